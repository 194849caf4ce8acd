//! Decodes an image of a scene, PNG, JPEG, KTX2, WebP, TIFF, BMP or TGA, to 8-bit RGBA; checks its size before anything of that size is
//! taken.

use std::io::Cursor;

use dpm_common::rounding::Rounder;
#[cfg(feature = "compressed")]
use dpm_ktx2::{Ktx2Error, Texels};
use image::{ImageFormat, ImageReader};

use super::super::limits::{largest_piece, of_header, of_picture};
use super::super::{Limits, SceneError};
use super::bmp;
use super::json::Item;
use crate::jpeg_picture::JpegFrame;
use crate::tiff_picture::{is_tiff, Tiff};

/// The first bytes of every file in KTX2.
const KTX2_MAGIC: [u8; 12] = *b"\xabKTX 20\xbb\r\n\x1a\n";

/// Texels along the sides of a picture, each above 0.
#[derive(Clone, Copy)]
pub(super) struct Size {
    /// Texels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Size {
    /// All texels.
    pub(super) fn texels(self) -> usize {
        self.width as usize * self.height as usize
    }

    fn not_empty(self, item: &Item) -> Result<Self, SceneError> {
        if self.width == 0 || self.height == 0 {
            return Err(item.error("has no texels"));
        }
        Ok(self)
    }
}

/// A decoded image.
pub(super) struct TexturePicture {
    /// Its sides.
    pub size: Size,
    /// RGBA, row by row from the top.
    pub texels: Vec<[u8; 4]>,
    /// Whether red, green and blue are encoded as sRGB, if the image says so in words that glTF makes binding.
    pub srgb: Option<bool>,
    /// It stores red and green alone. As normals such a picture lacks their heights ([`TexturePicture::with_heights`]).
    pub red_green_only: bool,
    /// Some of its numbers lay outside of 0 to 1 and were cut off there.
    pub cut_off: bool,
    /// The sides in the file, of which means are read, because all texels would take more than so short a file may, or than the
    /// scene's other textures leave.
    pub stored: Option<Size>,
    /// What else should be said of it.
    pub notes: Vec<String>,
}

impl TexturePicture {
    /// The texels with blue as normals of length 1 need it, which point away from the surface.
    pub(super) fn with_heights(&self) -> Vec<[u8; 4]> {
        let height = |[r, g, _, a]: [u8; 4]| {
            let [x, y] = [r, g].map(|byte| f32::from(byte) / 127.5 - 1.0);
            let z = (1.0 - x * x - y * y).max(0.0).sqrt();
            [r, g, (z * 127.5 + 128.0) as u8, a]
        };
        self.texels.iter().copied().map(height).collect()
    }
}

/// Decodes a picture. `name`, its URI or media type, tells a TGA, whose bytes do not. `texels_so_far` counts those of the scene's
/// other textures.
///
/// # Errors
/// Another format, damaged data, and sizes beyond the limits; the text names `item`.
pub(super) fn decode(
    item: &Item,
    bytes: &[u8],
    name: &str,
    texels_so_far: u64,
    limits: &Limits,
) -> Result<TexturePicture, SceneError> {
    if bytes.starts_with(&KTX2_MAGIC) {
        return ktx2(item, bytes, texels_so_far, limits);
    }
    let format = format_of(item, bytes, name)?;
    let room = PictureBudget::of(item, bytes, texels_so_far, limits)?;
    if format == ImageFormat::Tiff {
        return tiff(item, bytes, &room);
    }
    if let Some((plain, told)) = (format == ImageFormat::Bmp).then(|| bmp::plain(bytes, room.bytes)).flatten()
    {
        let mut picture = of_image(item, &plain, format, &room, limits)?;
        picture.notes.extend(told);
        return Ok(picture);
    }
    let frame = JpegFrame::of(bytes).filter(|_| format == ImageFormat::Jpeg);
    if let Some(picture) = frame.and_then(|frame| jpeg(item, bytes, &frame, &room, limits).transpose()) {
        return picture;
    }
    of_image(item, bytes, format, &room, limits)
}

