//! Samples of the sensor into the borders of the planes, by the sensor's own clock.
//!
//! Every change of light falls on a border between two planes, so the squares of the differences of neighbouring samples
//! repeat with the length of a plane. Their phase is measured in windows of a twentieth of a second; its slope over the
//! windows is the difference of the two clocks.

use super::decode::DecodeError;
use dpm_device::sensor::wire::{BlockHead, PERIOD_ONE};
use std::f64::consts::TAU;

/// Consecutive samples of the sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct SampleBlock {
    /// Instant of the middle of the first sample by the sensor's clock.
    pub start_ns: i64,
    /// Distance of two samples by the sensor's clock.
    pub interval_ns: f64,
    /// Levels, in any unit that is linear in light.
    pub levels: Vec<f32>,
}

impl SampleBlock {
    /// From a block of the serial protocol. `ticks_per_second` is that of the sensor's HELLO; levels of different gain
    /// settings are brought to one unit by `gain`. `None` for a clock that cannot be.
    pub fn from_wire(head: &BlockHead, levels: &[u16], ticks_per_second: u32, gain: f64) -> Option<Self> {
        let per_second = i128::from(ticks_per_second);
        let start_ns =
            i64::try_from((i128::from(head.first) * 1_000_000_000).checked_div(per_second)?).ok()?;
        let interval_ns = f64::from(head.period) / f64::from(PERIOD_ONE) * 1e9 / f64::from(ticks_per_second);
        let scale = 1.0 / gain;
        let sound = scale.is_finite() && scale > 0.0 && interval_ns > 0.0;
        let levels = levels.iter().map(|l| (f64::from(*l) * scale) as f32).collect();
        sound.then_some(Self { start_ns, interval_ns, levels })
    }

    /// The instant of a sample by the sensor's clock, nanoseconds after `base_ns`.
    pub fn at(&self, index: usize, base_ns: i64) -> f64 {
        self.start_ns.saturating_sub(base_ns) as f64 + index as f64 * self.interval_ns
    }
}

/// Where the planes lie by the sensor's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lock {
    /// The instant from which the others count.
    pub base_ns: i64,
    /// A border between two planes, after `base_ns`.
    pub border_ns: f64,
    /// Length of a plane by the sensor's clock.
    pub plane_ns: f64,
    /// How much faster the sensor's clock is than the host's, parts per million.
    pub drift_ppm: f64,
    /// Share of the changes of light that fall on borders: 1 is perfect.
    pub quality: f64,
}

const WINDOW_NS: f64 = 5e7;
/// Clocks differ by less than this, parts per million.
const MOST_DRIFT_PPM: f64 = 150.0;
/// Quality below which there is no lock.
const LEAST_QUALITY: f64 = 0.5;

/// Sums of a window: changes as a vector at their phase, their total, and the mean instant.
#[derive(Clone, Copy, Default)]
struct LockWindow {
    cos: f64,
    sin: f64,
    total: f64,
    moment_ns: f64,
}

/// Finds the borders. `plane_ns` is the length of a plane by the host's clock.
pub(super) fn lock(blocks: &[SampleBlock], plane_ns: f64) -> Result<Lock, DecodeError> {
    let base_ns = blocks.iter().map(|b| b.start_ns).min().ok_or(DecodeError::NoSamples)?;
    let windows = windows(blocks, base_ns, plane_ns);
    let total: f64 = windows.iter().map(|w| w.total).sum();
    if total <= 0.0 || !total.is_finite() {
        return Err(DecodeError::NoLight);
    }
    // Sum of all windows when the sensor's clock is fast by `drift`.
    let sum = |drift: f64| {
        let (mut re, mut im) = (0.0, 0.0);
        for w in &windows {
            let (s, c) = (TAU * drift * w.moment_ns / plane_ns).sin_cos();
            re += w.cos * c + w.sin * s;
            im += w.sin * c - w.cos * s;
        }
        (re, im)
    };
    let strength = |drift: f64| {
        let (re, im) = sum(drift);
        re.hypot(im)
    };
    let length = windows.iter().map(|w| w.moment_ns).fold(0.0, f64::max).max(WINDOW_NS);
    // An error of a fifth of a turn over the whole recording is seen as a weaker sum.
    let mut step = 0.2 * plane_ns / length;
    let count = (MOST_DRIFT_PPM * 1e-6 / step).ceil() as i64;
    let best = |centre: f64, step: f64, count: i64| {
        let all = (-count..=count).map(|i| centre + i as f64 * step);
        all.max_by(|a, b| strength(*a).total_cmp(&strength(*b))).unwrap_or(centre)
    };
    let mut drift = best(0.0, step, count.min(20_000));
    for _ in 0..12 {
        step /= 3.0;
        drift = best(drift, step, 4);
    }
    let (re, im) = sum(drift);
    let quality = re.hypot(im) / total;
    if quality < LEAST_QUALITY {
        return Err(DecodeError::NoLock { quality });
    }
    // Phase p: borders at (k + p) planes, by a clock that has been straightened; a fast clock stretches the plane.
    let phase = im.atan2(re) / TAU;
    let stretched = plane_ns * (1.0 + drift / (1.0 - drift));
    Ok(Lock {
        base_ns,
        border_ns: phase * stretched,
        plane_ns: stretched,
        drift_ppm: 1e6 * drift / (1.0 - drift),
        quality,
    })
}

fn windows(blocks: &[SampleBlock], base_ns: i64, plane_ns: f64) -> Vec<LockWindow> {
    let mut windows: Vec<LockWindow> = Vec::new();
    let mut current = (-1.0, LockWindow::default());
    let close = |all: &mut Vec<LockWindow>, mut w: LockWindow| {
        if w.total > 0.0 {
            w.moment_ns /= w.total;
            all.push(w);
        }
    };
    for block in blocks {
        for (i, pair) in block.levels.windows(2).enumerate() {
            let change = f64::from(pair[1] - pair[0]).powi(2);
            let at = block.at(i, base_ns) + 0.5 * block.interval_ns;
            let number = (at / WINDOW_NS).floor();
            if number != current.0 {
                close(&mut windows, current.1);
                current = (number, LockWindow::default());
            }
            if !change.is_finite() {
                continue;
            }
            let (sin, cos) = (TAU * (at / plane_ns).fract()).sin_cos();
            let w = &mut current.1;
            w.cos += change * cos;
            w.sin += change * sin;
            w.total += change;
            w.moment_ns += change * at;
        }
    }
    close(&mut windows, current.1);
    windows
}
