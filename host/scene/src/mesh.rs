//! Repairs raw vertices and indices to a [`TriangleMesh`] that keeps its guarantees: unit normals, finite tangents, no
//! empty triangle.

use glam::{DAffine3, DMat3, DVec3, Vec2, Vec3, Vec4};

use super::TriangleMesh;

/// Positions farther from the origin than this (metres) count as damage: beyond it f32 steps exceed 6 cm.
pub const MAX_COORDINATE_M: f32 = 1.0e6;

/// A triangle whose doubled area is below this times its longest edge squared has no usable normal.
const MIN_RELATIVE_AREA: f64 = 1.0e-12;

/// Counts of what [`TriangleMesh::drop_unusable`] removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct DropCounts {
    /// Triangles with a corner that is NaN, infinite or beyond [`MAX_COORDINATE_M`].
    pub not_finite: usize,
    /// Triangles without area.
    pub degenerate: usize,
}

impl DropCounts {
    /// Adds the counts of another mesh.
    pub(crate) fn add(&mut self, other: DropCounts) {
        self.not_finite += other.not_finite;
        self.degenerate += other.degenerate;
    }

    /// Says how many triangles are left out, and why.
    pub(crate) fn warn(&self, warnings: &mut Vec<String>) {
        if self.not_finite > 0 {
            warnings.push(format!(
                "{} triangles have corners that are not finite or beyond 1000 km and are left out",
                self.not_finite
            ));
        }
        if self.degenerate > 0 {
            warnings.push(format!("{} triangles without area are left out", self.degenerate));
        }
    }
}

impl TriangleMesh {
    /// Area of one triangle in square metres, computed in f64.
    pub fn triangle_area(&self, triangle: usize) -> f64 {
        0.5 * self.doubled_area_vector(self.triangles[triangle]).length()
    }

    fn doubled_area_vector(&self, [a, b, c]: [u32; 3]) -> DVec3 {
        let [a, b, c] = [a, b, c].map(|i| self.positions[i as usize].as_dvec3());
        (b - a).cross(c - a)
    }

    /// Removes triangles that no ray could meaningfully hit (non-finite corners, no area), then the vertices that are
    /// no longer used.
    pub(crate) fn drop_unusable(&mut self) -> DropCounts {
        let mut dropped = DropCounts::default();
        let mut keep = Vec::with_capacity(self.triangles.len());
        for triangle in &self.triangles {
            let corners = triangle.map(|i| self.positions[i as usize]);
            let usable = corners.iter().all(|p| p.is_finite() && p.abs().max_element() <= MAX_COORDINATE_M);
            if !usable {
                dropped.not_finite += 1;
                keep.push(false);
                continue;
            }
            let [a, b, c] = corners.map(|p| p.as_dvec3());
            let longest =
                (b - a).length_squared().max((c - a).length_squared()).max((c - b).length_squared());
            let doubled = (b - a).cross(c - a).length();
            let has_area = doubled > MIN_RELATIVE_AREA * longest && doubled > f64::from(f32::MIN_POSITIVE);
            if !has_area {
                dropped.degenerate += 1;
            }
            keep.push(has_area);
        }
        if dropped != DropCounts::default() {
            let mut flags = keep.iter();
            self.triangles.retain(|_| *flags.next().unwrap_or(&true));
            let mut flags = keep.iter();
            self.materials.retain(|_| *flags.next().unwrap_or(&true));
        }
        self.drop_unused_vertices();
        dropped
    }

