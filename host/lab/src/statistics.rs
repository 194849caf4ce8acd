//! Samples and their claimed density into a significance: is the sampler what it says it is?

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
}
