//! Which surface every pixel of a small camera sees: triangles into a buffer of depths.

use super::mesh::CoarseMesh;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3, Vec3};

/// A surface point that a pixel sees.
#[derive(Clone, Copy, Debug)]
pub(super) struct SeenSurface {
    /// Number of the body.
    pub body: usize,
    pub position: Vec3,
    /// Unit normal, which looks to either side.
    pub normal: Vec3,
    /// Texture coordinates.
    pub uv: [f32; 2],
}

/// The nearest surface of every pixel.
#[derive(Debug, Default)]
pub(super) struct DepthBuffer {
    width: usize,
    height: usize,
    /// One over the distance along the axis; 0 where nothing is.
    near: Vec<f32>,
    seen: Vec<(u16, u32, [f32; 2])>,
    corners: Vec<Corner>,
}

#[derive(Clone, Copy, Debug)]
struct Corner {
    /// Pixel position, and one over the distance along the axis; 0 where it is not in front of the camera.
    x: f32,
    y: f32,
    near: f32,
}

impl DepthBuffer {
    /// Draws all bodies into the empty buffer of `camera`.
    pub(super) fn draw(&mut self, camera: &ProjectorCamera, bodies: &[(&CoarseMesh, DAffine3)]) {
        let (width, height) = (camera.raster.width() as usize, camera.raster.height() as usize);
        (self.width, self.height) = (width, height);
        self.near.clear();
        self.near.resize(width * height, 0.0);
        self.seen.resize(width * height, (0, 0, [0.0; 2]));
        let axis = camera.world_from_projector.matrix3 * DVec3::NEG_Z;
        let origin = camera.position();
        for (number, (mesh, pose)) in bodies.iter().enumerate().take(usize::from(u16::MAX)) {
            self.corners.clear();
            self.corners.extend(mesh.positions.iter().map(|p| {
                let p = pose.transform_point3(p.as_dvec3());
                let along = (p - origin).dot(axis);
                let pixel = if along > 1e-6 { camera.project(p) } else { None };
                pixel.map_or(Corner { x: 0.0, y: 0.0, near: 0.0 }, |pixel| Corner {
                    x: pixel.x as f32,
                    y: pixel.y as f32,
                    near: (1.0 / along) as f32,
                })
            }));
            for (t, triangle) in mesh.triangles.iter().enumerate() {
                let corners = triangle.map(|v| self.corners[v as usize]);
                if corners.iter().all(|c| c.near > 0.0) {
                    self.fill(number as u16, t as u32, corners);
                }
            }
        }
    }

    fn fill(&mut self, body: u16, triangle: u32, [a, b, c]: [Corner; 3]) {
        let twice = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
        if twice.abs() < 1e-9 {
            return;
        }
        // Pixels whose centre lies in the bounding box. The conversion saturates.
        let first = |v: f32| (v - 0.5).ceil().max(0.0) as usize;
        let end = |v: f32, side: usize| ((v - 0.5).floor() + 1.0).max(0.0).min(side as f32) as usize;
        let (x0, x1) = (first(a.x.min(b.x).min(c.x)), end(a.x.max(b.x).max(c.x), self.width));
        let (y0, y1) = (first(a.y.min(b.y).min(c.y)), end(a.y.max(b.y).max(c.y), self.height));
        for y in y0..y1 {
            for x in x0..x1 {
                let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
                let u = ((px - a.x) * (c.y - a.y) - (py - a.y) * (c.x - a.x)) / twice;
                let v = ((b.x - a.x) * (py - a.y) - (b.y - a.y) * (px - a.x)) / twice;
                if u < 0.0 || v < 0.0 || u + v > 1.0 {
                    continue;
                }
                let near = a.near + u * (b.near - a.near) + v * (c.near - a.near);
                let at = y * self.width + x;
                if near > self.near[at] {
                    self.near[at] = near;
                    self.seen[at] = (body, triangle, [u, v]);
                }
            }
        }
    }

    /// What the pixel `at` sees, of the bodies that were drawn.
    pub(super) fn surface(&self, at: usize, bodies: &[(&CoarseMesh, DAffine3)]) -> Option<SeenSurface> {
        if self.near[at] <= 0.0 {
            return None;
        }
        let (body, triangle, [u, v]) = self.seen[at];
        let (mesh, pose) = bodies[usize::from(body)];
        let [a, b, c] = mesh.triangles[triangle as usize].map(|v| v as usize);
        let blend = |of: &[Vec3]| of[a] * (1.0 - u - v) + of[b] * u + of[c] * v;
        let position = pose.transform_point3(blend(&mesh.positions).as_dvec3()).as_vec3();
        let normal = pose.transform_vector3(blend(&mesh.normals).as_dvec3()).as_vec3().normalize_or_zero();
        let [p, q, r] = mesh.uvs[triangle as usize];
        let uv = (p * (1.0 - u - v) + q * u + r * v).to_array();
        Some(SeenSurface { body: usize::from(body), position, normal, uv })
    }

