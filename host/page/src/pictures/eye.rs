//! What falls on the bodies, and what the observer sees of it, as small pictures of linear light.

use super::depth::{small, DepthBuffer};
use super::mesh::{CoarseMesh, CELLS};
use dpm_device::planes::Raster;
use dpm_device::projector::light_of_planes;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::live::SeenLight;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3, Vec3};
use std::sync::Arc;

/// A surface is in the shadow of another that is nearer to the projector by more than this share.
const SHADOW: f32 = 0.02;
/// By how much of the way the camera follows the bodies from picture to picture.
const FOLLOW: f64 = 0.2;

/// Share of the radius of a mesh's sphere that it fills, more or less.
const FILLED: f64 = 0.7;

/// A picture of linear light, row by row.
#[derive(Clone, Debug)]
pub(super) struct Linear {
    pub raster: Raster,
    pub pixels: Vec<Vec3>,
}

/// Makes pictures of one rig.
pub(super) struct Eye {
    rig: Arc<Rig>,
    raster: Raster,
    /// Per body of the scene that light may fall on: its number and its mesh.
    meshes: Vec<(usize, CoarseMesh)>,
    codes: Vec<[u8; 3]>,
    poses: Vec<DAffine3>,
    from_eye: DepthBuffer,
    from_projector: DepthBuffer,
    /// Where the camera looks, and how large the part is that it shows.
    framed: Option<(DVec3, f64)>,
}

impl Eye {
    pub(super) fn new(rig: &Arc<Rig>) -> Self {
        let meshes = rig.scene.bodies.iter().enumerate().filter(|(_, b)| b.projected);
        Self {
            rig: rig.clone(),
            raster: small(rig.camera.raster),
            meshes: meshes.map(|(i, b)| (i, CoarseMesh::of(&b.mesh, CELLS))).collect(),
            codes: Vec::new(),
            poses: Vec::new(),
            from_eye: DepthBuffer::default(),
            from_projector: DepthBuffer::default(),
            framed: None,
        }
    }

    /// The light of `seen`, 0 to 1, averaged over the pixels of a small picture; black while the projector is dark.
    /// `None` if the planes are not those of the rig.
    pub(super) fn light(&mut self, seen: &SeenLight) -> Option<Linear> {
        let (full, small) = (self.rig.camera.raster, self.raster);
        let (width, height) = (small.width() as usize, small.height() as usize);
        let mut pixels = vec![Vec3::ZERO; small.pixel_count()];
        if seen.frame.is_none() {
            return Some(Linear { raster: small, pixels });
        }
        let schedule = &self.rig.schedule;
        if seen.planes.len() != full.plane_bytes() * schedule.len() {
            return None;
        }
        self.codes.resize(full.pixel_count(), [0; 3]);
        light_of_planes(full, schedule, &seen.planes, &mut self.codes);
        let full_width = full.width() as usize;
        let edge = |i: usize, of: usize, all: u32| i * all as usize / of;
        for y in 0..height {
            let rows = edge(y, height, full.height())..edge(y + 1, height, full.height());
            for x in 0..width {
                let columns = edge(x, width, full.width())..edge(x + 1, width, full.width());
                let mut sum = [0u32; 3];
                for row in rows.clone() {
                    for code in &self.codes[row * full_width..][columns.clone()] {
                        sum.iter_mut().zip(code).for_each(|(s, c)| *s += u32::from(*c));
                    }
                }
                let count = (rows.len() * columns.len()).max(1) as f32;
                pixels[y * width + x] = Vec3::from(sum.map(|s| s as f32)) / (255.0 * count);
            }
        }
        Some(Linear { raster: small, pixels })
    }

