//! Textures that lie on several sets of coordinates, or beside colours of vertices, as textures on one set.
//!
//! The renderer has one set of coordinates for a surface, and no colours of vertices. Each triangle gets a square of texels of its
//! own, about as many as it has in its finest texture; its corners lie in the centres of three of the square's. All textures of
//! the material are sampled into such squares, and the base colour times the colours of the vertices. Between texels the result
//! is that of the file up to a second interpolation and to the eight bits of a texel.

use std::collections::hash_map::DefaultHasher;
use std::collections::HashMap;
use std::hash::{Hash, Hasher};
use std::sync::OnceLock;

use glam::{Vec2, Vec4};

use super::super::srgb::{from_linear, to_linear};
use super::super::{Material, SceneError, Texture, TextureRef, Wrap};
use super::look::SceneLook;

/// Texels in a row of squares.
const ROW: usize = 2048;
/// Texels along the sides of the smallest and the largest square, as powers of two.
const SIDES: std::ops::RangeInclusive<u32> = 1..=7;
/// Texels of all textures that are made.
const MOST_TEXELS: usize = 1 << 24;

/// The places of base colour and emission in [`Material::textures`].
const BASE: usize = 0;
const EMISSION: usize = 3;
/// That of the map of normals, along whose coordinates tangents lie.
pub(super) const NORMALS: usize = 2;

/// The texture coordinates of a primitive by set and vertex, and its colours.
pub(super) struct Vertices<'a> {
    /// Coordinates of a vertex in a set; zero where the file has none.
    pub uv: &'a dyn Fn(u32, u64) -> Vec2,
    /// Linear colours, if there are some besides white.
    pub colour: Option<&'a dyn Fn(u64) -> glam::Vec3>,
}

/// A texture that is made.
struct Made {
    /// Its place in [`Material::textures`].
    slot: usize,
    /// The reference of the file; `None`: a base colour without a texture.
    source: Option<TextureRef>,
    set: u32,
    srgb: bool,
    /// Colours of vertices multiply it.
    is_coloured: bool,
    texels: Vec<[u8; 4]>,
}

/// What takes the place of one material.
struct BakedMaterial {
    /// Its number.
    material: u32,
    textures: Vec<Made>,
    rows: usize,
    /// For each size of squares the next free place.
    open: HashMap<u32, (usize, usize)>,
    /// The corners of faces that were placed, since a primitive may be read for several instances.
    placed: HashMap<u64, Vec<Vec2>>,
}

/// All of them.
#[derive(Default)]
pub(super) struct Bake {
    baked: HashMap<u32, BakedMaterial>,
    texels: usize,
    is_coarse: bool,
}

impl Bake {
    /// The coordinates of all corners of `faces` on the textures that are made for `material`, whose number is then that of
    /// `next`, if it has none yet. `primitive` names the numbers that the vertices are of.
    ///
    /// # Errors
    /// More texels than one texture may have.
    pub(super) fn faces(
        &mut self,
        look: &SceneLook,
        (material, next): (u32, u32),
        (primitive, faces): (usize, &[[u64; 3]]),
        vertices: &Vertices,
    ) -> Result<(u32, Vec<Vec2>), SceneError> {
        let source = &look.materials[material as usize];
        let sets = &look.sets[material as usize];
        let baked = self.baked.entry(material).or_insert_with(|| BakedMaterial::new(source, sets, next));
        if vertices.colour.is_some() {
            baked.add_coloured(source);
        }
        let mut hasher = DefaultHasher::new();
        (primitive, faces).hash(&mut hasher);
        let key = hasher.finish();
        if let Some(known) = baked.placed.get(&key) {
            return Ok((baked.material, known.clone()));
        }
        let sizes: Vec<u32> = faces.iter().map(|face| baked.size_of(look, *face, vertices)).collect();
        let many = baked.textures.len();
        let room = MOST_TEXELS.saturating_sub(self.texels) / many.max(1);
        let texels = |coarser: u32| -> usize {
            sizes.iter().map(|size| 1usize << (2 * size.saturating_sub(coarser).max(*SIDES.start()))).sum()
        };
        // Squares leave up to a row of each of their sizes unused.
        let coarser = (0..*SIDES.end()).find(|coarser| texels(*coarser) + 128 * ROW * 2 <= room);
        let Some(coarser) = coarser else {
            return Err(SceneError::TooLarge {
                what: "the texels of textures on two sets of coordinates or beside colours of vertices"
                    .into(),
                found: (self.texels + many * texels(*SIDES.end())) as u64,
                limit: MOST_TEXELS as u64,
                remedy: "bake them into one set of coordinates",
            });
        };
        self.is_coarse |= coarser > 0;
        let before = baked.rows;
        let mut uvs = Vec::with_capacity(3 * faces.len());
        for (face, size) in faces.iter().zip(sizes) {
            let size = size.saturating_sub(coarser).max(*SIDES.start());
            let [x, y] = baked.place(size);
            baked.fill(look, *face, vertices, ([x, y], size));
            let (low, high) = (0.5, (1 << size) as f32 - 0.5);
            let corners = [Vec2::new(low, low), Vec2::new(high, low), Vec2::new(low, high)];
            uvs.extend(corners.map(|corner| Vec2::new(x as f32, y as f32) + corner));
        }
        self.texels += many * ROW * (baked.rows - before);
        baked.placed.insert(key, uvs.clone());
        Ok((baked.material, uvs))
    }

