//! `dark from`: a frame's light ends at its own tick, whatever the host does or fails to do.
//!
//! Found in use, R1: a host whose stages hung continued to feed the watchdog, and the last frame stayed lit without
//! limit. R5: late frames were lit however old they were.

use super::*;

/// Sends frame `id` for `slot` now, with `dark_from` as the end of its light.
fn send<T: Transport>(rig: &mut Rig<T>, id: u64, slot: u64, dark_from: DeviceTicks) {
    rig.poll().unwrap();
    let target = rig.link.slots().unwrap().start(slot);
    let sent = rig.link.send_frame(rig.now, id, target, dark_from, &planes(id), &mut rig.cable);
    assert_eq!(sent, SendOutcome::Sent, "frame {id}");
}

/// Advances the mock to `tick` (its clock is ideal) while the host still talks, as one does whose renderer hangs.
fn live(rig: &mut Rig<Direct<ProjectorFirmware>>, tick: u64) {
    while rig.now.0 + 1_000_000 < tick as i64 {
        rig.now = rig.now.plus_ns(1_000_000);
        rig.poll().unwrap();
    }
    rig.now = HostTime(tick as i64);
    rig.cable.device_mut().advance_to(rig.now);
    rig.cable.device().check_laws();
}

fn armed() -> (Rig<Direct<ProjectorFirmware>>, crate::link::SlotClock) {
    let mut rig = clean(LinkSettings { late_slots: 100, ..settings() }, FirmwareConfig::new(raster()));
    rig.stream();
    let slots = rig.link.slots().unwrap();
    (rig, slots)
}

#[test]
fn light_ends_at_the_tick_and_not_with_the_slot_and_the_next_frame_lights() {
    let (mut rig, slots) = armed();
    let k = rig.slot + 2;
    // In the middle of a slot, and not because of the host, which still talks.
    let dark = DeviceTicks((slots.start(k + 40).0 + slots.start(k + 41).0) / 2);
    send(&mut rig, 1, k, dark);
    live(&mut rig, slots.start(k).0);
    assert!(rig.cable.device().is_lit());
    live(&mut rig, slots.start(k + 40).0);
    let device = rig.cable.device();
    assert_eq!(device.next_due(), Some(HostTime(dark.0 as i64)), "whoever serves it must wake for it");
    live(&mut rig, dark.0 - 1);
    assert!(rig.cable.device().is_lit());
    live(&mut rig, dark.0);
    let device = rig.cable.device();
    assert!(!device.is_lit() && device.lit_frame().is_none() && device.lit_planes().is_none());
    assert_eq!(device.status().state, DeviceState::Armed, "no fault, and no ARM is needed");
    assert!(!device.status().lit);
    // Every later slot is blank and counts as blank.
    let before = device.status();
    live(&mut rig, slots.start(k + 60).0);
    let s = rig.cable.device().status();
    assert_eq!((s.slots_blank - before.slots_blank, s.slots_repeated - before.slots_repeated), (20, 0));
    assert_eq!((s.frames_lit, s.slots_repeated), (1, 40));
    let last = std::iter::from_fn(|| rig.cable.device_mut().next_light());
    let last = last.filter(|e| e.kind != LightKind::Blank).last().unwrap();
    assert_eq!((last.slot, last.last_photon_at), (k + 40, HostTime(dark.0 as i64)));
    send(&mut rig, 2, k + 62, slots.start(k + 70));
    live(&mut rig, slots.start(k + 62).0);
    assert_eq!((rig.cable.device().is_lit(), rig.cable.device().lit_frame()), (true, Some(2)));
}

