//! How far ahead of its newest sample a body may be shown: `safety.predict_ms`, or what the rig needs if the file
//! does not set it.

use crate::config::RigConfig;

/// The shortest horizon of a rig that does not set its own, nanoseconds.
const SHORTEST_NS: i64 = 20_000_000;
/// The longest horizon of any rig, nanoseconds: the largest value of the key.
pub(crate) const LONGEST_NS: i64 = 1_000_000_000;

/// The rule for one rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Horizon {
    /// The value in the rig file, which is binding.
    written_ns: Option<i64>,
    /// Time between two samples of the tracker, nanoseconds.
    period_ns: i64,
    slot_ns: i64,
    /// From the start of a slot to its light, nanoseconds.
    light_delay_ns: i64,
}

impl Horizon {
    /// The rule that a rig file sets.
    pub(crate) fn of_rig(config: &RigConfig) -> Self {
        Self {
            written_ns: config.safety.predict_ms.map(|ms| i64::from(ms) * 1_000_000),
            // A recording has no known rate. Its samples are assumed to be no rarer than those of the slowest
            // trackers.
            period_ns: 1_000_000_000 / i64::from(config.tracker.rate_hz().unwrap_or(30).max(1)),
            slot_ns: config.projector.frame_rate.slot_len_ns(0),
            light_delay_ns: config.projector.light_delay_ns(),
        }
    }

    /// The longest time for which prediction may extend a body's track, nanoseconds. It is the rig file's value if
    /// there is one. Otherwise it is the sum of the tracker's latency, two of its samples, the lead, a slot and those for
    /// which the light of a frame must last, and the time from a slot to its light, and at least 20 ms. `lead_ns`: how long
    /// before its slot a frame is latched. `latency_ns`: from the capture of a sample to its arrival. `light_slots`: until
    /// the next frame is due for certain, so that a frame which is as late as that is still lit.
    pub(crate) fn predict_ns(&self, lead_ns: i64, latency_ns: i64, light_slots: u64) -> i64 {
        self.written_ns.unwrap_or_else(|| {
            let needed = latency_ns
                .saturating_add(2 * self.period_ns)
                .saturating_add(lead_ns)
                .saturating_add(self.slot_ns.saturating_mul(1 + light_slots.clamp(1, 1000) as i64))
                .saturating_add(self.light_delay_ns);
            needed.clamp(SHORTEST_NS, LONGEST_NS)
        })
    }

    /// The maximum age of the newest sample of a working tracker when it is read, nanoseconds.
    pub(crate) fn fresh_ns(&self, latency_ns: i64) -> i64 {
        latency_ns.saturating_add(3 * self.period_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Overrides;

    fn horizon(flags: &[&str]) -> Horizon {
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let config = RigConfig::demo(&Overrides { variables: vec![], flags });
        Horizon::of_rig(&config.unwrap_or_else(|e| panic!("{e}")))
    }

    const MS: i64 = 1_000_000;

    /// Found in use, R6 and C2: at 60 frames/s, 20 ms are less than any frame needs from tracker to light.
    #[test]
    fn a_rig_that_names_no_horizon_has_one_that_its_frames_can_keep() {
        let fast = horizon(&["projector.frame_rate=947", "tracker.rate_hz=500"]);
        assert_eq!(fast.predict_ns(2 * MS, 2 * MS, 1), 20 * MS);
        let slow = horizon(&["projector.frame_rate=24", "tracker.rate_hz=30"]);
        // 5 + 2 * 33.3 + 60 + 2 * 41.7
        assert_eq!(slow.predict_ns(60 * MS, 5 * MS, 1) / MS, 214);
        assert_eq!(slow.predict_ns(5_000 * MS, 0, 1), LONGEST_NS);
        // A cable that carries every tenth frame: 2 + 2 * 2 + 18 + 16 * 1.056
        assert_eq!(fast.predict_ns(18 * MS, 2 * MS, 15) / MS, 40);
        let written = horizon(&["projector.frame_rate=24", "tracker.rate_hz=500", "safety.predict_ms=70"]);
        assert_eq!(written.predict_ns(600 * MS, 5 * MS, 9), 70 * MS, "what is written is law");
    }
}
