//! What the host reads of a pixel for checks and pictures, put together from the parts in which the GPU keeps it.

use bytemuck::{Pod, Zeroable};
use dpm_shaders::structs::{
    in_blocks, part, Barycentric, HistoryLight, HistoryNoise, HistoryPlace, HistorySeed, HistoryTag,
    HistoryUsed, Part, Sight, SurfaceHit, Tint, HISTORY_EXACT, HISTORY_USED, NO_FRAME, NO_HIT, PART_BLOCK,
};

/// What the projector ray of a pixel met.
#[derive(Clone, Copy, Debug, PartialEq, Zeroable)]
#[repr(C)]
pub struct Surface {
    /// Instance in the high 8 bits, triangle of the body in BVH order in the low 24; `NO_HIT`: nothing.
    pub id: u32,
    /// Barycentric weights of vertices 1 and 2.
    pub barycentric: [f32; 2],
    /// Distance from the projector along the unit ray; negative: not lit (the eye cannot see it).
    pub distance: f32,
}

/// Where the surface point of a pixel moves, how the eye sees it, and what its light is divided by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Guide {
    /// Motion, apparent size and angle from the gaze.
    pub sight: Sight,
    /// Reflectance (method dpm).
    pub tint: Tint,
}

/// What former frames say about the surface point that a pixel shows.
#[derive(Clone, Copy, Debug, PartialEq, Zeroable)]
#[repr(C)]
pub struct History {
    /// The light that they found.
    pub light: HistoryLight,
    /// Where the point is.
    pub place: HistoryPlace,
    /// How far the light can be trusted (method dpm).
    pub noise: HistoryNoise,
    /// Whose history it is.
    pub tag: HistoryTag,
    /// Which sample sequence the point has.
    pub seed: HistorySeed,
    /// How far it was used before the frame.
    pub used: HistoryUsed,
}

impl Surface {
    /// Bytes of a pixel.
    pub(crate) const BYTES: usize = part("B_SURFACES", "hit").all;

    /// Light falls on it: something was met, and the eye sees it. As `is_lit` of the shaders.
    pub fn is_lit(&self) -> bool {
        self.id != NO_HIT && self.distance > 0.0
    }

    /// Bytes of the buffer for so many pixels.
    pub(crate) fn buffer_bytes(pixels: usize) -> usize {
        in_blocks(pixels) * Self::BYTES
    }

    /// Those of all pixels, from the bytes of the buffer.
    pub(crate) fn all(bytes: &[u8], pixels: usize) -> Vec<Self> {
        let hits = elements::<SurfaceHit>(bytes, part("B_SURFACES", "hit"), pixels);
        let inside = elements::<Barycentric>(bytes, part("B_SURFACES", "inside"), pixels);
        let both = hits.into_iter().zip(inside);
        both.map(|(hit, b)| Self { id: hit.id, barycentric: b.weights, distance: hit.distance }).collect()
    }

    /// The bytes of a block of pixels whose rays met nothing.
    pub(crate) fn block_of_none() -> [u8; PART_BLOCK * Self::BYTES] {
        let bytes = Self::bytes_of(&[Self { id: NO_HIT, ..Self::zeroed() }; PART_BLOCK]);
        std::array::from_fn(|i| bytes[i])
    }

    /// The bytes of the buffer that holds `all`.
    pub fn bytes_of(all: &[Self]) -> Vec<u8> {
        let mut bytes = vec![0; Self::buffer_bytes(all.len())];
        let hits = all.iter().map(|s| SurfaceHit { id: s.id, distance: s.distance });
        place_elements(&mut bytes, part("B_SURFACES", "hit"), hits);
        let inside = all.iter().map(|s| Barycentric { weights: s.barycentric });
        place_elements(&mut bytes, part("B_SURFACES", "inside"), inside);
        bytes
    }
}

impl Guide {
    /// Bytes of a pixel.
    pub(crate) const BYTES: usize = part("B_GUIDES", "sight").all;

    /// Bytes of the buffer for so many pixels.
    pub(crate) fn buffer_bytes(pixels: usize) -> usize {
        in_blocks(pixels) * Self::BYTES
    }

    /// Those of all pixels, from the bytes of the buffer.
    pub(crate) fn all(bytes: &[u8], pixels: usize) -> Vec<Self> {
        let sights = elements::<Sight>(bytes, part("B_GUIDES", "sight"), pixels);
        let tints = elements::<Tint>(bytes, part("B_GUIDES", "tint"), pixels);
        sights.into_iter().zip(tints).map(|(sight, tint)| Self { sight, tint }).collect()
    }
}

impl History {
    /// Bytes of a pixel.
    pub const BYTES: usize = part("B_HISTORY", "light").all;

    /// Chance had no part in the last frame's light.
    pub fn is_exact(&self) -> bool {
        self.noise.body_and_used & HISTORY_EXACT != 0
    }

