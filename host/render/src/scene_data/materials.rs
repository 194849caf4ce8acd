//! Materials as the shaders read them, and what they need of the shaders.

use super::{bounded, SceneData, SceneNeeds};
use dpm_scene::albedo_table::{tabulated, AlbedoTable, ALBEDO_NODES};
use dpm_scene::lobes::{Coat, Lobes, LEAST_COVERAGE, THICKEST_FILM_NM};
use dpm_scene::{Scene, TextureRef};
use dpm_shaders::structs::{self as gpu, AlbedoCell, Material, TextureUse};
use glam::Vec3;

/// A solid with a smaller index of refraction is drawn as a thin wall, because the peak of its refraction is too narrow for f32.
const STRAIGHT_BELOW_IOR: f32 = 1.001;

/// The cells of an albedo table as the shader reads them: those between nodes, row after row, then those between two averages.
fn albedo_cells(table: &AlbedoTable) -> Vec<AlbedoCell> {
    let n = ALBEDO_NODES;
    let mut cells = Vec::with_capacity((n - 1) * n);
    for rows in table.directional.windows(2 * n).step_by(n) {
        let (low, high) = rows.split_at(n);
        cells.extend((1..n).map(|i| AlbedoCell { corners: [low[i - 1], low[i], high[i - 1], high[i]] }));
    }
    cells.extend(table.average.windows(2).map(|e| AlbedoCell { corners: [e[0], e[1], 0.0, 0.0] }));
    cells
}

fn texture_use(t: Option<TextureRef>) -> TextureUse {
    let Some(t) = t else {
        return TextureUse { texture: gpu::NO_TEXTURE, row_u: [1.0, 0.0, 0.0], row_v: [0.0, 1.0, 0.0] };
    };
    // KHR_texture_transform: uv' = translation * rotation * scale * uv. The rotation is counter-clockwise, with v down.
    let (s, c) = t.rotation.sin_cos();
    TextureUse {
        texture: t.texture,
        row_u: [c * t.scale.x, s * t.scale.y, t.offset.x],
        row_v: [-s * t.scale.x, c * t.scale.y, t.offset.y],
    }
}

/// Where the tables of albedo of the lobes of glTF's extensions begin, in tables.
struct LobeTables {
    coat: u32,
    white: u32,
    sheen: u32,
}

impl SceneNeeds {
    /// Adds what a material needs that a triangle has. `ior`: its index of refraction, 1 or more.
    fn add_material(&mut self, m: &dpm_scene::Material, ior: f32) {
        let lobes = &m.lobes;
        let metal_everywhere = m.metallic >= 1.0 && m.metallic_roughness_texture.is_none();
        self.textures |= m.textures().any(|t| t.is_some());
        self.normal_maps |= m.normal_texture.is_some();
        self.alpha_mask |= m.alpha_cutoff.is_some() || m.alpha_blend;
        self.transmission |= m.transmission > 0.0;
        self.specular |= m.metallic > 0.0 || ior != 1.0;
        self.diffuse |= !metal_everywhere;
        self.clearcoat |= lobes.coat.factor > 0.0;
        self.specular_color |= !lobes.specular.is_plain() && !metal_everywhere && ior != 1.0;
        self.anisotropy |= lobes.anisotropy.strength > 0.0;
        self.sheen |= lobes.sheen.color != Vec3::ZERO;
        self.absorption |= lobes.absorption != Vec3::ZERO;
        self.alpha_blend |= m.alpha_blend;
        self.iridescence |= lobes.film.factor > 0.0;
        self.diffuse_transmission |= lobes.diffuse_transmission.factor > 0.0 && !metal_everywhere;
        self.dispersion |= lobes.dispersion > 0.0 && m.transmission > 0.0 && !m.thin_walled;
    }
}

/// The flags of a material, `gpu::MATERIAL_*`.
fn material_flags(m: &dpm_scene::Material, ior: f32) -> u32 {
    let flags = [
        (m.double_sided, gpu::MATERIAL_DOUBLE_SIDED),
        (m.thin_walled || ior < STRAIGHT_BELOW_IOR, gpu::MATERIAL_THIN),
        (m.shines_through(), gpu::MATERIAL_TRANSMISSIVE),
        (m.alpha_blend, gpu::MATERIAL_BLEND),
    ];
    flags.iter().filter(|(is_set, _)| *is_set).fold(0, |all, (_, flag)| all | flag)
}

