//! The whole calibration against a truth that it does not know: what the light will be worth.
//!
//! A truth is drawn from the seed. A hand, a tracker and a photodiode are simulated with their noise; the solvers see
//! only what these report, in the order of `dpm calibrate`: wand, projector with sensor, body, light. Their results are
//! compared with the truth over the working volume. The error is that of the light on points of tracked bodies at rest,
//! with the bodies' true poses: what lens, pose and the places of the meshes contribute.

mod bench;
mod photodiode;
mod tracker;
mod truth;

pub use truth::Bias;

use crate::body::TouchFit;
use crate::light::LightModel;
use crate::projector::percentile;
use crate::sensor::Solution;
use dpm_device::rng::Sampler;
use glam::{DAffine3, DMat3, DVec2, DVec3};
use serde::Serialize;
use thiserror::Error;
use truth::Truth;

/// How far the results of one draw are from its truth.
#[derive(Clone, Debug, PartialEq)]
pub struct Draw {
    /// Its seed.
    pub seed: u64,
    /// Errors of the light at points of bodies over the volume, pixels.
    pub errors_px: Vec<f64>,
    /// The same for bodies that move at [`SPEED_M_S`], beyond what their prediction adds, pixels.
    pub moving_px: Vec<f64>,
    /// Their 99th percentile.
    pub p99_px: f64,
    /// Upper bound of that by the solvers' covariance, which knows of no bias of the tracker.
    pub predicted_p99_px: f64,
    /// Error of the latency, microseconds.
    pub latency_error_us: f64,
    /// Largest error of a level over the channel's full light.
    pub level_error: f64,
    /// Error of the tip, metres.
    pub tip_error_m: f64,
}

/// Median and 99th percentile.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MedianAndTail {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
}

/// The largest of all.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Largest {
    /// The largest.
    pub max: f64,
}

/// What a rehearsal shows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Rehearsal {
    /// Truths that were drawn.
    pub draws: usize,
    /// Error of the light over all points of all draws, pixels of 1024 x 768.
    pub error_px: MedianAndTail,
    /// The same on bodies that move at 1 m/s in any direction, if their poses are predicted without error: what
    /// calibration adds to prediction.
    pub moving_px: MedianAndTail,
    /// Error of the latency, microseconds.
    pub latency_error_us: Largest,
    /// Error of a level over the channel's full light.
    pub level_error: Largest,
    /// Share of the draws whose predicted 99th percentile is an upper bound of the true one.
    pub covered: f64,
    /// Median of the predicted 99th percentile over the median of the true one.
    pub predicted_over_true: f64,
    /// Largest 99th percentile of a draw, pixels.
    pub worst_draw_p99_px: f64,
    /// Bias of the tracker, metres.
    pub bias: Bias,
}

/// A draw that a solver refused.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("rehearsal: draw {seed}: {why}")]
pub struct RehearsalError {
    seed: u64,
    why: String,
}

/// Rehearses with a tracker that has white noise only.
///
/// # Errors
/// The first draw that a solver refused, with its reason.
pub fn rehearse(draws: u32, seed: u64) -> Result<Rehearsal, RehearsalError> {
    rehearse_with(draws, seed, Bias::None)
}

/// Rehearses with a biased tracker.
///
/// # Errors
/// The first draw that a solver refused, with its reason.
pub fn rehearse_with(draws: u32, seed: u64, bias: Bias) -> Result<Rehearsal, RehearsalError> {
    let all = (0..u64::from(draws)).map(|i| rehearse_one(seed.wrapping_add(i), bias));
    Ok(Rehearsal::of(&all.collect::<Result<Vec<_>, _>>()?, bias))
}

/// Draws one truth and calibrates.
///
/// # Errors
/// The reason of the solver that refused.
pub fn rehearse_one(seed: u64, bias: Bias) -> Result<Draw, RehearsalError> {
    let refused = |why: String| RehearsalError { seed, why };
    let truth = Truth::draw(seed);
    let found = bench::calibrate(&truth, seed, bias).map_err(refused)?;
    let errors_px = light_errors(&truth, &found.sensor, &found.bodies, seed, 0.0);
    let moving_px = light_errors(&truth, &found.sensor, &found.bodies, seed, SPEED_M_S);
    Ok(Draw {
        seed,
        p99_px: percentile(errors_px.clone(), 0.99),
        errors_px,
        moving_px,
        predicted_p99_px: predicted(&truth, &found.sensor, &found.bodies),
        latency_error_us: 1e-3 * (found.sensor.latency_ns as f64 - truth.latency_ns),
        level_error: level_error(&truth, &found.light),
        tip_error_m: found.sensor.tip.distance(truth.tip),
    })
}