/// A picture in KTX2, level 0.
#[cfg(feature = "compressed")]
fn ktx2(
    item: &Item,
    bytes: &[u8],
    texels_so_far: u64,
    limits: &Limits,
) -> Result<TexturePicture, SceneError> {
    let failed = |e: Ktx2Error| match e {
        Ktx2Error::Damaged(why) => item.error(why),
        Ktx2Error::Unsupported { what, remedy } => {
            SceneError::unsupported(format!("{}: {what}", item.name), remedy)
        }
    };
    let image = dpm_ktx2::Image::open(bytes).map_err(failed)?;
    let [width, height] = image.sides();
    let size = Size { width, height };
    check_size(item, size, texels_so_far, limits)?;
    check_decoded(item, bytes, 4 * size.texels() as u64, limits)?;
    let Texels { texels, srgb, red_green_only, cut_off } = image.texels().map_err(failed)?;
    Ok(TexturePicture { size, texels, srgb, red_green_only, cut_off, stored: None, notes: vec![] })
}

#[cfg(not(feature = "compressed"))]
fn ktx2(item: &Item, _: &[u8], _: u64, _: &Limits) -> Result<TexturePicture, SceneError> {
    let remedy = "this program was built without the feature `compressed`; export PNG or JPEG textures";
    Err(SceneError::unsupported(format!("{}: an image in KTX2", item.name), remedy))
}

/// A picture by the decoders of `image`.
fn of_image(
    item: &Item,
    bytes: &[u8],
    format: ImageFormat,
    room: &PictureBudget,
    limits: &Limits,
) -> Result<TexturePicture, SceneError> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(of_header());
    let failed = |e: image::ImageError| item.error(format!("cannot be decoded: {e}"));
    let decoder = reader.into_decoder().map_err(failed)?;
    let (width, height) = image::ImageDecoder::dimensions(&decoder);
    let size = room.admitted(item, Size { width, height })?;
    check_decoded(item, bytes, image::ImageDecoder::total_bytes(&decoder), limits)?;
    let mut bounded = ImageReader::with_format(Cursor::new(bytes), format);
    // 16-bit RGBA is the widest decoded format.
    bounded.limits(of_picture(format, [width, height], 8, room.bytes));
    // A decoder that panics leaves its picture out, and not the scene.
    let decode = std::panic::AssertUnwindSafe(|| bounded.decode());
    let decoded = std::panic::catch_unwind(decode)
        .map_err(|_| item.error("cannot be decoded: its decoder failed; save it as PNG"))?
        .map_err(failed)?;
    Ok(of_decoded(decoded, size, room))
}

/// A JPEG of an odd kind, or one that takes more than it may with all of its texels; `None` where the decoder of all others reads
/// or refuses it.
fn jpeg(
    item: &Item,
    bytes: &[u8],
    frame: &JpegFrame,
    room: &PictureBudget,
    limits: &Limits,
) -> Result<Option<TexturePicture>, SceneError> {
    let [width, height] = frame.sides;
    let size = room.admitted(item, Size { width, height })?;
    let sides = match frame.sides_within(room.bytes) {
        Some(sides) if frame.is_odd() || sides != frame.sides => sides,
        None if frame.is_odd() => {
            return check_decoded(item, bytes, 3 * size.texels() as u64, limits).map(|()| None);
        }
        _ => return Ok(None),
    };
    let decoded = frame.decode(bytes, sides, room.bytes, false).map_err(|e| item.error(e))?;
    Ok(Some(of_decoded(decoded, size, room)))
}

/// What a picture may take.
struct PictureBudget {
    /// Bytes of the largest piece of memory.
    bytes: u64,
    /// Texels that the scene's other textures leave.
    texels: u64,
    /// Texels along a side.
    side: u32,
    /// Texels that a file of its length may store: each costs time.
    stored: u64,
}

/// Texels for each byte of a file that may have more than the limit: a JPEG of a smooth picture has some forty.
const MOST_IN_A_BYTE: u64 = 64;

impl PictureBudget {
    fn of(item: &Item, bytes: &[u8], texels_so_far: u64, limits: &Limits) -> Result<Self, SceneError> {
        let texels = limits.texels.saturating_sub(texels_so_far);
        if texels == 0 {
            let limit = limits.texels;
            return Err(item.error(format!("has no room: all textures together may have {limit} texels")));
        }
        let stored = limits.texels.max(MOST_IN_A_BYTE.saturating_mul(bytes.len() as u64));
        Ok(Self { bytes: allowed(bytes, limits), texels, side: limits.texture_side, stored })
    }

