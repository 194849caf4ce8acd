//! A good glTF file with bytes and values changed by chance: the loader answers with an error or a sound scene, never with a panic.

use crate::common::{png, with_image, Glb};
use dpm_scene::{LoadOptions, SceneError};
use proptest::prelude::*;
use serde_json::{json, Value};
use test_meter::core_seconds;

/// A file that uses most of the format, for mutation.
fn rich() -> Glb {
    let mut file = with_image(&png(3, 3, &[[200, 100, 50, 255]; 9]));
    let sparse_index = file.push_view(&[1, 3]);
    let sparse_value = file.push_view(&[0.1f32, 0.0, 0.0, 0.0, 0.0, 0.1].map(f32::to_le_bytes).concat());
    let joints = file.push_bytes("VEC4", &[0, 1, 0, 0].repeat(4));
    let shares = file.push_numbers("VEC4", &[0.75, 0.25, 0.0, 0.0].repeat(4));
    let bind = file.push_numbers("MAT4", &glam::Mat4::IDENTITY.to_cols_array().repeat(2));
    let target = file.push_numbers("VEC3", &[0.01; 12]);
    let primitive = "/meshes/0/primitives/0";
    let file = file
        .set(&format!("{primitive}/attributes/JOINTS_0"), json!(joints))
        .set(&format!("{primitive}/attributes/WEIGHTS_0"), json!(shares))
        .set(&format!("{primitive}/targets"), json!([{"POSITION": target, "NORMAL": target}]))
        .set("/meshes/0/weights", json!([0.5]))
        .set("/nodes/1/skin", json!(0))
        .set("/skins", json!([{"joints": [2, 1], "inverseBindMatrices": bind}]));
    file.set(
        "/accessors/0/sparse",
        json!({"count": 2, "indices": {"bufferView": sparse_index, "componentType": 5121}, "values": {"bufferView": sparse_value}}),
    )
    .set("/extensions", json!({"KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {"outerConeAngle": 0.5}}]}}))
    .set("/nodes/2", json!({"children": [0], "extensions": {"KHR_lights_punctual": {"light": 0}}, "scale": [1, -1, 2]}))
    .set("/scenes/0/nodes", json!([2, 1]))
    .set("/materials/0/extensions", json!({"KHR_materials_ior": {"ior": 1.4}, "KHR_materials_transmission": {"transmissionFactor": 0.5}}))
}

/// Loads whatever it is: an error or a sound scene, in bounded time.
fn assert_survives(bytes: &[u8]) -> Result<(), TestCaseError> {
    let start = core_seconds();
    match dpm_scene::load_bytes(bytes, &LoadOptions::default()) {
        Err(SceneError::Internal(e)) => return Err(TestCaseError::fail(format!("the loader panicked: {e}"))),
        Err(e) => prop_assert!(!e.to_string().is_empty() && e.to_string().len() < 4000),
        Ok(scene) => {
            for body in &scene.bodies {
                prop_assert!(body.mesh.positions.iter().all(|p| p.is_finite()));
                prop_assert!(body.mesh.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-3));
                prop_assert!(body.mesh.tangents.iter().all(|t| t.is_finite()));
                prop_assert!(body
                    .mesh
                    .triangles
                    .iter()
                    .flatten()
                    .all(|&i| (i as usize) < body.mesh.positions.len()));
            }
        }
    }
    prop_assert!(core_seconds() - start < 2.0);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn flipped_bytes_never_panic(changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let mut bytes = rich().bytes();
        for (at, value) in changes {
            let i = at.index(bytes.len());
            bytes[i] = value;
        }
        assert_survives(&bytes)?;
    }

    #[test]
    fn changed_numbers_never_panic(which in any::<prop::sample::Index>(), value in prop_oneof![
        Just(json!(0)), Just(json!(-1)), Just(json!(1)), Just(json!(3)), Just(json!(255)), Just(json!(u32::MAX)), Just(json!(u64::MAX)), Just(json!(1u64 << 62)),
        Just(json!(1e38)), Just(json!(-1e-45)), Just(json!(0.5)), Just(json!(null)), Just(json!([])), Just(json!({})), Just(json!("x")), Just(json!(true)),
    ]) {
        let mut file = rich();
        let places = leaves(&file.json);
        *file.json.pointer_mut(&places[which.index(places.len())]).unwrap() = value;
        assert_survives(&file.bytes())?;
    }
}

/// JSON pointers of all values below the top.
fn leaves(value: &Value) -> Vec<String> {
    let children: Vec<(String, &Value)> = match value {
        Value::Array(list) => list.iter().enumerate().map(|(i, v)| (i.to_string(), v)).collect(),
        Value::Object(map) => map.iter().map(|(k, v)| (k.clone(), v)).collect(),
        _ => vec![],
    };
    children
        .into_iter()
        .flat_map(|(key, v)| {
            std::iter::once(format!("/{key}"))
                .chain(leaves(v).into_iter().map(move |below| format!("/{key}{below}")))
                .collect::<Vec<_>>()
        })
        .collect()
}

#[test]
fn the_file_that_is_mutated_is_itself_good() {
    let scene = dpm_scene::load_bytes(&rich().bytes(), &LoadOptions::default()).unwrap();
    assert_eq!((scene.bodies.len(), scene.textures.len(), scene.lights.len()), (2, 1, 1));
}
