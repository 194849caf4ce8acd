//! Laws that the reference must obey: closed forms, conservation, reciprocity, statistics, invariance.

mod bsdf_laws;
mod furnace;
mod intersection;
mod lighting;
mod materials;

use crate::experiments::stability::shapes::*;
use crate::scene::{Environment, Material, Scene, TriangleMesh};
use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};
