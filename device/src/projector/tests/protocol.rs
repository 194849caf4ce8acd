//! Statements of docs/PROTOCOL.md where a reader of its first version had to guess (found in use, C, the eleven
//! questions).

use super::*;
use crate::link::{Commit, Echo, HostHello, HostMessage};

/// A packet of a host.
fn packet(session: u32, message: &HostMessage) -> Vec<u8> {
    let mut payload = [0; MAX_CONTROL_BYTES];
    let (kind, n) = message.write(&mut payload);
    Packet::new(Header::control(kind, session, 0), &payload[..n]).to_vec()
}

fn hello(session: u32, version: u16) -> Vec<u8> {
    let hello = HostHello { version_min: version, version_max: version, codecs: 1 };
    packet(session, &HostMessage::Hello(hello))
}

/// Sessions and messages of all the device's replies.
fn answers(mock: &mut ProjectorFirmware, now: HostTime) -> Vec<(u32, DeviceMessage)> {
    let mut all = Vec::new();
    mock.replies(now, &mut |_, bytes| {
        let header = Header::decode(bytes[..32].try_into().unwrap()).unwrap();
        let payload = &bytes[32..32 + header.payload_bytes as usize];
        all.push((header.session, DeviceMessage::parse(header.kind, payload).unwrap()));
    });
    all
}

/// A frame as the host of `rig` would send it, packet by packet, with planes left out.
fn frame(
    session: u32,
    id: u32,
    times: (DeviceTicks, DeviceTicks),
    count: u32,
    without: usize,
) -> Vec<Vec<u8>> {
    let (target_at, dark_from) = times;
    let header = Header { frame: id, target_at, ..Header::control(MessageType::Plane, session, 0) };
    let (bytes, n) = (planes(u64::from(id)), raster().plane_bytes());
    let mut all = Vec::new();
    for (k, spec) in PlaneSchedule::rgb24().planes().iter().enumerate().skip(without) {
        let header = Header { plane: k as u8, led_code: spec.led_code(), ..header };
        all.push(Packet::new(header, &bytes[k * n..(k + 1) * n]).to_vec());
    }
    let commit = Commit { sent: (1 << 24) - 1, kept: 0, base_frame: 0, frames_sent: count, dark_from };
    let mut payload = [0; MAX_CONTROL_BYTES];
    let (kind, n) = HostMessage::Commit(commit).write(&mut payload);
    all.push(Packet::new(Header { kind, ..header }, &payload[..n]).to_vec());
    all
}

fn armed() -> (Rig<Direct<ProjectorFirmware>>, u32) {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    let session = rig.cable.device().core.session;
    (rig, session)
}

/// Question 1, found in use, R3 and C1: a HELLO of the open session changes nothing; one of another session restarts
/// everything.
#[test]
fn a_hello_of_the_present_session_is_only_answered() {
    let (mut rig, session) = armed();
    for id in 1000..1010 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
    }
    let now = rig.now;
    let mock = rig.cable.device_mut();
    let before = mock.status();
    mock.receive(now, Lane::Control, &hello(session, 2));
    let after = mock.status();
    assert!(mock.is_lit());
    assert_eq!((after.state, after.frames_seen), (DeviceState::Armed, before.frames_seen));
    let said = answers(mock, now);
    assert!(matches!(said[0], (s, DeviceMessage::Hello(_)) if s == session));
    // Its old frame numbers are still over.
    for bytes in frame(session, 3, (DeviceTicks(now.0 as u64 + 5_000_000), DeviceTicks(u64::MAX)), 11, 0) {
        mock.receive(now, Lane::Data, &bytes);
    }
    assert_eq!(mock.status().frames_seen, before.frames_seen);
    // Another number: dark, and all counters of the session at 0, including those of its packets.
    mock.receive(now, Lane::Control, &hello(session ^ 5, 2));
    let s = mock.status();
    assert!(!mock.is_lit());
    assert_eq!(
        (s.state, s.slots, s.frames_seen, s.packets, s.packets_ignored),
        (DeviceState::Greeted, 0, 0, 0, 0)
    );
    // Question 6: any frame number begins.
    let mut rig = Rig { link: HostLink::new(settings()), cable: rig.cable, now, slot: 0 };
    rig.stream();
    for id in 2..8 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
    }
    assert_eq!(rig.cable.device().status().frames_seen, 6);
    assert!(rig.cable.device().is_lit());
}

