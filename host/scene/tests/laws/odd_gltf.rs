//! What is odd in a glTF file costs what is odd, and not the scene: pictures that no decoder reads or that are too large for
//! their file, and nodes that stand on the globe.

use crate::common::{tetrahedra, with_image};
use dpm_scene::{load_bytes, LoadOptions, Scene};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::ImageEncoder;
use serde_json::json;

fn load(bytes: &[u8]) -> Scene {
    load_bytes(bytes, &LoadOptions::default()).unwrap()
}

/// A TIFF of 16 x 16 texels in one tile for each of red, green and blue.
fn tiff_in_planes() -> Vec<u8> {
    let entries: [(u16, u16, u32, u32); 11] = [
        (256, 4, 1, 16),
        (257, 4, 1, 16),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (277, 3, 1, 3),
        (284, 3, 1, 2),
        (322, 4, 1, 16),
        (323, 4, 1, 16),
        (324, 4, 3, 146),
        (325, 4, 3, 158),
    ];
    let mut out = b"II*\0\x08\0\0\0\x0b\0".to_vec();
    for (tag, kind, count, value) in entries {
        out.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
        out.extend([count.to_le_bytes(), value.to_le_bytes()].concat());
    }
    out.extend([0; 4]);
    assert_eq!(out.len(), 146);
    out.extend([170, 426, 682, 256, 256, 256].map(u32::to_le_bytes).concat());
    out.resize(out.len() + 768, 90);
    out
}

#[test]
fn tiles_in_planes_of_colours_are_read() {
    let scene = load(&with_image(&tiff_in_planes()).bytes());
    assert!(scene.textures[0].texels.iter().all(|t| *t == [90, 90, 90, 255]), "{:?}", scene.warnings);
    assert!(scene.bodies.iter().all(|b| b.mesh.triangles.len() == 4));
}

#[test]
fn a_picture_too_large_for_its_file_is_read_as_means() {
    // Columns of red and black take turns: the mean of any four texels is half red.
    let row: Vec<u8> = (0..4096).flat_map(|x| [if x % 2 == 0 { 200 } else { 0 }, 7, 0]).collect();
    let mut file = vec![];
    let packed = (CompressionType::Best, FilterType::NoFilter);
    let writer = PngEncoder::new_with_quality(&mut file, packed.0, packed.1);
    writer.write_image(&row.repeat(4096), 4096, 4096, image::ExtendedColorType::Rgb8).unwrap();
    assert!(file.len() < 150_000, "{} bytes", file.len());
    let scene = load(&with_image(&file).bytes());
    let texture = &scene.textures[0];
    assert_eq!((texture.width, texture.height), (2048, 2048));
    assert!(texture.texels.iter().all(|t| *t == [100, 7, 0, 255]));
    let told = scene.warnings.join("\n");
    assert!(told.contains("2048 x 2048 of its 4096 x 4096 texels"), "{told}");
}

#[test]
fn bodies_on_the_globe_are_moved_together() {
    // Earth-centred coordinates, as surveyors' exporters write them into the nodes: 6,378 km along x.
    let file = tetrahedra()
        .set("/nodes/0/translation", json!([6_378_000.0, 3.0, -2.0]))
        .set("/nodes/1/translation", json!([6_378_004.0, 3.0, -2.0]));
    let scene = load(&file.bytes());
    let at: Vec<_> = scene.bodies.iter().map(|b| b.world_from_body_rest.translation).collect();
    assert_eq!(at.iter().map(|p| p.to_array()).collect::<Vec<_>>(), [[0.0; 3], [4.0, 0.0, 0.0]]);
    let told = scene.warnings.join("\n");
    assert!(told.contains("6378 km from the origin") && told.contains("left"), "{told}");
    // What a room may have stays where it is.
    let near = tetrahedra().set("/nodes/0/translation", json!([900_000.0, 0.0, 0.0]));
    let scene = load(&near.bytes());
    assert_eq!(scene.bodies[0].world_from_body_rest.translation.x, 900_000.0);
}