impl Rehearsal {
    /// Sums up draws.
    pub fn of(draws: &[Draw], bias: Bias) -> Self {
        let of = |errors: &dyn Fn(&Draw) -> &[f64]| {
            let all: Vec<f64> = draws.iter().flat_map(|d| errors(d).iter().copied()).collect();
            MedianAndTail { p50: percentile(all.clone(), 0.5), p99: percentile(all, 0.99) }
        };
        let largest = |f: &dyn Fn(&Draw) -> f64| Largest { max: draws.iter().map(f).fold(0.0, f64::max) };
        let median = |f: &dyn Fn(&Draw) -> f64| percentile(draws.iter().map(f).collect(), 0.5);
        let covered = draws.iter().filter(|d| d.predicted_p99_px >= d.p99_px).count();
        Self {
            draws: draws.len(),
            error_px: of(&|d| &d.errors_px),
            moving_px: of(&|d| &d.moving_px),
            latency_error_us: largest(&|d| d.latency_error_us.abs()),
            level_error: largest(&|d| d.level_error),
            covered: covered as f64 / draws.len().max(1) as f64,
            predicted_over_true: median(&|d| d.predicted_p99_px) / median(&|d| d.p99_px).max(1e-12),
            worst_draw_p99_px: largest(&|d| d.p99_px).max,
            bias,
        }
    }
}

/// Speed of the bodies that move, metres a second.
pub const SPEED_M_S: f64 = 1.0;
/// Half the size of a body's mesh, metres.
const MESH_M: f64 = 0.08;
const POINTS: usize = 2000;

/// Distances between the pixels that are lit and those that should be, for points of bodies that lie anywhere in the
/// volume, turned in any way, and move at `speed_m_s` in any direction. A wrong latency lights them where they were or will
/// be.
fn light_errors(truth: &Truth, got: &Solution, bodies: &[TouchFit], seed: u64, speed_m_s: f64) -> Vec<f64> {
    let late_s = 1e-9 * (got.latency_ns as f64 - truth.latency_ns);
    let mut s = Sampler::new(seed, 0xe4404);
    let mut cube = || DVec3::new(s.uniform(), s.uniform(), s.uniform());
    let size = DVec2::new(f64::from(truth.raster.width()), f64::from(truth.raster.height()));
    let mut errors = Vec::with_capacity(POINTS);
    for i in 0..4 * POINTS {
        let world = truth.volume.low + cube() * (truth.volume.high - truth.volume.low);
        let mesh = (2.0 * cube() - 1.0) * MESH_M;
        let turn = DMat3::from_quat(dpm_common::so3::so3_exp((2.0 * cube() - 1.0) * 1.8));
        let motion = (2.0 * cube() - 1.0).normalize_or(DVec3::X) * (speed_m_s * late_s);
        let body = i % bodies.len();
        // The pose of the body that puts this point of its mesh there.
        let in_body = truth.mesh_to_body[body].transform_point3(mesh);
        let pose = DAffine3::from_mat3_translation(turn, world - turn * in_body);
        let lit = pose.transform_point3(bodies[body].mesh_to_body.transform_point3(mesh)) + motion;
        let (Some(should), Some(is)) = (truth.projector.project(world), got.model.project(lit)) else {
            continue;
        };
        if should.cmpge(DVec2::ZERO).all() && should.cmple(size).all() && errors.len() < POINTS {
            errors.push(should.distance(is));
        }
    }
    errors
}

/// The solvers' bound of the 99th percentile of [`light_errors`].
fn predicted(truth: &Truth, got: &Solution, bodies: &[TouchFit]) -> f64 {
    let corners =
        (0..8u32).map(|i| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)) * 2.0 - 1.0);
    let deviations = corners.flat_map(|c| bodies.iter().map(move |b| b.deviation_m(c * MESH_M)));
    let body_m = deviations.fold(0.0, f64::max);
    let middle = 0.5 * (truth.volume.low + truth.volume.high);
    let scale = got.model.derive(middle).map_or(0.0, |d| d.by_point[0].length().max(d.by_point[1].length()));
    // Two of three axes of the deviation are seen; 99 of 100 lengths are below three deviations of an axis.
    got.predicted.p99_px.hypot(3.0 * body_m / 3f64.sqrt() * scale)
}

/// The largest error of a level over codes, channels and pixels.
fn level_error(truth: &Truth, got: &LightModel) -> f64 {
    let mut worst = 0.0f64;
    for i in 0..9u32 {
        let share = DVec2::new(f64::from(i % 3), f64::from(i / 3)) * 0.45 + 0.05;
        let pixel = share * DVec2::new(f64::from(truth.raster.width()), f64::from(truth.raster.height()));
        for channel in 0..3 {
            for step in 0..=50u32 {
                let code = f64::from(step) / 50.0;
                let full = truth.intensity[channel];
                let should = truth.flat(pixel) * full * (1.0 - truth.black) * truth.response(channel, code);
                worst = worst.max((got.level(channel, code, pixel) - should).abs() / full);
            }
        }
    }
    worst
}

#[cfg(test)]
mod latency_tests;
#[cfg(test)]
mod refusal_tests;
#[cfg(test)]
mod tests;
