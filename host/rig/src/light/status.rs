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
use dpm_handoff::channel::Sender;

/// Maximum number of slots of one report for which single notes are made: a second of silence at 1 kHz.
const MOST_SLOTS: u32 = 1024;
/// Frames whose slot is remembered until their light is reported.
const REMEMBERED: usize = 64;
/// The longest travel of a frame that is considered plausible, nanoseconds.
const LONGEST_TRAVEL_NS: i64 = 500_000_000;

/// Reads the reports of one session after the other.
#[derive(Debug)]
pub(crate) struct StatusLight {
    lights: Sender<LightNote>,
    before: Option<Status>,
    counts: DeviceCounts,
    planned: [(u32, u64); REMEMBERED],
    next: usize,
    travel_ns: i64,
}

impl StatusLight {
    /// Sends notes to `lights`. Notes for which there is no room are lost, as a mock's are.
    pub(crate) fn new(lights: Sender<LightNote>) -> Self {
        Self {
            lights,
            before: None,
            counts: DeviceCounts::default(),
            planned: [(0, u64::MAX); REMEMBERED],
            next: 0,
            travel_ns: 0,
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

    /// Frame number `frame` was sent for `slot`.
    pub(crate) fn sent(&mut self, frame: u32, slot: u64) {
        self.planned[self.next % REMEMBERED] = (frame, slot);
        self.next = (self.next + 1) % REMEMBERED;
    }

    /// How much earlier than the host's estimate a frame must be sent to be lit in its slot, nanoseconds. It rises at
    /// once when frames are lit late, and falls slowly while they are not.
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
                first_photon_at: time.host_of(start),
                last_photon_at: time.host_of(time.start(slot + 1)),
            };
            let _ = self.lights.push(LightNote { event, hash: 0, torn: false, wall_ns: 0, unseen: told });
        }
    }

    fn follow(&mut self, frame: u32, lit_slot: u64, time: &LinkTime) {
        let Some(&(_, planned)) = self.planned.iter().find(|p| p.0 == frame && p.1 != u64::MAX) else {
            return;
        };
        let late_ns = time.host_of_slot(lit_slot).ns_since(time.host_of_slot(planned)).max(0);
        self.travel_ns = if late_ns > 0 {
            // Half of it, because frames that are already on their way are late by the same amount.
            (self.travel_ns + late_ns / 2).min(LONGEST_TRAVEL_NS)
        } else {
            self.travel_ns - self.travel_ns / 1024
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::link::{DeviceMessage, MessageType, SlotClock};
    use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
    use dpm_handoff::channel::{channel, Receiver};
    use dpm_handoff::wake::WaitPolicy;

    /// Slots of a millisecond on a microsecond clock that began with the host's clock. The run's slot 100 is the
    /// clock's slot 0.
    fn time() -> LinkTime {
        let rate = FrameRate::new(1000, 1).unwrap();
        let clock = SlotClock::new(DeviceTicks(0), 1_000_000, rate).unwrap();
        LinkTime { clock, first: 100, anchor: (DeviceTicks(0), HostTime(0)) }
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
    struct Reader(StatusLight, Receiver<LightNote>);

    fn reader() -> Reader {
        let (lights, notes) = channel(4096, WaitPolicy::Park);
        Reader(StatusLight::new(lights), notes)
    }

    fn told(Reader(light, notes): &mut Reader, s: &Status) -> Vec<(u64, LightKind, Option<u32>, u32)> {
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

    #[test]
    fn travel_follows_late_frames_and_forgets_slowly() {
        let mut light = reader();
        light.0.sent(7, 101);
        told(&mut light, &status(5_100, [1, 0, 0], (7, 5_000)));
        assert_eq!(light.0.travel_ns(), 2_000_000, "half of four slots");
        light.0.sent(8, 106);
        told(&mut light, &status(6_100, [2, 0, 0], (8, 6_000)));
        assert_eq!(light.0.travel_ns(), 2_000_000 - 2_000_000 / 1024);
        for k in 0..2000u32 {
            light.0.sent(9 + k, 0);
            told(&mut light, &status(7_100 + u64::from(k), [3 + k, 0, 0], (9 + k, 7_000)));
        }
        assert_eq!(light.0.travel_ns(), LONGEST_TRAVEL_NS);
    }
}
