//! The stamps of a frame into named intervals: work apart from waiting, and the totals that matter.
//!
//! `docs/LATENCY.md` defines each stamp, whose clock it is on and how far to trust it.

use crate::frame::{FrameTimeline, Stage};

/// What kind of time an interval is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IntervalKind {
    /// Something is computed or moved.
    Work,
    /// The frame lies in a hand-off.
    Wait,
    /// A sum over others.
    Total,
}

/// A named part of a frame's way.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(usize)]
pub enum Interval {
    /// Mid-exposure of the tracker to arrival in this process.
    Tracker = 0,
    /// Arrival to the latch that used it: the sample's age on top of the tracker's latency.
    PoseWait,
    /// Latch to the GPU's start.
    Plan,
    /// The GPU's start to code values.
    Render,
    /// Code values to the packer's start.
    PackWait,
    /// Code values to bit planes.
    Pack,
    /// Bit planes to the link's start.
    LinkWait,
    /// Bit planes to the transport.
    Link,
    /// Taken by the transport to the slot's due time: what was left of the slot before.
    SlotWait,
    /// Due time to first photon.
    Lateness,
    /// Latch to first photon.
    LatchToLight,
    /// Mid-exposure of the tracker to first photon.
    MotionToLight,
}

impl Interval {
    /// All, in the order in which a frame passes them.
    pub const ALL: [Self; 12] = [
        Self::Tracker,
        Self::PoseWait,
        Self::Plan,
        Self::Render,
        Self::PackWait,
        Self::Pack,
        Self::LinkWait,
        Self::Link,
        Self::SlotWait,
        Self::Lateness,
        Self::LatchToLight,
        Self::MotionToLight,
    ];

    /// As in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Tracker => "tracker",
            Self::PoseWait => "pose_wait",
            Self::Plan => "plan",
            Self::Render => "render",
            Self::PackWait => "pack_wait",
            Self::Pack => "pack",
            Self::LinkWait => "link_wait",
            Self::Link => "link",
            Self::SlotWait => "slot_wait",
            Self::Lateness => "lateness",
            Self::LatchToLight => "latch_to_light",
            Self::MotionToLight => "motion_to_light",
        }
    }

    /// Work, waiting or a sum.
    pub const fn kind(self) -> IntervalKind {
        match self {
            Self::Tracker | Self::Plan | Self::Render | Self::Pack | Self::Link => IntervalKind::Work,
            Self::PoseWait | Self::PackWait | Self::LinkWait | Self::SlotWait => IntervalKind::Wait,
            Self::Lateness | Self::LatchToLight | Self::MotionToLight => IntervalKind::Total,
        }
    }

    /// Length in nanoseconds; negative where a stamp lies before its predecessor (a clock's error, or a frame sent after it
    /// was due). `None` when the frame was not lit and the interval ends with light.
    ///
    /// `measured` says whether the stamps are readings of a clock. At virtual pace they are modelled: there the whole of pack
    /// and link counts as work and nothing waits.
    pub fn of(self, t: &FrameTimeline, measured: bool) -> Option<i64> {
        let work = |stage: Stage, whole: i64| {
            if measured {
                i64::try_from(t.wall_ns[stage as usize]).unwrap_or(i64::MAX).min(whole.max(0))
            } else {
                whole
            }
        };
        let pack = t.packed_at.ns_since(t.rendered_at);
        let link = t.sent_at.ns_since(t.packed_at);
        Some(match self {
            Self::Tracker => t.received_at.ns_since(t.captured_at),
            Self::PoseWait => t.latched_at.ns_since(t.received_at),
            Self::Plan => t.submitted_at.ns_since(t.latched_at),
            Self::Render => t.rendered_at.ns_since(t.submitted_at),
            Self::PackWait => pack - work(Stage::Pack, pack),
            Self::Pack => work(Stage::Pack, pack),
            Self::LinkWait => link - work(Stage::Link, link),
            Self::Link => work(Stage::Link, link),
            Self::SlotWait => t.due_at.ns_since(t.sent_at),
            Self::Lateness => t.lit_at?.ns_since(t.due_at),
            Self::LatchToLight => t.lit_at?.ns_since(t.latched_at),
            Self::MotionToLight => t.motion_to_light_ns()?,
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::frame::STAGES;
    use dpm_device::time::HostTime;

    /// A frame whose stamps are `step` ns apart; pack worked for half of its step, link for a quarter.
    pub(crate) fn frame(start: i64, step: i64) -> FrameTimeline {
        let at = |k: i64| HostTime(start + k * step);
        let mut wall_ns = [0; STAGES.len()];
        wall_ns[Stage::Pack as usize] = (step / 2).unsigned_abs();
        wall_ns[Stage::Link as usize] = (step / 4).unsigned_abs();
        FrameTimeline {
            captured_at: at(0),
            received_at: at(1),
            latched_at: at(2),
            submitted_at: at(3),
            rendered_at: at(4),
            packed_at: at(5),
            sent_at: at(6),
            due_at: at(7),
            lit_at: Some(at(8)),
            wall_ns,
        }
    }

    /// Work and waits from sample to light add up to motion-to-light, measured or modelled.
    #[test]
    fn the_parts_add_up_to_the_whole() {
        for measured in [true, false] {
            let t = frame(1_000, 400);
            let sum: i64 = Interval::ALL
                .into_iter()
                .filter(|i| i.kind() != IntervalKind::Total)
                .map(|i| i.of(&t, measured).unwrap())
                .sum();
            let lateness = Interval::Lateness.of(&t, measured).unwrap();
            assert_eq!(sum + lateness, Interval::MotionToLight.of(&t, measured).unwrap());
            assert_eq!(Interval::LatchToLight.of(&t, measured), Some(2400));
            let waits = (Interval::PackWait.of(&t, measured), Interval::LinkWait.of(&t, measured));
            assert_eq!(waits, if measured { (Some(200), Some(300)) } else { (Some(0), Some(0)) });
        }
        for (i, interval) in Interval::ALL.into_iter().enumerate() {
            assert_eq!(interval as usize, i);
        }
    }

    #[test]
    fn an_unlit_frame_has_no_light() {
        let t = FrameTimeline { lit_at: None, ..frame(0, 10) };
        assert_eq!(Interval::MotionToLight.of(&t, true), None);
        assert_eq!(Interval::Link.of(&t, true), Some(2));
    }
}
