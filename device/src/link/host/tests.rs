//! A device that sends unexpected messages: answers to other sessions, old answers, unsolicited answers.

use super::*;
use crate::link::{Codec, DeviceMessage, Fault, LightLimits, MessageType, Underrun};
use crate::planes::{PlaneSchedule, Raster};
use crate::time::FrameRate;
use proptest::prelude::*;

/// Hands out prepared bytes and remembers the types of what was sent.
#[derive(Default)]
struct Script {
    inbound: Vec<u8>,
    sent: Vec<MessageType>,
    session: u32,
    flushed: u32,
}

impl Script {
    fn say(&mut self, session: u32, message: &DeviceMessage) {
        let mut payload = [0; MAX_CONTROL_BYTES];
        let (kind, n) = message.write(&mut payload);
        let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
        self.inbound.extend(packet.to_vec());
    }
}

impl Transport for Script {
    fn send(&mut self, _: HostTime, _: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        for packet in packets {
            let header = Header::decode(packet.header()).unwrap();
            self.session = header.session;
            self.sent.push(header.kind);
        }
        Ok(())
    }
    fn flush_output(&mut self) {
        self.flushed += 1;
    }
    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        sink(Lane::Control, now, &std::mem::take(&mut self.inbound));
        Ok(())
    }
    fn name(&self) -> &str {
        "script"
    }
}

fn raster() -> Raster {
    Raster::new(8, 2).unwrap()
}

fn link() -> HostLink {
    HostLink::new(LinkSettings {
        raster: raster(),
        schedule: PlaneSchedule::mono8(),
        rate: FrameRate::new(100, 1).unwrap(),
        watchdog_us: 50_000,
        underrun: Underrun::Repeat,
        late_slots: 0,
        epoch: Epoch::At(DeviceTicks(0)),
        codecs: Codec::Raw.mask(),
        flash_limit: None,
        limits: LightLimits::OFF,
    })
}

fn hello() -> DeviceMessage {
    DeviceMessage::Hello(DeviceHello {
        version: u16::from(VERSION),
        firmware: 0,
        codecs: 1,
        raster: raster(),
        max_planes: 8,
        frame_buffers: 2,
        greatest_shift: None,
        measures_timing: false,
        shifts_slots: false,
        exceeds: false,
        tick_hz: 1_000_000,
        min_plane_ns: 1000,
        serial: 0,
        now: DeviceTicks(1),
    })
}

fn status(state: DeviceState, now: u64, frame_limit: u32) -> Status {
    let bytes = [0u8; 96];
    let DeviceMessage::Status(blank) = DeviceMessage::parse(MessageType::Status, &bytes).unwrap() else {
        unreachable!()
    };
    Status { state, now: DeviceTicks(now), frame_limit, ..blank }
}

/// Brings a link to streaming against the script.
fn streaming() -> (HostLink, Script) {
    let (mut link, mut script) = (link(), Script::default());
    link.connect();
    link.poll(HostTime(0), &mut script).unwrap();
    script.say(script.session, &hello());
    script.say(script.session, &DeviceMessage::Status(status(DeviceState::Greeted, 2, 0)));
    assert_eq!(link.poll(HostTime(1), &mut script).unwrap(), LinkState::Configuring);
    script.say(script.session, &DeviceMessage::Status(status(DeviceState::Configured, 3, 0)));
    assert_eq!(link.poll(HostTime(2), &mut script).unwrap(), LinkState::Ready);
    assert!(!script.sent.contains(&MessageType::Arm), "never armed of its own accord");
    link.arm(0);
    link.poll(HostTime(3), &mut script).unwrap();
    script.say(script.session, &DeviceMessage::Status(status(DeviceState::Armed, 4, 2)));
    assert_eq!(link.poll(HostTime(4), &mut script).unwrap(), LinkState::Streaming);
    assert_eq!(script.sent[0], MessageType::Hello);
    assert_eq!(script.sent.iter().filter(|t| **t == MessageType::Config).count(), 1);
    (link, script)
}

