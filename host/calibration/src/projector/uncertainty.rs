//! A covariance of the projector into the error of the light over a working volume.

use crate::dense::cholesky;
use crate::model::{ProjectorModel, PARAMETERS};
use dpm_calibration_file::LightError;
use dpm_device::planes::Raster;
use dpm_device::rng::Draws;
use glam::{DVec2, DVec3};

/// A box in the world in which light is needed, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Volume {
    /// The corner of the smallest coordinates.
    pub low: DVec3,
    /// The corner of the largest coordinates.
    pub high: DVec3,
}

impl Volume {
    /// The smallest box around points.
    pub fn around(points: impl IntoIterator<Item = DVec3>) -> Option<Self> {
        points.into_iter().fold(None, |all, p| {
            Some(
                all.map_or(Self { low: p, high: p }, |v: Self| Self {
                    low: v.low.min(p),
                    high: v.high.max(p),
                }),
            )
        })
    }

    /// A grid of points, corners included, of those that the projector's raster reaches.
    pub fn points(&self, model: &ProjectorModel, raster: Raster) -> Vec<DVec3> {
        const N: u32 = 8;
        let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
        let share = |i: u32| f64::from(i) / f64::from(N - 1);
        (0..N * N * N)
            .map(|i| DVec3::new(share(i % N), share(i / N % N), share(i / N / N)))
            .map(|s| self.low + s * (self.high - self.low))
            .filter(|p| model.project(*p).is_some_and(|q| q.cmpge(DVec2::ZERO).all() && q.cmple(size).all()))
            .collect()
    }
}

/// The share of calibrations whose error [`predict`] bounds.
const BOUND: f64 = 0.99;
/// Calibrations that are drawn from the covariance.
const DRAWS: u64 = 400;

/// The error over `points` of a projector whose numbers have the given covariance, and whose points in the
/// world are known to `point_m` along each axis (0 where they are exact).
pub fn predict(model: &ProjectorModel, covariance: &[Vec<f64>], points: &[DVec3]) -> LightError {
    predict_share(model, covariance, points, BOUND)
}

/// The same, with the 99th percentile over the points that a share of all projectors so uncertain stays below: 0.99 is a bound,
/// 0.5 what is to be expected.
pub(crate) fn predict_share(
    model: &ProjectorModel,
    covariance: &[Vec<f64>],
    points: &[DVec3],
    share: f64,
) -> LightError {
    let n = PARAMETERS;
    let slopes: Vec<_> =
        points.iter().filter_map(|p| model.derive(*p).map(|d| (*p, d.by_parameters))).collect();
    let deviation =
        |[x, y]: &[[f64; PARAMETERS]; 2]| (variance(covariance, x) + variance(covariance, y)).max(0.0).sqrt();
    let mut deviations: Vec<(f64, DVec3)> = slopes.iter().map(|(p, rows)| (deviation(rows), *p)).collect();
    deviations.sort_by(|a, b| a.0.total_cmp(&b.0));
    let Some(&(worst_px, worst)) = deviations.last() else {
        return LightError {
            typical_px: f64::INFINITY,
            p99_px: f64::INFINITY,
            worst: DVec3::ZERO,
            worst_px: f64::INFINITY,
        };
    };
    let typical_px = deviations[deviations.len() / 2].0;
    let Some(root) = root(covariance) else {
        return LightError { typical_px, p99_px: f64::INFINITY, worst, worst_px };
    };
    let draws = Draws::new(0x0ca1_1b8a);
    let mut bounds: Vec<f64> = (0..DRAWS)
        .map(|draw| {
            let z: Vec<f64> = (0..n as u64).map(|i| draws.normal(draw * 64 + i)).collect();
            let e: Vec<f64> = (0..n).map(|i| (0..=i).map(|j| root[i][j] * z[j]).sum()).collect();
            let size = |row: &[f64; PARAMETERS]| row.iter().zip(&e).map(|(a, b)| a * b).sum::<f64>();
            percentile(slopes.iter().map(|(_, rows)| size(&rows[0]).hypot(size(&rows[1]))).collect(), 0.99)
        })
        .collect();
    bounds.sort_by(f64::total_cmp);
    let p99_px = bounds[(share * (bounds.len() - 1) as f64).round() as usize];
    LightError { typical_px, p99_px, worst, worst_px }
}

/// The variance of what changes by `row` with the projector's numbers.
pub(crate) fn variance(covariance: &[Vec<f64>], row: &[f64; PARAMETERS]) -> f64 {
    let times = |i: usize| (0..PARAMETERS).map(|j| covariance[i][j] * row[j]).sum::<f64>();
    (0..PARAMETERS).map(|i| row[i] * times(i)).sum()
}

/// A lower triangle whose square is the covariance of the numbers. Numbers that are held have no variance, so
/// a trace of each diagonal is added.
fn root(covariance: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let scale: Vec<f64> = (0..PARAMETERS).map(|i| covariance[i][i].sqrt()).collect();
    let at = |i: usize, j: usize| {
        let s = scale[i] * scale[j];
        let correlation = if s > 0.0 { covariance[i][j] / s } else { 0.0 };
        if i == j {
            1.0 + 1e-9
        } else {
            correlation
        }
    };
    let correlation: Vec<Vec<f64>> =
        (0..PARAMETERS).map(|i| (0..PARAMETERS).map(|j| at(i, j)).collect()).collect();
    let mut root = cholesky(&correlation)?;
    root.iter_mut().zip(&scale).for_each(|(row, s)| row.iter_mut().for_each(|v| *v *= s));
    Some(root)
}

/// The value below which a share of all lies; 0 of none.
pub(crate) fn percentile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1) as f64;
    values.get((share * last).round() as usize).copied().unwrap_or(0.0)
}
