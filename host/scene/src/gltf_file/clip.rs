//! Clips: animated PNG files, whose pictures follow each other over and over.

use std::io::Cursor;

use image::codecs::png::PngDecoder;
use image::{AnimationDecoder, ImageDecoder, ImageError};

use super::super::limits::of_header;
use super::super::{Limits, SceneError, Texture};
use super::json::Item;
use super::picture::{check_decoded, check_size, Size};

/// Most pictures of a clip.
const MOST_PICTURES: usize = 10_000;
/// The shortest time of a picture. Files say 0 where a picture is to be gone as fast as can be.
const SHORTEST_NS: i64 = 1_000_000;

/// Decodes an animated PNG; `None` if the bytes are another picture. `texels_so_far` counts those of the scene's other textures.
///
/// # Errors
/// Damaged data, and more pictures or texels than the limits allow; the text names `item`.
pub(super) fn decode(
    item: &Item,
    bytes: &[u8],
    texels_so_far: u64,
    limits: &Limits,
) -> Result<Option<Texture>, SceneError> {
    let failed = |e: ImageError| item.error(format!("cannot be decoded: {e}"));
    if !bytes.starts_with(b"\x89PNG") {
        return Ok(None);
    }
    let Ok(mut decoder) = PngDecoder::with_limits(Cursor::new(bytes), of_header()) else { return Ok(None) };
    if !decoder.is_apng().map_err(failed)? {
        return Ok(None);
    }
    let (width, height) = decoder.dimensions();
    check_size(item, Size { width, height }, texels_so_far, limits)?;
    let mut memory = image::Limits::default();
    // As for a single picture, and one more that the next one is drawn over.
    memory.max_alloc = Some(u64::from(width) * u64::from(height) * 16 + (16 << 20));
    decoder.set_limits(memory).map_err(failed)?;
    let (mut texels, mut ends_ns, mut end) = (vec![], vec![], 0);
    for picture in decoder.apng().map_err(failed)?.into_frames() {
        let picture = picture.map_err(failed)?;
        let so_far = texels_so_far + texels.len() as u64;
        check_size(item, Size { width, height }, so_far, limits)?;
        check_decoded(item, bytes, 4 * (so_far + u64::from(width) * u64::from(height)), limits)?;
        if ends_ns.len() == MOST_PICTURES {
            return Err(item.error(format!("has more than {MOST_PICTURES} pictures")));
        }
        let (numerator, denominator) = picture.delay().numer_denom_ms();
        let lasts_ns = i64::from(numerator) * 1_000_000 / i64::from(denominator.max(1));
        end += lasts_ns.max(SHORTEST_NS);
        ends_ns.push(end);
        // Doubling what is there would take twice the memory of the whole clip.
        texels.reserve_exact(width as usize * height as usize);
        texels.extend(picture.into_buffer().as_raw().chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]));
    }
    if ends_ns.is_empty() {
        return Err(item.error("is an animated PNG without pictures"));
    }
    Ok(Some(Texture { ends_ns, ..Texture::repeated([width, height], texels, true) }))
}
