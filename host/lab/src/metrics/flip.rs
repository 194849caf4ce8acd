//! Two pictures into the difference that a person sees when one alternates with the other: LDR FLIP \[Andersson20\].
//!
//! Colours are blurred by what the eye resolves, compared in a perceptually even space, and the difference is raised where edges or points
//! appear or go. Equation numbers are those of the paper; the constants are its own.

use glam::{DMat3, DVec3};

use super::{LinearImage, MetricError};

/// Pixels a degree at which the paper judges by default: a screen 0.7 m wide of 3840 pixels seen from 0.7 m.
pub(crate) const DEFAULT_PIXELS_PER_DEGREE: f64 = 67.020_643_276_582_26;

/// Exponent of colour differences (q_c), and the two numbers of the mapping to 0..1 (p_c, p_t).
const COLOR_EXPONENT: f64 = 0.7;
const SHARE_OF_GREATEST: f64 = 0.4;
const MAPPED_SHARE: f64 = 0.95;
/// Exponent of feature differences (q_f) and width of the detector in degrees (w).
const FEATURE_EXPONENT: f64 = 0.5;
const FEATURE_WIDTH_DEG: f64 = 0.082;

/// The D65 white that goes with [`xyz_from_rgb`].
const WHITE: DVec3 = DVec3::new(0.950_428_545, 1.0, 1.088_900_371);

/// A sum of Gaussians in degrees, `a sqrt(pi / b) exp(-pi^2 r^2 / b)` for each (a, b): the contrast sensitivity of one colour channel.
type Sensitivity = &'static [(f64, f64)];
const ACHROMATIC: Sensitivity = &[(1.0, 0.0047)];
const RED_GREEN: Sensitivity = &[(1.0, 0.0053)];
const BLUE_YELLOW: Sensitivity = &[(34.1, 0.04), (13.5, 0.025)];
/// The widest of the three sets the radius of all.
const WIDEST: f64 = 0.04;

/// FLIP at every pixel, 0 (no difference) to 1. Pixels are clamped to 0..1 and shown as they are: linear light, white is 1; what is not a
/// number is black. `pixels_per_degree` is how densely the viewer sees them, [`DEFAULT_PIXELS_PER_DEGREE`] unless known better.
///
/// # Errors
/// Sizes that differ; `pixels_per_degree` outside 1 to 1000.
pub(crate) fn flip(
    test: &LinearImage,
    reference: &LinearImage,
    pixels_per_degree: f64,
) -> Result<Vec<f32>, MetricError> {
    test.check_same_size(reference)?;
    if !(1.0..=1000.0).contains(&pixels_per_degree) {
        return Err(MetricError::Parameter("pixels per degree"));
    }
    let (seen_test, seen_reference) =
        (FlipPicture::new(test, pixels_per_degree), FlipPicture::new(reference, pixels_per_degree));
    let greatest = greatest_color_difference();
    let at = |i: usize| {
        let color = map_to_unit(hyab(seen_test.lab[i], seen_reference.lab[i]).powf(COLOR_EXPONENT), greatest);
        let edges = (seen_test.edges[i] - seen_reference.edges[i]).abs();
        let points = (seen_test.points[i] - seen_reference.points[i]).abs();
        let feature = (edges.max(points) * std::f64::consts::FRAC_1_SQRT_2).powf(FEATURE_EXPONENT);
        color.powf(1.0 - feature) as f32
    };
    Ok((0..test.pixels().len()).map(at).collect())
}

/// The mean of [`flip`].
///
/// # Errors
/// As [`flip`].
pub(crate) fn mean_flip(
    test: &LinearImage,
    reference: &LinearImage,
    pixels_per_degree: f64,
) -> Result<f64, MetricError> {
    let map = flip(test, reference, pixels_per_degree)?;
    Ok(map.iter().map(|&x| f64::from(x)).sum::<f64>() / map.len() as f64)
}

/// A picture as the metric sees it.
struct FlipPicture {
    /// Blurred colour in Hunt-adjusted L*a*b*.
    lab: Vec<DVec3>,
    edges: Vec<f64>,
    points: Vec<f64>,
}

