//! How the rate of a tracker and the rate of slots go together.
//!
//! If one divides the other, the slots can be shifted so that a sample is ready just before each frame reads it. Else the
//! age of the newest sample swings between none and the time from one sample to the next, and the light with it.

/// A tracker's rate and a rate of slots.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RatePair {
    /// Samples of a body a second.
    pub tracker_hz: f64,
    /// Slots a second.
    pub slots_hz: f64,
}

/// Clocks that should run alike differ by less than this.
const CLOCKS_DIFFER: f64 = 1e-3;

impl RatePair {
    /// Whole times of the faster one over the slower one, the nearest.
    fn times(&self) -> f64 {
        let ratio = self.slots_hz / self.tracker_hz;
        ratio.max(1.0 / ratio).round()
    }

    /// True if one rate divides the other, apart from what the clocks differ by.
    pub fn divides(&self) -> bool {
        let ratio = self.slots_hz / self.tracker_hz;
        (ratio.max(1.0 / ratio) / self.times() - 1.0).abs() < CLOCKS_DIFFER
    }

    /// How often a second the age of the newest sample swings; `None` if one rate divides the other.
    pub fn beat_hz(&self) -> Option<f64> {
        let beat = if self.slots_hz >= self.tracker_hz {
            self.slots_hz / self.times() - self.tracker_hz
        } else {
            self.tracker_hz / self.times() - self.slots_hz
        };
        (!self.divides()).then_some(beat.abs())
    }

    /// The nearest rates of slots below and above that go together with the tracker's.
    pub fn nearest_slots_hz(&self) -> [f64; 2] {
        let (tracker, slots) = (self.tracker_hz, self.slots_hz);
        if slots >= tracker {
            let below = (slots / tracker).floor();
            [below * tracker, (below + 1.0) * tracker]
        } else {
            let above = (tracker / slots).floor();
            [tracker / (above + 1.0), tracker / above]
        }
    }

    /// One sentence for the operator about rates that do not go together; `None` if they do.
    pub fn told(&self) -> Option<String> {
        let beat = self.beat_hz()?;
        let [below, above] = self.nearest_slots_hz();
        let hz = |hz: f64| format!("{}", (hz * 1e3).round() / 1e3);
        Some(format!(
            "neither of {} slots and {} samples a second divides the other: the age of the newest sample swings {:.0} \
             times a second by up to {:.2} ms; at {} or {} frames a second the slots follow the tracker",
            hz(self.slots_hz),
            hz(self.tracker_hz),
            beat,
            1e3 / self.tracker_hz,
            hz(below),
            hz(above),
        ))
    }
}

/// How the slots of a run went together with its tracker, for the report.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct BeatReport {
    /// Samples of a body a second, as they were measured.
    pub tracker_hz: f64,
    /// True if the slots were shifted to follow the tracker.
    pub in_step: bool,
    /// How often a second the age of the newest sample swings; null if one rate divides the other.
    pub beat_hz: Option<f64>,
    /// The nearest rates of slots below and above at which one rate divides the other.
    pub nearest_slots_hz: [f64; 2],
}

impl BeatReport {
    /// Of a run in which the slots followed the tracker, if they were `in_step`.
    pub(crate) fn new(pair: RatePair, in_step: bool) -> Self {
        let (beat_hz, nearest_slots_hz) = (pair.beat_hz(), pair.nearest_slots_hz());
        Self { tracker_hz: pair.tracker_hz, in_step, beat_hz, nearest_slots_hz }
    }

    /// The same in words, for slots of so many a second.
    pub fn told(&self, slots_hz: f64) -> String {
        let pair = RatePair { tracker_hz: self.tracker_hz, slots_hz };
        pair.told().unwrap_or_else(|| {
            let does = if self.in_step { "follow" } else { "do not follow" };
            format!(
                "{:.0} slots and {:.0} samples a second go together, and the slots {does} the tracker",
                slots_hz, self.tracker_hz
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_rates_go_together_and_only_others_beat() {
        for (tracker_hz, slots_hz, beat, nearest) in [
            (500.0, 947.0, Some(26.5), [500.0, 1000.0]),
            (500.0, 60.0, Some(2.5), [500.0 / 9.0, 62.5]),
            (1000.0, 947.0, Some(53.0), [500.0, 1000.0]),
            (240.0, 947.0, Some(3.25), [720.0, 960.0]),
            (500.0, 1000.0, None, [1000.0, 1500.0]),
            (499.98, 500.0, None, [499.98, 999.96]),
            (500.0, 250.0, None, [500.0 / 3.0, 250.0]),
        ] {
            let pair = RatePair { tracker_hz, slots_hz };
            assert_eq!(pair.divides(), beat.is_none(), "{pair:?}");
            assert_eq!(pair.told().is_some(), beat.is_some());
            assert!((pair.beat_hz().unwrap_or(0.0) - beat.unwrap_or(0.0)).abs() < 1e-9, "{pair:?}");
            for (hz, expected) in pair.nearest_slots_hz().into_iter().zip(nearest) {
                assert!((hz - expected).abs() < 1e-9, "{pair:?}: {hz}");
                assert!(RatePair { slots_hz: hz, ..pair }.divides());
            }
        }
    }
}
