//! The level of a round aperture over the stripes of a plane, and its derivatives.

use std::f64::consts::FRAC_2_PI;

/// Share of light on an aperture, and its derivatives by place and radius, a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Share {
    pub share: f64,
    pub by_place: f64,
    pub by_radius: f64,
}

/// Stripes lit from `width` to `3 width`, repeated every `4 width`, seen by a disc of `radius` around `place`; pixels.
pub(super) fn stripes(width: f64, place: f64, radius: f64) -> Share {
    let low = place - radius;
    let phase = (low / (4.0 * width)).rem_euclid(1.0);
    let mut share = if (0.25..0.75).contains(&phase) { 1.0 } else { 0.0 };
    let (mut by_place, mut by_radius) = (0.0, 0.0);
    // Borders lie at odd multiples of the width; those at 1, 5, 9... rise.
    let mut index = ((low / width - 1.0) / 2.0).floor() + 1.0;
    loop {
        let border = (2.0 * index + 1.0) * width;
        if border >= place + radius {
            break;
        }
        let sign = if index.rem_euclid(2.0) < 0.5 { 1.0 } else { -1.0 };
        let z = ((border - place) / radius).clamp(-1.0, 1.0);
        let chord = (1.0 - z * z).sqrt();
        // The part of a disc to the right of a line at z, and the density there.
        share += sign * (0.5 - 0.5 * FRAC_2_PI * (z * chord + z.asin()));
        let density = FRAC_2_PI * chord / radius;
        by_place += sign * density;
        by_radius += sign * density * z;
        index += 1.0;
    }
    Share { share, by_place, by_radius }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the disc cut into many chords.
    #[test]
    fn the_share_is_that_of_the_disc() {
        for (width, place, radius) in
            [(1.0, 300.3, 2.5), (2.0, 17.0, 3.1), (64.0, 65.0, 2.0), (512.0, 100.0, 2.0), (1.0, 3.0, 0.4)]
        {
            let n = 20_000;
            let (mut lit, mut all) = (0.0, 0.0);
            for i in 0..n {
                let z = (f64::from(i) + 0.5) / f64::from(n) * 2.0 - 1.0;
                let chord = (1.0 - z * z).sqrt();
                let stripe = ((place + z * radius) / width).floor() as i64;
                all += chord;
                lit += chord * f64::from(u8::from((stripe + 1) & 2 != 0));
            }
            let got = stripes(width, place, radius);
            assert!((got.share - lit / all).abs() < 1e-3, "{width} {place}: {} {}", got.share, lit / all);
            let h = 1e-6;
            let by = |p: f64, r: f64| stripes(width, place + p, radius + r).share;
            assert!(((by(h, 0.0) - by(-h, 0.0)) / (2.0 * h) - got.by_place).abs() < 1e-5);
            assert!(((by(0.0, h) - by(0.0, -h)) / (2.0 * h) - got.by_radius).abs() < 1e-5);
        }
    }
}
