//! SHIFT: slots that begin earlier or later from one slot on.

use super::*;
use crate::link::{HostMessage, SlotShift};

const SLOT_NS: i64 = 1_055_966;
const PART_NS: i64 = SLOT_NS / 64;

fn shifting() -> FirmwareConfig {
    FirmwareConfig { shifts_slots: true, ..FirmwareConfig::new(raster()) }
}

impl Rig<Direct<ProjectorFirmware>> {
    fn wants_shifts(mut self) -> Self {
        self.link.want_shifts();
        self.stream();
        self
    }

    /// To the start of the next slot by the host's own account; sends a frame for the slot after next.
    fn shifted_step(&mut self, id: u64) -> SendOutcome {
        self.slot += 1;
        self.now = HostTime(self.link.slots().unwrap().start(self.slot).0 as i64);
        self.poll().expect("poll");
        let (target, dark_from) = self.times(self.slot + 2);
        self.link.send_frame(self.now, id, target, dark_from, &planes(id), &mut self.cable)
    }

    fn shift(&mut self, slots_ahead: u64, by_ns: i64) -> bool {
        let Self { link, cable, now, slot, .. } = self;
        link.shift_slots(*now, *slot + slots_ahead, by_ns, cable).expect("the cable has room")
    }

    fn say_shift(&mut self, shift: SlotShift) {
        let mut payload = [0u8; crate::link::MAX_CONTROL_BYTES];
        let (kind, n) = HostMessage::Shift(shift).write(&mut payload);
        let session = self.cable.device().core.session;
        let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
        self.cable.send(self.now, Lane::Control, &[packet]).expect("the cable has room");
    }
}

/// However often slots are shifted: each has its own frame, and none is longer or shorter than by a 64th.
#[test]
fn every_slot_is_lit_while_slots_are_shifted() {
    let mut rig = clean(settings(), shifting()).wants_shifts();
    let (mut before, mut shifts, mut lit) = (None, 0, 0);
    for id in 100..700u64 {
        assert_eq!(rig.shifted_step(id), SendOutcome::Sent);
        let by_ns = if id % 100 < 70 { PART_NS } else { -PART_NS };
        shifts += i64::from(rig.shift(1 + id % 5, by_ns)) * by_ns.signum();
        let slots = rig.link.slots().unwrap();
        while let Some(event) = rig.cable.device_mut().next_light() {
            let Some(frame) = event.frame else { continue };
            assert_eq!(event.kind, LightKind::Lit);
            let first = event.first_photon_at;
            if slots.shift().is_none_or(|shift| event.slot + 1 >= shift.slot) {
                assert_eq!(first.0 as u64, slots.start(event.slot).0, "host and device agree");
            }
            if let Some((slot, at, of)) = before.replace((event.slot, first, frame)) {
                assert_eq!((event.slot, frame), (slot + 1, of + 1), "each slot has its own frame");
                assert!((first.ns_since(at) - SLOT_NS).abs() <= PART_NS + 1, "{}", first.ns_since(at));
            }
            lit += 1;
        }
    }
    let s = rig.cable.device().status();
    assert_eq!((lit, s.slots_repeated, s.frames_late, s.packets_ignored), (598, 0, 0, 0));
    assert!(shifts > 10, "{shifts}");
    let moved = rig.link.slots().unwrap().epoch_of(u64::MAX).0 as i64;
    assert!((moved - shifts * PART_NS).abs() <= 600, "{moved}");
    rig.cable.device().check_laws();
}

/// A SHIFT that never arrives is repeated; until then every frame is lit in its slot all the same.
#[test]
fn a_lost_shift_is_repeated() {
    let mut rig = clean(settings(), shifting()).wants_shifts();
    for id in 100..400u64 {
        assert_eq!(rig.shifted_step(id), SendOutcome::Sent);
        if id == 150 || id == 250 {
            let by_ns = if id == 150 { PART_NS } else { -PART_NS };
            let mut nowhere = Direct::new(ProjectorFirmware::new(shifting()));
            let slot = rig.slot + 2;
            assert!(rig.link.shift_slots(rig.now, slot, by_ns, &mut nowhere).expect("sent into the void"));
        }
        assert!(!(153..=165).contains(&id) || !rig.link.may_shift(), "it is not confirmed");
    }
    assert!(rig.link.may_shift());
    let s = rig.cable.device().status();
    assert_eq!((s.frames_lit, s.slots_repeated, s.frames_late, s.frames_superseded), (298, 0, 0, 0));
    let (host, device) = (rig.link.slots().unwrap(), rig.cable.device().core.config.unwrap().1);
    assert_eq!((host.start(10_000), host.epoch_of(u64::MAX).0), (device.start(10_000), 0));
}

