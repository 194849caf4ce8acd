//! The simulated operator: what `dpm calibrate` does in its order, from reports of the simulated devices.

use super::photodiode::{normal, record, UNIT_DISTANCE_M};
use super::tracker::Tracker;
use super::truth::{Bias, Hand, Truth};
use crate::body::{self, tip_in_body, Touch, TouchFit};
use crate::light::{self, flat_field, steady, LightModel, Next, Steady};
use crate::pivot::Pivot;
use crate::projector::{PlaceHint, Priors};
use crate::sensor::{decode, solve, Code, SampleBlock, Settings, Solution, Timing};
use crate::trajectory::{TimedPose, Trajectory};
use dpm_common::so3::so3_exp;
use dpm_device::rng::Sampler;
use glam::{DAffine3, DQuat, DVec2, DVec3};
use std::f64::consts::TAU;

/// What was calibrated.
pub(super) struct BenchResult {
    pub sensor: Solution,
    pub bodies: Vec<TouchFit>,
    pub light: LightModel,
}

/// The projector's pace, known from its own clock: 947 frames a second.
pub(super) const TIMING: Timing = Timing { frame_zero_ns: 1_000_000_123, frame_ns: 1_055_966.2 };
/// Seconds of turning about the tip, and of the sweep.
const PIVOT_S: f64 = 20.0;
const SWEEP_S: [f64; 2] = [40.0, 70.0];
/// Seconds during which the tip stays on a point.
const TOUCH_S: f64 = 0.5;
/// Seconds of a reading of light, at 100 kS/s.
const READING_S: f64 = 0.1;

pub(super) fn calibrate(truth: &Truth, seed: u64, bias: Bias) -> Result<BenchResult, String> {
    let middle = 0.5 * (truth.volume.low + truth.volume.high);
    let tracker = |stream: u64| Tracker {
        seed: seed.wrapping_mul(1000).wrapping_add(stream),
        latency_ns: truth.latency_ns,
        bias,
    };
    let mut pivot = Pivot::default();
    let turning = tracker(0).wand(&Hand::pivoting(seed), truth.tip, middle, 0.0, PIVOT_S);
    turning.into_iter().for_each(|p| pivot.add(p));
    let tip = pivot.solve().map_err(|e| e.to_string())?;

    let code = Code::new(truth.raster).map_err(|e| e.to_string())?;
    let hand = Hand::sweeping(&truth.volume, seed);
    let poses = tracker(1).wand(&hand, truth.tip, middle, SWEEP_S[0] - 1.0, SWEEP_S[1] + 1.0);
    let blocks = record(truth, &code, &TIMING, &hand, SWEEP_S, seed);
    // Echo tells the difference of the clocks to some milliseconds; even a second would do.
    let offset_ns = truth.sensor_offset_ns.saturating_add(250_000_000);
    let decoded = decode(&code, &TIMING, &blocks, offset_ns, &|slot| slot).map_err(|e| e.to_string())?;
    let settings = Settings {
        timing: TIMING,
        tip: tip.tip,
        tip_sigma_m: crate::pivot::trace(&tip.covariance).sqrt(),
        aperture_m: 2.5e-3,
        priors: Priors::many_points(truth.raster),
        known: PlaceHint { distance_m: None, up: Some(DVec3::Y) },
        volume: truth.volume,
        seed,
    };
    let sensor = solve(&code, &decoded, &Trajectory::new(&poses), &settings).map_err(|e| e.to_string())?;

    let bodies = (0..truth.mesh_to_body.len()).map(|body| touch(truth, body, sensor.tip, &tracker, seed));
    let bodies = bodies.collect::<Result<_, _>>()?;
    let light = measure_light(truth, &sensor, seed)?;
    Ok(BenchResult { sensor, bodies, light })
}

/// Touches the corners of a body's mesh, each with the wand at another angle.
fn touch(
    truth: &Truth,
    body: usize,
    tip: DVec3,
    tracker: &dyn Fn(u64) -> Tracker,
    seed: u64,
) -> Result<TouchFit, String> {
    let mut s = Sampler::new(seed, 0x70c4 + body as u64);
    let mut turn = |size: f64| {
        let v = DVec3::new(s.uniform(), s.uniform(), s.uniform()) * 2.0 - 1.0;
        so3_exp(v * size)
    };
    let place = DAffine3::from_rotation_translation(turn(1.5), DVec3::new(0.05, -0.05, 0.02));
    let (place_of_body, turn_of_body) = (place.translation, DQuat::from_mat3(&place.matrix3));
    let mut session = body::TouchSession::default();
    for corner in 0..8u32 {
        let half =
            DVec3::new(f64::from(corner & 1), f64::from(corner >> 1 & 1), f64::from(corner >> 2)) - 0.5;
        let mesh = half * 2.0 * super::MESH_M;
        let point = place.transform_point3(truth.mesh_to_body[body].transform_point3(mesh));
        let rotation = turn(1.0);
        let (of_wand, of_body) = (tracker(10 + 2 * body as u64), tracker(11 + 2 * body as u64));
        let poses: Vec<(TimedPose, TimedPose)> = (0..(TOUCH_S * 240.0) as u64)
            .map(|i| {
                let (number, seconds) =
                    (u64::from(corner) * 1000 + i, 100.0 + f64::from(corner) + i as f64 / 240.0);
                let wand = of_wand.report(number, seconds, point - rotation * truth.tip, rotation);
                (wand, of_body.report(number, seconds, place_of_body, turn_of_body))
            })
            .collect();
        let contact = tip_in_body(tip, &poses).map_err(|e| e.to_string())?;
        session.add(Touch { mesh, body: contact.body });
    }
    session.solve().map_err(|e| e.to_string())
}

/// Reads every code that the session asks for, with the wand on a stand in the middle of the picture.
fn measure_light(truth: &Truth, sensor: &Solution, seed: u64) -> Result<LightModel, String> {
    let mut s = Sampler::new(seed, 0x1194);
    let pixel = DVec2::new(530.0, 370.0);
    let full = truth.flat(pixel) * (UNIT_DISTANCE_M / 1.1f64).powi(2);
    let mut session = light::ResponseSession::new(3);
    while let Some(next) = session.next_reading() {
        let of_codes = match next {
            Next::Ambient => 0.0,
            Next::Black => truth.black,
            Next::White => 1.0,
            Next::Code { channel, code } => {
                truth.black + (1.0 - truth.black) * truth.intensity[channel] * truth.response(channel, code)
            }
        };
        session.add(next, reading(truth, full * of_codes, &mut s)?).map_err(|e| e.to_string())?;
    }
    let channels = session.solve().map_err(|e| e.to_string())?;
    let flat = flat_field(truth.raster, &sensor.brightness, None).map_err(|e| e.to_string())?;
    Ok(LightModel { channels, flat })
}

/// A reading of a steady light beside the flicker of lamps.
fn reading(truth: &Truth, level: f64, s: &mut Sampler) -> Result<Steady, String> {
    let phase = TAU * s.uniform();
    let sample = |i: usize| {
        let flicker = 1.0 + truth.ambient[1] * (TAU * 100.0 * 1e-5 * i as f64 + phase).sin();
        level + truth.ambient[0] * flicker + 0.01 * normal(s)
    };
    let levels = (0..(READING_S * 1e5) as usize).map(sample).map(|v| v as f32).collect();
    let block = SampleBlock { start_ns: 0, interval_ns: 1e4, levels };
    steady(&[block], 100.0).map_err(|e| e.to_string())
}
