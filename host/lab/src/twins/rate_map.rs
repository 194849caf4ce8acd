//! Tiles into shading rates, \[paper\] eq. 1 to 4: the CPU twin of `rate_map.comp`, equal bit for bit.
//!
//! Every comparison uses products of sums only, because division and root differ between devices.

use dpm_render::rate_table::FIRST;

/// The table read as the shader reads it.
pub(crate) fn blur(table: &[[f32; 2]], v: f32) -> [f32; 2] {
    if v < FIRST {
        let rest = [1.0f32, 2.13];
        return std::array::from_fn(|c| rest[c] + (table[0][c] - rest[c]) * (v * 64.0));
    }
    let bits = v.to_bits() - FIRST.to_bits();
    let entry = (bits >> 13) as usize;
    if entry + 1 >= table.len() {
        return table[table.len() - 1];
    }
    let f = (bits & 8191) as f32 * (1.0 / 8192.0);
    let (a, b) = (table[entry], table[entry + 1]);
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * f)
}

/// What one lit pixel brings to its tile's decision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelGuide {
    /// Luminance that it showed last; `None`: nothing known.
    pub luminance: Option<f32>,
    /// Pixels per frame.
    pub motion: [f32; 2],
    /// Apparent size, \[paper\] eq. 3.
    pub size: f32,
    /// Visual angle from the gaze, degrees.
    pub angle: f32,
}

/// Constants of the decision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RateConstants {
    /// t of \[paper\] eq. 2.
    pub t: f32,
    /// l of \[paper\] eq. 2.
    pub l: f32,
    /// Inner and outer angle of \[paper\] eq. 4, degrees.
    pub degrees: [f32; 2],
}

/// Shading rate of a tile: log2 of the coarse pixel's sides.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ShadingRate {
    /// 0, 1, 2: 1, 2 or 4 pixels along x.
    pub x: u32,
    /// Likewise along y.
    pub y: u32,
}

impl ShadingRate {
    /// As the shader stores it.
    pub(crate) fn code(self) -> u32 {
        self.x | (self.y << 2)
    }
}

#[derive(Clone, Copy)]
struct Row {
    luminance: f32,
    square: [f32; 2],
    speed: [f32; 2],
    size: f32,
    angle: f32,
    lit: u32,
    pairs: [u32; 2],
    odd: u32,
}

const EMPTY_ROW: Row = Row {
    luminance: 0.0,
    square: [0.0; 2],
    speed: [3.0e38; 2],
    size: 0.0,
    angle: 180.0,
    lit: 0,
    pairs: [0; 2],
    odd: 0,
};

fn full_half_quarter(b: [f32; 2], square: f32, pairs: f32, size: f32, tau: f32, lit: f32) -> u32 {
    let error = square * (size * size) * (lit * lit);
    let threshold = (tau * tau) * pairs;
    if (b[0] * b[0]) * error >= threshold {
        0
    } else if (b[1] * b[1]) * error < threshold {
        2
    } else {
        1
    }
}

/// \[paper\] eq. 1 and 2 of a tile, for looking at; the decision itself needs neither root nor division.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TileError {
    /// Error estimate along x and y, scene units.
    pub error: [f32; 2],
    /// Threshold tau that it is held against, scene units.
    pub threshold: f32,
}

/// Error estimate and threshold of a tile; `None` where nothing is lit or some lit pixel has no history.
pub fn estimate(tile: &[Option<PixelGuide>; 256], constants: &RateConstants) -> Option<TileError> {
    let t = gather(tile);
    if t.lit == 0 || t.odd > 0 {
        return None;
    }
    let error = |axis: usize| t.size * (t.square[axis] / t.pairs[axis].max(1) as f32).sqrt();
    let threshold = constants.t * (t.luminance / t.lit as f32 + constants.l);
    Some(TileError { error: [error(0), error(1)], threshold })
}

