//! The whole calibration against a truth that it does not know: what the light will be worth.
//!
//! A truth is drawn from the seed. A hand, a tracker and a photodiode are simulated with their noise, the solvers see
//! only what these report, and their results are compared with the truth over the working volume.

mod photodiode;
mod tracker;
mod truth;

pub use truth::Bias;

#[cfg(test)]
mod tests;
