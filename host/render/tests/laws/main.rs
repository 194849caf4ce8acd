//! The integration tests of this crate, in one program: one link, one row of costs.

#[path = "../../../scene/tests/laws/common/mod.rs"]
mod common;
mod few_samples;
mod hostile_gltf;
mod scale;
