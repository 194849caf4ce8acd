//! A frame's planes into what has to be sent of them: nothing for a plane that did not change, else the shortest of raw, RLE, XOR + RLE
//! and LZ4.
//!
//! Trying every codec on every plane would cost more than it saves: each plane keeps the codec that won last time and the others
//! are tried again every [`RETRIAL`] frames, staggered so that a frame's cost stays even.

use lz4_flex::block::{compress_into_with_table, get_maximum_output_size, CompressTable};

use super::codec::rle_encode;
use super::header::Codec;
use crate::planes::{Raster, MAX_PLANES};

/// Frames between two trials of all codecs on a plane.
const RETRIAL: u32 = 16;

/// What to send of one plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PlaneForm {
    /// Nothing: it equals the base frame's.
    Kept,
    /// The plane itself.
    Raw,
    /// This many bytes of the plane's share of [`Compactor::coded`].
    Coded(Codec, usize),
}

/// Keeps the frame sent before and the codec that each plane likes. Allocates only in [`Compactor::new`].
pub(super) struct Compactor {
    plane_bytes: usize,
    codecs: u32,
    /// The planes of the frame sent before.
    before: Vec<u8>,
    coded: Vec<u8>,
    difference: Vec<u8>,
    scratch: Vec<u8>,
    table: CompressTable,
    favourite: [Codec; MAX_PLANES],
    /// Bit k: plane k's favourite was chosen with a base frame at hand.
    tried_base: u32,
    frames: u32,
}

impl std::fmt::Debug for Compactor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Compactor").field("codecs", &self.codecs).field("frames", &self.frames).finish()
    }
}

impl Compactor {
    /// For frames of `planes` planes; `codecs` is the mask of those allowed.
    pub fn new(raster: Raster, planes: usize, codecs: u32) -> Self {
        let plane_bytes = raster.plane_bytes();
        Self {
            plane_bytes,
            codecs,
            before: vec![0; plane_bytes * planes],
            coded: vec![0; plane_bytes * planes],
            difference: vec![0; plane_bytes],
            scratch: vec![0; get_maximum_output_size(plane_bytes)],
            table: if plane_bytes < u16::MAX as usize {
                CompressTable::small()
            } else {
                CompressTable::large()
            },
            favourite: [Codec::Raw; MAX_PLANES],
            tried_base: 0,
            frames: 0,
        }
    }

    /// Narrows the codecs to those that the device reads, too.
    pub fn restrict(&mut self, codecs: u32) {
        self.codecs &= codecs | Codec::Raw.mask();
    }

    /// Chooses the form of every plane of `planes`. Without `has_base` no plane refers to the frame before.
    pub fn compact(&mut self, planes: &[u8], has_base: bool) -> [PlaneForm; MAX_PLANES] {
        let mut forms = [PlaneForm::Raw; MAX_PLANES];
        self.frames = self.frames.wrapping_add(1);
        for (k, plane) in planes.chunks_exact(self.plane_bytes).enumerate() {
            forms[k] = self.plane(k, plane, has_base);
        }
        forms
    }

    fn plane(&mut self, k: usize, plane: &[u8], has_base: bool) -> PlaneForm {
        let share = k * self.plane_bytes..(k + 1) * self.plane_bytes;
        if has_base && self.before[share.clone()] == *plane {
            return PlaneForm::Kept;
        }
        let trial = self.frames.wrapping_add(k as u32).is_multiple_of(RETRIAL)
            || self.frames == 1
            || (has_base && self.tried_base >> k & 1 == 0);
        let favourite = self.favourite[k];
        // Less than a 32nd saved is not worth the decoder's time.
        let mut best = (Codec::Raw, self.plane_bytes - self.plane_bytes / 32);
        for codec in [Codec::XorRle, Codec::Rle, Codec::Lz4] {
            if self.codecs & codec.mask() == 0
                || (codec == Codec::XorRle && !has_base)
                || !(trial
                    || codec == favourite
                    || (favourite == Codec::XorRle && codec == Codec::Rle && !has_base))
            {
                continue;
            }
            if let Some(n) = self.encode(codec, plane, share.clone(), best.1) {
                self.coded[share.start..share.start + n].copy_from_slice(&self.scratch[..n]);
                best = (codec, n);
            }
        }
        if trial {
            self.favourite[k] = best.0;
            self.tried_base |= u32::from(has_base) << k;
        }
        if best.0 == Codec::Raw {
            PlaneForm::Raw
        } else {
            PlaneForm::Coded(best.0, best.1)
        }
    }

    /// Writes `plane` by `codec` into the scratch buffer if that takes fewer than `below` bytes.
    fn encode(
        &mut self,
        codec: Codec,
        plane: &[u8],
        share: std::ops::Range<usize>,
        below: usize,
    ) -> Option<usize> {
        let room = below.checked_sub(1)?;
        match codec {
            Codec::Raw => None,
            Codec::Rle => rle_encode(plane, &mut self.scratch[..room]),
            Codec::XorRle => {
                for ((d, a), b) in self.difference.iter_mut().zip(plane).zip(&self.before[share]) {
                    *d = a ^ b;
                }
                rle_encode(&self.difference, &mut self.scratch[..room])
            }
            Codec::Lz4 => {
                let n = compress_into_with_table(plane, &mut self.scratch, &mut self.table).ok()?;
                (n <= room).then_some(n)
            }
        }
    }

    /// The first `n` bytes of plane `k` as [`Compactor::compact`] coded it.
    pub fn coded(&self, k: usize, n: usize) -> &[u8] {
        &self.coded[k * self.plane_bytes..][..n]
    }

    /// The frame went out: it is what the next one refers to.
    pub fn sent(&mut self, planes: &[u8]) {
        self.before.copy_from_slice(planes);
    }
}
