//! Reads a latitude-longitude image file (PFM, Radiance RGBE or XYZE, OpenEXR, PNG, JPEG, TIFF, WebP, BMP) as an
//! [`Environment`].
//!
//! Radiance pictures are read here and not by the crate `image`, which reads one of the eight orders of their texels and no
//! XYZE.

#[cfg(feature = "exr")]
mod exr_picture;
mod radiance;

use std::path::Path;

use glam::{DVec3, Vec3};
use image::{ImageFormat, ImageReader};

use super::gltf_file::read_file;
use super::limits::{largest_piece, of_header, of_picture, Limits};
use super::load::contained;
use super::primaries::Primaries;
use super::srgb::to_linear;
use super::tiff_picture::{is_tiff, Tiff};
use super::{Environment, SceneError};
#[cfg(feature = "exr")]
use exr_picture::read_exr;
use radiance::read_rgbe;

/// The formats that this program reads.
const FORMATS: &str = if cfg!(feature = "exr") {
    "give a .pfm, a Radiance .hdr, an .exr, .png, .jpg, .tif, .webp or .bmp"
} else {
    "give a .pfm, a Radiance .hdr, a .png, .jpg, .tif, .webp or .bmp (this program was built without its feature \"exr\", which reads an .exr)"
};

/// Maximum number of texels of an environment: 8192 x 4096.
const MAX_TEXELS: u64 = 1 << 25;

/// Radiance beyond this counts as damage; the sun's disc is near 10^5 times the sky.
const MAX_RADIANCE: f32 = 1.0e9;
/// What infinite light is taken for: the greatest number of half precision, in which skies overflow.
const OVERFLOWN: f32 = 65_504.0;
/// Share of texels that may be no light at all; with more the picture is damaged.
const MOST_CLAMPED: f64 = 0.1;

/// A sky that was read.
#[derive(Clone, Debug)]
pub struct Sky {
    /// The light.
    pub environment: Environment,
    /// What was changed or is not used, one line each, for the operator.
    pub warnings: Vec<String>,
}

/// A picture before it is checked.
#[derive(Clone, Debug, Default, PartialEq)]
struct Read {
    width: u32,
    height: u32,
    texels: Vec<Vec3>,
    /// Of its colours; `None`: sRGB's.
    primaries: Option<Primaries>,
    warnings: Vec<String>,
}

impl From<Pixels> for Read {
    fn from((width, height, texels): Pixels) -> Self {
        Self { width, height, texels, ..Self::default() }
    }
}

/// Reads an environment image: `.pfm` (linear, "PF" or "Pf"), Radiance `.hdr` (linear), OpenEXR (linear), PNG, JPEG, WebP or
/// BMP (sRGB, decoded to linear), or TIFF (sRGB, linear where it holds floats); the first bytes identify the format. Row 0 is
/// up; the middle column looks along -Z turned by `rotation_rad` about +Y. Texels are multiplied by `scale`.
///
/// A few texels that are negative, infinite or no numbers are clamped and counted.
///
/// # Errors
/// [`SceneError::InFile`] if the file cannot be read, is larger than 8192 x 4096 texels, or holds many values that are no
/// light.
pub fn load_environment(path: &Path, rotation_rad: f32, scale: f32) -> Result<Sky, SceneError> {
    let limits = Limits::default();
    let owned = path.to_path_buf();
    let work = move |_: &_| {
        let bytes = read_file(&owned, MAX_TEXELS * 16)?;
        decode_environment(&bytes, rotation_rad, scale)
    };
    contained(&limits, work).map_err(|e| e.in_file(path))
}

/// Size of a storage buffer that every Vulkan device can bind (`maxStorageBufferRange` is at least 2^27), bytes. The
/// renderer keeps an environment in such a buffer, with 16 bytes for each texel and each row.
const RENDERED_BYTES: u64 = 1 << 27;

/// True when the renderer can hold an environment of these sides on every device.
fn is_held(width: u32, height: u32) -> bool {
    (u64::from(width) * u64::from(height) + u64::from(height)) * 16 <= RENDERED_BYTES
}

