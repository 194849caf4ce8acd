//! Meshes that an animation deforms: by a skin, by morph targets, or by sizes that change [glTF 2.0, sections 3.7.2.2,
//! 3.7.3 and 3.11].
//!
//! A vertex is first moved by the morph targets, and then mapped by the mean of its joints' maps. A mesh without a skin hangs
//! on one joint: the node that shows it. Joints lie in a chain of nodes that begins in the space of the mesh's body.

use std::ops::Range;

use glam::{Affine3A, DAffine3, DQuat, DVec3, Mat3A, Vec3, Vec3A, Vec4};

use crate::mesh::MAX_COORDINATE_M;
use crate::part_motion::ValueTrack;
use crate::TriangleMesh;

/// Instants at which its bounds are looked for: so many vertices together, and never fewer or more than these.
const LOOKED_AT: usize = 4_000_000;
const FEWEST_LOOKS: usize = 32;
const MOST_LOOKS: usize = 1024;

/// A mesh that deforms over and over.
#[derive(Clone, Debug, Default)]
pub struct DeformingMesh {
    skeleton: Skeleton,
    targets: Vec<MorphTarget>,
    /// One for each vertex of the mesh.
    vertices: Vec<BindVertex>,
    /// Joints and weights of all vertices, which have the sum 1 for each.
    influences: Vec<(u16, f32)>,
    /// Vertices of which each three in a row are a face with its own normal: the file has no normals.
    flat: Vec<Range<usize>>,
    /// Its faces are turned inside out by the map of most of its vertices.
    is_mirrored: bool,
    /// Seconds of the file's time in a round.
    length_s: f64,
    /// Nanoseconds that a round lasts, above 0.
    period_ns: i64,
    /// Corners of the box around all its shapes.
    bounds: [Vec3; 2],
}

/// A node on the way from the body to a joint.
#[derive(Clone, Debug)]
pub(crate) struct SkeletonNode {
    /// The one above it; `None`: the body.
    pub above: Option<usize>,
    /// Where it lies there.
    pub place: NodePlace,
}

/// Where a node lies in the one above it.
#[derive(Clone, Debug)]
pub(crate) enum NodePlace {
    /// It does not move.
    Fixed(DAffine3),
    /// As key frames say.
    Moving {
        /// Metres, or units of the node above.
        translation: ValueTrack<DVec3>,
        /// Unit quaternions.
        rotation: ValueTrack<DQuat>,
        /// Along the node's axes.
        scale: ValueTrack<DVec3>,
    },
}

impl NodePlace {
    fn at(&self, t: f64) -> DAffine3 {
        match self {
            Self::Fixed(map) => *map,
            Self::Moving { translation, rotation, scale } => {
                DAffine3::from_scale_rotation_translation(scale.at(t), rotation.at(t), translation.at(t))
            }
        }
    }
}

/// What is added to some vertices, times a weight.
#[derive(Clone, Debug)]
pub(crate) struct MorphTarget {
    /// How much of it counts.
    pub weight: ValueTrack<f64>,
    /// The vertices that it moves: what it adds to position, normal and tangent.
    pub moves: Vec<(u32, [Vec3; 3])>,
}

/// A vertex as the file has it, before anything moves it.
#[derive(Clone, Copy, Debug)]
struct BindVertex {
    position: Vec3,
    normal: Vec3,
    tangent: Vec4,
    /// First and last + 1 of its influences.
    influences: [u32; 2],
}

/// What moves the vertices of a mesh.
#[derive(Clone, Debug, Default)]
pub(crate) struct Skeleton {
    /// The nodes that joints hang on, each after the one above it.
    pub nodes: Vec<SkeletonNode>,
    /// For each joint its node, and joint-from-mesh.
    pub joints: Vec<(usize, DAffine3)>,
}

/// A deforming mesh at an instant: vertices in its body's space. It is kept and filled anew, without allocating.
#[derive(Clone, Debug, Default)]
pub struct Deformed {
    /// Positions, metres, finite and at most [`MAX_COORDINATE_M`].
    pub positions: Vec<Vec3>,
    /// Unit normals.
    pub normals: Vec<Vec3>,
    /// Unit tangents across the normals, w = +1 or -1.
    pub tangents: Vec<Vec4>,
    /// Body-from-node, and body-from-mesh of each joint.
    places: Vec<DAffine3>,
    maps: Vec<Affine3A>,
}

impl DeformingMesh {
    /// A mesh without vertices, which `skeleton` moves. A round of the animation has `length_s` seconds of the file's time and
    /// lasts `period_ns`.
    pub(crate) fn new(skeleton: Skeleton, length_s: f64, period_ns: i64) -> Self {
        Self { skeleton, length_s, period_ns: period_ns.max(1), ..Self::default() }
    }

