//! Laws of the reference that no stability case states (`host/lab/src/stability/tracer.rs`, `scattering.rs`): parts that a case cannot reach,
//! and what a picture looks like.

mod albedo_table;
mod bsdf_laws;
mod lighting;
mod materials;

use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, Scene, TriangleMesh};
use glam::{DAffine3, DVec3, Vec2, Vec3};