#[test]
fn u10_answers_to_others_old_answers_and_answers_never_asked_for_change_nothing() {
    let (mut link, mut script) = streaming();
    let session = script.session;
    let ignored = link.counters().packets_ignored;
    // A large credit of another session, an older state, an echo from the future, the refusal of an ARM that was not
    // sent.
    script.say(session ^ 1, &DeviceMessage::Status(status(DeviceState::Armed, 50, 1000)));
    script.say(session, &DeviceMessage::Status(status(DeviceState::Configured, 3, 0)));
    let echo = Echo { host_sent_ns: 1 << 40, device_received: DeviceTicks(1), device_sent: DeviceTicks(2) };
    script.say(session, &DeviceMessage::Echo(echo));
    let fault = Fault { latched: 0, code: FaultCode::Arm, detail: 0, at: DeviceTicks(0) };
    script.say(session, &DeviceMessage::Fault(fault));
    // A PLANE and a HELLO of a host come back: a cable that echoes.
    let looped = Packet::new(Header::control(MessageType::Plane, session, 0), &[0; 200]).to_vec();
    script.inbound.extend(looped);
    // So does the host's own question for the time, which would be the quickest answer of all.
    let echo = Echo { host_sent_ns: 3, device_received: DeviceTicks(0), device_sent: DeviceTicks(0) };
    script.say(session, &DeviceMessage::Echo(echo));
    assert_eq!(link.poll(HostTime(5), &mut script).unwrap(), LinkState::Streaming);
    assert_eq!(link.credit(), 2);
    assert_eq!(link.counters().packets_ignored - ignored, 5);
    let mut echoes = 0;
    link.take_echoes(|_| echoes += 1);
    assert_eq!(echoes, 0);
    // The same answer twice is one answer.
    for _ in 0..2 {
        script.say(session, &DeviceMessage::Status(status(DeviceState::Armed, 60, 3)));
    }
    link.poll(HostTime(6), &mut script).unwrap();
    assert_eq!(link.credit(), 3);
}

#[test]
fn credit_wraps_and_never_goes_below_zero() {
    let (mut link, mut script) = streaming();
    let planes = [0u8; 16];
    for (id, expected) in [(1, SendOutcome::Sent), (2, SendOutcome::Sent)] {
        assert_eq!(
            link.send_frame(HostTime(10), id, DeviceTicks(0), DeviceTicks(1), &planes, &mut script),
            expected
        );
    }
    let none = SendOutcome::Dropped { reason: DropReason::NoCredit };
    assert_eq!(link.send_frame(HostTime(10), 3, DeviceTicks(0), DeviceTicks(1), &planes, &mut script), none);
    // A device that takes credit back below what was sent.
    script.say(script.session, &DeviceMessage::Status(status(DeviceState::Armed, 90, 1)));
    link.poll(HostTime(11), &mut script).unwrap();
    assert_eq!(link.credit(), 0);
    // Starved for four slots: the count is repaired on the data lane.
    script.sent.clear();
    link.poll(HostTime(60_000_000), &mut script).unwrap();
    assert!(script.sent.contains(&MessageType::Sync));
    link.frames_sent = u32::MAX;
    script.say(script.session, &DeviceMessage::Status(status(DeviceState::Armed, 91, 1)));
    link.poll(HostTime(60_000_001), &mut script).unwrap();
    assert_eq!(link.credit(), 2, "from 2^32 - 1 to 1");
    let older =
        link.send_frame(HostTime(60_000_002), 2, DeviceTicks(0), DeviceTicks(1), &planes, &mut script);
    assert_eq!(older, SendOutcome::Dropped { reason: DropReason::NotNewer });
}

/// A device 30 us away at the other end of a medium that either stamps arrivals or does not. Its clock is the host's, a
/// tick a nanosecond.
struct Distant {
    script: Script,
    stamps: bool,
    waiting: Vec<(HostTime, Vec<u8>)>,
}

const WAY_NS: i64 = 30_000;

impl Transport for Distant {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        let (header, payload) = (packets[0].header(), packets[0].payload());
        if header[5] == MessageType::Echo as u8 {
            let host_sent_ns = u64::from_le_bytes(payload[..8].try_into().unwrap());
            let at = DeviceTicks(now.plus_ns(WAY_NS).0 as u64);
            self.script.say(
                self.script.session,
                &DeviceMessage::Echo(Echo { host_sent_ns, device_received: at, device_sent: at }),
            );
            self.waiting.push((now.plus_ns(2 * WAY_NS), std::mem::take(&mut self.script.inbound)));
        }
        self.script.send(now, lane, packets)
    }
    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        self.script.receive(now, sink)?;
        let (stamps, waiting) = (self.stamps, &mut self.waiting);
        waiting.retain(|(at, bytes)| {
            if *at <= now {
                sink(Lane::Control, if stamps { *at } else { now }, bytes);
            }
            *at > now
        });
        Ok(())
    }
    fn name(&self) -> &str {
        "distant"
    }
}

