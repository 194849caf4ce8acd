//! What is kept of a rig's answer: known fields, short texts, and rates over the last minute.
//!
//! The answer comes from another program, perhaps of another version. Fields that are not known here are not read.

use serde::{Deserialize, Deserializer, Serialize};
use std::collections::VecDeque;

/// Longest text that is kept, characters.
const MAX_TEXT: usize = 240;
/// Most bodies that are kept; no rig may have more.
const MAX_BODIES: usize = 256;
/// Rates are told over at least this time, and misses over at most a minute, seconds.
const RATE_S: f64 = 2.0;
const MINUTE_S: f64 = 61.0;
/// Counters that were read further apart do not belong to the same look, seconds.
const GAP_S: f64 = 6.0;
/// Most counters that are kept, whatever a rig says of its time.
const MAX_KEPT: usize = 90;

/// A text of bounded length without control characters.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub(super) struct Short(String);

impl<'de> Deserialize<'de> for Short {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let text = String::deserialize(from)?;
        let mut left = text.chars().filter(|c| !c.is_control());
        let mut short: String = left.by_ref().take(MAX_TEXT).collect();
        if left.next().is_some() {
            short.push('…');
        }
        Ok(Self(short))
    }
}

/// The answer to `GET /api/state`. A run without a collector has no figures but the link's.
#[derive(Debug, Deserialize)]
pub(super) struct StateAnswer {
    now: Now,
    #[serde(default)]
    figures: Figures,
}

#[derive(Debug, Deserialize)]
struct Now {
    pid: u32,
    up_s: f64,
    counts: FrameCounts,
    #[serde(flatten)]
    state: NeighbourState,
}

/// What is passed on as the rig tells it.
#[derive(Clone, Debug, Deserialize, Serialize)]
struct NeighbourState {
    light: NeighbourLight,
    /// The order that is kept over restarts.
    standing: Option<Short>,
    /// On what light depends, and whether it is permitted.
    interlock: Option<(Short, bool)>,
    /// What the tracker says of bodies that it has not seen.
    tracker: Option<Short>,
    /// The run is asked to end.
    is_stopping: bool,
}

/// The state of the light.
#[derive(Clone, Debug, Deserialize, Serialize)]
struct NeighbourLight {
    /// As a word, and as a sentence behind it.
    word: Short,
    told: Short,
    /// Mirrors are lit.
    is_lit: bool,
}

