//! Converts the stamps of a frame into named intervals: work, waiting, and the totals that matter.
//!
//! `docs/LATENCY.md` defines each stamp, its clock, and how far it can be trusted.

use crate::frame::{FrameTimeline, Stage};

/// What kind of time an interval is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IntervalKind {
    /// Something is computed or moved.
    Work,
    /// The frame waits in a hand-off.
    Wait,
    /// A sum of other intervals.
    Total,
}

/// A named part of a frame's path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(usize)]
pub enum Interval {
    /// From the tracker's mid-exposure to arrival in this process.
    Tracker = 0,
    /// From arrival to the latch that used the sample: the sample's age in addition to the tracker's latency.
    PoseWait,
    /// From the latch to the GPU's start.
    Plan,
    /// From the GPU's start to code values.
    Render,
    /// From code values to the packer's start.
    PackWait,
    /// From code values to bit planes.
    Pack,
    /// From bit planes to the link's start.
    LinkWait,
    /// From bit planes to the transport.
    Link,
    /// From acceptance by the transport to the slot's due time: the rest of the slot before.
    SlotWait,
    /// From due time to first photon. It is negative if the frame was lit before it was due, through the error of the
    /// clock's map.
    Lateness,
    /// From the latch to the first photon.
    LatchToFirstPhoton,
    /// From the tracker's mid-exposure to the first photon.
    MotionToFirstPhoton,
    /// From the tracker's mid-exposure to the centre of the light.
    MotionToCentre,
    /// From the tracker's mid-exposure to the last photon.
    MotionToLastPhoton,
}

impl Interval {
    /// All intervals, in the order in which a frame passes them.
    pub const ALL: [Self; 14] = [
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
        Self::LatchToFirstPhoton,
        Self::MotionToFirstPhoton,
        Self::MotionToCentre,
        Self::MotionToLastPhoton,
    ];

