//! Decodes an image of a scene, PNG, JPEG, KTX2, WebP, TIFF, BMP or TGA, to 8-bit RGBA; checks its size before anything of that size is
//! taken.

use std::io::Cursor;

use image::{ImageFormat, ImageReader};

use super::super::limits::largest_piece;
use super::super::{Limits, SceneError};
use super::json::Item;
use super::ktx2_image;

/// Texels along the sides of a picture, each above 0.
#[derive(Clone, Copy)]
pub(super) struct Size {
    /// Texels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Size {
    /// All texels, after [`check_size`].
    pub(super) fn texels(self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// A decoded image.
pub(super) struct Picture {
    /// Its sides.
    pub size: Size,
    /// RGBA, row by row from the top.
    pub texels: Vec<[u8; 4]>,
    /// Whether red, green and blue are encoded as sRGB, if the image says so in words that glTF makes binding.
    pub srgb: Option<bool>,
    /// It stores red and green alone. As normals such a picture lacks their heights ([`Picture::with_heights`]).
    pub red_green_only: bool,
    /// Some of its numbers lay outside of 0 to 1 and were cut off there.
    pub cut_off: bool,
}

impl Picture {
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
) -> Result<Picture, SceneError> {
    if ktx2_image::is_ktx2(bytes) {
        return ktx2_image::decode(item, bytes, texels_so_far, limits);
    }
    let format = format_of(item, bytes, name)?;
    let reader = || ImageReader::with_format(Cursor::new(bytes), format);
    let failed = |e: image::ImageError| item.error(format!("cannot be decoded: {e}"));
    let decoder = reader().into_decoder().map_err(failed)?;
    let (width, height) = image::ImageDecoder::dimensions(&decoder);
    let size = Size { width, height };
    check_size(item, size, texels_so_far, limits)?;
    let decoded = image::ImageDecoder::total_bytes(&decoder).max(4 * size.texels() as u64);
    check_decoded(item, bytes, decoded, limits)?;
    let mut bounded = reader();
    let mut memory = image::Limits::default();
    memory.max_image_width = Some(width);
    memory.max_image_height = Some(height);
    // 16-bit RGBA is the widest decoded format; the rest is room for the decoder's own tables.
    memory.max_alloc = Some(u64::from(width) * u64::from(height) * 8 + (16 << 20));
    bounded.limits(memory);
    let rgba = bounded.decode().map_err(failed)?.into_rgba8();
    let texels = rgba.as_raw().chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect();
    Ok(Picture { size, texels, srgb: None, red_green_only: false, cut_off: false })
}

/// The format of an image by its first bytes. TGA has none of its own: its header, its last bytes or its name show it.
fn format_of(item: &Item, bytes: &[u8], name: &str) -> Result<ImageFormat, SceneError> {
    use ImageFormat::{Bmp, Jpeg, Png, Tga, Tiff, WebP};
    match image::guess_format(bytes) {
        Ok(format @ (Png | Jpeg | Bmp | Tiff | WebP)) => Ok(format),
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
    if ktx2_image::is_ktx2(bytes) {
        return Ok(());
    }
    let format = format_of(item, bytes, name)?;
    let sides = ImageReader::with_format(Cursor::new(bytes), format).into_dimensions();
    let (width, height) = sides.map_err(|e| item.error(format!("cannot be decoded: {e}")))?;
    check_size(item, Size { width, height }, 0, limits)
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
        largest_piece(limits.file_bytes.max(bytes.len() as u64)),
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
    let Size { width, height } = size;
    if width == 0 || height == 0 {
        return Err(item.error("has no texels"));
    }
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
