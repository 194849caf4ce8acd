//! What the rig file says of the real surfaces' albedo: a number for each body, or a picture over its texture coordinates.

use super::{srgb_light, DriveError, MAX_PICTURE_BYTES};
use crate::config::{AlbedoEncoding, BodyConfig, RigConfig};
use dpm_device::regular_file;
use dpm_render::albedo_map::AlbedoMap;
use dpm_scene::{LinearPicture, Scene};
use std::path::Path;
use std::sync::Arc;

/// Most texels of all albedo maps together. As numbers of four bytes they fill three quarters of the smallest storage buffer that Vulkan allows, and the
/// rest is for what differs from pixel to pixel.
const MAX_TEXELS: usize = 8 << 20;

/// Albedo of the real surface of a body of the scene, by the tracked body that carries it. Where the body has an albedo map it is that of the map.
pub(crate) fn albedo_of(config: &RigConfig, tracked: Option<u16>) -> [f64; 3] {
    match body_of(config, tracked) {
        Some(BodyConfig { albedo_map: Some(_), .. }) => [1.0; 3],
        body => body.and_then(|b| b.albedo).unwrap_or(config.scene.surface_albedo).0,
    }
}

fn body_of(config: &RigConfig, tracked: Option<u16>) -> Option<&BodyConfig> {
    tracked.and_then(|i| config.scene.bodies.get(usize::from(i)))
}

/// The albedo map of each body of the scene; empty if no body has one.
///
/// # Errors
/// A picture cannot be used, or its body has no texture coordinates.
pub(crate) fn albedo_maps(
    config: &RigConfig,
    scene: &Scene,
) -> Result<Vec<Option<Arc<AlbedoMap>>>, DriveError> {
    if config.scene.bodies.iter().all(|b| b.albedo_map.is_none()) {
        return Ok(Vec::new());
    }
    let mut left = MAX_TEXELS;
    let bodies = scene.bodies.iter().map(|body| {
        let Some(section) = body_of(config, body.tracked) else { return Ok(None) };
        let Some(file) = &section.albedo_map else { return Ok(None) };
        let wrong = |message: String| DriveError {
            key: "scene.bodies[].albedo_map",
            message: format!("body \"{}\": {message}", section.name),
        };
        let instead = |e: String| wrong(format!("{e}, or give one `albedo` in place of the picture"));
        scene.check_coordinates(body).map_err(instead)?;
        let map = albedo_map(file, section, left)
            .map_err(|message| wrong(format!("{}: {message}", file.display())))?;
        left -= map.texels().len();
        Ok(Some(Arc::new(map)))
    });
    bodies.collect()
}

/// The albedo in a picture of at most `left` texels.
fn albedo_map(file: &Path, section: &BodyConfig, left: usize) -> Result<AlbedoMap, String> {
    let bytes = regular_file::read(file, MAX_PICTURE_BYTES).map_err(|e| e.to_string())?;
    let picture = dpm_scene::load_linear_picture(&bytes).map_err(|e| e.to_string())?;
    let is_float = bytes.starts_with(b"P");
    let decode = match section.albedo_map_encoding {
        AlbedoEncoding::Srgb if !is_float => |v: f32| srgb_light(f64::from(v)) as f32,
        AlbedoEncoding::Srgb | AlbedoEncoding::Linear => |v: f32| v,
    };
    let factor = section.albedo.map_or([1.0; 3], |f| f.0.map(|v| v as f32));
    texels_of(&picture, decode, factor, left)
}

