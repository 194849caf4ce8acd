//! A scene into radiance by a plain f64 path tracer on the CPU: the oracle of every image test.
//!
//! It follows `docs/RENDERING.md` and shares no code with the shaders (the albedo table is data that both read). Reading order:
//! [`render`](Reference::render), then [`path`], [`light`], [`bsdf`], [`microfacet`]; [`bvh`] and [`surface`] answer what a ray meets.
//!
//! **Numbers.** Triangles are moved to world space in f64, so no ray is ever transformed. A hit point is the barycentric mean of its
//! vertices: wrong by a few units in the last place of the largest coordinate. New rays start [`OFFSET`] times that coordinate away along
//! the geometric normal, thousands of times the error and, in a scene of metres, a picometre: too little to see, so the bit patterns of
//! \[Waechter19\], which single precision needs, would add nothing here.

pub(crate) mod bsdf;
pub mod bvh;
mod image;
mod light;
pub(crate) mod lobes;
pub(crate) mod microfacet;
mod path;
mod surface;
mod texture;

pub use dpm_device::rng::Sampler;
pub use image::{ReferenceImage, RenderSettings};
pub use surface::SurfacePoint;

use bvh::{Bvh, Hit, Triangle};
use dpm_scene::albedo_table::{tabulated, AlbedoTable};
use dpm_scene::lobes::LEAST_COVERAGE;
use dpm_scene::Scene;
use glam::{DAffine3, DMat3, DVec3};
use light::Lights;
use std::sync::OnceLock;

/// Distance of a new ray's origin from its surface, in units of the largest coordinate.
pub(crate) const OFFSET: f64 = 1e-12;

/// A scene with every body at a pose, ready to be traced.
pub(crate) struct Reference<'a> {
    scene: &'a Scene,
    bvh: Bvh,
    normal_from_body: Vec<DMat3>,
    world_from_body: Vec<DAffine3>,
    /// One table per distinct index of refraction, made when a ray first asks for it.
    tables: Vec<(f32, OnceLock<AlbedoTable>)>,
    table_of_material: Vec<usize>,
    lights: Lights,
    /// Some material is only partly there.
    blends: bool,
    /// Triangles left out because a vertex is not finite or the area is zero.
    pub dropped_triangles: usize,
}

impl<'a> Reference<'a> {
    /// Builds the tracer. `poses`: world-from-body for each body of the scene; bodies beyond its end are at rest.
    pub(crate) fn new(scene: &'a Scene, poses: &[DAffine3]) -> Self {
        let world_from_body: Vec<DAffine3> = (scene.bodies.iter().enumerate())
            .map(|(i, body)| poses.get(i).copied().unwrap_or(body.world_from_body_rest))
            .collect();
        let mut triangles = Vec::new();
        let mut dropped_triangles = 0;
        for (b, body) in scene.bodies.iter().enumerate() {
            let at = |i: u32| world_from_body[b].transform_point3(body.mesh.positions[i as usize].as_dvec3());
            for (t, index) in body.mesh.triangles.iter().enumerate() {
                let p = index.map(at);
                let area = (p[1] - p[0]).cross(p[2] - p[0]).length();
                if area > 0.0 && area.is_finite() {
                    triangles.push(Triangle { p, body: b as u32, index: t as u32 });
                } else {
                    dropped_triangles += 1;
                }
            }
        }
        let iors: Vec<f32> = scene.materials.iter().map(|m| m.ior).collect();
        let (iors, table_of_material) = tabulated(&iors);
        let tables = iors.into_iter().map(|ior| (ior, OnceLock::new())).collect();
        let bvh = Bvh::new(triangles);
        let lights = Lights::new(scene, &world_from_body, &bvh);
        let normal_from_body = world_from_body.iter().map(|m| m.matrix3.inverse().transpose()).collect();
        Self {
            scene,
            bvh,
            normal_from_body,
            world_from_body,
            tables,
            table_of_material,
            lights,
            blends: scene.materials.iter().any(|m| m.alpha_blend),
            dropped_triangles,
        }
    }

    /// The acceleration structure.
    pub(crate) fn bvh(&self) -> &Bvh {
        &self.bvh
    }

    /// The first surface on a ray at 0 < t < `t_max`; masked-out texels let it pass. `projected_only`: see [`Self::visible`].
    pub(crate) fn trace(
        &self,
        origin: DVec3,
        direction: DVec3,
        t_max: f64,
        projected_only: bool,
    ) -> Option<SurfacePoint> {
        let hit = self.bvh.closest(origin, direction, t_max, |hit| self.exists(hit, projected_only))?;
        Some(self.resolve(&hit))
    }

    /// True when nothing stands between two points. `projected_only`: only bodies on which the projector's light can fall count.
    pub(crate) fn visible(&self, from: DVec3, to: DVec3, projected_only: bool) -> bool {
        let way = to - from;
        let length = way.length();
        length > 0.0 && !self.occluded(from, way / length, length, projected_only)
    }

    /// True when something stands on a ray at 0 < t < `t_max`.
    pub(crate) fn occluded(&self, origin: DVec3, direction: DVec3, t_max: f64, projected_only: bool) -> bool {
        self.bvh.any(origin, direction, t_max, |hit| self.exists(hit, projected_only))
    }

    /// The coat's albedo table of a material.
    pub(crate) fn table(&self, material: u32) -> &AlbedoTable {
        let (ior, table) = &self.tables[self.table_of_material[material as usize]];
        table.get_or_init(|| AlbedoTable::new(*ior))
    }

    fn exists(&self, hit: &Hit, projected_only: bool) -> bool {
        let triangle = self.bvh.triangle(hit.triangle);
        let body = &self.scene.bodies[triangle.body as usize];
        if projected_only && !body.projected {
            return false;
        }
        let material = &self.scene.materials[body.mesh.materials[triangle.index as usize] as usize];
        let least = if material.alpha_blend { Some(LEAST_COVERAGE) } else { material.alpha_cutoff };
        least.is_none_or(|least| self.alpha(hit) >= f64::from(least))
    }

    /// Whether a ray of a path meets a hit: a surface that is only partly there decides by chance, of the ray (`key`) and the triangle.
    fn is_met(&self, hit: &Hit, key: u64) -> bool {
        let triangle = self.bvh.triangle(hit.triangle);
        let mesh = &self.scene.bodies[triangle.body as usize].mesh;
        if !self.scene.materials[mesh.materials[triangle.index as usize] as usize].alpha_blend {
            return self.exists(hit, false);
        }
        Sampler::new(key, hit.triangle as u64).uniform() < self.alpha(hit)
    }

    /// The number that decides what a ray meets; 0 where nothing is left to chance.
    fn ray_key(&self, sampler: &mut Sampler) -> u64 {
        if self.blends {
            sampler.next_u64()
        } else {
            0
        }
    }
}

/// A point moved off its surface: `normal` is the geometric one, `toward` tells the side. `scale`: largest coordinate involved.
pub(crate) fn offset(point: DVec3, normal: DVec3, toward: DVec3, scale: f64) -> DVec3 {
    let side = if normal.dot(toward) >= 0.0 { 1.0 } else { -1.0 };
    point + normal * (side * OFFSET * scale)
}

#[cfg(test)]
mod tests;
