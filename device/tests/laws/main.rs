//! The integration tests of this crate, in one program: one link, one row of costs.

mod packaging;
mod third_party;
