//! Samples into frames: the number of each frame, and the level of each of its planes.

use super::code::{Code, IDENTITY_PERIOD, PLANES};
use super::lock::{lock, Lock, SampleBlock};
use super::Timing;
use thiserror::Error;

/// A frame as the sensor saw it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorFrame {
    /// Its number.
    pub number: u64,
    /// Mean level of each plane, in the sensor's unit.
    pub levels: [f32; PLANES],
    /// Level of darkness in the first plane, and in the middle of the last two.
    pub off: [f32; 2],
    /// Level of full light in the second plane, and in the middle of the last two.
    pub on: [f32; 2],
}

impl SensorFrame {
    /// The reference levels (off, on) during a plane.
    pub fn references(&self, plane: usize) -> (f64, f64) {
        let last = PLANES as f64 - 1.5;
        let mix = |v: [f32; 2], first: f64| {
            let s = (plane as f64 - first) / (last - first);
            f64::from(v[0]) + s * f64::from(v[1] - v[0])
        };
        (mix(self.off, 0.0), mix(self.on, 1.0))
    }

    /// Full light less darkness in the middle of the frame.
    pub fn contrast(&self) -> f64 {
        let (off, on) = self.references(PLANES / 2);
        on - off
    }
}

/// What the samples say.
#[derive(Clone, Debug)]
pub struct Decoding {
    /// Frames that are whole and lit, in order.
    pub frames: Vec<SensorFrame>,
    /// Frames during which the sensor was covered, outside the picture, or moved out of it.
    pub dropped: usize,
    /// How the planes were found.
    pub lock: Lock,
    /// The mean instant of the samples of a plane, in planes after its start.
    pub centre: f64,
    /// Frames of a hundred whose bit of identity agrees with their number.
    pub identity_percent: f64,
    /// Standard deviation of a plane's level over the contrast.
    pub noise: f64,
}

/// Why samples are refused.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum DecodeError {
    /// Nothing was sampled.
    #[error("sensor: no samples; look at its cable and power")]
    NoSamples,
    /// Nothing ever changed.
    #[error("sensor: the level never changes: it sees no light, or is saturated; look at the sensor and at the projector")]
    NoLight,
    /// A level is NaN or infinite.
    #[error("sensor: block {0} has levels that are no numbers")]
    NotFinite(usize),
    /// Too few samples a plane.
    #[error("sensor: {per_plane:.1} samples a plane are too few, 3 are needed: sample faster, or show longer planes")]
    TooSlow {
        /// Samples a plane.
        per_plane: f64,
    },
    /// The changes do not follow the planes.
    #[error("sensor: its samples do not follow the planes (quality {quality:.2}): is the sensor in the picture, and is the frame rate right?")]
    NoLock {
        /// Share of the changes that repeat with the planes.
        quality: f64,
    },
    /// No place in the planes looks like the beginning of frames.
    #[error("sensor: no beginning of frames is seen ({share:.0} % of them look right): is the code shown, is the sensor in the picture, is it saturated, are all planes equally bright?")]
    NoFrames {
        /// Share of frames whose references agree, percent.
        share: f64,
    },
    /// The identity of the frames does not agree with any number.
    #[error("sensor: the frames' identity does not tell their number ({percent:.0} % agree); move the sensor inside the picture for three seconds")]
    NoIdentity {
        /// Agreement at the best number, percent.
        percent: f64,
    },
}

/// Mean levels of consecutive planes; NaN where there is no sample.
struct Planes {
    first: i64,
    levels: Vec<f32>,
    centre: f64,
}

/// The clocks of host and sensor are mapped to each other within this time, nanoseconds.
const CLOCKS_NS: f64 = 1e10;
/// Longest recording, planes: an hour.
const MOST_PLANES: i64 = 100_000_000;
/// A frame is used when its contrast reaches this share of the usual one.
const LEAST_CONTRAST: f64 = 0.15;
/// References at both ends of a frame agree within this share of the contrast.
const AGREE: f64 = 0.2;

/// Decodes a recording. `sensor_minus_host_ns` is the rough difference of the two clocks, known to ten seconds. `shown`
/// tells which frame's picture each slot showed: the slot's own, unless that frame was late or never came.
///
/// # Errors
/// Each reason of [`DecodeError`].
pub fn decode(
    code: &Code,
    timing: &Timing,
    blocks: &[SampleBlock],
    sensor_minus_host_ns: i64,
    shown: &dyn Fn(u64) -> u64,
) -> Result<Decoding, DecodeError> {
    let PlaneTimes { lock, planes, start } = seen(timing.frame_ns / PLANES as f64, blocks)?;
    let whole = frames_from(&planes, start);
    let numbered = number((code, shown), timing, &lock, &planes, start, whole, sensor_minus_host_ns)?;
    Ok(Decoding { lock, centre: planes.centre, ..numbered })
}