/// What the shaders read of a material. `ior`: its index of refraction, 1 or more; `albedo_table`: the table of that index.
fn material_row(m: &dpm_scene::Material, ior: f32, albedo_table: u32, tables: &LobeTables) -> Material {
    let lobes = &m.lobes;
    let Lobes { coat, specular, anisotropy, sheen, film, diffuse_transmission, .. } = *lobes;
    Material {
        base_color: m.base_color.into(),
        alpha: m.alpha,
        emissive: bounded(m.emissive).into(),
        alpha_cutoff: m.alpha_cutoff.unwrap_or(if m.alpha_blend { LEAST_COVERAGE } else { -1.0 }),
        metallic: m.metallic,
        roughness: m.roughness,
        ior,
        transmission: m.transmission,
        normal_scale: m.normal_scale,
        flags: material_flags(m, ior),
        albedo_table,
        base_color_texture: texture_use(m.base_color_texture),
        metallic_roughness_texture: texture_use(m.metallic_roughness_texture),
        normal_texture: texture_use(m.normal_texture),
        emissive_texture: texture_use(m.emissive_texture),
        transmission_texture: texture_use(m.transmission_texture),
        coat: coat.factor,
        coat_roughness: coat.roughness,
        coat_normal_scale: coat.normal_scale,
        coat_table: tables.coat,
        white_table: tables.white,
        sheen_table: tables.sheen,
        specular: specular.factor,
        specular_color: specular.color.into(),
        anisotropy: anisotropy.strength,
        anisotropy_direction: anisotropy.direction().into(),
        sheen_color: sheen.color.into(),
        sheen_roughness: sheen.roughness,
        film: film.factor,
        film_ior: film.ior,
        film_thickness: film.thickness_nm.map(|nm| nm.min(THICKEST_FILM_NM)),
        absorption: if m.thin_walled { [0.0; 3] } else { lobes.absorption.into() },
        shine: diffuse_transmission.factor,
        shine_color: diffuse_transmission.color.into(),
        dispersion: if m.thin_walled { 0.0 } else { lobes.dispersion },
        coat_texture: texture_use(coat.texture),
        coat_roughness_texture: texture_use(coat.roughness_texture),
        coat_normal_texture: texture_use(coat.normal_texture),
        specular_texture: texture_use(specular.texture),
        specular_color_texture: texture_use(specular.color_texture),
        anisotropy_texture: texture_use(anisotropy.texture),
        sheen_color_texture: texture_use(sheen.color_texture),
        sheen_roughness_texture: texture_use(sheen.roughness_texture),
        film_texture: texture_use(film.texture),
        film_thickness_texture: texture_use(film.thickness_texture),
        shine_texture: texture_use(diffuse_transmission.texture),
        shine_color_texture: texture_use(diffuse_transmission.color_texture),
        reserved: 0,
    }
}

impl SceneData {
    /// Adds the materials of a scene and their tables of albedo.
    pub(super) fn add_materials(&mut self, scene: &Scene) {
        let used = scene.used_materials();
        let ior_of = |m: &dpm_scene::Material| if m.ior.is_finite() { m.ior.max(1.0) } else { 1.0 };
        let iors: Vec<f32> = scene.materials.iter().map(ior_of).collect();
        let (tables, table_of) = tabulated(&iors);
        self.albedo.extend(tables.iter().flat_map(|&ior| albedo_cells(&AlbedoTable::new(ior))));
        let lobes = || scene.materials.iter().zip(&used).filter(|(_, used)| **used).map(|(m, _)| &m.lobes);
        let mut made = tables.len() as u32;
        let mut extra = |wanted: bool, make: &dyn Fn() -> Vec<AlbedoTable>| {
            let tables = if wanted { make() } else { vec![] };
            self.albedo.extend(tables.iter().flat_map(albedo_cells));
            made += tables.len() as u32;
            made - tables.len() as u32
        };
        let facets = |l: &Lobes| !l.specular.is_plain() || l.film.factor > 0.0;
        let of_lobes = LobeTables {
            coat: extra(lobes().any(|l| l.coat.factor > 0.0), &|| vec![AlbedoTable::new(Coat::IOR)]),
            white: extra(lobes().any(facets), &|| vec![AlbedoTable::white()]),
            sheen: extra(lobes().any(|l| l.sheen.color != Vec3::ZERO), &|| AlbedoTable::sheen().to_vec()),
        };
        for (((m, &used), &ior), table) in scene.materials.iter().zip(&used).zip(&iors).zip(table_of) {
            if used {
                self.needs.add_material(m, ior);
            }
            self.materials.push(material_row(m, ior, table as u32, &of_lobes));
        }
    }
}