    fn admitted(&self, item: &Item, size: Size) -> Result<Size, SceneError> {
        let Size { width, height } = size.not_empty(item)?;
        if u64::from(width) * u64::from(height) > self.stored {
            let most = self.stored;
            return Err(item.error(format!(
                "says that it has {width} x {height} texels, and the limit of so short a file is {most}: use a smaller picture"
            )));
        }
        Ok(size)
    }

    /// The sides of the squares whose means are read so that a picture fits. `width_of_texel`: bytes of each square for steps of
    /// 1 and of more.
    fn step(&self, size: Size, width_of_texel: [u64; 2]) -> u32 {
        let fits = |step: u32| {
            let [across, down] = [size.width, size.height].map(|side| side.div_ceil(step));
            let texels = u64::from(across) * u64::from(down);
            let bytes = texels.saturating_mul(width_of_texel[usize::from(step > 1)]);
            across.max(down) <= self.side && texels <= self.texels && bytes <= self.bytes
        };
        (1..).find(|step| fits(*step)).unwrap_or(1)
    }
}

/// A picture of a size in its file, with as many texels as there is room for.
fn of_decoded(decoded: image::DynamicImage, size: Size, room: &PictureBudget) -> TexturePicture {
    let (kept, texels) = as_rgba(decoded, room);
    let stored = (kept.texels() < size.texels()).then_some(size);
    TexturePicture {
        size: kept,
        texels,
        srgb: None,
        red_green_only: false,
        cut_off: false,
        stored,
        notes: vec![],
    }
}

/// The texels of a decoded picture, or the means of squares of them.
fn as_rgba(decoded: image::DynamicImage, room: &PictureBudget) -> (Size, Vec<[u8; 4]>) {
    use image::GenericImageView;
    let (width, height) = decoded.dimensions();
    let step = room.step(Size { width, height }, [4, 4]);
    if step == 1 {
        // A decoder may leave room for a part of a texel, which only a copy gets rid of.
        let copy = |raw: Vec<u8>| raw.chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect();
        let texels =
            bytemuck::try_cast_vec(decoded.into_rgba8().into_raw()).unwrap_or_else(|(_, raw)| copy(raw));
        return (Size { width, height }, texels);
    }
    let size = Size { width: width.div_ceil(step), height: height.div_ceil(step) };
    let mut texels = Vec::with_capacity(size.texels());
    for (top, left) in (0..height)
        .step_by(step as usize)
        .flat_map(|y| (0..width).step_by(step as usize).map(move |x| (y, x)))
    {
        let (down, across) = (top..height.min(top + step), left..width.min(left + step));
        let count = (down.len() * across.len()) as u32;
        let mut sum = [0; 4];
        for (y, x) in down.flat_map(|y| across.clone().map(move |x| (y, x))) {
            let of = decoded.get_pixel(x, y).0;
            sum.iter_mut().zip(of).for_each(|(sum, code)| *sum += u32::from(code));
        }
        texels.push(sum.map(|sum| ((sum + count / 2) / count) as u8));
    }
    (size, texels)
}

/// The texels of a TIFF, or the means of squares of them.
fn tiff(item: &Item, bytes: &[u8], room: &PictureBudget) -> Result<TexturePicture, SceneError> {
    let file = Tiff::open(bytes).map_err(|e| item.error(e))?;
    let [width, height] = file.sides();
    let stored = room.admitted(item, Size { width, height })?;
    let allowed = room.bytes;
    // Sums of means are four times as wide as texels.
    let step = room.step(stored, [4, 16]);
    let size = Size { width: width.div_ceil(step), height: height.div_ceil(step) };
    let mut rounder = Rounder::default();
    let mut round = |texel: [f32; 4]| texel.map(|x| rounder.byte(x));
    let place = |[x, y]: [u32; 2]| (y / step) as usize * size.width as usize + (x / step) as usize;
    let failed = |e: String| item.error(e);
    let (texels, notes) = if step == 1 {
        let mut texels = vec![[0, 0, 0, u8::MAX]; size.texels()];
        let notes = file.read(allowed, |at, texel| texels[place(at)] = round(texel)).map_err(failed)?;
        (texels, notes)
    } else {
        let mut sums = vec![[0u32; 4]; size.texels()];
        let add = |at, texel| {
            sums[place(at)].iter_mut().zip(round(texel)).for_each(|(sum, code)| *sum += u32::from(code));
        };
        let notes = file.read(allowed, add).map_err(failed)?;
        let mean = |(i, sum): (usize, &[u32; 4])| {
            let of = |length: u32, at: usize| step.min(length - at as u32 * step);
            let count = of(width, i % size.width as usize) * of(height, i / size.width as usize);
            sum.map(|sum| ((sum + count / 2) / count) as u8)
        };
        (sums.iter().enumerate().map(mean).collect(), notes)
    };
    let stored = (step > 1).then_some(stored);
    let cut_off = rounder.cut_off;
    Ok(TexturePicture { size, texels, srgb: None, red_green_only: false, cut_off, stored, notes })
}

