//! What several crates of the rig controller share: the clock, files and folders, stop flags, rotations.

pub mod clock;
pub mod commit;
pub mod files;
pub mod folder;
pub mod quantiles;
pub mod so3;
pub mod stopping;
pub mod unix;
