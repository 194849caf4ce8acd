//! Laws that the reference must obey: closed forms, conservation, reciprocity, statistics, invariance.

mod albedo_table;
mod bsdf_laws;
mod furnace;
mod intersection;
mod lighting;
mod materials;

use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, Scene, TriangleMesh};
use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};
