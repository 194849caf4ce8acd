//! A software projector and software trackers, for a rig without hardware.
//!
//! Reading order: [`motion`] is the true motion, [`faults`] the one vocabulary of faults, [`tracker`] the samples that
//! a tracker would report, [`projector`] the light that a projector makes from its packets. All randomness comes from
//! [`dpm_device::rng`], keyed by a seed; time is always an argument. The crate `hil-mock` offers the same mocks to other
//! programs, over USB/IP, pseudo-terminals, UDP and TCP.
//!
//! # Example: a tracker that goes blind for 10 ms
//!
//! ```
//! use dpm_device::{pose::Pose, time::HostTime, tracker::Tracker};
//! use dpm_mock::motion::{Motion, MotionSpec};
//! use dpm_mock::tracker::{MockTracker, MockTrackerConfig};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let spin = MotionSpec::Rotate { axis: [0.0, 1.0, 0.0], rate_rad_s: 3.0, pivot_offset_m: [0.0; 3] };
//! let body = Motion::new(&spin, Pose::IDENTITY)?;
//! let config = MockTrackerConfig { faults: "dropout@20ms+10ms".parse()?, ..Default::default() };
//! let mut tracker = MockTracker::new(config, vec![body.clone()])?;
//!
//! // Everything that arrives within the first 50 ms: 500 samples a second, each 2 ms after its capture.
//! let mut captured = Vec::new();
//! tracker.poll(HostTime(50_000_000), &mut |sample| {
//!     let truth = body.pose_at(sample.captured_at.0);
//!     assert_eq!(sample.pose.position_m, truth.position_m, "no noise was asked for");
//!     captured.push(sample.captured_at.0 / 1_000_000);
//! })?;
//! assert!(captured.contains(&18) && captured.contains(&30));
//! assert!(!captured.iter().any(|ms| (20..30).contains(ms)), "blind: {captured:?}");
//! # Ok(())
//! # }
//! ```

pub mod camera;
pub mod faults;
pub mod hand;
pub mod line_port;
pub mod monotonic;
pub mod motion;
mod motion_spec;
pub mod natnet_host;
pub mod natnet_server;
pub mod projector;
pub mod report_queue;
pub mod serial_server;
pub mod tracker;
pub mod vrpn_host;
pub mod vrpn_server;
