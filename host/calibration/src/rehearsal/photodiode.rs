//! The light sensor of the rehearsal: what a round aperture at the wand's tip collects from the projector, sampled.
//!
//! The aperture is cut into small parts, and for each of them the code is asked whether the pixel that lights it is on.
//! The decoder knows nothing of this: it fits discs over stripes.

use super::truth::{Hand, Truth};
use crate::sensor::{Code, SampleBlock, Timing, PLANES};
use dpm_device::rng::Sampler;
use glam::{DVec2, DVec3};
use std::f64::consts::TAU;

/// Diameter of the aperture, metres.
const APERTURE_M: f64 = 3e-3;
/// Parts of the aperture.
const PARTS: u32 = 96;
/// Distance of two samples by the sensor's clock, nanoseconds.
const INTERVAL_NS: f64 = 10_000.0;
/// Samples of a block.
const BLOCK: usize = 1000;
/// Share of the previous sample in one: the electronics follow with a time constant of 4 microseconds.
const LAG: f64 = 0.08;
/// Noise of a sample over full light in the middle of the volume.
const NOISE: f64 = 0.01;

/// Distance at which full light reads 1, metres.
pub(super) const UNIT_DISTANCE_M: f64 = 1.2;

/// Records a sweep: the sensor sees frames from `from_s` to `to_s` by the host's clock.
pub(super) fn record(
    truth: &Truth,
    code: &Code,
    timing: &Timing,
    hand: &Hand,
    [from_s, to_s]: [f64; 2],
    seed: u64,
) -> Vec<SampleBlock> {
    let middle = 0.5 * (truth.volume.low + truth.volume.high);
    let mut sampler = Sampler::new(seed, 0x9107);
    let covered = covered(from_s, to_s, &mut sampler);
    let plane_ns = timing.frame_ns / PLANES as f64;
    let first = ((1e9 * from_s - timing.frame_zero_ns as f64) / timing.frame_ns).ceil().max(0.0) as u64;
    let last = ((1e9 * to_s - timing.frame_zero_ns as f64) / timing.frame_ns) as u64;
    let mut light = Vec::with_capacity(((last - first) as usize) * PLANES);
    for frame in first..last {
        let start_ns = timing.frame_zero_ns as f64 + frame as f64 * timing.frame_ns;
        let levels = frame_levels(truth, code, hand, middle, frame, start_ns, plane_ns, &mut sampler);
        light.extend(levels);
    }
    let start_ns = timing.frame_zero_ns as f64 + first as f64 * timing.frame_ns;
    sample(truth, &light, start_ns, plane_ns, &covered, &mut sampler)
}

/// Stretches of time, seconds, in which a hand or a cable hides the sensor: a fifth of all.
fn covered(from_s: f64, to_s: f64, s: &mut Sampler) -> Vec<[f64; 2]> {
    let (mut all, mut at) = (Vec::new(), from_s);
    while at < to_s {
        let hidden = 0.05 + 0.45 * s.uniform();
        let open = 4.0 * (0.05 + 0.45 * s.uniform());
        all.push([at + open, at + open + hidden]);
        at += open + hidden;
    }
    all
}