impl Environment {
    /// The same environment, scaled down if needed so that the renderer can hold it on every device, and a description
    /// of the scaling if there was any. A projector shows reflections of it at a few texels a degree at most, so no
    /// visible detail is lost.
    ///
    /// A texel of the smaller picture is the mean of the larger one over its part of the sphere, so the total light
    /// stays the same.
    pub fn fitted(self) -> (Self, Option<String>) {
        let (width, height, texels, rotation_rad) = match self {
            Self::Equirect { width, height, texels, rotation_rad } if !is_held(width, height) => {
                (width, height, texels, rotation_rad)
            }
            other => return (other, None),
        };
        // The same aspect ratio if possible: both sides divided by the smallest factor that fits.
        let side = |side: u32, factor: f64| ((f64::from(side) / factor) as u32).max(1);
        let mut factor = 1.0;
        while !is_held(side(width, factor), side(height, factor)) {
            factor *= 1.0 + 1.0 / 1024.0;
        }
        let (w, h) = (side(width, factor), side(height, factor));
        let small = box_filtered(&texels, (width, height), (w, h));
        let told = format!(
            "the environment of {width} x {height} texels is scaled down to {w} x {h}, the most that every device holds; its light stays the same"
        );
        (Self::Equirect { width: w, height: h, texels: small, rotation_rad }, Some(told))
    }
}

/// Overlaps of `n` parts with the `m` parts beneath them, where `edge` gives the position of edge `k` for either
/// number. Returns for each of the `n` parts the first of the `m` and the sizes of the overlaps.
fn overlaps(n: u32, m: u32, edge: impl Fn(u32, u32) -> f64) -> Vec<(usize, Vec<f64>)> {
    let part = |k: u32| {
        let (from, to) = (edge(k, n), edge(k + 1, n));
        // Integers, so that rounding leaves no part out.
        let first = (u64::from(k) * u64::from(m) / u64::from(n)) as u32;
        let last = ((u64::from(k) + 1) * u64::from(m)).div_ceil(u64::from(n)).min(u64::from(m)) as u32;
        let sizes = (first..last).map(|i| (edge(i + 1, m).min(to) - edge(i, m).max(from)).max(0.0));
        (first as usize, sizes.collect())
    };
    (0..n).map(part).collect()
}

/// Scales a latitude-longitude picture of `from` texels to `to`, with no side larger: each texel is the mean over its
/// solid angle.
fn box_filtered(texels: &[Vec3], from: (u32, u32), to: (u32, u32)) -> Vec<Vec3> {
    let columns = overlaps(to.0, from.0, |k, of| f64::from(k) / f64::from(of));
    // Rows in terms of the height on the unit sphere, in which equal steps are equal solid angles.
    let height = |k: u32, of: u32| 1.0 - (std::f64::consts::PI * f64::from(k) / f64::from(of)).cos();
    let rows = overlaps(to.1, from.1, height);
    let width = from.0 as usize;
    let mut out = Vec::with_capacity(to.0 as usize * to.1 as usize);
    for (top, down) in &rows {
        for (left, across) in &columns {
            let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
            for (y, dy) in down.iter().enumerate() {
                let row = &texels[(top + y) * width + left..][..across.len()];
                for (texel, dx) in row.iter().zip(across) {
                    sum += texel.as_dvec3() * (dx * dy);
                    weight += dx * dy;
                }
            }
            out.push((sum / weight.max(f64::MIN_POSITIVE)).as_vec3());
        }
    }
    out
}

/// [`load_environment`] of bytes, in this thread: for fuzzers.
#[doc(hidden)]
pub fn decode_environment(bytes: &[u8], rotation_rad: f32, scale: f32) -> Result<Sky, SceneError> {
    if !(rotation_rad.is_finite() && scale.is_finite() && scale >= 0.0) {
        return Err(SceneError::broken(
            "environment",
            format!("rotation {rotation_rad} and scale {scale} must be finite, the scale not negative"),
        ));
    }
    let mut read: Read = match bytes {
        [b'P', b'F' | b'f', ..] => read_pfm(bytes)?.into(),
        [b'#', b'?', ..] => read_rgbe(bytes)?,
        [0x76, 0x2f, 0x31, 0x01, ..] => read_exr(bytes)?,
        _ if is_tiff(bytes) => read_tiff(bytes)?,
        _ => match image::guess_format(bytes) {
            Ok(format @ (ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP | ImageFormat::Bmp)) => {
                read_srgb(bytes, format)?
            }
            _ => return Err(SceneError::unsupported("this image format", FORMATS)),
        },
    };
    if let Some(primaries) = read.primaries {
        read.warnings.extend(primaries.convert(&mut read.texels));
    }
    clamp(&mut read, scale)?;
    let Read { width, height, texels, warnings, .. } = read;
    Ok(Sky { environment: Environment::Equirect { width, height, texels, rotation_rad }, warnings })
}

