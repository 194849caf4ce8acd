//! Decodes images in KTX2, the container of glTF's extension KHR_texture_basisu, to texels of 8-bit RGBA.
//!
//! The extension allows what Basis Universal has compressed: ETC1S and UASTC ([`basis`]). Files by others also hold
//! blocks as graphics cards take them ([`blocks`], [`etc`]) and plain texels ([`plain`]). Mipmaps are left out: level 0
//! is the picture, and the renderer averages by samples. Every size is checked before memory of that size is taken.

mod basis;
mod blocks;
mod container;
mod etc;
mod numbers;
mod plain;

use std::borrow::Cow;
use std::io::Read;

use container::File;
use dpm_common::rounding::Rounder;
use flate2::bufread::ZlibDecoder;
use ktx2::{ColorModel, Format, Header, SupercompressionScheme, TransferFunction};
use ruzstd::decoding::FrameDecoder;

/// What to do about an image that cannot be shown.
const REMEDY: &str = "encode it as ETC1S or UASTC, or export PNG or JPEG textures";

/// A stored byte of a Zstandard stream stands for at most so many: a block of 3 bytes and more makes up to 128 KiB.
const MOST_FROM_A_BYTE: usize = 1 << 16;

/// A stored byte of a ZLIB stream stands for at most so many: two bits repeat up to 258.
const MOST_FROM_A_BYTE_OF_ZLIB: usize = 4 * 258;

/// A Zstandard stream may ask for a window of so many bytes, whatever the size of its content. Every decoder has to
/// allow that much by the format's own advice.
const WINDOW_FOR_ALL: u64 = 8 << 20;

/// Why an image cannot be shown, as the end of a sentence that begins with its name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ktx2Error {
    /// The file contradicts its format.
    Damaged(String),
    /// The image is of a kind that is not shown here.
    Unsupported {
        /// What it is.
        what: String,
        /// What to do.
        remedy: &'static str,
    },
}

fn damaged(why: impl Into<String>) -> Ktx2Error {
    Ktx2Error::Damaged(why.into())
}

/// The texels of an image.
#[derive(Clone, Debug)]
pub struct Texels {
    /// Red, green, blue and alpha, row by row from the top.
    pub texels: Vec<[u8; 4]>,
    /// Whether the numbers are encoded as in sRGB, if the file says it.
    pub srgb: Option<bool>,
    /// Only red and green are stored, in their own places.
    pub red_green_only: bool,
    /// Some numbers lie beyond those of a texture.
    pub cut_off: bool,
}

/// An image of one flat picture.
pub struct Image<'a> {
    file: File<'a>,
}

impl<'a> Image<'a> {
    /// Reads the head of `bytes`. No memory is taken.
    ///
    /// # Errors
    /// A file that is cut off or damaged, or holds something else than one flat picture.
    pub fn open(bytes: &'a [u8]) -> Result<Self, Ktx2Error> {
        let file = File::of(bytes)
            .ok_or_else(|| damaged("is a KTX2 image that is cut off or damaged: export it again"))?;
        check_shape(&file.header)?;
        Ok(Self { file })
    }

    /// Texels in a row, and rows.
    pub fn sides(&self) -> [u32; 2] {
        [self.file.header.pixel_width, self.file.header.pixel_height]
    }

    /// The texels of level 0. They take four bytes each, and what the file stores may take as much again: check
    /// [`Self::sides`] first.
    ///
    /// # Errors
    /// An image that contradicts its format or is of a format that is not known here.
    pub fn texels(&self) -> Result<Texels, Ktx2Error> {
        let file = &self.file;
        check_meaning(file)?;
        let [width, height] = self.sides();
        let content = LevelContent { file, size: Size { width, height } };
        let mut stored = match (file.header.format, file.descriptor.model) {
            (None, Some(ColorModel::ETC1S)) => StoredTexels::of_bytes(basis::etc1s(&content)?),
            (None, Some(ColorModel::UASTC)) => StoredTexels::of_bytes(basis::uastc(&content)?),
            (None, model) => return Err(unsupported(format!("of the colour model {model:?}"))),
            (Some(format), _) => StoredTexels::of(&content, format)?,
        };
        let order = file.note("KTXswizzle");
        if let Some(order) = order.as_deref().filter(|order| *order != "rgba") {
            swizzle(order, &mut stored.texels)?;
        }
        let as_stored = matches!(order.as_deref(), None | Some("rgba" | "rg01"));
        let srgb = match file.descriptor.transfer {
            Some(TransferFunction::SRGB) => Some(true),
            Some(TransferFunction::Linear) => Some(false),
            _ => None,
        };
        Ok(Texels {
            texels: stored.texels,
            srgb,
            red_green_only: stored.channels == 2 && as_stored,
            cut_off: stored.cut_off,
        })
    }
}