/// Before its first frame a run may take any phase at once; in light no slot changes by more than a 64th.
#[test]
fn a_device_in_light_refuses_great_shifts() {
    let mut rig = clean(settings(), shifting()).wants_shifts();
    assert!(rig.shift(3, SLOT_NS - 1));
    for _ in 0..10 {
        rig.slot += 1;
        rig.now = HostTime(rig.link.slots().unwrap().start(rig.slot).0 as i64);
        rig.poll().expect("poll");
    }
    assert!(rig.link.may_shift(), "confirmed");
    for id in 100..150u64 {
        assert_eq!(rig.shifted_step(id), SendOutcome::Sent);
    }
    let slots = rig.link.slots().unwrap();
    let ignored = |rig: &Rig<Direct<ProjectorFirmware>>| rig.cable.device().status().packets_ignored;
    assert_eq!((slots.epoch_of(u64::MAX).0 as i64, ignored(&rig)), (SLOT_NS - 1, 0));
    for by in [PART_NS + 1, -PART_NS - 1, i64::MIN / 4] {
        let epoch = DeviceTicks(slots.epoch_of(u64::MAX).0.saturating_add_signed(by));
        let before = ignored(&rig);
        rig.say_shift(SlotShift { slot: rig.slot + 2, epoch });
        assert_eq!(ignored(&rig), before + 1, "{by}");
        assert_eq!(rig.cable.device().core.config.unwrap().1.start(10_000), slots.start(10_000));
    }
}

/// A host that is refused again and again returns to the slots that the device has.
#[test]
fn a_host_that_is_refused_takes_the_devices_slots() {
    let mut rig = clean(settings(), shifting()).wants_shifts();
    for id in 100..120u64 {
        assert_eq!(rig.shifted_step(id), SendOutcome::Sent);
    }
    // A device that ignores what it has offered.
    rig.cable.device_mut().core.config.as_mut().expect("configured").0.shifts = false;
    assert!(rig.shift(2, PART_NS));
    for id in 120..900u64 {
        assert_eq!(rig.shifted_step(id), SendOutcome::Sent);
    }
    assert!(!rig.link.shifts_slots() && !rig.link.may_shift());
    assert_eq!(rig.link.slots().unwrap().epoch_of(u64::MAX), DeviceTicks(0));
    assert_eq!(rig.cable.device().status().slots_repeated, 0);
}

/// Nothing is shifted on a device that does not offer it, or whose planes would become too short.
#[test]
fn slots_that_cannot_be_shorter_are_not_shifted() {
    let long = FirmwareConfig { min_plane_ns: 43_900, ..shifting() };
    for setup in [long, FirmwareConfig::new(raster())] {
        let mut rig = clean(settings(), setup).wants_shifts();
        assert!(!rig.link.may_shift() && !rig.shift(2, PART_NS));
        for id in 100..130u64 {
            assert_eq!(rig.shifted_step(id), SendOutcome::Sent);
        }
        let epoch = DeviceTicks(100);
        rig.say_shift(SlotShift { slot: rig.slot + 2, epoch });
        let s = rig.cable.device().status();
        assert_eq!((s.packets_ignored, s.slots_repeated), (1, 0));
        assert_eq!(s.timing.expect("it was asked for").epoch, 0);
    }
}

/// The SHIFT printed in docs/PROTOCOL.md, byte for byte, shifts the slots of the panel printed there.
#[test]
fn the_documents_shift_shifts_the_documents_slots() {
    let packets = packets_of_the_document();
    let [hello, config, arm, .., shift] = &packets[..] else { panic!("{} packets", packets.len()) };
    let mut asks = config[32..32 + 41].to_vec();
    asks[19] = 8 + 16;
    let config = Packet::new(Header::control(MessageType::Config, 42, 0), &asks).to_vec();
    let mut mock = ProjectorFirmware::new(FirmwareConfig {
        shifts_slots: true,
        ..FirmwareConfig::new(Raster::new(16, 1).unwrap())
    });
    for control in [hello, &config, arm, shift] {
        mock.receive(HostTime(0), Lane::Control, control);
    }
    let slots = mock.core.config.expect("configured").1;
    assert_eq!([9, 10].map(|k| slots.start(k).0), [9_503_695, 10_569_662]);
}
