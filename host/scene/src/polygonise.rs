//! Converts a signed distance field to triangles: naive surface nets \[Gibson98\] with the vertices moved onto the
//! surface.

use glam::{UVec3, Vec3};

/// Vertices, their outward unit normals, and faces counter-clockwise seen from outside.
pub(crate) struct PolygonSurface {
    /// On the surface within a small fraction of a cell.
    pub positions: Vec<Vec3>,
    /// Unit gradients of the field.
    pub normals: Vec<Vec3>,
    /// Indices of corners.
    pub triangles: Vec<[u32; 3]>,
}

/// Polygonises the zero set of `field` (negative inside) in the box from `min` to `max` with cubic cells of edge
/// `cell`.
///
/// The surface must not touch the box. The result is closed: every edge belongs to two triangles, except where the surface
/// passes twice through a cell, where four may meet.
pub(crate) fn surface_nets(field: &dyn Fn(Vec3) -> f32, min: Vec3, max: Vec3, cell: f32) -> PolygonSurface {
    let samples = ((max - min) / cell).ceil().as_uvec3() + UVec3::ONE;
    let [nx, ny, nz] = samples.to_array();
    let value = sample_near_surface(field, min, samples, cell);
    let grid = Grid { min, cell, samples: [nx, ny, nz], value };
    let mut surface = PolygonSurface { positions: vec![], normals: vec![], triangles: vec![] };
    let mut vertex_of_cell = vec![u32::MAX; grid.value.len()];
    for z in 0..nz - 1 {
        for y in 0..ny - 1 {
            for x in 0..nx - 1 {
                let Some((position, normal)) = grid.vertex(field, x, y, z) else { continue };
                vertex_of_cell[grid.at(x, y, z)] = surface.positions.len() as u32;
                surface.positions.push(position);
                surface.normals.push(normal);
            }
        }
    }
    for z in 1..nz - 1 {
        for y in 1..ny - 1 {
            for x in 1..nx - 1 {
                for quad in grid.quads(&vertex_of_cell, x, y, z) {
                    push_quad(&mut surface, quad);
                }
            }
        }
    }
    surface
}

/// Samples of a field, x fastest.
struct Grid {
    min: Vec3,
    cell: f32,
    samples: [u32; 3],
    value: Vec<f32>,
}

impl Grid {
    fn at(&self, x: u32, y: u32, z: u32) -> usize {
        let [nx, ny, _] = self.samples;
        (x + nx * (y + ny * z)) as usize
    }

    /// The point of the surface in a cell, and the direction away from it; `None` where the surface does not pass.
    fn vertex(&self, field: &dyn Fn(Vec3) -> f32, x: u32, y: u32, z: u32) -> Option<(Vec3, Vec3)> {
        let ([nx, ny, _], cell, value) = (self.samples, self.cell, &self.value);
        // Nearly all cells lie on one side, and all eight corners say so at once.
        let row = self.at(x, y, z);
        let corners = [0, 1].map(|dz| [0, 1].map(|dy| &value[row + (nx * (dy + ny * dz)) as usize..][..2]));
        let inside = corners.as_flattened().iter().flat_map(|pair| *pair).filter(|v| **v < 0.0).count();
        if inside == 0 || inside == 8 {
            return None;
        }
        // Central differences along the diagonals of a cube: four evaluations instead of six.
        let gradient = |p: Vec3| {
            let step = 0.15 * cell;
            let corners = [
                Vec3::ONE,
                Vec3::new(1.0, -1.0, -1.0),
                Vec3::new(-1.0, 1.0, -1.0),
                Vec3::new(-1.0, -1.0, 1.0),
            ];
            corners.iter().map(|&k| k * field(p + step * k)).sum::<Vec3>() / (4.0 * step)
        };
        let start = mean_crossing(|dx, dy, dz| value[self.at(x + dx, y + dy, z + dz)])?;
        let corner = self.min + cell * UVec3::new(x, y, z).as_vec3();
        let mut p = corner + cell * start;
        let g = gradient(p);
        for _ in 0..2 {
            p -= (field(p) * g / g.length_squared().max(0.1)).clamp_length_max(0.5 * cell);
        }
        p = p.clamp(corner, corner + cell);
        Some((p, gradient(p).normalize_or(Vec3::Y)))
    }

    /// The quads across those grid edges which leave a sample upwards and which the surface cuts.
    fn quads<'a>(
        &'a self,
        vertex_of_cell: &'a [u32],
        x: u32,
        y: u32,
        z: u32,
    ) -> impl Iterator<Item = [u32; 4]> + 'a {
        let inside = self.value[self.at(x, y, z)] < 0.0;
        (0..3).filter_map(move |axis| {
            // The four cells around the grid edge that leaves this sample along `axis`, counter-clockwise when seen
            // against it.
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut ahead = [x, y, z];
            ahead[axis] += 1;
            if (self.value[self.at(ahead[0], ahead[1], ahead[2])] < 0.0) == inside {
                return None;
            }
            let mut ring = [[x, y, z]; 4];
            for (k, (du, dv)) in [(1, 1), (0, 1), (0, 0), (1, 0)].into_iter().enumerate() {
                ring[k][u] -= du;
                ring[k][v] -= dv;
            }
            let mut quad = ring.map(|[x, y, z]| vertex_of_cell[self.at(x, y, z)]);
            if !inside {
                quad.reverse();
            }
            Some(quad)
        })
    }
}

