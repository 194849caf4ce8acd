//! What can be wrong with an ALP, and what to do about it.

use super::abi;
use std::path::PathBuf;

/// Why an ALP does not do what it should.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AlpError {
    /// The vendor's library cannot be opened.
    #[error("cannot open the ALP library {}: {reason}; install ViALUX's ALP for Linux, or set `library` to the path of its libalp", path.display())]
    Library {
        /// What was tried last.
        path: PathBuf,
        /// What the loader says.
        reason: String,
    },
    /// The library lacks a function.
    #[error("{} has no function {function}: this is not an ALP-4 or ALP-5 library; set `library`", path.display())]
    Function {
        /// The library.
        path: PathBuf,
        /// The function.
        function: &'static str,
    },
    /// A call failed.
    #[error("{device}: {call} answered {} ({code}): {}", abi::name_of(*code), remedy(*code))]
    Call {
        /// The device.
        device: String,
        /// The vendor's function, and what it was asked.
        call: &'static str,
        /// Its answer.
        code: i32,
    },
    /// The device is not what the rig file says.
    #[error("{device} has {found_width} x {found_height} mirrors, and the rig file says {width} x {height}: set projector.width = {found_width} and projector.height = {found_height}")]
    Raster {
        /// The device.
        device: String,
        /// Its mirrors in a row.
        found_width: u32,
        /// Its rows.
        found_height: u32,
        /// Mirrors in a row by the rig file.
        width: u32,
        /// Rows by the rig file.
        height: u32,
    },
    /// The panel cannot show so many planes in a frame's time.
    #[error("{device} shows a plane for at least {shortest_us} us, and {planes} planes {how} at {hz:.3} frames/s leave {left_us:.1} us: at most {most_hz:.1} frames/s")]
    TooFast {
        /// The device.
        device: String,
        /// Planes of a frame.
        planes: usize,
        /// How they share the frame.
        how: &'static str,
        /// Frames a second that were asked for.
        hz: f64,
        /// What the panel needs, microseconds.
        shortest_us: i32,
        /// What there is for the shortest plane, microseconds.
        left_us: f64,
        /// Frames a second that it can show.
        most_hz: f64,
    },
    /// The panel cannot show a plane for so long.
    #[error("{device} shows a plane for at most {longest_us} us, and a frame's longest would take {asked_us} us: raise the frame rate")]
    TooSlow {
        /// The device.
        device: String,
        /// What the panel can, microseconds.
        longest_us: i32,
        /// What the frame rate asks for, microseconds.
        asked_us: i64,
    },
    /// The panel took another picture time than it was given.
    #[error("{device} was given a picture time of {asked_us} us and uses {used_us} us")]
    Timing {
        /// The device.
        device: String,
        /// What it was told.
        asked_us: i32,
        /// What it says.
        used_us: i32,
    },
    /// The cable is too slow.
    #[error("{device} takes {measured_mb:.0} MB/s over its cable, and {planes} planes at {hz:.1} frames/s are {needed_mb:.0} MB/s: at most {most_hz:.1} frames/s")]
    Cable {
        /// The device.
        device: String,
        /// Measured rate, million bytes a second.
        measured_mb: f64,
        /// What the frames need, million bytes a second.
        needed_mb: f64,
        /// Planes of a frame.
        planes: usize,
        /// Frames a second.
        hz: f64,
        /// Frames a second that the cable can carry.
        most_hz: f64,
    },
    /// The memory is too small.
    #[error("{device} has memory for {free} binary pictures, and {frames} frames in flight need {needed}: lower `frames_in_flight`, or free what another program has loaded")]
    Memory {
        /// The device.
        device: String,
        /// Free binary pictures.
        free: i32,
        /// Frames in flight.
        frames: usize,
        /// Binary pictures that they need.
        needed: usize,
    },
    /// The queue is too short.
    #[error("{device} queues {places} sequences, and two frames of {parts} sequences need {needed}: use plane_times = \"equal\"")]
    Queue {
        /// The device.
        device: String,
        /// Places of the queue.
        places: i32,
        /// Sequences of a frame.
        parts: usize,
        /// Places that two frames need.
        needed: usize,
    },
}

impl AlpError {
    /// Whether the device is gone or silent, so that only opening it again can help.
    pub fn is_gone(&self) -> bool {
        let gone = [abi::NOT_ONLINE, abi::NOT_AVAILABLE, abi::ERROR_COMM, abi::DEVICE_REMOVED];
        matches!(self, Self::Call { code, .. } if gone.contains(code))
    }
}

fn remedy(code: i32) -> &'static str {
    match code {
        1001 => "no such device; switch it on, plug it in, and check projector.backend.device_number",
        1002 => "it shows something; end the other program that uses it",
        1004 => "another program uses it; end that program",
        1007 => "its memory is full; power-cycle it if no other program uses it",
        1010 | 1013 | 1020 => "power-cycle it",
        1011 => "check the cable, and use a USB 3 port of the computer itself",
        1003 | 1012 => "it was unplugged; plug it in again",
        1014 | 1019 => "update ViALUX's driver, and power-cycle the device",
        1018 => "its DMD did not wake up; power-cycle it",
        _ => "see the vendor's description of the call",
    }
}