    /// Adds the vertices of `mesh`, as the file has them. `influences_of` gives the joints and weights of a vertex of the file;
    /// weights that are not positive count for nothing, and a vertex without any hangs on the first joint. `is_flat`: each three
    /// vertices in a row are a face with its own normal.
    pub(crate) fn bind<I>(&mut self, mesh: &TriangleMesh, is_flat: bool, influences_of: impl Fn(u32) -> I)
    where
        I: Iterator<Item = (usize, f64)>,
    {
        let first = self.vertices.len();
        for (i, source) in mesh.sources.iter().enumerate() {
            let begin = self.influences.len();
            let joints = self.skeleton.joints.len();
            let usable =
                |(joint, weight): &(usize, f64)| *joint < joints && *weight > 0.0 && weight.is_finite();
            let sum: f64 = influences_of(*source).filter(usable).map(|(_, weight)| weight).sum();
            let shares =
                influences_of(*source).filter(usable).map(|(j, weight)| (j as u16, (weight / sum) as f32));
            self.influences.extend(shares);
            if self.influences.len() == begin {
                self.influences.push((0, 1.0));
            }
            self.vertices.push(BindVertex {
                position: mesh.positions[i],
                normal: mesh.normals[i],
                tangent: mesh.tangents[i],
                influences: [begin as u32, self.influences.len() as u32],
            });
        }
        if is_flat {
            self.flat.push(first..self.vertices.len());
        }
    }

    /// Adds a morph target that moves vertices which were bound.
    pub(crate) fn add_target(&mut self, target: MorphTarget) {
        self.targets.push(target);
    }

    /// Vertices so far.
    pub(crate) fn len(&self) -> usize {
        self.vertices.len()
    }

    /// The mesh is complete: `mesh`, which has the bound vertices, is given its shape at time 0, with its faces outside.
    pub(crate) fn finish(&mut self, mesh: &mut TriangleMesh) {
        let mut now = Deformed::default();
        self.place(0, &mut now);
        let mirrored = |v: &&BindVertex| self.map_of(v, &now.maps).matrix3.determinant() < 0.0;
        self.is_mirrored = 2 * self.vertices.iter().filter(mirrored).count() > self.vertices.len();
        if self.is_mirrored {
            mesh.triangles.iter_mut().for_each(|[_, b, c]| std::mem::swap(b, c));
        }
        self.at(0, &mut now);
        (mesh.positions, mesh.normals, mesh.tangents) =
            (now.positions.clone(), now.normals.clone(), now.tangents.clone());
        let looks = (LOOKED_AT / self.vertices.len().max(1)).clamp(FEWEST_LOOKS, MOST_LOOKS) as i64;
        self.bounds = [Vec3::INFINITY, Vec3::NEG_INFINITY];
        for look in 0..looks {
            self.at(self.period_ns / looks * look, &mut now);
            let [lower, upper] = &mut self.bounds;
            now.positions.iter().for_each(|p| (*lower, *upper) = (lower.min(*p), upper.max(*p)));
        }
    }

    /// Corners of the box around the shapes that it has at many instants of a round, in its body's space. In between it may
    /// reach a little farther.
    pub fn bounds(&self) -> [Vec3; 2] {
        self.bounds
    }

    /// The mesh at `t_ns` nanoseconds, any value: it repeats after every round.
    pub fn at(&self, t_ns: i64, now: &mut Deformed) {
        let t = self.place(t_ns, now);
        self.morph(t, now);
        for (i, vertex) in self.vertices.iter().enumerate() {
            let map = self.map_of(vertex, &now.maps);
            let side = if map.matrix3.determinant() < 0.0 { -1.0 } else { 1.0 };
            now.positions[i] = within(map.transform_point3(now.positions[i]));
            let normal = side * (cofactor(map.matrix3) * Vec3A::from(now.normals[i]));
            now.normals[i] = unit(normal.into(), vertex.normal);
            let along = map.matrix3 * Vec3A::from(now.tangents[i].truncate());
            now.tangents[i] = across(along.into(), now.normals[i]).extend(side * vertex.tangent.w);
        }
        self.flatten_faces(now);
    }

    /// Where nodes and joints are; returns the seconds of the file's time.
    fn place(&self, t_ns: i64, now: &mut Deformed) -> f64 {
        let t = t_ns.rem_euclid(self.period_ns) as f64 / self.period_ns as f64 * self.length_s;
        now.places.clear();
        for node in &self.skeleton.nodes {
            let above = node.above.map_or(DAffine3::IDENTITY, |i| now.places[i]);
            now.places.push(above * node.place.at(t));
        }
        now.maps.clear();
        now.maps.extend(self.skeleton.joints.iter().map(|(node, bind)| {
            let map = now.places[*node] * *bind;
            Affine3A { matrix3: map.matrix3.as_mat3().into(), translation: map.translation.as_vec3().into() }
        }));
        t
    }

