//! The rig. **Follow one frame**: tracks, plan, render, pack, link, light.
//!
//! See `docs/ARCHITECTURE.md` for the picture and one invariant per folder.

pub mod config;
pub mod control;
pub mod failure;
pub mod frame;
pub mod interlock;
mod mock;
pub mod pictures;
pub mod pipeline;
pub mod plan;
pub mod realtime;
pub mod rig;
pub mod run_rig;
pub mod standing;
pub mod telemetry;
mod tracks;