    /// Keeps only vertices that a triangle uses, in their order.
    fn drop_unused_vertices(&mut self) {
        let mut used = vec![false; self.positions.len()];
        for &i in self.triangles.iter().flatten() {
            used[i as usize] = true;
        }
        if used.iter().all(|&u| u) {
            return;
        }
        let mut new_index = vec![0u32; used.len()];
        let mut next = 0u32;
        for (slot, &is_used) in new_index.iter_mut().zip(&used) {
            *slot = next;
            next += u32::from(is_used);
        }
        fn compact<T>(values: &mut Vec<T>, used: &[bool]) {
            let mut flags = used.iter();
            values.retain(|_| *flags.next().unwrap_or(&false));
        }
        compact(&mut self.positions, &used);
        compact(&mut self.normals, &used);
        compact(&mut self.tangents, &used);
        compact(&mut self.uvs, &used);
        compact(&mut self.sources, &used);
        compact(&mut self.later_uvs, &used);
        for i in self.triangles.iter_mut().flatten() {
            *i = new_index[*i as usize];
        }
    }

    /// Gives every triangle its own three vertices with the face normal, as glTF requires for a file without normals.
    pub(crate) fn split_into_flat_faces(&mut self) {
        let corners: Vec<u32> = self.triangles.iter().flatten().copied().collect();
        let normals = self
            .triangles
            .iter()
            .flat_map(|&t| {
                [self.doubled_area_vector(t)
                    .as_vec3()
                    .try_normalize()
                    .unwrap_or(face_normal_of_tiny(self, t)); 3]
            })
            .collect();
        self.positions = corners.iter().map(|&i| self.positions[i as usize]).collect();
        self.uvs = corners.iter().map(|&i| self.uvs[i as usize]).collect();
        if !self.sources.is_empty() {
            self.sources = corners.iter().map(|&i| self.sources[i as usize]).collect();
        }
        if !self.later_uvs.is_empty() {
            self.later_uvs = corners.iter().map(|&i| self.later_uvs[i as usize]).collect();
        }
        self.tangents.clear();
        self.normals = normals;
        self.triangles = (0..corners.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    }

    /// Normalises the normals; one that is zero or not finite becomes the area-weighted mean of the faces around it.
    pub(crate) fn repair_normals(&mut self) {
        let unit =
            |n: Vec3| n.is_finite().then(|| n.as_dvec3().try_normalize()).flatten().map(DVec3::as_vec3);
        let needs_repair = self.normals.iter().any(|&n| unit(n).is_none());
        let mut face_sum = vec![DVec3::ZERO; if needs_repair { self.positions.len() } else { 0 }];
        if needs_repair {
            for &t in &self.triangles {
                let area = self.doubled_area_vector(t);
                for i in t {
                    face_sum[i as usize] += area;
                }
            }
        }
        for (i, n) in self.normals.iter_mut().enumerate() {
            *n = unit(*n).or_else(|| face_sum[i].try_normalize().map(DVec3::as_vec3)).unwrap_or(Vec3::Y);
        }
    }

    /// Computes tangents from the texture coordinates: the tangent follows +u, the bitangent `w * n x t` follows -v (up
    /// in the image), as in glTF's normal maps. Faces around a vertex are weighted by their angle there, as in
    /// \[Mikkelsen08\]; a vertex that joins mirrored and unmirrored faces is split. Where the coordinates are
    /// degenerate, any unit vector perpendicular to the normal is used.
    pub(crate) fn generate_tangents(&mut self) {
        self.split_mirrored_vertices();
        let mut sum = vec![DVec3::ZERO; self.positions.len()];
        let mut sign = vec![1.0f32; self.positions.len()];
        for &t in &self.triangles {
            let Some((tangent, w)) = self.face_tangent(t) else { continue };
            let corners = t.map(|i| self.positions[i as usize].as_dvec3());
            for k in 0..3 {
                let to_next = corners[(k + 1) % 3] - corners[k];
                let to_last = corners[(k + 2) % 3] - corners[k];
                let n = self.normals[t[k] as usize].as_dvec3();
                let across = (tangent - n * n.dot(tangent)).normalize_or_zero();
                sum[t[k] as usize] += across * to_next.angle_between(to_last);
                sign[t[k] as usize] = w;
            }
        }
        self.tangents = (0..self.positions.len())
            .map(|i| {
                let n = self.normals[i].as_dvec3();
                let across = sum[i] - n * n.dot(sum[i]);
                let unit = across
                    .try_normalize()
                    .filter(|t| t.is_finite())
                    .unwrap_or_else(|| n.any_orthonormal_vector());
                unit.as_vec3().extend(sign[i])
            })
            .collect();
    }

    /// Replaces tangents that are not finite, too short or parallel to the normal; makes all of them unit length,
    /// perpendicular to the normal, `w = +-1`.
    pub(crate) fn repair_tangents(&mut self) {
        for (t, n) in self.tangents.iter_mut().zip(&self.normals) {
            let n = n.as_dvec3();
            let raw = t.truncate().as_dvec3();
            let across =
                if raw.is_finite() { (raw - n * n.dot(raw)).normalize_or_zero() } else { DVec3::ZERO };
            let unit = if across == DVec3::ZERO { n.any_orthonormal_vector() } else { across };
            *t = unit.as_vec3().extend(if t.w < 0.0 { -1.0 } else { 1.0 });
        }
    }

    /// Share of the surface, 0 to 1, that has no texture coordinates: all three corners of its triangles have (0, 0), which is what a file without
    /// coordinates is read as. 1 without triangles.
    pub fn share_without_uvs(&self) -> f64 {
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| self.positions[i as usize].as_dvec3());
            (b - a).cross(c - a).length()
        };
        let bare = |t: &&[u32; 3]| t.iter().all(|&i| self.uvs[i as usize] == Vec2::ZERO);
        let all: f64 = self.triangles.iter().map(area).sum();
        if all > 0.0 {
            self.triangles.iter().filter(bare).map(area).sum::<f64>() / all
        } else {
            1.0
        }
    }

    /// Unit direction of +u on a face and the sign of its bitangent; `None` if the coordinates span no area.
    fn face_tangent(&self, t: [u32; 3]) -> Option<(DVec3, f32)> {
        let [p0, p1, p2] = t.map(|i| self.positions[i as usize].as_dvec3());
        let [w0, w1, w2] = t.map(|i| self.uvs[i as usize].as_dvec2());
        let (d1, d2) = (w1 - w0, w2 - w0);
        let det = d1.perp_dot(d2);
        if !det.is_finite() || det == 0.0 {
            return None;
        }
        let along_u = ((p1 - p0) * d2.y - (p2 - p0) * d1.y) * det.signum();
        // v grows downwards in glTF, so an image that is not mirrored has a negative determinant.
        Some((along_u.try_normalize().filter(|t| t.is_finite())?, if det < 0.0 { 1.0 } else { -1.0 }))
    }

    fn split_mirrored_vertices(&mut self) {
        let mut side = vec![0.0f32; self.positions.len()];
        let mut twin = std::collections::HashMap::new();
        for k in 0..self.triangles.len() {
            let Some((_, w)) = self.face_tangent(self.triangles[k]) else { continue };
            for corner in 0..3 {
                let i = self.triangles[k][corner];
                if side[i as usize] == 0.0 {
                    side[i as usize] = w;
                } else if side[i as usize] != w {
                    let next = self.positions.len() as u32;
                    let j = *twin.entry(i).or_insert(next);
                    if j == next {
                        self.positions.push(self.positions[i as usize]);
                        self.normals.push(self.normals[i as usize]);
                        self.uvs.push(self.uvs[i as usize]);
                        self.sources.extend(self.sources.get(i as usize).copied());
                        self.later_uvs.extend(self.later_uvs.get(i as usize).copied());
                        side.push(w);
                    }
                    self.triangles[k][corner] = j;
                }
            }
        }
    }

    /// Appends `other` transformed by `transform` (any invertible affine map; a mirroring one flips the winding so that
    /// outside stays outside).
    pub(crate) fn append_transformed(&mut self, other: &TriangleMesh, transform: &DAffine3) {
        let base = self.positions.len() as u32;
        let linear = transform.matrix3;
        let mirrored = linear.determinant() < 0.0;
        let normal_map = cofactor(linear) * if mirrored { -1.0 } else { 1.0 };
        let (vertices, triangles) = (other.positions.len(), other.triangles.len());
        make_room(&mut self.positions, vertices);
        make_room(&mut self.normals, vertices);
        make_room(&mut self.uvs, vertices);
        make_room(&mut self.tangents, vertices);
        make_room(&mut self.triangles, triangles);
        make_room(&mut self.materials, triangles);
        self.positions
            .extend(other.positions.iter().map(|p| transform.transform_point3(p.as_dvec3()).as_vec3()));
        self.normals.extend(
            other
                .normals
                .iter()
                .map(|n| (normal_map * n.as_dvec3()).try_normalize().map_or(Vec3::Y, DVec3::as_vec3)),
        );
        self.uvs.extend_from_slice(&other.uvs);
        self.sources.extend_from_slice(&other.sources);
        let first = self.tangents.len();
        self.tangents.extend(other.tangents.iter().map(|t| -> Vec4 {
            let turned = (linear * t.truncate().as_dvec3()).normalize_or_zero();
            turned.as_vec3().extend(if mirrored { -t.w } else { t.w })
        }));
        // A shear or a non-uniform scale leaves the tangent along the surface but may tilt the interpolated normal
        // against it.
        for (t, n) in self.tangents[first..].iter_mut().zip(&self.normals[first..]) {
            let across = t.truncate() - *n * n.dot(t.truncate());
            *t = across.try_normalize().unwrap_or_else(|| n.any_orthonormal_vector()).extend(t.w);
        }
        self.triangles.extend(other.triangles.iter().map(|&[a, b, c]| {
            let [a, b, c] = [a + base, b + base, c + base];
            if mirrored {
                [a, c, b]
            } else {
                [a, b, c]
            }
        }));
        self.materials.extend_from_slice(&other.materials);
    }
}

