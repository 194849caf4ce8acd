//! The edges by which an eye knows a body: its outline as the projector sees it, and its sharp edges.

use crate::body::TriangleTree;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};
use std::collections::HashMap;

/// Faces that meet at a larger angle than this, degrees, make a sharp edge.
const SHARP_DEG: f64 = 30.0;
/// Pixels from point to point along an edge.
const SPACING_PX: f64 = 3.0;
/// Most points of one edge.
const MOST_OF_EDGE: f64 = 512.0;
/// What lies nearer to an edge than this share of its surface does not hide it.
const CLEAR: f64 = 0.01;

/// Two corners by the bits of their coordinates, the smaller first.
type EdgeKey = [[u64; 3]; 2];
/// The ends of an edge, and the normals of the faces that meet there.
type Faces = ([DVec3; 2], Vec<DVec3>);

struct Edge {
    ends: [DVec3; 2],
    /// Unit normals of the faces that meet here; twice the same at the border of an open mesh.
    normals: [DVec3; 2],
    is_sharp: bool,
}

/// A mesh as edges.
pub struct Outline {
    surface: TriangleTree,
    edges: Vec<Edge>,
    middle: DVec3,
}

impl Outline {
    /// From triangles, counter-clockwise seen from outside, in the mesh's frame, metres. Corners at the same place are
    /// the same corner.
    pub fn new(triangles: &[[DVec3; 3]]) -> Self {
        let mut faces: HashMap<EdgeKey, Faces> = HashMap::new();
        // Adding 0 makes -0 and 0 the same.
        let key = |p: DVec3| p.to_array().map(|v| (v + 0.0).to_bits());
        for [a, b, c] in triangles {
            let Some(normal) = (*b - *a).cross(*c - *a).try_normalize() else { continue };
            for (p, q) in [(a, b), (b, c), (c, a)] {
                let (from, to) = (key(*p), key(*q));
                let ends = if from <= to { [from, to] } else { [to, from] };
                faces.entry(ends).or_insert_with(|| ([*p, *q], Vec::new())).1.push(normal);
            }
        }
        let sharp = SHARP_DEG.to_radians().cos();
        let mut edges: Vec<Edge> = faces
            .into_values()
            .filter_map(|(ends, normals)| {
                let (first, last) = (*normals.first()?, *normals.last()?);
                let is_sharp = normals.len() != 2 || first.dot(last) < sharp;
                Some(Edge { ends, normals: [first, last], is_sharp })
            })
            .collect();
        // A map gives them in any order; points that do not fit must be the same every time.
        let order = |e: &Edge| e.ends.map(|p| p.to_array());
        edges.sort_by(|a, b| order(a).partial_cmp(&order(b)).unwrap_or(std::cmp::Ordering::Equal));
        let low = triangles.iter().flatten().fold(DVec3::INFINITY, |a, p| a.min(*p));
        let high = triangles.iter().flatten().fold(DVec3::NEG_INFINITY, |a, p| a.max(*p));
        let middle = if low.is_finite() && high.is_finite() { 0.5 * (low + high) } else { DVec3::ZERO };
        Self { surface: TriangleTree::new(triangles.iter().copied()), edges, middle }
    }

    /// Middle of the box around the mesh, in its frame.
    pub fn middle(&self) -> DVec3 {
        self.middle
    }

