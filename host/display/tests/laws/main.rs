//! The integration tests of this crate, in one program: one link, one row of costs.

mod common;
mod dlpc900;
mod panel;
mod set_up;
mod transport;
mod window;
