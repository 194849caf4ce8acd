//! Loads every file that is named, and prints one line for each: what it holds, or why it is refused. With `--json` in front
//! each line is an object that `tests/peers/files/run.py` compares with what other programs read.

use dpm_scene::srgb::to_linear;
use dpm_scene::{Body, Environment, Material, Scene};
use glam::{DVec3, Vec2, Vec3};
use serde_json::{json, Value};
use std::path::Path;

/// Endings of skies.
const SKIES: [&str; 7] = ["exr", "hdr", "pfm", "tif", "tiff", "webp", "bmp"];

fn main() {
    let mut files: Vec<String> = std::env::args().skip(1).collect();
    let as_json = files.first().is_some_and(|first| first == "--json");
    if as_json {
        files.remove(0);
    }
    for file in files {
        let begin = std::time::Instant::now();
        let path = Path::new(&file);
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let result = match SKIES.contains(&ending.as_str()) {
            true => dpm_scene::load_environment(path, 0.0, 1.0).map(|s| of_sky(&s.environment, &s.warnings)),
            false => dpm_scene::load(path, &options()).map(|scene| of_scene(&scene)),
        };
        let ms = begin.elapsed().as_millis();
        let told = result.unwrap_or_else(|e| json!({"refused": e.to_string()}));
        if as_json {
            println!("{}", json!({"file": file, "ms": ms as u64, "read": told}));
        } else {
            let word = if told.get("refused").is_some() { "refused" } else { "ok" };
            println!("{word}\t{file}\t{ms} ms\t{told}");
        }
    }
}

/// As it lies in the file.
fn options() -> dpm_scene::LoadOptions {
    let up = Some(dpm_scene::UpAxis::Y);
    dpm_scene::LoadOptions { scale: Some(1.0), up, ..dpm_scene::LoadOptions::default() }
}

fn of_sky(environment: &Environment, warnings: &[String]) -> Value {
    let Environment::Equirect { width, height, texels, .. } = environment else { return json!({}) };
    let sum: DVec3 = texels.iter().map(|t| t.as_dvec3()).sum();
    let mean = sum / texels.len() as f64;
    json!({"width": width, "height": height, "mean": mean.to_array(), "warnings": warnings})
}

fn of_scene(scene: &Scene) -> Value {
    let count: usize = scene.bodies.iter().map(|b| b.mesh.triangles.len()).sum();
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for (a, b, c) in scene.bodies.iter().flat_map(corners) {
        for p in [a, b, c] {
            (low, high) = (low.min(p), high.max(p));
        }
    }
    let sides: Vec<f64> = (high - low).to_array().into();
    let views: Vec<[f64; 3]> = (0..8).map(|view| colour(scene, view)).collect();
    json!({
        "bodies": scene.bodies.len(), "triangles": count, "textures": scene.textures.len(), "sides": sides,
        "colours": views, "warnings": scene.warnings,
    })
}

fn corners(body: &Body) -> impl Iterator<Item = (DVec3, DVec3, DVec3)> + '_ {
    let at = |i: u32| body.world_from_body_rest.transform_point3(body.mesh.positions[i as usize].as_dvec3());
    body.mesh.triangles.iter().map(move |&[a, b, c]| (at(a), at(b), at(c)))
}

/// Mean linear base colour of the surfaces that a view along a diagonal of the axes sees, by their projected area, without
/// hiding one behind another.
fn colour(scene: &Scene, view: u32) -> [f64; 3] {
    let sign = |bit: u32| if view >> bit & 1 == 0 { 1.0 } else { -1.0 };
    let towards = DVec3::new(sign(0), sign(1), sign(2)).normalize();
    let (mut sum, mut area) = (DVec3::ZERO, 0.0);
    for body in &scene.bodies {
        for (t, (a, b, c)) in corners(body).enumerate() {
            let seen = (0.5 * (b - a).cross(c - a)).dot(towards).max(0.0);
            let material = &scene.materials[body.mesh.materials[t] as usize];
            sum += seen * albedo(scene, material, body, t).as_dvec3();
            area += seen;
        }
    }
    (sum / area.max(1e-30)).to_array()
}

/// The mean of a triangle's corners, each at a place a little inside.
fn albedo(scene: &Scene, material: &Material, body: &Body, triangle: usize) -> Vec3 {
    let base = if material.unlit { material.emissive } else { material.base_color };
    let used = if material.unlit { material.emissive_texture } else { material.base_color_texture };
    let Some(used) = used else { return base };
    let texture = &scene.textures[used.texture as usize];
    let uvs = body.mesh.triangles[triangle].map(|i| used.apply(body.mesh.uvs[i as usize]));
    let at = |uv: Vec2| {
        let pick = |t: f32, n: u32| ((t.rem_euclid(1.0) * n as f32) as u32).min(n - 1) as usize;
        let (x, y) = (pick(uv.x, texture.width), pick(uv.y, texture.height));
        let [r, g, b, _] = texture.texels[y * texture.width as usize + x];
        Vec3::from([r, g, b].map(|c| {
            if texture.srgb {
                to_linear(f32::from(c) / 255.0)
            } else {
                f32::from(c) / 255.0
            }
        }))
    };
    let middle = (uvs[0] + uvs[1] + uvs[2]) / 3.0;
    base * uvs.map(|uv| at(uv.lerp(middle, 0.02))).iter().sum::<Vec3>() / 3.0
}