/// Scales the texels, and makes light of those that are none.
fn clamp(read: &mut Read, scale: f32) -> Result<(), SceneError> {
    let (mut negative, mut infinite, mut none, mut bright) = (0usize, 0usize, 0usize, 0usize);
    let mut first: Option<usize> = None;
    for (i, texel) in read.texels.iter_mut().enumerate() {
        let is_light =
            texel.is_finite() && texel.min_element() >= 0.0 && (*texel * scale).max_element() <= MAX_RADIANCE;
        if is_light {
            *texel *= scale;
            continue;
        }
        first = first.or(Some(i));
        let mut counts = [false; 4];
        for x in texel.as_mut() {
            let (is, value) = match *x {
                v if v.is_nan() => (2, 0.0),
                f32::INFINITY => (1, OVERFLOWN),
                f32::NEG_INFINITY => (0, 0.0),
                v if v < 0.0 => (0, 0.0),
                v if v * scale > MAX_RADIANCE => (3, MAX_RADIANCE / scale),
                v => {
                    *x = v * scale;
                    continue;
                }
            };
            counts[is] = true;
            *x = (value * scale).min(MAX_RADIANCE);
        }
        negative += usize::from(counts[0]);
        infinite += usize::from(counts[1]);
        none += usize::from(counts[2]);
        bright += usize::from(counts[3]);
    }
    let Some(first) = first else { return Ok(()) };
    let (x, y) = (first % read.width as usize, first / read.width as usize);
    let count = read.texels.len();
    // Numbers that are too great may be those of another unit, and are told; the others are damage.
    if (infinite + none) as f64 > MOST_CLAMPED * count as f64 && infinite + none > 1 {
        let problem = format!(
            "is the first of {} of {count} texels that are infinite or no numbers: the picture is damaged",
            infinite + none
        );
        return Err(SceneError::broken(format!("texel {x}, {y}"), problem));
    }
    for (count, what) in [
        (negative, "negative ones are taken for 0".to_owned()),
        (infinite, format!("infinite ones are taken for {OVERFLOWN}")),
        (none, "ones that are no numbers are taken for 0".to_owned()),
        (bright, format!("ones beyond {MAX_RADIANCE:e} are taken for that")),
    ] {
        if count > 0 {
            read.warnings.push(format!(
                "{count} texels of the environment are no light (the first at {x}, {y}): {what}"
            ));
        }
    }
    Ok(())
}

/// Refuses a picture of `texels` that needs more memory in one piece than its file's length allows.
pub(crate) fn check_piece(texels: usize, texel_bytes: u64, file_bytes: usize) -> Result<(), SceneError> {
    SceneError::check_limit(
        "the bytes of a picture in so short a file",
        texels as u64 * texel_bytes,
        largest_piece(file_bytes as u64),
        "save it with fewer texels, or less compressed",
    )
}

/// All texels of a picture, or the means of squares of them, if all take more memory than the length of the file allows.
pub(crate) fn collect(
    [width, height]: [u32; 2],
    file_bytes: usize,
    at: impl Fn(u32, u32) -> Vec3,
) -> (Pixels, Option<String>) {
    let most = largest_piece(file_bytes as u64) / size_of::<Vec3>() as u64;
    let sides = |step: u32| (width.div_ceil(step), height.div_ceil(step));
    let texels = |(w, h): (u32, u32)| u64::from(w) * u64::from(h);
    let step = (1..).find(|step| texels(sides(*step)) <= most).unwrap_or(1);
    let (w, h) = sides(step);
    let mut out = Vec::with_capacity(w as usize * h as usize);
    for y in 0..h {
        for x in 0..w {
            let (across, down) =
                ((x * step..width.min((x + 1) * step)), (y * step..height.min((y + 1) * step)));
            let count = across.len() * down.len();
            let sum: DVec3 = down
                .flat_map(|y| across.clone().map(move |x| (x, y)))
                .map(|(x, y)| at(x, y).as_dvec3())
                .sum();
            out.push((sum / count as f64).as_vec3());
        }
    }
    let told = format!(
        "it is read with {w} x {h} of its {width} x {height} texels, as many as so short a file may take"
    );
    ((w, h, out), (step > 1).then_some(told))
}