#[test]
fn a_newer_frame_replaces_it_without_a_gap_and_without_one_the_slot_is_blank() {
    let (mut rig, slots) = armed();
    let k = rig.slot + 2;
    // Both end exactly where a slot begins.
    send(&mut rig, 1, k, slots.start(k + 3));
    send(&mut rig, 2, k + 3, slots.start(k + 5));
    live(&mut rig, slots.start(k + 3).0 - 1);
    assert_eq!(rig.cable.device().lit_frame(), Some(1));
    live(&mut rig, slots.start(k + 3).0);
    assert_eq!((rig.cable.device().is_lit(), rig.cable.device().lit_frame()), (true, Some(2)));
    live(&mut rig, slots.start(k + 5).0 - 1);
    assert!(rig.cable.device().is_lit());
    live(&mut rig, slots.start(k + 5).0);
    assert!(!rig.cable.device().is_lit());
    let s = rig.cable.device().status();
    assert_eq!((s.frames_lit, s.slots_repeated), (2, 3), "{s:?}");
    // A frame whose light ends later than the next frame's: the next frame's end counts.
    send(&mut rig, 3, k + 7, slots.start(k + 100));
    send(&mut rig, 4, k + 8, slots.start(k + 9));
    live(&mut rig, slots.start(k + 8).0);
    assert_eq!(rig.cable.device().lit_frame(), Some(4));
    live(&mut rig, slots.start(k + 9).0);
    assert!(!rig.cable.device().is_lit());
}

#[test]
fn freeze_suspends_it_and_arm_applies_it_again() {
    for over in [false, true] {
        let (mut rig, slots) = armed();
        let k = rig.slot + 2;
        let dark = DeviceTicks(slots.start(k + 10).0 + 12_345);
        send(&mut rig, 1, k, dark);
        live(&mut rig, slots.start(k + 2).0);
        rig.link.command(rig.now, Verb::Freeze, &mut rig.cable).unwrap();
        assert_eq!(rig.cable.device().status().state, DeviceState::Frozen);
        let until = if over { slots.start(k + 25).0 + 5 } else { slots.start(k + 6).0 + 5 };
        live(&mut rig, until);
        assert!(rig.cable.device().is_lit(), "held");
        rig.link.arm(0);
        rig.poll().unwrap();
        assert_eq!(rig.cable.device().is_lit(), !over, "over by now: dark with ARM, not with the next slot");
        live(&mut rig, dark.0.max(until + 1));
        assert!(!rig.cable.device().is_lit());
        assert_eq!(rig.cable.device().status().state, DeviceState::Armed);
    }
}

#[test]
fn freeze_makes_no_light_where_there_is_none_and_black_does_not_bring_back_what_is_over() {
    let (mut rig, slots) = armed();
    let k = rig.slot + 2;
    send(&mut rig, 1, k, slots.start(k + 3));
    live(&mut rig, slots.start(k + 4).0);
    rig.link.command(rig.now, Verb::Freeze, &mut rig.cable).unwrap();
    live(&mut rig, slots.start(k + 9).0);
    assert!(!rig.cable.device().is_lit(), "nothing was lit that could be held");
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
    let k = slots.slot_at(DeviceTicks(rig.now.0 as u64)).unwrap() + 2;
    send(&mut rig, 2, k, slots.start(k + 5));
    live(&mut rig, slots.start(k + 1).0);
    rig.link.command(rig.now, Verb::Black, &mut rig.cable).unwrap();
    live(&mut rig, slots.start(k + 8).0);
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
    let lit_before = rig.cable.device().status().slots_repeated;
    live(&mut rig, slots.start(k + 30).0);
    assert!(!rig.cable.device().is_lit());
    assert_eq!(rig.cable.device().status().slots_repeated, lit_before);
}

