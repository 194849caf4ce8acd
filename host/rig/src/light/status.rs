//! Converts STATUS reports of a projector outside this process into light notes like a mock's, as far as the reports
//! contain the information.
//!
//! Counters are absolute, and reports may be merged or lost. A report that covers one slot tells everything about it.
//! A report that covers several slots tells how many were lit, repeated and dark, and which frame was lit last; the
//! other frames are passed on as a number.

use crate::light::recorder::LightNote;
use crate::plan::link_time::LinkTime;
use crate::telemetry::projector::DeviceCounts;
use dpm_device::light::{LightEvent, LightKind};
use dpm_device::link::Status;
use dpm_device::time::HostTime;
use dpm_handoff::channel::Sender;

/// Maximum number of slots of one report for which single notes are made: a second of silence at 1 kHz.
const MOST_SLOTS: u32 = 1024;
/// Frames whose slot is remembered until their light is reported.
const REMEMBERED: usize = 64;
/// The longest travel of a frame that is considered plausible, nanoseconds.
const LONGEST_TRAVEL_NS: i64 = 500_000_000;
/// Frames whose arrival bounds the travel from above.
const ARRIVALS: usize = 16;

/// A frame that was sent.
#[derive(Clone, Copy, Debug)]
struct ReportedFrame {
    /// Low 32 bits of its number.
    frame: u32,
    /// Its slot.
    slot: u64,
    at: HostTime,
}

/// Reads the reports of one session after the other.
#[derive(Debug)]
pub(crate) struct StatusLight {
    lights: Sender<LightNote>,
    /// From the start of a slot to its light, nanoseconds.
    light_delay_ns: i64,
    before: Option<Status>,
    counts: DeviceCounts,
    sent: [Option<ReportedFrame>; REMEMBERED],
    next: usize,
    travel_ns: i64,
    /// Upper bounds of the travel of the last frames, nanoseconds, and how many there are.
    arrivals: [i64; ARRIVALS],
    arrived: usize,
}

impl StatusLight {
    /// Sends notes to `lights`. Notes for which there is no room are lost, as a mock's are. Light falls `light_delay_ns`
    /// after the start of its slot.
    pub(crate) fn new(lights: Sender<LightNote>, light_delay_ns: i64) -> Self {
        Self {
            lights,
            light_delay_ns,
            before: None,
            counts: DeviceCounts::default(),
            sent: [None; REMEMBERED],
            next: 0,
            travel_ns: 0,
            arrivals: [0; ARRIVALS],
            arrived: 0,
        }
    }

    /// The counts so far.
    pub(crate) fn counts(&self) -> DeviceCounts {
        self.counts
    }

    /// A new session counts from zero again.
    pub(crate) fn new_session(&mut self) {
        self.before = None;
    }

    /// Frame number `frame` was sent for `slot` at `at`.
    pub(crate) fn sent(&mut self, frame: u32, slot: u64, at: HostTime) {
        self.sent[self.next % REMEMBERED] = Some(ReportedFrame { frame, slot, at });
        self.next = (self.next + 1) % REMEMBERED;
    }

    /// The map of the projector's clock was wrong until now, and with it all that was learned from it.
    pub(crate) fn clock_was_wrong(&mut self) {
        self.sent = [None; REMEMBERED];
        (self.travel_ns, self.arrived) = (0, 0);
    }

    /// How much earlier than the host's estimate a frame must be sent to be lit in its slot, nanoseconds. It rises at
    /// once when a frame that was sent in time is lit late. It falls slowly while none is, and at once when the last
    /// frames are known to have arrived sooner.
    pub(crate) fn travel_ns(&self) -> i64 {
        self.travel_ns
    }

    /// Reads a report. `time` converts slots and instants.
    pub(crate) fn observe(&mut self, status: &Status, time: &LinkTime) {
        let before = self.before.replace(*status);
        if before == Some(*status) {
            return;
        }
        let since = |now: u32, before: Option<u32>| now.wrapping_sub(before.unwrap_or(0));
        let of = |field: fn(&Status) -> u32| since(field(status), before.as_ref().map(field));
        let slots = of(|s| s.slots);
        let (lit, repeated, blank) = (of(|s| s.frames_lit), of(|s| s.slots_repeated), of(|s| s.slots_blank));
        let c = &mut self.counts;
        c.lit += u64::from(lit);
        c.lit_unseen += u64::from(lit.saturating_sub(1));
        c.repeated += u64::from(repeated);
        c.blank += u64::from(blank);
        c.incomplete += u64::from(of(|s| s.frames_incomplete));
        c.too_late += u64::from(of(|s| s.frames_late));
        c.superseded += u64::from(of(|s| s.frames_superseded));
        c.refused += u64::from(of(|s| s.frames_refused));
        c.damaged_packets += u64::from(of(|s| s.header_errors)) + u64::from(of(|s| s.payload_errors));
        let Some(newest) = time.slot_at(status.now) else { return };
        let whole = (before.map(|s| s.last_whole_frame) != Some(status.last_whole_frame))
            .then_some(status.last_whole_frame);
        if let Some(frame) = whole {
            self.arrived(frame, status, time);
        }
        if lit > 0 {
            if let Some(slot) = time.slot_at(status.last_lit_at) {
                self.follow(status.last_lit_frame, slot, time);
            }
        }
        self.notes(status, newest, [slots, lit, repeated], time);
    }

