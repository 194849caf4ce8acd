//! The code for projectors that hold a picture for a whole frame, such as displays: every picture is followed by its
//! inverse, so that the light of the whole never flashes, and what the sensor sees is the difference of the two.
//!
//! A round of the code takes some forty frames, during which a hand moves far. So the wand is held still at a dozen places
//! for a second or two each, which gives a start, and moved slowly between them, which gives the latency.

mod code;
mod decode;
mod record;
mod solve;

pub use code::{InverseCode, Stripe};
pub use decode::{decode_pairs, DecodedPairs, FrameLight, Pair};
pub use record::Mapped;
pub use solve::{places_rested, solve_latency_of_pairs, solve_pairs, FEWEST_PLACES};
