//! By how much time the light of a second is behind the body, or ahead of it.
//!
//! The place of one frame may be wrong by what the filter takes noise for. Over a second noise and turns cancel, and what
//! is left is a time: with `e` the way from the body to its light and `v` the body's velocity, the least squares of
//! `e + lag v` have their least at `lag = -sum(e v) / sum(v v)`. Light that is shown where the body was lags by the age
//! of its poses; light that aims at the wrong instant of its exposure lags or leads by as much.

use crate::plan::{Setup, TrackerSetup};

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

/// What the light of a second says.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Second {
    /// Frames that were lit in it.
    pub(crate) frames: u64,
    /// By how much time they were behind the body, seconds; negative if ahead.
    pub(crate) lag_s: f64,
    /// The mean age of their poses at the centre of their light, seconds.
    pub(crate) age_s: f64,
    /// How much lag is lawful, either way, seconds.
    pub(crate) allowed_s: f64,
}

/// Collects the places of light, tick by tick.
#[derive(Clone, Debug)]
pub(crate) struct Lag {
    clock_s: f64,
    ticks: [Sums; TICKS],
    now: usize,
}

impl Lag {
    /// For the world of `setup`.
    pub(crate) fn new(setup: &Setup) -> Self {
        let clock_s = match setup.tracker {
            TrackerSetup::NatNet => CLOCK_S,
            TrackerSetup::Serial(_) | TrackerSetup::Vrpn(_) => CLOCK_HELD_S,
        };
        Self { clock_s, ticks: [Sums::default(); TICKS], now: 0 }
    }

    /// How far the tracker's clock is known, seconds.
    pub(crate) fn clock_s(&self) -> f64 {
        self.clock_s
    }

    /// A frame was lit `off` beside the body, metres, which moved with `velocity`, m/s; its poses were `age_s` old.
    pub(crate) fn add(&mut self, off: [f64; 3], velocity: [f64; 3], age_s: f64) {
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let sums = &mut self.ticks[self.now];
        sums.frames += 1;
        sums.off += dot(off, velocity);
        sums.speed += dot(velocity, velocity);
        sums.age += age_s;
        sums.age_squared += age_s * age_s;
    }

    /// A tick is over: what the last second says, if bodies moved in it.
    pub(crate) fn tick(&mut self) -> Option<Second> {
        let sum = |f: fn(&Sums) -> f64| self.ticks.iter().map(f).sum::<f64>();
        let frames = self.ticks.iter().map(|tick| tick.frames).sum();
        let (n, off, speed) = (frames as f64, sum(|s| s.off), sum(|s| s.speed));
        let (age_s, age_squared) = (sum(|s| s.age) / n, sum(|s| s.age_squared) / n);
        self.now = (self.now + 1) % TICKS;
        self.ticks[self.now] = Sums::default();
        let allowed_s = self.clock_s + SHARE * age_s + TURNS_PER_S * age_squared;
        (speed > n * SLOW_M_S * SLOW_M_S).then(|| Second { frames, lag_s: -off / speed, age_s, allowed_s })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Light that shows where a swinging body was 7 ms ago lags by 7 ms, whatever noise is on single frames; light of a body
    /// that rests says nothing.
    #[test]
    fn light_of_the_past_lags_by_its_age() {
        let mut lag = Lag { clock_s: CLOCK_S, ticks: [Sums::default(); TICKS], now: 0 };
        let place = |t: f64| 0.09 * (t / 0.3).sin();
        let mut last = None;
        for frame in 0..240 {
            let t = f64::from(frame) / 120.0;
            let noise = if frame % 2 == 0 { 0.002 } else { -0.002 };
            let off = [place(t - 0.007) - place(t) + noise, 0.0, 0.0];
            lag.add(off, [0.3 * (t / 0.3).cos(), 0.0, 0.0], 0.01);
            if frame % 12 == 11 {
                last = lag.tick();
            }
        }
        let second = last.unwrap();
        assert_eq!(second.frames, 132);
        assert!((second.lag_s - 0.007).abs() < 1e-4, "{second:?}");
        assert!(second.lag_s > second.allowed_s);
        let mut lag = Lag { clock_s: CLOCK_S, ticks: [Sums::default(); TICKS], now: 0 };
        lag.add([0.1, 0.0, 0.0], [0.01, 0.0, 0.0], 0.01);
        assert!(lag.tick().is_none());
    }
}
