//! Decides what to send of each plane of a frame: nothing for a plane that did not change, else the shortest of raw,
//! RLE, XOR + RLE and LZ4.
//!
//! Trying every codec on every plane would cost more than it saves. So each plane keeps the codec that won last time,
//! and the others are tried again every [`RETRIAL`] frames, staggered so that the cost per frame stays even. A codec
//! that takes the host longer has to save more bytes. LZ4 takes several times longer than all others here. It is
//! therefore used only when the medium refuses frames, and then for the planes where it saves most, as many as half a
//! frame's time allows. So the processor never slows down a cable that is fast enough.

use lz4_flex::block::{compress_into_with_table, get_maximum_output_size, CompressTable};

use super::codec::rle_encode;
use crate::packet::Codec;
use crate::planes::{Raster, MAX_PLANES};

/// Frames between two trials of all codecs on a plane.
const RETRIAL: u32 = 16;
/// Frames for which a refusal of the medium is remembered.
const REMEMBERED: u32 = 64;
/// Assumed time of LZ4 per byte, nanoseconds; measured on noisy planes: 0.4 to 1 on one core of 2020.
const LZ4_NS_PER_BYTE: i64 = 1;

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

/// Keeps the previously sent frame and the best codec of each plane. Allocates only in [`Compactor::new`].
pub(super) struct Compactor {
    plane_bytes: usize,
    codecs: u32,
    /// The planes of the previously sent frame.
    before: Vec<u8>,
    coded: Vec<u8>,
    difference: Vec<u8>,
    scratch: Vec<u8>,
    table: CompressTable,
    favourite: [Codec; MAX_PLANES],
    /// Bytes that LZ4 saved over the next best codec in its last trial.
    lz4_saves: [usize; MAX_PLANES],
    /// Planes of a frame that LZ4 has time for.
    lz4_planes: usize,
    /// Frames for which the medium still counts as the bottleneck.
    pressed: u32,
    /// Bit k: plane k's best codec was chosen while a base frame was available.
    tried_base: u32,
    frames: u32,
    /// Bit k: plane k differs from the frame sent before.
    changed: u32,
    /// Bytes that were read and written.
    touched: u64,
}

impl std::fmt::Debug for Compactor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Compactor").field("codecs", &self.codecs).field("frames", &self.frames).finish()
    }
}

