//! The laboratory: what judges the rig and its renderer. Each experiment is a command and a test.
//!
//! # Example: one of the stiff cases
//!
//! ```
//! use dpm_lab::stability::{cases, StabilityReport, SEED};
//!
//! let mut report = StabilityReport::default();
//! report.run_cases(&cases(), Some("compensation-extremes"), SEED..=SEED, |case| {
//!     println!("{}: {:?} of at most {} {}", case.name, case.error, case.bound, case.unit);
//! });
//! assert_eq!((report.cases.len(), report.passed), (1, 1));
//! ```

pub mod bench;
pub mod bench_walk;
pub mod blue_noise;
pub mod conformance;
pub mod error;
pub mod film;
pub mod gpu_model;
pub mod handoff_cost;
pub mod lanes;
pub mod link_test;
mod median;
pub mod method_choice;
mod metrics;
pub mod offline;
pub mod paint;
pub mod plan_savings;
pub mod reference;
pub mod report;
pub mod room;
pub mod rounding;
pub mod scene_plan;
pub mod seed_frames;
pub mod sequence;
pub mod snapshot;
#[cfg(test)]
mod sobol;
pub mod stability;
pub mod stamp;
mod statistics;
pub mod temporal_light;
pub mod twins;
