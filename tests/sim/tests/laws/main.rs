//! The integration tests of this crate, in one program: one link, one row of costs.

mod breadth;
mod follow;
mod seeds;
