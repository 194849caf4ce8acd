//! What of the tracer a scene needs, as the specialization constants that leave out the rest.

use dpm_shaders::specialization as ids;

macro_rules! scene_needs {
    ($($(#[$doc:meta])* $field:ident => $constant:ident,)*) => {
        /// What of the tracer the scene needs. Code for the rest is left out of the shaders.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct SceneNeeds {
            $($(#[$doc])* pub $field: bool,)*
            /// Light from the surroundings, as `ENVIRONMENT_*`.
            pub environment_kind: u32,
        }

        impl SceneNeeds {
            /// What this scene or the other needs. The kind of environment stays this scene's, because another kind reads tables that it does not
            /// have.
            pub(crate) fn with(self, other: Self) -> Self {
                Self { $($field: self.$field || other.$field,)* ..self }
            }

            /// Everything, to show that leaving code out changes nothing.
            pub fn everything(self) -> Self {
                Self { $($field: true,)* ..self }
            }

            /// The specialization constants that the scene decides, each as id and value.
            pub fn constants(&self) -> Vec<(u32, u32)> {
                vec![$((ids::$constant, u32::from(self.$field)),)* (ids::ENVIRONMENT_KIND, self.environment_kind)]
            }
        }
    };
}

scene_needs! {
    /// A material has a texture.
    textures => HAS_TEXTURES,
    /// A material has a normal map.
    normal_maps => HAS_NORMAL_MAPS,
    /// A material has holes.
    alpha_mask => HAS_ALPHA_MASK,
    /// A material lets light through.
    transmission => HAS_TRANSMISSION,
    /// A material has a specular lobe: it is metallic, or its index of refraction is not 1.
    specular => HAS_SPECULAR,
    /// A material has a diffuse lobe.
    diffuse => HAS_DIFFUSE,
    /// A triangle emits light.
    emissive => HAS_EMISSIVE,
    /// There is a punctual light.
    punctual => HAS_PUNCTUAL,
    /// There are so many bodies that rays look for them in a tree.
    body_tree => HAS_BODY_TREE,
    /// The luminance of indirect contributions is limited.
    clamp => HAS_CLAMP,
    /// A material has a clear coat.
    clearcoat => HAS_CLEARCOAT,
    /// A dielectric reflects in a colour of its own, or less than its index says.
    specular_color => HAS_SPECULAR_COLOR,
    /// A material is rougher along one direction.
    anisotropy => HAS_ANISOTROPY,
    /// A material has fibres.
    sheen => HAS_SHEEN,
    /// A solid absorbs light.
    absorption => HAS_ABSORPTION,
    /// A material is partly there.
    alpha_blend => HAS_ALPHA_BLEND,
    /// A material has a thin film.
    iridescence => HAS_IRIDESCENCE,
    /// Light shines through a material in every direction.
    diffuse_transmission => HAS_DIFFUSE_TRANSMISSION,
    /// A solid refracts colours differently.
    dispersion => HAS_DISPERSION,
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_shaders::structs as gpu;

    #[test]
    fn a_shader_without_constants_leaves_nothing_out() {
        let all = SceneNeeds { environment_kind: gpu::ENVIRONMENT_MAP, ..SceneNeeds::default().everything() };
        for (id, value) in all.constants() {
            assert_eq!(value, ids::ALL[id as usize].default, "{}", ids::ALL[id as usize].name);
        }
    }
}