/// Light on the aperture during each plane of a frame.
fn frame_levels(
    truth: &Truth,
    code: &Code,
    hand: &Hand,
    middle: DVec3,
    frame: u64,
    start_ns: f64,
    plane_ns: f64,
    sampler: &mut Sampler,
) -> [f64; PLANES] {
    let place = |plane: f64| middle + hand.at(1e-9 * (start_ns + plane * plane_ns)).0;
    let spin = TAU * sampler.uniform();
    // The tip moves by half a millimetre in a frame: the projection is straight over it.
    let ends = [place(0.5), place(PLANES as f64 - 0.5)].map(|p| truth.projector.derive(p).map(|d| (p, d)));
    let [Some((p0, d0)), Some((p1, d1))] = ends else { return [0.0; PLANES] };
    // The aperture faces the projector.
    let away = (truth.projector.position() - p0).normalize_or(DVec3::Z);
    let side = away.any_orthonormal_vector();
    let up = away.cross(side);
    let axis = |v: DVec3| DVec2::new(d0.by_point[0].dot(v), d0.by_point[1].dot(v)) * (0.5 * APERTURE_M);
    let (side, up) = (axis(side), axis(up));
    let parts: Vec<DVec2> = (0..PARTS)
        .map(|i| {
            // Sunflower seeds: equal areas.
            let radius = ((f64::from(i) + 0.5) / f64::from(PARTS)).sqrt();
            let (sin, cos) = (2.399_963_229_728_653 * f64::from(i) + spin).sin_cos();
            side * (radius * cos) + up * (radius * sin)
        })
        .collect();
    std::array::from_fn(|plane| {
        let s = plane as f64 / (PLANES as f64 - 1.0);
        let pixel = d0.pixel.lerp(d1.pixel, s);
        let distance = truth.projector.position().distance(p0.lerp(p1, s));
        let full = truth.flat(pixel) * (UNIT_DISTANCE_M / distance).powi(2);
        let lit = |q: &&DVec2| {
            let at = pixel + **q;
            at.min_element() >= 0.0 && code.lit(frame, plane, at.x as u32, at.y as u32)
        };
        let share = parts.iter().filter(lit).count() as f64 / f64::from(PARTS);
        full * (truth.black + (1.0 - truth.black) * share)
    })
}

/// Light by plane into samples by the sensor's clock.
fn sample(
    truth: &Truth,
    light: &[f64],
    start_ns: f64,
    plane_ns: f64,
    covered: &[[f64; 2]],
    sampler: &mut Sampler,
) -> Vec<SampleBlock> {
    let count = (light.len() as f64 * plane_ns * (1.0 + truth.sensor_drift) / INTERVAL_NS) as usize;
    let to_sensor = |host_ns: f64| host_ns * (1.0 + truth.sensor_drift) + truth.sensor_offset_ns as f64;
    let first_ns = to_sensor(start_ns).ceil();
    let duration = 0.5 * INTERVAL_NS / (1.0 + truth.sensor_drift);
    let mut blocks = Vec::new();
    let (mut previous, mut gone) = (0.0, 0);
    for begin in (0..count).step_by(BLOCK) {
        let levels = (begin..(begin + BLOCK).min(count)).map(|i| {
            let sensor_ns = first_ns + i as f64 * INTERVAL_NS;
            let host_ns = (sensor_ns - truth.sensor_offset_ns as f64) / (1.0 + truth.sensor_drift);
            let s = 1e-9 * host_ns;
            while covered.get(gone).is_some_and(|c| c[1] < s) {
                gone += 1;
            }
            let hidden = covered.get(gone).is_some_and(|c| c[0] <= s);
            let mean = if hidden { 0.0 } else { mean_light(light, plane_ns, host_ns - start_ns, duration) };
            let flicker = 1.0 + truth.ambient[1] * (TAU * 100.0 * s).sin();
            let level = mean + truth.ambient[0] * flicker;
            previous = LAG * previous + (1.0 - LAG) * level;
            (previous + NOISE * normal(sampler)) as f32
        });
        let levels = levels.collect();
        let start = first_ns + begin as f64 * INTERVAL_NS;
        blocks.push(SampleBlock { start_ns: start as i64, interval_ns: INTERVAL_NS, levels });
    }
    blocks
}

/// Mean light within `duration` to either side of an instant.
fn mean_light(light: &[f64], plane_ns: f64, at_ns: f64, duration: f64) -> f64 {
    let (low, high) = ((at_ns - duration) / plane_ns, (at_ns + duration) / plane_ns);
    let level = |p: f64| if p < 0.0 { 0.0 } else { light.get(p as usize).copied().unwrap_or(0.0) };
    let border = high.floor();
    if border <= low {
        return level(low);
    }
    let share = (border - low) / (high - low);
    share * level(low) + (1.0 - share) * level(border)
}

/// A standard normal number.
pub(super) fn normal(s: &mut Sampler) -> f64 {
    let radius = (-2.0 * (1.0 - s.uniform()).ln()).sqrt();
    radius * (TAU * s.uniform()).cos()
}
