//! The packers for x86-64 beyond its common registers: blocks of 512 pixels, a whole cache line of every plane at once.
#![allow(unsafe_code)]

use super::quantise::{quantise_scalar, QuantiseCounts, ROUND};
use super::{pack_blocks, BitPlaneFrame, Planes, BATCH_BYTES, BLOCK_BYTES, BLOCK_PIXELS, CODE_BITS};
use std::arch::x86_64::*;

pub(super) fn has_avx2() -> bool {
    is_x86_feature_detected!("avx2")
}

pub(super) fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512vbmi")
        && is_x86_feature_detected!("gfni")
}

/// Packs with AVX2; falls back to the scalar packer where there is none.
pub(super) fn pack_avx2(codes: &[u32], frame: &mut BitPlaneFrame) {
    if !has_avx2() {
        return super::scalar::pack(codes, frame);
    }
    // SAFETY: the CPU has AVX2, as just checked.
    unsafe { pack_with_avx2(codes, frame) }
}

/// Packs with AVX-512 and GFNI; falls back to the scalar packer where there is none.
pub(super) fn pack_avx512(codes: &[u32], frame: &mut BitPlaneFrame) {
    if !has_avx512() {
        return super::scalar::pack(codes, frame);
    }
    // SAFETY: the CPU has all four features, as just checked.
    unsafe { pack_with_avx512(codes, frame) }
}

/// Moves a batch of a plane past the caches to where it belongs. The thread that sends the planes runs on another core and has read
/// the frame before from the same memory, so a usual store would first fetch every line from there: packing takes twice the time
/// then, and the planes displace from the caches what the stages share. End with [`fence`].
#[inline]
pub(super) fn stream(to: &mut [u8; BATCH_BYTES], from: &[u8; BATCH_BYTES]) {
    let (to_registers, from_registers) = (to.as_mut_ptr().cast::<__m128i>(), from.as_ptr().cast::<__m128i>());
    // Miri does not have these stores.
    if cfg!(miri) || !to_registers.is_aligned() {
        *to = *from;
        return;
    }
    for i in 0..BATCH_BYTES / 16 {
        // SAFETY: 16 bytes within each array; the target is aligned, as just checked, and the load needs no alignment.
        unsafe { _mm_stream_si128(to_registers.add(i), _mm_loadu_si128(from_registers.add(i))) };
    }
}

/// Stores past the caches are not ordered by the hand-off that follows them.
pub(super) fn fence() {
    if !cfg!(miri) {
        // SAFETY: SSE is part of every x86-64.
        unsafe { _mm_sfence() };
    }
}

#[target_feature(enable = "avx2")]
fn pack_with_avx2(codes: &[u32], frame: &mut BitPlaneFrame) {
    let mut rests = Rests([[[_mm256_setzero_si256(); 4]; GROUPS]; CODE_BITS / 8]);
    pack_blocks(codes, frame, stream, |blocks, planes, at| blocks_avx2(blocks, &mut rests, planes, at));
    fence();
}

#[target_feature(enable = "avx512f,avx512bw,avx512vbmi,gfni")]
fn pack_with_avx512(codes: &[u32], frame: &mut BitPlaneFrame) {
    pack_blocks(codes, frame, stream, |blocks, planes, at| {
        for (i, pixels) in blocks.iter().enumerate() {
            block_avx512(pixels, planes, at + BLOCK_BYTES * i);
        }
    });
    fence();
}

/// Pixels that [`gather_rests`] takes.
const GROUP_PIXELS: usize = 128;
/// Such groups in a batch.
const GROUPS: usize = 8 * BATCH_BYTES / GROUP_PIXELS;

/// A batch's pixels, sorted: for each channel, group and rest by 4 the register of [`gather_rests`]. 12 KiB.
struct Rests([[[__m256i; 4]; GROUPS]; CODE_BITS / 8]);

