//! Linear drive 0..1 into 8-bit code values.
//!
//! `code = floor(v * 255 + offset)` in single precision, multiplication and addition rounded one after the other (no fused
//! multiply-add), so that a GPU shader with `precise` arithmetic gives the same bits. Offset 1/2 rounds to nearest; offsets
//! spread evenly over 0..1 make the mean over frames equal to the value.

/// What was not representable.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct QuantiseCounts {
    /// Pixels with at least one channel that is not a number; such channels become black.
    pub nan_pixels: u64,
    /// Channel values above 1, infinity among them; they become 255.
    pub clipped: u64,
}

/// Offset that rounds to nearest.
pub(crate) const ROUND: f32 = 0.5;

/// Drive (red, green, blue, and a fourth value that is ignored) into code values `0x00BBGGRR`. Values below 0 become 0, above
/// 1 become 255. `offsets` holds one offset per pixel, 0 up to but not including 1; `None` rounds to nearest.
///
/// # Panics
/// When `codes` or `offsets` is not as long as `drive`.
pub fn quantise(drive: &[[f32; 4]], offsets: Option<&[f32]>, codes: &mut [u32]) -> QuantiseCounts {
    assert_eq!(drive.len(), codes.len(), "one code value per pixel");
    assert!(offsets.is_none_or(|o| o.len() == drive.len()), "one offset per pixel");
    #[cfg(target_arch = "x86_64")]
    if super::simd::has_avx2() {
        return super::simd::quantise_avx2(drive, offsets, codes);
    }
    quantise_scalar(drive, offsets, codes)
}

/// As [`quantise`], in plain Rust: the definition.
pub(super) fn quantise_scalar(
    drive: &[[f32; 4]],
    offsets: Option<&[f32]>,
    codes: &mut [u32],
) -> QuantiseCounts {
    let mut counts = QuantiseCounts::default();
    for (i, (pixel, code)) in drive.iter().zip(codes).enumerate() {
        let offset = offsets.map_or(ROUND, |o| o[i]);
        let [r, g, b, _] = *pixel;
        *code = level(r, offset) | level(g, offset) << 8 | level(b, offset) << 16;
        counts.nan_pixels += u64::from(is_nan(r) || is_nan(g) || is_nan(b));
        counts.clipped += [r, g, b].iter().map(|&v| u64::from(v > 1.0)).sum::<u64>();
    }
    counts
}

fn level(v: f32, offset: f32) -> u32 {
    let v = if is_nan(v) { 0.0 } else { v.clamp(0.0, 1.0) };
    let scaled = v * 255.0 + offset;
    // The sum may have been rounded up to 256; offsets outside their range do no harm either.
    (scaled as u32).min(255)
}

/// By its bits, as a shader has to test it: compilers for GPUs may assume that comparisons never see a NaN.
fn is_nan(v: f32) -> bool {
    v.to_bits() & 0x7fff_ffff > 0x7f80_0000
}
