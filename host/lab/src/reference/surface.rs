//! A hit into the point that light meets: position, normals and the material's values there.

use super::bvh::Hit;
use super::lobes::{LobesHere, LEAST_BRUSHED_ALPHA};
use super::{texture, Reference};
use dpm_scene::albedo_table::LEAST_SHEEN_ALPHA;
use dpm_scene::lobes::THICKEST_FILM_NM;
use dpm_scene::{Material, TextureRef};
use glam::{DVec2, DVec3, DVec4, Vec3};

/// A point on a surface. Normals are not flipped: they belong to the counter-clockwise side.
#[derive(Clone, Copy, Debug)]
pub struct SurfacePoint {
    /// World position, metres: barycentric mean of the corners.
    pub position: DVec3,
    /// Unit normal of the triangle.
    pub geometric: DVec3,
    /// Unit normal interpolated from the vertices, without normal map.
    pub smooth: DVec3,
    /// Unit normal with the normal map.
    pub shading: DVec3,
    /// Unit normal of the clear coat, which has a map of its own.
    pub coat: DVec3,
    /// Unit direction along which a brushed surface has its first width, or any.
    pub tangent: DVec3,
    /// Texture coordinates, before any transform.
    pub uv: DVec2,
    /// Distance along the ray.
    pub distance: f64,
    /// Largest coordinate of the triangle, the scale of [`super::offset`].
    pub scale: f64,
    /// Body.
    pub body: u32,
    /// Triangle of the body's mesh.
    pub triangle: u32,
    /// Triangle of [`super::bvh::Bvh`].
    pub bvh_triangle: usize,
    /// Material values here.
    pub look: PointMaterial,
}

/// A material at one point, textures applied.
#[derive(Clone, Copy, Debug)]
pub struct PointMaterial {
    /// Index of the material.
    pub material: u32,
    /// Linear, 0..1.
    pub base: DVec3,
    /// 0..1.
    pub metallic: f64,
    /// GGX width, `max(roughness^2, 1e-4)`.
    pub alpha: f64,
    /// Emitted radiance.
    pub emission: DVec3,
    /// Index of refraction.
    pub ior: f64,
    /// 0..1.
    pub transmission: f64,
    /// Light passes straight; also for a solid whose index is below 1.001.
    pub thin: bool,
    /// Back faces are shaded: double-sided, or the material transmits.
    pub two_sided: bool,
    /// Back faces emit.
    pub emits_behind: bool,
    /// Lobes that few materials have.
    pub lobes: LobesHere,
}

/// Below this index a solid refracts too little to be told from none: its rough transmission would be a spike that f32 cannot carry.
pub(super) const STRAIGHT_BELOW_IOR: f64 = 1.001;