/// Sums and extremes over a tile in the shader's order.
fn gather(tile: &[Option<PixelGuide>; 256]) -> Row {
    // The shader's stand-in for "nothing known".
    let known = |g: &PixelGuide| g.luminance.unwrap_or(-1.0);
    let mut rows = [EMPTY_ROW; 16];
    for y in 0..16 {
        let r = &mut rows[y];
        for x in 0..16 {
            let Some(g) = &tile[y * 16 + x] else { continue };
            let l = known(g);
            if !(l >= 0.0 && l.is_finite()) {
                r.odd += 1;
            }
            r.luminance += l;
            r.lit += 1;
            let v = g.motion.map(f32::abs);
            if !(v[0].is_finite() && v[1].is_finite() && g.size.is_finite()) {
                r.odd += 1;
            }
            for (speed, v) in r.speed.iter_mut().zip(v) {
                if v < *speed {
                    *speed = v;
                }
            }
            if g.size > r.size {
                r.size = g.size;
            }
            if g.angle < r.angle {
                r.angle = g.angle;
            }
            let neighbours = [x.checked_sub(1).map(|x| y * 16 + x), y.checked_sub(1).map(|y| y * 16 + x)];
            for (axis, neighbour) in neighbours.into_iter().enumerate() {
                if let Some(other) = neighbour.and_then(|i| tile[i].as_ref()) {
                    let d = (l - known(other)) * 0.5;
                    r.square[axis] += d * d;
                    r.pairs[axis] += 1;
                }
            }
        }
    }
    let mut t = rows[0];
    for o in &rows[1..] {
        t.luminance += o.luminance;
        t.lit += o.lit;
        t.odd += o.odd;
        for axis in 0..2 {
            t.square[axis] += o.square[axis];
            t.pairs[axis] += o.pairs[axis];
            if o.speed[axis] < t.speed[axis] {
                t.speed[axis] = o.speed[axis];
            }
        }
        if o.size > t.size {
            t.size = o.size;
        }
        if o.angle < t.angle {
            t.angle = o.angle;
        }
    }
    t
}

/// The rate of a tile of 16 x 16 pixels, row by row; `None` is a pixel that is not lit or lies outside the raster.
pub fn decide(
    tile: &[Option<PixelGuide>; 256],
    table: &[[f32; 2]],
    constants: &RateConstants,
) -> ShadingRate {
    let t = gather(tile);
    if t.lit == 0 {
        return ShadingRate::default();
    }
    let by_angle = if t.angle <= constants.degrees[0] {
        0
    } else if t.angle > constants.degrees[1] {
        2
    } else {
        1
    };
    let pairs = t.pairs.map(|n| n.max(1) as f32);
    let mut rate = [0u32; 2];
    if t.odd == 0 {
        let lit = t.lit as f32;
        let tau = constants.t * (t.luminance + constants.l * lit);
        for axis in 0..2 {
            rate[axis] =
                full_half_quarter(blur(table, t.speed[axis]), t.square[axis], pairs[axis], t.size, tau, lit);
        }
    }
    combine(rate.map(|r| r.max(by_angle)), t.square[0] * pairs[1] > t.square[1] * pairs[0])
}

