//! A light sensor at the tip of a tracked wand, moved through coded planes of light (\[Lee04\]), into lens, pose, tip and
//! latency.
//!
//! [`Code`] says which pixels of which plane of which frame are lit; [`decode()`] finds the planes and the number of each
//! frame in the samples of the sensor; [`solve()`] fits what the sensor must have seen. The sensor's own clock serves only
//! to tell the planes apart: a level belongs to a plane of a frame, and the projector says when that plane was lit.

mod change;
mod code;
mod coverage;
mod decode;
mod fit;
mod inverse;
mod latency;
mod lens;
mod lock;
mod problem;
mod start;
mod stripes;

pub use code::{Code, CodeError, Role, PLANES};
pub use coverage::Coverage;
pub use decode::{decode, DecodeError, Decoding, SensorFrame};
pub use fit::{solve, Brightness, SensorError, Settings, Solution};
pub use inverse::{
    decode_pairs, places_rested, solve_latency_of_pairs, solve_pairs, DecodedPairs, FrameLight, InverseCode,
    Mapped, Pair, Stripe, FEWEST_PLACES,
};
pub use latency::{solve_latency, Latency};
pub use lock::{Lock, SampleBlock};

/// When the projector shows which frame, by the host's clock. All planes of a frame are equally long, and no pause
/// divides frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    /// Start of the first plane of frame 0.
    pub frame_zero_ns: i64,
    /// Length of a frame; with its fraction, since it adds up over thousands of frames.
    pub frame_ns: f64,
}

impl Timing {
    /// The instant within a frame: `planes` after its start. The second number is the rest below a nanosecond.
    pub fn instant(&self, frame: u64, planes: f64) -> (i64, f64) {
        let ns = (frame as f64 + planes / PLANES as f64) * self.frame_ns;
        (self.frame_zero_ns.saturating_add(ns as i64), ns.fract())
    }
}

#[cfg(test)]
mod tests;
