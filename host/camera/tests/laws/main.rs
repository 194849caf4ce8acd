//! The integration tests of this crate, in one program: one link, one row of costs.

mod identity;
mod pictures;
mod poses;
mod projector;
mod stage;
