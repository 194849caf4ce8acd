//! Tabulates the directional albedo of a rough dielectric reflection for one index of refraction: the share of light
//! that the coat reflects and that the diffuse base therefore does not get. The GPU and the f64 reference read the same
//! table.
//!
//! ```text
//!     E(mu, alpha) = integral over the hemisphere of f_spec(v, l) (n.l) dl,  mu = n.v
//!     nodes        mu_i = (i / 31)^2, alpha_j = (j / 31)^2, i, j = 0..31     row j holds all mu of one alpha
//!     lookup       x = 31 sqrt(mu), y = 31 sqrt(alpha), bilinear between the nodes (y is 31 * perceptual roughness)
//!     average      E_avg_j = 4 integral_0^1 E(s^2) s^3 ds of the piecewise linear row itself, so that
//!                  2 integral E_table mu dmu = E_avg exactly and the diffuse base keeps all that the coat lets in
//! ```
//!
//! Row 0 is the Fresnel reflectance of a smooth surface. With `ior` 1 every entry is exactly 0.

use glam::DVec3;
use std::f64::consts::PI;

/// Nodes along each axis.
pub const ALBEDO_NODES: usize = 32;

/// The table of one index of refraction.
#[derive(Clone, Debug, PartialEq)]
pub struct AlbedoTable {
    /// Its index of refraction.
    pub ior: f32,
    /// `directional[j * ALBEDO_NODES + i]`, node `i` of mu and `j` of alpha; 0..1.
    pub directional: Vec<f32>,
    /// Cosine-weighted average over mu per alpha node; 0..1.
    pub average: Vec<f32>,
}

impl AlbedoTable {
    /// Integrates the table, which takes a few hundredths of a second. An `ior` below 1 or not finite counts as 1.
    pub fn new(ior: f32) -> Self {
        let ior = if ior.is_finite() { ior.max(1.0) } else { 1.0 };
        let rule = Quadrature::new(20, 10);
        Self::of(ior, |mu, alpha| match ior {
            1.0 => 0.0,
            _ => by_quadrature(f64::from(ior), mu, alpha, &rule),
        })
    }

    /// The table of facets that reflect everything: what a rough surface loses is the rest. Its index is infinite.
    pub fn white() -> Self {
        let rule = Quadrature::new(20, 10);
        Self::of(f32::INFINITY, |mu, alpha| by_quadrature(f64::INFINITY, mu, alpha, &rule))
    }

    /// The tables of a white sheen, whose alpha is the sheen's. The first is the model's albedo as it was fitted: at grazing
    /// angles it is above 1, up to 6 where the sheen is narrow. The second is what is left of it after the value was
    /// divided by the larger albedo of both directions where that is above 1.
    pub fn sheen() -> [Self; 2] {
        let rule = Quadrature::new(48, 64);
        let fitted = Self::of(0.0, |mu, alpha| sheen_albedo(mu, alpha, &rule, &|_| 1.0));
        let limited = Self::of(0.0, |mu, alpha| {
            let own = fitted.directional(mu, alpha).max(1.0);
            sheen_albedo(mu, alpha, &rule, &|cos| own.max(fitted.directional(cos, alpha)))
        });
        [fitted, limited]
    }

    fn of(ior: f32, albedo: impl Fn(f64, f64) -> f64) -> Self {
        let n = ALBEDO_NODES;
        let directional: Vec<f32> = (0..n * n).map(|k| albedo(node(k % n), node(k / n)) as f32).collect();
        let average = directional.chunks_exact(n).map(|row| row_average(row) as f32).collect();
        Self { ior, directional, average }
    }

    /// `E(mu, alpha)` in f64; arguments are clamped to 0..1.
    pub fn directional(&self, mu: f64, alpha: f64) -> f64 {
        let n = ALBEDO_NODES;
        let (i, s) = cell(mu.clamp(0.0, 1.0).sqrt());
        let (j, t) = cell(alpha.clamp(0.0, 1.0).sqrt());
        let at = |i: usize, j: usize| f64::from(self.directional[j * n + i]);
        let low = at(i, j) * (1.0 - s) + at(i + 1, j) * s;
        let high = at(i, j + 1) * (1.0 - s) + at(i + 1, j + 1) * s;
        low * (1.0 - t) + high * t
    }

