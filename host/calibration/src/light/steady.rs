//! Samples at one place into their mean without the flicker of lamps.

use crate::dense::{inverse_diagonal, solve_spd};
use crate::sensor::SampleBlock;
use std::f64::consts::TAU;
use thiserror::Error;

/// A steady level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Steady {
    /// Mean, in the sensor's unit.
    pub level: f64,
    /// Standard deviation of that mean.
    pub sigma: f64,
    /// Amplitude of the flicker at its first frequency.
    pub flicker: f64,
}

/// Why samples are refused.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum SteadyError {
    /// Too short.
    #[error("light: {have_ms:.1} ms of samples are too few, {need_ms:.1} ms are needed to take the lamps' flicker out; hold the sensor still for longer")]
    TooShort {
        /// Length, milliseconds.
        have_ms: f64,
        /// Length needed, milliseconds.
        need_ms: f64,
    },
    /// A level is NaN or infinite.
    #[error("light: a sample is no number")]
    NotFinite,
    /// The level drifts.
    #[error("light: the level changes by {percent:.1} % while it is read; hold the sensor still, and do not shade it")]
    NotSteady {
        /// Change over the reading, percent of its level.
        percent: f64,
    },
}

/// Constant, then cosine and sine of the flicker and of its double.
const TERMS: usize = 5;
/// Fewest samples.
const FEWEST: f64 = 20.0;
/// Frames that last as long as a period of the flicker, or twice as long, show it as a constant. The constant takes it then,
/// and is right, because such frames have it averaged out.
const RIDGE: f64 = 1e-3;
/// A change over a reading that is no longer noise, as a share of the level.
const MOST_CHANGE: f64 = 0.02;

/// Fits a constant and the flicker of lamps at `flicker_hz` (twice that of the mains: 100 or 120) and its double.
///
/// # Errors
/// Each reason of [`SteadyError`].
pub fn steady(blocks: &[SampleBlock], flicker_hz: f64) -> Result<Steady, SteadyError> {
    let base_ns = blocks.iter().map(|b| b.start_ns).min().unwrap_or(0);
    let samples = || {
        blocks.iter().flat_map(|b| {
            b.levels.iter().enumerate().map(move |(i, level)| (1e-9 * b.at(i, base_ns), f64::from(*level)))
        })
    };
    let (mut last_s, mut count) = (0.0f64, 0.0);
    for (s, level) in samples() {
        if !level.is_finite() || !s.is_finite() {
            return Err(SteadyError::NotFinite);
        }
        last_s = last_s.max(s);
        count += 1.0;
    }
    let need_s = 2.0 / flicker_hz;
    if last_s < 0.99 * need_s || count < FEWEST {
        return Err(SteadyError::TooShort { have_ms: 1e3 * last_s, need_ms: 1e3 * need_s });
    }
    let row = |s: f64| {
        let (sin, cos) = (TAU * flicker_hz * s).sin_cos();
        [1.0, cos, sin, cos * cos - sin * sin, 2.0 * sin * cos]
    };
    let (mut square, mut right) = (vec![vec![0.0; TERMS]; TERMS], vec![0.0; TERMS]);
    for (s, level) in samples() {
        let row = row(s);
        for (i, a) in row.iter().enumerate() {
            right[i] += a * level;
            row.iter().enumerate().for_each(|(j, b)| square[i][j] += a * b);
        }
    }
    (1..TERMS).for_each(|i| square[i][i] += RIDGE);
    let too_short = SteadyError::TooShort { have_ms: 1e3 * last_s, need_ms: 1e3 * need_s };
    let x = solve_spd(&square, &right).ok_or(too_short)?;
    let (mut squares, mut halves) = (0.0, [[0.0; 2]; 2]);
    for (s, level) in samples() {
        let off = level - row(s).iter().zip(&x).map(|(a, b)| a * b).sum::<f64>();
        squares += off * off;
        let half = &mut halves[usize::from(s > 0.5 * last_s)];
        *half = [half[0] + off, half[1] + 1.0];
    }
    let variance = squares / (count - TERMS as f64);
    let sigma = (variance * inverse_diagonal(&square).ok_or(too_short)?[0]).sqrt();
    let change = (halves[1][0] / halves[1][1].max(1.0) - halves[0][0] / halves[0][1].max(1.0)).abs();
    if change > MOST_CHANGE * x[0].abs() + 12.0 * sigma {
        return Err(SteadyError::NotSteady { percent: 100.0 * change / x[0].abs() });
    }
    Ok(Steady { level: x[0], sigma, flicker: x[1].hypot(x[2]) })
}
