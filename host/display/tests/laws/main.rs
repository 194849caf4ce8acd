//! The integration tests of this crate, in one program: one link, one row of costs.

mod common;
mod panel;
mod real_pace;
mod set_up;