    /// One over the distance of the nearest surface at a pixel position; 0 where nothing is.
    pub(super) fn near_at(&self, x: f32, y: f32) -> f32 {
        let inside = x >= 0.0 && y >= 0.0 && (x as usize) < self.width && (y as usize) < self.height;
        if inside {
            self.near[y as usize * self.width + x as usize]
        } else {
            0.0
        }
    }
}

/// The largest raster of the same shape with at most 320 x 240 pixels.
pub(super) fn small(raster: Raster) -> Raster {
    let (w, h) = (raster.width(), raster.height());
    let part = (320.0 / f64::from(w)).min(240.0 / f64::from(h)).min(1.0);
    let side = |n: u32| ((f64::from(n) * part).round() as u32).max(1);
    Raster::new(side(w), side(h)).unwrap_or(raster)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec2;

    fn quad(z: f32, half: f32) -> CoarseMesh {
        let at = |x: f32, y: f32| Vec3::new(x * half, y * half, z);
        CoarseMesh {
            positions: vec![at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)],
            normals: vec![Vec3::Z; 4],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            uvs: vec![[Vec2::ZERO, Vec2::X, Vec2::ONE], [Vec2::ZERO, Vec2::ONE, Vec2::Y]],
            ..CoarseMesh::default()
        }
    }

    fn camera() -> ProjectorCamera {
        let raster = Raster::new(100, 80).unwrap();
        ProjectorCamera::look_at(raster, DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO, DVec3::Y, 1.0).unwrap()
    }

    #[test]
    fn the_nearest_surface_is_seen_where_the_ray_meets_it() {
        let (far, near) = (quad(0.0, 0.6), quad(0.5, 0.2));
        let bodies = [(&far, DAffine3::IDENTITY), (&near, DAffine3::from_translation(DVec3::X * 0.1))];
        let camera = camera();
        let mut depths = DepthBuffer::default();
        depths.draw(&camera, &bodies);
        let mut counts = [0; 3];
        for at in 0..8000 {
            let ray = camera.ray(glam::DVec2::new(f64::from(at % 100) + 0.5, f64::from(at / 100) + 0.5));
            // Where the ray meets the planes of the two squares.
            let hit = |z: f64| ray.origin + ray.direction * ((z - ray.origin.z) / ray.direction.z);
            let inside = |p: DVec3, x: f64, half: f64| (p.x - x).abs().max(p.y.abs()) - half;
            let (on_near, on_far) = (inside(hit(0.5), 0.1, 0.2), inside(hit(0.0), 0.0, 0.6));
            let found = depths.surface(at as usize, &bodies);
            // At an edge either may be found.
            if on_near.abs() < 1e-3 || on_far.abs() < 1e-3 {
                continue;
            }
            let expected = if on_near < 0.0 { Some(1) } else { (on_far < 0.0).then_some(0) };
            assert_eq!(found.map(|s| s.body), expected, "{at}");
            counts[expected.map_or(2, |b| b)] += 1;
            if let Some(s) = found {
                let there = hit(if s.body == 1 { 0.5 } else { 0.0 });
                assert!((s.position.as_dvec3() - there).length() < 0.02, "{} {there}", s.position);
                assert!((s.normal - Vec3::Z).length() < 1e-5);
                let (x, half) = if s.body == 1 { (0.1, 0.2) } else { (0.0, 0.6) };
                let uv = [(there.x - x) / half, there.y / half].map(|t| 0.5 + 0.5 * t as f32);
                assert!((0..2).all(|k| (s.uv[k] - uv[k]).abs() < 0.05), "{:?} {uv:?}", s.uv);
            }
        }
        assert!(counts.iter().all(|n| *n > 200), "{counts:?}");
    }

    #[test]
    fn what_is_behind_the_camera_or_beyond_all_bounds_is_not_drawn() {
        let (behind, huge) = (quad(3.0, 1.0), quad(0.0, 1e30));
        let mut depths = DepthBuffer::default();
        depths.draw(&camera(), &[(&behind, DAffine3::IDENTITY)]);
        assert!((0..8000).all(|at| depths.near[at] == 0.0));
        depths.draw(&camera(), &[(&huge, DAffine3::IDENTITY)]);
    }

    #[test]
    fn pictures_are_small_and_keep_their_shape() {
        let of = |w, h| {
            let small = small(Raster::new(w, h).unwrap());
            (small.width(), small.height())
        };
        assert_eq!(of(1024, 768), (320, 240));
        assert_eq!(of(1920, 1080), (320, 180));
        assert_eq!(of(64, 48), (64, 48));
        assert_eq!(of(8192, 1), (320, 1));
        assert_eq!(of(2, 8192), (1, 240));
    }
}
