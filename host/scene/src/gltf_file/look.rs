//! Converts checked glTF materials, textures and images to [`Material`] and [`Texture`].

use std::collections::HashMap;

use glam::{Vec2, Vec3};

use super::super::limits::Cancel;
use super::super::{Limits, Material, SceneError, Texture, TextureRef, Wrap};
use super::accessor::Data;
use super::bake::NORMALS;
use super::container::{fetch, SideFolder};
use super::json::Item;
use super::lobes::read_lobes;
use super::picture::{self, Size, TexturePicture};

/// The result of [`read_look`].
pub(super) struct SceneLook {
    /// One for each material of the file, followed by glTF's default material.
    pub materials: Vec<Material>,
    /// For each material the sets of texture coordinates of its textures, in the order of [`Material::textures`]; 0 where there is none.
    pub sets: Vec<Vec<u32>>,
    /// Decoded images.
    pub textures: Vec<Texture>,
}

/// Reads all materials of a checked document and decodes the images they use.
pub(crate) fn read_look(
    document: &gltf::Document,
    root: &Item,
    data: &Data,
    folder: Option<&SideFolder>,
    limits: &Limits,
    cancel: &Cancel,
    warnings: &mut Vec<String>,
) -> Result<SceneLook, SceneError> {
    let mut reader = LookReader {
        document,
        image_items: root.list("images", "image", limits.objects)?,
        data,
        folder,
        limits,
        cancel,
        images: HashMap::new(),
        holders: HashMap::new(),
        known: HashMap::new(),
        textures: vec![],
        texels: 0,
    };
    let raw = root.list("materials", "material", limits.objects)?;
    let (mut materials, mut sets) = (vec![], vec![]);
    for (material, raw) in document.materials().zip(&raw) {
        let (look, of_look) = reader.material(&material, raw, warnings)?;
        materials.push(look);
        sets.push(of_look);
    }
    materials.push(Material::default());
    sets.push(vec![]);
    Ok(SceneLook { materials, sets, textures: reader.textures })
}

/// KHR_materials_unlit: the base colour is what the surface sends out, whatever falls on it. It reflects nothing, and nothing else
/// of the material counts but what is cut out of it, and whether it has a back.
fn unlit(material: Material) -> Material {
    Material {
        emissive: material.base_color,
        emissive_texture: material.base_color_texture,
        base_color: Vec3::ZERO,
        // Its alpha cuts.
        base_color_texture: material
            .base_color_texture
            .filter(|_| material.alpha_cutoff.is_some() || material.alpha_blend),
        metallic: 0.0,
        roughness: 1.0,
        // Without a coat.
        ior: 1.0,
        name: material.name,
        alpha: material.alpha,
        alpha_cutoff: material.alpha_cutoff,
        alpha_blend: material.alpha_blend,
        double_sided: material.double_sided,
        unlit: true,
        ..Material::default()
    }
}

struct LookReader<'a> {
    document: &'a gltf::Document,
    image_items: Vec<Item<'a>>,
    data: &'a Data,
    folder: Option<&'a SideFolder>,
    limits: &'a Limits,
    cancel: &'a Cancel,
    /// Decoded images; `None`: one that cannot be read, which is told.
    images: HashMap<usize, Option<TexturePicture>>,
    /// Image to index in `textures`: the first texture of an image takes its texels, so that no picture is held twice.
    holders: HashMap<usize, usize>,
    /// (image, sampler, sRGB, with heights) to index in `textures`: textures of a file may differ in their names alone.
    known: HashMap<(usize, Option<usize>, bool, bool), u32>,
    textures: Vec<Texture>,
    texels: u64,
}

/// The slot of the texture that tilts a surface.
const NORMAL: &str = "normal";
/// The slot of the texture that tilts a clear coat.
pub(super) const COAT_NORMAL: &str = "clearcoat normal";

/// A texture reference of a material before its image is decoded.
pub(super) struct Use {
    slot: &'static str,
    texture: usize,
    uv_set: u32,
    offset: [f32; 2],
    rotation: f32,
    scale: [f32; 2],
    srgb: bool,
}

