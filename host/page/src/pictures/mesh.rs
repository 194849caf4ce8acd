//! A body's mesh with few triangles, for small pictures and for the room.

use dpm_scene::TriangleMesh;
use glam::{DVec3, Vec2, Vec3};
use std::collections::HashMap;

/// Cells along the longest side of a mesh in a picture: about half a pixel where the body fills it.
pub(super) const CELLS: f32 = 96.0;

/// Positions and normals in the body's space, metres, and triangles.
#[derive(Clone, Debug, Default)]
pub(crate) struct CoarseMesh {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates of the corners of each triangle.
    pub uvs: Vec<[Vec2; 3]>,
    /// A sphere around all of it.
    pub centre: DVec3,
    pub radius_m: f64,
}

impl CoarseMesh {
    /// Merges the vertices of `mesh` that share a cell of a grid, of which there are `cells` along its longest side.
    pub(crate) fn of(mesh: &TriangleMesh, cells: f32) -> Self {
        let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for p in &mesh.positions {
            lower = lower.min(*p);
            upper = upper.max(*p);
        }
        if !lower.is_finite() {
            return Self::default();
        }
        let side = ((upper - lower).max_element() / cells).max(f32::MIN_POSITIVE);
        let mut known: HashMap<[i32; 3], u32> = HashMap::new();
        let mut sums: Vec<(Vec3, Vec3, f32)> = Vec::new();
        let cell_of: Vec<u32> = mesh
            .positions
            .iter()
            .zip(&mesh.normals)
            .map(|(p, n)| {
                let at = ((*p - lower) / side).floor();
                let cell = *known.entry([at.x as i32, at.y as i32, at.z as i32]).or_insert_with(|| {
                    sums.push((Vec3::ZERO, Vec3::ZERO, 0.0));
                    sums.len() as u32 - 1
                });
                let sum = &mut sums[cell as usize];
                *sum = (sum.0 + *p, sum.1 + *n, sum.2 + 1.0);
                cell
            })
            .collect();
        let mut triangles: Vec<([u32; 3], [Vec2; 3])> = mesh
            .triangles
            .iter()
            .map(|t| (t.map(|v| cell_of[v as usize]), t.map(|v| mesh.uvs[v as usize])))
            .filter(|([a, b, c], _)| a != b && b != c && c != a)
            .map(|(mut cells, mut uvs)| {
                // The least cell comes first, so that equal triangles are equal.
                let first = (0..3).min_by_key(|&i| cells[i]).unwrap_or(0);
                cells.rotate_left(first);
                uvs.rotate_left(first);
                (cells, uvs)
            })
            .collect();
        triangles.sort_by_key(|(cells, _)| *cells);
        triangles.dedup_by_key(|(cells, _)| *cells);
        let centre = (lower + upper).as_dvec3() * 0.5;
        Self {
            positions: sums.iter().map(|(p, _, n)| *p / *n).collect(),
            normals: sums.iter().map(|(_, n, _)| n.normalize_or(Vec3::Y)).collect(),
            uvs: triangles.iter().map(|(_, uvs)| *uvs).collect(),
            triangles: triangles.into_iter().map(|(cells, _)| cells).collect(),
            centre,
            radius_m: f64::from((upper - lower).length()) * 0.5,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sphere of `rings` rings and twice as many sectors.
    fn sphere(rings: u32) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let sectors = 2 * rings;
        for r in 0..=rings {
            for s in 0..sectors {
                let (theta, phi) = (
                    std::f32::consts::PI * r as f32 / rings as f32,
                    std::f32::consts::TAU * s as f32 / sectors as f32,
                );
                let p = Vec3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin());
                mesh.positions.push(p);
                mesh.normals.push(p);
                mesh.uvs.push(Vec2::new(s as f32 / sectors as f32, r as f32 / rings as f32));
            }
        }
        for r in 0..rings {
            for s in 0..sectors {
                let at = |r: u32, s: u32| r * sectors + s % sectors;
                mesh.triangles.push([at(r, s), at(r, s + 1), at(r + 1, s)]);
                mesh.triangles.push([at(r + 1, s), at(r, s + 1), at(r + 1, s + 1)]);
            }
        }
        mesh
    }

    #[test]
    fn a_fine_mesh_becomes_coarse_and_stays_where_it_was() {
        let fine = sphere(400);
        let coarse = CoarseMesh::of(&fine, CELLS);
        // A surface of six squares of cells holds at most a few vertices a cell.
        assert!(coarse.triangles.len() < 8 * 6 * (CELLS * CELLS) as usize / 4, "{}", coarse.triangles.len());
        assert!(coarse.triangles.len() < fine.triangles.len() / 2);
        assert!(coarse.positions.iter().all(|p| (p.length() - 1.0).abs() < 2.0 / CELLS));
        assert!(coarse.positions.iter().zip(&coarse.normals).all(|(p, n)| p.normalize().dot(*n) > 0.99));
        // Every corner keeps the texture coordinates of a vertex of its cell.
        for (cells, uvs) in coarse.triangles.iter().zip(&coarse.uvs) {
            for (cell, uv) in cells.iter().zip(uvs) {
                let (theta, phi) = (std::f32::consts::PI * uv.y, std::f32::consts::TAU * uv.x);
                let p = Vec3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin());
                assert!((coarse.positions[*cell as usize] - p).length() < 4.0 / CELLS);
            }
        }
        let area = |positions: &[Vec3], t: &[[u32; 3]]| -> f32 {
            let of = |t: &[u32; 3]| {
                let [a, b, c] = t.map(|v| positions[v as usize]);
                (b - a).cross(c - a).length() * 0.5
            };
            t.iter().map(of).sum()
        };
        let (was, is) = (area(&fine.positions, &fine.triangles), area(&coarse.positions, &coarse.triangles));
        assert!((is / was - 1.0).abs() < 0.1, "{is} of {was}");
    }

    #[test]
    fn a_coarse_mesh_is_kept_and_an_empty_one_is_no_fault() {
        let few = sphere(4);
        let mesh = CoarseMesh::of(&few, CELLS);
        assert!((mesh.radius_m - 3f64.sqrt()).abs() < 1e-3 && mesh.centre.length() < 1e-6);
        let empty = CoarseMesh::of(&TriangleMesh::default(), CELLS);
        assert!(empty.triangles.is_empty() && empty.radius_m == 0.0);
    }
}
