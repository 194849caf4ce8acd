//! The integration tests of this crate, in one program: one link, one row of costs.

mod examine;
mod source;
mod stage;
mod tracker;
