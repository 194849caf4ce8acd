//! Brightness along a sweep into a field over the raster: a polynomial of second order.
//!
//! The light on the sensor falls with the square of the distance, and with the angle between the sensor's axis and the
//! light; both are divided out. A sensor behind a round diffuser has no axis.

use crate::dense::{inverse_spd, solve_spd};
use crate::sensor::Brightness;
use dpm_calibration_file::light::{row, FlatField, TERMS};
use dpm_device::planes::Raster;
use glam::{DVec2, DVec3};
use thiserror::Error;

/// Least cosine of the angle at which a sensor's reading is used.
const LEAST_COSINE: f64 = 0.2;
/// A field that is more uncertain than this anywhere is refused.
const MOST_SIGMA: f64 = 0.01;
/// A field darker than this anywhere is no flat field of a projector.
const DARKEST: f64 = 0.05;

/// Why a sweep gives no field.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum FlatError {
    /// Too few readings.
    #[error("{0} readings are too few for a flat field, {FEWEST} are needed; move the sensor through the picture for longer")]
    TooFew(usize),
    /// The sweep does not cover the raster.
    #[error(
        "the flat field is uncertain by {percent:.1} % near pixel ({x:.0}, {y:.0}); move the sensor there too"
    )]
    Uncovered {
        /// Standard deviation, percent.
        percent: f64,
        /// Column.
        x: f64,
        /// Row.
        y: f64,
    },
    /// The field is dark or negative somewhere.
    #[error("near pixel ({x:.0}, {y:.0}) the light is {percent:.0} % of that in the middle; is the sensor shaded there, is the aperture of the lens cut off?")]
    Dark {
        /// Brightness, percent of the middle.
        percent: f64,
        /// Column.
        x: f64,
        /// Row.
        y: f64,
    },
}

/// Fewest readings.
const FEWEST: usize = 200;

/// Fits a field. `axis` is the direction in the wand's body frame into which a flat sensor looks; `None` for one behind
/// a round diffuser.
///
/// # Errors
/// Each reason of [`FlatError`].
pub fn flat_field(raster: Raster, sweep: &[Brightness], axis: Option<DVec3>) -> Result<FlatField, FlatError> {
    let reading = |b: &Brightness| {
        let cosine = axis.map_or(1.0, |a| a.normalize_or_zero().dot(b.towards));
        let at_a_metre = b.level * b.distance_m * b.distance_m / cosine;
        (cosine >= LEAST_COSINE && at_a_metre.is_finite() && b.pixel.is_finite())
            .then_some((b.pixel, at_a_metre))
    };
    let readings: Vec<(DVec2, f64)> = sweep.iter().filter_map(reading).collect();
    if readings.len() < FEWEST {
        return Err(FlatError::TooFew(readings.len()));
    }
    let mut weights = vec![1.0; readings.len()];
    let mut fitted = None;
    // Twice with the readings that were half covered weighed down.
    for _ in 0..4 {
        let (mut square, mut right) = (vec![vec![0.0; TERMS]; TERMS], vec![0.0; TERMS]);
        for ((pixel, level), weight) in readings.iter().zip(&weights) {
            let row = row(raster, *pixel);
            for (i, a) in row.iter().enumerate() {
                right[i] += weight * a * level;
                row.iter().enumerate().for_each(|(j, b)| square[i][j] += weight * a * b);
            }
        }
        let terms = solve_spd(&square, &right).ok_or(FlatError::TooFew(readings.len()))?;
        let off = |(pixel, level): &(DVec2, f64)| {
            level - row(raster, *pixel).iter().zip(&terms).map(|(a, b)| a * b).sum::<f64>()
        };
        let mut sizes: Vec<f64> = readings.iter().map(|r| off(r).abs()).collect();
        sizes.sort_by(f64::total_cmp);
        // The median of a normal deviation's size is 0.674 sigma.
        let sigma = (sizes[sizes.len() / 2] / 0.674).max(1e-12 * terms[0].abs());
        weights = readings.iter().map(|r| crate::least_squares::huber(off(r).abs(), 2.0 * sigma).0).collect();
        fitted = Some((terms, square, sigma));
    }
    let (terms, square, sigma) = fitted.ok_or(FlatError::TooFew(readings.len()))?;
    judge(raster, &terms, &square, sigma)
}

fn judge(raster: Raster, terms: &[f64], square: &[Vec<f64>], sigma: f64) -> Result<FlatField, FlatError> {
    let inverse = inverse_spd(square).ok_or(FlatError::TooFew(0))?;
    let unit = terms[0];
    let field = FlatField { raster, terms: std::array::from_fn(|i| terms[i] / unit), unit, sigma: 0.0 };
    let (mut worst, mut darkest) = ((0.0, DVec2::ZERO), (f64::INFINITY, DVec2::ZERO));
    for i in 0..81u32 {
        let share = DVec2::new(f64::from(i % 9), f64::from(i / 9)) / 8.0;
        let pixel = share * DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
        let row = row(raster, pixel);
        let variance: f64 =
            (0..TERMS).map(|a| row[a] * (0..TERMS).map(|b| inverse[a][b] * row[b]).sum::<f64>()).sum();
        let deviation = sigma * variance.max(0.0).sqrt() / unit.abs();
        worst = if deviation > worst.0 { (deviation, pixel) } else { worst };
        darkest = if field.at(pixel) < darkest.0 { (field.at(pixel), pixel) } else { darkest };
    }
    if worst.0 > MOST_SIGMA || unit <= 0.0 {
        return Err(FlatError::Uncovered { percent: 100.0 * worst.0, x: worst.1.x, y: worst.1.y });
    }
    if darkest.0 < DARKEST {
        return Err(FlatError::Dark { percent: 100.0 * darkest.0, x: darkest.1.x, y: darkest.1.y });
    }
    Ok(FlatField { sigma: worst.0, ..field })
}