    /// `E_avg(alpha)` in f64.
    pub fn average(&self, alpha: f64) -> f64 {
        let (j, t) = cell(alpha.clamp(0.0, 1.0).sqrt());
        f64::from(self.average[j]) * (1.0 - t) + f64::from(self.average[j + 1]) * t
    }

    /// `E(mu, alpha)` in f32 with the operations of the shader.
    pub fn directional_f32(&self, mu: f32, alpha: f32) -> f32 {
        let n = ALBEDO_NODES;
        let (i, s) = cell_f32(mu);
        let (j, t) = cell_f32(alpha);
        let at = |i: usize, j: usize| self.directional[j * n + i];
        let low = at(i, j) * (1.0 - s) + at(i + 1, j) * s;
        let high = at(i, j + 1) * (1.0 - s) + at(i + 1, j + 1) * s;
        low * (1.0 - t) + high * t
    }

    /// `E_avg(alpha)` in f32 with the operations of the shader.
    pub fn average_f32(&self, alpha: f32) -> f32 {
        let (j, t) = cell_f32(alpha);
        self.average[j] * (1.0 - t) + self.average[j + 1] * t
    }
}

/// Maximum number of tables of a scene. Each takes a few hundredths of a second, so a file with ten thousand indices of
/// refraction would take minutes.
pub(crate) const MAX_TABLES: usize = 32;

/// The indices of refraction for which a scene has tables, and for each of `iors` the index of its table. If there are
/// at most [`MAX_TABLES`] different indices, each has its own table, in order of first occurrence. Otherwise
/// [`MAX_TABLES`] of them, spread evenly over the sorted indices, have a table, and each index uses the nearest one. An
/// index below 1 or not finite counts as 1.
pub fn tabulated(iors: &[f32]) -> (Vec<f32>, Vec<usize>) {
    let sound = |ior: f32| if ior.is_finite() { ior.max(1.0) } else { 1.0 };
    let mut seen = std::collections::HashSet::new();
    let mut chosen: Vec<f32> =
        iors.iter().map(|&ior| sound(ior)).filter(|ior| seen.insert(ior.to_bits())).collect();
    if chosen.len() > MAX_TABLES {
        chosen.sort_unstable_by(f32::total_cmp);
        let last = chosen.len() - 1;
        chosen = (0..MAX_TABLES).map(|k| chosen[k * last / (MAX_TABLES - 1)]).collect();
    }
    let nearest = |ior: f32| {
        let distance = |k: &usize| (chosen[*k] - ior).abs();
        (0..chosen.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0)
    };
    let uses = iors.iter().map(|&ior| nearest(sound(ior))).collect();
    (chosen, uses)
}

fn node(i: usize) -> f64 {
    let s = i as f64 / (ALBEDO_NODES - 1) as f64;
    s * s
}

/// Lower node (at most the last but one) and the weight of the upper.
fn cell(s: f64) -> (usize, f64) {
    let x = s * (ALBEDO_NODES - 1) as f64;
    let i = (x as usize).min(ALBEDO_NODES - 2);
    (i, x - i as f64)
}

fn cell_f32(v: f32) -> (usize, f32) {
    let x = v.clamp(0.0, 1.0).sqrt() * (ALBEDO_NODES - 1) as f32;
    let i = (x as usize).min(ALBEDO_NODES - 2);
    (i, x - i as f32)
}

/// `4 integral_0^1 E(s) s^3 ds` of a row that is linear in `s = sqrt(mu)` between its nodes, in closed form.
fn row_average(row: &[f32]) -> f64 {
    let h = 1.0 / (ALBEDO_NODES - 1) as f64;
    row.windows(2)
        .enumerate()
        .map(|(i, e)| {
            let (a, b) = (i as f64 * h, (i + 1) as f64 * h);
            let (ea, eb) = (f64::from(e[0]), f64::from(e[1]));
            let slope = (eb - ea) / h;
            // E(s) = ea + slope (s - a)
            (ea - slope * a) * (b.powi(4) - a.powi(4)) + slope * 0.8 * (b.powi(5) - a.powi(5))
        })
        .sum()
}