pub(crate) type Pixels = (u32, u32, Vec<Vec3>);

/// Checks the sides before anything is allocated; returns the number of texels.
pub(crate) fn check_size(width: u32, height: u32) -> Result<usize, SceneError> {
    let texels = u64::from(width) * u64::from(height);
    if texels == 0 {
        return Err(SceneError::broken(
            "image header",
            format!("gives {width} x {height} texels; both sides must be at least 1"),
        ));
    }
    SceneError::check_limit(
        "the number of texels of the environment",
        texels,
        MAX_TEXELS,
        "scale it down to 8192 x 4096 or less",
    )?;
    Ok(texels as usize)
}

fn header(problem: &str) -> SceneError {
    SceneError::broken("image header", problem)
}

/// Longest line of a header. Some programs keep the history of a picture there.
const MAX_LINE: usize = 65_536;

/// Takes a line (without its end) off the front of `rest`. A comment may have any bytes.
fn line<'a>(rest: &mut &'a [u8]) -> Result<std::borrow::Cow<'a, str>, SceneError> {
    let end = rest
        .iter()
        .take(MAX_LINE)
        .position(|&b| b == b'\n')
        .ok_or_else(|| header("is cut off or has a line without end"))?;
    let text = &rest[..end];
    *rest = &rest[end + 1..];
    Ok(String::from_utf8_lossy(text.strip_suffix(b"\r").unwrap_or(text)))
}

pub(crate) fn read_pfm(bytes: &[u8]) -> Result<Pixels, SceneError> {
    let mut rest = bytes;
    let channels = if line(&mut rest)?.trim_end() == "PF" { 3 } else { 1 };
    let size = line(&mut rest)?;
    let sides: Vec<u32> = size.split_ascii_whitespace().map_while(|s| s.parse().ok()).collect();
    let [width, height] = sides[..] else {
        return Err(header("needs the width and the height on its second line"));
    };
    let scale: f32 =
        line(&mut rest)?.trim().parse().map_err(|_| header("needs a number on its third line"))?;
    let texels = check_size(width, height)?;
    let needed = texels * channels * 4;
    if rest.len() < needed {
        return Err(SceneError::broken(
            "image",
            format!("needs {needed} bytes of texels, {} are there: it is cut off", rest.len()),
        ));
    }
    let float = |i: usize| {
        let four = [rest[4 * i], rest[4 * i + 1], rest[4 * i + 2], rest[4 * i + 3]];
        // The sign of the scale gives the byte order; its magnitude has no agreed meaning.
        if scale < 0.0 {
            f32::from_le_bytes(four)
        } else {
            f32::from_be_bytes(four)
        }
    };
    let (w, h) = (width as usize, height as usize);
    let texel = |i: usize| {
        let stored = (h - 1 - i / w) * w + i % w; // the first row stored is the lowest
        if channels == 3 {
            Vec3::new(float(3 * stored), float(3 * stored + 1), float(3 * stored + 2))
        } else {
            Vec3::splat(float(stored))
        }
    };
    Ok((width, height, (0..texels).map(texel).collect()))
}

/// Refuses OpenEXR in a program that was built without it.
#[cfg(not(feature = "exr"))]
fn read_exr(_: &[u8]) -> Result<Read, SceneError> {
    Err(SceneError::unsupported(
        "OpenEXR",
        "this program was built without its feature \"exr\"; convert the picture to Radiance .hdr, or build the program with that feature",
    ))
}

/// Decodes a picture with the sides that its header gives, which are checked first, in at most `texel_bytes` for each texel.
fn decode_bounded(
    bytes: &[u8],
    format: ImageFormat,
    texel_bytes: u64,
) -> Result<image::DynamicImage, SceneError> {
    let reader = || ImageReader::with_format(std::io::Cursor::new(bytes), format);
    let failed = |e: image::ImageError| SceneError::broken("image", format!("cannot be decoded: {e}"));
    let mut header = reader();
    header.limits(of_header());
    let decoder = header.into_decoder().map_err(failed)?;
    let (width, height) = image::ImageDecoder::dimensions(&decoder);
    check_size(width, height)?;
    check_piece(1, image::ImageDecoder::total_bytes(&decoder), bytes.len())?;
    let mut bounded = reader();
    let allowed = largest_piece(bytes.len() as u64);
    bounded.limits(of_picture(format, [width, height], texel_bytes, allowed));
    bounded.decode().map_err(failed)
}

