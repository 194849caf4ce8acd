//! Decodes images in KTX2, the container of the extension KHR_texture_basisu, to texels of 8-bit RGBA.
//!
//! The extension allows what Basis Universal has compressed: ETC1S and UASTC ([`basis`]). Files by others also hold
//! blocks as graphics cards take them ([`blocks`], [`etc`]) and plain texels ([`plain`]). Mipmaps are left out: level 0
//! is the picture, and the renderer averages by samples. Every size is checked before memory of that size is taken.

mod basis;
mod blocks;
mod container;
mod etc;
pub(super) mod numbers;
mod plain;

use std::borrow::Cow;
use std::io::Read;

use container::File;
use flate2::bufread::ZlibDecoder;
use ktx2::{ColorModel, Format, Header, SupercompressionScheme, TransferFunction};
use numbers::Rounder;
use ruzstd::decoding::FrameDecoder;
use serde_json::{json, Value};

use super::super::{Limits, SceneError};
use super::json::{shorten, Item};
use super::picture::{check_decoded, check_size, Picture, Size};

/// The extension, at textures.
pub(super) const BASISU: &str = "KHR_texture_basisu";
/// The extension by which a texture names an image in WebP.
pub(super) const WEBP: &str = "EXT_texture_webp";

/// What to do about an image that cannot be shown.
const REMEDY: &str = "encode it as ETC1S or UASTC, or export PNG or JPEG textures";

/// A stored byte of a Zstandard stream stands for at most so many: a block of 3 bytes and more makes up to 128 KiB.
const MOST_FROM_A_BYTE: usize = 1 << 16;

/// A stored byte of a ZLIB stream stands for at most so many: two bits repeat up to 258.
const MOST_FROM_A_BYTE_OF_ZLIB: usize = 4 * 258;

/// A Zstandard stream may ask for a window of so many bytes, whatever the size of its content. Every decoder has to
/// allow that much by the format's own advice.
const WINDOW_FOR_ALL: u64 = 8 << 20;

/// Rewrites every texture with the extension as a plain one that shows the extension's image, also where there is
/// another image for programs that do not know the extension.
///
/// # Errors
/// Lists that are none, or are longer than the limits allow.
pub(super) fn make_plain(tree: &mut Value, limits: &Limits) -> Result<(), SceneError> {
    let root = Item::new(tree, "document".into())?;
    let images = root.list("images", "image", limits.objects)?.len();
    let mut sources = vec![];
    for (i, texture) in root.list("textures", "texture", limits.objects)?.iter().enumerate() {
        if let Some(extension) = texture.extension(BASISU)? {
            if let Some(source) = extension.index("source", images, "image")? {
                sources.push((i, source));
            }
        } else if let Some(extension) = texture.extension(WEBP)?.filter(|_| texture.get("source").is_none()) {
            // An image for all programs is taken where there is one.
            sources.extend(extension.index("source", images, "image")?.map(|source| (i, source)));
        }
    }
    for (texture, source) in sources {
        tree["textures"][texture]["source"] = json!(source);
    }
    Ok(())
}

/// True if `bytes` begin as KTX2 does.
pub(super) fn is_ktx2(bytes: &[u8]) -> bool {
    bytes.starts_with(&ktx2::MAGIC)
}

/// The texels of level 0 of a KTX2 image. `texels_so_far` counts those of the scene's other textures.
///
/// # Errors
/// An image that contradicts its format, is beyond the limits, or holds something else than one flat picture of a
/// format that is known here. The text names `item` and what to do.
pub(super) fn decode(
    item: &Item,
    bytes: &[u8],
    texels_so_far: u64,
    limits: &Limits,
) -> Result<Picture, SceneError> {
    let file = File::of(bytes)
        .ok_or_else(|| item.error("is a KTX2 image that is cut off or damaged: export it again"))?;
    let header = file.header;
    check_shape(item, &header)?;
    let size = Size { width: header.pixel_width, height: header.pixel_height };
    check_size(item, size, texels_so_far, limits)?;
    check_decoded(item, bytes, 4 * size.texels() as u64, limits)?;
    check_meaning(item, &file)?;
    let content = Content { item, file: &file, size };
    let mut stored = match (header.format, file.descriptor.model) {
        (None, Some(ColorModel::ETC1S)) => StoredTexels::of_bytes(basis::etc1s(&content)?),
        (None, Some(ColorModel::UASTC)) => StoredTexels::of_bytes(basis::uastc(&content)?),
        (None, model) => return Err(content.unsupported(&format!("of the colour model {model:?}"))),
        (Some(format), _) => StoredTexels::of(&content, format)?,
    };
    let order = file.note("KTXswizzle");
    if let Some(order) = order.as_deref().filter(|order| *order != "rgba") {
        swizzle(item, order, &mut stored.texels)?;
    }
    let as_stored = matches!(order.as_deref(), None | Some("rgba" | "rg01"));
    let srgb = match file.descriptor.transfer {
        Some(TransferFunction::SRGB) => Some(true),
        Some(TransferFunction::Linear) => Some(false),
        _ => None,
    };
    Ok(Picture {
        size,
        texels: stored.texels,
        srgb,
        red_green_only: stored.channels == 2 && as_stored,
        cut_off: stored.cut_off,
        stored: None,
        notes: vec![],
    })
}

/// What an image stores, as texels.
struct StoredTexels {
    texels: Vec<[u8; 4]>,
    /// Channels, 1 to 4, beginning with red.
    channels: usize,
    /// Some numbers lie beyond those of a texture.
    cut_off: bool,
}

