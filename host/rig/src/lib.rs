//! The rig. **Follow one frame** through its folders: tracks, plan, render, pack, link, light.
//!
//! `docs/FRAME.md` follows a frame in detail, with a picture. `docs/ARCHITECTURE.md` states one invariant per folder.
//!
//! # Example: twenty frames from motion to light
//!
//! This runs the demo's rig with the mock tracker and the mock projector. Prepared frames replace the renderer, so no
//! GPU is needed; [`pipeline::run`] with a [`dpm_render::gpu::Gpu`] renders them.
//!
//! ```
//! use dpm_device::planes::Raster;
//! use dpm_rig::config::{Overrides, RigConfig};
//! use dpm_rig::pipeline::{run_prepared, RunOptions};
//! use dpm_rig::rig::Rig;
//! use dpm_rig::telemetry::monitor::RunMonitor;
//! use std::sync::Arc;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let flags = vec!["tracker.noise_m=0.0001".to_owned()];
//! let config = RigConfig::demo(&Overrides { flags, ..Default::default() })?;
//! let rig = Arc::new(Rig::build(&config, Raster::new(64, 48))?);
//! let options = RunOptions { frames: 20, ..Default::default() };
//! let outcome = run_prepared(rig, options, &Arc::new(RunMonitor::default()))?;
//!
//! assert_eq!(outcome.report.frames_lit, 20);
//! assert_eq!(outcome.frames_torn, 0, "no frame was lit with a part of another");
//! # Ok(())
//! # }
//! ```

pub mod calibrated;
pub mod calibration_steps;
pub mod camera_file;
pub mod config;
pub mod control;
pub mod drive;
mod engine;
pub mod failure;
pub mod frame;
pub mod gaze;
mod gaze_stream;
pub mod interlock;
pub mod light;
pub mod method_choice;
mod mock;
pub mod order;
pub mod own_run;
pub mod pack;
pub mod parameters;
pub mod pattern;
pub mod picture_stream;
pub mod pictures;
pub mod pipeline;
pub mod plan;
pub mod presence;
pub mod projectors;
mod render;
pub mod results;
pub mod rig;
pub mod run_rig;
pub mod standing;
pub mod still;
pub mod telemetry;
pub mod trackers;
pub mod tracks;
