//! The table from which `rate_map.comp` reads the blur of a moving eye.
//!
//! `b_H` and `b_Q` are \[Yang19\]'s fits. They are tabulated in f64 because `pow` differs between devices.

use dpm_shaders::structs::{RATE_TABLE_OCTAVE, RATE_TABLE_OCTAVES};

/// \[Yang19\] `b_H`: 1 at rest, falls with `v` pixels per frame.
pub fn blur_half(v: f64) -> f64 {
    (1.0 / (1.0 + (1.05 * v).powf(3.10))).powf(0.35)
}

/// \[Yang19\] `b_Q`: 2.13 at rest.
pub fn blur_quarter(v: f64) -> f64 {
    2.13 * (1.0 / (1.0 + (0.55 * v).powf(2.41))).powf(0.49)
}

/// Slowest tabulated speed, pixels per frame.
pub const FIRST: f32 = 0.015_625;

/// `[b_H, b_Q]` at `2^-6 * 2^(i / 1024)` read along the mantissa: entry `i` belongs to the float whose bits are `bits(2^-6) + (i << 13)`.
pub fn rate_table() -> Vec<[f32; 2]> {
    (0..RATE_TABLE_OCTAVE * RATE_TABLE_OCTAVES)
        .map(|i| {
            let v = f64::from(f32::from_bits(FIRST.to_bits() + (i << 13)));
            [blur_half(v) as f32, blur_quarter(v) as f32]
        })
        .collect()
}
