//! Determines what a [`Scene`] contains, so that a plan can leave out the code that nothing in the scene needs.

use glam::Vec3;

use super::{Environment, Scene, TextureRef};

/// The features that a scene requires of the tracer. Materials that no triangle has do not count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneFeatures {
    /// Triangles of all bodies.
    pub triangles: usize,
    /// Triangles whose material emits.
    pub emissive_triangles: usize,
    /// Those of them that are lamps: not those of unlit materials.
    pub lamp_triangles: usize,
    /// Point, spot and directional lights.
    pub punctual_lights: usize,
    /// The surroundings.
    pub environment: EnvironmentFeature,
    /// Some material has a texture of any kind.
    pub textures: bool,
    /// Some material has a normal map, so shading frames differ from the mesh's.
    pub normal_maps: bool,
    /// Some surface is cut out by the alpha of its material.
    pub masks: bool,
    /// Light passes through some surface.
    pub transmission: bool,
    /// Some of these surfaces bound a solid and refract.
    pub solid_transmission: bool,
    /// Every surface is a metal at every texel: no diffuse part and no albedo table.
    pub metals_only: bool,
    /// Some surface is a mirror or clear glass (GGX alpha below 1e-3): it is not reached by light sampling.
    pub delta_lobes: bool,
    /// Some surface is seen from both sides.
    pub double_sided: bool,
    /// Some body exists only in the virtual world.
    pub virtual_bodies: bool,
}

/// Kind of surroundings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum EnvironmentFeature {
    /// Black.
    #[default]
    None,
    /// The same radiance from everywhere.
    Constant,
    /// An image.
    Image,
}

/// Roughness below which GGX alpha = r^2 is below 1e-3, a delta lobe.
const DELTA_ROUGHNESS: f32 = 0.031_622_776;

impl SceneFeatures {
    /// Scans the scene once; the cost is proportional to its triangles.
    pub fn of(scene: &Scene) -> Self {
        let mut used = vec![0usize; scene.materials.len()];
        for &m in scene.bodies.iter().flat_map(|b| &b.mesh.materials) {
            used[m as usize] += 1;
        }
        let mut out = Self {
            triangles: used.iter().sum(),
            punctual_lights: scene.lights.iter().filter(|l| l.intensity.max_element() > 0.0).count(),
            environment: match &scene.environment {
                Environment::Constant(c) if *c == Vec3::ZERO => EnvironmentFeature::None,
                Environment::Constant(_) => EnvironmentFeature::Constant,
                Environment::Equirect { texels, .. } if texels.iter().all(|t| *t == Vec3::ZERO) => {
                    EnvironmentFeature::None
                }
                Environment::Equirect { .. } => EnvironmentFeature::Image,
            },
            virtual_bodies: scene.bodies.iter().any(|b| !b.projected),
            metals_only: used.iter().any(|&n| n > 0),
            ..Self::default()
        };
        for (m, &triangles) in scene.materials.iter().zip(&used).filter(|(_, &n)| n > 0) {
            let transmits = m.transmission > 0.0 && m.metallic < 1.0;
            let emits = m.emissive.max_element() > 0.0;
            out.emissive_triangles += if emits { triangles } else { 0 };
            out.lamp_triangles += if emits && !m.unlit { triangles } else { 0 };
            out.normal_maps |= m.normal_texture.is_some();
            out.textures |= m.textures().any(|t| t.is_some());
            // An opaque alpha of 1 without a texture never falls below the cut-off.
            out.masks |= m.alpha_cutoff.is_some_and(|c| m.base_color_texture.is_some() || m.alpha < c);
            out.transmission |= transmits;
            out.solid_transmission |= transmits && !m.thin_walled;
            let [least_roughness, least_metallic] =
                least_surface_factors(scene, m.metallic_roughness_texture);
            out.metals_only &= m.metallic * least_metallic == 1.0;
            // A thin wall transmits light straight whatever its roughness.
            out.delta_lobes |=
                m.roughness * least_roughness < DELTA_ROUGHNESS || (transmits && m.thin_walled);
            out.double_sided |= m.double_sided;
        }
        out
    }
}

/// Least factors of roughness and metallic anywhere in a texture; interpolation never gives less than the least texel.
fn least_surface_factors(scene: &Scene, texture: Option<TextureRef>) -> [f32; 2] {
    let Some(t) = texture else { return [1.0; 2] };
    let least = scene.textures[t.texture as usize]
        .texels
        .iter()
        .fold([255u8; 2], |[g, b], t| [g.min(t[1]), b.min(t[2])]);
    least.map(|x| f32::from(x) / 255.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::builtin::SHARED;
    use crate::Material;

    #[test]
    fn the_built_in_scene_has_what_it_is_made_of() {
        let scene = &*SHARED;
        let f = SceneFeatures::of(scene);
        assert_eq!(f.triangles, scene.bodies.iter().map(|b| b.mesh.triangles.len()).sum::<usize>());
        assert_eq!(
            (f.emissive_triangles, f.punctual_lights, f.environment),
            (2, 0, EnvironmentFeature::Constant)
        );
        assert!(f.textures && f.normal_maps && f.virtual_bodies);
        assert!(
            !(f.delta_lobes
                || f.masks
                || f.transmission
                || f.solid_transmission
                || f.metals_only
                || f.double_sided)
        );
    }

    #[test]
    fn each_feature_follows_its_cause_and_unused_materials_do_not_count() {
        let mut scene = SHARED.clone();
        scene.bodies.truncate(1);
        scene.materials = vec![Material::default(); 2];
        scene.bodies[0].mesh.materials.fill(0);
        scene.environment = Environment::default();
        scene.materials[1] = Material {
            transmission: 1.0,
            metallic: 0.0,
            double_sided: true,
            emissive: Vec3::ONE,
            ..Material::default()
        };
        let bare = SceneFeatures::of(&scene);
        assert!(bare.metals_only && !bare.transmission && !bare.double_sided && bare.emissive_triangles == 0);
        assert_eq!(bare.environment, EnvironmentFeature::None);
        scene.bodies[0].mesh.materials[0] = 1;
        let glass = SceneFeatures::of(&scene);
        assert!(
            glass.transmission
                && !glass.solid_transmission
                && glass.delta_lobes
                && !glass.metals_only
                && glass.emissive_triangles == 1
        );
        scene.materials[1].thin_walled = false;
        assert!(SceneFeatures::of(&scene).solid_transmission && !SceneFeatures::of(&scene).delta_lobes);
        scene.materials[0].metallic_roughness_texture = SHARED.materials[1].metallic_roughness_texture;
        assert!(!SceneFeatures::of(&scene).delta_lobes);
        let texture = scene.materials[0].metallic_roughness_texture.unwrap().texture as usize;
        scene.textures[texture].texels[77][1] = 3;
        assert!(SceneFeatures::of(&scene).delta_lobes, "one smooth texel is enough");
        scene.textures[texture].texels[77][1] = 255;
        scene.materials[0].roughness = 0.03;
        assert!(SceneFeatures::of(&scene).delta_lobes);
        scene.materials[0].alpha_cutoff = Some(0.5);
        assert!(!SceneFeatures::of(&scene).masks, "alpha 1 never falls below the cut-off");
        scene.materials[0].alpha = 0.4;
        assert!(SceneFeatures::of(&scene).masks);
    }
}
