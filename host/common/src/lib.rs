//! Code that several crates of the rig controller share: the clock, files and folders, stop flags, rotations.
//!
//! # Example: a clock that a test sets by hand
//!
//! ```
//! use dpm_common::clock::{Clock, ManualClock};
//! use dpm_device::time::HostTime;
//!
//! let clock = ManualClock::new(HostTime(0));
//! clock.advance_to(HostTime(1_000));
//! clock.advance_to(HostTime(500)); // It never goes back.
//! assert_eq!(clock.now(), HostTime(1_000));
//! ```

pub mod clock;
pub mod commit;
pub mod files;
pub mod fnv;
pub mod folder;
pub mod guardian;
pub mod keys;
pub mod quantiles;
pub mod realtime;
pub mod rounding;
pub mod signals;
pub mod so3;
pub mod stopping;
pub mod unix;