/// Pixels whose numbers leave the same rest by 8 come into one register, a byte each, one set of eight registers for each channel;
/// then bits and registers change places (8 x 8 bits across the registers, 32 of them side by side \[HackersDelight\] 7-3), and each
/// register is 32 bytes of a plane. No `movemask`: it passes one register a cycle, shifts several. All pixels are sorted before
/// the first bits move, since the registers do not hold both.
#[inline]
#[target_feature(enable = "avx2")]
fn blocks_avx2(blocks: &[[u32; BLOCK_PIXELS]], rests: &mut Rests, planes: &mut Planes, at: usize) {
    let pixels = blocks.as_flattened().as_chunks::<GROUP_PIXELS>().0;
    for (group, pixels) in pixels.iter().enumerate() {
        for (rests, registers) in rests.0.iter_mut().zip(gather_rests(pixels)) {
            rests[group] = registers;
        }
    }
    for (rests, planes) in rests.0.iter().zip(planes.as_chunks_mut::<8>().0) {
        let pairs = rests[..pixels.len()].as_chunks::<2>().0;
        for (pair, [first, second]) in pairs.iter().enumerate() {
            let mut eight = [_mm256_setzero_si256(); 8];
            for k in 0..4 {
                // The last rest first: bit 7 of a plane's byte is the leftmost pixel.
                eight[7 - k] = _mm256_permute2x128_si256::<0x20>(first[k], second[k]);
                eight[3 - k] = _mm256_permute2x128_si256::<0x31>(first[k], second[k]);
            }
            let at = at + 32 * pair;
            for (plane, bytes) in planes.iter_mut().zip(transpose_bits(eight)) {
                let stretch = &mut plane[at..at + 32];
                // SAFETY: the slice has 32 bytes; the store needs no alignment.
                unsafe { _mm256_storeu_si256(stretch.as_mut_ptr().cast(), bytes) };
            }
        }
    }
}

/// 128 pixels into four registers for each channel: register `k` holds the 16 bytes of the pixels with rest `k` by 8 in its
/// lower half, those with rest `k + 4` in its upper half. Only interleavings, so that no shift and no mask is needed.
#[inline]
#[target_feature(enable = "avx2")]
fn gather_rests(pixels: &[u32; GROUP_PIXELS]) -> [[__m256i; 4]; CODE_BITS / 8] {
    let mut fours = [[_mm256_setzero_si256(); 4]; 4];
    for (four, pixels) in fours.iter_mut().zip(pixels.as_chunks::<32>().0) {
        let load = |i: usize| {
            // SAFETY: pixels 8 i to 8 i + 8 of an array of 32; the load needs no alignment.
            unsafe { _mm256_loadu_si256(pixels.as_ptr().add(8 * i).cast()) }
        };
        let (a, b, c, d) = (load(0), load(1), load(2), load(3));
        let (ab, ab_next) = (_mm256_unpacklo_epi8(a, b), _mm256_unpackhi_epi8(a, b));
        let (cd, cd_next) = (_mm256_unpacklo_epi8(c, d), _mm256_unpackhi_epi8(c, d));
        // Each half of register k: four bytes of red, of green, of blue, of nothing.
        *four = [
            _mm256_unpacklo_epi16(ab, cd),
            _mm256_unpackhi_epi16(ab, cd),
            _mm256_unpacklo_epi16(ab_next, cd_next),
            _mm256_unpackhi_epi16(ab_next, cd_next),
        ];
    }
    let mut channels = [[_mm256_setzero_si256(); 4]; CODE_BITS / 8];
    for k in 0..4 {
        let [a, b, c, d] = [fours[0][k], fours[1][k], fours[2][k], fours[3][k]];
        let (rg, rg_next) = (_mm256_unpacklo_epi32(a, b), _mm256_unpacklo_epi32(c, d));
        let (blue, blue_next) = (_mm256_unpackhi_epi32(a, b), _mm256_unpackhi_epi32(c, d));
        channels[0][k] = _mm256_unpacklo_epi64(rg, rg_next);
        channels[1][k] = _mm256_unpackhi_epi64(rg, rg_next);
        channels[2][k] = _mm256_unpacklo_epi64(blue, blue_next);
    }
    channels
}

/// Bit `i` of every byte of register `j` becomes bit `j` of the same byte of register `i`.
#[inline]
#[target_feature(enable = "avx2")]
fn transpose_bits(mut r: [__m256i; 8]) -> [__m256i; 8] {
    let nibbles = _mm256_set1_epi8(0x0f);
    for i in 0..4 {
        let t = _mm256_and_si256(_mm256_xor_si256(_mm256_srli_epi16::<4>(r[i]), r[i + 4]), nibbles);
        r[i + 4] = _mm256_xor_si256(r[i + 4], t);
        r[i] = _mm256_xor_si256(r[i], _mm256_slli_epi16::<4>(t));
    }
    let pairs = _mm256_set1_epi8(0x33);
    for i in [0, 1, 4, 5] {
        let t = _mm256_and_si256(_mm256_xor_si256(_mm256_srli_epi16::<2>(r[i]), r[i + 2]), pairs);
        r[i + 2] = _mm256_xor_si256(r[i + 2], t);
        r[i] = _mm256_xor_si256(r[i], _mm256_slli_epi16::<2>(t));
    }
    let singles = _mm256_set1_epi8(0x55);
    for i in [0, 2, 4, 6] {
        let t = _mm256_and_si256(_mm256_xor_si256(_mm256_srli_epi16::<1>(r[i]), r[i + 1]), singles);
        r[i + 1] = _mm256_xor_si256(r[i + 1], t);
        // An addition is a shift by one.
        r[i] = _mm256_xor_si256(r[i], _mm256_add_epi8(t, t));
    }
    r
}