#[test]
fn a_late_frame_keeps_its_own_end() {
    let (mut rig, slots) = armed();
    let k = rig.slot + 2;
    live(&mut rig, slots.start(k + 10).0 + 5);
    let before = rig.cable.device().status();
    // Late, and over already; late, and over before the slot in which it could be lit; late, with light left.
    send(&mut rig, 1, k, slots.start(k + 10));
    assert_eq!(rig.cable.device().status().frames_late - before.frames_late, 1);
    send(&mut rig, 2, k, DeviceTicks(slots.start(k + 11).0 - 5));
    live(&mut rig, slots.start(k + 11).0);
    let s = rig.cable.device().status();
    assert_eq!((s.frames_late - before.frames_late, s.frames_lit), (2, 0));
    assert!(!rig.cable.device().is_lit());
    send(&mut rig, 3, k, DeviceTicks(slots.start(k + 12).0 + 500));
    live(&mut rig, slots.start(k + 12).0 + 499);
    assert_eq!((rig.cable.device().is_lit(), rig.cable.device().lit_frame()), (true, Some(3)));
    live(&mut rig, slots.start(k + 12).0 + 500);
    assert!(!rig.cable.device().is_lit());
}

#[test]
fn a_frame_that_ends_before_it_begins_has_a_wrong_field() {
    let (mut rig, slots) = armed();
    let session = rig.cable.device().core.session;
    let k = rig.slot + 4;
    let target_at = slots.start(k);
    let plane_bytes = raster().plane_bytes();
    let mut frame = |frame: u32, dark_from: DeviceTicks| {
        let header = Header { frame, target_at, ..Header::control(MessageType::Plane, session, 0) };
        let bytes = planes(u64::from(frame));
        for (plane, spec) in PlaneSchedule::rgb24().planes().iter().enumerate() {
            let header = Header { plane: plane as u8, led_code: spec.led_code(), ..header };
            let payload = &bytes[plane * plane_bytes..(plane + 1) * plane_bytes];
            rig.cable.send(rig.now, Lane::Data, &[Packet::new(header, payload)]).unwrap();
        }
        let commit = crate::link::Commit {
            sent: (1 << 24) - 1,
            kept: 0,
            base_frame: 0,
            frames_sent: frame,
            dark_from,
        };
        let mut payload = [0; MAX_CONTROL_BYTES];
        let (kind, n) = crate::link::HostMessage::Commit(commit).write(&mut payload);
        let commit = Packet::new(Header { kind, ..header }, &payload[..n]);
        rig.cable.send(rig.now, Lane::Data, &[commit]).unwrap();
        rig.cable.device().check_laws();
        rig.cable.device().status()
    };
    let wrong = frame(1, target_at);
    assert_eq!((wrong.frames_seen, wrong.frames_accounted, wrong.packets_ignored), (1, 0, 1));
    let wrong = frame(2, DeviceTicks(target_at.0 - 1));
    assert_eq!((wrong.frames_seen, wrong.frames_incomplete, wrong.packets_ignored), (2, 1, 2));
    let right = frame(3, DeviceTicks(target_at.0 + 1));
    assert_eq!((right.frames_accounted, right.frames_incomplete, right.packets_ignored), (3, 2, 2));
    live(&mut rig, target_at.0);
    assert!(rig.cable.device().is_lit());
    live(&mut rig, target_at.0 + 1);
    assert!(!rig.cable.device().is_lit());
    // The host's own link never sends such a frame: its light lasts one tick instead.
    send(&mut rig, 4, k + 5, DeviceTicks(0));
    assert_eq!(rig.cable.device().status().packets_ignored, 2);
    live(&mut rig, slots.start(k + 5).0 + 1);
    let s = rig.cable.device().status();
    assert_eq!((s.frames_lit, s.lit), (2, false));
}

