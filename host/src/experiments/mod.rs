//! Runs that answer a question: each is a command and a test.

pub mod pictures;
pub mod profile;
pub mod run_rig;
pub mod sequence;
pub mod snapshot;
pub mod stability;