/// Where the planes and the frames are in samples.
struct PlaneTimes {
    lock: Lock,
    planes: Planes,
    start: usize,
}

fn seen(plane_ns: f64, blocks: &[SampleBlock]) -> Result<PlaneTimes, DecodeError> {
    if let Some(bad) = blocks.iter().position(|b| !b.levels.iter().all(|l| l.is_finite())) {
        return Err(DecodeError::NotFinite(bad));
    }
    let slowest = blocks.iter().map(|b| b.interval_ns).fold(0.0, f64::max);
    let per_plane = plane_ns / slowest;
    if blocks.iter().all(|b| b.levels.is_empty()) {
        return Err(DecodeError::NoSamples);
    }
    if !(slowest.is_finite() && per_plane >= 3.0)
        || blocks.iter().any(|b| b.interval_ns.is_nan() || b.interval_ns <= 0.0)
    {
        return Err(DecodeError::TooSlow { per_plane });
    }
    let lock = lock(blocks, plane_ns)?;
    let planes = average(blocks, &lock, slowest)?;
    let start = find_start(&planes)?;
    Ok(PlaneTimes { lock, planes, start })
}

/// The frames in samples; each with its place among them instead of its number.
///
/// # Errors
/// As [`decode`], but for the identity.
pub(super) fn frames_seen(plane_ns: f64, blocks: &[SampleBlock]) -> Result<Vec<SensorFrame>, DecodeError> {
    let PlaneTimes { planes, start, .. } = seen(plane_ns, blocks)?;
    Ok(frames_from(&planes, start))
}

/// Averages the samples inside each plane, away from its borders.
fn average(blocks: &[SampleBlock], lock: &Lock, interval_ns: f64) -> Result<Planes, DecodeError> {
    // A sample whose own duration reaches over a border mixes two planes; the rise of the electronics comes after it.
    let guard = 0.5 * interval_ns / lock.plane_ns;
    let (low, high) = (guard + 0.06, 1.0 - guard + 0.02);
    let position = |b: &SampleBlock, i: usize| (b.at(i, lock.base_ns) - lock.border_ns) / lock.plane_ns;
    let filled = || blocks.iter().filter(|b| !b.levels.is_empty());
    let first = filled().map(|b| position(b, 0)).fold(f64::INFINITY, f64::min).floor() as i64;
    let last = filled().map(|b| position(b, b.levels.len() - 1)).fold(0.0, f64::max) as i64;
    let count = last.saturating_sub(first).saturating_add(1);
    if !(1..=MOST_PLANES).contains(&count) {
        return Err(DecodeError::NoLock { quality: 0.0 });
    }
    let mut sums = vec![(0.0f32, 0u16); count as usize];
    let (mut phases, mut used) = (0.0, 0.0);
    for block in blocks {
        for (i, level) in block.levels.iter().enumerate() {
            let at = position(block, i);
            let plane = at.floor();
            let phase = at - plane;
            if (low..high).contains(&phase) {
                let slot = &mut sums[(plane as i64 - first) as usize];
                *slot = (slot.0 + level, slot.1.saturating_add(1));
                phases += phase;
                used += 1.0;
            }
        }
    }
    let level = |(sum, n): (f32, u16)| if n > 0 { sum / f32::from(n) } else { f32::NAN };
    Ok(Planes { first, levels: sums.into_iter().map(level).collect(), centre: phases / f64::max(used, 1.0) })
}

/// The levels of a frame that begins at a plane: `None` where planes are missing, or its references disagree.
fn frame_at(planes: &Planes, begin: usize, least_contrast: f64) -> Option<SensorFrame> {
    let levels: [f32; PLANES] = planes.levels.get(begin..begin + PLANES)?.try_into().ok()?;
    let (a, b) = (levels[PLANES - 2], levels[PLANES - 1]);
    let frame = SensorFrame { number: 0, levels, off: [levels[0], a.min(b)], on: [levels[1], a.max(b)] };
    let contrast = frame.contrast();
    let near = |v: [f32; 2]| f64::from((v[1] - v[0]).abs()) <= AGREE * contrast;
    let inside = (2..PLANES - 2).all(|p| {
        let (off, on) = frame.references(p);
        let level = f64::from(levels[p]);
        (off - AGREE * contrast..=on + AGREE * contrast).contains(&level)
    });
    // NaN fails each of these.
    (contrast > least_contrast && near(frame.off) && near(frame.on) && inside).then_some(frame)
}

