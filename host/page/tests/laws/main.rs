//! The integration tests of this crate, in one program: one link, one row of costs.

mod calibration;
mod common;
mod metrics;
mod orders;
mod parameters;
mod real_pace;