    /// Makes one note for each slot of the report whose result is known, in order.
    fn notes(&mut self, status: &Status, newest: u64, [slots, lit, repeated]: [u32; 3], time: &LinkTime) {
        let lit_slot = if lit > 0 { time.slot_at(status.last_lit_at) } else { None };
        let first = (newest + 1).saturating_sub(u64::from(slots.min(MOST_SLOTS)));
        let mut unseen = lit.saturating_sub(1);
        let mut repeated = repeated;
        for slot in first..=newest {
            let (kind, frame, told) = if Some(slot) == lit_slot {
                (LightKind::Lit, Some(status.last_lit_frame), lit - 1)
            } else if unseen > 0 && lit_slot.is_some_and(|l| slot < l) {
                unseen -= 1;
                continue;
            } else if repeated > 0 {
                repeated -= 1;
                (LightKind::Repeated, None, 0)
            } else {
                (LightKind::Blank, None, 0)
            };
            let start = time.start(slot);
            let event = LightEvent {
                slot,
                frame,
                kind,
                lit_at: start,
                first_photon_at: time.host_of(start).plus_ns(self.light_delay_ns),
                last_photon_at: time.host_of(time.start(slot + 1)).plus_ns(self.light_delay_ns),
            };
            let _ = self.lights.push(LightNote { event, hash: 0, torn: false, wall_ns: 0, unseen: told });
        }
    }

    fn sent_frame(&self, frame: u32) -> Option<ReportedFrame> {
        self.sent.iter().flatten().find(|sent| sent.frame == frame).copied()
    }

    /// `frame` had arrived when the report was made.
    fn arrived(&mut self, frame: u32, status: &Status, time: &LinkTime) {
        let Some(sent) = self.sent_frame(frame) else { return };
        self.arrivals[self.arrived % ARRIVALS] = time.host_of(status.now).ns_since(sent.at).max(0);
        self.arrived += 1;
        if self.arrived >= ARRIVALS {
            let longest = self.arrivals.iter().copied().max().unwrap_or(LONGEST_TRAVEL_NS);
            self.travel_ns = self.travel_ns.min(longest);
        }
    }