impl Reference<'_> {
    /// What lies at a hit.
    pub(crate) fn resolve(&self, hit: &Hit) -> SurfacePoint {
        let triangle = self.bvh.triangle(hit.triangle);
        let [a, b, c] = triangle.p;
        let body = &self.scene.bodies[triangle.body as usize];
        let mesh = &body.mesh;
        let index = mesh.triangles[triangle.index as usize].map(|i| i as usize);
        let [wa, wb, wc] = hit.weights;
        let position = a * wa + b * wb + c * wc;
        let geometric = (b - a).cross(c - a).normalize();
        let to_world = self.normal_from_body[triangle.body as usize];
        let mean = |v: &[Vec3]| {
            v[index[0]].as_dvec3() * wa + v[index[1]].as_dvec3() * wb + v[index[2]].as_dvec3() * wc
        };
        let smooth = (to_world * mean(&mesh.normals)).try_normalize().unwrap_or(geometric);
        let uv = self.uv(hit);
        let material_index = mesh.materials[triangle.index as usize];
        let material = &self.scene.materials[material_index as usize];
        let tangents = index.map(|i| mesh.tangents[i].as_dvec4());
        let tangent = tangents[0] * wa + tangents[1] * wb + tangents[2] * wc;
        // Tangents are directions on the surface: they turn with the pose itself, not with its inverse transpose.
        let t = self.world_from_body[triangle.body as usize].transform_vector3(tangent.truncate());
        let t =
            (t - smooth * smooth.dot(t)).try_normalize().unwrap_or_else(|| smooth.any_orthonormal_vector());
        let bitangent = smooth.cross(t) * if tangent.w < 0.0 { -1.0 } else { 1.0 };
        let mapped = |reference: &Option<TextureRef>, scale: f32| {
            let Some(reference) = reference else { return smooth };
            let (m, scale) = (self.look_up(reference, uv).truncate() * 2.0 - 1.0, f64::from(scale));
            let n = t * (m.x * scale) + bitangent * (m.y * scale) + smooth * m.z;
            n.try_normalize().unwrap_or(smooth)
        };
        let shading = mapped(&material.normal_texture, material.normal_scale);
        let coat = material.lobes.coat;
        let coat = mapped(&coat.normal_texture, coat.normal_scale);
        let mut look = self.look(material, material_index, uv);
        let along = self.brush(material, &mut look, uv);
        let along = t * along.x + bitangent * along.y;
        let tangent = (along - shading * shading.dot(along))
            .try_normalize()
            .unwrap_or_else(|| shading.any_orthonormal_vector());
        let scale = triangle.p.iter().fold(0.0f64, |s, p| s.max(p.abs().max_element()));
        SurfacePoint {
            position,
            geometric,
            smooth,
            shading,
            coat,
            tangent,
            uv,
            distance: hit.t,
            scale,
            body: triangle.body,
            triangle: triangle.index,
            bvh_triangle: hit.triangle,
            look,
        }
    }

    /// The direction of a brushed surface in the plane of tangent and bitangent, and its widths into `look`.
    fn brush(&self, m: &Material, look: &mut PointMaterial, uv: DVec2) -> DVec2 {
        let anisotropy = &m.lobes.anisotropy;
        let mut strength = f64::from(anisotropy.strength);
        let mut along = DVec2::from_angle(f64::from(anisotropy.rotation));
        if let Some(texture) = anisotropy.texture.as_ref().filter(|_| strength > 0.0) {
            let texel = self.look_up(texture, uv);
            let turn = (texel.truncate().truncate() * 2.0 - 1.0).try_normalize().unwrap_or(DVec2::X);
            along = along.rotate(turn);
            strength *= texel.z;
        }
        let wide = look.alpha + (1.0 - look.alpha) * strength * strength;
        if strength > 0.0 && wide >= LEAST_BRUSHED_ALPHA {
            look.lobes.brushed =
                Some(DVec2::new(wide.max(LEAST_BRUSHED_ALPHA), look.alpha.max(LEAST_BRUSHED_ALPHA)));
        }
        along
    }

    fn look(&self, m: &Material, material: u32, uv: DVec2) -> PointMaterial {
        let value = |r: &Option<TextureRef>| r.as_ref().map_or(DVec4::ONE, |r| self.look_up(r, uv));
        let rough_metal = value(&m.metallic_roughness_texture);
        let roughness = (f64::from(m.roughness) * rough_metal.y).clamp(0.0, 1.0);
        let ior = f64::from(m.ior).max(1.0);
        PointMaterial {
            material,
            base: m.base_color.as_dvec3() * value(&m.base_color_texture).truncate(),
            metallic: (f64::from(m.metallic) * rough_metal.z).clamp(0.0, 1.0),
            alpha: (roughness * roughness).max(1e-4),
            emission: m.emissive.as_dvec3() * value(&m.emissive_texture).truncate(),
            ior,
            transmission: (f64::from(m.transmission) * value(&m.transmission_texture).x).clamp(0.0, 1.0),
            thin: m.thin_walled || ior < STRAIGHT_BELOW_IOR,
            two_sided: m.double_sided || m.shines_through(),
            emits_behind: m.double_sided,
            lobes: self.lobes(m, uv),
        }
    }

    fn lobes(&self, m: &Material, uv: DVec2) -> LobesHere {
        let value = |r: &Option<TextureRef>| r.as_ref().map_or(DVec4::ONE, |r| self.look_up(r, uv));
        let (l, width) = (&m.lobes, |roughness: f64, least: f64| (roughness * roughness).max(least));
        let alpha = f64::from(m.alpha) * value(&m.base_color_texture).w;
        let [thin, thick] = l.film.thickness_nm.map(|nm| f64::from(nm.min(THICKEST_FILM_NM)));
        let transmits = m.transmission > 0.0 && !m.thin_walled;
        LobesHere {
            coverage: if m.alpha_blend { alpha.clamp(0.0, 1.0) } else { 1.0 },
            coat: f64::from(l.coat.factor) * value(&l.coat.texture).x,
            coat_alpha: width(f64::from(l.coat.roughness) * value(&l.coat.roughness_texture).y, 1e-4),
            brushed: None,
            specular: f64::from(l.specular.factor) * value(&l.specular.texture).w,
            specular_color: l.specular.color.as_dvec3() * value(&l.specular.color_texture).truncate(),
            sheen: l.sheen.color.as_dvec3() * value(&l.sheen.color_texture).truncate(),
            sheen_alpha: width(
                f64::from(l.sheen.roughness) * value(&l.sheen.roughness_texture).w,
                LEAST_SHEEN_ALPHA,
            ),
            film: f64::from(l.film.factor) * value(&l.film.texture).x,
            film_ior: f64::from(l.film.ior),
            film_nm: thin + (thick - thin) * value(&l.film.thickness_texture).y,
            shine: f64::from(l.diffuse_transmission.factor) * value(&l.diffuse_transmission.texture).w,
            shine_color: l.diffuse_transmission.color.as_dvec3()
                * value(&l.diffuse_transmission.color_texture).truncate(),
            absorption: if m.thin_walled { DVec3::ZERO } else { l.absorption.as_dvec3() },
            dispersion: if transmits { f64::from(l.dispersion) } else { 0.0 },
        }
    }

    /// Opacity at a hit, 0..1.
    pub(super) fn alpha(&self, hit: &Hit) -> f64 {
        let triangle = self.bvh.triangle(hit.triangle);
        let mesh = &self.scene.bodies[triangle.body as usize].mesh;
        let m = &self.scene.materials[mesh.materials[triangle.index as usize] as usize];
        let texture = m.base_color_texture.as_ref().map_or(1.0, |r| self.look_up(r, self.uv(hit)).w);
        f64::from(m.alpha) * texture
    }

    fn uv(&self, hit: &Hit) -> DVec2 {
        let triangle = self.bvh.triangle(hit.triangle);
        let mesh = &self.scene.bodies[triangle.body as usize].mesh;
        let uv = mesh.triangles[triangle.index as usize].map(|i| mesh.uvs[i as usize].as_dvec2());
        uv[0] * hit.weights[0] + uv[1] * hit.weights[1] + uv[2] * hit.weights[2]
    }

    fn look_up(&self, r: &TextureRef, uv: DVec2) -> DVec4 {
        texture::sample(&self.scene.textures[r.texture as usize], texture::transform(r, uv))
    }
}