    /// How many materials have been made.
    pub(super) fn materials(&self) -> usize {
        self.baked.len()
    }

    /// Says what was resampled.
    pub(super) fn warn(&self, look: &SceneLook, warnings: &mut Vec<String>) {
        let mut names: Vec<&str> =
            self.baked.keys().map(|m| look.materials[*m as usize].name.as_str()).collect();
        names.sort_unstable();
        if let Some(first) = names.first() {
            let more = if names.len() > 1 { format!(" and {} more", names.len() - 1) } else { String::new() };
            let coarse = if self.is_coarse { ", more coarsely than they are" } else { "" };
            warnings.push(format!(
                "material '{first}'{more}: textures on two sets of coordinates or beside colours of vertices are sampled anew \
                 for each triangle{coarse}"
            ));
        }
    }

    /// The materials with their numbers; their textures are added to `textures`.
    pub(super) fn into_materials(self, look: &mut SceneLook) -> Vec<(u32, Material)> {
        let mut all: Vec<(u32, BakedMaterial)> = self.baked.into_iter().collect();
        all.sort_unstable_by_key(|(_, baked)| baked.material);
        let made = |(plain, baked): (u32, BakedMaterial)| {
            let mut material = look.materials[plain as usize].clone();
            let scale = Vec2::new(1.0 / ROW as f32, 1.0 / baked.rows as f32);
            for one in baked.textures {
                let reference = TextureRef {
                    texture: look.textures.len() as u32,
                    offset: Vec2::ZERO,
                    rotation: 0.0,
                    scale,
                };
                if let Some(place) = material.textures_mut().nth(one.slot) {
                    *place = Some(reference);
                }
                look.textures.push(Texture {
                    wrap_u: Wrap::Clamp,
                    wrap_v: Wrap::Clamp,
                    of_vertices: true,
                    ..Texture::repeated([ROW as u32, baked.rows as u32], one.texels, one.srgb)
                });
            }
            (baked.material, material)
        };
        all.into_iter().map(made).collect()
    }
}

impl BakedMaterial {
    fn new(source: &Material, sets: &[u32], material: u32) -> Self {
        let textures = source.textures().enumerate().filter_map(|(slot, reference)| {
            let set = sets.get(slot).copied().unwrap_or(0);
            let is_coloured = slot == coloured(source);
            reference.map(|r| Made { slot, source: Some(r), set, srgb: false, is_coloured, texels: vec![] })
        });
        Self { material, textures: textures.collect(), rows: 0, open: HashMap::new(), placed: HashMap::new() }
    }

    /// The place that colours of vertices multiply has a texture, even if the file has none there.
    fn add_coloured(&mut self, source: &Material) {
        let slot = coloured(source);
        if !self.textures.iter().any(|made| made.slot == slot) {
            let texels = vec![[255; 4]; ROW * self.rows];
            self.textures.push(Made { slot, source: None, set: 0, srgb: true, is_coloured: true, texels });
        }
    }

    /// The power of two of texels along the sides of a triangle's square.
    fn size_of(&self, look: &SceneLook, face: [u64; 3], vertices: &Vertices) -> u32 {
        let longest = |made: &Made| {
            let Some(reference) = made.source else { return 1.0 };
            let texture = &look.textures[reference.texture as usize];
            let size = Vec2::new(texture.width as f32, texture.height as f32);
            let [a, b, c] = face.map(|i| reference.apply((vertices.uv)(made.set, i)) * size);
            (b - a).length().max((c - a).length()).max((c - b).length())
        };
        let longest = self.textures.iter().map(longest).fold(1.0, f32::max);
        let texels = if longest.is_finite() { (longest + 1.0).min(1e6) as u32 } else { 1 };
        texels.next_power_of_two().trailing_zeros().clamp(*SIDES.start(), *SIDES.end())
    }

