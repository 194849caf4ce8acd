//! A rig into a file of its room that any viewer of glTF shows: bodies, projector with its cone, observer, and the space in which
//! the bodies move.

use super::furniture::{Ball, Bounds};
use dpm_common::files::write_atomically;
use dpm_rig::rig::{affine, Rig};
use glam::{DAffine3, DQuat, DVec2, DVec3, Vec3};
use serde_json::{json, Value};
use std::io::{self, Write};
use std::path::Path;

/// `componentType` of 32-bit floats and of 32-bit indices.
const FLOATS: u32 = 5126;
const INDICES: u32 = 5125;
/// `mode` of lines and of triangles.
const LINES: u32 = 1;
const TRIANGLES: u32 = 4;
/// Rings and sectors of the observer's head.
const RINGS: usize = 12;

/// Colours: bodies, projector, its cone, observer, the space of the bodies.
const COLOURS: [[f32; 3]; 5] =
    [[0.8, 0.8, 0.8], [0.2, 0.24, 0.34], [1.0, 0.85, 0.3], [0.85, 0.62, 0.48], [0.3, 0.6, 0.9]];
const BODY: usize = 0;
const CASE: usize = 1;
const CONE: usize = 2;
const HEAD: usize = 3;
const SPACE: usize = 4;

/// Writes the room of `rig` at time 0 to `path` as binary glTF 2.0. `length_ns`: the bodies' space is that of so long a run.
///
/// # Errors
/// The file cannot be written.
pub fn export(rig: &Rig, length_ns: i64, path: &Path) -> io::Result<()> {
    let bytes = room(rig, length_ns);
    write_atomically(path, |out| out.write_all(&bytes))
}

/// The bytes of the file.
fn room(rig: &Rig, length_ns: i64) -> Vec<u8> {
    let mut file = Glb::default();
    let rest = || rig.bodies.iter().map(|body| affine(&body.rest)).collect();
    let tracked: Vec<DAffine3> = rig.true_poses(0).unwrap_or_else(rest);
    let mut poses = Vec::new();
    rig.scene_poses(&tracked, 0, &mut poses);
    for (body, pose) in rig.scene.bodies.iter().zip(&poses) {
        let indices: Vec<u32> = body.mesh.triangles.iter().flatten().copied().collect();
        if !indices.is_empty() {
            file.node(
                &body.name,
                *pose,
                TRIANGLES,
                BODY,
                &body.mesh.positions,
                Some(&body.mesh.normals),
                &indices,
            );
        }
    }
    let bounds = Bounds::of_run(rig, length_ns);
    let (lens, ball) = (rig.camera.position(), bounds.ball());
    let reach = (lens - ball.centre).length().max(ball.radius);
    file.cuboid("projector", rig.camera.world_from_projector, DVec3::new(0.055, 0.035, 0.075) * reach);
    let (points, lines) = cone(rig, reach + 1.2 * ball.radius);
    file.node("projector's cone", DAffine3::IDENTITY, LINES, CONE, &points, None, &lines);
    let (eye, gaze) = rig.observer.eye_and_gaze(&tracked);
    file.head(Ball { centre: eye, radius: 0.045 * reach });
    let sight = [eye, gaze].map(|p| p.as_vec3());
    file.node("observer's gaze", DAffine3::IDENTITY, LINES, HEAD, &sight, None, &[0, 1]);
    let corners = bounds.corners().map(|p| p.as_vec3());
    // Corners whose numbers differ in one bit are joined.
    let edges: Vec<u32> =
        (0..8u32).flat_map(|i| [1, 2, 4].map(|bit| [i, i | bit])).filter(|[a, b]| a != b).flatten().collect();
    file.node("space of the bodies", DAffine3::IDENTITY, LINES, SPACE, &corners, None, &edges);
    file.bytes()
}

/// Edges of the projector's cone, `length` metres from the lens: lens and corners, and the lines between them.
fn cone(rig: &Rig, length: f64) -> (Vec<Vec3>, Vec<u32>) {
    let (width, height) = (f64::from(rig.camera.raster.width()), f64::from(rig.camera.raster.height()));
    let corner = |x: f64, y: f64| {
        let ray = rig.camera.ray(DVec2::new(x, y));
        (ray.origin + ray.direction * length).as_vec3()
    };
    let corners = [corner(0.0, 0.0), corner(width, 0.0), corner(width, height), corner(0.0, height)];
    let points = [vec![rig.camera.position().as_vec3()], corners.to_vec()].concat();
    (points, vec![0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1])
}

/// A file of glTF 2.0 as it grows.
#[derive(Default)]
struct Glb {
    data: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
}

