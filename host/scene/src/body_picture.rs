//! Pictures on a body: whether its mesh has a place for them, and one in the place of the colours that its file gives it.

use super::limits::Limits;
use super::load::contained;
use super::{gltf_file, Body, LivePictures, LiveTexture, Material, Scene, SceneError, Texture, TextureRef};
use glam::{Vec2, Vec3};
use std::collections::HashMap;
use std::sync::Arc;

/// Share of a body's surface that may lack texture coordinates: a few triangles that nobody sees.
const MOST_WITHOUT_UVS: f64 = 0.01;

impl Scene {
    /// Whether a picture can lie over the texture coordinates of a body.
    ///
    /// # Errors
    /// Why not, and what to do about it.
    pub fn check_coordinates(&self, body: &Body) -> Result<(), String> {
        if body.mesh.materials.iter().any(|m| self.is_painted(&self.materials[*m as usize])) {
            return Err("its vertices have colours, which take the place of texture coordinates, so the picture has no place on \
                        it; export the mesh with TEXCOORD_0 and without COLOR_0"
                .into());
        }
        let bare = body.mesh.share_without_uvs();
        if bare <= MOST_WITHOUT_UVS {
            return Ok(());
        }
        Err(format!(
            "{:.0} % of its surface has no texture coordinates, so the picture has no place there; export the mesh with them \
             (TEXCOORD_0)",
            100.0 * bare
        ))
    }

    /// Colours of vertices are a texture whose coordinates count its texels.
    fn is_painted(&self, material: &Material) -> bool {
        material.textures().flatten().any(|used| {
            let Texture { width, height, .. } = self.textures[used.texture as usize];
            width > 1 && used.scale == Vec2::new(1.0 / width as f32, 1.0 / height as f32)
        })
    }

    /// Shows a PNG, JPEG, KTX2 or an animated PNG on a tracked body and its parts, over their texture coordinates and repeated, in the place of
    /// their base colours, and of the light of materials that are unlit. What else a material says stays.
    ///
    /// # Errors
    /// The picture cannot be decoded or is beyond the limits, or a mesh has no place for it.
    pub fn show_picture(&mut self, tracked: u16, bytes: Vec<u8>, limits: &Limits) -> Result<(), SceneError> {
        self.check_carried(tracked)?;
        let (texels, owned) = (self.texel_count(), limits.clone());
        let texture = contained(limits, move |_| gltf_file::decode_picture(&bytes, texels, &owned))?;
        self.lay_over(tracked, texture);
        Ok(())
    }

    /// Shows the pictures of another program, in the same way as [`Scene::show_picture`] does. They are black until the first is shown,
    /// and their surfaces opaque.
    ///
    /// # Errors
    /// The pictures are beyond the limits, or a mesh has no place for them.
    pub fn show_live(
        &mut self,
        tracked: u16,
        pictures: Arc<LivePictures>,
        limits: &Limits,
    ) -> Result<(), SceneError> {
        self.check_carried(tracked)?;
        let size = pictures.size();
        gltf_file::check_picture(size, self.texel_count(), limits)?;
        let texture = Texture::repeated(size, pictures.newest(), true);
        self.live.push(LiveTexture { texture: self.textures.len() as u32, tracked, pictures });
        self.lay_over(tracked, texture);
        Ok(())
    }

    fn check_carried(&self, tracked: u16) -> Result<(), SceneError> {
        let is_carried = |body: &&Body| body.tracked == Some(tracked) && !body.mesh.triangles.is_empty();
        let mut carried = self.bodies.iter().filter(is_carried);
        let checked = carried.try_for_each(|body| self.check_coordinates(body));
        checked.map_err(|e| SceneError::broken("mesh", e))
    }

    fn texel_count(&self) -> u64 {
        self.textures.iter().map(|t| t.texels.len() as u64).sum()
    }

    /// Lays a new texture over a tracked body and its parts.
    fn lay_over(&mut self, tracked: u16, texture: Texture) {
        let picture = TextureRef {
            texture: self.textures.len() as u32,
            offset: Vec2::ZERO,
            rotation: 0.0,
            scale: Vec2::ONE,
        };
        self.textures.push(texture);
        let mut shown: HashMap<u32, u32> = HashMap::new();
        for body in self.bodies.iter_mut().filter(|body| body.tracked == Some(tracked)) {
            for material in &mut body.mesh.materials {
                *material = *shown.entry(*material).or_insert_with(|| {
                    self.materials.push(with_picture(&self.materials[*material as usize], picture));
                    self.materials.len() as u32 - 1
                });
            }
        }
    }
}

fn with_picture(material: &Material, picture: TextureRef) -> Material {
    if material.unlit {
        return Material { emissive: Vec3::ONE, emissive_texture: Some(picture), ..material.clone() };
    }
    Material { base_color: Vec3::ONE, alpha: 1.0, base_color_texture: Some(picture), ..material.clone() }
}
