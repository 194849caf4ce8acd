//! Samples into significance: is a sampler what it says it is, how sure is a mean, and do two means differ?

use glam::DVec3;
use std::f64::consts::PI;

/// Outcome of a chi-square test of directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DirectionTest {
    /// Integral of the density over the sphere minus the share of samples that were not absorbed.
    pub integral_error: f64,
    /// Probability of a worse fit by chance.
    pub p_value: f64,
}

/// Upper tail of the chi-square distribution by the normal approximation of its cube root \[Wilson31\], tail by \[Abramowitz64\] 7.1.26:
/// good to a few percent of p, enough for thresholds.
pub(crate) fn chi2_p_value(chi2: f64, freedom: f64) -> f64 {
    let spread = 2.0 / (9.0 * freedom);
    let z = ((chi2 / freedom).cbrt() - (1.0 - spread)) / spread.sqrt();
    let t = 1.0 / (1.0 + 0.3275911 * z.abs() / std::f64::consts::SQRT_2);
    let poly =
        t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    let tail = 0.5 * poly * (-0.5 * z * z).exp();
    if z > 0.0 {
        tail
    } else {
        1.0 - tail
    }
}

/// Cells of (y, azimuth) around the Y axis, each way; all of one solid angle.
const CELLS: usize = 40;
/// Points per cell and direction at which the density is integrated.
const SUB: usize = 14;

/// Draws `samples` directions (`None`: absorbed) and compares their histogram with the density per steradian.
pub(crate) fn test_directions(
    samples: u32,
    sample: &mut dyn FnMut() -> Option<DVec3>,
    pdf: &dyn Fn(DVec3) -> f64,
) -> DirectionTest {
    let mut count = vec![0.0; CELLS * CELLS];
    let mut kept = 0.0;
    let index = |x: f64| ((x * CELLS as f64) as usize).min(CELLS - 1);
    for _ in 0..samples {
        let Some(d) = sample() else { continue };
        count[index(0.5 - 0.5 * d.y) * CELLS + index(0.5 + d.z.atan2(d.x) / (2.0 * PI))] += 1.0;
        kept += 1.0;
    }
    let mut expected = vec![0.0; CELLS * CELLS];
    for (cell, e) in expected.iter_mut().enumerate() {
        let (row, column) = ((cell / CELLS) as f64, (cell % CELLS) as f64);
        let mut sum = 0.0;
        for i in 0..SUB {
            for j in 0..SUB {
                let at = |k: usize| (k as f64 + 0.5) / SUB as f64;
                let y = 1.0 - 2.0 * (row + at(i)) / CELLS as f64;
                let phi = (2.0 * (column + at(j)) / CELLS as f64 - 1.0) * PI;
                let r = (1.0 - y * y).sqrt();
                sum += pdf(DVec3::new(r * phi.cos(), y, r * phi.sin()));
            }
        }
        *e = sum / (SUB * SUB) as f64 * 4.0 * PI / (CELLS * CELLS) as f64 * f64::from(samples);
    }
    let integral_error = (expected.iter().sum::<f64>() - kept) / f64::from(samples);
    // Cells that expect few samples are taken together: the approximation needs about ten in each.
    let (mut chi2, mut freedom, mut few) = (0.0, -1.0, (0.0, 0.0));
    for (c, e) in count.iter().zip(&expected) {
        if *e < 10.0 {
            few = (few.0 + c, few.1 + e);
        } else {
            chi2 += (c - e) * (c - e) / e;
            freedom += 1.0;
        }
    }
    if few.1 >= 10.0 {
        chi2 += (few.0 - few.1) * (few.0 - few.1) / few.1;
        freedom += 1.0;
    } else if few.0 > 30.0 {
        // Samples where the density says there are none.
        return DirectionTest { integral_error, p_value: 0.0 };
    }
    DirectionTest { integral_error, p_value: chi2_p_value(chi2, f64::max(freedom, 1.0)) }
}

/// Mean and standard error of a stream of values.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Mean {
    n: f64,
    mean: f64,
    m2: f64,
}