/// Question 7: the session number of the device's own packets.
#[test]
fn a_refused_hello_is_answered_under_its_own_number() {
    let mut mock = ProjectorFirmware::new(FirmwareConfig::new(raster()));
    for (open, asked) in [(0, 77), (9, 78)] {
        if open != 0 {
            mock.receive(HostTime(1), Lane::Control, &hello(open, 2));
            answers(&mut mock, HostTime(1));
        }
        mock.receive(HostTime(2), Lane::Control, &hello(asked, 1));
        let said = answers(&mut mock, HostTime(2));
        assert!(matches!(said[0], (s, DeviceMessage::Hello(h)) if s == asked && h.version == 2), "{said:?}");
        assert!(
            matches!(said[1], (s, DeviceMessage::Fault(f)) if s == asked && f.code == FaultCode::Version && f.detail == 2),
            "{said:?}"
        );
        assert_eq!(mock.core.session, open, "what is open goes on");
    }
    let last = mock.status();
    assert_eq!(last.last_plane, 0);
}

/// Question 2: a whole frame is the base of the next one, whatever becomes of it.
#[test]
fn a_whole_frame_is_the_base_of_the_next_even_if_it_is_never_lit() {
    let s = LinkSettings { codecs: crate::link::Codec::ALL, ..settings() };
    let mut rig = clean(s, FirmwareConfig::new(raster()));
    rig.stream();
    rig.idle(20);
    let picture = planes(7);
    assert_eq!(rig.step_with(1, &picture), SendOutcome::Sent);
    rig.poll().unwrap();
    // Late, and too far ahead: neither is ever lit. The frames after them keep all planes of the one before.
    let slots = rig.link.slots().unwrap();
    let (late, far) = (slots.start(rig.slot - 5), slots.start(rig.slot + 947 * 5));
    for (id, target) in [(2, late), (3, far)] {
        let dark_from = DeviceTicks(u64::MAX);
        let sent = rig.link.send_frame(rig.now, id, target, dark_from, &picture, &mut rig.cable);
        assert_eq!(sent, SendOutcome::Sent);
        assert_eq!(rig.cable.device().status().last_whole_frame, id as u32);
    }
    let s = rig.cable.device().status();
    assert_eq!((s.frames_late, s.frames_refused, s.frames_incomplete), (1, 1, 0));
    let commit = crate::link::packet_bytes(crate::link::COMMIT_BYTES) as u64;
    let before = rig.link.counters().frame_bytes_sent;
    let (target, dark_from) = rig.times(rig.slot + 3);
    // A refusal makes the host send a key frame; without another poll it does not know yet.
    rig.link.send_frame(rig.now, 4, target, dark_from, &picture, &mut rig.cable);
    assert_eq!(rig.link.counters().frame_bytes_sent - before, commit, "every plane is kept");
    rig.idle(5);
    assert_eq!(rig.cable.device().lit_planes(), Some(&picture[..]));
}

/// Questions 3 and 4: what STOP drops and what continues; which slots count.
#[test]
fn stop_forgets_frames_and_keeps_counters_and_slots_count_while_armed_black_or_frozen() {
    let (mut rig, session) = armed();
    for id in 1..=10 {
        rig.step(id);
    }
    let kinds = |s: &Status| (s.frames_lit, s.slots_repeated, s.slots_blank);
    for (verb, repeated, blank) in [(Verb::Black, 0, 6), (Verb::Freeze, 6, 0)] {
        let before = rig.cable.device().status();
        rig.link.command(rig.now, verb, &mut rig.cable).unwrap();
        rig.idle(6);
        let after = rig.cable.device().status();
        assert_eq!(
            kinds(&after),
            (before.frames_lit, before.slots_repeated + repeated, before.slots_blank + blank),
            "{verb:?}"
        );
        assert_eq!(after.slots - before.slots, 6);
        // Two frames were waiting for their slots: used up.
        assert_eq!(after.buffers_free, 4);
        rig.link.arm(0);
        rig.until(LinkState::Streaming);
        rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0);
        for id in 0..6 {
            rig.step(rig.link.next_frame_id() + id);
        }
    }
    let before = rig.cable.device().status();
    rig.link.command(rig.now, Verb::Stop, &mut rig.cable).unwrap();
    let stopped = rig.cable.device().status();
    assert_eq!((stopped.state, stopped.buffers_free), (DeviceState::Configured, 4));
    assert_eq!(stopped.frames_refused - before.frames_refused, 2, "those that waited");
    assert_eq!((stopped.frames_seen, stopped.slots), (before.frames_seen, before.slots));
    assert_eq!(stopped.frame_limit, stopped.frames_accounted, "no credit while frames would be refused");
    rig.idle(20);
    assert_eq!(rig.cable.device().status().slots, stopped.slots, "no slot counts");
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
    rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0);
    // No frame is left to be lit, and the counters continue.
    rig.idle(3);
    let again = rig.cable.device().status();
    assert!(!again.lit && again.slots > stopped.slots && again.frames_lit == stopped.frames_lit);
    assert_eq!(rig.cable.device().core.session, session);
    rig.cable.device().check_laws();
}

