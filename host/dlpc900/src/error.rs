//! What can go wrong with a controller, what its error codes mean, and the remedy for each.

use std::time::Duration;

use super::sequence::SequenceError;

/// Errors of the cable.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PortError {
    /// Nothing within the time given.
    #[error("no answer in time: is it switched on, and past its start (10 s)? Else switch it off and on")]
    Timeout,
    /// The device has gone.
    #[error("the device was unplugged or has lost power: check cable and supply")]
    Gone,
    /// No such device.
    #[error("none is plugged in and switched on there: check cable and supply; `lsusb -d 0451:c900` lists those that are")]
    NotFound,
    /// The operating system denies access; the text is the remedy.
    #[error("no permission to open the device: {0}")]
    Denied(String),
    /// Another program uses the device.
    #[error("another program holds the device: close it (TI's own, or a second dpm; `fuser -v` on the device file names it)")]
    Busy,
    /// Anything else.
    #[error("{0}")]
    Other(String),
}

/// Why a call failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Dlpc900Error {
    /// The cable failed.
    #[error("{doing}: {source}")]
    Port {
        /// The device and the command.
        doing: String,
        /// The error.
        source: PortError,
    },
    /// The controller refused a command.
    #[error("{doing}: the controller refuses (error {code}, \"{text}\"): {remedy}")]
    Refused {
        /// The command, with the entry or image that it concerned.
        doing: String,
        /// The controller's error code.
        code: u8,
        /// The controller's error text.
        text: String,
        /// The remedy in the present state of the controller.
        remedy: &'static str,
    },
    /// The controller's answer makes no sense.
    #[error("{doing}: the answer makes no sense ({what})")]
    Protocol {
        /// Which command.
        doing: String,
        /// What is wrong with it.
        what: String,
    },
    /// A sequence that the controller cannot show.
    #[error(transparent)]
    Sequence(#[from] SequenceError),
    /// The controller reports a hardware error.
    #[error("the controller reports {0}: check DMD, cable and power, then reset")]
    Hardware(String),
    /// No video signal.
    #[error("the video source did not lock within {0:?}: check cable, resolution and that the graphics card sends a picture")]
    NotLocked(Duration),
    /// A stop was requested during the call; see [`Dlpc900::stop_when`](super::driver::Dlpc900::stop_when).
    #[error("stopped before the controller was set up")]
    Stopped,
    /// An unknown DMD.
    #[error("the controller drives a DMD with unknown number {0}: update this program or the controller's firmware")]
    UnknownDmd(u8),
}

impl Dlpc900Error {
    /// The controller is not there: it was unplugged, or has lost power.
    pub const fn is_gone(&self) -> bool {
        matches!(self, Self::Port { source: PortError::Gone | PortError::NotFound, .. })
    }
}

/// What the controller's error code means.
pub const fn error_meaning(code: u8) -> &'static str {
    match code {
        0 => "no error",
        1 => "batch file checksum error",
        2 => "device failure",
        3 => "invalid command number",
        4 => "incompatible controller and DMD",
        5 => "command not allowed in current mode",
        6 => "invalid command parameter",
        7 => "item referred by the parameter is not present",
        8 => "out of resource (RAM or flash)",
        9 => "invalid BMP compression type",
        10 => "pattern bit number out of range",
        11 => "pattern BMP not present in flash",
        12 => "pattern dark time is out of range",
        13 => "signal delay parameter is out of range",
        14 => "pattern exposure time is out of range",
        15 => "pattern number is out of range",
        16 => "invalid pattern definition",
        17 => "pattern image memory address is out of range",
        255 => "internal error",
        _ => "unknown error",
    }
}

/// The remedy for an error code.
pub const fn remedy(code: u8) -> &'static str {
    match code {
        1 | 7 | 11 => {
            "what the command names is not in the controller's flash; load it there or upload it over USB"
        }
        2 | 4 | 255 => {
            "power the projector off and on; if it stays, DMD and controller do not fit or are damaged"
        }
        3 => "the firmware does not know this command; update it",
        5 => "stop the sequence and select the right display mode first",
        6 => "a number in the command is outside its range",
        8 => "fewer or smaller images",
        9 => "the image stream is damaged; upload again, without other programs on the cable",
        10 => "bit position plus depth must stay within 24 planes",
        12 => "a shorter dark time",
        13 => "trigger delays lie between -20 and 20000 us",
        14 => "a longer exposure or fewer bits; the least exposure grows with the depth",
        15 => "fewer patterns in the table",
        16 => "number the entries 0, 1, 2, ... without gaps and define each before the configuration",
        17 => "image numbers must be below the number of images uploaded",
        _ => "look the code up in the programmer's guide (DLPU018, command 0x0100)",
    }
}