    /// The corner of a free square.
    fn place(&mut self, size: u32) -> [usize; 2] {
        let side = 1usize << size;
        let rows = &mut self.rows;
        let open = self.open.entry(size).or_insert((ROW, 0));
        if open.0 + side > ROW {
            *open = (0, *rows);
            *rows += side;
        }
        let at = [open.0, open.1];
        open.0 += side;
        at
    }

    /// Samples all textures into a square.
    fn fill(
        &mut self,
        look: &SceneLook,
        face: [u64; 3],
        vertices: &Vertices,
        ([left, top], size): ([usize; 2], u32),
    ) {
        let side = 1usize << size;
        let step = 1.0 / (side - 1) as f32;
        for made in &mut self.textures {
            made.texels.resize(ROW * self.rows, [0, 0, 0, 255]);
            let texture = made.source.map(|r| (r, &look.textures[r.texture as usize]));
            let srgb = texture.map_or(made.srgb, |(_, texture)| texture.srgb);
            made.srgb = srgb;
            let corners = texture.map(|(r, _)| face.map(|i| r.apply((vertices.uv)(made.set, i))));
            let colours = vertices.colour.filter(|_| made.is_coloured).map(|colour| face.map(colour));
            for y in 0..side {
                for x in 0..side {
                    let (b, c) = (x as f32 * step, y as f32 * step);
                    let mut value = match (texture, corners) {
                        (Some((_, texture)), Some([p, q, r])) => {
                            sample(texture, p + (q - p) * b + (r - p) * c)
                        }
                        _ => Vec4::ONE,
                    };
                    if let Some([p, q, r]) = colours {
                        let colour = (p + (q - p) * b + (r - p) * c).max(glam::Vec3::ZERO);
                        value = (value.truncate() * colour).extend(value.w);
                    }
                    made.texels[(top + y) * ROW + left + x] = encoded(value, srgb);
                }
            }
        }
    }
}

/// The place in [`Material::textures`] that colours of vertices multiply.
fn coloured(material: &Material) -> usize {
    if material.unlit {
        EMISSION
    } else {
        BASE
    }
}

/// The texture at a place, as the renderer samples it: linear.
fn sample(texture: &Texture, uv: Vec2) -> Vec4 {
    let size = Vec2::new(texture.width as f32, texture.height as f32);
    let at = (uv * size).clamp(Vec2::splat(-1e6), Vec2::splat(1e6));
    let texel = |x: i64, y: i64| {
        let x = wrapped(x, texture.width, texture.wrap_u);
        let y = wrapped(y, texture.height, texture.wrap_v);
        let [r, g, b, a] = texture.texels[y * texture.width as usize + x];
        let light = if texture.srgb { linear() } else { plain() };
        let [r, g, b] = [r, g, b].map(|code| light[usize::from(code)]);
        let a = f32::from(a) / 255.0;
        Vec4::new(r, g, b, a)
    };
    if texture.nearest {
        return texel(at.x.floor() as i64, at.y.floor() as i64);
    }
    let at = at - 0.5;
    let (x, y) = (at.x.floor(), at.y.floor());
    let (right, down) = (at.x - x, at.y - y);
    let (x, y) = (x as i64, y as i64);
    texel(x, y).lerp(texel(x + 1, y), right).lerp(texel(x, y + 1).lerp(texel(x + 1, y + 1), right), down)
}

/// The light of all codes of sRGB.
fn linear() -> &'static [f32; 256] {
    static TABLE: OnceLock<[f32; 256]> = OnceLock::new();
    TABLE.get_or_init(|| std::array::from_fn(|code| to_linear(code as f32 / 255.0)))
}

/// The numbers of all codes of what is no colour.
fn plain() -> &'static [f32; 256] {
    static TABLE: OnceLock<[f32; 256]> = OnceLock::new();
    TABLE.get_or_init(|| std::array::from_fn(|code| code as f32 / 255.0))
}

fn wrapped(at: i64, size: u32, wrap: Wrap) -> usize {
    let size = i64::from(size);
    let at = match wrap {
        Wrap::Repeat => at.rem_euclid(size),
        Wrap::Clamp => at.clamp(0, size - 1),
        Wrap::Mirror => {
            let at = at.rem_euclid(2 * size);
            at.min(2 * size - 1 - at)
        }
    };
    at as usize
}

fn encoded(value: Vec4, srgb: bool) -> [u8; 4] {
    let code = |x: f32| (x.clamp(0.0, 1.0) * 255.0).round() as u8;
    let of = |x: f32| if srgb { code(from_linear(x.clamp(0.0, 1.0))) } else { code(x) };
    [of(value.x), of(value.y), of(value.z), code(value.w)]
}
