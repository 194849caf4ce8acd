//! The kinds of time in a run, as types: the wall clock, or a clock that the run itself moves.

use super::facts::Facts;
use std::sync::atomic::Ordering;

/// Virtual pace: time between the last byte of a frame and its slot, nanoseconds.
const MARGIN_NS: i64 = 50_000;
/// Real pace: the projector lights the last frames for this long, plus the medium's travel, before it is ordered to
/// go dark, nanoseconds.
const LAST_LIGHT_NS: i64 = 10_000_000;

/// Times from latch to the beginning of a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Leads {
    /// How long before its slot a frame is latched, nanoseconds.
    pub lead_ns: i64,
    /// The first slot for which a frame may be planned begins this long from now, nanoseconds.
    pub needed_ns: i64,
}

/// How the engine's parts behave under a kind of time.
pub(crate) trait Pace: Send + 'static {
    /// How long trackers are read before the first frame, so that the filters know the motion, nanoseconds.
    const LISTEN_NS: i64;
    /// Whether the projector's clock is followed during the run. Otherwise it stays as the handshake found it.
    const FOLLOWS_CLOCK: bool;

    /// How early frames begin. `is_slow`: the GPU needs about a slot or more for each.
    fn leads(facts: &Facts, is_slow: bool) -> Leads;

    /// How long after the last frame was sent its light lasts, nanoseconds.
    fn last_light_ns(facts: &Facts, travel_ns: i64) -> i64;
}

/// Modelled time from latch to slot: the stage costs in the rig file and a margin, nanoseconds.
pub(super) fn modelled_ns(facts: &Facts) -> i64 {
    facts.modelled_costs().iter().sum::<i64>() + MARGIN_NS
}

/// The wall clock's pace, or that of a simulator that replaces it: stages take their real time, frames can be late,
/// and the engine learns from its measurements.
pub(crate) enum Real {}

impl Pace for Real {
    const LISTEN_NS: i64 = super::plan::LISTEN_NS;
    const FOLLOWS_CLOCK: bool = true;

    /// Frames begin early enough to survive a bad moment, so there is time to catch up afterwards. A slot is given up
    /// only when a frame of typical duration would miss it. A renderer that is slower than its slots cannot catch up;
    /// its frames are planned for slots that they can meet.
    fn leads(facts: &Facts, is_slow: bool) -> Leads {
        let travel_ns = facts.travel_ns.load(Ordering::Relaxed);
        let lead_ns = facts.lead_ns.load(Ordering::Relaxed) + travel_ns;
        let typical_ns = facts.typical_ns.load(Ordering::Relaxed) + travel_ns;
        Leads { lead_ns, needed_ns: if is_slow { lead_ns } else { typical_ns } }
    }

    fn last_light_ns(_: &Facts, travel_ns: i64) -> i64 {
        LAST_LIGHT_NS + travel_ns
    }
}

/// A clock that the run moves: every stage takes the time in `[real_time.stage_costs_us]`, and no frame is ever late.
pub(crate) enum Virtual {}

impl Pace for Virtual {
    const LISTEN_NS: i64 = 0;
    const FOLLOWS_CLOCK: bool = false;

    fn leads(facts: &Facts, _: bool) -> Leads {
        let lead_ns = modelled_ns(facts);
        Leads { lead_ns, needed_ns: lead_ns }
    }

    fn last_light_ns(facts: &Facts, _: i64) -> i64 {
        2 * facts.rig.rate().slot_len_ns(0)
    }
}