impl Mean {
    /// Adds a value (\[Welford62\]).
    pub(crate) fn push(&mut self, x: f64) {
        self.n += 1.0;
        let d = x - self.mean;
        self.mean += d / self.n;
        self.m2 += d * (x - self.mean);
    }

    /// The mean.
    pub(crate) fn mean(&self) -> f64 {
        self.mean
    }

    /// Its standard error.
    pub(crate) fn standard_error(&self) -> f64 {
        (self.m2 / (self.n * (self.n - 1.0).max(1.0))).sqrt()
    }

    /// Standard deviation of one value.
    pub(crate) fn deviation(&self) -> f64 {
        (self.m2 / self.n.max(1.0)).sqrt()
    }
}

/// Logarithm of the gamma function of `x` above 0. \[Abramowitz64 6.1.41 after steps up to 8\]
fn ln_gamma(mut x: f64) -> f64 {
    let mut below = 0.0;
    while x < 8.0 {
        below += x.ln();
        x += 1.0;
    }
    let x2 = 1.0 / (x * x);
    let series = (1.0 / 12.0 - x2 * (1.0 / 360.0 - x2 * (1.0 / 1260.0 - x2 / 1680.0))) / x;
    (x - 0.5) * x.ln() - x + 0.5 * (2.0 * PI).ln() + series - below
}

/// The incomplete beta function `I_x(a, b)`, by its continued fraction. \[Abramowitz64 26.5.8\]
fn incomplete_beta(x: f64, a: f64, b: f64) -> f64 {
    if x <= 0.0 || x >= 1.0 {
        return x.clamp(0.0, 1.0);
    }
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - incomplete_beta(1.0 - x, b, a);
    }
    let front = (ln_gamma(a + b) - ln_gamma(a) - ln_gamma(b) + a * x.ln() + b * (1.0 - x).ln()).exp() / a;
    // From the inside out: so many terms that more change nothing.
    let fraction = (1..=200).rev().fold(1.0, |rest, n| {
        let m = f64::from(n / 2);
        let d = if n % 2 == 0 {
            m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m))
        } else {
            -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0))
        };
        1.0 + d / rest
    });
    front / fraction
}

/// Probability that Student's t with so many degrees of freedom is farther from 0 than `t`, either way. \[Abramowitz64 26.7\]
pub(crate) fn student_p(t: f64, freedom: f64) -> f64 {
    incomplete_beta(freedom / (freedom + t * t), freedom / 2.0, 0.5)
}

/// How far from 0 Student's t is in 5 % of all cases.
fn student_95(freedom: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1000.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        *(if student_p(middle, freedom) > 0.05 { &mut low } else { &mut high }) = middle;
    }
    high
}

/// Mean and variance of the mean.
fn mean_and_its_variance(samples: &[f64]) -> (f64, f64) {
    let n = samples.len() as f64;
    let mean = samples.iter().sum::<f64>() / n;
    let squares: f64 = samples.iter().map(|x| (x - mean).powi(2)).sum();
    (mean, squares / (n - 1.0).max(1.0) / n)
}

/// Probability that chance alone parts the means of two samples of unequal variances by more than they are. `None` where neither
/// varies, or one has fewer than two. \[Welch47\]
pub(crate) fn welch_p(a: &[f64], b: &[f64]) -> Option<f64> {
    if a.len() < 2 || b.len() < 2 {
        return None;
    }
    let ((ma, va), (mb, vb)) = (mean_and_its_variance(a), mean_and_its_variance(b));
    let freedom = (va + vb).powi(2) / (va * va / (a.len() as f64 - 1.0) + vb * vb / (b.len() as f64 - 1.0));
    let p = student_p((ma - mb) / (va + vb).sqrt(), freedom);
    p.is_finite().then_some(p)
}

/// An expectation, as samples tell it.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Estimate {
    /// Mean of the samples.
    pub mean: f64,
    /// The 95 % interval by Student's distribution.
    pub interval: [f64; 2],
}

