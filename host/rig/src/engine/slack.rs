//! What the projector's reports of slack say about the frames that were sent: the time that each needed from latch to
//! whole, and from sent to whole.
//!
//! The device measures slack on its own clock, from the whole frame to the beginning of its slot. So the time that a
//! frame needed follows without a constant for what the host cannot see: it is the lead with which the frame was
//! latched, minus its slack. Where the frame was planned by a wrong map of the clocks, after the machine was suspended
//! for example, its slot was not where the host believed. Two instants of the host's own clock bound the error: the frame
//! was whole after it was sent, and before its report was read.

use super::queue::FrameNeed;
use crate::telemetry::projector::SlackReport;
use crate::telemetry::signed::SignedHistogram;
use dpm_device::link::FrameTiming;
use dpm_device::time::HostTime;

/// Sent frames whose report may be outstanding: more than any projector holds.
const REMEMBERED: usize = 64;
/// Slack beyond this is counted as this, nanoseconds.
const LONGEST_NS: i64 = 1_000_000_000;
/// A frame of which nothing was heard is taken for whole, or lost, after this time, nanoseconds; where frames travel for long,
/// after so many times that, but no later than [`LONGEST_NS`].
const HEARD_WITHIN_NS: i64 = 100_000_000;
const HEARD_WITHIN_TRAVELS: i64 = 4;

/// A frame that was sent.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SlackFrame {
    /// Low 32 bits of its number.
    pub frame: u32,
    /// When it should have been latched.
    pub latch_due_at: HostTime,
    /// When its slot begins.
    pub due_at: HostTime,
    /// When the medium had accepted it.
    pub sent_at: HostTime,
    /// How long it waited for room in the device, nanoseconds. An earlier start would only fill the device more.
    pub waited_ns: i64,
    /// How long it waited for stages that were busy with frames before it, nanoseconds.
    pub behind_ns: i64,
}

/// See the module's documentation.
pub(crate) struct SlackMeter {
    sent: [Option<SlackFrame>; REMEMBERED],
    next: usize,
    /// The newest report that was read.
    read: Option<FrameTiming>,
    /// When the frame of that report was sent and whole, and how long it waited on the medium for the one before, nanoseconds.
    whole: Option<[HostTime; 2]>,
    queued_ns: i64,
    /// When the slot of that frame began, and when its light did.
    lit: Option<[HostTime; 2]>,
    /// Of frames that travel alone: mean and mean deviation of the time from sent to whole, nanoseconds.
    travel_ns: Option<(i64, i64)>,
    slack: SignedHistogram,
    transfer: SignedHistogram,
}

impl SlackMeter {
    pub(crate) fn new() -> Self {
        Self {
            sent: [None; REMEMBERED],
            next: 0,
            read: None,
            whole: None,
            queued_ns: 0,
            lit: None,
            travel_ns: None,
            slack: SignedHistogram::new(LONGEST_NS as u64),
            transfer: SignedHistogram::new(LONGEST_NS as u64),
        }
    }

    /// A frame was sent.
    pub(crate) fn sent(&mut self, frame: SlackFrame) {
        self.sent[self.next] = Some(frame);
        self.next = (self.next + 1) % REMEMBERED;
    }

    /// Frames that were sent to a former session, or planned by a wrong map of the clock, are not judged any more.
    pub(crate) fn forget(&mut self) {
        (self.sent, self.read, self.travel_ns) = ([None; REMEMBERED], None, None);
        (self.whole, self.queued_ns, self.lit) = (None, 0, None);
    }

    /// When the slot of the frame of the newest report began, and when it was lit if that was later.
    pub(crate) fn lit(&self) -> Option<[HostTime; 2]> {
        self.lit
    }

    /// How long the frame of the newest report waited on the medium for the frame before it, nanoseconds: from sent until that
    /// one was whole.
    pub(crate) fn queued_ns(&self) -> i64 {
        self.queued_ns
    }