fn read_srgb(bytes: &[u8], format: ImageFormat) -> Result<Read, SceneError> {
    use image::DynamicImage::{ImageLuma8, ImageRgb8, ImageRgba8};
    let picture = decode_bounded(bytes, format, 8)?;
    let sides = [picture.width(), picture.height()];
    let of_eight: Vec<f32> = (0..=255u8).map(|code| to_linear(f32::from(code) / 255.0)).collect();
    let of = |code: u8| of_eight[usize::from(code)];
    Ok(match &picture {
        ImageLuma8(grey) => {
            collected(collect(sides, bytes.len(), |x, y| Vec3::splat(of(grey.get_pixel(x, y).0[0]))))
        }
        ImageRgb8(rgb) => {
            collected(collect(sides, bytes.len(), |x, y| Vec3::from(rgb.get_pixel(x, y).0.map(of))))
        }
        ImageRgba8(rgba) => {
            let at = |x, y| {
                let [r, g, b, _] = rgba.get_pixel(x, y).0;
                Vec3::from([r, g, b].map(of))
            };
            collected(collect(sides, bytes.len(), at))
        }
        _ => {
            check_piece(sides[0] as usize * sides[1] as usize, 6, bytes.len())?;
            let rgb = picture.into_rgb16();
            let linear = |x: u16| to_linear(f32::from(x) / 65535.0);
            collected(collect(sides, bytes.len(), |x, y| Vec3::from(rgb.get_pixel(x, y).0.map(linear))))
        }
    })
}

fn collected(((width, height, texels), told): (Pixels, Option<String>)) -> Read {
    Read { width, height, texels, warnings: told.into_iter().collect(), ..Read::default() }
}