impl SceneLook {
    /// The set of a material's coordinates, or that of its map of normals if its textures lie on several.
    pub(super) fn set_of(&self, material: u32) -> u32 {
        let normals = self.used_sets(material).find(|(slot, _)| *slot == NORMALS);
        normals.or_else(|| self.used_sets(material).next()).map_or(0, |(_, set)| set)
    }

    /// The places in [`Material::textures`] that have one, with their sets.
    fn used_sets(&self, material: u32) -> impl Iterator<Item = (usize, u32)> + '_ {
        let sets = &self.sets[material as usize];
        let textures = self.materials[material as usize].textures().enumerate();
        textures
            .filter(|(_, texture)| texture.is_some())
            .map(|(slot, _)| (slot, sets.get(slot).copied().unwrap_or(0)))
    }

    /// Whether the textures of a material lie on several sets.
    pub(super) fn has_several_sets(&self, material: u32) -> bool {
        let first = self.used_sets(material).next();
        self.used_sets(material).any(|used| Some(used.1) != first.map(|f| f.1))
    }
}

impl LookReader<'_> {
    fn material(
        &mut self,
        m: &gltf::Material,
        raw: &Item,
        warnings: &mut Vec<String>,
    ) -> Result<(Material, Vec<u32>), SceneError> {
        let pbr = m.pbr_metallic_roughness();
        let [r, g, b, alpha] = pbr.base_color_factor().map(|x| x.clamp(0.0, 1.0));
        let alpha_cutoff = match m.alpha_mode() {
            gltf::material::AlphaMode::Opaque | gltf::material::AlphaMode::Blend => None,
            gltf::material::AlphaMode::Mask => Some(m.alpha_cutoff().unwrap_or(0.5)),
        };
        let strength = m.emissive_strength().unwrap_or(1.0);
        // In the extension, 0 means "reflects everything"; it occurs in converted files and is not physical.
        let ior = m.ior().filter(|&i| i >= 1.0).unwrap_or(1.5);
        if m.ior() == Some(0.0) {
            warnings.push(format!("{}: ior 0 is read as 1.5", raw.name));
        }
        let thin_walled = m.volume().is_none_or(|v| v.thickness_factor() <= 0.0);
        let (lobes, lobe_uses) = read_lobes(raw, thin_walled)?;
        let mut out = Material {
            name: m.name().map_or_else(|| raw.name.clone(), str::to_owned),
            base_color: Vec3::new(r, g, b),
            alpha_cutoff,
            alpha,
            metallic: pbr.metallic_factor().clamp(0.0, 1.0),
            roughness: pbr.roughness_factor().clamp(0.0, 1.0),
            emissive: Vec3::from(m.emissive_factor()) * strength,
            ior,
            transmission: m.transmission().map_or(0.0, |t| t.transmission_factor().clamp(0.0, 1.0)),
            thin_walled,
            lobes,
            double_sided: m.double_sided(),
            normal_scale: m.normal_texture().map_or(1.0, |n| n.scale()),
            ..Material::default()
        };
        let uses = plain_uses(m, raw)?;
        let all = uses.iter().chain(&lobe_uses);
        let mut sets: Vec<u32> = all.map(|u| u.as_ref().map_or(0, |u| u.uv_set)).collect();
        let mut references = [None; 5];
        for (reference, u) in references.iter_mut().zip(&uses) {
            if let Some(u) = u {
                *reference = self.reference(u, warnings)?;
            }
        }
        [
            out.base_color_texture,
            out.metallic_roughness_texture,
            out.normal_texture,
            out.emissive_texture,
            out.transmission_texture,
        ] = references;
        for (place, u) in out.lobes.textures_mut().into_iter().zip(&lobe_uses) {
            if let Some(u) = u {
                *place = self.reference(u, warnings)?;
            }
        }
        // Exporters write BLEND for much that is opaque everywhere.
        let opaque = |t: TextureRef| self.textures[t.texture as usize].texels.iter().all(|t| t[3] == 255);
        out.alpha_blend = m.alpha_mode() == gltf::material::AlphaMode::Blend
            && !(alpha >= 1.0 && out.base_color_texture.is_none_or(opaque));
        if m.unlit() {
            out = unlit(out);
            sets[3] = sets[0];
        }
        Ok((out, sets))
    }

    /// `None`: its image cannot be read. The shape of a body is worth more than its picture.
    fn reference(&mut self, u: &Use, warnings: &mut Vec<String>) -> Result<Option<TextureRef>, SceneError> {
        let image = self.image(u, warnings)?;
        let Some(Some(picture)) = self.images.get(&image) else { return Ok(None) };
        let heights = [NORMAL, COAT_NORMAL].contains(&u.slot) && picture.red_green_only;
        let sampler = self.document.textures().nth(u.texture).and_then(|t| t.sampler().index());
        let key = (image, sampler, u.srgb, heights);
        let texture = match self.known.get(&key) {
            Some(&known) => known,
            None => {
                let made = self.texture(u, image, heights, warnings)?;
                self.textures.push(made);
                let index = self.textures.len() as u32 - 1;
                self.known.insert(key, index);
                index
            }
        };
        Ok(Some(TextureRef {
            texture,
            offset: Vec2::from(u.offset),
            rotation: u.rotation,
            scale: Vec2::from(u.scale),
        }))
    }

    /// The index of the image of a texture, which is decoded by then.
    fn image(&mut self, u: &Use, warnings: &mut Vec<String>) -> Result<usize, SceneError> {
        let image = self.document.as_json().textures[u.texture].source.value();
        if !self.images.contains_key(&image) {
            self.cancel.check(self.limits)?;
            let decoded = match self.decode(image) {
                Ok(decoded) => Some(decoded),
                Err(e @ SceneError::TimedOut(_)) => return Err(e),
                Err(e) => {
                    warnings.push(format!("the {} texture is left out: {e}", u.slot));
                    None
                }
            };
            if decoded.as_ref().is_some_and(|d| d.cut_off) {
                warnings.push(format!(
                    "{}: it holds numbers outside of 0 to 1, which a texture does not hold: they are cut off there",
                    self.image_items[image].name
                ));
            }
            let notes = decoded.iter().flat_map(|d| &d.notes);
            warnings.extend(notes.map(|note| format!("{}: {note}", self.image_items[image].name)));
            if let Some((kept, stored)) = decoded.as_ref().and_then(|d| Some((d.size, d.stored?))) {
                warnings.push(format!(
                    "{}: it is read with {} x {} of its {} x {} texels, as many as so short a file, or other textures, leave room for",
                    self.image_items[image].name, kept.width, kept.height, stored.width, stored.height
                ));
            }
            self.images.insert(image, decoded);
        }
        Ok(image)
    }

    /// A texture of a decoded image, with `heights` as normals that need their third number.
    fn texture(
        &mut self,
        u: &Use,
        image: usize,
        heights: bool,
        warnings: &mut Vec<String>,
    ) -> Result<Texture, SceneError> {
        let Some(Some(picture)) = self.images.get_mut(&image) else {
            return Err(SceneError::Internal(format!("image {image} was not decoded")));
        };
        let (Size { width, height }, srgb) = (picture.size, picture.srgb);
        if srgb.is_some_and(|srgb| srgb != u.srgb) {
            let (said, used) =
                if u.srgb { ("linear", "colours in sRGB") } else { ("sRGB", "linear numbers") };
            warnings.push(format!(
                "{}: it says that it is {said}, but it is read as {used}, which glTF wants of a {} texture",
                self.image_items[image].name, u.slot
            ));
        }
        self.texels += u64::from(width) * u64::from(height);
        SceneError::check_limit(
            "the number of texels in all textures",
            self.texels,
            self.limits.texels,
            "use smaller textures",
        )?;
        let texels = match self.holders.get(&image) {
            _ if heights => picture.with_heights(),
            // Another texture may need its heights.
            _ if picture.red_green_only => picture.texels.clone(),
            Some(&holder) => self.textures[holder].texels.clone(),
            None => {
                self.holders.insert(image, self.textures.len());
                std::mem::take(&mut picture.texels)
            }
        };
        let texture = self.document.textures().nth(u.texture);
        let sampler = texture.as_ref().map(|t| t.sampler());
        let wrap = |mode: gltf::texture::WrappingMode| match mode {
            gltf::texture::WrappingMode::Repeat => Wrap::Repeat,
            gltf::texture::WrappingMode::ClampToEdge => Wrap::Clamp,
            gltf::texture::WrappingMode::MirroredRepeat => Wrap::Mirror,
        };
        Ok(Texture {
            width,
            height,
            texels,
            srgb: u.srgb,
            wrap_u: sampler.as_ref().map_or(Wrap::Repeat, |s| wrap(s.wrap_s())),
            wrap_v: sampler.as_ref().map_or(Wrap::Repeat, |s| wrap(s.wrap_t())),
            nearest: sampler
                .as_ref()
                .is_some_and(|s| s.mag_filter() == Some(gltf::texture::MagFilter::Nearest)),
            of_vertices: false,
            ends_ns: vec![],
        })
    }

    fn decode(&self, index: usize) -> Result<TexturePicture, SceneError> {
        let Some(item) = self.image_items.get(index) else {
            return Err(SceneError::broken("textures", format!("name image {index}, which is not there")));
        };
        let fetched;
        let bytes = match (item.text("uri")?, item.whole("bufferView")?) {
            (Some(_), Some(_)) => return Err(item.error("must have either a 'uri' or a 'bufferView'")),
            (Some(uri), None) => {
                fetched =
                    fetch(uri, self.folder, self.limits.bytes).map_err(|e| item.error(e.to_string()))?;
                fetched.as_slice()
            }
            (None, Some(view)) => self.data.view_bytes(view as usize).ok_or_else(|| {
                item.error(format!("'bufferView' points at bufferView {view}, which is not there"))
            })?,
            (None, None) => return Err(item.error("has no data")),
        };
        let name = item.text("mimeType")?.or(item.text("uri")?).unwrap_or_default();
        picture::decode(item, bytes, name, self.texels, self.limits)
    }
}