    /// Adds the pixels (column, row) of the edges that the projector can light to `pixels`, until there are `most`.
    pub fn draw(
        &self,
        camera: &ProjectorCamera,
        world_from_mesh: &DAffine3,
        most: usize,
        pixels: &mut Vec<[u32; 2]>,
    ) {
        let lens = world_from_mesh.inverse().transform_point3(camera.position());
        let clear_m = CLEAR * self.surface.extent_m();
        for Edge { ends: [a, b], normals, is_sharp } in &self.edges {
            let [one, two] = normals.map(|n| n.dot(lens - *a) > 0.0);
            let is_seen = if *is_sharp { one || two } else { one != two };
            if !is_seen {
                continue;
            }
            let place = |p: DVec3| camera.project(world_from_mesh.transform_point3(p));
            let (Some(from), Some(to)) = (place(*a), place(*b)) else { continue };
            let steps = (from.distance(to) / SPACING_PX).ceil().clamp(1.0, MOST_OF_EDGE) as u32;
            for step in 0..=steps {
                if pixels.len() >= most {
                    return;
                }
                // In space and not on the raster: a lens bends edges.
                let point = a.lerp(*b, f64::from(step) / f64::from(steps));
                let pixel =
                    place(point).filter(|p| p.x >= 0.0 && p.y >= 0.0).map(|p| [p.x as u32, p.y as u32]);
                let inside = |p: &[u32; 2]| p[0] < camera.raster.width() && p[1] < camera.raster.height();
                if let Some(pixel) = pixel.filter(inside) {
                    if !self.surface.hides(lens, point, clear_m) {
                        pixels.push(pixel);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;
    use glam::DVec2;

    /// A ball of radius 0.1 of flat pieces.
    fn ball() -> Vec<[DVec3; 3]> {
        let (rows, columns) = (40, 80);
        let at = |i: i32, j: i32| {
            let (up, around) = (
                std::f64::consts::PI * f64::from(i) / f64::from(rows),
                std::f64::consts::TAU * f64::from(j % columns) / f64::from(columns),
            );
            0.1 * DVec3::new(up.sin() * around.sin(), up.cos(), up.sin() * around.cos())
        };
        let piece = |(i, j)| {
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            [[a, b, c], [a, c, d]]
        };
        (0..rows).flat_map(|i| (0..columns).map(move |j| (i, j))).flat_map(piece).collect()
    }

    fn camera() -> ProjectorCamera {
        let raster = Raster::new(1024, 768).unwrap();
        ProjectorCamera::look_at(raster, DVec3::Z, DVec3::ZERO, DVec3::Y, 0.6).unwrap()
    }

    #[test]
    fn the_outline_of_a_ball_is_a_circle() {
        let (camera, outline) = (camera(), Outline::new(&ball()));
        let mut pixels = Vec::new();
        outline.draw(&camera, &DAffine3::IDENTITY, 100_000, &mut pixels);
        // Rays that touch a ball of radius r at distance d leave at the angle asin(r / d).
        let radius = camera.fx * 0.1 / (1.0f64 - 0.01).sqrt();
        assert!(pixels.len() > 200, "{}", pixels.len());
        for [x, y] in &pixels {
            let at = DVec2::new(f64::from(*x) + 0.5, f64::from(*y) + 0.5) - DVec2::new(512.0, 384.0);
            assert!((at.length() - radius).abs() < 0.01 * radius + 1.0, "{at} {radius}");
        }
        // A shift of 1 mm to the right moves the middle of the pixels by its projection.
        let middle = |p: &[[u32; 2]]| {
            let sum: DVec2 = p.iter().map(|p| DVec2::new(f64::from(p[0]), f64::from(p[1]))).sum();
            sum / p.len() as f64
        };
        let mut moved = Vec::new();
        let step = DAffine3::from_translation(DVec3::X * 1e-3);
        outline.draw(&camera, &step, 100_000, &mut moved);
        let expected = DVec2::new(camera.fx * 1e-3, 0.0);
        assert!((middle(&moved) - middle(&pixels) - expected).length() < 1.0);
        // No more than may be.
        moved.clear();
        outline.draw(&camera, &step, 17, &mut moved);
        assert_eq!(moved.len(), 17);
    }

    #[test]
    fn hidden_and_outside_edges_are_dark() {
        let camera = camera();
        let square = |half: f64, z: f64| {
            let [a, b] = [DVec3::new(-half, -half, z), DVec3::new(half, -half, z)];
            let [c, d] = [DVec3::new(half, half, z), DVec3::new(-half, half, z)];
            [[a, b, c], [a, c, d]]
        };
        let count = |triangles: &[[DVec3; 3]], place: &DAffine3| {
            let mut pixels = Vec::new();
            Outline::new(triangles).draw(&camera, place, 100_000, &mut pixels);
            pixels.len()
        };
        let (small, large) = (square(0.05, 0.0), square(0.1, 0.2));
        let alone = count(&large, &DAffine3::IDENTITY);
        assert!(alone > 100);
        // The border of the large one, without the diagonal, and nothing of the small one behind it.
        assert_eq!(count(&[small, large].concat(), &DAffine3::IDENTITY), alone);
        assert_eq!(count(&large, &DAffine3::from_rotation_y(std::f64::consts::PI)), 0);
        assert_eq!(count(&large, &DAffine3::from_translation(DVec3::X * 5.0)), 0);
        assert_eq!(count(&[], &DAffine3::IDENTITY), 0);
    }
}
