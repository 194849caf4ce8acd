//! Words into calls: the command line of `dpm`. One file per command, no logic of its own.

pub mod rig_args;
pub mod signals;
pub mod watch;