/// Directional albedo of one coat: index of refraction `ior` >= 1, cosine `mu` 0..1, GGX width `alpha` 0..1. A node of
/// the table holds this value, within 1.5e-4.
pub fn directional_albedo(ior: f64, mu: f64, alpha: f64) -> f64 {
    by_quadrature(ior, mu, alpha, &Quadrature::new(20, 10))
}

/// Unpolarised reflectance of a smooth dielectric interface from Fresnel's two amplitudes, by the cosines on both
/// sides. `ior` >= 1, `cos` 0..1.
fn fresnel(ior: f64, cos: f64) -> f64 {
    if ior == 1.0 || ior.is_infinite() {
        return if ior == 1.0 { 0.0 } else { 1.0 };
    }
    let inside = (1.0 - (1.0 - cos * cos) / (ior * ior)).sqrt();
    let across = (cos - ior * inside) / (cos + ior * inside);
    let along = (ior * cos - inside) / (ior * cos + inside);
    0.5 * (across * across + along * along)
}

/// Smith's height-correlated shadowing over masking, `G2 / G1(v)`, of the GGX distribution \[Heitz14\]: the weight of a
/// direction that was sampled through a visible normal. Both cosines are above 0.
fn shadowing(cos_v: f64, cos_l: f64, alpha: f64) -> f64 {
    // 1 + 2 Lambda, with the tangent expressed by the cosine.
    let stretch = |c: f64| (c * c + alpha * alpha * (1.0 - c * c)).sqrt() / c;
    let (v, l) = (stretch(cos_v), stretch(cos_l));
    (1.0 + v) / (v + l)
}

/// `E` by quadrature over the visible normals: with `h` drawn from their density the integrand is `F G2 / G1`.
///
/// In the stretched space of \[Dupuy23\], visible normals are uniform over a spherical cap. There `h` is given by its
/// angle `beta` from the stretched `v` and its azimuth `psi` about it, and the integrand has neither cone nor root
/// inside. `v.h` depends on `beta` alone. So the reflected direction is above the surface where the height of `h` lies
/// between two roots of a quadratic equation: lower facets reflect downwards, and so do level facets seen nearly edge
/// on. The limits of the azimuth are therefore known in closed form. The outer integral is split where a limit begins
/// to differ from the end of a half turn. Each part uses sin^2 as its variable, because the limits of the azimuth
/// behave like square roots there.
fn by_quadrature(ior: f64, mu: f64, alpha: f64, rule: &Quadrature) -> f64 {
    if alpha == 0.0 {
        return fresnel(ior, mu);
    }
    let mu = mu.max(1e-9);
    let v = DVec3::new((1.0 - mu * mu).max(0.0).sqrt(), 0.0, mu);
    let stretched = DVec3::new(v.x * alpha, 0.0, v.z);
    let (v_std, scale) = (stretched.normalize(), stretched.length());
    let upward = DVec3::new(-v_std.z, 0.0, v_std.x);
    // Heights of `h` on the ring at `beta`: centre and half width of the range.
    let heights = |beta: f64| (v_std.z * beta.cos(), v_std.x * beta.sin());
    // The heights between which the reflected direction is above the surface; NaN: none.
    let allowed = |beta: f64| {
        let half = scale * beta.cos();
        let sum = half + (half * half - mu * mu * alpha * alpha * (1.0 - alpha * alpha)).sqrt();
        (mu * alpha * alpha / sum, sum / (mu * (1.0 - alpha * alpha)))
    };
    let above_lowest = |beta: f64| heights(beta).0 - heights(beta).1 - allowed(beta).0;
    let below_highest = |beta: f64| allowed(beta).1 - heights(beta).0 - heights(beta).1;
    let overlap = |beta: f64| {
        let ((middle, half), (low, high)) = (heights(beta), allowed(beta));
        (middle + half - low).min(high - middle + half)
    };
    let last = root(0.0, 0.5 * PI, overlap).unwrap_or(0.5 * PI);
    let ring = |beta: f64| {
        let ((middle, half), (low, high)) = (heights(beta), allowed(beta));
        let azimuth = |height: f64| {
            let cos = (height - middle) / half;
            if cos.is_nan() { 0.0 } else { cos.clamp(-1.0, 1.0) }.acos()
        };
        // From directly above `v`, the highest, to below it. A ring of constant height is allowed as a whole.
        let (from, to) = if half > 0.0 { (azimuth(high), azimuth(low)) } else { (0.0, PI) };
        let (sin, cos) = beta.sin_cos();
        let mut sum = 0.0;
        for &(x, w) in &rule.azimuth {
            let (sin_psi, cos_psi) = (from + (to - from) * x).sin_cos();
            let h = v_std * cos + upward * (sin * cos_psi) + DVec3::Y * (sin * sin_psi);
            let h = DVec3::new(h.x * alpha, h.y * alpha, h.z).normalize();
            let vh = v.dot(h).clamp(0.0, 1.0);
            let l_z = 2.0 * vh * h.z - v.z;
            if l_z > 0.0 {
                sum += w * fresnel(ior, vh) * shadowing(v.z, l_z, alpha);
            }
        }
        // Swept area of the cap: 4 sin cos dbeta dpsi of 2 pi (1 + v.z), both halves of the azimuth.
        sum * (to - from) * 4.0 * sin * cos / (PI * (1.0 + v_std.z))
    };
    let mut ends = [0.0, last, last, last];
    ends[1] = root(0.0, last, above_lowest).unwrap_or(last);
    ends[2] = root(0.0, last, below_highest).unwrap_or(last);
    ends.sort_by(f64::total_cmp);
    let mut sum = 0.0;
    for part in ends.windows(2) {
        let length = part[1] - part[0];
        for &(x, w) in &rule.tilt {
            let (sin, cos) = (0.5 * PI * x).sin_cos();
            sum += w * PI * sin * cos * length * ring(part[0] + length * sin * sin);
        }
    }
    sum
}