/// Room for so many more elements, and for an eighth of those that are there up to half a million: a list that doubles would take
/// more memory at once than the triangles of a short file may ([`super::limits::largest_piece`]).
fn make_room<T>(list: &mut Vec<T>, more: usize) {
    if list.capacity() - list.len() < more {
        list.reserve_exact(more.max((list.len() / 8).min(500_000)));
    }
}

/// Unit normal of a face whose area vector underflows in f32.
fn face_normal_of_tiny(mesh: &TriangleMesh, t: [u32; 3]) -> Vec3 {
    mesh.doubled_area_vector(t).try_normalize().map_or(Vec3::Y, DVec3::as_vec3)
}

/// The cofactor matrix: it transforms area vectors, and so normals, by `m`, and unlike the inverse transpose it exists
/// for every `m`.
pub(crate) fn cofactor(m: DMat3) -> DMat3 {
    DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn quad() -> TriangleMesh {
        // An upright image on the XY plane facing +Z: u to the right, v down.
        TriangleMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
            normals: vec![Vec3::Z; 4],
            uvs: vec![Vec2::new(0.0, 1.0), Vec2::new(1.0, 1.0), Vec2::new(1.0, 0.0), Vec2::new(0.0, 0.0)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            materials: vec![0, 0],
            ..TriangleMesh::default()
        }
    }

    #[test]
    fn tangents_of_an_upright_image_point_right_and_up() {
        let mut mesh = quad();
        mesh.generate_tangents();
        for t in &mesh.tangents {
            assert!((t.truncate() - Vec3::X).length() < 1e-6);
            let bitangent = Vec3::Z.cross(t.truncate()) * t.w;
            assert!((bitangent - Vec3::Y).length() < 1e-6);
        }
    }

    #[test]
    fn a_vertex_between_mirrored_faces_is_split() {
        let mut mesh = quad();
        // The second face mirrors u about the shared edge 0-2.
        mesh.uvs[3] = Vec2::new(1.0, 1.0) - mesh.uvs[3] + Vec2::new(0.5, 0.5);
        mesh.generate_tangents();
        assert_eq!(mesh.positions.len(), 6);
        for (k, &t) in mesh.triangles.iter().enumerate() {
            let signs = t.map(|i| mesh.tangents[i as usize].w);
            assert!(signs.iter().all(|&s| s == signs[0]), "face {k} mixes signs");
        }
        assert_ne!(
            mesh.tangents[mesh.triangles[0][1] as usize].w,
            mesh.tangents[mesh.triangles[1][2] as usize].w
        );
    }

    #[test]
    fn degenerate_coordinates_still_give_unit_tangents_across_the_normal() {
        let mut mesh = quad();
        mesh.uvs = vec![Vec2::splat(0.5); 4];
        mesh.generate_tangents();
        for (t, n) in mesh.tangents.iter().zip(&mesh.normals) {
            assert!((t.truncate().length() - 1.0).abs() < 1e-5 && t.truncate().dot(*n).abs() < 1e-6);
        }
    }

    #[test]
    fn unusable_triangles_and_lonely_vertices_go() {
        let mut mesh = quad();
        mesh.positions.push(Vec3::new(f32::NAN, 0.0, 0.0));
        mesh.positions.push(Vec3::new(0.5, 0.5, 0.0));
        mesh.normals.extend([Vec3::Z; 2]);
        mesh.uvs.extend([Vec2::ZERO; 2]);
        mesh.triangles.extend([[0, 1, 4], [0, 2, 5], [1, 1, 2]]);
        mesh.materials.extend([1, 2, 3]);
        let dropped = mesh.drop_unusable();
        assert_eq!(dropped, DropCounts { not_finite: 1, degenerate: 2 });
        assert_eq!((mesh.triangles.len(), mesh.materials.len(), mesh.positions.len()), (2, 2, 4));
        assert_eq!(mesh.materials, vec![0, 0]);
    }

    #[test]
    fn any_affine_map_keeps_faces_and_normals_on_the_same_side() {
        let rotation = DQuat::from_rotation_y(0.7) * DQuat::from_rotation_x(-0.4);
        for scale in [DVec3::new(1.0, 2.0, 3.0), DVec3::new(-1.0, 0.5, 2.0), DVec3::new(-1.0, -2.0, -0.1)] {
            let map = DAffine3::from_scale_rotation_translation(scale, rotation, DVec3::new(1.0, 2.0, 3.0));
            let mut source = quad();
            source.generate_tangents();
            let mut out = TriangleMesh::default();
            out.append_transformed(&source, &map);
            for &t in &out.triangles {
                let face = out.doubled_area_vector(t).normalize().as_vec3();
                for i in t {
                    assert!(
                        face.dot(out.normals[i as usize]) > 0.9999,
                        "normal and winding disagree for scale {scale}"
                    );
                }
            }
            // The outside of the source is where its normals point; a map must keep a point off the surface on that
            // side.
            let off_surface = map.transform_point3(DVec3::new(0.3, 0.3, 1.0)).as_vec3();
            assert!((off_surface - out.positions[0]).dot(out.normals[0]) > 0.0);
            // The bitangent still follows the image's up direction.
            let up = (map.matrix3 * DVec3::Y).normalize().as_vec3();
            let b = out.normals[0].cross(out.tangents[0].truncate()) * out.tangents[0].w;
            assert!(b.dot(up) > 0.99);
        }
    }

    #[test]
    fn flat_faces_have_the_face_normal() {
        let mut mesh = quad();
        mesh.positions[2].z = 0.5;
        mesh.split_into_flat_faces();
        assert_eq!(mesh.positions.len(), 6);
        for &t in &mesh.triangles {
            let face = mesh.doubled_area_vector(t).normalize().as_vec3();
            assert!(t.iter().all(|&i| (mesh.normals[i as usize] - face).length() < 1e-6));
        }
    }
}
