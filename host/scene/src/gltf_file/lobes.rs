//! The extensions of materials that bring lobes of their own: their checks, and their values as [`Lobes`].

use super::super::lobes::*;
use super::super::SceneError;
use super::check::Counts;
use super::check_look::{check_texture, ranged, ranged_list, UNIT};
use super::json::Item;
use super::look::{raw_use, Use};
use glam::Vec3;

/// Colours of a specular reflection beyond this count as damage. The reflectance itself is at most 1.
const GREATEST_COLOR: f32 = 1.0e6;
/// Thickness of a film beyond this counts as damage, nanometres: light of a wavelength has long lost its order there.
const THICKEST_FILM_NM: f32 = 1.0e9;

/// Extensions that this file reads.
pub(super) const LOBES: [&str; 7] = [
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_dispersion",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
];

/// Checks all of them.
pub(super) fn check_lobes(material: &Item, counts: &Counts) -> Result<(), SceneError> {
    if let Some(e) = material.extension("KHR_materials_clearcoat")? {
        ranged(&e, "clearcoatFactor", 0.0, UNIT)?;
        ranged(&e, "clearcoatRoughnessFactor", 0.0, UNIT)?;
        for key in ["clearcoatTexture", "clearcoatRoughnessTexture", "clearcoatNormalTexture"] {
            check_texture(&e, key, counts)?;
        }
        if let Some(normal) = e.object("clearcoatNormalTexture")? {
            ranged(&normal, "scale", -100.0, 100.0)?;
        }
    }
    if let Some(e) = material.extension("KHR_materials_specular")? {
        ranged(&e, "specularFactor", 0.0, UNIT)?;
        ranged_list::<3>(&e, "specularColorFactor", GREATEST_COLOR)?;
        check_texture(&e, "specularTexture", counts)?;
        check_texture(&e, "specularColorTexture", counts)?;
    }
    if let Some(e) = material.extension("KHR_materials_anisotropy")? {
        ranged(&e, "anisotropyStrength", 0.0, UNIT)?;
        e.number("anisotropyRotation")?;
        check_texture(&e, "anisotropyTexture", counts)?;
    }
    if let Some(e) = material.extension("KHR_materials_sheen")? {
        ranged_list::<3>(&e, "sheenColorFactor", UNIT)?;
        ranged(&e, "sheenRoughnessFactor", 0.0, UNIT)?;
        check_texture(&e, "sheenColorTexture", counts)?;
        check_texture(&e, "sheenRoughnessTexture", counts)?;
    }
    if let Some(e) = material.extension("KHR_materials_iridescence")? {
        ranged(&e, "iridescenceFactor", 0.0, UNIT)?;
        ranged(&e, "iridescenceIor", 1.0, 10.0)?;
        ranged(&e, "iridescenceThicknessMinimum", 0.0, THICKEST_FILM_NM)?;
        ranged(&e, "iridescenceThicknessMaximum", 0.0, THICKEST_FILM_NM)?;
        check_texture(&e, "iridescenceTexture", counts)?;
        check_texture(&e, "iridescenceThicknessTexture", counts)?;
    }
    if let Some(e) = material.extension("KHR_materials_diffuse_transmission")? {
        ranged(&e, "diffuseTransmissionFactor", 0.0, UNIT)?;
        ranged_list::<3>(&e, "diffuseTransmissionColorFactor", UNIT)?;
        check_texture(&e, "diffuseTransmissionTexture", counts)?;
        check_texture(&e, "diffuseTransmissionColorTexture", counts)?;
    }
    if let Some(e) = material.extension("KHR_materials_dispersion")? {
        ranged(&e, "dispersion", 0.0, f32::MAX)?;
    }
    Ok(())
}

fn unit(item: &Item, key: &str, default: f32) -> Result<f32, SceneError> {
    Ok(item.number(key)?.unwrap_or(default).clamp(0.0, 1.0))
}

fn color(item: &Item, key: &str, default: Vec3) -> Result<Vec3, SceneError> {
    Ok(item.numbers::<3>(key)?.map_or(default, Vec3::from))
}

