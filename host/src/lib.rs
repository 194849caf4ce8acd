//! dpm: the rig controller. **Follow one frame**: tracking, plan, render, pack, link, light.
//!
//! See `docs/ARCHITECTURE.md` for the picture and one invariant per folder.

pub mod cli;
pub mod clock;
pub mod commit;
pub mod config;
pub mod control;
pub mod dlpc900;
pub mod experiments;
pub mod failure;
pub mod files;
pub mod folder;
pub mod frame;
pub mod geometry;
pub mod gpu;
pub mod interlock;
pub mod metrics;
pub mod pack;
pub mod pipeline;
pub mod plan;
pub mod realtime;
pub mod reference;
pub mod render;
pub mod rig;
pub mod scene;
pub mod standing;
pub mod stopping;
pub mod telemetry;
pub mod tracking;
pub mod unix;