/// Where frames begin, among the planes of the first one.
fn find_start(planes: &Planes) -> Result<usize, DecodeError> {
    let least = LEAST_CONTRAST * usual_contrast(planes);
    let frames = planes.levels.len() / PLANES;
    let step = (frames / 2000).max(1);
    let tried = (0..frames).step_by(step).count().max(1);
    let right = |start: usize| {
        let all = (0..frames).step_by(step);
        all.filter(|f| frame_at(planes, start + f * PLANES, least).is_some()).count()
    };
    let mut scores: Vec<(usize, usize)> = (0..PLANES).map(|s| (right(s), s)).collect();
    scores.sort_unstable_by(|a, b| b.cmp(a));
    let (best, second) = (scores[0], scores[1]);
    if best.0 < 20 || 10 * best.0 < tried || 2 * best.0 < 3 * second.0 {
        return Err(DecodeError::NoFrames { share: 100.0 * best.0 as f64 / tried as f64 });
    }
    Ok(best.1)
}

/// The median over stretches of the recording of their range.
fn usual_contrast(planes: &Planes) -> f64 {
    let mut ranges: Vec<f64> = planes
        .levels
        .chunks(2 * PLANES)
        .map(|c| {
            let fold =
                |f: fn(f32, f32) -> f32, start| c.iter().copied().filter(|v| !v.is_nan()).fold(start, f);
            f64::from(fold(f32::max, f32::NEG_INFINITY) - fold(f32::min, f32::INFINITY))
        })
        .filter(|r| r.is_finite())
        .collect();
    ranges.sort_by(f64::total_cmp);
    ranges.get(ranges.len() / 2).copied().unwrap_or(0.0)
}

/// All frames from `start`; each with its place in the recording instead of its number.
fn frames_from(planes: &Planes, start: usize) -> Vec<SensorFrame> {
    let least = LEAST_CONTRAST * usual_contrast(planes);
    let count = planes.levels.len().saturating_sub(start) / PLANES;
    let at =
        |i: usize| frame_at(planes, start + i * PLANES, least).map(|f| SensorFrame { number: i as u64, ..f });
    (0..count).filter_map(at).collect()
}

/// Numbers frames by their identity: of the numbers that the clocks allow, the one whose identities are those seen.
fn number(
    (code, shown): (&Code, &dyn Fn(u64) -> u64),
    timing: &Timing,
    lock: &Lock,
    planes: &Planes,
    start: usize,
    mut frames: Vec<SensorFrame>,
    sensor_minus_host_ns: i64,
) -> Result<Decoding, DecodeError> {
    let bit = |f: &SensorFrame| f.levels[PLANES - 2] > f.levels[PLANES - 1];
    let told: Vec<(usize, bool)> = frames.iter().take(1000).map(|f| (f.number as usize, bit(f))).collect();
    let n = told.len();
    let Some(span) = told.last().map(|(i, _)| i + 1) else {
        return Err(DecodeError::NoIdentity { percent: 0.0 });
    };
    let sensor_ns =
        lock.base_ns as f64 + lock.border_ns + (planes.first as f64 + start as f64) * lock.plane_ns;
    let host_ns = sensor_ns - sensor_minus_host_ns as f64 - timing.frame_zero_ns as f64;
    let reach = ((CLOCKS_NS / timing.frame_ns) as u64).min(IDENTITY_PERIOD / 2);
    let low = (host_ns / timing.frame_ns - reach as f64).max(0.0) as u64;
    let tried = 2 * reach as usize + 1;
    let identities: Vec<bool> =
        (low..low + (tried + span) as u64).map(|slot| code.identity(shown(slot))).collect();
    let (mut best, mut second) = ((0, 0), 0);
    for shift in 0..tried {
        let count = told.iter().filter(|(i, b)| identities.get(shift + i) == Some(b)).count();
        if count > best.0 {
            (second, best) = (best.0, (count, shift));
        } else {
            second = second.max(count);
        }
    }
    let percent = 100.0 * best.0 as f64 / n as f64;
    if n < 60 || percent < 90.0 || 100 * second > 85 * n {
        return Err(DecodeError::NoIdentity { percent });
    }
    let first = low + best.1 as u64;
    frames.iter_mut().for_each(|f| f.number += first);
    let right = frames.iter().filter(|f| code.identity(shown(f.number)) == bit(f)).count();
    let whole = planes.levels.len().saturating_sub(start) / PLANES;
    let noise = noise(&frames);
    Ok(Decoding {
        dropped: whole - frames.len(),
        identity_percent: 100.0 * right as f64 / frames.len().max(1) as f64,
        frames,
        lock: *lock,
        centre: 0.5,
        noise,
    })
}

/// Deviation of a plane over the contrast, from the two references of darkness in each frame.
fn noise(frames: &[SensorFrame]) -> f64 {
    let square = |f: &SensorFrame| (f64::from(f.off[1] - f.off[0]) / f.contrast()).powi(2);
    (0.5 * frames.iter().map(square).sum::<f64>() / frames.len().max(1) as f64).sqrt()
}
