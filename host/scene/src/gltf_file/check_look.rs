//! The second half of the validation: materials, textures, samplers, images and lights of the raw JSON.

use super::super::{Limits, SceneError};
use super::check::Counts;
use super::json::{shorten, Item};
use super::lobes::{check_lobes, LOBES};

/// Radiance factors and intensities beyond this count as damage.
const GREATEST_INTENSITY: f32 = 1.0e9;

/// Extensions of materials that are reproduced.
const REPRODUCED: [&str; 5] = [
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_volume",
];

/// Checks everything about the appearance of surfaces and the light of lamps.
pub(crate) fn check_look(
    root: &Item,
    counts: &Counts,
    lights: &[Item],
    limits: &Limits,
    warnings: &mut Vec<String>,
) -> Result<(), SceneError> {
    for image in root.list("images", "image", limits.objects)? {
        if image.get("uri").is_some() == image.get("bufferView").is_some() {
            return Err(image.error("must have either a 'uri' or a 'bufferView'"));
        }
        image.whole("bufferView")?;
        image.text("uri")?;
        image.text("mimeType")?;
    }
    for sampler in root.list("samplers", "sampler", limits.objects)? {
        let one_of = |key, allowed: &[u64]| match sampler.whole(key)? {
            Some(code) if !allowed.contains(&code) => {
                Err(sampler.error(format!("'{key}' is {code}; it must be one of {allowed:?}")))
            }
            _ => Ok(()),
        };
        one_of("magFilter", &[9728, 9729])?;
        one_of("minFilter", &[9728, 9729, 9984, 9985, 9986, 9987])?;
        one_of("wrapS", &[33071, 33648, 10497])?;
        one_of("wrapT", &[33071, 33648, 10497])?;
    }
    for texture in root.list("textures", "texture", limits.objects)? {
        texture.index("sampler", counts.samplers, "sampler")?;
        if texture.index("source", counts.images, "image")?.is_none() {
            return Err(texture
                .error("has no 'source' this program can read: re-export with PNG, JPEG or KTX2 textures"));
        }
    }
    for material in root.list("materials", "material", limits.objects)? {
        check_material(&material, counts, warnings)?;
    }
    lights.iter().try_for_each(check_light)
}

/// Checks a use of a texture.
pub(super) fn check_texture(owner: &Item, key: &str, counts: &Counts) -> Result<(), SceneError> {
    let Some(info) = owner.object(key)? else { return Ok(()) };
    info.index("index", counts.textures, "texture")?.ok_or_else(|| info.error("has no 'index'"))?;
    small_whole(&info, "texCoord")?;
    if let Some(transform) = info.extension("KHR_texture_transform")? {
        transform.numbers::<2>("offset")?;
        transform.numbers::<2>("scale")?;
        transform.number("rotation")?;
        small_whole(&transform, "texCoord")?;
    }
    Ok(())
}

fn small_whole(item: &Item, key: &str) -> Result<(), SceneError> {
    match item.whole(key)? {
        Some(n) if n > 255 => Err(item.error(format!("'{key}' is {n}; this program reads sets 0 to 255"))),
        _ => Ok(()),
    }
}

/// A number that must be in a range if present.
pub(super) fn ranged(item: &Item, key: &str, low: f32, high: f32) -> Result<(), SceneError> {
    match item.number(key)? {
        Some(x) if !(low..=high).contains(&x) => {
            Err(item.error(format!("'{key}' is {x}; it must be from {low} to {high}")))
        }
        _ => Ok(()),
    }
}

pub(super) fn ranged_list<const N: usize>(item: &Item, key: &str, high: f32) -> Result<(), SceneError> {
    match item.numbers::<N>(key)? {
        Some(list) if list.iter().any(|x| !(0.0..=high).contains(x)) => {
            Err(item.error(format!("'{key}' is {list:?}; each must be from 0 to {high}")))
        }
        _ => Ok(()),
    }
}

/// The reader clamps factors 0..1 that writers round to slightly above 1.
pub(super) const UNIT: f32 = 1.001;