/// The six allowed rates (\[paper\] section 2.1): 1x4 becomes 1x2, 4x1 becomes 2x1, 4x4 stays finer along the axis with the larger error.
fn combine([mut x, mut y]: [u32; 2], more_error_along_x: bool) -> ShadingRate {
    if x == 2 && y == 0 {
        x = 1;
    }
    if y == 2 && x == 0 {
        y = 1;
    }
    if x == 2 && y == 2 {
        if more_error_along_x {
            x = 1;
        } else {
            y = 1;
        }
    }
    ShadingRate { x, y }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_render::rate_table::{blur_half, blur_quarter, rate_table};

    const PAPER: RateConstants = RateConstants { t: 0.0762, l: 0.363, degrees: [15.0, 30.0] };

    fn tile(
        f: impl Fn(usize, usize) -> f32,
        motion: [f32; 2],
        size: f32,
        angle: f32,
    ) -> [Option<PixelGuide>; 256] {
        std::array::from_fn(|i| Some(PixelGuide { luminance: Some(f(i % 16, i / 16)), motion, size, angle }))
    }

    #[test]
    fn table_follows_the_fits() {
        let table = rate_table();
        assert_eq!(blur(&table, 0.0), [1.0, 2.13]);
        for (v, h, q) in [(0.5, 0.956, 2.085), (1.0, 0.763, 1.919), (4.0, 0.210, 0.784), (16.0, 0.047, 0.163)]
        {
            let b = blur(&table, v);
            assert!((b[0] - h).abs() < 1e-3 && (b[1] - q).abs() < 1e-3, "{v}: {b:?}");
        }
        for i in 0..20_000 {
            let v = 1e-4 * 1.0012f64.powi(i);
            if v > 1e9 {
                break;
            }
            let b = blur(&table, v as f32);
            let (h, q) = (blur_half(f64::from(v as f32)), blur_quarter(f64::from(v as f32)));
            assert!((f64::from(b[0]) - h).abs() < 2e-6 * h.max(1e-3), "{v} {} {h}", b[0]);
            assert!((f64::from(b[1]) - q).abs() < 2e-6 * q.max(1e-3), "{v} {} {q}", b[1]);
        }
        assert!(blur(&table, 1e12)[0] < 1e-9);
        assert!(blur(&table, f32::INFINITY)[0].is_finite());
    }

    /// Eq. 1 to 4 in f64 straight from the paper.
    fn by_the_paper(t: &[Option<PixelGuide>; 256], c: &RateConstants) -> [f64; 4] {
        let at = |x: usize, y: usize| t[y * 16 + x].as_ref();
        let lit: Vec<_> = t.iter().flatten().collect();
        let mean = lit.iter().map(|g| f64::from(g.luminance.unwrap())).sum::<f64>() / lit.len() as f64;
        let tau = f64::from(c.t) * (mean + f64::from(c.l));
        let size = lit.iter().map(|g| f64::from(g.size)).fold(0.0, f64::max);
        let mut out = [0.0; 4];
        for axis in 0..2 {
            let v = lit.iter().map(|g| f64::from(g.motion[axis].abs())).fold(f64::INFINITY, f64::min);
            let (mut sum, mut n) = (0.0, 0.0);
            for y in 0..16usize {
                for x in 0..16usize {
                    let (px, py) = if axis == 0 { (x.wrapping_sub(1), y) } else { (x, y.wrapping_sub(1)) };
                    if px > 15 || py > 15 {
                        continue;
                    }
                    if let (Some(a), Some(b)) = (at(x, y), at(px, py)) {
                        sum += ((f64::from(a.luminance.unwrap()) - f64::from(b.luminance.unwrap())) / 2.0)
                            .powi(2);
                        n += 1.0;
                    }
                }
            }
            let e = (sum / f64::max(n, 1.0)).sqrt();
            out[axis * 2] = blur_half(v) * e * size / tau;
            out[axis * 2 + 1] = blur_quarter(v) * e * size / tau;
        }
        out
    }

    #[test]
    fn decisions_are_the_papers() {
        let table = rate_table();
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) as f32 / (1u64 << 31) as f32
        };
        let (mut checked, mut seen) = (0, [0; 9]);
        for _ in 0..4000 {
            let (base, contrast) = (random() * 2.0, 10f32.powf(random() * 4.0 - 3.0));
            let motion = [10f32.powf(random() * 4.0 - 2.0), 10f32.powf(random() * 4.0 - 2.0)];
            let (size, angle, holes) = (0.2 + 2.0 * random(), random() * 60.0, random() * 0.5);
            let tile: [Option<PixelGuide>; 256] = std::array::from_fn(|_| {
                (random() >= holes).then(|| PixelGuide {
                    luminance: Some(base + contrast * random()),
                    motion: [motion[0] * (1.0 + random()), motion[1] * (1.0 + random())],
                    size: size * (0.5 + random()),
                    angle,
                })
            });
            let ratio = by_the_paper(&tile, &PAPER);
            // Within rounding of a boundary either answer is right.
            if ratio.iter().any(|r| (r - 1.0).abs() < 1e-4) {
                continue;
            }
            let axis = |h: f64, q: f64| {
                if h >= 1.0 {
                    0
                } else if q < 1.0 {
                    2
                } else {
                    1u32
                }
            };
            let by_angle = if angle <= 15.0 {
                0
            } else if angle > 30.0 {
                2
            } else {
                1
            };
            let x = axis(ratio[0], ratio[1]).max(by_angle);
            let y = axis(ratio[2], ratio[3]).max(by_angle);
            let rate = decide(&tile, &table, &PAPER);
            let wanted = combine([x, y], rate.x == 1 && x == 2 && y == 2);
            assert_eq!(rate, wanted, "{ratio:?} angle {angle}");
            seen[(x * 3 + y) as usize] += 1;
            checked += 1;
        }
        assert!(checked > 3500 && seen.iter().all(|&n| n > 20), "{checked} {seen:?}");
    }

    #[test]
    fn boundaries_belong_where_the_paper_puts_them() {
        let table = rate_table();
        // b E d = tau exactly: Full. Columns alternate by 2 tau at rest, so E = tau; all numbers are powers of two.
        let exact = RateConstants { t: 0.25, l: 0.0, degrees: [15.0, 30.0] };
        let stripes = tile(|x, _| if x % 2 == 0 { 0.75 } else { 1.25 }, [0.0; 2], 1.0, 0.0);
        assert_eq!(decide(&stripes, &table, &exact).x, 0);
        let weaker = tile(|x, _| if x % 2 == 0 { 0.75 } else { 1.249_999 }, [0.0; 2], 1.0, 0.0);
        assert_eq!(decide(&weaker, &table, &exact).x, 1);
        // phi = phi_H is Full, above is Half; phi = phi_Q is Half, above is Quarter.
        let flat =
            |angle| decide(&tile(|x, y| ((x + y) % 2) as f32 * 9.0, [0.0; 2], 9.0, angle), &table, &PAPER);
        assert_eq!(flat(15.0), ShadingRate { x: 0, y: 0 });
        assert_eq!(flat(15.000_001), ShadingRate { x: 1, y: 1 });
        assert_eq!(flat(30.0), ShadingRate { x: 1, y: 1 });
        assert!(matches!(flat(30.000_002), ShadingRate { x: 1, y: 2 } | ShadingRate { x: 2, y: 1 }));
    }

    #[test]
    fn extremes_are_defined() {
        let table = rate_table();
        assert_eq!(decide(&[None; 256], &table, &PAPER), ShadingRate::default(), "empty tiles are skipped");
        // No detail: coarsest, and only allowed rates come out.
        let flat = decide(&tile(|_, _| 0.5, [0.0; 2], 1.0, 0.0), &table, &PAPER);
        assert_eq!(flat.x + flat.y, 3);
        for odd in [f32::NAN, f32::INFINITY, -1.0] {
            let t = tile(|x, y| if (x, y) == (3, 3) { odd } else { 0.5 }, [0.0; 2], 1.0, 0.0);
            assert_eq!(decide(&t, &table, &PAPER), ShadingRate::default(), "{odd}");
            let t = tile(|_, _| 0.5, [if odd < 0.0 { f32::NAN } else { odd }, 0.0], 1.0, 0.0);
            assert_eq!(decide(&t, &table, &PAPER), ShadingRate::default(), "motion {odd}");
        }
        let fast = decide(&tile(|x, _| (x % 2) as f32, [1e12, 1e12], 1.0, 0.0), &table, &PAPER);
        assert_eq!(fast.x.max(fast.y), 2);
    }

    #[test]
    fn estimate_and_decision_agree_away_from_the_threshold() {
        let table = rate_table();
        for (contrast, speed, size) in [
            (0.05, 0.0, 1.0),
            (0.4, 0.0, 1.0),
            (0.1, 1.3, 0.7),
            (0.1, 9.0, 2.0),
            (1.0, 4.0, 1.0),
            (0.06, 0.3, 1.0),
        ] {
            let tile = tile(|x, _| if x % 2 == 0 { 0.5 } else { 0.5 + contrast }, [speed, 0.0], size, 3.0);
            let e = estimate(&tile, &PAPER).unwrap();
            // By hand: half differences of contrast / 2 everywhere along x, none along y.
            assert!((e.error[0] - size * contrast / 2.0).abs() < 1e-6 && e.error[1] == 0.0, "{e:?}");
            assert!((e.threshold - 0.0762 * (0.5 + contrast / 2.0 + 0.363)).abs() < 1e-6, "{e:?}");
            let [half, quarter] = blur(&table, speed).map(|b| b * e.error[0]);
            let expected = if half >= e.threshold { 0 } else { 1 + u32::from(quarter < e.threshold) };
            // Along y nothing changes, so y asks for a quarter; 4 x 4 is not allowed and stays finer along x, where the error is.
            let rate = decide(&tile, &table, &PAPER);
            assert_eq!(rate.x, expected.min(1), "{contrast} {speed}: {rate:?}");
        }
        assert_eq!(estimate(&[None; 256], &PAPER), None);
    }
}