/// Found in use, section 2b of the second look at latency: with replies stamped at the poll, the map of the projector's
/// clock was half a slot wrong.
#[test]
fn a_poll_that_comes_late_does_not_shift_the_map() {
    use crate::clock_map::ClockMap;
    let worst_ns = |stamps: bool| {
        let (mut link, script) = streaming();
        let mut medium = Distant { script, stamps, waiting: Vec::new() };
        let mut map = ClockMap::new(1_000_000_000).unwrap();
        let mut worst = 0;
        for slot in 1..3000i64 {
            // A frame's work, and in addition every third poll a millisecond late.
            let now = HostTime(slot * 1_055_966 + if slot % 3 == 0 { 1_000_000 } else { 0 });
            link.poll(now, &mut medium).unwrap();
            link.take_echoes(|e| {
                map.add_exchange(e.host_sent_at, e.device_received_at, e.device_sent_at, e.host_received_at);
            });
            if slot > 100 {
                let mapped = map.to_host(DeviceTicks(now.0 as u64)).unwrap();
                let error = mapped.at.ns_since(now).abs();
                assert!(error <= mapped.uncertainty_ns, "the bound holds");
                worst = worst.max(error);
            }
        }
        worst
    };
    assert!(worst_ns(true) <= WAY_NS, "{} ns", worst_ns(true));
    assert!(worst_ns(false) > 400_000, "what the stamps are for: {} ns", worst_ns(false));
}

/// Found in use, R2: an order to go dark goes out once, whatever else waits, and is not weakened while it is
/// unconfirmed.
#[test]
fn an_order_to_be_dark_goes_first_once_and_is_not_replaced_by_a_weaker_one() {
    let (mut link, mut script) = streaming();
    script.sent.clear();
    link.command(HostTime(100), Verb::Safe, &mut script).unwrap();
    assert_eq!((script.flushed, &script.sent[..]), (1, &[MessageType::Safe][..]));
    for (verb, flushed) in [(Verb::Black, 1), (Verb::Stop, 1), (Verb::Freeze, 1), (Verb::Safe, 1)] {
        link.command(HostTime(200), verb, &mut script).unwrap();
        assert_eq!((script.flushed, script.sent.last()), (flushed, Some(&MessageType::Safe)), "{verb:?}");
    }
    // Nothing that could be lit goes out before it is confirmed.
    let planes = [0u8; 16];
    let sent = link.send_frame(HostTime(300), 1, DeviceTicks(0), DeviceTicks(9), &planes, &mut script);
    assert_eq!(sent, SendOutcome::Dropped { reason: DropReason::NotStreaming });
    // A stronger order replaces a weaker one, and goes before it.
    let (mut link, mut script) = streaming();
    for (verb, kind, flushed) in [
        (Verb::Freeze, MessageType::Freeze, 0),
        (Verb::Black, MessageType::Black, 1),
        (Verb::Stop, MessageType::Stop, 2),
        (Verb::Safe, MessageType::Safe, 3),
    ] {
        link.command(HostTime(400), verb, &mut script).unwrap();
        assert_eq!((script.flushed, script.sent.last()), (flushed, Some(&kind)));
    }
    // An ARM is newer than all of these orders.
    link.arm(0);
    link.command(HostTime(500), Verb::Black, &mut script).unwrap();
    assert_eq!(script.sent.last(), Some(&MessageType::Black));
}

/// ARM right after BLACK, before a status has told of BLACK: what the device was before is no answer to ARM.
#[test]
fn arm_is_sent_although_the_device_was_armed_before_it_was_made_dark() {
    let (mut link, mut script) = streaming();
    let at = HostTime(1_000_000);
    link.command(at, Verb::Black, &mut script).unwrap();
    link.arm(0);
    script.sent.clear();
    link.poll(at.plus_ns(1_000_000), &mut script).unwrap();
    link.poll(at.plus_ns(2_000_000), &mut script).unwrap();
    assert!(script.sent.contains(&MessageType::Arm), "{:?}", script.sent);
}

#[test]
fn full_frame_numbers_come_back_from_their_low_half() {
    for newest in [5u64, 1 << 32, (7 << 32) + 3] {
        for back in 0..5u64.min(newest) {
            let id = newest - back;
            assert_eq!(HostLink::full_frame_id(newest, id as u32), id);
        }
    }
}

proptest! {
    /// Whatever a device sends, in any state: no panic, no credit beyond the granted one, no request for light.
    #[test]
    fn any_bytes_from_a_device_are_survived(
        pieces in prop::collection::vec((any::<bool>(), 1u8..14, prop::collection::vec(any::<u8>(), 0..120)), 0..40),
    ) {
        let (mut link, mut script) = streaming();
        script.sent.clear();
        for (i, (framed, kind, bytes)) in pieces.iter().enumerate() {
            if *framed {
                let kind = MessageType::from_code(*kind).unwrap();
                let packet = Packet::new(Header::control(kind, script.session, 0), bytes).to_vec();
                script.inbound.extend(packet);
            } else {
                script.inbound.extend(bytes);
            }
            let _ = link.poll(HostTime(1000 + i as i64 * 3_000_000), &mut script);
        }
        prop_assert!(!script.sent.contains(&MessageType::Arm));
        prop_assert!(link.credit() <= i32::MAX as u32);
    }
}