#[derive(Clone, Copy, Debug, Deserialize)]
struct FrameCounts {
    frames_lit: u64,
    slots: u64,
    slots_missed: u64,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Figures {
    bodies: Vec<NeighbourBody>,
    link: NeighbourLink,
    setup: NeighbourSetup,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct NeighbourLink {
    celsius: Option<f64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct NeighbourSetup {
    rig: Short,
    version: Short,
    commit: Short,
}

/// A body of a rig.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub(super) struct NeighbourBody {
    name: Short,
    /// Why no light falls on it, as a word and as a sentence; `None` while it is lit.
    dark: Option<Short>,
    told: Option<Short>,
}

/// What the overview shows of a rig.
#[derive(Clone, Debug, Serialize)]
pub(super) struct RigView {
    #[serde(flatten)]
    state: NeighbourState,
    /// Frames lit a second, over the last seconds; `None` before the second answer.
    lit_per_s: Option<f64>,
    /// Share of the slots of the last minute, or of the time for which somebody has looked, that were missed, 0 to 1.
    missed: Option<f64>,
    /// Temperature of the projector's hottest sensor, degrees Celsius.
    celsius: Option<f64>,
    bodies: Vec<NeighbourBody>,
    /// The rig file, the program's version, and the commit from which it was built.
    rig: Short,
    version: Short,
    commit: Short,
}

impl StateAnswer {
    /// What is kept of it. Its counters are added to `minute`, which gives the rates.
    pub(super) fn told(self, minute: &mut Minute) -> RigView {
        let (now, mut figures) = (self.now, self.figures);
        minute.add(CounterSample { pid: now.pid, up_s: now.up_s, counts: now.counts });
        figures.bodies.truncate(MAX_BODIES);
        RigView {
            state: now.state,
            lit_per_s: minute.lit_per_s(),
            missed: minute.missed(),
            celsius: figures.link.celsius,
            bodies: figures.bodies,
            rig: figures.setup.rig,
            version: figures.setup.version,
            commit: figures.setup.commit,
        }
    }
}

/// Counters of a process at one moment of its own clock.
#[derive(Clone, Copy, Debug)]
struct CounterSample {
    pid: u32,
    up_s: f64,
    counts: FrameCounts,
}

/// The counters of the last minute, oldest first.
#[derive(Debug, Default)]
pub(super) struct Minute(VecDeque<CounterSample>);

impl Minute {
    /// Adds the newest. A new process, a new run and a pause begin a new minute.
    fn add(&mut self, now: CounterSample) {
        let goes_on = self.0.back().is_some_and(|last| {
            last.pid == now.pid
                && last.counts.slots <= now.counts.slots
                && (0.0..GAP_S).contains(&(now.up_s - last.up_s))
        });
        if !goes_on {
            self.0.clear();
        }
        self.0.push_back(now);
        while self.0.len() > MAX_KEPT || self.0.get(1).is_some_and(|next| next.up_s <= now.up_s - MINUTE_S) {
            self.0.pop_front();
        }
    }

    /// Frames lit a second since an answer that is two seconds old, or since the first.
    fn lit_per_s(&self) -> Option<f64> {
        let (first, now) = (self.0.front()?, self.0.back()?);
        let before = self.0.iter().rev().find(|c| c.up_s <= now.up_s - RATE_S).unwrap_or(first);
        let frames = now.counts.frames_lit.checked_sub(before.counts.frames_lit)?;
        let seconds = now.up_s - before.up_s;
        (seconds > 0.0).then(|| frames as f64 / seconds)
    }

    /// Share of the slots that were missed, 0 to 1; `None` if there was no slot.
    fn missed(&self) -> Option<f64> {
        let (first, now) = (self.0.front()?.counts, self.0.back()?.counts);
        let slots = now.slots.checked_sub(first.slots)?;
        let missed = now.slots_missed.checked_sub(first.slots_missed)?;
        (slots > 0).then(|| missed as f64 / slots as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(pid: u32, up_s: f64, frames_lit: u64, slots: u64, slots_missed: u64) -> CounterSample {
        CounterSample { pid, up_s, counts: FrameCounts { frames_lit, slots, slots_missed } }
    }

    #[test]
    fn rates_are_those_of_one_run_over_the_last_minute() {
        let mut minute = Minute::default();
        minute.add(counted(1, 1.0, 10, 100, 90));
        assert_eq!((minute.lit_per_s(), minute.missed()), (None, None), "one answer tells no rate");
        for k in 1..=300u64 {
            // A hundred slots a second; every tenth is missed in the first 100 s, and none after that.
            minute.add(counted(1, 1.0 + k as f64, 10 + 90 * k, 100 + 100 * k, 90 + 10 * k.min(100)));
        }
        assert_eq!((minute.lit_per_s(), minute.missed()), (Some(90.0), Some(0.0)));
        assert!(minute.0.len() <= 63, "{}", minute.0.len());
        minute.add(counted(1, 320.0, 1_000_000, 1_000_000, 0));
        assert_eq!(minute.lit_per_s(), None, "nobody looked in between");
        minute.add(counted(2, 321.0, 1_000_100, 1_000_100, 1));
        assert_eq!(minute.missed(), None, "another process");
        // A clock that stands still, and counters that go back.
        for k in 0..1000u64 {
            minute.add(counted(2, 321.0, 1_000_000 - k, 1_000_100, 0));
        }
        assert_eq!((minute.lit_per_s(), minute.missed()), (None, None));
        assert!(minute.0.len() <= MAX_KEPT);
    }

    #[test]
    fn texts_are_short_and_plain_whatever_a_rig_says() {
        let text = serde_json::to_string(&format!("a\u{1b}[31m\n{}", "ä".repeat(5000))).unwrap();
        let Short(short) = serde_json::from_str(&text).unwrap();
        assert!(short.starts_with("a[31mä") && short.ends_with('…'), "{short}");
        assert_eq!(short.chars().count(), MAX_TEXT + 1);
        assert_eq!(serde_json::from_str::<Short>("\"up\"").unwrap(), Short("up".into()));
    }
}