/// Width below which no sheen is narrower.
pub const LEAST_SHEEN_ALPHA: f64 = 1e-3;

/// Directional albedo of a white sheen, `integral D V (n.l) dl`, with D and V of \[Estevez17\] as KHR_materials_sheen has
/// them. `rule`: nodes of the azimuth, and of the square root of the cosine of `l`.
///
/// `divided`: by what the value is divided for the cosine of `l`.
fn sheen_albedo(mu: f64, alpha: f64, rule: &Quadrature, divided: &dyn Fn(f64) -> f64) -> f64 {
    // No surface is seen at a smaller cosine.
    let (mu, alpha) = (mu.max(1e-3), alpha.max(LEAST_SHEEN_ALPHA));
    let v = DVec3::new((1.0 - mu * mu).max(0.0).sqrt(), 0.0, mu);
    let lambda_v = sheen_lambda(mu, alpha);
    let mut sum = 0.0;
    for &(root, weight) in &rule.tilt {
        let cos = root * root;
        let sin = (1.0 - cos * cos).sqrt();
        // (n.l) of the integrand and of V cancel.
        let visible = 1.0 / (divided(cos) * (1.0 + lambda_v + sheen_lambda(cos, alpha)) * 4.0 * mu);
        for &(part, share) in &rule.azimuth {
            let (sin_phi, cos_phi) = (PI * part).sin_cos();
            let h = (v + DVec3::new(sin * cos_phi, sin * sin_phi, cos)).normalize();
            let fibres = (2.0 + 1.0 / alpha) * (1.0 - h.z * h.z).max(0.0).powf(0.5 / alpha) / (2.0 * PI);
            sum += weight * 2.0 * root * share * 2.0 * PI * fibres * visible;
        }
    }
    sum
}