    /// The vertices as the file has them, moved by the morph targets.
    fn morph(&self, t: f64, now: &mut Deformed) {
        now.positions.clear();
        now.normals.clear();
        now.tangents.clear();
        now.positions.extend(self.vertices.iter().map(|v| v.position));
        now.normals.extend(self.vertices.iter().map(|v| v.normal));
        now.tangents.extend(self.vertices.iter().map(|v| v.tangent));
        for target in &self.targets {
            let weight = target.weight.at(t) as f32;
            if weight == 0.0 {
                continue;
            }
            for &(vertex, [position, normal, tangent]) in &target.moves {
                let i = vertex as usize;
                now.positions[i] += weight * position;
                now.normals[i] += weight * normal;
                now.tangents[i] += (weight * tangent).extend(0.0);
            }
        }
    }

    /// The mean of the maps of a vertex's joints.
    fn map_of(&self, vertex: &BindVertex, maps: &[Affine3A]) -> Affine3A {
        let [begin, end] = vertex.influences.map(|i| i as usize);
        match &self.influences[begin..end] {
            [(joint, _)] => maps[usize::from(*joint)],
            several => several.iter().fold(
                Affine3A { matrix3: Mat3A::ZERO, translation: Vec3A::ZERO },
                |mean, (joint, weight)| {
                    let map = &maps[usize::from(*joint)];
                    Affine3A {
                        matrix3: mean.matrix3 + map.matrix3 * *weight,
                        translation: mean.translation + map.translation * *weight,
                    }
                },
            ),
        }
    }

    /// Faces without normals in the file have those of their corners.
    fn flatten_faces(&self, now: &mut Deformed) {
        for first in self.flat.iter().flat_map(|range| range.clone().step_by(3)) {
            let [a, b, c] = [0, 1, 2].map(|k| now.positions[first + k]);
            let outside = if self.is_mirrored { (c - a).cross(b - a) } else { (b - a).cross(c - a) };
            let normal = unit(outside, now.normals[first]);
            for i in first..first + 3 {
                now.normals[i] = normal;
                now.tangents[i] = across(now.tangents[i].truncate(), normal).extend(now.tangents[i].w);
            }
        }
    }
}

/// A position that a renderer can use, whatever the file's numbers become.
fn within(p: Vec3) -> Vec3 {
    if p.is_finite() {
        p.clamp(Vec3::splat(-MAX_COORDINATE_M), Vec3::splat(MAX_COORDINATE_M))
    } else {
        Vec3::ZERO
    }
}

/// The unit vector of `v`, and of `other` where it has none.
fn unit(v: Vec3, other: Vec3) -> Vec3 {
    direction(v).or_else(|| other.try_normalize()).unwrap_or(Vec3::Y)
}

/// The unit vector along `v` that is across the unit vector `normal`.
fn across(v: Vec3, normal: Vec3) -> Vec3 {
    direction(v - normal * normal.dot(v)).unwrap_or_else(|| normal.any_orthonormal_vector())
}

/// The unit vector of `v`, however short or long it is: the square of a tiny one has few bits left.
fn direction(v: Vec3) -> Option<Vec3> {
    (v * v.abs().max_element().recip()).try_normalize()
}

/// It maps area vectors, as [`crate::mesh::cofactor`] does.
fn cofactor(m: Mat3A) -> Mat3A {
    Mat3A::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found by fuzzing: the square of a tangent of 1e-20 has so few bits that its root is off by a hundredth.
    #[test]
    fn directions_of_tiny_and_huge_vectors_have_the_length_one() {
        let v = Vec3::new(0.3, -0.7, 0.2);
        for scale in [1e-37, 1e-30, 3e-23, 1e-20, 1.0, 1e19, 1e38] {
            let found = direction(v * scale).unwrap();
            assert!(found.distance(v.normalize()) < 1e-6, "{scale:e}: {found}");
            let tangent = across(v * scale, Vec3::Z);
            assert!((tangent.length() - 1.0).abs() < 1e-6 && tangent.z == 0.0, "{scale:e}: {tangent}");
        }
        for v in [Vec3::ZERO, Vec3::NAN, Vec3::INFINITY, Vec3::splat(1e-45)] {
            assert_eq!(unit(v, Vec3::X), Vec3::X, "{v}");
            assert!((across(v, Vec3::Z).length() - 1.0).abs() < 1e-6);
        }
    }
}