impl Glb {
    #[allow(clippy::too_many_arguments)] // The parts of a primitive, as glTF lists them.
    fn node(
        &mut self,
        name: &str,
        world_from_mesh: DAffine3,
        mode: u32,
        material: usize,
        positions: &[Vec3],
        normals: Option<&[Vec3]>,
        indices: &[u32],
    ) {
        let (lower, upper) =
            positions.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, u), p| (l.min(*p), u.max(*p)));
        let floats = |list: &[Vec3]| {
            list.iter().flat_map(|v| v.to_array()).flat_map(f32::to_le_bytes).collect::<Vec<u8>>()
        };
        let position = self.accessor(&floats(positions), FLOATS, "VEC3", positions.len());
        self.accessors[position]["min"] = json!(lower.to_array());
        self.accessors[position]["max"] = json!(upper.to_array());
        let mut attributes = json!({ "POSITION": position });
        if let Some(normals) = normals {
            attributes["NORMAL"] = json!(self.accessor(&floats(normals), FLOATS, "VEC3", normals.len()));
        }
        let bytes: Vec<u8> = indices.iter().flat_map(|i| i.to_le_bytes()).collect();
        let indices = self.accessor(&bytes, INDICES, "SCALAR", indices.len());
        self.meshes.push(json!({
            "name": name,
            "primitives": [{ "attributes": attributes, "indices": indices, "mode": mode, "material": material }],
        }));
        let matrix = glam::DMat4::from(world_from_mesh).to_cols_array();
        self.nodes.push(json!({ "name": name, "mesh": self.meshes.len() - 1, "matrix": matrix }));
    }

    fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        self.views.push(json!({ "buffer": 0, "byteOffset": self.data.len(), "byteLength": bytes.len() }));
        self.data.extend_from_slice(bytes);
        self.accessors.push(
            json!({ "bufferView": self.views.len() - 1, "componentType": component, "count": count, "type": kind }),
        );
        self.accessors.len() - 1
    }

    /// A box with half sides `half` whose front is at the origin of `pose`, against its third axis.
    fn cuboid(&mut self, name: &str, pose: DAffine3, half: DVec3) {
        let corners = Bounds::of_ball(Ball { centre: DVec3::ZERO, radius: 1.0 }).corners();
        let positions = corners.map(|corner| (corner * half + DVec3::Z * half.z).as_vec3());
        let faces = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let indices: Vec<u32> = faces.iter().flat_map(|[a, b, c, d]| [*a, *b, *c, *a, *c, *d]).collect();
        self.node(name, pose, TRIANGLES, CASE, &positions, None, &indices);
    }

    fn head(&mut self, ball: Ball) {
        let mut points = Vec::new();
        for ring in 0..=RINGS {
            for sector in 0..=2 * RINGS {
                let turn = |part: usize| std::f64::consts::PI * part as f64 / RINGS as f64;
                let up = DQuat::from_rotation_z(turn(ring)) * DVec3::Y;
                points.push((DQuat::from_rotation_y(turn(sector)) * up).as_vec3());
            }
        }
        let row = 2 * RINGS as u32 + 1;
        let squares = (0..RINGS as u32).flat_map(|ring| (0..row - 1).map(move |sector| ring * row + sector));
        // The squares at the poles are triangles; those without an area are left out.
        let corners = |at: u32| [[at, at + row, at + row + 1], [at, at + row + 1, at + 1]];
        let has_area = |[a, b, c]: &[u32; 3]| {
            let [a, b, c] = [a, b, c].map(|i: &u32| points[*i as usize]);
            (b - a).cross(c - a).length() > 1e-6
        };
        let indices: Vec<u32> = squares.flat_map(corners).filter(has_area).flatten().collect();
        let pose = DAffine3::from_scale_rotation_translation(
            DVec3::splat(ball.radius),
            DQuat::IDENTITY,
            ball.centre,
        );
        self.node("observer", pose, TRIANGLES, HEAD, &points, Some(&points), &indices);
    }

    fn bytes(self) -> Vec<u8> {
        let materials = COLOURS.map(|[r, g, b]| {
            json!({
                "pbrMetallicRoughness": { "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8 },
                "doubleSided": true,
            })
        });
        let document = json!({
            "asset": { "version": "2.0", "generator": "dpm" },
            "scene": 0,
            "scenes": [{ "nodes": (0..self.nodes.len()).collect::<Vec<_>>() }],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.data.len() }],
        });
        let mut text = document.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut data = self.data;
        data.resize(data.len().next_multiple_of(4), 0);
        let length = |list: &[u8]| (list.len() as u32).to_le_bytes();
        let all = (12 + 8 + text.len() + 8 + data.len()) as u32;
        [
            &b"glTF"[..],
            &2u32.to_le_bytes(),
            &all.to_le_bytes(),
            &length(&text),
            b"JSON",
            &text,
            &length(&data),
            b"BIN\0",
            &data,
        ]
        .concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;
    use dpm_rig::config::{Overrides, RigConfig};
    use dpm_scene::{load_bytes, LoadOptions};

    #[test]
    fn the_room_is_read_back_with_everything_in_its_place() {
        let rig = Rig::build(&RigConfig::demo(&Overrides::default()).unwrap(), Raster::new(64, 48)).unwrap();
        let bytes = room(&rig, 250_000_000);
        let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(&bytes).unwrap();
        let names: Vec<&str> = document.nodes().filter_map(|node| node.name()).collect();
        for name in ["bunny", "venus", "projector", "projector's cone", "observer", "space of the bodies"] {
            assert!(names.contains(&name), "{name} is not among {names:?}");
        }
        let place = |name: &str| {
            let node = document.nodes().find(|node| node.name() == Some(name)).unwrap();
            let [x, y, z] = node.transform().decomposed().0;
            DVec3::new(x.into(), y.into(), z.into())
        };
        assert!((place("projector") - rig.camera.position()).length() < 1e-6);
        let (eye, _) = rig.observer.eye_and_gaze(&rig.true_poses(0).unwrap());
        assert!((place("observer") - eye).length() < 1e-6);
        // As many triangles as the bodies have.
        let bunny = document.meshes().find(|mesh| mesh.name() == Some("bunny")).unwrap();
        let reader = bunny.primitives().next().unwrap();
        let count = reader.reader(|_| blob.as_deref()).read_indices().unwrap().into_u32().count();
        let body = rig.scene.bodies.iter().find(|body| body.name == "bunny").unwrap();
        assert_eq!(count, 3 * body.mesh.triangles.len());
        // And our own reader takes it.
        let options = LoadOptions::default();
        assert!(load_bytes(&bytes, &options).is_ok());
    }
}