/// The format of an image by its first bytes. TGA has none of its own: its header, its last bytes or its name show it.
fn format_of(item: &Item, bytes: &[u8], name: &str) -> Result<ImageFormat, SceneError> {
    use ImageFormat::{Bmp, Jpeg, Png, Tga, Tiff, WebP};
    match image::guess_format(bytes) {
        _ if is_tiff(bytes) => Ok(Tiff),
        Ok(format @ (Png | Jpeg | Bmp | WebP)) => Ok(format),
        Ok(other) => Err(SceneError::unsupported(
            format!("{}: an image of format {other:?}", item.name),
            "convert it to PNG",
        )),
        Err(_) => {
            let name = name.to_ascii_lowercase();
            let is_named =
                name.ends_with(".tga") || name.contains("image/x-tga") || name.contains("image/tga");
            // Kind of palette, kind of image, bits of a texel.
            let is_plausible = matches!(bytes, [_, 0 | 1, 1..=3 | 9..=11, ..])
                && matches!(bytes.get(16), Some(8 | 15 | 16 | 24 | 32));
            if is_plausible && (is_named || bytes.ends_with(b"TRUEVISION-XFILE.\0") || name.is_empty()) {
                return Ok(Tga);
            }
            Err(item.error("is no PNG, JPEG, KTX2, WebP, TIFF, BMP or TGA: convert it to PNG"))
        }
    }
}

/// Checks format and size of a picture that is decoded later.
pub(super) fn check(item: &Item, bytes: &[u8], name: &str, limits: &Limits) -> Result<(), SceneError> {
    if bytes.starts_with(&KTX2_MAGIC) {
        return Ok(());
    }
    let format = format_of(item, bytes, name)?;
    if format == ImageFormat::Tiff {
        let [width, height] = Tiff::open(bytes).map_err(|e| item.error(e))?.sides();
        return check_size(item, Size { width, height }, 0, limits);
    }
    if let Some(frame) = JpegFrame::of(bytes).filter(|frame| format == ImageFormat::Jpeg && frame.is_odd()) {
        let [width, height] = frame.sides;
        return check_size(item, Size { width, height }, 0, limits);
    }
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(of_header());
    let (width, height) =
        reader.into_dimensions().map_err(|e| item.error(format!("cannot be decoded: {e}")))?;
    check_size(item, Size { width, height }, 0, limits)
}

/// Bytes that one piece of memory may have for a picture of `bytes`, or for the scene that it is of.
fn allowed(bytes: &[u8], limits: &Limits) -> u64 {
    largest_piece(limits.file_bytes.max(bytes.len() as u64))
}

/// Refuses a picture that takes more bytes than the length of its file allows.
pub(super) fn check_decoded(
    item: &Item,
    bytes: &[u8],
    decoded: u64,
    limits: &Limits,
) -> Result<(), SceneError> {
    SceneError::check_limit(
        &format!("the bytes of {} in so short a file", item.name),
        decoded,
        allowed(bytes, limits),
        "use a smaller texture",
    )
}

/// Refuses a picture without texels, or with more than the limits allow.
pub(super) fn check_size(
    item: &Item,
    size: Size,
    texels_so_far: u64,
    limits: &Limits,
) -> Result<(), SceneError> {
    let Size { width, height } = size.not_empty(item)?;
    SceneError::check_limit(
        &format!("the longer side of {}", item.name),
        width.max(height).into(),
        limits.texture_side.into(),
        "use a smaller texture",
    )?;
    let texels = texels_so_far + u64::from(width) * u64::from(height);
    SceneError::check_limit(
        "the number of texels in all textures",
        texels,
        limits.texels,
        "use smaller textures",
    )
}