fn unsupported(what: impl AsRef<str>) -> Ktx2Error {
    Ktx2Error::Unsupported { what: format!("a KTX2 image {}", what.as_ref()), remedy: REMEDY }
}

/// Texels along the sides of a picture, each above 0.
#[derive(Clone, Copy)]
struct Size {
    width: u32,
    height: u32,
}

impl Size {
    fn texels(self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// At most 60 characters of a text by others, without control characters, for a message.
fn shorten(text: &str) -> String {
    let mut out: String = text.chars().take(60).map(|c| if c.is_control() { '?' } else { c }).collect();
    if text.chars().nth(60).is_some() {
        out.push_str("...");
    }
    out
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
    fn of(content: &LevelContent, format: Format) -> Result<Self, Ktx2Error> {
        let mut rounder = Rounder::default();
        let (texels, channels) = if let Some(layout) = plain::TexelLayout::of(format) {
            (layout.texels(content, &mut rounder)?, layout.channels)
        } else if let Some(block) = blocks::BlockFormat::of(format) {
            (block.texels(content, &mut rounder)?, block.channels)
        } else if blocks::is_astc(format) {
            (basis::astc(content, format)?, 4)
        } else {
            return Err(unsupported(format!("in {format:?}")));
        };
        Ok(Self { texels, channels, cut_off: rounder.cut_off })
    }
}

/// Refuses what is not one flat picture.
fn check_shape(header: &Header) -> Result<(), Ktx2Error> {
    let flat = header.pixel_height > 0 && header.pixel_depth == 0;
    if flat && header.layer_count <= 1 && header.face_count == 1 {
        return Ok(());
    }
    Err(Ktx2Error::Unsupported {
        what: "a KTX2 image that is a volume, an array or a cube map".into(),
        remedy: "export one flat picture",
    })
}

/// Refuses what glTF forbids and what would change the picture: another orientation, and colours that are multiplied by
/// alpha.
fn check_meaning(file: &File) -> Result<(), Ktx2Error> {
    if let Some(orientation) = file.note("KTXorientation").filter(|o| o != "rd") {
        return Err(damaged(format!(
            "says that its KTXorientation is '{}'; glTF allows only 'rd': export it again",
            shorten(&orientation)
        )));
    }
    if file.descriptor.premultiplied {
        return Err(damaged("holds colours multiplied by alpha: export it with straight alpha"));
    }
    Ok(())
}

/// Puts the channels where the image's KTXswizzle wants them. glTF forbids one, but encoders leave 'rrr1' at grey images.
fn swizzle(order: &str, texels: &mut [[u8; 4]]) -> Result<(), Ktx2Error> {
    // The channels of a texel, and behind them the constants.
    let sources: Option<Vec<usize>> = order.chars().map(|c| "rgba01".find(c)).collect();
    let Some(&[r, g, b, a]) = sources.as_deref().and_then(<[usize]>::as_array) else {
        return Err(damaged(format!(
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
struct LevelContent<'a> {
    file: &'a File<'a>,
    size: Size,
}

impl LevelContent<'_> {
    /// The first `needed` bytes of the level, without supercompression.
    fn bytes(&self, needed: usize) -> Result<Cow<'_, [u8]>, Ktx2Error> {
        let cut_off = |there: usize| {
            damaged(format!(
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
                    .map_err(|e| damaged(format!("cannot be decompressed: {e}")))?;
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
            Some(other) => Err(unsupported(format!("with supercompression {other:?}"))),
        }
    }

    /// A ZLIB stream of `needed` bytes and no more.
    fn inflated(&self, data: &[u8], needed: usize) -> Result<Vec<u8>, Ktx2Error> {
        let failed = |e: std::io::Error| damaged(format!("cannot be decompressed: {e}"));
        let mut decoder = ZlibDecoder::new(data);
        let mut plain = vec![0; needed];
        decoder.read_exact(&mut plain).map_err(failed)?;
        // Only the end of the stream tells whether its sum is right.
        match decoder.read(&mut [0]).map_err(failed)? {
            0 => Ok(plain),
            _ => Err(damaged(format!(
                "holds more than the {needed} bytes of texels of its size: export it again"
            ))),
        }
    }
}