/// Samples on a grid, x fastest. Blocks of samples that are far from the surface according to the field get one value
/// for all, because only the sign counts there. `field` may be up to twice the true distance.
fn sample_near_surface(field: &dyn Fn(Vec3) -> f32, min: Vec3, samples: UVec3, cell: f32) -> Vec<f32> {
    const BLOCK: u32 = 4;
    let half_diagonal = 0.5 * BLOCK as f32 * cell * 3f32.sqrt();
    let [nx, ny, nz] = samples.to_array();
    let mut value = vec![0.0; (nx * ny * nz) as usize];
    let starts = |n: u32| (0..n).step_by(BLOCK as usize);
    for (bz, by, bx) in
        starts(nz).flat_map(|z| starts(ny).flat_map(move |y| starts(nx).map(move |x| (z, y, x))))
    {
        let centre = min + cell * (UVec3::new(bx, by, bz).as_vec3() + 0.5 * (BLOCK - 1) as f32);
        let at_centre = field(centre);
        let far = at_centre.abs() > 2.0 * half_diagonal;
        for z in bz..(bz + BLOCK).min(nz) {
            for y in by..(by + BLOCK).min(ny) {
                for x in bx..(bx + BLOCK).min(nx) {
                    value[(x + nx * (y + ny * z)) as usize] =
                        if far { at_centre } else { field(min + cell * UVec3::new(x, y, z).as_vec3()) };
                }
            }
        }
    }
    value
}

/// Mean of the crossings of the cell's twelve edges in cell units; `None` if all corners are on one side.
fn mean_crossing(value: impl Fn(u32, u32, u32) -> f32) -> Option<Vec3> {
    let (mut sum, mut count) = (Vec3::ZERO, 0);
    for axis in 0..3usize {
        for (du, dv) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let mut from = [0u32; 3];
            from[(axis + 1) % 3] = du;
            from[(axis + 2) % 3] = dv;
            let mut to = from;
            to[axis] = 1;
            let (a, b) = (value(from[0], from[1], from[2]), value(to[0], to[1], to[2]));
            if (a < 0.0) != (b < 0.0) {
                let from = UVec3::from_array(from).as_vec3();
                sum += from + (UVec3::from_array(to).as_vec3() - from) * (a / (a - b));
                count += 1;
            }
        }
    }
    (count > 0).then(|| sum / count as f32)
}

/// Splits a quad along its shorter diagonal.
fn push_quad(surface: &mut PolygonSurface, [a, b, c, d]: [u32; 4]) {
    let p = |i: u32| surface.positions[i as usize];
    let faces = if p(a).distance_squared(p(c)) <= p(b).distance_squared(p(d)) {
        [[a, b, c], [a, c, d]]
    } else {
        [[a, b, d], [b, c, d]]
    };
    surface.triangles.extend(faces);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sphere_has_its_volume_area_and_normals() {
        let radius = 0.1f32;
        let s = surface_nets(&|p| p.length() - radius, Vec3::splat(-0.12), Vec3::splat(0.12), 0.005);
        let (mut volume, mut area) = (0.0f64, 0.0f64);
        for t in &s.triangles {
            let [a, b, c] = t.map(|i| s.positions[i as usize].as_dvec3());
            volume += a.dot(b.cross(c)) / 6.0;
            area += (b - a).cross(c - a).length() / 2.0;
        }
        let r = f64::from(radius);
        let pi = std::f64::consts::PI;
        assert!((volume / (4.0 / 3.0 * pi * r.powi(3)) - 1.0).abs() < 0.01, "volume {volume}");
        assert!((area / (4.0 * pi * r * r) - 1.0).abs() < 0.01, "area {area}");
        for (p, n) in s.positions.iter().zip(&s.normals) {
            assert!((p.length() - radius).abs() < 1e-5 && p.normalize().dot(*n) > 0.9999);
        }
        // Closed: every directed edge has its opposite, and Euler's formula holds for a sphere.
        let mut edges = std::collections::HashSet::new();
        for &[a, b, c] in &s.triangles {
            for e in [(a, b), (b, c), (c, a)] {
                assert!(edges.insert(e), "edge twice in the same direction");
            }
        }
        assert!(edges.iter().all(|&(a, b)| edges.contains(&(b, a))));
        assert_eq!(s.positions.len() as i64 - edges.len() as i64 / 2 + s.triangles.len() as i64, 2);
    }
}