/// The lobes of a checked material, and the uses of textures in the order of [`Lobes::textures`]. `thin_walled`: there is no volume
/// that could absorb.
pub(super) fn read_lobes(
    material: &Item,
    thin_walled: bool,
) -> Result<(Lobes, [Option<Use>; 12]), SceneError> {
    let mut out = Lobes::default();
    let mut uses = [const { None }; 12];
    if let Some(e) = material.extension("KHR_materials_clearcoat")? {
        out.coat.factor = unit(&e, "clearcoatFactor", 0.0)?;
        out.coat.roughness = unit(&e, "clearcoatRoughnessFactor", 0.0)?;
        let normal = e.object("clearcoatNormalTexture")?;
        out.coat.normal_scale = normal.map_or(Ok(None), |n| n.number("scale"))?.unwrap_or(1.0);
        uses[0] = raw_use("clearcoat", &e, "clearcoatTexture", false)?;
        uses[1] = raw_use("clearcoat roughness", &e, "clearcoatRoughnessTexture", false)?;
        uses[2] = raw_use(super::look::COAT_NORMAL, &e, "clearcoatNormalTexture", false)?;
    }
    if let Some(e) = material.extension("KHR_materials_specular")? {
        out.specular.factor = unit(&e, "specularFactor", 1.0)?;
        out.specular.color = color(&e, "specularColorFactor", Vec3::ONE)?;
        uses[3] = raw_use("specular", &e, "specularTexture", false)?;
        uses[4] = raw_use("specular colour", &e, "specularColorTexture", true)?;
    }
    if let Some(e) = material.extension("KHR_materials_anisotropy")? {
        out.anisotropy.strength = unit(&e, "anisotropyStrength", 0.0)?;
        out.anisotropy.rotation = e.number("anisotropyRotation")?.unwrap_or(0.0);
        uses[5] = raw_use("anisotropy", &e, "anisotropyTexture", false)?;
    }
    if let Some(e) = material.extension("KHR_materials_sheen")? {
        out.sheen.color = color(&e, "sheenColorFactor", Vec3::ZERO)?.clamp(Vec3::ZERO, Vec3::ONE);
        out.sheen.roughness = unit(&e, "sheenRoughnessFactor", 0.0)?;
        uses[6] = raw_use("sheen colour", &e, "sheenColorTexture", true)?;
        uses[7] = raw_use("sheen roughness", &e, "sheenRoughnessTexture", false)?;
    }
    if let Some(e) = material.extension("KHR_materials_iridescence")? {
        out.film.factor = unit(&e, "iridescenceFactor", 0.0)?;
        out.film.ior = e.number("iridescenceIor")?.unwrap_or(1.3);
        let [thin, thick] = ["iridescenceThicknessMinimum", "iridescenceThicknessMaximum"];
        out.film.thickness_nm = [e.number(thin)?.unwrap_or(100.0), e.number(thick)?.unwrap_or(400.0)];
        uses[8] = raw_use("iridescence", &e, "iridescenceTexture", false)?;
        uses[9] = raw_use("iridescence thickness", &e, "iridescenceThicknessTexture", false)?;
    }
    if let Some(e) = material.extension("KHR_materials_diffuse_transmission")? {
        out.diffuse_transmission.factor = unit(&e, "diffuseTransmissionFactor", 0.0)?;
        out.diffuse_transmission.color =
            color(&e, "diffuseTransmissionColorFactor", Vec3::ONE)?.clamp(Vec3::ZERO, Vec3::ONE);
        uses[10] = raw_use("diffuse transmission", &e, "diffuseTransmissionTexture", false)?;
        uses[11] = raw_use("diffuse transmission colour", &e, "diffuseTransmissionColorTexture", true)?;
    }
    if let Some(e) = material.extension("KHR_materials_volume")?.filter(|_| !thin_walled) {
        let distance = e.number("attenuationDistance")?.unwrap_or(f32::INFINITY);
        out.absorption = absorption(color(&e, "attenuationColor", Vec3::ONE)?, distance);
    }
    if let Some(e) = material.extension("KHR_materials_dispersion")? {
        out.dispersion = e.number("dispersion")?.unwrap_or(0.0);
    }
    // A lobe without strength has no textures either: nothing is decoded and nothing is sampled for it.
    let absent = [
        (out.coat.factor == 0.0, 0..3),
        (out.anisotropy.strength == 0.0, 5..6),
        (out.sheen.color == Vec3::ZERO, 6..8),
        (out.film.factor == 0.0, 8..10),
        (out.diffuse_transmission.factor == 0.0, 10..12),
    ];
    for (_, range) in absent.into_iter().filter(|(absent, _)| *absent) {
        uses[range].fill_with(|| None);
    }
    Ok((out, uses))
}
