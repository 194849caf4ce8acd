//! A scene in which a mesh deforms: a flag that waves on a tracked box.

use crate::rigs::demo_rig;
use dpm_rig::rig::Rig;
use serde_json::json;
use std::path::PathBuf;
use std::sync::Arc;

/// Rows of the flag.
const ROWS: usize = 12;
/// Seconds of a round.
const ROUND_S: f32 = 0.2;

/// A file with a box, `base`, and a flag above it on two joints, of which the upper turns to one side and back. The files are
/// removed afterwards.
pub struct Flag(PathBuf);

impl Flag {
    /// Writes the files; `name` is that of the test.
    ///
    /// # Panics
    /// They cannot be written.
    pub fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("dpm-deforming-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let flag = Self(folder);
        let corners: Vec<f32> = (0..8)
            .flat_map(|i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|high| if high == 1 { 0.05 } else { -0.05 }))
            .collect();
        let faces: [[u16; 4]; 6] =
            [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let halves = |[a, b, c, d]: &[u16; 4]| [*a, *b, *c, *a, *c, *d];
        let row = |i: usize| i as f32 / ROWS as f32;
        let points: Vec<f32> = (0..=ROWS)
            .flat_map(|i| [[-0.08, 0.3 * row(i), 0.0], [0.08, 0.3 * row(i), 0.0]].concat())
            .collect();
        let strip: Vec<[u16; 4]> =
            (0..ROWS as u16).map(|i| [2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2]).collect();
        let shares: Vec<f32> = (0..=ROWS).flat_map(|i| [1.0 - row(i), row(i), 0.0, 0.0].repeat(2)).collect();
        let turn = |angle: f32| [0.0, 0.0, (0.5 * angle).sin(), (0.5 * angle).cos()];
        let turns = [turn(-0.7), turn(0.7), turn(-0.7)].concat();
        let floats = |values: &[f32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let indices = |faces: &[[u16; 4]]| {
            faces.iter().flat_map(halves).flat_map(u16::to_le_bytes).collect::<Vec<u8>>()
        };
        let parts = [
            floats(&corners),
            indices(&faces),
            floats(&points),
            indices(&strip),
            [0u8, 1, 0, 0].repeat(2 * (ROWS + 1)),
            floats(&shares),
            floats(&[0.0, 0.5 * ROUND_S, ROUND_S]),
            floats(&turns),
        ];
        let (mut views, mut bytes) = (vec![], vec![]);
        for part in parts {
            views.push(json!({"buffer": 0, "byteOffset": bytes.len(), "byteLength": part.len()}));
            bytes.extend(part);
        }
        std::fs::write(flag.0.join("flag.bin"), &bytes).unwrap();
        let accessor = |view: usize, component: u32, kind: &str, count: usize| json!({"bufferView": view, "componentType": component, "type": kind, "count": count});
        let file = json!({
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "base", "mesh": 0, "children": [1, 2]}, {"name": "flag", "mesh": 1, "skin": 0},
                {"name": "foot", "translation": [0.0, 0.05, 0.0], "children": [3]}, {"name": "top"}],
            "skins": [{"joints": [2, 3]}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]},
                {"primitives": [{"attributes": {"POSITION": 2, "JOINTS_0": 4, "WEIGHTS_0": 5}, "indices": 3, "material": 1}]}],
            "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0}},
                {"doubleSided": true, "pbrMetallicRoughness": {"metallicFactor": 0.0, "baseColorFactor": [0.8, 0.3, 0.1, 1.0]}}],
            "accessors": [accessor(0, 5126, "VEC3", 8), accessor(1, 5123, "SCALAR", 36),
                accessor(2, 5126, "VEC3", 2 * (ROWS + 1)), accessor(3, 5123, "SCALAR", 6 * ROWS),
                accessor(4, 5121, "VEC4", 2 * (ROWS + 1)), accessor(5, 5126, "VEC4", 2 * (ROWS + 1)),
                accessor(6, 5126, "SCALAR", 3), accessor(7, 5126, "VEC4", 3)],
            "bufferViews": views,
            "buffers": [{"byteLength": bytes.len(), "uri": "flag.bin"}],
            "animations": [{"name": "wave", "channels": [{"sampler": 0, "target": {"node": 3, "path": "rotation"}}],
                "samplers": [{"input": 6, "output": 7}]}]
        });
        std::fs::write(flag.0.join("flag.gltf"), file.to_string()).unwrap();
        flag
    }

    /// The demo's rig with the flag on a tracked body that moves.
    pub fn rig(&self, (width, height): (u32, u32), more: &[&str]) -> Arc<Rig> {
        let file = format!("scene.file=\"{}\"", self.0.join("flag.gltf").display());
        let bodies = "scene.bodies=[{ name = \"base\", motion = { kind = \"translate\" } }]";
        demo_rig(width, height, &[&[&file[..], bodies][..], more].concat())
    }
}

impl Drop for Flag {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