    /// Samples of the point's sequence that were used.
    pub fn samples_used(&self) -> u32 {
        self.noise.body_and_used & HISTORY_USED
    }

    /// Those of all pixels, from the bytes of the buffer.
    pub(crate) fn all(bytes: &[u8], pixels: usize) -> Vec<Self> {
        let lights = elements::<HistoryLight>(bytes, part("B_HISTORY", "light"), pixels);
        let places = elements::<HistoryPlace>(bytes, part("B_HISTORY", "place"), pixels);
        let noises = elements::<HistoryNoise>(bytes, part("B_HISTORY", "noise"), pixels);
        let tags = elements::<HistoryTag>(bytes, part("B_HISTORY", "tag"), pixels);
        let seeds = elements::<HistorySeed>(bytes, part("B_HISTORY", "seed"), pixels);
        let uses = elements::<HistoryUsed>(bytes, part("B_HISTORY", "used"), pixels);
        let of = |i: usize| Self {
            light: lights[i],
            place: places[i],
            noise: noises[i],
            tag: tags[i],
            seed: seeds[i],
            used: uses[i],
        };
        (0..pixels).map(of).collect()
    }

    /// Bytes of the buffer for so many pixels.
    pub(crate) fn buffer_bytes(pixels: usize) -> usize {
        in_blocks(pixels) * Self::BYTES
    }

    /// The bytes of a block of pixels of which nothing is known.
    pub(crate) fn block_of_none() -> [u8; PART_BLOCK * Self::BYTES] {
        let none = Self { tag: HistoryTag { frame: NO_FRAME, ..Zeroable::zeroed() }, ..Self::zeroed() };
        let bytes = Self::bytes_of(&[none; PART_BLOCK]);
        std::array::from_fn(|i| bytes[i])
    }

    /// The bytes of the buffer that holds `all`.
    pub(crate) fn bytes_of(all: &[Self]) -> Vec<u8> {
        let mut bytes = vec![0; Self::buffer_bytes(all.len())];
        place_elements(&mut bytes, part("B_HISTORY", "light"), all.iter().map(|h| h.light));
        place_elements(&mut bytes, part("B_HISTORY", "place"), all.iter().map(|h| h.place));
        place_elements(&mut bytes, part("B_HISTORY", "noise"), all.iter().map(|h| h.noise));
        place_elements(&mut bytes, part("B_HISTORY", "tag"), all.iter().map(|h| h.tag));
        place_elements(&mut bytes, part("B_HISTORY", "seed"), all.iter().map(|h| h.seed));
        place_elements(&mut bytes, part("B_HISTORY", "used"), all.iter().map(|h| h.used));
        bytes
    }
}

/// The elements of a part of a buffer, one for each pixel.
pub(crate) fn elements<T: Pod>(bytes: &[u8], part: Part, pixels: usize) -> Vec<T> {
    assert_eq!(part.bytes, size_of::<T>(), "{}.{}", part.binding, part.name);
    let at = |pixel| &bytes[part.index(pixel) * part.bytes..][..part.bytes];
    (0..pixels).map(|pixel| bytemuck::pod_read_unaligned(at(pixel))).collect()
}

/// Writes such elements.
fn place_elements<T: Pod>(bytes: &mut [u8], part: Part, values: impl Iterator<Item = T>) {
    assert_eq!(part.bytes, size_of::<T>(), "{}.{}", part.binding, part.name);
    for (pixel, value) in values.enumerate() {
        bytes[part.index(pixel) * part.bytes..][..part.bytes].copy_from_slice(bytemuck::bytes_of(&value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The order of the parts in memory is declared once, in `dpm_shaders::structs::PARTS`, and the parts of a pixel fill it without gaps.
    #[test]
    fn histories_survive_the_way_into_their_parts_and_back() {
        let history = |i: u32| History {
            light: HistoryLight { weight: i as f32, ..HistoryLight::zeroed() },
            place: HistoryPlace { normal: i + 100, ..HistoryPlace::zeroed() },
            noise: HistoryNoise { body_and_used: i + 200, ..HistoryNoise::zeroed() },
            tag: HistoryTag { frame: i + 300, ..HistoryTag::zeroed() },
            seed: HistorySeed { seed: i + 400 },
            used: HistoryUsed { before: i as i32 + 500 },
        };
        let all: Vec<_> = (0..200).map(history).collect();
        let bytes = History::bytes_of(&all);
        assert_eq!(bytes.len(), 256 * History::BYTES);
        assert_eq!(History::all(&bytes, 200), all);
        let end = |binding| {
            dpm_shaders::structs::PARTS
                .iter()
                .filter(|p| p.binding == binding)
                .map(|p| p.before + p.bytes)
                .max()
        };
        assert_eq!(
            (end("B_HISTORY"), end("B_FORMER"), end("B_GUIDES"), end("B_SURFACES")),
            (Some(64), Some(64), Some(Guide::BYTES), Some(Surface::BYTES))
        );
    }
}