/// Question 5: N waiting frames, one being received, one lit and a base that is neither: N + 3 in all.
#[test]
fn free_buffers_are_those_of_waiting_frames() {
    let (mut rig, session) = armed();
    let k = rig.slot + 2;
    let slots = rig.link.slots().unwrap();
    let far = |k| (slots.start(k), slots.dark_from(k, LONG_NS));
    let send = |rig: &mut Rig<Direct<ProjectorFirmware>>, id: u32, slot: u64, without: usize| {
        for bytes in frame(session, id, far(slot), id, without) {
            let now = rig.now;
            rig.cable.device_mut().receive(now, Lane::Data, &bytes);
        }
    };
    send(&mut rig, 1, k, 0);
    rig.now = HostTime(slots.start(k).0 as i64);
    rig.poll().unwrap();
    assert_eq!(rig.cable.device().lit_frame(), Some(1));
    assert_eq!(rig.cable.device().status().buffers_free, 4, "the one that is lit takes none");
    for id in 2..=5 {
        send(&mut rig, id, k + 50, 0);
    }
    assert_eq!(rig.cable.device().status().buffers_free, 0);
    // One more, half received: it takes no buffer, and waiting and lit frames are unchanged.
    let half = frame(session, 6, far(k + 51), 6, 0);
    for bytes in &half[..12] {
        let now = rig.now;
        rig.cable.device_mut().receive(now, Lane::Data, bytes);
    }
    assert_eq!(rig.cable.device().lit_planes().unwrap(), planes(1));
    rig.now = HostTime(slots.start(k + 50).0 as i64);
    rig.cable.device_mut().advance_to(rig.now);
    assert_eq!(rig.cable.device().lit_frame(), None, "the watchdog, as no packet came for 50 slots");
}

/// Question 9: a target may be any tick of its slot; the frame is lit when the slot begins.
#[test]
fn a_target_anywhere_in_a_slot_means_that_slot() {
    for offset in [0, 1, 500_000, 1_055_000] {
        let (mut rig, session) = armed();
        let slots = rig.link.slots().unwrap();
        let k = rig.slot + 3;
        let times = (DeviceTicks(slots.start(k).0 + offset), slots.dark_from(k, 0));
        for bytes in frame(session, 1, times, 1, 0) {
            let now = rig.now;
            rig.cable.device_mut().receive(now, Lane::Data, &bytes);
        }
        let mock = rig.cable.device_mut();
        mock.advance_to(HostTime(slots.start(k).0 as i64 - 1));
        assert!(!mock.is_lit());
        mock.advance_to(HostTime(slots.start(k).0 as i64));
        assert!(mock.is_lit(), "offset {offset}");
    }
}

/// Found in the simulated world: on a line that echoes, a device hears its own answers. They are no word of a host.
#[test]
fn its_own_answers_do_not_feed_the_watchdog_and_are_not_answered() {
    for is_answer in [false, true] {
        let (mut rig, session) = armed();
        rig.step(1);
        let heard = rig.now;
        let at = DeviceTicks(u64::from(is_answer) * 77);
        let echo = Echo { host_sent_ns: 5, device_received: at, device_sent: at };
        let echo = packet(session, &HostMessage::Echo(echo));
        let mut answered = 0;
        for ms in 1..=60 {
            let now = heard.plus_ns(ms * 1_000_000);
            rig.cable.device_mut().receive(now, Lane::Control, &echo);
            let all = answers(rig.cable.device_mut(), now);
            answered += all.iter().filter(|(_, m)| matches!(m, DeviceMessage::Echo(_))).count();
        }
        let faults = rig.cable.device().status().faults;
        assert_eq!((faults, answered), if is_answer { (faults::WATCHDOG, 0) } else { (0, 60) });
    }
}

/// Only intact packets feed the watchdog: an intact header in front of damaged planes does not.
#[test]
fn damaged_planes_do_not_feed_the_watchdog() {
    for damaged in [false, true] {
        let (mut rig, session) = armed();
        rig.step(1);
        let heard = rig.now;
        for ms in 1..=60 {
            let now = heard.plus_ns(ms * 1_000_000);
            let mut bytes =
                frame(session, 2 + ms as u32, (DeviceTicks(0), DeviceTicks(1)), 2, 0).swap_remove(0);
            if damaged {
                let last = bytes.len() - 8;
                bytes[last] ^= 1;
            }
            rig.cable.device_mut().receive(now, Lane::Data, &bytes);
        }
        let faults = rig.cable.device().status().faults;
        assert_eq!(faults, if damaged { faults::WATCHDOG } else { 0 });
    }
}
