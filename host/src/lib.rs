//! dpm: the rig controller. **Follow one frame**: tracking, plan, render, pack, link, light.
//!
//! See `docs/ARCHITECTURE.md` for the picture and one invariant per folder.

pub mod config;
pub mod geometry;
pub mod reference;
pub mod render;
pub mod scene;
pub mod tracking;
