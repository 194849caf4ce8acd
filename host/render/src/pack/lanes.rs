//! The packer for registers of 16 bytes, which every x86-64 (SSE2) and every AArch64 (NEON) has.
#![allow(unsafe_code)]

use super::{pack_blocks, BitPlaneFrame, Planes, BATCH_BYTES, BLOCK_PIXELS, CODE_BITS};

/// Pixels that [`gather_rests`] takes: those of a register's bytes in each of eight planes.
const GROUP_PIXELS: usize = 128;
/// Such groups in a batch.
const GROUPS: usize = 8 * BATCH_BYTES / GROUP_PIXELS;

/// A register of 16 bytes. Interleaving takes the lower halves of both, then the upper halves; the first element is that of `self`.
trait Register: Copy {
    fn load(pixels: &[u32; 4]) -> Self;
    fn store(self, to: &mut [u8; 16]);
    fn interleave_bytes(self, other: Self) -> [Self; 2];
    fn interleave_words(self, other: Self) -> [Self; 2];
    fn interleave_doublewords(self, other: Self) -> [Self; 2];
    fn interleave_quadwords(self, other: Self) -> [Self; 2];
    /// Exchanges the bits of `self` that lie `N` places above those of `mask`, in each byte, with the bits of `other` in `mask`.
    fn exchange_bits<const N: i32>(self, other: Self, mask: u8) -> [Self; 2];
}

/// Packs with the registers of this processor.
pub(super) fn pack(codes: &[u32], frame: &mut BitPlaneFrame) {
    pack_with::<arch::Register16>(codes, frame);
}

fn pack_with<R: Register>(codes: &[u32], frame: &mut BitPlaneFrame) {
    let zero = R::load(&[0; 4]);
    let mut rests = [[[zero; 8]; GROUPS]; CODE_BITS / 8];
    pack_blocks(codes, frame, arch::put, |blocks, planes, at| pack_batch(blocks, &mut rests, planes, at));
    arch::fence();
}

/// Pixels whose numbers leave the same rest by 8 come into one register, a byte each, one set of eight registers for each channel;
/// then bits and registers change places (8 x 8 bits across the registers, 16 of them side by side \[HackersDelight\] 7-3), and each
/// register is 16 bytes of a plane. All pixels are sorted before the first bits move, since the registers do not hold both.
#[inline]
fn pack_batch<R: Register>(
    blocks: &[[u32; BLOCK_PIXELS]],
    rests: &mut [[[R; 8]; GROUPS]; CODE_BITS / 8],
    planes: &mut Planes,
    at: usize,
) {
    let pixels = blocks.as_flattened().as_chunks::<GROUP_PIXELS>().0;
    for (group, pixels) in pixels.iter().enumerate() {
        for (rests, registers) in rests.iter_mut().zip(gather_rests(pixels)) {
            rests[group] = registers;
        }
    }
    for (rests, planes) in rests.iter().zip(planes.as_chunks_mut::<8>().0) {
        for (group, rests) in rests[..pixels.len()].iter().enumerate() {
            let at = at + 16 * group;
            for (plane, bytes) in planes.iter_mut().zip(transpose_bits(*rests)) {
                let (stretch, _) = plane[at..].split_first_chunk_mut().expect("a batch holds its groups");
                bytes.store(stretch);
            }
        }
    }
}

/// For each channel the bytes of 128 pixels: register `7 - k` holds those of the pixels with rest `k` by 8, because bit 7 of a
/// plane's byte is the leftmost pixel.
#[inline(always)]
fn gather_rests<R: Register>(pixels: &[u32; GROUP_PIXELS]) -> [[R; 8]; CODE_BITS / 8] {
    let (left, right) = (gather_half::<R, 0>(pixels), gather_half::<R, 1>(pixels));
    std::array::from_fn(|channel| {
        let ([a, b, c, d], [e, f, g, h]) = (left[channel], right[channel]);
        [h, g, f, e, d, c, b, a]
    })
}

/// The same for rests 0 to 3 (`HALF` 0) or 4 to 7, in their order.
#[inline(always)]
fn gather_half<R: Register, const HALF: usize>(pixels: &[u32; GROUP_PIXELS]) -> [[R; 4]; CODE_BITS / 8] {
    let fours = pixels.as_chunks::<4>().0;
    let quarter = |i: usize| {
        let load = |row: usize| R::load(&fours[8 * i + 2 * row + HALF]);
        let [ab, ab_next] = load(0).interleave_bytes(load(1));
        let [cd, cd_next] = load(2).interleave_bytes(load(3));
        // Register k: four bytes of red, of green, of blue, of nothing.
        let ([zeroth, first], [second, third]) = (ab.interleave_words(cd), ab_next.interleave_words(cd_next));
        [zeroth, first, second, third]
    };
    let quarters = [quarter(0), quarter(1), quarter(2), quarter(3)];
    let rest = |k: usize| {
        let [a, b, c, d] = quarters.map(|quarter| quarter[k]);
        let ([rg, blue], [rg_next, blue_next]) = (a.interleave_doublewords(b), c.interleave_doublewords(d));
        let [red, green] = rg.interleave_quadwords(rg_next);
        [red, green, blue.interleave_quadwords(blue_next)[0]]
    };
    let rests = [rest(0), rest(1), rest(2), rest(3)];
    std::array::from_fn(|channel| rests.map(|rest| rest[channel]))
}