impl FlipPicture {
    fn new(picture: &LinearImage, pixels_per_degree: f64) -> Self {
        let (width, height) = picture.size();
        let clean = |c: &glam::Vec3| c.as_dvec3().map(|x| if x.is_nan() { 0.0 } else { x.clamp(0.0, 1.0) });
        let opponent: Vec<DVec3> =
            picture.pixels().iter().map(|c| opponent_from_xyz(xyz_from_rgb() * clean(c))).collect();
        let plane = |f: &dyn Fn(&DVec3) -> f64| FlipChannel {
            width,
            height,
            values: opponent.iter().map(f).collect(),
        };
        let blurred = [
            plane(&|c| c.x).see(ACHROMATIC, pixels_per_degree),
            plane(&|c| c.y).see(RED_GREEN, pixels_per_degree),
            plane(&|c| c.z).see(BLUE_YELLOW, pixels_per_degree),
        ];
        let rgb_from_xyz = xyz_from_rgb().inverse();
        let lab = (0..opponent.len())
            .map(|i| {
                let c = DVec3::new(blurred[0].values[i], blurred[1].values[i], blurred[2].values[i]);
                let rgb = (rgb_from_xyz * xyz_from_opponent(c)).clamp(DVec3::ZERO, DVec3::ONE);
                hunt(lab_from_xyz(xyz_from_rgb() * rgb))
            })
            .collect();
        let lightness = plane(&|c| (c.x + 16.0) / 116.0);
        let sd = 0.5 * FEATURE_WIDTH_DEG * pixels_per_degree;
        Self {
            lab,
            edges: lightness.features(sd, |x| -x),
            points: lightness.features(sd, |x| x * x / (sd * sd) - 1.0),
        }
    }
}

fn xyz_from_rgb() -> DMat3 {
    // Rows of the sRGB standard's matrix as fractions.
    DMat3::from_cols_array(&[
        10_135_552.0 / 24_577_794.0,
        2_613_072.0 / 12_288_897.0,
        1_425_312.0 / 73_733_382.0,
        8_788_810.0 / 24_577_794.0,
        8_788_810.0 / 12_288_897.0,
        8_788_810.0 / 73_733_382.0,
        4_435_075.0 / 24_577_794.0,
        887_015.0 / 12_288_897.0,
        70_074_185.0 / 73_733_382.0,
    ])
}

/// YCxCz: a linear opponent space.
fn opponent_from_xyz(xyz: DVec3) -> DVec3 {
    let c = xyz / WHITE;
    DVec3::new(116.0 * c.y - 16.0, 500.0 * (c.x - c.y), 200.0 * (c.y - c.z))
}

fn xyz_from_opponent(c: DVec3) -> DVec3 {
    let y = (c.x + 16.0) / 116.0;
    DVec3::new(y + c.y / 500.0, y, y - c.z / 200.0) * WHITE
}

fn lab_from_xyz(xyz: DVec3) -> DVec3 {
    const DELTA: f64 = 6.0 / 29.0;
    let f = (xyz / WHITE).map(|t| {
        if t > DELTA * DELTA * DELTA {
            t.cbrt()
        } else {
            t / (3.0 * DELTA * DELTA) + 4.0 / 29.0
        }
    });
    DVec3::new(116.0 * f.y - 16.0, 500.0 * (f.x - f.y), 200.0 * (f.y - f.z))
}

/// Hunt's effect: colours of dark things are seen weaker.
fn hunt(lab: DVec3) -> DVec3 {
    DVec3::new(lab.x, 0.01 * lab.x * lab.y, 0.01 * lab.x * lab.z)
}

/// HyAB: city-block in lightness, Euclidean in colour.
fn hyab(a: DVec3, b: DVec3) -> f64 {
    let d = a - b;
    d.x.abs() + d.y.hypot(d.z)
}

/// The difference between green and blue, the greatest in the space, raised to q_c.
fn greatest_color_difference() -> f64 {
    let seen = |rgb: DVec3| hunt(lab_from_xyz(xyz_from_rgb() * rgb));
    hyab(seen(DVec3::Y), seen(DVec3::Z)).powf(COLOR_EXPONENT)
}