/// The fitted shadowing of \[Estevez17\].
fn sheen_lambda(cos: f64, alpha: f64) -> f64 {
    let t = (1.0 - alpha) * (1.0 - alpha);
    let mix = |a: f64, b: f64| a + (b - a) * t;
    let [a, b, c] = [mix(21.5473, 25.3245), mix(3.82987, 3.32435), mix(0.19823, 0.16801)];
    let [d, e] = [mix(-1.97760, -1.27393), mix(-4.32054, -4.85967)];
    let fit = |x: f64| a / (1.0 + b * x.powf(c)) + d * x + e;
    if cos < 0.5 { fit(cos) } else { 2.0 * fit(0.5) - fit(1.0 - cos) }.exp()
}

/// Where a continuous function changes sign between `a` and `b`, by bisection; `None` if its ends have the same sign.
fn root(mut a: f64, mut b: f64, f: impl Fn(f64) -> f64) -> Option<f64> {
    let sign = f(a) > 0.0;
    if (f(b) > 0.0) == sign {
        return None;
    }
    for _ in 0..26 {
        let middle = 0.5 * (a + b);
        if (f(middle) > 0.0) == sign {
            a = middle
        } else {
            b = middle
        }
    }
    Some(0.5 * (a + b))
}

/// Gauss-Legendre nodes and weights on 0..1 for both variables.
struct Quadrature {
    azimuth: Vec<(f64, f64)>,
    tilt: Vec<(f64, f64)>,
}

impl Quadrature {
    fn new(azimuths: usize, points: usize) -> Self {
        Self { azimuth: gauss_legendre(azimuths), tilt: gauss_legendre(points) }
    }
}

