//! Files that a test writes and a rig reads, and the demo's rig with a scene of such a file.
#![allow(dead_code)]

pub(crate) use crate::common;

use common::Glb;
use dpm_rig::rig::Rig;
use dpm_tests::rigs::demo_rig;
use serde_json::{json, Value};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A file that is removed afterwards.
pub(crate) struct TempFile(PathBuf);

impl TempFile {
    /// `name` is that of the test, with the file's extension.
    pub(crate) fn new(name: &str, bytes: &[u8]) -> Self {
        let file = std::env::temp_dir().join(format!("dpm-{}-{name}", std::process::id()));
        std::fs::write(&file, bytes).unwrap();
        Self(file)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TempFile {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// The demo's rig with the scene of `file`, whose node `base` is its tracked body. `motion`: how it moves.
pub(crate) fn rig_of(file: &TempFile, (width, height): (u32, u32), motion: &str, more: &[&str]) -> Arc<Rig> {
    let scene = format!("scene.file=\"{}\"", file.path().display());
    let bodies = format!("scene.bodies=[{{ name = \"base\", motion = {{ kind = \"{motion}\" }} }}]");
    demo_rig(width, height, &[&[&scene[..], &bodies][..], more].concat())
}

/// Linear keys of a node by its path: times, and the values of each key.
pub(crate) fn animate(
    mut glb: Glb,
    (node, path): (usize, &str),
    times: &[f32],
    kind: &str,
    values: &[f32],
) -> Glb {
    let (input, output) = (glb.push_numbers("SCALAR", times), glb.push_numbers(kind, values));
    glb.set(
        "/animations",
        json!([{"channels": [{"sampler": 0, "target": {"node": node, "path": path}}],
            "samplers": [{"input": input, "output": output}]}]),
    )
}

/// A primitive with the material of this number.
pub(crate) fn with_material(mut primitive: Value, material: usize) -> Value {
    primitive["material"] = json!(material);
    primitive
}

/// Rows of the flag.
const ROWS: usize = 12;
/// Seconds of a round.
const ROUND_S: f32 = 0.2;

/// A cube, `base`, and a flag above it on two joints, of which the upper turns to one side and back.
pub(crate) fn flag(name: &str) -> TempFile {
    let row = |i: usize| i as f32 / ROWS as f32;
    let ends = |i: usize| [[-0.08, 0.3 * row(i), 0.0], [0.08, 0.3 * row(i), 0.0]].concat();
    let points: Vec<f32> = (0..=ROWS).flat_map(ends).collect();
    let strip: Vec<[u8; 4]> = (0..ROWS as u8).map(|i| [2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2]).collect();
    let shares: Vec<f32> = (0..=ROWS).flat_map(|i| [1.0 - row(i), row(i), 0.0, 0.0].repeat(2)).collect();
    let turn = |angle: f32| [0.0, 0.0, (0.5 * angle).sin(), (0.5 * angle).cos()];
    let mut glb = Glb::empty();
    let cube = with_material(glb.push_cube(0.05), 0);
    let joints = glb.push_bytes("VEC4", &[0u8, 1, 0, 0].repeat(2 * (ROWS + 1)));
    let attributes = json!({
        "POSITION": glb.push_numbers("VEC3", &points),
        "JOINTS_0": joints,
        "WEIGHTS_0": glb.push_numbers("VEC4", &shares),
    });
    let flag = json!({"attributes": attributes, "indices": glb.push_quads(&strip), "material": 1});
    let glb = glb
        .set(
            "/nodes",
            json!([{"name": "base", "mesh": 0, "children": [1, 2]}, {"name": "flag", "mesh": 1, "skin": 0},
                {"name": "foot", "translation": [0.0, 0.05, 0.0], "children": [3]}, {"name": "top"}]),
        )
        .set("/skins", json!([{"joints": [2, 3]}]))
        .set("/meshes", json!([{"primitives": [cube]}, {"primitives": [flag]}]))
        .set(
            "/materials",
            json!([{"pbrMetallicRoughness": {"metallicFactor": 0.0}}, {"doubleSided": true,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "baseColorFactor": [0.8, 0.3, 0.1, 1.0]}}]),
        );
    let turns = [turn(-0.7), turn(0.7), turn(-0.7)].concat();
    let glb = animate(glb, (3, "rotation"), &[0.0, 0.5 * ROUND_S, ROUND_S], "VEC4", &turns);
    TempFile::new(&format!("{name}.glb"), &glb.bytes())
}