/// Found in use, R16 and similar: the device's own events are reported with their own instants, however late they are
/// polled.
#[test]
fn changes_of_light_and_state_carry_their_own_instants() {
    let (mut rig, slots) = armed();
    let k = rig.slot + 2;
    let states: Vec<DeviceState> =
        std::iter::from_fn(|| rig.cable.device_mut().next_change()).map(|change| change.state).collect();
    assert_eq!(states, [DeviceState::Greeted, DeviceState::Configured, DeviceState::Armed]);
    let dark = DeviceTicks(slots.start(k + 3).0 + 777);
    send(&mut rig, 1, k, dark);
    // No poll for a second.
    let heard = rig.now;
    rig.cable.device_mut().advance_to(heard.plus_ns(1_000_000_000));
    let bite = heard.plus_ns(i64::from(WATCHDOG_US) * 1000);
    let mut next = || rig.cable.device_mut().next_change().map(|c| (c.at.0, c.frame, c.state, c.faults));
    assert_eq!(next(), Some((slots.start(k).0 as i64, Some(1), DeviceState::Armed, 0)));
    assert_eq!(next(), Some((dark.0 as i64, None, DeviceState::Armed, 0)));
    assert_eq!(next(), Some((bite.0, None, DeviceState::Faulted, faults::WATCHDOG)));
    assert_eq!(next(), None);
    // The instant of an order is that of its arrival.
    let (mut rig, slots) = armed();
    let k = rig.slot + 2;
    send(&mut rig, 1, k, slots.start(k + 30));
    live(&mut rig, slots.start(k + 4).0 + 4321);
    rig.link.command(rig.now, Verb::Black, &mut rig.cable).unwrap();
    let last = std::iter::from_fn(|| rig.cable.device_mut().next_change()).last().unwrap();
    assert_eq!((last.at, last.frame, last.state), (rig.now, None, DeviceState::Black));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// For any frames, late or early, and any orders: light that is not frozen always ends by its own end, on a clock
    /// that is not the host's; and between events nothing changes that `next_due` did not announce.
    #[test]
    fn no_light_outlives_its_frame(
        steps in prop::collection::vec((0u8..12, 0u64..6, 1u64..9_000_000, 1i64..4_000_000), 1..120),
        skew_ppb in -100_000i32..100_000,
        late_slots in 0u8..6,
    ) {
        let clock = DeviceClock { tick_hz: 27_000_000, skew_ppb, ..DeviceClock::IDEAL };
        let s = LinkSettings { late_slots, watchdog_us: 10_000_000, ..settings() };
        let mut rig = clean(s, FirmwareConfig { clock, ..FirmwareConfig::new(raster()) });
        rig.stream();
        let slots = rig.link.slots().unwrap();
        let mut ends = std::collections::HashMap::new();
        let mut told = false;
        for (id, (action, ahead, keep, wait)) in steps.into_iter().enumerate() {
            let _ = rig.poll();
            match action {
                0 => drop(rig.link.command(rig.now, Verb::Freeze, &mut rig.cable)),
                1 => drop(rig.link.command(rig.now, Verb::Black, &mut rig.cable)),
                2 | 3 => rig.link.arm(0),
                _ => {
                    let now = clock.ticks_at(rig.now);
                    let slot = (slots.slot_at(now).unwrap() + ahead).saturating_sub(2);
                    let end = DeviceTicks(slots.start(slot).0 + 1 + keep * 27 / 1000);
                    ends.insert(id as u32, end);
                    rig.link.send_frame(rig.now, id as u64, slots.start(slot), end, &planes(id as u64), &mut rig.cable);
                }
            }
            let until = rig.now.plus_ns(wait);
            while rig.now < until {
                let device = rig.cable.device_mut();
                let due = device.next_due().unwrap_or(until).min(until);
                let (lit, frame) = (device.is_lit(), device.lit_frame());
                if due.ns_since(rig.now) > 1 {
                    device.advance_to(due.plus_ns(-1));
                    prop_assert_eq!((device.is_lit(), device.lit_frame()), (lit, frame));
                }
                device.advance_to(due);
                device.check_laws();
                let s = device.status();
                if s.lit && s.state != DeviceState::Frozen {
                    let end = ends[&device.lit_frame().unwrap()];
                    prop_assert!(clock.ticks_at(due) < end, "lit at {:?}, over since {end:?}", clock.ticks_at(due));
                }
                while let Some(change) = device.next_change() {
                    told = change.frame.is_some();
                    prop_assert!(change.at <= due);
                }
                prop_assert_eq!(told, s.lit);
                rig.now = due.max(rig.now.plus_ns(1));
            }
        }
    }
}
