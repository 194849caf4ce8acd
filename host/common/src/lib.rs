//! What several crates of the rig controller share: the clock, files and folders, stop flags, rigid motions.

pub mod clock;
pub mod commit;
pub mod files;
pub mod folder;
pub mod se3;
pub mod stopping;
pub mod unix;