/// Maps 0..greatest to 0..1 with most of the range for small differences.
fn map_to_unit(difference: f64, greatest: f64) -> f64 {
    let knee = SHARE_OF_GREATEST * greatest;
    if difference < knee {
        MAPPED_SHARE / knee * difference
    } else {
        MAPPED_SHARE + (difference - knee) / (greatest - knee) * (1.0 - MAPPED_SHARE)
    }
}

/// One channel of a picture.
struct FlipChannel {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl FlipChannel {
    /// Filters with `across(dx) * down(dy)`; the border's pixels go on outside. Both kernels have the odd length `2 r + 1`.
    fn separable(&self, across: &[f64], down: &[f64]) -> FlipChannel {
        let r = across.len() as isize / 2;
        let (w, h) = (self.width as isize, self.height as isize);
        let mut rows = vec![0.0; self.values.len()];
        for y in 0..self.height {
            let row = &self.values[y * self.width..][..self.width];
            for x in 0..w {
                let taps = across.iter().enumerate();
                rows[y * self.width + x as usize] =
                    taps.map(|(k, c)| c * row[(x + k as isize - r).clamp(0, w - 1) as usize]).sum();
            }
        }
        let mut values = vec![0.0; self.values.len()];
        for y in 0..h {
            let out = &mut values[y as usize * self.width..][..self.width];
            for (k, c) in down.iter().enumerate() {
                let from = &rows[(y + k as isize - r).clamp(0, h - 1) as usize * self.width..][..self.width];
                out.iter_mut().zip(from).for_each(|(o, v)| *o += c * v);
            }
        }
        FlipChannel { width: self.width, height: self.height, values }
    }

    /// Blurs by a contrast sensitivity function.
    fn see(&self, sensitivity: Sensitivity, pixels_per_degree: f64) -> FlipChannel {
        let radius =
            (3.0 * (WIDEST / (2.0 * std::f64::consts::PI.powi(2))).sqrt() * pixels_per_degree).ceil() as i32;
        let kernel = |b: f64| -> Vec<f64> {
            (-radius..=radius)
                .map(|x| {
                    (-std::f64::consts::PI.powi(2) * (f64::from(x) / pixels_per_degree).powi(2) / b).exp()
                })
                .collect()
        };
        let terms: Vec<(f64, Vec<f64>)> =
            sensitivity.iter().map(|&(a, b)| (a * (std::f64::consts::PI / b).sqrt(), kernel(b))).collect();
        let total: f64 = terms.iter().map(|(a, k)| a * k.iter().sum::<f64>().powi(2)).sum();
        let mut out =
            FlipChannel { width: self.width, height: self.height, values: vec![0.0; self.values.len()] };
        for (a, k) in &terms {
            let scaled: Vec<f64> = k.iter().map(|c| c * a / total).collect();
            let part = self.separable(&scaled, k);
            out.values.iter_mut().zip(part.values).for_each(|(o, v)| *o += v);
        }
        out
    }