impl Compactor {
    /// For frames of `planes` planes every `frame_ns` nanoseconds; `codecs` is the mask of the permitted codecs.
    pub(super) fn new(raster: Raster, planes: usize, frame_ns: i64, codecs: u32) -> Self {
        let plane_bytes = raster.plane_bytes();
        let lz4_ns = LZ4_NS_PER_BYTE * plane_bytes as i64;
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
            lz4_saves: [0; MAX_PLANES],
            lz4_planes: usize::try_from(frame_ns / 2 / lz4_ns.max(1)).unwrap_or(0).clamp(1, MAX_PLANES),
            pressed: 0,
            tried_base: 0,
            frames: 0,
            changed: u32::MAX,
            touched: 0,
        }
    }

    /// Restricts the codecs to those that the device decodes too.
    pub(super) fn restrict(&mut self, codecs: u32) {
        self.codecs &= codecs | Codec::Raw.mask();
    }

    /// The medium had no room for a frame: saving bytes is now worth more of the host's time.
    pub(super) fn refused(&mut self) {
        self.pressed = REMEMBERED;
    }

    /// Chooses the form of every plane of `planes`. Without `has_base` no plane refers to the previous frame.
    pub(super) fn compact(&mut self, planes: &[u8], has_base: bool) -> [PlaneForm; MAX_PLANES] {
        let mut forms = [PlaneForm::Raw; MAX_PLANES];
        self.frames = self.frames.wrapping_add(1);
        self.pressed = self.pressed.saturating_sub(1);
        self.changed = 0;
        for (k, plane) in planes.chunks_exact(self.plane_bytes).enumerate() {
            forms[k] = self.plane(k, plane, has_base);
        }
        forms
    }

    fn plane(&mut self, k: usize, plane: &[u8], has_base: bool) -> PlaneForm {
        let share = k * self.plane_bytes..(k + 1) * self.plane_bytes;
        if has_base {
            let (is_kept, compared) = are_equal(&self.before[share.clone()], plane);
            self.touched += 2 * compared;
            if is_kept {
                return PlaneForm::Kept;
            }
        }
        self.changed |= 1 << k;
        let trial = self.frames.wrapping_add(k as u32).is_multiple_of(RETRIAL)
            || self.frames == 1
            || (has_base && self.tried_base >> k & 1 == 0);
        let favourite = self.favourite[k];
        let lz4 = self.has_time_for_lz4(k, trial);
        let mut best = (Codec::Raw, self.plane_bytes);
        for codec in [Codec::Rle, Codec::XorRle, Codec::Lz4] {
            let usable = self.codecs & codec.mask() != 0
                && match codec {
                    Codec::XorRle => has_base && (trial || codec == favourite),
                    Codec::Lz4 => lz4 && (trial || codec == favourite),
                    // The fallback while the best codec is unavailable.
                    _ => trial || codec == favourite || (codec_waits(favourite, has_base, lz4)),
                };
            let Some(below) = best.1.checked_sub(self.plane_bytes / worth(codec)).filter(|_| usable) else {
                continue;
            };
            if let Some(n) = self.encode(codec, plane, share.clone(), below) {
                if codec == Codec::Lz4 {
                    self.lz4_saves[k] = best.1 - n;
                }
                self.coded[share.start..share.start + n].copy_from_slice(&self.scratch[..n]);
                self.touched += 3 * n as u64;
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

    /// True when LZ4 may be used on plane `k`: it is the only codec, or the medium is the bottleneck and the plane is
    /// one of those where it saves most.
    fn has_time_for_lz4(&self, k: usize, trial: bool) -> bool {
        if self.codecs & (Codec::Rle.mask() | Codec::XorRle.mask()) == 0 {
            return true;
        }
        let saves = self.lz4_saves;
        let ahead = (0..MAX_PLANES).filter(|&j| (saves[j], k) > (saves[k], j)).count();
        self.pressed > 0 && (trial || ahead < self.lz4_planes)
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
        // The plane is read; for the difference the one before is read too, and the difference is written and read.
        self.touched += plane.len() as u64 * if codec == Codec::XorRle { 4 } else { 1 };
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
    pub(super) fn coded(&self, k: usize, n: usize) -> &[u8] {
        &self.coded[k * self.plane_bytes..][..n]
    }

    /// The frame that was compacted last was sent: the next frame refers to it.
    pub(super) fn sent(&mut self, planes: &[u8]) {
        let pairs = self.before.chunks_exact_mut(self.plane_bytes).zip(planes.chunks_exact(self.plane_bytes));
        for (k, (before, plane)) in pairs.enumerate() {
            if self.changed >> k & 1 == 1 {
                before.copy_from_slice(plane);
                self.touched += 2 * plane.len() as u64;
            }
        }
    }

    /// Bytes that the processor has read and written since this was asked last.
    pub(super) fn take_touched(&mut self) -> u64 {
        core::mem::take(&mut self.touched)
    }
}

/// Whether two planes are equal, and how many bytes of each were read to see it.
fn are_equal(before: &[u8], plane: &[u8]) -> (bool, u64) {
    const STEP: usize = 1024;
    let pieces = before.chunks(STEP).zip(plane.chunks(STEP));
    match pieces.enumerate().find(|(_, (a, b))| a != b) {
        Some((k, _)) => (false, ((k + 1) * STEP).min(plane.len()) as u64),
        None => (true, plane.len() as u64),
    }
}

/// True when a plane whose best codec is `favourite` cannot use it now.
fn codec_waits(favourite: Codec, has_base: bool, lz4: bool) -> bool {
    (favourite == Codec::XorRle && !has_base) || (favourite == Codec::Lz4 && !lz4)
}

/// A codec must save this fraction of a plane compared with any cheaper form: compared with the raw plane, and each
/// codec compared with the one before it.
const fn worth(codec: Codec) -> usize {
    match codec {
        Codec::Raw | Codec::Rle => 32,
        // A second pass over the plane, and for the device a copy of its base.
        Codec::XorRle => 24,
        Codec::Lz4 => 16,
    }
}

#[cfg(test)]
#[path = "compact_tests.rs"]
mod tests;