impl Estimate {
    /// That of at least two samples; with fewer the interval is as wide as can be.
    pub(crate) fn of(samples: &[f64]) -> Self {
        let (mean, variance) = mean_and_its_variance(samples);
        let reach = match samples.len() {
            0 | 1 => f64::MAX,
            n => student_95(n as f64 - 1.0) * variance.sqrt(),
        };
        Self { mean, interval: [mean - reach, mean + reach] }
    }

    /// In words, with so many decimals.
    pub(crate) fn told(&self, decimals: usize) -> String {
        let [low, high] = self.interval;
        format!("{:.decimals$} ({low:.decimals$} to {high:.decimals$})", self.mean)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::Sampler;

    #[test]
    fn p_values_of_the_table() {
        // chi^2 at 1e-3 and 0.5 for 10 and 100 degrees of freedom.
        for (chi2, freedom, p) in
            [(29.588, 10.0, 1e-3), (149.449, 100.0, 1e-3), (9.342, 10.0, 0.5), (99.334, 100.0, 0.5)]
        {
            let got = chi2_p_value(chi2, freedom);
            assert!((got / p - 1.0).abs() < 0.08, "{chi2} {freedom}: {got}");
        }
    }

    #[test]
    fn a_slightly_wrong_density_is_caught_and_the_right_one_is_not() {
        let run = |power: f64| {
            let mut s = Sampler::new(5, 5);
            let mut draw = || {
                let u = s.uniform2();
                let (r, phi) = (u[0].sqrt(), 2.0 * PI * u[1]);
                Some(DVec3::new(r * phi.cos(), (1.0 - u[0]).sqrt(), r * phi.sin()))
            };
            let pdf = |d: DVec3| if d.y > 0.0 { (power + 1.0) / (2.0 * PI) * d.y.powf(power) } else { 0.0 };
            test_directions(150_000, &mut draw, &pdf)
        };
        let (right, wrong) = (run(1.0), run(1.06));
        assert!(right.p_value > 1e-2 && right.integral_error.abs() < 1e-3, "{right:?}");
        assert!(wrong.p_value < 1e-4 && wrong.integral_error.abs() < 1e-3, "{wrong:?}");
    }

    /// Student's distribution at values of tables \[Abramowitz64 table 26.10\], and by its closed form with one degree of
    /// freedom.
    #[test]
    fn students_distribution_is_that_of_the_tables() {
        for (freedom, t) in
            [(1.0, 12.706), (2.0, 4.303), (7.0, 2.365), (15.0, 2.131), (30.0, 2.042), (120.0, 1.980)]
        {
            assert!((student_95(freedom) - t).abs() < 6e-4, "{freedom}: {}", student_95(freedom));
        }
        for t in [0.0, 0.3, 1.0, 5.0, 100.0f64] {
            let wanted = 1.0 - 2.0 / PI * t.atan();
            assert!((student_p(t, 1.0) - wanted).abs() < 1e-10, "{t}: {}", student_p(t, 1.0));
        }
    }

    /// Intervals cover the expectation in 95 of 100 draws, and p-values of Welch's test are even where there is no difference.
    #[test]
    fn intervals_cover_and_p_values_are_even() {
        let draws = dpm_device::rng::Draws::new(9);
        let sample = |first: u64, n: u64, spread: f64| -> Vec<f64> {
            (0..n).map(|k| 3.0 + spread * draws.normal(first * 64 + k)).collect()
        };
        let runs = 4000u64;
        let covered = (0..runs).filter(|run| {
            let [low, high] = Estimate::of(&sample(*run, 8, 2.0)).interval;
            (low..=high).contains(&3.0)
        });
        let share = covered.count() as f64 / runs as f64;
        assert!((share - 0.95).abs() < 0.014, "four standard deviations: {share}");
        let below = (0..runs).filter(|run| {
            let (a, b) = (sample(10_000 + *run, 8, 0.5), sample(20_000 + *run, 5, 3.0));
            welch_p(&a, &b).unwrap() < 0.1
        });
        let share = below.count() as f64 / runs as f64;
        assert!((share - 0.1).abs() < 0.03, "{share}");
        assert_eq!(welch_p(&[1.0], &[1.0, 2.0]), None);
        assert_eq!(welch_p(&[1.0, 1.0], &[1.0, 1.0]), None);
    }
}
