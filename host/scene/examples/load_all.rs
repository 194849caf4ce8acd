//! Loads every file that is named, and prints one line for each: what it holds, or why it is refused. With `--json` in front
//! each line is an object that `tests/peers/files/run.py` compares with what other programs read: with the milliseconds, the
//! greatest piece of memory that was asked for at once, and what the process had at most beyond what it had before. After that
//! `--texels DIR` writes the red, green, blue and alpha of every texel of a picture to a file there, named by its place in the
//! list.

use counting_allocator::{Counting, Request};
use dpm_camera_files::{LengthUnit, LensKind, ReadOptions, StorageError};
use dpm_device::planes::Raster;
use dpm_scene::srgb::to_linear;
use dpm_scene::{Body, Environment, LoadOptions, Material, Scene, SceneError, UpAxis};
use glam::{DVec3, Vec2, Vec3};
use serde_json::{json, Value};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Endings of skies.
const SKIES: [&str; 3] = ["exr", "hdr", "pfm"];
/// Endings of textures.
const PICTURES: [&str; 8] = ["png", "jpg", "jpeg", "tga", "tif", "tiff", "webp", "bmp"];
/// Endings of calibration files; `.ktx2` is a texture that no package of Python reads.
const CALIBRATIONS: [&str; 10] = ["yml", "yaml", "xml", "json", "gz", "zip", "mpcdi", "npz", "npy", "txt"];

/// The greatest piece of memory of the file in work, bytes.
static GREATEST: AtomicUsize = AtomicUsize::new(0);

#[global_allocator]
static ALLOCATOR: Counting = Counting::telling(|request| {
    if let Request::Allocation(bytes) | Request::Reallocation(bytes) = request {
        GREATEST.fetch_max(bytes, Ordering::Relaxed);
    }
});

fn main() {
    let mut files: Vec<String> = std::env::args().skip(1).collect();
    let as_json = files.first().is_some_and(|first| first == "--json");
    if as_json {
        files.remove(0);
    }
    let texels = (files.first().is_some_and(|first| first == "--texels") && files.len() > 1)
        .then(|| PathBuf::from(files.drain(..2).next_back().unwrap_or_default()));
    for (i, file) in files.into_iter().enumerate() {
        let out = texels.as_ref().map(|folder| folder.join(i.to_string()));
        let (begin, before) = (std::time::Instant::now(), resident(true));
        GREATEST.store(0, Ordering::Relaxed);
        let told = read(Path::new(&file), out.as_deref()).unwrap_or_else(|e| json!({"refused": e}));
        let (piece, at_most) = (GREATEST.load(Ordering::Relaxed), resident(false).saturating_sub(before));
        let ms = begin.elapsed().as_millis() as u64;
        if as_json {
            println!("{}", json!({"file": file, "ms": ms, "piece": piece, "at_most": at_most, "read": told}));
        } else {
            let word = if told.get("refused").is_some() { "refused" } else { "ok" };
            println!("{word}\t{file}\t{ms} ms\t{told}");
        }
    }
}

/// What the process has of memory at most, bytes, since the call with `anew`; 0 where the kernel does not say.
fn resident(anew: bool) -> usize {
    if anew {
        let _ = std::fs::write("/proc/self/clear_refs", "5");
    }
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or_default();
    line.trim().trim_end_matches(" kB").parse::<usize>().unwrap_or(0) << 10
}

/// `texels` is where those of a picture are written.
fn read(path: &Path, texels: Option<&Path>) -> Result<Value, String> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let is_of = |endings: &[&str]| endings.contains(&ending.as_str());
    let told = |e: SceneError| e.to_string();
    if is_of(&SKIES) {
        let sky = dpm_scene::load_environment(path, 0.0, 1.0).map_err(told)?;
        Ok(of_sky(&sky.environment, &sky.warnings))
    } else if is_of(&PICTURES) || ending == "ktx2" {
        let bytes = std::fs::read(path).map_err(|e| e.to_string())?;
        let scene = dpm_scene::load_bytes(&card(&bytes), &options()).map_err(told)?;
        if let Some((path, texture)) = texels.zip(scene.textures.first()) {
            std::fs::write(path, texture.texels.as_flattened()).map_err(|e| e.to_string())?;
        }
        of_picture(&scene)
    } else if is_of(&CALIBRATIONS) {
        of_calibration(&std::fs::read(path).map_err(|e| e.to_string())?)
    } else {
        Ok(of_scene(&dpm_scene::load(path, &options()).map_err(told)?))
    }
}

/// A triangle with a picture on it, as GLB.
fn card(picture: &[u8]) -> Vec<u8> {
    let points: [f32; 15] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0];
    let binary: Vec<u8> =
        points.iter().flat_map(|v| v.to_le_bytes()).chain(picture.iter().copied()).collect();
    let document = json!({
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3, "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 3}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": picture.len()}],
        "buffers": [{"byteLength": binary.len()}], "images": [{"bufferView": 2}], "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    });
    let chunk = |kind: &[u8; 4], bytes: &[u8], pad: u8| {
        let mut padded = bytes.to_vec();
        padded.resize(bytes.len().next_multiple_of(4), pad);
        [&(padded.len() as u32).to_le_bytes()[..], kind, &padded].concat()
    };
    let chunks =
        [chunk(b"JSON", document.to_string().as_bytes(), b' '), chunk(b"BIN\0", &binary, 0)].concat();
    [&b"glTF\x02\0\0\0"[..], &(chunks.len() as u32 + 12).to_le_bytes(), &chunks].concat()
}

fn of_picture(scene: &Scene) -> Result<Value, String> {
    let [texture] = &scene.textures[..] else { return Err(scene.warnings.join("; ")) };
    let count = texture.texels.len() as f64;
    let mean = [0, 1, 2].map(|c| texture.texels.iter().map(|t| f64::from(t[c])).sum::<f64>() / count);
    Ok(json!({"width": texture.width, "height": texture.height, "mean": mean, "warnings": scene.warnings}))
}

fn of_calibration(bytes: &[u8]) -> Result<Value, String> {
    let read = |raster: Raster| {
        let (unit, lens) = (LengthUnit::Metre, LensKind::Auto);
        dpm_camera_files::read(bytes, &ReadOptions { raster, unit, lens, region: None, device: None })
    };
    let stored = match read(Raster::new(1024, 768).expect("sides of a raster")) {
        // At its own raster.
        Err(StorageError::ImageSize { file: (width, height), .. }) => {
            read(Raster::new(width, height).ok_or("its raster is none of a projector")?)
        }
        other => other,
    };
    let stored = stored.map_err(|e| e.to_string())?;
    let camera = format!("{:?}", stored.camera);
    let frame = format!("{:?}", stored.frame);
    Ok(json!({
        "camera": camera, "frame": frame, "size": stored.image_size, "found": stored.found, "unread": stored.unread,
        "warnings": stored.notes,
    }))
}

/// As it lies in the file.
fn options() -> LoadOptions {
    LoadOptions { scale: Some(1.0), up: Some(UpAxis::Y), ..LoadOptions::default() }
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