/// `picture` as albedo: each value decoded, times the factor of its channel.
fn texels_of(
    picture: &LinearPicture,
    decode: fn(f32) -> f32,
    factor: [f32; 3],
    left: usize,
) -> Result<AlbedoMap, String> {
    let (width, height) = (picture.width, picture.height);
    if picture.texels.len() > left {
        return Err(format!(
            "has {width} x {height} pixels, and {left} are left of {MAX_TEXELS} for the pictures of all bodies; scale it down"
        ));
    }
    let mut brightest = [0.0f32; 3];
    let mut texels = Vec::with_capacity(picture.texels.len());
    for (i, texel) in picture.texels.iter().enumerate() {
        let albedo: [f32; 3] = std::array::from_fn(|c| decode(texel[c]) * factor[c]);
        // A NaN is in no range.
        if let Some(bad) = albedo.iter().find(|v| !(0.0..=1.0).contains(*v)) {
            let (x, y) = (i as u32 % width, i as u32 / width);
            return Err(format!(
                "is {bad} at pixel ({x}, {y}); an albedo is 0 to 1. Give a smaller `albedo`, by which the picture is multiplied, or \
                 mend the picture"
            ));
        }
        (0..3).for_each(|c| brightest[c] = brightest[c].max(albedo[c]));
        texels.push(albedo.map(|v| v.max(AlbedoMap::LEAST)));
    }
    if let Some(channel) = brightest.iter().position(|v| *v < AlbedoMap::LEAST) {
        return Err(format!(
            "is black in its {} channel, which no light can make visible; is it the picture of the right body?",
            ["red", "green", "blue"][channel]
        ));
    }
    AlbedoMap::new(width, height, texels).ok_or_else(|| "has no pixels".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Overrides;

    fn picture(values: &[f32]) -> LinearPicture {
        LinearPicture {
            width: values.len() as u32,
            height: 1,
            texels: values.iter().map(|v| [*v, 0.5, 1.0]).collect(),
        }
    }

    #[test]
    fn values_are_decoded_multiplied_and_kept_above_the_least() {
        let srgb = |v: f32| srgb_light(f64::from(v)) as f32;
        let map = texels_of(&picture(&[0.0, 0.5, 1.0]), srgb, [0.5, 1.0, 0.8], 3).unwrap();
        let red: Vec<f32> = map.texels().iter().map(|t| t[0]).collect();
        assert_eq!([red[0], red[2]], [0.01, 0.5]);
        // The standard's value of middle grey, times the factor.
        assert!((red[1] - 0.5 * 0.214_041_14).abs() < 1e-6, "{red:?}");
        assert_eq!(map.texels()[0][2], 0.8);
    }

    #[test]
    fn the_body_and_the_file_are_named() {
        let file = std::env::temp_dir().join(format!("dpm-albedo-map-{}.png", std::process::id()));
        let demo = || {
            let flags = vec![format!("scene.bodies.1.albedo_map=\"{}\"", file.display())];
            RigConfig::demo(&Overrides { variables: vec![], flags })
        };
        let missing = demo().expect_err("the file is not there").to_string();
        assert!(missing.contains("scene.bodies.1.albedo_map") && missing.contains("png"), "{missing}");
        std::fs::write(&file, b"\x89PNG and then nothing of the kind").unwrap();
        let config = demo().unwrap();
        let mut scene = dpm_scene::builtin();
        let told = |scene: &Scene| albedo_maps(&config, scene).expect_err("cannot be used").to_string();
        let broken = told(&scene);
        assert!(broken.contains("body \"venus\"") && broken.contains("png"), "{broken}");
        let venus = scene.bodies.iter_mut().find(|b| b.name == "venus").unwrap();
        venus.mesh.uvs.fill(glam::Vec2::ZERO);
        let bare = told(&scene);
        assert!(bare.contains("100 % of its surface has no texture coordinates"), "{bare}");
        let _ = std::fs::remove_file(&file);
    }

    #[test]
    fn pictures_that_are_no_albedo_are_refused_by_what_is_wrong() {
        let told = |values: &[f32], left| {
            texels_of(&picture(values), |v| v, [1.0; 3], left).expect_err("is no albedo")
        };
        assert!(told(&[0.5, 1.5], 9).contains("is 1.5 at pixel (1, 0)"));
        assert!(told(&[0.5, -0.1], 9).contains("0 to 1"));
        assert!(told(&[f32::NAN], 9).contains("pixel (0, 0)"));
        assert!(told(&[0.005, 0.009], 9).contains("red channel"));
        assert!(told(&[0.5; 4], 3).contains("scale it down"));
        assert!(texels_of(&picture(&[]), |v| v, [1.0; 3], 9).is_err());
    }
}