    /// `frame` was lit in `lit_slot`.
    fn follow(&mut self, frame: u32, lit_slot: u64, time: &LinkTime) {
        let Some(sent) = self.sent_frame(frame) else { return };
        if lit_slot <= sent.slot {
            self.travel_ns -= self.travel_ns / 1024;
            return;
        }
        // It had not arrived when the slot before the one in which it was lit began. That tells nothing about the
        // travel of a frame that the host itself sent too late.
        let (missed_at, lit_at) = (time.host_of_slot(lit_slot - 1), time.host_of_slot(lit_slot));
        let at_least_ns = missed_at.ns_since(sent.at);
        if at_least_ns >= 0 {
            let between_ns = at_least_ns + lit_at.ns_since(missed_at) / 2;
            self.travel_ns = self.travel_ns.max(between_ns).min(LONGEST_TRAVEL_NS);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::link::{DeviceMessage, MessageType, SlotClock};
    use dpm_device::time::{DeviceTicks, FrameRate};
    use dpm_handoff::channel::{channel, Receiver};
    use dpm_handoff::wake::WaitPolicy;

    /// Slots of a millisecond on a microsecond clock that began with the host's clock. The run's slot 100 is the
    /// clock's slot 0.
    fn time() -> LinkTime {
        let rate = FrameRate::new(1000, 1).unwrap();
        let clock = SlotClock::new(DeviceTicks(0), 1_000_000, rate).unwrap();
        LinkTime { clock, first: 100, anchor: (DeviceTicks(0), HostTime(0)), bound_ns: 0 }
    }

    fn status(now: u64, [lit, repeated, blank]: [u32; 3], last: (u32, u64)) -> Status {
        let parsed = DeviceMessage::parse(MessageType::Status, &[0; 96]).unwrap();
        let DeviceMessage::Status(zero) = parsed else { panic!("a STATUS of zeros") };
        Status {
            now: DeviceTicks(now),
            slots: lit + repeated + blank,
            frames_lit: lit,
            slots_repeated: repeated,
            slots_blank: blank,
            last_lit_frame: last.0,
            last_lit_at: DeviceTicks(last.1),
            ..zero
        }
    }

    /// A reader of reports, and the receiver of its notes.
    struct StatusReader(StatusLight, Receiver<LightNote>);

    fn reader() -> StatusReader {
        let (lights, notes) = channel(4096, WaitPolicy::Park);
        StatusReader(StatusLight::new(lights, 0), notes)
    }

    fn told(
        StatusReader(light, notes): &mut StatusReader,
        s: &Status,
    ) -> Vec<(u64, LightKind, Option<u32>, u32)> {
        light.observe(s, &time());
        std::iter::from_fn(|| notes.try_pop())
            .map(|n| (n.event.slot, n.event.kind, n.event.frame, n.unseen))
            .collect()
    }

    #[test]
    fn a_report_a_slot_tells_everything() {
        use LightKind::{Blank, Lit, Repeated};
        let mut light = reader();
        assert_eq!(told(&mut light, &status(5_100, [1, 0, 0], (7, 5_000))), [(105, Lit, Some(7), 0)]);
        assert_eq!(told(&mut light, &status(6_100, [1, 1, 0], (7, 5_000))), [(106, Repeated, None, 0)]);
        assert_eq!(told(&mut light, &status(7_100, [1, 1, 1], (7, 5_000))), [(107, Blank, None, 0)]);
        // The same report again has no news.
        assert_eq!(told(&mut light, &status(7_100, [1, 1, 1], (7, 5_000))), []);
        light.0.observe(&status(8_100, [2, 1, 1], (9, 8_000)), &time());
        let event = light.1.try_pop().unwrap().event;
        assert_eq!((event.first_photon_at, event.last_photon_at), (HostTime(8_000_000), HostTime(9_000_000)));
    }

    #[test]
    fn a_merged_report_is_told_as_far_as_it_goes() {
        use LightKind::{Lit, Repeated};
        let mut light = reader();
        // Slots 1 to 5: three were lit, the last of them in slot 4, and two repeated.
        let notes = told(&mut light, &status(5_900, [3, 2, 0], (12, 4_000)));
        assert_eq!(notes.iter().filter(|n| n.1 == Lit).collect::<Vec<_>>(), [&(104, Lit, Some(12), 2)]);
        assert_eq!(notes.iter().filter(|n| n.1 == Repeated).count(), 2);
        assert_eq!((light.0.counts().lit, light.0.counts().lit_unseen, light.0.counts().repeated), (3, 2, 2));
        // A new session begins at zero.
        light.0.new_session();
        told(&mut light, &status(1_100, [1, 0, 0], (13, 1_000)));
        assert_eq!((light.0.counts().lit, light.0.counts().lit_unseen), (4, 2));
        // Counters that wrapped, and a silence of a day: the work is bounded.
        told(&mut light, &status(86_400_000_000, [u32::MAX, 0, 0], (14, 86_400_000_000)));
        assert_eq!(light.0.counts().lit, 4 + u64::from(u32::MAX - 1));
    }

    /// A frame that was sent at `sent_us` for `slot` and lit in `lit_slot`, with a report in the middle of that slot.
    fn lit_in(reader: &mut StatusReader, k: u32, sent_us: i64, slot: u64, lit_slot: u64) {
        let at = (lit_slot - 100) * 1_000;
        reader.0.sent(k, slot, HostTime(sent_us * 1_000));
        let report = Status { last_whole_frame: k, ..status(at + 500, [k, 0, 0], (k, at)) };
        told(reader, &report);
    }

    #[test]
    fn travel_rises_with_frames_that_are_lit_late_although_they_were_sent_in_time() {
        let mut light = reader();
        // Sent 200 us before slot 105 and lit in slot 108: it had not arrived 2.2 ms later.
        lit_in(&mut light, 1, 4_800, 105, 108);
        assert_eq!(light.0.travel_ns(), 2_700_000);
        lit_in(&mut light, 2, 6_000, 109, 109);
        assert_eq!(light.0.travel_ns(), 2_700_000 - 2_700_000 / 1024);
        // A frame that the host sent after its slot had begun tells nothing.
        let before = light.0.travel_ns();
        lit_in(&mut light, 3, 9_900, 105, 110);
        assert_eq!(light.0.travel_ns(), before);
        lit_in(&mut light, 4, 1_000, 112, 2_000);
        assert_eq!(light.0.travel_ns(), LONGEST_TRAVEL_NS);
    }

    /// Found by the simulator: after a slow cable, or a machine that was suspended for 75 ms, frames left 150 ms early
    /// for a minute, so that their poses were too old and everything was dark.
    #[test]
    fn travel_is_forgotten_when_frames_arrive_sooner_or_the_clock_was_wrong() {
        let mut light = reader();
        lit_in(&mut light, 1, 4_800, 105, 305);
        assert!(light.0.travel_ns() > 190_000_000);
        for k in 0..ARRIVALS as u64 {
            lit_in(&mut light, 2 + k as u32, 205_900 + 1_000 * k as i64, 306 + k, 306 + k);
        }
        assert!(light.0.travel_ns() <= 1_600_000, "{}", light.0.travel_ns());
        lit_in(&mut light, 90, 220_000, 330, 430);
        assert!(light.0.travel_ns() > 90_000_000);
        light.0.clock_was_wrong();
        assert_eq!(light.0.travel_ns(), 0);
    }
}
