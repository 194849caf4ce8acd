//! The lobes that a material may have beside metal, dielectric and transmission: glTF's extensions of materials, as
//! `docs/RENDERING.md`, "Lobes of materials", defines them. The default of each is its absence.

use super::TextureRef;
use glam::{Vec2, Vec3};

/// KHR_materials_clearcoat: a clear coat of index 1.5 over everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coat {
    /// 0..1; 0: none.
    pub factor: f32,
    /// Perceptual roughness, 0..1.
    pub roughness: f32,
    /// Strength of the coat's own normal map.
    pub normal_scale: f32,
    /// Linear; red is the factor.
    pub texture: Option<TextureRef>,
    /// Linear; green is the roughness.
    pub roughness_texture: Option<TextureRef>,
    /// Linear tangent-space normals of the coat alone.
    pub normal_texture: Option<TextureRef>,
}

/// KHR_materials_specular: strength and colour of a dielectric's reflection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Specular {
    /// 0..1.
    pub factor: f32,
    /// Linear colour of the reflection at normal incidence, 0 or more.
    pub color: Vec3,
    /// Linear; alpha is the factor.
    pub texture: Option<TextureRef>,
    /// sRGB colour.
    pub color_texture: Option<TextureRef>,
}

/// KHR_materials_anisotropy: a surface that is rougher along one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Anisotropy {
    /// 0..1.
    pub strength: f32,
    /// Radians from the tangent toward the bitangent.
    pub rotation: f32,
    /// Linear; red and green are the direction, blue is the strength.
    pub texture: Option<TextureRef>,
}

/// KHR_materials_sheen: fibres that stand on the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sheen {
    /// Linear colour, 0..1; black: none.
    pub color: Vec3,
    /// Perceptual roughness, 0..1.
    pub roughness: f32,
    /// sRGB colour.
    pub color_texture: Option<TextureRef>,
    /// Linear; alpha is the roughness.
    pub roughness_texture: Option<TextureRef>,
}

/// KHR_materials_iridescence: a thin film on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Film {
    /// 0..1; 0: none.
    pub factor: f32,
    /// Index of refraction, at least 1.
    pub ior: f32,
    /// Thickness where the texture is 0, and where it is 1 or absent, nanometres.
    pub thickness_nm: [f32; 2],
    /// Linear; red is the factor.
    pub texture: Option<TextureRef>,
    /// Linear; green is the thickness.
    pub thickness_texture: Option<TextureRef>,
}

/// KHR_materials_diffuse_transmission: light that leaves on the other side in every direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DiffuseTransmission {
    /// Share of the diffuse light that does, 0..1.
    pub factor: f32,
    /// Linear colour of it.
    pub color: Vec3,
    /// Linear; alpha is the factor.
    pub texture: Option<TextureRef>,
    /// sRGB colour.
    pub color_texture: Option<TextureRef>,
}

/// All lobes of a material that few materials have.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lobes {
    /// A clear coat.
    pub coat: Coat,
    /// Strength and colour of the dielectric reflection.
    pub specular: Specular,
    /// Brushed surfaces.
    pub anisotropy: Anisotropy,
    /// Cloth.
    pub sheen: Sheen,
    /// What a solid absorbs, per metre and channel: 0 or more, finite (KHR_materials_volume).
    pub absorption: Vec3,
    /// A thin film.
    pub film: Film,
    /// Light that shines through.
    pub diffuse_transmission: DiffuseTransmission,
    /// KHR_materials_dispersion: 20 over Abbe's number; 0: none.
    pub dispersion: f32,
}

impl Default for Specular {
    fn default() -> Self {
        Self { factor: 1.0, color: Vec3::ONE, texture: None, color_texture: None }
    }
}

impl Default for Film {
    fn default() -> Self {
        Self { factor: 0.0, ior: 1.3, thickness_nm: [100.0, 400.0], texture: None, thickness_texture: None }
    }
}

impl Default for DiffuseTransmission {
    fn default() -> Self {
        Self { factor: 0.0, color: Vec3::ONE, texture: None, color_texture: None }
    }
}

impl Coat {
    /// Index of refraction of every coat.
    pub const IOR: f32 = 1.5;
}

impl Specular {
    /// Whether the reflection is that of the index of refraction alone.
    pub fn is_plain(&self) -> bool {
        *self == Self::default()
    }
}

impl Anisotropy {
    /// Direction in the plane of tangent and bitangent.
    pub fn direction(&self) -> Vec2 {
        Vec2::from_angle(self.rotation)
    }
}

/// Alpha below which nothing of a blended surface is there for any ray: below half a step of eight bits.
pub const LEAST_COVERAGE: f32 = 1.0 / 512.0;

/// A thicker film is as this one: light of a wavelength has long lost its order in it, nanometres.
pub const THICKEST_FILM_NM: f32 = 1e5;

/// Absorption per metre beyond which light is gone at the first picometre.
pub const MOST_ABSORPTION: f32 = 1e30;

/// What a solid absorbs per metre, if of the light `color` is left after `distance_m` (KHR_materials_volume):
/// `-ln(color) / distance`, at most [`MOST_ABSORPTION`]. An infinite distance: nothing.
pub fn absorption(color: Vec3, distance_m: f32) -> Vec3 {
    let of = |c: f32| {
        if c >= 1.0 || distance_m.is_infinite() {
            return 0.0;
        }
        let sigma = -f64::from(c.max(0.0)).ln() / f64::from(distance_m.max(0.0));
        sigma.min(f64::from(MOST_ABSORPTION)) as f32
    };
    Vec3::from(color.to_array().map(of))
}

impl Lobes {
    /// All texture references.
    pub fn textures(&self) -> [Option<TextureRef>; 12] {
        let mut copy = *self;
        copy.textures_mut().map(|t| *t)
    }

    /// Their places, in the same order.
    pub fn textures_mut(&mut self) -> [&mut Option<TextureRef>; 12] {
        let Self { coat, specular, anisotropy, sheen, film, diffuse_transmission, .. } = self;
        [
            &mut coat.texture,
            &mut coat.roughness_texture,
            &mut coat.normal_texture,
            &mut specular.texture,
            &mut specular.color_texture,
            &mut anisotropy.texture,
            &mut sheen.color_texture,
            &mut sheen.roughness_texture,
            &mut film.texture,
            &mut film.thickness_texture,
            &mut diffuse_transmission.texture,
            &mut diffuse_transmission.color_texture,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn absorption_leaves_the_colour_after_its_distance() {
        for (color, distance) in [(0.3f32, 1e-6f32), (0.999, 0.02), (1e-6, 1e6)] {
            let sigma = f64::from(absorption(Vec3::splat(color), distance).x);
            let left = (-sigma * f64::from(distance)).exp();
            assert!((left / f64::from(color) - 1.0).abs() < 1e-5, "{color} {distance}: {left}");
        }
        assert_eq!(absorption(Vec3::new(0.5, 1.0, 0.0), f32::INFINITY), Vec3::ZERO);
        let hard = absorption(Vec3::new(0.5, 1.0, 0.0), 0.0);
        assert_eq!(hard, Vec3::new(MOST_ABSORPTION, 0.0, MOST_ABSORPTION));
    }
}
