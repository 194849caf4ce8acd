//! By how much time the light of a second is behind the body, or ahead of it.
//!
//! The place of one frame may be wrong by what the filter takes noise for. Over a second noise and turns cancel, and what
//! is left is a time: with `e` the way from the body to its light and `v` the body's velocity, the least squares of
//! `e + lag v` have their least at `lag = -sum(e v) / sum(v v)`. Light that is shown where the body was lags by the age
//! of its poses; light that aims at the wrong instant of its exposure lags or leads by as much.

use crate::plan::{Setup, TrackerSetup};
use dpm_device::planes::PlaneSchedule;
use hil_mock::motion::Motion;

/// Ticks that a judgement looks back: a second and the tick that is not over.
const TICKS: usize = 11;
/// How far the tracker's clock is known, seconds: a datagram takes as long one way as the other; an adapter or a server that
/// polls holds back what it sends, and not what it gets.
const CLOCK_S: f64 = 0.0015;
const CLOCK_HELD_S: f64 = 0.003;
/// Share of the age of poses by which a prediction may err: the filter follows a velocity late.
const SHARE: f64 = 0.08;
/// A body that turns is lost until a sample of it arrives: with two turns in 0.8 s, poses of the age `a` are off by `a^2 /
/// 0.4 s` on average, and a second may hold one turn more.
const TURNS_PER_S: f64 = 5.0;
/// A body that is slower than this on average (rms, m/s) tells nothing about time.
const SLOW_M_S: f64 = 0.05;

/// Sums over the frames of one tick.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    frames: u64,
    /// Of `e v`, m^2/s.
    off: f64,
    /// Of `v v`, m^2/s^2.
    speed: f64,
    /// Of the ages of poses at the centre of the light, seconds, and of their squares.
    age: f64,
    age_squared: f64,
}

/// Collects the places of light, tick by tick, and judges every second.
#[derive(Clone, Debug)]
pub(crate) struct Lag {
    /// How far the tracker's clock is known, seconds.
    clock_s: f64,
    /// The centre of a frame's light, as a share of its exposure.
    light_centre: f64,
    /// Half a second of frames, as elsewhere: fewer do not tell how it usually is.
    few_frames: u64,
    ticks: [Sums; TICKS],
    now: usize,
    /// The greatest lag of a second, as a share of what is allowed, in thousandths.
    pub(crate) worst_milli: i64,
}

/// The centre of the light of a frame whose planes last equally long, each as bright as its bit, as a share of the exposure.
fn light_centre(schedule: &PlaneSchedule) -> f64 {
    let bits = schedule.planes().iter().map(|plane| f64::from(1u32 << plane.bit));
    let light: f64 = bits.clone().sum();
    bits.enumerate().map(|(k, bit)| bit * (k as f64 + 0.5)).sum::<f64>() / (light * schedule.len() as f64)
}

impl Lag {
    /// For the world of `setup`, whose frames have these planes.
    pub(crate) fn new(setup: &Setup, schedule: &PlaneSchedule) -> Self {
        let clock_s = match setup.tracker {
            TrackerSetup::NatNet => CLOCK_S,
            TrackerSetup::Serial(_) | TrackerSetup::Vrpn(_) => CLOCK_HELD_S,
        };
        Self {
            clock_s,
            light_centre: light_centre(schedule),
            few_frames: u64::from(setup.rate_hz) / 2,
            ticks: [Sums::default(); TICKS],
            now: 0,
            worst_milli: 0,
        }
    }

    /// How far the tracker's clock is known, seconds.
    pub(crate) fn clock_s(&self) -> f64 {
        self.clock_s
    }

    /// A frame was lit for which the body was at `position`, metres, from its first to its last photon; its poses were `age_s`
    /// old at the first.
    pub(crate) fn see(&mut self, motion: &Motion, position: [f64; 3], [first, last]: [i64; 2], age_s: f64) {
        let to_centre_ns = (last - first) as f64 * self.light_centre;
        let (pose, twist) = motion.state_at(first + to_centre_ns as i64);
        let off = [0, 1, 2].map(|i| position[i] - pose.position_m[i]);
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let age_s = age_s + 1e-9 * to_centre_ns;
        let sums = &mut self.ticks[self.now];
        sums.frames += 1;
        sums.off += dot(off, twist.linear_m_s);
        sums.speed += dot(twist.linear_m_s, twist.linear_m_s);
        sums.age += age_s;
        sums.age_squared += age_s * age_s;
    }

