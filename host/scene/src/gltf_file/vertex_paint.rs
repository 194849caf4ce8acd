//! Colours of vertices as a texture, so that surfaces have one kind of colour.
//!
//! Each triangle gets 2 x 2 texels, and its corners lie in the centres of three of them. The fourth is what makes bilinear
//! interpolation linear on the triangle (`b + c - a`), up to the 8 bits of a texel and to values outside 0..1.

use std::collections::HashMap;

use glam::{Vec2, Vec3};

use super::super::srgb::{from_linear, to_linear};
use super::super::{Limits, SceneError, Texture, TextureRef, Wrap};
use super::look::Look;

/// Triangles in a row of the texture.
const PER_ROW: u32 = 4096;

/// A material and the texture coordinates of all corners of its faces.
type Painted = (u32, Vec<Vec2>);

/// The texture while it grows.
#[derive(Default)]
pub(super) struct Paint {
    /// Colours of the corners of a triangle, sRGB of 8 bits; equal ones share their texels.
    blocks: Vec<[[u8; 3]; 3]>,
    known: HashMap<[[u8; 3]; 3], u32>,
    /// Painted material by plain material; numbers go on after those of the file.
    materials: HashMap<u32, u32>,
    /// Materials of the file that have a texture, which cannot be painted.
    is_textured: Vec<bool>,
    /// Most triangles that fit into the limits.
    most: u64,
    /// Primitives whose colours are left out.
    ignored: usize,
}

impl Paint {
    /// For the materials of a file.
    pub(super) fn new(look: &Look, limits: &Limits) -> Self {
        let texels: u64 = look.textures.iter().map(|t| u64::from(t.width) * u64::from(t.height)).sum();
        let rows = u64::from(limits.texture_side / 2);
        let most = (limits.texels.saturating_sub(texels) / 4).min(rows * u64::from(PER_ROW));
        let is_textured = look.materials.iter().map(|m| m.textures().any(|t| t.is_some())).collect();
        Self { is_textured, most, ..Self::default() }
    }

    /// Paints faces whose vertices have linear colours. `None`: they stay as they are, since they are white or their material
    /// has a texture.
    ///
    /// # Errors
    /// More colours than a texture holds.
    pub(super) fn faces(
        &mut self,
        faces: &[[u64; 3]],
        material: u32,
        colour: impl Fn(u64) -> Vec3,
    ) -> Result<Option<Painted>, SceneError> {
        let white = |i: &u64| colour(*i).min_element() > 0.999;
        if faces.as_flattened().iter().all(white) {
            return Ok(None);
        }
        if self.is_textured.get(material as usize).copied().unwrap_or(true) {
            self.ignored += 1;
            return Ok(None);
        }
        let mut uvs = Vec::with_capacity(3 * faces.len());
        for face in faces {
            let block = self.block(face.map(|i| colour(i).to_array().map(encoded)))?;
            let corner = Vec2::new((block % PER_ROW * 2) as f32, (block / PER_ROW * 2) as f32);
            uvs.extend([Vec2::new(0.5, 0.5), Vec2::new(1.5, 0.5), Vec2::new(0.5, 1.5)].map(|at| corner + at));
        }
        let next = (self.is_textured.len() + self.materials.len()) as u32;
        Ok(Some((*self.materials.entry(material).or_insert(next), uvs)))
    }

    fn block(&mut self, corners: [[u8; 3]; 3]) -> Result<u32, SceneError> {
        if let Some(&known) = self.known.get(&corners) {
            return Ok(known);
        }
        let found = self.blocks.len() as u64 + 1;
        let remedy = "bake the colours of the vertices into a texture, or decimate the mesh";
        SceneError::check_limit(
            "the number of triangles with colours of their own",
            found,
            self.most,
            remedy,
        )?;
        let block = self.blocks.len() as u32;
        self.blocks.push(corners);
        self.known.insert(corners, block);
        Ok(block)
    }

    /// Says what is left out.
    pub(super) fn warn(&self, warnings: &mut Vec<String>) {
        if self.ignored > 0 {
            warnings.push(format!(
                "colours of vertices are ignored on {} primitives, whose materials have textures",
                self.ignored
            ));
        }
    }

    /// Adds the texture and the painted materials.
    pub(super) fn add_to(self, look: &mut Look) {
        if self.blocks.is_empty() {
            return;
        }
        let (width, height) = self.sides();
        let made = TextureRef {
            texture: look.textures.len() as u32,
            offset: Vec2::ZERO,
            rotation: 0.0,
            scale: Vec2::new(1.0 / width as f32, 1.0 / height as f32),
        };
        look.textures.push(self.texture());
        let mut pairs: Vec<(u32, u32)> = self.materials.into_iter().collect();
        pairs.sort_unstable_by_key(|(_, painted)| *painted);
        for (plain, _) in pairs {
            let mut material = look.materials[plain as usize].clone();
            if material.unlit {
                material.emissive_texture = Some(made);
            } else {
                material.base_color_texture = Some(made);
            }
            look.materials.push(material);
        }
    }

    fn sides(&self) -> (u32, u32) {
        let blocks = self.blocks.len() as u32;
        (2 * blocks.min(PER_ROW), 2 * blocks.div_ceil(PER_ROW))
    }

    fn texture(&self) -> Texture {
        let (width, height) = self.sides();
        let mut texels = vec![[0, 0, 0, 255]; width as usize * height as usize];
        for (block, [a, b, c]) in self.blocks.iter().enumerate() {
            let at = (block as u32 / PER_ROW * 2 * width + block as u32 % PER_ROW * 2) as usize;
            let fourth: [u8; 3] =
                std::array::from_fn(|k| encoded(decoded(b[k]) + decoded(c[k]) - decoded(a[k])));
            let below = at + width as usize;
            for (place, [red, green, blue]) in [(at, *a), (at + 1, *b), (below, *c), (below + 1, fourth)] {
                texels[place] = [red, green, blue, 255];
            }
        }
        Texture {
            wrap_u: Wrap::Clamp,
            wrap_v: Wrap::Clamp,
            of_vertices: true,
            ..Texture::repeated([width, height], texels, true)
        }
    }
}

fn encoded(linear: f32) -> u8 {
    let light = if linear.is_finite() { linear.clamp(0.0, 1.0) } else { 0.0 };
    (from_linear(light) * 255.0).round() as u8
}

fn decoded(value: u8) -> f32 {
    to_linear(f32::from(value) / 255.0)
}
