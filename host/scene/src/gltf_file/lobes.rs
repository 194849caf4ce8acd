//! The extensions of materials that bring lobes of their own, as [`Lobes`].

use super::super::lobes::*;
use super::super::SceneError;
use super::json::Item;
use super::look::{raw_use, Use};
use glam::Vec3;

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