/// TIFF of whole numbers is a picture for a display, and one of floats is light.
fn read_tiff(bytes: &[u8]) -> Result<Read, SceneError> {
    let failed = |problem| SceneError::broken("image", problem);
    let file = Tiff::open(bytes).map_err(failed)?;
    let [width, height] = file.sides();
    let texels = check_size(width, height)?;
    check_piece(texels, size_of::<Vec3>() as u64, bytes.len())?;
    let of = |x: f32| if file.is_light() { x } else { to_linear(x) };
    let mut light = vec![Vec3::ZERO; texels];
    let allowed = largest_piece(bytes.len() as u64);
    let put = |[x, y]: [u32; 2], [r, g, b, _]: [f32; 4]| {
        light[y as usize * width as usize + x as usize] = Vec3::new(of(r), of(g), of(b));
    };
    let warnings = file.read(allowed, put).map_err(failed)?;
    Ok(Read { width, height, texels: light, warnings, ..Read::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texels(bytes: &[u8]) -> Pixels {
        match decode_environment(bytes, 0.0, 1.0).unwrap().environment {
            Environment::Equirect { width, height, texels, .. } => (width, height, texels),
            Environment::Constant(_) => unreachable!("an image never decodes to a constant"),
        }
    }

    fn refused(bytes: &[u8]) -> String {
        decode_environment(bytes, 0.0, 1.0).unwrap_err().to_string()
    }

    fn pfm(size: &str, scale: &str, values: &[[u8; 4]]) -> Vec<u8> {
        [format!("PF\n{size}\n{scale}\n").as_bytes(), &values.concat()].concat()
    }

    #[test]
    fn pfm_rows_run_upwards_in_either_byte_order() {
        let values = [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0];
        let little = pfm("1 2", "-1.0", &values.map(f32::to_le_bytes));
        let big = pfm("1 2", "1.0", &values.map(f32::to_be_bytes));
        let expected = (1, 2, vec![Vec3::new(4.0, 5.0, 6.0), Vec3::new(1.0, 2.0, 3.0)]);
        assert_eq!(texels(&little), expected);
        assert_eq!(texels(&big), expected);
        let gray = [b"Pf\n2 1\n-1\n".as_slice(), &[0.25f32, 0.5].map(f32::to_le_bytes).concat()].concat();
        assert_eq!(texels(&gray).2, [Vec3::splat(0.25), Vec3::splat(0.5)]);
    }

    #[test]
    fn rgbe_golden_bytes_in_all_three_codings() {
        let head = |width| format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X {width}\n").into_bytes();
        // 128 * 2^(129 - 136) = 1; 64 gives a half.
        let plain = [head(3), vec![128, 64, 0, 129, 1, 1, 1, 2]].concat();
        assert_eq!(texels(&plain).2, [Vec3::new(1.0, 0.5, 0.0); 3]);
        let mut coded = head(8);
        coded.extend([2, 2, 0, 8]);
        coded.extend([128 + 8, 128]); // red: a run of 8
        coded.extend([8, 64, 64, 64, 64, 128, 128, 128, 128]); // green: 8 values
        coded.extend([128 + 5, 0, 3, 32, 32, 32]); // blue: both
        coded.extend([128 + 8, 129]);
        let (_, _, t) = texels(&coded);
        assert_eq!(
            (t[0], t[4], t[7]),
            (Vec3::new(1.0, 0.5, 0.0), Vec3::new(1.0, 1.0, 0.0), Vec3::new(1.0, 1.0, 0.25))
        );
        let dark = [head(1), vec![255, 255, 255, 0]].concat();
        assert_eq!(texels(&dark).2, [Vec3::ZERO]);
        let exposed =
            [b"#?RGBE\nEXPOSURE=2\nEXPOSURE=2\n\n-Y 1 +X 1\n".to_vec(), vec![128, 128, 128, 129]].concat();
        assert_eq!(texels(&exposed).2, [Vec3::splat(0.25)]);
    }

    #[test]
    fn png_is_decoded_from_srgb() {
        let mut png = std::io::Cursor::new(vec![]);
        image::RgbImage::from_raw(2, 1, vec![0, 128, 255, 255, 0, 0])
            .unwrap()
            .write_to(&mut png, ImageFormat::Png)
            .unwrap();
        let (w, h, t) = texels(png.get_ref());
        assert_eq!((w, h), (2, 1));
        assert!(t[0].distance(Vec3::new(0.0, 0.215_86, 1.0)) < 1e-4 && t[1] == Vec3::X);
    }

    #[test]
    fn hostile_images_are_refused_with_reasons() {
        let of = |value: f32| pfm("1 2", "-1", &[1.0, value, 1.0, 1.0, value, 2.0].map(f32::to_le_bytes));
        assert!(
            refused(&of(f32::NAN)).contains("texel 0, 0") && refused(&of(f32::INFINITY)).contains("2 of 2")
        );
        // A picture of another unit has nothing but such light.
        let bright = decode_environment(&of(1e30), 0.0, 1.0).unwrap();
        let told = bright.warnings.join(" ");
        assert!(told.contains("2 texels") && told.contains("beyond 1e9"), "{told}");
        assert_eq!(texels(&of(1e30)).2[0], Vec3::new(1.0, MAX_RADIANCE, 2.0));
        assert!(refused(&pfm("65535 65535", "-1", &[])).contains("limit"));
        assert!(refused(&pfm("4 4", "-1", &[])).contains("cut off"));
        assert!(refused(&pfm("0 4", "-1", &[])).contains("at least 1"));
        assert!(refused(&pfm("-4 4", "-1", &[])).contains("width"));
        assert!(refused(b"PF\n1 1").contains("cut off"));
        assert!(refused(b"#?RADIANCE\n\n-Y 70000 +X 70000\n").contains("limit"));
        assert!(refused(b"#?RADIANCE\n\n-Y 4000 +X 4000\n\x02\x02").contains("cut off"));
        assert!(refused(b"#?RADIANCE\n\n+Y 2 +Y 2\n").contains("-Y height"));
        assert!(refused(b"#?RADIANCE\nFORMAT=32-bit_luv\n\n-Y 2 +X 2\n").contains("luv"));
        assert!(refused(b"#?RADIANCE\n\n-Y 1 +X 8\n\x02\x02\x00\x08\xff\x01").contains("row 0"));
        assert!(refused(b"#?RADIANCE\n\n-Y 1 +X 2\n\x01\x01\x01\x01").contains("row 0"));
        assert!(refused(b"GIF89a").contains("format") && refused(b"").contains("format"));
        assert!(decode_environment(b"", f32::NAN, 1.0).unwrap_err().to_string().contains("rotation"));
        assert!(load_environment(Path::new("/nonexistent/sky.pfm"), 0.0, 1.0)
            .unwrap_err()
            .to_string()
            .contains("sky.pfm"));
    }

    #[cfg(not(feature = "exr"))]
    #[test]
    fn openexr_is_refused_by_name_in_a_program_without_it() {
        let folder = std::env::temp_dir().join(format!("dpm-no-exr-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("sky.exr");
        for bytes in [&[0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0][..], b"no picture"] {
            std::fs::write(&file, bytes).unwrap();
            let told = load_environment(&file, 0.0, 1.0).unwrap_err().to_string();
            for word in ["sky.exr", "built without its feature \"exr\"", ".hdr"] {
                assert!(told.contains(word), "{told}");
            }
        }
        std::fs::remove_dir_all(&folder).unwrap();
    }

    /// The total light, and the light on an upward-facing plane: both are weighted by solid angle.
    fn energies(texels: &[Vec3], width: usize) -> [f64; 2] {
        let height = texels.len() / width;
        let z = |k: usize| (std::f64::consts::PI * k as f64 / height as f64).cos();
        let mut sums = [0.0; 2];
        for (y, row) in texels.chunks_exact(width).enumerate() {
            let of_row: f64 = row.iter().map(|t| t.as_dvec3().element_sum()).sum::<f64>() / width as f64;
            sums[0] += of_row * (z(y) - z(y + 1));
            sums[1] += of_row * (z(y) * z(y) - z(y + 1) * z(y + 1)) * 0.5;
        }
        sums
    }

    /// Found in use, R17: an environment of 8192 x 4096 crashed the run. It is scaled down to a size that every device
    /// holds, with a note, and keeps its light to a millionth.
    #[test]
    fn large_environments_are_scaled_down_and_keep_their_light() {
        // Bright spots on a dim ground, as studios and suns are.
        let light = |x: u32, y: u32| {
            let spot = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503)).is_multiple_of(997);
            Vec3::new(0.1 + (x % 7) as f32, 0.2, if spot { 5.0e4 } else { 0.3 })
        };
        for ((w, h), (tw, th)) in
            [((1000, 500), (333, 166)), ((64, 32), (64, 32)), ((7, 5), (1, 1)), ((97, 89), (96, 11))]
        {
            let texels: Vec<Vec3> = (0..w * h).map(|i| light(i % w, i / w)).collect();
            let small = box_filtered(&texels, (w, h), (tw, th));
            assert_eq!(small.len(), (tw * th) as usize);
            let [before, after] = [energies(&texels, w as usize), energies(&small, tw as usize)];
            assert!((after[0] / before[0] - 1.0).abs() < 1e-6, "{w} x {h}: {before:?} {after:?}");
            if (w, h) == (tw, th) {
                assert_eq!(small, texels);
            }
        }
        let (width, height) = (8192, 4096);
        let texels: Vec<Vec3> = (0..width * height).map(|i| light(i % width, i / width)).collect();
        let before = energies(&texels, width as usize);
        let (fitted, told) = Environment::Equirect { width, height, texels, rotation_rad: 0.5 }.fitted();
        let Environment::Equirect { width, height, texels, rotation_rad } = fitted else { panic!() };
        assert_eq!((texels.len(), rotation_rad), (width as usize * height as usize, 0.5));
        assert!(
            is_held(width, height) && (4000..4096).contains(&width) && height == width / 2,
            "{width} x {height}"
        );
        let after = energies(&texels, width as usize);
        assert!((after[0] / before[0] - 1.0).abs() < 1e-6, "{before:?} {after:?}");
        // The vertical shift is less than a row.
        assert!((after[1] - before[1]).abs() < before[0] * 1e-3, "{before:?} {after:?}");
        assert!(told.is_some_and(|t| t.contains("8192 x 4096") && t.contains(&format!("{width} x {height}"))));
        let small =
            Environment::Equirect { width: 2, height: 1, texels: vec![Vec3::ONE; 2], rotation_rad: 0.0 };
        assert!(small.fitted().1.is_none());
        assert!(Environment::Constant(Vec3::ONE).fitted().1.is_none());
    }

    #[test]
    fn scale_multiplies_and_rotation_is_kept() {
        let bytes = pfm("1 1", "-1", &[1.0f32, 2.0, 3.0].map(f32::to_le_bytes));
        let Environment::Equirect { texels, rotation_rad, .. } =
            decode_environment(&bytes, 0.5, 2.0).unwrap().environment
        else {
            panic!()
        };
        assert_eq!((texels[0], rotation_rad), (Vec3::new(2.0, 4.0, 6.0), 0.5));
    }

    /// The same picture in every order of rows and columns.
    #[test]
    fn radiance_pictures_are_read_in_all_eight_orders() {
        // Three columns, two rows; red says which texel it is.
        let texel = |x: u32, y: u32| [(10 * (1 + x + 3 * y)) as u8, 7, 9, 130];
        let upright = |bytes: &[u8]| texels(bytes).2;
        let file = |size: &str, list: Vec<[u8; 4]>| {
            [format!("#?RADIANCE\n\n{size}\n").into_bytes(), list.concat()].concat()
        };
        let rows = |ys: [u32; 2], xs: [u32; 3]| {
            ys.into_iter().flat_map(|y| xs.into_iter().map(move |x| texel(x, y))).collect::<Vec<_>>()
        };
        let columns = |xs: [u32; 3], ys: [u32; 2]| {
            xs.into_iter().flat_map(|x| ys.into_iter().map(move |y| texel(x, y))).collect::<Vec<_>>()
        };
        let (right, left, down, up) = ([0, 1, 2], [2, 1, 0], [0, 1], [1, 0]);
        let first = upright(&file("-Y 2 +X 3", rows(down, right)));
        for (size, list) in [
            ("-Y 2 -X 3", rows(down, left)),
            ("+Y 2 +X 3", rows(up, right)),
            ("+Y 2 -X 3", rows(up, left)),
            ("+X 3 -Y 2", columns(right, down)),
            ("+X 3 +Y 2", columns(right, up)),
            ("-X 3 -Y 2", columns(left, down)),
            ("-X 3 +Y 2", columns(left, up)),
        ] {
            assert_eq!(upright(&file(size, list)), first, "{size}");
        }
    }

    #[test]
    fn headers_of_other_programs_are_read_and_light_that_is_none_is_counted() {
        let case = |name: &str| {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/cases");
            decode_environment(&std::fs::read(folder.join(name)).unwrap(), 0.0, 1.0).unwrap()
        };
        assert_eq!(case("e06-latin1-header.hdr").warnings, [] as [String; 0]);
        let told = case("e09-primaries.hdr").warnings;
        assert!(told[0].contains("converted from the primaries (0.7347, 0.2653)"), "{told:?}");
        case("e05-plus-y.hdr");
        let mut values = vec![1.0f32; 60];
        (values[4], values[30], values[50]) = (-0.5, f32::INFINITY, f32::NAN);
        let bytes: Vec<[u8; 4]> = values.iter().map(|v| v.to_le_bytes()).collect();
        let sky = decode_environment(&pfm("20 1", "-1", &bytes), 0.0, 2.0).unwrap();
        let Environment::Equirect { texels, .. } = sky.environment else { panic!() };
        assert_eq!((texels[1], texels[10]), (Vec3::new(2.0, 0.0, 2.0), Vec3::new(131_008.0, 2.0, 2.0)));
        assert_eq!(texels[16].z, 0.0);
        let told = sky.warnings.join("; ");
        assert!(
            ["1 texels", "negative", "infinite", "no numbers", "at 1, 0"].iter().all(|w| told.contains(w)),
            "{told}"
        );
        // XYZE: white of equal energy is white here.
        let xyze = b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n\x80\x80\x80\x81".to_vec();
        let white = super::tests::texels(&xyze).2[0];
        assert!((white - Vec3::ONE).abs().max_element() < 1e-3, "{white}");
        // The end of a picture may be missing, and not most of it.
        let line = [128u8, 64, 0, 129];
        let cut = [b"#?RADIANCE\n\n-Y 4 +X 1\n".to_vec(), line.repeat(3)].concat();
        let sky = decode_environment(&cut, 0.0, 1.0).unwrap();
        assert!(sky.warnings[0].contains("scan line 3 of 4"), "{:?}", sky.warnings);
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_make_it_panic(kind in 0usize..3, tail in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..200)) {
            let head: &[u8] = [b"PF\n3 2\n-1\n".as_slice(), b"#?RADIANCE\n\n-Y 2 +X 9\n", b"\x89PNG\r\n\x1a\n"][kind];
            let _ = decode_environment(&[head, &tail].concat(), 0.0, 1.0);
        }
    }
}