/// The uses of the textures that glTF has without extensions of lobes: base colour, metallic-roughness, normal, emissive and
/// transmission.
fn plain_uses(m: &gltf::Material, raw: &Item) -> Result<[Option<Use>; 5], SceneError> {
    let pbr = m.pbr_metallic_roughness();
    Ok([
        pbr.base_color_texture().map(|i| plain_use("base colour", &i, true)),
        pbr.metallic_roughness_texture().map(|i| plain_use("metallic-roughness", &i, false)),
        // The crate does not provide the transform of a normal texture.
        raw_use(NORMAL, raw, "normalTexture", false)?,
        m.emissive_texture().map(|i| plain_use("emissive", &i, true)),
        m.transmission().and_then(|t| t.transmission_texture()).map(|i| plain_use("transmission", &i, false)),
    ])
}

fn plain_use(slot: &'static str, info: &gltf::texture::Info, srgb: bool) -> Use {
    let transform = info.texture_transform();
    Use {
        slot,
        texture: info.texture().index(),
        uv_set: transform.as_ref().and_then(|t| t.tex_coord()).unwrap_or(info.tex_coord()),
        offset: transform.as_ref().map_or([0.0; 2], |t| t.offset()),
        rotation: transform.as_ref().map_or(0.0, |t| t.rotation()),
        scale: transform.as_ref().map_or([1.0; 2], |t| t.scale()),
        srgb,
    }
}

/// The use of a texture that is at `key`, from the JSON.
pub(super) fn raw_use(
    slot: &'static str,
    owner: &Item,
    key: &str,
    srgb: bool,
) -> Result<Option<Use>, SceneError> {
    let Some(info) = owner.object(key)? else { return Ok(None) };
    let texture = info.whole("index")?.ok_or_else(|| info.error("has no 'index'"))? as usize;
    let uv_set = info.whole("texCoord")?.unwrap_or(0) as u32;
    let mut out = Use { slot, texture, uv_set, offset: [0.0; 2], rotation: 0.0, scale: [1.0; 2], srgb };
    if let Some(t) = info.extension("KHR_texture_transform")? {
        out.offset = t.numbers("offset")?.unwrap_or(out.offset);
        out.scale = t.numbers("scale")?.unwrap_or(out.scale);
        out.rotation = t.number("rotation")?.unwrap_or(0.0);
        out.uv_set = t.whole("texCoord")?.map_or(out.uv_set, |s| s as u32);
    }
    Ok(Some(out))
}