/// Nodes and weights of Gauss-Legendre quadrature on 0..1: Newton's method on the Legendre polynomial from Chebyshev's guess.
fn gauss_legendre(points: usize) -> Vec<(f64, f64)> {
    let n = points as f64;
    (0..points)
        .map(|k| {
            let mut x = (PI * (k as f64 + 0.75) / (n + 0.5)).cos();
            let mut slope = 1.0;
            for _ in 0..8 {
                let (mut p0, mut p1) = (1.0, x);
                for j in 2..=points {
                    let j = j as f64;
                    (p0, p1) = (p1, ((2.0 * j - 1.0) * x * p1 - (j - 1.0) * p0) / j);
                }
                slope = n * (x * p1 - p0) / (x * x - 1.0);
                x -= p1 / slope;
            }
            (0.5 * (1.0 + x), 1.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ior_1_has_no_coat_at_all() {
        let t = AlbedoTable::new(1.0);
        assert!(t.directional.iter().chain(&t.average).all(|e| *e == 0.0));
        assert_eq!(AlbedoTable::new(f32::NAN), t);
    }

    #[test]
    fn quadrature_has_converged() {
        let (used, fine) = (Quadrature::new(20, 10), Quadrature::new(48, 32));
        for ior in [1.1, 1.5, 2.5] {
            for j in (0..ALBEDO_NODES).step_by(3) {
                for i in (0..ALBEDO_NODES).step_by(2) {
                    let (mu, alpha) = (node(i), node(j));
                    let (a, b) = (by_quadrature(ior, mu, alpha, &used), by_quadrature(ior, mu, alpha, &fine));
                    assert!((a - b).abs() < 1.5e-4, "ior {ior} mu {mu} alpha {alpha}: {a} {b}");
                    assert!((0.0..=1.0).contains(&a));
                }
            }
        }
    }

    #[test]
    fn smooth_row_is_fresnel_and_the_average_is_that_of_the_row() {
        let t = AlbedoTable::new(1.5);
        assert!((t.directional(1.0, 0.0) - 0.04).abs() < 1e-6);
        assert_eq!(t.directional(0.0, 0.0), 1.0);
        for alpha in [0.0, 0.003, 0.1, 0.37, 1.0] {
            let n = 20_000;
            let sum: f64 = (0..n)
                .map(|i| {
                    let mu = (f64::from(i) + 0.5) / f64::from(n);
                    2.0 * t.directional(mu, alpha) * mu / f64::from(n)
                })
                .sum();
            assert!((sum - t.average(alpha)).abs() < 1e-6, "{alpha}: {sum} {}", t.average(alpha));
        }
        // Hemispherical reflectance of a smooth dielectric of index 1.5: 0.0918 [Duntley42].
        assert!((t.average(0.0) - 0.0918).abs() < 3e-4, "{}", t.average(0.0));
    }

    #[test]
    fn facets_that_reflect_everything_lose_what_single_scattering_loses() {
        let t = AlbedoTable::white();
        assert!((t.directional(1.0, 0.0) - 1.0).abs() < 1e-7 && (t.average(0.0) - 1.0).abs() < 1e-6);
        for (alpha, expected) in [(0.25, 0.882 / 0.9), (1.0, 0.55)] {
            let average = t.average(alpha);
            assert!(average < 1.0 && average > expected - 0.2, "{alpha}: {average}");
        }
        // No coat reflects more than that.
        let coat = AlbedoTable::new(2.4);
        assert!(t.directional.iter().zip(&coat.directional).all(|(all, some)| *all >= some - 1e-4));
    }

    #[test]
    fn sheen_converges_and_reflects_no_more_than_it_gets() {
        let (used, fine) = (Quadrature::new(48, 64), Quadrature::new(160, 200));
        let [fitted, limited] = AlbedoTable::sheen();
        assert!(limited.directional.iter().chain(&limited.average).all(|e| (0.0..=1.0).contains(e)));
        for j in (0..ALBEDO_NODES).step_by(3) {
            for i in (0..ALBEDO_NODES).step_by(3) {
                let (mu, alpha) = (node(i), node(j));
                let [a, b] = [&used, &fine].map(|rule| sheen_albedo(mu, alpha, rule, &|_| 1.0));
                assert!((a - b).abs() < 2e-3 * b.max(1.0), "mu {mu} alpha {alpha}: {a} {b}");
            }
        }
        // Where the model sends out no more than it gets, it is as it was fitted.
        for mu in [0.2, 0.5, 1.0] {
            for alpha in [0.1, 0.5, 1.0] {
                let [a, b] = [&fitted, &limited].map(|t| t.directional(mu, alpha));
                assert!((a - b).abs() < 2e-3, "mu {mu} alpha {alpha}: {a} {b}");
            }
        }
    }

    #[test]
    fn interpolation_error_is_bounded() {
        let rule = Quadrature::new(20, 10);
        let t = AlbedoTable::new(1.5);
        // Toward grazing angles E depends on mu / alpha alone, and no grid resolves it; but the light that arrives
        // there is proportional to mu.
        let (mut worst, mut weighed): (f64, f64) = (0.0, 0.0);
        for j in 0..40 {
            for i in 0..40 {
                let (mu, alpha) = ((f64::from(i) / 39.0).powi(3), (f64::from(j) / 39.0).powi(3).max(1e-4));
                let e = (t.directional(mu, alpha) - by_quadrature(1.5, mu, alpha, &rule)).abs();
                weighed = weighed.max(e * mu);
                if mu > 0.1 {
                    worst = worst.max(e);
                }
                let f32_form = t.directional_f32(mu as f32, alpha as f32);
                assert!((f64::from(f32_form) - t.directional(mu, alpha)).abs() < 2e-6);
                assert!((f64::from(t.average_f32(alpha as f32)) - t.average(alpha)).abs() < 2e-6);
            }
        }
        assert!(worst < 2e-3 && weighed < 3e-4, "{worst} {weighed}");
    }

    /// Found in use, similar to R10: every index of refraction had its own table, at a few hundredths of a second each.
    #[test]
    fn the_number_of_tables_is_bounded_and_few_indices_have_their_own() {
        let (own, uses) = tabulated(&[1.5, 1.33, 1.5, f32::NAN, 2.4, 1.33]);
        assert_eq!(own, [1.5, 1.33, 1.0, 2.4]);
        assert_eq!(uses, [0, 1, 0, 2, 3, 1]);
        assert_eq!(tabulated(&[]), (vec![], vec![]));
        let many: Vec<f32> = (0..15_000).map(|k| 1.0 + k as f32 * 1e-4).collect();
        let (shared, uses) = tabulated(&many);
        assert_eq!(shared.len(), MAX_TABLES);
        for (ior, table) in many.iter().zip(&uses) {
            assert!((shared[*table] - ior).abs() < 0.03, "{ior}: {}", shared[*table]);
        }
    }
}
