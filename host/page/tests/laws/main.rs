//! The integration tests of this crate, in one program: one link, one row of costs.

mod attack;
mod calibration;
mod common;
mod events;
mod metrics;
mod orders;
mod parameters;
mod rigs;