fn check_material(material: &Item, counts: &Counts, warnings: &mut Vec<String>) -> Result<(), SceneError> {
    if let Some(pbr) = material.object("pbrMetallicRoughness")? {
        ranged_list::<4>(&pbr, "baseColorFactor", UNIT)?;
        ranged(&pbr, "metallicFactor", 0.0, UNIT)?;
        ranged(&pbr, "roughnessFactor", 0.0, UNIT)?;
        check_texture(&pbr, "baseColorTexture", counts)?;
        check_texture(&pbr, "metallicRoughnessTexture", counts)?;
    }
    if let Some(normal) = material.object("normalTexture")? {
        ranged(&normal, "scale", -100.0, 100.0)?;
    }
    for key in ["normalTexture", "occlusionTexture", "emissiveTexture"] {
        check_texture(material, key, counts)?;
    }
    ranged_list::<3>(material, "emissiveFactor", GREATEST_INTENSITY)?;
    ranged(material, "alphaCutoff", 0.0, f32::MAX)?;
    material.flag("doubleSided")?;
    match material.text("alphaMode")? {
        None | Some("OPAQUE" | "MASK" | "BLEND") => {}
        Some(other) => {
            return Err(material
                .error(format!("'alphaMode' is '{}'; it must be OPAQUE, MASK or BLEND", shorten(other))))
        }
    }
    if let Some(e) = material.extension("KHR_materials_emissive_strength")? {
        ranged(&e, "emissiveStrength", 0.0, GREATEST_INTENSITY)?;
    }
    if let Some(e) = material.extension("KHR_materials_ior")? {
        if e.number("ior")?.is_some_and(|x| x != 0.0 && !(1.0..=10.0).contains(&x)) {
            return Err(e.error("'ior' must be 0, or from 1 to 10"));
        }
    }
    if let Some(e) = material.extension("KHR_materials_transmission")? {
        ranged(&e, "transmissionFactor", 0.0, UNIT)?;
        check_texture(&e, "transmissionTexture", counts)?;
    }
    if let Some(e) = material.extension("KHR_materials_volume")? {
        ranged(&e, "thicknessFactor", 0.0, f32::MAX)?;
        ranged(&e, "attenuationDistance", 0.0, f32::MAX)?;
        ranged_list::<3>(&e, "attenuationColor", UNIT)?;
        check_texture(&e, "thicknessTexture", counts)?;
    }
    check_lobes(material, counts)?;
    if let Some(extensions) = material.object("extensions")? {
        let known = |n: &&String| REPRODUCED.iter().chain(&LOBES).any(|known| known == n);
        for name in extensions.keys().filter(|n| !known(n)) {
            warnings.push(format!("{}: {} is ignored", material.name, shorten(name)));
        }
    }
    Ok(())
}

fn check_light(light: &Item) -> Result<(), SceneError> {
    let kind = light.text("type")?.unwrap_or("missing");
    if !matches!(kind, "point" | "spot" | "directional") {
        return Err(
            light.error(format!("'type' is '{}'; it must be point, spot or directional", shorten(kind)))
        );
    }
    ranged_list::<3>(light, "color", GREATEST_INTENSITY)?;
    ranged(light, "intensity", 0.0, GREATEST_INTENSITY)?;
    if light.number("range")?.is_some_and(|r| r <= 0.0) {
        return Err(light.error("'range' must be above 0"));
    }
    if let Some(spot) = light.object("spot")? {
        let quarter = std::f32::consts::FRAC_PI_2 + 1e-4;
        let inner = spot.number("innerConeAngle")?.unwrap_or(0.0);
        let outer = spot.number("outerConeAngle")?.unwrap_or(std::f32::consts::FRAC_PI_4);
        if !(inner >= 0.0 && inner < outer && outer <= quarter) {
            return Err(spot.error(format!(
                "needs 0 <= innerConeAngle < outerConeAngle <= pi/2, but has {inner} and {outer}"
            )));
        }
    } else if kind == "spot" {
        return Err(light.error("is a spot without a 'spot' object"));
    }
    Ok(())
}
