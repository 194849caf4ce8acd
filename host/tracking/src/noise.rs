//! Estimates the tracker's noise from samples: the part of each sample that no smooth motion explains.
//!
//! A cubic divided difference of four samples vanishes for any motion of constant acceleration, whatever the spacing of
//! the stamps. Scaled to unit weight it has the variance of one sample. Its median over a window ignores the few
//! windows in which the acceleration jumped. Only noise that is white from sample to sample is measured; a slow wander
//! of a tracker's calibration looks like motion to this and to every other filter.

use super::imm::Chart;

/// Differences kept; the median over them has a standard error of about a tenth.
const WINDOW: usize = 63;

/// Median of chi-square with 3 degrees of freedom.
const CHI2_3_MEDIAN: f64 = 2.365_974;

/// Running estimate of the variance per axis of one sample.
#[derive(Clone, Debug)]
pub(crate) struct NoiseEstimator<C: Chart> {
    points: [Option<(i64, C::Point)>; 3],
    ring: [f64; WINDOW],
    sorted: [f64; WINDOW],
    filled: usize,
    next: usize,
    variance: f64,
    floor: f64,
}

impl<C: Chart> NoiseEstimator<C> {
    /// `prior` and `floor` are standard deviations in metres or rad: the assumed value until the window is half full,
    /// and the least reported value.
    pub(crate) fn new(prior: f64, floor: f64) -> Self {
        Self {
            points: [None; 3],
            ring: [0.0; WINDOW],
            sorted: [0.0; WINDOW],
            filled: 0,
            next: 0,
            variance: prior * prior,
            floor: floor * floor,
        }
    }

    /// Variance per axis, m^2 or rad^2.
    pub(crate) fn variance(&self) -> f64 {
        self.variance.max(self.floor)
    }

    /// Drops the last points (not the estimate): the next samples belong to another track.
    pub(crate) fn break_track(&mut self) {
        self.points = [None; 3];
    }

    /// Adds a sample captured at `at_ns`, later than the previous one.
    pub(crate) fn push(&mut self, at_ns: i64, z: C::Point) {
        if let [Some((t0, p0)), Some((t1, p1)), Some((t2, p2))] = self.points {
            // Seconds from the newest, exact in f64 for any gap that a track survives.
            let t = [t0, t1, t2].map(|t| (t - at_ns) as f64 * 1e-9);
            let t = [t[0], t[1], t[2], 0.0];
            // Weight of sample i in the divided difference: 1 / prod (t_i - t_j).
            let w: [f64; 4] = std::array::from_fn(|i| {
                (0..4).filter(|&j| j != i).map(|j| 1.0 / (t[i] - t[j])).product::<f64>()
            });
            let norm2: f64 = w.iter().map(|w| w * w).sum();
            // Tangents at the middle sample keep the chart's curvature out of the sum (the weights sum to 0).
            let sum = C::between(p1, p0) * w[0] + C::between(p1, p2) * w[2] + C::between(p1, z) * w[3];
            let scaled = sum.length_squared() / norm2;
            if scaled.is_finite() {
                self.insert(scaled);
            }
        }
        self.points = [self.points[1], self.points[2], Some((at_ns, z))];
    }

    fn insert(&mut self, value: f64) {
        if self.filled == WINDOW {
            let old = self.sorted.partition_point(|&v| v < self.ring[self.next]);
            self.sorted.copy_within(old + 1.., old);
            self.filled -= 1;
        }
        let at = self.sorted[..self.filled].partition_point(|&v| v < value);
        self.sorted.copy_within(at..self.filled, at + 1);
        self.sorted[at] = value;
        self.filled += 1;
        self.ring[self.next] = value;
        self.next = (self.next + 1) % WINDOW;
        if self.filled > WINDOW / 2 {
            self.variance = self.sorted[self.filled / 2] / CHI2_3_MEDIAN;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::imm::{Rotations, Translations};
    use super::super::testing::Gauss;
    use super::*;
    use dpm_common::so3::so3_exp;
    use glam::DVec3;

    #[test]
    fn finds_the_noise_under_motion_and_irregular_stamps() {
        for sigma in [1e-6, 1e-4, 1e-2] {
            let mut gauss = Gauss::new(7);
            let mut positions = NoiseEstimator::<Translations>::new(1e-3, 1e-9);
            let mut rotations = NoiseEstimator::<Rotations>::new(1e-3, 1e-9);
            let (mut seen_p, mut seen_r) = (0.0, 0.0);
            let n = 2000;
            let mut at = 5_000_000_000i64;
            for i in 0..n {
                at += 1_000_000 + (i * 7919 % 2_000_000);
                let t = at as f64 * 1e-9;
                let p = DVec3::new(t, -2.0 * t + 1.5 * t * t, 0.3) + gauss.vector(sigma);
                positions.push(at, p);
                let q = so3_exp(gauss.vector(sigma)) * so3_exp(DVec3::new(0.0, 3.0, 1.0) * t);
                rotations.push(at, q);
                if i >= n / 2 {
                    seen_p += positions.variance() / (n / 2) as f64;
                    seen_r += rotations.variance() / (n / 2) as f64;
                }
            }
            for seen in [seen_p, seen_r] {
                let ratio = seen.sqrt() / sigma;
                assert!((0.9..1.1).contains(&ratio), "{ratio} at {sigma}");
            }
        }
    }

    #[test]
    fn median_ignores_rare_jumps_and_the_floor_holds() {
        let mut e = NoiseEstimator::<Translations>::new(1e-4, 1e-6);
        for i in 0..1000i64 {
            let jump = if i % 50 == 0 { 0.5 } else { 0.0 };
            e.push(i * 2_000_000, DVec3::splat(jump));
        }
        assert_eq!(e.variance(), 1e-12);
    }
}
