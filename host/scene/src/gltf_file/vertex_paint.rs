//! Colours of vertices as a texture, so that surfaces have one kind of colour. Beside other textures `bake.rs` samples them.
//!
//! Each triangle gets 2 x 2 texels, and its corners lie in the centres of three of them. The fourth is what makes bilinear
//! interpolation linear on the triangle (`b + c - a`), up to the 8 bits of a texel and to values outside 0..1.

use std::collections::HashMap;

use glam::{Vec2, Vec3};

use super::super::srgb::{from_linear, to_linear};
use super::super::{Limits, SceneError, Texture, TextureRef, Wrap};
use super::bake::{Bake, Vertices};
use super::look::SceneLook;

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
    /// Materials of the file that have a texture, which is sampled anew.
    is_textured: Vec<bool>,
    bake: Bake,
    /// Most triangles that fit into the limits.
    most: u64,
}

impl Paint {
    /// For the materials of a file.
    pub(super) fn new(look: &SceneLook, limits: &Limits) -> Self {
        let texels: u64 = look.textures.iter().map(|t| u64::from(t.width) * u64::from(t.height)).sum();
        let rows = u64::from(limits.texture_side / 2);
        let most = (limits.texels.saturating_sub(texels) / 4).min(rows * u64::from(PER_ROW));
        let is_textured = look.materials.iter().map(|m| m.textures().any(|t| t.is_some())).collect();
        Self { is_textured, most, ..Self::default() }
    }

    /// Paints faces whose vertices have linear colours, and those whose material has textures on several sets of coordinates.
    /// `None`: they stay as they are. `primitive` names what the vertices are of.
    ///
    /// # Errors
    /// More colours than a texture holds.
    pub(super) fn faces(
        &mut self,
        look: &SceneLook,
        (primitive, faces): (usize, &[[u64; 3]]),
        material: u32,
        vertices: &Vertices,
    ) -> Result<Option<Painted>, SceneError> {
        let white = |colour: &dyn Fn(u64) -> Vec3| {
            faces.as_flattened().iter().all(|i| colour(*i).min_element() > 0.999)
        };
        let colour = vertices.colour.filter(|colour| !white(colour));
        let next = (self.is_textured.len() + self.materials.len() + self.bake.materials()) as u32;
        let is_textured = self.is_textured[material as usize];
        if is_textured && (colour.is_some() || look.has_several_sets(material)) {
            let vertices = Vertices { uv: vertices.uv, colour };
            return self.bake.faces(look, (material, next), (primitive, faces), &vertices).map(Some);
        }
        let Some(colour) = colour else { return Ok(None) };
        let mut uvs = Vec::with_capacity(3 * faces.len());
        for face in faces {
            let block = self.block(face.map(|i| colour(i).to_array().map(encoded)))?;
            let corner = Vec2::new((block % PER_ROW * 2) as f32, (block / PER_ROW * 2) as f32);
            uvs.extend([Vec2::new(0.5, 0.5), Vec2::new(1.5, 0.5), Vec2::new(0.5, 1.5)].map(|at| corner + at));
        }
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

    /// Says what is sampled anew.
    pub(super) fn warn(&self, look: &SceneLook, warnings: &mut Vec<String>) {
        self.bake.warn(look, warnings);
    }

    /// Adds the textures and the painted materials.
    pub(super) fn add_to(mut self, look: &mut SceneLook) {
        let mut made = std::mem::take(&mut self.bake).into_materials(look);
        if !self.blocks.is_empty() {
            let (width, height) = self.sides();
            let reference = TextureRef {
                texture: look.textures.len() as u32,
                offset: Vec2::ZERO,
                rotation: 0.0,
                scale: Vec2::new(1.0 / width as f32, 1.0 / height as f32),
            };
            look.textures.push(self.texture());
            made.extend(self.materials.iter().map(|(plain, painted)| {
                let mut material = look.materials[*plain as usize].clone();
                if material.unlit {
                    material.emissive_texture = Some(reference);
                } else {
                    material.base_color_texture = Some(reference);
                }
                (*painted, material)
            }));
        }
        made.sort_by_key(|(number, _)| *number);
        look.materials.extend(made.into_iter().map(|(_, material)| material));
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