    /// Magnitude of the response to `shape(x) exp(-(x^2 + y^2) / (2 sd^2))` along both axes; the positive weights add up to 1, the negative
    /// to -1.
    fn features(&self, sd: f64, shape: impl Fn(f64) -> f64) -> Vec<f64> {
        let radius = (3.0 * sd).ceil() as i32;
        let gauss: Vec<f64> =
            (-radius..=radius).map(|x| (-f64::from(x * x) / (2.0 * sd * sd)).exp()).collect();
        let shaped: Vec<f64> = (-radius..=radius).zip(&gauss).map(|(x, g)| shape(f64::from(x)) * g).collect();
        let across_sum: f64 = gauss.iter().sum();
        let side = |positive: bool| {
            shaped.iter().filter(|&&c| (c > 0.0) == positive).map(|c| c.abs()).sum::<f64>() * across_sum
        };
        let (plus, minus) = (side(true), side(false));
        let kernel: Vec<f64> = shaped.iter().map(|&c| c / if c > 0.0 { plus } else { minus }).collect();
        let (x, y) = (self.separable(&kernel, &gauss), self.separable(&gauss, &kernel));
        x.values.iter().zip(&y.values).map(|(x, y)| x.hypot(*y)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn uniform(c: Vec3) -> Vec<Vec3> {
        vec![c; 24 * 16]
    }

    fn picture(pixels: &[Vec3]) -> LinearImage<'_> {
        LinearImage::new(24, 16, pixels).unwrap()
    }

    fn mean(a: &[Vec3], b: &[Vec3]) -> f64 {
        mean_flip(&picture(a), &picture(b), DEFAULT_PIXELS_PER_DEGREE).unwrap()
    }

    fn noise(seed: u64) -> Vec<Vec3> {
        let d = dpm_device::rng::Draws::new(seed);
        (0..24 * 16)
            .map(|i| Vec3::new(d.unit(3 * i) as f32, d.unit(3 * i + 1) as f32, d.unit(3 * i + 2) as f32))
            .collect()
    }

    #[test]
    fn equal_pictures_do_not_differ_and_the_order_does_not_matter() {
        let (a, b) = (noise(1), noise(2));
        assert_eq!(mean(&a, &a), 0.0);
        assert!((mean(&a, &b) - mean(&b, &a)).abs() < 1e-12);
        assert!(flip(&picture(&a), &picture(&b), 67.0).unwrap().iter().all(|x| (0.0..=1.0).contains(x)));
    }

    #[test]
    fn green_against_blue_is_the_greatest_difference() {
        assert!((mean(&uniform(Vec3::Y), &uniform(Vec3::Z)) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn black_against_white_follows_from_the_definition() {
        // L* differs by 100 and colour not at all; green and blue in L*a*b* are textbook values.
        let (green, blue) = ([87.7351, -86.1829, 83.1795], [32.2957, 79.1856, -107.8573]);
        let adjusted = |c: [f64; 3]| [c[0], 0.01 * c[0] * c[1], 0.01 * c[0] * c[2]];
        let (g, b) = (adjusted(green), adjusted(blue));
        let greatest = (g[0] - b[0] + (g[1] - b[1]).hypot(g[2] - b[2])).powf(0.7);
        let expected = 0.95 + (100f64.powf(0.7) - 0.4 * greatest) / (0.6 * greatest) * 0.05;
        assert!((expected - 0.967).abs() < 1e-3);
        assert!((mean(&uniform(Vec3::ZERO), &uniform(Vec3::ONE)) - expected).abs() < 1e-4);
    }

    #[test]
    fn colour_spaces_meet_their_textbook_values() {
        let lab = |rgb: DVec3| lab_from_xyz(xyz_from_rgb() * rgb);
        assert!((lab(DVec3::ONE) - DVec3::new(100.0, 0.0, 0.0)).length() < 1e-2);
        assert!((lab(DVec3::X) - DVec3::new(53.24, 80.09, 67.20)).length() < 0.05);
        assert!((lab(DVec3::Y) - DVec3::new(87.73, -86.18, 83.18)).length() < 0.05);
        let c = DVec3::new(0.3, 0.2, 0.1);
        assert!((xyz_from_opponent(opponent_from_xyz(c)) - c).length() < 1e-12);
    }

    #[test]
    fn an_edge_that_only_one_picture_has_counts_more_than_its_colour_alone() {
        let mut edge = uniform(Vec3::splat(0.2));
        (0..16).for_each(|y| (12..24).for_each(|x| edge[y * 24 + x] = Vec3::splat(0.4)));
        let flat = uniform(Vec3::splat(0.2));
        let map = flip(&picture(&edge), &picture(&flat), 20.0).unwrap();
        let (at_edge, inside) = (map[8 * 24 + 12], map[8 * 24 + 23]);
        let colour_alone = mean(&uniform(Vec3::splat(0.4)), &flat) as f32;
        assert!(
            (inside - colour_alone).abs() < 1e-3,
            "far from the edge only colour counts: {inside} against {colour_alone}"
        );
        assert!(at_edge > inside, "{at_edge} against {inside}");
        assert!(map[8 * 24] < 1e-3);
    }

    #[test]
    fn separable_filters_equal_the_two_dimensional_definition() {
        let ppd = 25.0;
        let values: Vec<f64> = noise(5).iter().map(|c| f64::from(c.x)).collect();
        let plane = FlipChannel { width: 24, height: 16, values: values.clone() };
        let at = |x: i32, y: i32| values[(y.clamp(0, 15) * 24 + x.clamp(0, 23)) as usize];
        let brute = |kernel: &dyn Fn(i32, i32) -> f64, r: i32, x: i32, y: i32| -> f64 {
            (-r..=r)
                .flat_map(|dy| (-r..=r).map(move |dx| (dx, dy)))
                .map(|(dx, dy)| kernel(dx, dy) * at(x + dx, y + dy))
                .sum()
        };
        let pi = std::f64::consts::PI;
        let r = (3.0 * (0.04 / (2.0 * pi * pi)).sqrt() * ppd).ceil() as i32;
        let raw = |dx: i32, dy: i32| {
            let z = f64::from(dx * dx + dy * dy) / (ppd * ppd);
            34.1 * (pi / 0.04).sqrt() * (-pi * pi * z / 0.04).exp()
                + 13.5 * (pi / 0.025).sqrt() * (-pi * pi * z / 0.025).exp()
        };
        let total: f64 = (-r..=r).flat_map(|dy| (-r..=r).map(move |dx| raw(dx, dy))).sum();
        let blurred = plane.see(BLUE_YELLOW, ppd);

        let sd = 0.5 * FEATURE_WIDTH_DEG * ppd;
        let rf = (3.0 * sd).ceil() as i32;
        let point = |dx: i32, dy: i32| {
            (f64::from(dx * dx) / (sd * sd) - 1.0) * (-f64::from(dx * dx + dy * dy) / (2.0 * sd * sd)).exp()
        };
        let all = || (-rf..=rf).flat_map(|dy| (-rf..=rf).map(move |dx| point(dx, dy)));
        let (plus, minus): (f64, f64) =
            (all().filter(|c| *c > 0.0).sum(), -all().filter(|c| *c < 0.0).sum::<f64>());
        let signed = |c: f64| c / if c > 0.0 { plus } else { minus };
        let points = plane.features(sd, |x| x * x / (sd * sd) - 1.0);
        for (x, y) in [(0, 0), (11, 7), (23, 15), (3, 14)] {
            let i = (y * 24 + x) as usize;
            assert!((blurred.values[i] - brute(&|dx, dy| raw(dx, dy) / total, r, x, y)).abs() < 1e-12);
            let along_x = brute(&|dx, dy| signed(point(dx, dy)), rf, x, y);
            let along_y = brute(&|dx, dy| signed(point(dy, dx)), rf, x, y);
            assert!((points[i] - along_x.hypot(along_y)).abs() < 1e-12);
        }
    }

    #[test]
    fn fine_noise_is_seen_less_from_farther_away() {
        let (a, b) = (noise(1), uniform(Vec3::splat(0.5)));
        let at = |ppd| mean_flip(&picture(&a), &picture(&b), ppd).unwrap();
        assert!(at(10.0) > at(30.0) && at(30.0) > at(90.0));
    }

    #[test]
    fn what_is_not_a_picture_is_refused_or_read_as_black() {
        let (mut a, b) = (uniform(Vec3::ZERO), uniform(Vec3::ZERO));
        a.fill(Vec3::new(f32::NAN, -1.0, f32::NEG_INFINITY));
        assert_eq!(mean(&a, &b), 0.0);
        a.fill(Vec3::splat(f32::INFINITY));
        assert!((mean(&a, &b) - mean(&uniform(Vec3::ONE), &b)).abs() < 1e-12);
        assert!(
            flip(&picture(&a), &picture(&b), 0.0).is_err()
                && flip(&picture(&a), &picture(&b), f64::NAN).is_err()
        );
        assert!(flip(&picture(&a), &LinearImage::new(16, 24, &b).unwrap(), 67.0).is_err());
    }
}