    /// Frames that are on the medium at `now`, as far as is known.
    fn on_the_way(&self, now: HostTime) -> usize {
        let within_ns = (HEARD_WITHIN_TRAVELS * self.travel_ns()).clamp(HEARD_WITHIN_NS, LONGEST_NS);
        let newest = self.whole.map_or(HostTime(i64::MIN), |[sent_at, _]| sent_at);
        let is_open = |sent: &&SlackFrame| sent.sent_at > newest && now.ns_since(sent.sent_at) < within_ns;
        self.sent.iter().flatten().filter(is_open).count()
    }

    /// True while a frame is on its way at `now`.
    pub(crate) fn is_on_the_way(&self, now: HostTime) -> bool {
        self.on_the_way(now) > 0
    }

    /// How long after `now` a frame that is sent then will be whole, as most are, nanoseconds: it travels behind those that are
    /// on the way.
    pub(crate) fn arrives_ns(&self, now: HostTime) -> i64 {
        self.travel_ns() * (1 + self.on_the_way(now) as i64)
    }

    /// A frame was not sent because it would have come too late. If the travel is believed to be longer than it is, no
    /// report would ever say so: each such frame takes some of the belief.
    pub(crate) fn doubts_travel(&mut self) {
        if let Some((mean, deviation)) = &mut self.travel_ns {
            (*mean, *deviation) = (*mean - *mean / 8, *deviation - *deviation / 8);
        }
    }

    /// Reads the timing of a report at `now`. Returns the time that the frame needed from the instant at which it should have
    /// been latched until it was whole in the device, without the time that it waited for room and for the frame before it on
    /// the medium, nanoseconds; `None` if the report says nothing new.
    pub(crate) fn observe(&mut self, timing: FrameTiming, now: HostTime) -> Option<FrameNeed> {
        if self.read == Some(timing) {
            return None;
        }
        let place = self.sent.iter_mut().find(|sent| sent.is_some_and(|sent| sent.frame == timing.frame))?;
        let sent = place.take()?;
        self.read = Some(timing);
        let slack_ns = i64::from(timing.slack_ns);
        let whole_at = sent.due_at.plus_ns(-slack_ns).max(sent.sent_at).min(now.max(sent.sent_at));
        let travel_ns = whole_at.ns_since(sent.sent_at);
        let before = self.whole.replace([sent.sent_at, whole_at]);
        self.lit = Some([sent.due_at, sent.due_at.max(whole_at)]);
        self.queued_ns =
            before.map_or(0, |[_, whole_at]| whole_at.ns_since(sent.sent_at).clamp(0, travel_ns));
        let travel_ns = travel_ns - self.queued_ns;
        self.travel_ns = Some(self.travel_ns.map_or((travel_ns, travel_ns / 2), |(mean, deviation)| {
            let error = travel_ns - mean;
            (mean + error / 16, deviation + (error.abs() - deviation) / 16)
        }));
        self.slack.record(slack_ns);
        self.transfer.record(i64::from(timing.transfer_ns));
        // An earlier start would only fill the medium more, as it would the device.
        let needed_ns = whole_at.ns_since(sent.latch_due_at) - sent.waited_ns - self.queued_ns;
        Some(FrameNeed { needed_ns, behind_ns: sent.behind_ns })
    }

    /// From sent to whole, as most frames need it that travel alone, nanoseconds; 0 while nothing is known.
    pub(crate) fn travel_ns(&self) -> i64 {
        self.travel_ns.map_or(0, |(mean, deviation)| mean + 2 * deviation)
    }