    /// What the observer sees, radiance in scene units, in `light`, which falls on tracked bodies at `poses` at `t_ns` on the
    /// host's clock. `None` while nothing can be seen.
    pub(super) fn viewer(&mut self, light: &Linear, poses: &[DAffine3], t_ns: i64) -> Option<Linear> {
        if poses.len() != self.rig.tracked_count() {
            return None;
        }
        let projector = self.rig.camera.at_raster(self.raster);
        let intensity = Vec3::from_array(self.rig.config.projector.intensity_at_255().map(|v| v as f32));
        let ambient = Vec3::from_array(self.rig.config.scene.ambient.map(|v| v as f32));
        let (eye, _) = self.rig.observer.eye_and_gaze(poses);
        self.rig.scene_poses(poses, t_ns, &mut self.poses);
        let camera = self.camera(eye)?;
        let bodies: Vec<(&CoarseMesh, DAffine3)> =
            self.meshes.iter().map(|(i, mesh)| (mesh, self.poses[*i])).collect();
        self.from_projector.draw(&projector, &bodies);
        self.from_eye.draw(&camera, &bodies);
        let (origin, axis) = (projector.position(), projector.world_from_projector.matrix3 * DVec3::NEG_Z);
        let shade = |at: usize| {
            let Some(seen) = self.from_eye.surface(at, &bodies) else { return Vec3::ZERO };
            let position = seen.position.as_dvec3();
            let Some(pixel) = projector.project(position) else { return ambient };
            let near = (1.0 / (position - origin).dot(axis)) as f32;
            let (x, y) = (pixel.x as f32, pixel.y as f32);
            if self.from_projector.near_at(x, y) > near * (1.0 + SHADOW) {
                return ambient;
            }
            let to_projector = (origin - position).as_vec3();
            let d2 = to_projector.length_squared();
            let cos = seen.normal.dot(to_projector).abs() / d2.sqrt();
            let drive = bilinear(light, x, y);
            let albedo = self.rig.albedo_at(self.meshes[seen.body].0, seen.uv);
            ambient + drive * albedo * intensity * (cos / (std::f32::consts::PI * d2))
        };
        let pixels = (0..self.raster.pixel_count()).map(shade).collect();
        Some(Linear { raster: self.raster, pixels })
    }

    /// A camera at the eye that follows the bodies calmly.
    fn camera(&mut self, eye: DVec3) -> Option<ProjectorCamera> {
        let (mut lower, mut upper) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for (i, mesh) in self.meshes.iter().filter(|(_, mesh)| !mesh.triangles.is_empty()) {
            let centre = self.poses[*i].transform_point3(mesh.centre);
            // The sphere touches the corners of the mesh's box, which are seldom filled.
            lower = lower.min(centre - mesh.radius_m * FILLED);
            upper = upper.max(centre + mesh.radius_m * FILLED);
        }
        if !lower.is_finite() || !upper.is_finite() {
            return None;
        }
        let now = ((lower + upper) * 0.5, (upper - lower).length() * 0.42);
        let (centre, radius) = match self.framed {
            Some((centre, radius)) => {
                // It widens at once, so that no body leaves the picture, and narrows slowly.
                let narrow = radius + (now.1 - radius) * FOLLOW * 0.1;
                (centre.lerp(now.0, FOLLOW), now.1.max(narrow))
            }
            None => now,
        };
        self.framed = Some((centre, radius));
        let radius = radius.max(1e-9);
        let distance = (centre - eye).length().max(radius * 1.05);
        let aspect = f64::from(self.raster.width()) / f64::from(self.raster.height());
        let vertical = 2.0 * (radius / distance).asin();
        let horizontal = 2.0 * ((0.5 * vertical).tan() * aspect.max(1.0)).atan();
        ProjectorCamera::look_at(self.raster, eye, centre, DVec3::Y, horizontal.clamp(0.01, 3.0)).ok()
    }
}

/// The light at a pixel position, interpolated between pixel centres; black outside.
fn bilinear(light: &Linear, x: f32, y: f32) -> Vec3 {
    let (width, height) = (light.raster.width() as usize, light.raster.height() as usize);
    let (x, y) = (x - 0.5, y - 0.5);
    let (x0, y0) = (x.floor(), y.floor());
    let texel = |x: f32, y: f32| {
        let inside = x >= 0.0 && y >= 0.0 && (x as usize) < width && (y as usize) < height;
        if inside {
            light.pixels[y as usize * width + x as usize]
        } else {
            Vec3::ZERO
        }
    };
    let top = texel(x0, y0).lerp(texel(x0 + 1.0, y0), x - x0);
    let bottom = texel(x0, y0 + 1.0).lerp(texel(x0 + 1.0, y0 + 1.0), x - x0);
    top.lerp(bottom, y - y0)
}