    /// A tick is over: judges the last second if it was peaceful, and if the body moved in it.
    ///
    /// # Errors
    /// The light was not where the body was, but where it had been, or not yet was.
    pub(crate) fn tick(&mut self, is_in_peace: bool) -> Result<(), String> {
        let sum = |f: fn(&Sums) -> f64| self.ticks.iter().map(f).sum::<f64>();
        let frames: u64 = self.ticks.iter().map(|tick| tick.frames).sum();
        let (n, off, speed) = (frames as f64, sum(|s| s.off), sum(|s| s.speed));
        let (age_s, age_squared) = (sum(|s| s.age) / n, sum(|s| s.age_squared) / n);
        self.now = (self.now + 1) % TICKS;
        self.ticks[self.now] = Sums::default();
        let says_something = frames >= self.few_frames && speed > n * SLOW_M_S * SLOW_M_S;
        if !is_in_peace || !says_something {
            return Ok(());
        }
        let (lag_s, allowed_s) = (-off / speed, self.clock_s + SHARE * age_s + TURNS_PER_S * age_squared);
        self.worst_milli = self.worst_milli.max((lag_s.abs() / allowed_s * 1e3) as i64);
        if lag_s.abs() <= allowed_s {
            return Ok(());
        }
        Err(format!(
            "the light of a quiet second is {:.2} ms behind the body; {:.2} ms are allowed to either side; poses are {:.2} ms \
             old",
            lag_s * 1e3,
            allowed_s * 1e3,
            age_s * 1e3
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::BodyMotion;

    /// What a second of light says that shows where a body was `late_ns` ago, with noise on single frames.
    fn told_of(motion: &Motion, late_ns: i64) -> Result<(), String> {
        let setup = Setup::of(5, Some(120), None, Some(false), Some(crate::plan::TrackerKind::NatNet));
        let mut lag = Lag::new(&setup, &PlaneSchedule::mono8());
        let mut told = Ok(());
        for frame in 0..240i64 {
            let first = frame * 1_000_000_000 / 120;
            let last = first + 8_000_000;
            let centre = first + ((last - first) as f64 * lag.light_centre) as i64;
            let mut position = motion.pose_at(centre - late_ns).position_m;
            position[0] += if frame % 2 == 0 { 0.002 } else { -0.002 };
            lag.see(motion, position, [first, last], 0.01);
            if frame % 12 == 11 {
                told = told.and_then(|()| lag.tick(frame > 130));
            }
        }
        told
    }

    /// Light of the past lags by its age, whatever noise is on single frames, and light of the future leads; a body that rests
    /// says nothing.
    #[test]
    fn light_of_another_time_is_told_and_noise_is_not() {
        let swings = BodyMotion::Swings.of(1.0).unwrap();
        assert_eq!(told_of(&swings, 0), Ok(()));
        assert_eq!(told_of(&swings, 2_000_000), Ok(()));
        for late_ms in [7.0, -7.0] {
            let told = told_of(&swings, (late_ms * 1e6) as i64).unwrap_err();
            let found = told.split(' ').find_map(|word| word.parse::<f64>().ok()).unwrap();
            assert!((found - late_ms).abs() < 0.2, "{told}");
        }
        let still = Motion::still(swings.rest()).unwrap();
        assert_eq!(told_of(&still, 7_000_000), Ok(()));
    }

    /// As docs/LATENCY.md has it of the order of 24 planes at 947 frames/s.
    #[test]
    fn the_centre_of_the_light_of_24_planes_is_at_194_us() {
        let centre_us = light_centre(&PlaneSchedule::rgb24()) * 1e6 / 947.0;
        assert!((centre_us - 194.0).abs() < 1.0, "{centre_us}");
    }
}