    /// For the report; `None` if the device has reported nothing.
    pub(crate) fn report(&self) -> Option<SlackReport> {
        let ms = |histogram: &SignedHistogram, share: f64| {
            (!histogram.is_empty()).then(|| histogram.value_at_quantile(share) as f64 / 1e6)
        };
        Some(SlackReport {
            least_0_1_percent_ms: ms(&self.slack, 0.001)?,
            least_0_5_percent_ms: ms(&self.slack, 0.005)?,
            median_ms: ms(&self.slack, 0.5)?,
            transfer_median_ms: ms(&self.transfer, 0.5)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn frame(frame: u32) -> SlackFrame {
        let latch_due_at = HostTime(100 * MS + i64::from(frame) * MS);
        let (due_at, sent_at) = (latch_due_at.plus_ns(3 * MS), latch_due_at.plus_ns(MS));
        SlackFrame { frame, latch_due_at, due_at, sent_at, waited_ns: 0, behind_ns: 0 }
    }

    fn timing(frame: u32, slack_ns: i64) -> FrameTiming {
        FrameTiming { frame, slack_ns: slack_ns as i32, transfer_ns: 7, epoch: 0 }
    }

    #[test]
    fn what_a_frame_needed_is_its_lead_without_its_slack() {
        let mut meter = SlackMeter::new();
        for k in 0..200 {
            meter.sent(SlackFrame { waited_ns: i64::from(k % 3), behind_ns: 5, ..frame(k) });
            let read_at = frame(k).due_at;
            // It is whole before the next one is sent.
            let need = meter.observe(timing(k, 5 * MS / 4), read_at);
            let needed_ns = 7 * MS / 4 - i64::from(k % 3);
            assert_eq!(need, Some(FrameNeed { needed_ns, behind_ns: 5 }));
            assert_eq!(meter.observe(timing(k, 5 * MS / 4), read_at), None, "a report that was read");
            assert_eq!(
                meter.observe(timing(k + 1000, 5 * MS / 4), read_at),
                None,
                "a frame that was never sent"
            );
        }
        assert!((3 * MS / 4..MS).contains(&meter.travel_ns()), "{}", meter.travel_ns());
        let report = meter.report().expect("there were reports");
        assert!((report.median_ms - 1.25).abs() < 2e-3, "{report:?}");
    }

    /// Found by the simulator: a machine was suspended, the map of the clock was wrong by as much for a moment, and a
    /// lead of that length kept everything dark.
    #[test]
    fn a_wrong_map_of_the_clock_adds_no_more_than_the_report_took() {
        for wrong_ms in [-344, 344] {
            let mut meter = SlackMeter::new();
            meter.sent(frame(1));
            let read_at = frame(1).sent_at.plus_ns(MS / 4);
            let need = meter.observe(timing(1, 3 * MS / 2 + wrong_ms * MS), read_at).expect("it is new");
            assert!((MS..=5 * MS / 4).contains(&need.needed_ns), "{need:?}");
            assert!(meter.travel_ns() <= MS / 2 + 1, "{}", meter.travel_ns());
        }
    }

    /// Frames that wait on the medium for those before them: that is no time that they needed.
    #[test]
    fn what_a_frame_waited_on_the_medium_is_told_apart() {
        let mut meter = SlackMeter::new();
        for k in 0..8 {
            // Each is whole 2.5 ms after it was sent, 1 ms after the one before.
            meter.sent(frame(k));
            assert!(meter.is_on_the_way(frame(k).sent_at.plus_ns(2 * MS)));
            let need = meter.observe(timing(k, -MS / 2), frame(k).due_at.plus_ns(MS)).expect("it is new");
            let queued_ns = if k == 0 { 0 } else { 3 * MS / 2 };
            assert_eq!((meter.queued_ns(), need.needed_ns), (queued_ns, 7 * MS / 2 - queued_ns));
            assert!(!meter.is_on_the_way(frame(k).due_at.plus_ns(MS)));
        }
        // One of which nothing is heard does not keep others back for ever.
        meter.sent(frame(9));
        assert_eq!(meter.arrives_ns(frame(9).sent_at), 2 * meter.travel_ns());
        assert!(!meter.is_on_the_way(frame(9).sent_at.plus_ns(HEARD_WITHIN_NS)));
    }

    #[test]
    fn a_travel_that_lets_no_frame_be_sent_is_doubted() {
        let mut meter = SlackMeter::new();
        meter.sent(frame(1));
        meter.observe(timing(1, -900 * MS), HostTime(10_000 * MS));
        assert!(meter.travel_ns() > 900 * MS);
        (0..100).for_each(|_| meter.doubts_travel());
        assert!(meter.travel_ns() < MS, "{}", meter.travel_ns());
    }
}