impl StoredTexels {
    /// Texels of three or four channels that are bytes already.
    fn of_bytes(texels: Vec<[u8; 4]>) -> Self {
        Self { texels, channels: 4, cut_off: false }
    }

    /// The texels of a format that Vulkan has a name for.
    fn of(content: &Content, format: Format) -> Result<Self, SceneError> {
        let mut rounder = Rounder::default();
        let (texels, channels) = if let Some(layout) = plain::Layout::of(format) {
            (layout.texels(content, &mut rounder)?, layout.channels)
        } else if let Some(block) = blocks::Block::of(format) {
            (block.texels(content, &mut rounder)?, block.channels)
        } else if blocks::is_astc(format) {
            (basis::astc(content, format)?, 4)
        } else {
            return Err(content.unsupported(&format!("in {format:?}")));
        };
        Ok(Self { texels, channels, cut_off: rounder.cut_off })
    }
}

/// Refuses what is not one flat picture.
fn check_shape(item: &Item, header: &Header) -> Result<(), SceneError> {
    let flat = header.pixel_height > 0 && header.pixel_depth == 0;
    if flat && header.layer_count <= 1 && header.face_count == 1 {
        return Ok(());
    }
    Err(SceneError::unsupported(
        format!("{}: a KTX2 image that is a volume, an array or a cube map", item.name),
        "export one flat picture",
    ))
}

/// Refuses what glTF forbids and what would change the picture: another orientation, and colours that are multiplied by
/// alpha.
fn check_meaning(item: &Item, file: &File) -> Result<(), SceneError> {
    if let Some(orientation) = file.note("KTXorientation").filter(|o| o != "rd") {
        return Err(item.error(format!(
            "says that its KTXorientation is '{}'; glTF allows only 'rd': export it again",
            shorten(&orientation)
        )));
    }
    if file.descriptor.premultiplied {
        return Err(item.error("holds colours multiplied by alpha: export it with straight alpha"));
    }
    Ok(())
}

/// Puts the channels where the image's KTXswizzle wants them. glTF forbids one, but encoders leave 'rrr1' at grey images.
fn swizzle(item: &Item, order: &str, texels: &mut [[u8; 4]]) -> Result<(), SceneError> {
    // The channels of a texel, and behind them the constants.
    let sources: Option<Vec<usize>> = order.chars().map(|c| "rgba01".find(c)).collect();
    let Some(&[r, g, b, a]) = sources.as_deref().and_then(<[usize]>::as_array) else {
        return Err(item.error(format!(
            "says that its KTXswizzle is '{}', which is none: export it again",
            shorten(order)
        )));
    };
    for texel in texels {
        let [red, green, blue, alpha] = *texel;
        *texel = [r, g, b, a].map(|k| [red, green, blue, alpha, 0, 255][k]);
    }
    Ok(())
}

/// Level 0 of an image, and what errors call it.
struct Content<'a> {
    item: &'a Item<'a>,
    file: &'a File<'a>,
    size: Size,
}

impl Content<'_> {
    fn unsupported(&self, what: &str) -> SceneError {
        SceneError::unsupported(format!("{}: a KTX2 image {what}", self.item.name), REMEDY)
    }

    /// The first `needed` bytes of the level, without supercompression.
    fn bytes(&self, needed: usize) -> Result<Cow<'_, [u8]>, SceneError> {
        let cut_off = |there: usize| {
            self.item.error(format!(
                "holds {there} bytes of texels, but its size asks for {needed}: the data is cut off"
            ))
        };
        let data = self.file.level;
        match self.file.header.supercompression_scheme {
            None => data.get(..needed).map(Cow::Borrowed).ok_or_else(|| cut_off(data.len())),
            Some(SupercompressionScheme::Zstandard) => {
                if needed / MOST_FROM_A_BYTE > data.len() {
                    return Err(cut_off(data.len()));
                }
                let mut plain = vec![0; needed];
                let mut decoder = FrameDecoder::new();
                decoder.set_max_window_size((needed as u64).next_power_of_two().max(WINDOW_FOR_ALL));
                let length = decoder
                    .decode_all(data, &mut plain)
                    .map_err(|e| self.item.error(format!("cannot be decompressed: {e}")))?;
                if length < needed {
                    return Err(cut_off(length));
                }
                Ok(Cow::Owned(plain))
            }
            Some(SupercompressionScheme::ZLIB) => {
                if needed / MOST_FROM_A_BYTE_OF_ZLIB > data.len() {
                    return Err(cut_off(data.len()));
                }
                self.inflated(data, needed).map(Cow::Owned)
            }
            Some(other) => Err(self.unsupported(&format!("with supercompression {other:?}"))),
        }
    }

    /// A ZLIB stream of `needed` bytes and no more.
    fn inflated(&self, data: &[u8], needed: usize) -> Result<Vec<u8>, SceneError> {
        let failed = |e: std::io::Error| self.item.error(format!("cannot be decompressed: {e}"));
        let mut decoder = ZlibDecoder::new(data);
        let mut plain = vec![0; needed];
        decoder.read_exact(&mut plain).map_err(failed)?;
        // Only the end of the stream tells whether its sum is right.
        match decoder.read(&mut [0]).map_err(failed)? {
            0 => Ok(plain),
            _ => Err(self
                .item
                .error(format!("holds more than the {needed} bytes of texels of its size: export it again"))),
        }
    }
}