    /// The name in reports.
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
            Self::LatchToFirstPhoton => "latch_to_first_photon",
            Self::MotionToFirstPhoton => "motion_to_first_photon",
            Self::MotionToCentre => "motion_to_centre",
            Self::MotionToLastPhoton => "motion_to_last_photon",
        }
    }

    /// Work, waiting or a sum.
    pub const fn kind(self) -> IntervalKind {
        match self {
            Self::Tracker | Self::Plan | Self::Render | Self::Pack | Self::Link => IntervalKind::Work,
            Self::PoseWait | Self::PackWait | Self::LinkWait | Self::SlotWait => IntervalKind::Wait,
            Self::Lateness
            | Self::LatchToFirstPhoton
            | Self::MotionToFirstPhoton
            | Self::MotionToCentre
            | Self::MotionToLastPhoton => IntervalKind::Total,
        }
    }

    /// Length in nanoseconds. It is negative where a stamp lies before its predecessor (an error of the clock, or a
    /// frame sent after it was due). `None` if the interval ends with light and the frame was not lit, and if the
    /// interval begins with a sample and the frame has none.
    ///
    /// `measured` says whether the stamps are readings of a clock. At virtual pace they are modelled: the whole of
    /// the link then counts as work, and nothing waits.
    /// link counts as work and nothing waits.
    pub(crate) fn of(self, t: &FrameTimeline, measured: bool) -> Option<i64> {
        let sample = t.has_sample().then_some((t.captured_at, t.received_at));
        let captured = || sample.map(|s| s.0);
        let link = t.sent_at.ns_since(t.packed_at);
        // The thread's own time for sending. It ends with the stamp and lies inside the whole. It was measured with
        // another clock, so it is limited to the whole: the two parts then add up, and neither is negative unless the
        // whole is.
        let sending = if measured {
            i64::try_from(t.wall_ns[Stage::Link as usize]).unwrap_or(i64::MAX).min(link.max(0))
        } else {
            link
        };
        Some(match self {
            Self::Tracker => t.received_at.ns_since(captured()?),
            Self::PoseWait => t.latched_at.ns_since(sample?.1),
            Self::Plan => t.submitted_at.ns_since(t.latched_at),
            Self::Render => t.rendered_at.ns_since(t.submitted_at),
            Self::PackWait => t.packing_at.ns_since(t.rendered_at),
            Self::Pack => t.packed_at.ns_since(t.packing_at),
            Self::LinkWait => link - sending,
            Self::Link => sending,
            Self::SlotWait => t.due_at.ns_since(t.sent_at),
            Self::Lateness => t.lit_at?.ns_since(t.due_at),
            Self::LatchToFirstPhoton => t.lit_at?.ns_since(t.latched_at),
            Self::MotionToFirstPhoton => t.lit_at?.ns_since(captured()?),
            Self::MotionToCentre => t.centre_at?.ns_since(captured()?),
            Self::MotionToLastPhoton => t.last_photon_at?.ns_since(captured()?),
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::frame::STAGES;
    use dpm_device::time::HostTime;

    /// A frame whose stamps are `step` ns apart, except that packing begins in the middle of its step and the link
    /// worked for a quarter of its step. Its light lasts for one step, with its centre after a quarter.
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
            packing_at: at(4).plus_ns(step / 2),
            packed_at: at(5),
            sent_at: at(6),
            due_at: at(7),
            lit_at: Some(at(8)),
            centre_at: Some(at(8).plus_ns(step / 4)),
            last_photon_at: Some(at(9)),
            wall_ns,
        }
    }

    /// Work and waits from sample to light add up to motion to first photon, whether measured or modelled.
    #[test]
    fn the_parts_add_up_to_the_whole() {
        for measured in [true, false] {
            let t = frame(1_000, 400);
            let of = |i: Interval| i.of(&t, measured).unwrap();
            let sum: i64 =
                Interval::ALL.into_iter().filter(|i| i.kind() != IntervalKind::Total).map(of).sum();
            assert_eq!(sum + of(Interval::Lateness), of(Interval::MotionToFirstPhoton));
            assert_eq!(of(Interval::LatchToFirstPhoton), 2400);
            assert_eq!((of(Interval::PackWait), of(Interval::Pack)), (200, 200));
            assert_eq!(of(Interval::LinkWait), if measured { 300 } else { 0 });
            let totals =
                [Interval::MotionToFirstPhoton, Interval::MotionToCentre, Interval::MotionToLastPhoton];
            assert_eq!(totals.map(of), [3200, 3300, 3600]);
        }
        for (i, interval) in Interval::ALL.into_iter().enumerate() {
            assert_eq!(interval as usize, i);
        }
    }

    #[test]
    fn a_frame_lit_before_it_was_due_has_a_negative_lateness() {
        let t = FrameTimeline { due_at: HostTime(8_500), ..frame(0, 1_000) };
        assert_eq!(Interval::Lateness.of(&t, true), Some(-500));
    }

    #[test]
    fn an_unlit_frame_has_no_light() {
        let t = FrameTimeline { lit_at: None, centre_at: None, last_photon_at: None, ..frame(0, 10) };
        for interval in Interval::ALL.into_iter().filter(|i| i.kind() == IntervalKind::Total) {
            assert_eq!(interval.of(&t, true), None);
        }
        assert_eq!(Interval::Link.of(&t, true), Some(2));
    }

    /// A frame for bodies without any report is not the fastest of all frames.
    #[test]
    fn a_frame_without_a_sample_has_no_way_from_one() {
        let t = frame(0, 1_000).without_sample();
        assert!(!t.has_sample() && frame(0, 1_000).has_sample());
        for interval in Interval::ALL {
            let from_sample = matches!(interval, Interval::Tracker | Interval::PoseWait)
                || interval.name().starts_with("motion");
            assert_eq!(interval.of(&t, true).is_none(), from_sample, "{}", interval.name());
        }
    }
}