/// Indices into two registers of 16 pixels: byte `first` of each of the 32 pixels, then byte `second`.
const fn bytes_of_channels(first: u8, second: u8) -> [u8; 64] {
    let mut out = [0; 64];
    let mut i = 0;
    while i < 32 {
        out[i] = 4 * i as u8 + first;
        out[i + 32] = 4 * i as u8 + second;
        i += 1;
    }
    out
}

/// Indices that transpose a register of 8 x 8 bytes.
const fn transposed_bytes() -> [u8; 64] {
    let mut out = [0; 64];
    let mut i = 0;
    while i < 64 {
        out[i] = (8 * (i % 8) + i / 8) as u8;
        i += 1;
    }
    out
}

static RED_GREEN: [u8; 64] = bytes_of_channels(0, 1);
static BLUE_TWICE: [u8; 64] = bytes_of_channels(2, 2);
static TRANSPOSE_BYTES: [u8; 64] = transposed_bytes();

/// 64 pixels at a time: bytes of one channel into one register, 8 x 8 bits transposed by the affine instruction, 8 x 8 bytes
/// by a permutation; after eight such steps 8 x 8 quadwords, which makes a whole line of each plane.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vbmi,gfni")]
fn block_avx512(pixels: &[u32; BLOCK_PIXELS], planes: &mut Planes, at: usize) {
    let (red_green, blue_twice) = (load_bytes(&RED_GREEN), load_bytes(&BLUE_TWICE));
    let transpose = load_bytes(&TRANSPOSE_BYTES);
    // Byte i of the affine product takes bit i of every byte of the matrix, the matrix's first byte into bit 7.
    let unit = _mm512_set1_epi64(0x8040_2010_0804_0201_u64 as i64);

    let mut rows = [[_mm512_setzero_si512(); 8]; CODE_BITS / 8];
    for (step, pixels) in pixels.as_chunks::<64>().0.iter().enumerate() {
        let load = |i: usize| {
            // SAFETY: pixels 16 i to 16 i + 16 of an array of 64; the load needs no alignment.
            unsafe { _mm512_loadu_si512(pixels.as_ptr().add(16 * i).cast()) }
        };
        let (a, b, c, d) = (load(0), load(1), load(2), load(3));
        let ab = _mm512_permutex2var_epi8(a, red_green, b);
        let cd = _mm512_permutex2var_epi8(c, red_green, d);
        let blue_ab = _mm512_permutex2var_epi8(a, blue_twice, b);
        let blue_cd = _mm512_permutex2var_epi8(c, blue_twice, d);
        let channels = [
            _mm512_shuffle_i64x2::<0x44>(ab, cd),
            _mm512_shuffle_i64x2::<0xee>(ab, cd),
            _mm512_mask_blend_epi64(0xf0, blue_ab, blue_cd),
        ];
        for (channel, bytes) in channels.into_iter().enumerate() {
            let bits = _mm512_gf2p8affine_epi64_epi8::<0>(unit, bytes);
            rows[channel][step] = _mm512_permutexvar_epi8(transpose, bits);
        }
    }
    for (channel, rows) in rows.iter().enumerate() {
        let columns = transpose_quadwords(rows);
        for (bit, line) in columns.into_iter().enumerate() {
            let plane = &mut planes[8 * channel + bit][at..at + BLOCK_BYTES];
            // SAFETY: the slice has 64 bytes; the store needs no alignment.
            unsafe { _mm512_storeu_si512(plane.as_mut_ptr().cast(), line) };
        }
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load_bytes(bytes: &[u8; 64]) -> __m512i {
    // SAFETY: 64 readable bytes; the load needs no alignment.
    unsafe { _mm512_loadu_si512(bytes.as_ptr().cast()) }
}

/// An 8 x 8 matrix of quadwords, transposed.
#[inline]
#[target_feature(enable = "avx512f")]
fn transpose_quadwords(rows: &[__m512i; 8]) -> [__m512i; 8] {
    let r = rows;
    // Pairs of rows, then pairs of pairs, then halves.
    let lo = |i: usize| _mm512_unpacklo_epi64(r[i], r[i + 1]);
    let hi = |i: usize| _mm512_unpackhi_epi64(r[i], r[i + 1]);
    let even = [lo(0), lo(2), lo(4), lo(6)];
    let odd = [hi(0), hi(2), hi(4), hi(6)];
    let four = |v: &[__m512i; 4]| {
        [
            _mm512_shuffle_i64x2::<0x88>(v[0], v[1]),
            _mm512_shuffle_i64x2::<0xdd>(v[0], v[1]),
            _mm512_shuffle_i64x2::<0x88>(v[2], v[3]),
            _mm512_shuffle_i64x2::<0xdd>(v[2], v[3]),
        ]
    };
    let (e, o) = (four(&even), four(&odd));
    let column = |v: &[__m512i; 4]| {
        [
            _mm512_shuffle_i64x2::<0x88>(v[0], v[2]),
            _mm512_shuffle_i64x2::<0x88>(v[1], v[3]),
            _mm512_shuffle_i64x2::<0xdd>(v[0], v[2]),
            _mm512_shuffle_i64x2::<0xdd>(v[1], v[3]),
        ]
    };
    let (e, o) = (column(&e), column(&o));
    [e[0], o[0], e[1], o[1], e[2], o[2], e[3], o[3]]
}

/// [`super::quantise()`] with AVX2, eight pixels at a time; falls back to the scalar one where there is none.
pub(super) fn quantise_avx2(
    drive: &[[f32; 4]],
    offsets: Option<&[f32]>,
    codes: &mut [u32],
) -> QuantiseCounts {
    if !has_avx2() {
        return quantise_scalar(drive, offsets, codes);
    }
    let (whole, rest) = drive.as_chunks::<8>();
    let (out, out_rest) = codes.as_chunks_mut::<8>();
    let (whole_offsets, rest_offsets) = match offsets {
        Some(o) => {
            let (whole, rest) = o.as_chunks::<8>();
            (Some(whole), Some(rest))
        }
        None => (None, None),
    };
    // SAFETY: the CPU has AVX2, as just checked.
    let mut counts = unsafe { quantise_eights(whole, whole_offsets, out) };
    let tail = quantise_scalar(rest, rest_offsets, out_rest);
    counts.nan_pixels += tail.nan_pixels;
    counts.clipped += tail.clipped;
    counts
}

#[target_feature(enable = "avx2")]
fn quantise_eights(
    drive: &[[[f32; 4]; 8]],
    offsets: Option<&[[f32; 8]]>,
    codes: &mut [[u32; 8]],
) -> QuantiseCounts {
    let (zero, one) = (_mm256_setzero_ps(), _mm256_set1_ps(1.0));
    let full = _mm256_set1_ps(255.0);
    let mut counts = QuantiseCounts::default();
    // The fourth value of a pixel counts for nothing and becomes 0.
    const COLOUR: i32 = 0b0111_0111;
    for (i, (pixels, codes)) in drive.iter().zip(codes).enumerate() {
        let mut levels = [_mm256_setzero_si256(); 4];
        for (pair, level) in levels.iter_mut().enumerate() {
            // SAFETY: pixels 2 `pair` and 2 `pair` + 1 of eight, eight floats; the load needs no alignment.
            let v = unsafe { _mm256_loadu_ps(pixels.as_ptr().add(2 * pair).cast()) };
            let offset = match offsets {
                Some(o) => {
                    let (left, right) = (o[i][2 * pair], o[i][2 * pair + 1]);
                    _mm256_set_m128(_mm_set1_ps(right), _mm_set1_ps(left))
                }
                None => _mm256_set1_ps(ROUND),
            };
            let number = _mm256_cmp_ps::<_CMP_ORD_Q>(v, v);
            let nan = !_mm256_movemask_ps(number) & COLOUR;
            if nan != 0 {
                counts.nan_pixels += u64::from(nan & 0x0f != 0) + u64::from(nan & 0xf0 != 0);
            }
            let above = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(v, one)) & COLOUR;
            counts.clipped += u64::from(above.count_ones());
            let v = _mm256_min_ps(_mm256_max_ps(_mm256_and_ps(v, number), zero), one);
            let scaled = _mm256_add_ps(_mm256_mul_ps(v, full), offset);
            *level = _mm256_cvttps_epi32(scaled);
        }
        // 32 bits to 8, with saturation to 0..255; the lanes end up as pixels 0 2 4 6 | 1 3 5 7.
        let halves = |a, b| _mm256_packs_epi32(a, b);
        let bytes = _mm256_packus_epi16(halves(levels[0], levels[1]), halves(levels[2], levels[3]));
        let ordered = _mm256_permutevar8x32_epi32(bytes, _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7));
        let colour = _mm256_and_si256(ordered, _mm256_set1_epi32(0x00ff_ffff));
        // SAFETY: eight writable code values; the store needs no alignment.
        unsafe { _mm256_storeu_si256(codes.as_mut_ptr().cast(), colour) };
    }
    counts
}