/// Bit `i` of every byte of register `j` becomes bit `j` of the same byte of register `i`.
#[inline(always)]
fn transpose_bits<R: Register>(mut r: [R; 8]) -> [R; 8] {
    for i in 0..4 {
        [r[i], r[i + 4]] = r[i].exchange_bits::<4>(r[i + 4], 0x0f);
    }
    for i in [0, 1, 4, 5] {
        [r[i], r[i + 2]] = r[i].exchange_bits::<2>(r[i + 2], 0x33);
    }
    for i in [0, 2, 4, 6] {
        [r[i], r[i + 1]] = r[i].exchange_bits::<1>(r[i + 1], 0x55);
    }
    r
}

#[cfg(target_arch = "x86_64")]
mod arch {
    pub(super) use super::super::simd::{fence, stream as put};
    use std::arch::x86_64::*;

    pub(super) type Register16 = __m128i;

    macro_rules! interleave {
        ($low:ident, $high:ident, $a:expr, $b:expr) => {
            // SAFETY: SSE2 is part of every x86-64, and the values are registers.
            unsafe { [$low($a, $b), $high($a, $b)] }
        };
    }

    impl super::Register for __m128i {
        #[inline(always)]
        fn load(pixels: &[u32; 4]) -> Self {
            // SAFETY: 16 readable bytes; the load needs no alignment.
            unsafe { _mm_loadu_si128(pixels.as_ptr().cast()) }
        }

        #[inline(always)]
        fn store(self, to: &mut [u8; 16]) {
            // SAFETY: 16 writable bytes; the store needs no alignment.
            unsafe { _mm_storeu_si128(to.as_mut_ptr().cast(), self) }
        }

        #[inline(always)]
        fn interleave_bytes(self, other: Self) -> [Self; 2] {
            interleave!(_mm_unpacklo_epi8, _mm_unpackhi_epi8, self, other)
        }

        #[inline(always)]
        fn interleave_words(self, other: Self) -> [Self; 2] {
            interleave!(_mm_unpacklo_epi16, _mm_unpackhi_epi16, self, other)
        }

        #[inline(always)]
        fn interleave_doublewords(self, other: Self) -> [Self; 2] {
            interleave!(_mm_unpacklo_epi32, _mm_unpackhi_epi32, self, other)
        }

        #[inline(always)]
        fn interleave_quadwords(self, other: Self) -> [Self; 2] {
            interleave!(_mm_unpacklo_epi64, _mm_unpackhi_epi64, self, other)
        }

        #[inline(always)]
        fn exchange_bits<const N: i32>(self, other: Self, mask: u8) -> [Self; 2] {
            // SAFETY: as in `interleave!`.
            unsafe {
                let moved = _mm_xor_si128(_mm_srli_epi16::<N>(self), other);
                let moved = _mm_and_si128(moved, _mm_set1_epi8(mask as i8));
                [_mm_xor_si128(self, _mm_slli_epi16::<N>(moved)), _mm_xor_si128(other, moved)]
            }
        }
    }
}

#[cfg(target_arch = "aarch64")]
mod arch {
    pub(super) use super::super::copy as put;
    use std::arch::aarch64::*;

    pub(super) fn fence() {}

    pub(super) type Register16 = uint8x16_t;

    /// Interleaves elements of one width.
    macro_rules! interleave {
        ($of_bytes:ident, $to_bytes:ident, $low:ident, $high:ident, $a:expr, $b:expr) => {{
            // SAFETY: NEON is part of every AArch64 target of this program, and the values are registers.
            unsafe {
                let (a, b) = ($of_bytes($a), $of_bytes($b));
                [$to_bytes($low(a, b)), $to_bytes($high(a, b))]
            }
        }};
    }

    impl super::Register for uint8x16_t {
        #[inline(always)]
        fn load(pixels: &[u32; 4]) -> Self {
            // SAFETY: 16 readable bytes; the load needs no alignment.
            unsafe { vreinterpretq_u8_u32(vld1q_u32(pixels.as_ptr())) }
        }

        #[inline(always)]
        fn store(self, to: &mut [u8; 16]) {
            // SAFETY: 16 writable bytes; the store needs no alignment.
            unsafe { vst1q_u8(to.as_mut_ptr(), self) }
        }

        #[inline(always)]
        fn interleave_bytes(self, other: Self) -> [Self; 2] {
            // SAFETY: as in `interleave!`.
            unsafe { [vzip1q_u8(self, other), vzip2q_u8(self, other)] }
        }

        #[inline(always)]
        fn interleave_words(self, other: Self) -> [Self; 2] {
            interleave!(vreinterpretq_u16_u8, vreinterpretq_u8_u16, vzip1q_u16, vzip2q_u16, self, other)
        }

        #[inline(always)]
        fn interleave_doublewords(self, other: Self) -> [Self; 2] {
            interleave!(vreinterpretq_u32_u8, vreinterpretq_u8_u32, vzip1q_u32, vzip2q_u32, self, other)
        }

        #[inline(always)]
        fn interleave_quadwords(self, other: Self) -> [Self; 2] {
            interleave!(vreinterpretq_u64_u8, vreinterpretq_u8_u64, vzip1q_u64, vzip2q_u64, self, other)
        }

        #[inline(always)]
        fn exchange_bits<const N: i32>(self, other: Self, mask: u8) -> [Self; 2] {
            // SAFETY: as in `interleave!`.
            unsafe {
                let moved = vandq_u8(veorq_u8(vshrq_n_u8::<N>(self), other), vdupq_n_u8(mask));
                [veorq_u8(self, vshlq_n_u8::<N>(moved)), veorq_u8(other, moved)]
            }
        }
    }
}
