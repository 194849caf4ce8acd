//! Tests the link's host side against the projector at virtual pace, over a clean and over a bad cable.

mod cable;
mod codec;
mod dark;
mod following;
mod limits;
mod panel;
mod protocol;
mod safety;
mod shift;
mod timing;

use super::*;
use crate::link::{
    DropReason, Epoch, HostLink, LightLimits, LinkError, LinkSettings, LinkState, MessageType, SendOutcome,
    Underrun, Verb,
};
use crate::planes::PlaneSchedule;
use crate::rng::Draws;
use crate::time::FrameRate;
use crate::transport::inproc::Direct;
use crate::transport::{SendError, Transport, TransportError};
use proptest::prelude::*;

const WATCHDOG_US: u32 = 50_000;
const LONG_NS: u64 = 60_000_000_000;

fn raster() -> Raster {
    Raster::new(20, 3).unwrap()
}

fn settings() -> LinkSettings {
    LinkSettings {
        raster: raster(),
        schedule: PlaneSchedule::rgb24(),
        rate: FrameRate::new(947, 1).unwrap(),
        watchdog_us: WATCHDOG_US,
        underrun: Underrun::Repeat,
        late_slots: 0,
        epoch: Epoch::At(DeviceTicks(0)),
        codecs: 0,
        flash_limit: None,
        limits: LightLimits::OFF,
    }
}

/// Planes of frame `id`: any bits, a function of `id`, padding bits 0.
fn planes(id: u64) -> Vec<u8> {
    planes_of(raster(), id)
}

/// Planes of any raster: noise, planes that never change, planes that change in one byte a frame, and planes of short patterns.
fn structured(r: Raster, id: u64) -> Vec<u8> {
    let n = r.plane_bytes();
    let mut all = planes_of(r, id);
    let still = planes_of(r, 999_999);
    for (k, plane) in all.chunks_mut(n).enumerate() {
        match k % 4 {
            0 => {}
            1 => plane.copy_from_slice(&still[k * n..(k + 1) * n]),
            2 => {
                plane.copy_from_slice(&still[k * n..(k + 1) * n]);
                plane[id as usize % n] = id as u8;
            }
            _ => plane.iter_mut().enumerate().for_each(|(i, b)| *b = ((i + id as usize) % 5 * 50) as u8),
        }
    }
    all
}

fn planes_of(r: Raster, id: u64) -> Vec<u8> {
    let draws = Draws::new(id);
    let mut all: Vec<u8> = (0..r.plane_bytes() * 24).map(|i| draws.bits(i as u64) as u8).collect();
    let padding = (r.row_bytes() * 8) as u32 - r.width();
    for row in all.chunks_mut(r.row_bytes()) {
        row[r.row_bytes() - 1] &= 0xff << padding;
    }
    all
}

/// A host and a projector, and the rig's time.
struct Rig<T> {
    link: HostLink,
    cable: T,
    now: HostTime,
    slot: u64,
}

fn clean(settings: LinkSettings, setup: FirmwareConfig) -> Rig<Direct<ProjectorFirmware>> {
    Rig {
        link: HostLink::new(settings),
        cable: Direct::new(ProjectorFirmware::new(setup)),
        now: HostTime(0),
        slot: 0,
    }
}

impl<T: Transport> Rig<T> {
    fn poll(&mut self) -> Result<LinkState, LinkError> {
        self.link.poll(self.now, &mut self.cable)
    }

    /// Polls until `state`, for at most 200 ms of virtual time.
    fn until(&mut self, state: LinkState) {
        for _ in 0..200 {
            if self.poll().expect("handshake") == state {
                return;
            }
            self.now = self.now.plus_ns(1_000_000);
        }
        panic!("still {:?}, not {state:?}", self.link.state());
    }

    fn stream(&mut self) {
        self.link.connect();
        self.until(LinkState::Ready);
        self.link.arm(0);
        self.until(LinkState::Streaming);
        self.slot = self.link.settings().rate.slot_at_ns(self.now.0) + 1;
    }

    /// One slot of the host: to its start, poll, and a frame for the slot after next.
    fn step(&mut self, id: u64) -> SendOutcome {
        self.step_with(id, &planes(id))
    }

    fn step_with(&mut self, id: u64, planes: &[u8]) -> SendOutcome {
        self.slot += 1;
        self.now = HostTime(self.link.settings().rate.slot_start_ns(self.slot));
        self.poll().expect("poll");
        let (target, dark_from) = self.times(self.slot + 2);
        self.link.send_frame(self.now, id, target, dark_from, planes, &mut self.cable)
    }

    /// The start of slot `slot`, and a `dark from` long after it: other tests cover the end of light.
    fn times(&self, slot: u64) -> (DeviceTicks, DeviceTicks) {
        let slots = self.link.slots().unwrap();
        (slots.start(slot), slots.dark_from(slot, LONG_NS))
    }

    fn idle(&mut self, slots: u64) {
        for _ in 0..slots {
            self.slot += 1;
            self.now = HostTime(self.link.settings().rate.slot_start_ns(self.slot));
            self.poll().expect("poll");
        }
    }
}

/// The laws that every report must obey.
fn laws(s: &Status, waiting: u32) {
    assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank, "{s:?}");
    assert_eq!(
        s.frames_seen,
        s.frames_lit + s.frames_incomplete + s.frames_late + s.frames_superseded + s.frames_refused + waiting,
        "{s:?}"
    );
}

impl ProjectorFirmware {
    pub(super) fn check_laws(&self) {
        laws(&self.status(), self.in_flight());
    }
}

#[test]
fn light_is_the_code_values_of_the_frame_at_its_slot() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    let mut sent = Vec::new();
    let mut lit = 0;
    for id in 100..160u64 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
        sent.push((id, rig.slot + 2));
        let mock = rig.cable.device_mut();
        while let Some(event) = mock.next_light() {
            if event.kind == LightKind::Blank {
                assert_eq!(lit, 0, "dark only before the first frame");
                continue;
            }
            let id = u64::from(event.frame.unwrap());
            assert_eq!(event.kind, LightKind::Lit);
            assert!(sent.contains(&(id, event.slot)), "frame {id} in slot {}", event.slot);
            assert_eq!(event.first_photon_at.0, rig.link.settings().rate.slot_start_ns(event.slot));
            assert_eq!(event.last_photon_at.0, rig.link.settings().rate.slot_start_ns(event.slot + 1));
            assert_eq!(mock.lit_planes().unwrap(), planes(id));
            let light = mock.light_of_frame().unwrap().to_vec();
            let bits = planes(id);
            for (p, pixel) in light.iter().enumerate() {
                let (x, y) = (p % 20, p / 20);
                for (c, &lit) in pixel.iter().enumerate() {
                    let code: u32 = (0..8)
                        .map(|k| {
                            let plane = k * 3 + c; // rgb24: bit 7 first, red green blue
                            u32::from(bits[plane * 9 + y * 3 + x / 8] >> (7 - x % 8) & 1) << (7 - k)
                        })
                        .sum();
                    assert_eq!(u32::from(lit), code, "frame {id} pixel {x},{y} channel {c}");
                }
            }
            lit += 1;
        }
        mock.check_laws();
    }
    assert_eq!(lit, 58, "all but the two still waiting");
    let s = rig.cable.device().status();
    assert_eq!((s.frames_lit, s.slots_repeated, s.frames_late, s.payload_errors), (58, 0, 0, 0));
    assert_eq!(rig.cable.device().credit_violations(), 0);
}

#[test]
fn no_light_without_hello_config_and_arm() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    // Planes at a device that was never greeted.
    let header = Header { frame: 1, ..Header::control(MessageType::Plane, 5, 0) };
    rig.cable.send(rig.now, Lane::Data, &[Packet::new(header, &planes(1)[..9])]).unwrap();
    assert_eq!(rig.cable.device().status().packets_ignored, 1);
    rig.link.connect();
    rig.until(LinkState::Ready);
    for id in 0..5 {
        assert_eq!(rig.step(id), SendOutcome::Dropped { reason: DropReason::NotStreaming });
        assert!(!rig.cable.device().is_lit());
    }
    // A host that still sends is refused.
    let session = rig.cable.device().core.session;
    let header = Header { frame: 1, led_code: 7, ..Header::control(MessageType::Plane, session, 0) };
    rig.cable.send(rig.now, Lane::Data, &[Packet::new(header, &planes(1)[..9])]).unwrap();
    rig.now = rig.now.plus_ns(10_000_000);
    rig.poll().unwrap();
    let s = rig.cable.device().status();
    assert_eq!((s.frames_seen, s.frames_refused, s.frames_lit, s.slots), (1, 1, 0, 0));
    assert!(rig.cable.device_mut().next_light().is_none());
}

#[test]
fn a_serial_number_is_drawn_once_and_names_a_projector() {
    let mut drawn = [0, 1, u64::MAX, 77, 78].into_iter();
    let first = FirmwareConfig::serial_number(None, || drawn.next().unwrap());
    assert_eq!(first, 77);
    assert_eq!(FirmwareConfig::serial_number(Some(first), || unreachable!("it is kept")), 77);
    for erased in [0, 1, u64::MAX] {
        assert_eq!(FirmwareConfig::serial_number(Some(erased), || 9), 9);
    }
}

#[test]
fn silence_is_dark_at_the_watchdogs_tick_and_stays_dark() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..20 {
        rig.step(id);
    }
    assert!(rig.cable.device().is_lit());
    let heard = rig.now;
    // Killed: nothing is sent any more. A nanosecond before the watchdog expires, the last frame still repeats.
    let bite = heard.plus_ns(i64::from(WATCHDOG_US) * 1000);
    rig.cable.device_mut().advance_to(bite.plus_ns(-1));
    assert!(rig.cable.device().is_lit());
    rig.cable.device_mut().advance_to(bite);
    assert!(!rig.cable.device().is_lit());
    assert_eq!(rig.cable.device().status().faults, faults::WATCHDOG);
    rig.cable.device_mut().check_laws();
    // A host that returns and continues to send changes nothing until it arms again, with acknowledgement.
    rig.now = bite.plus_ns(1_000_000_000);
    rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0);
    rig.until(LinkState::Faulted);
    assert_eq!(rig.step(100), SendOutcome::Dropped { reason: DropReason::NotStreaming });
    rig.link.arm(0);
    rig.poll().unwrap();
    let refused = rig.poll();
    assert!(matches!(refused, Err(LinkError::ArmRefused { faults: faults::WATCHDOG, .. })), "{refused:?}");
    assert!(!rig.cable.device().is_lit());
    rig.link.arm(faults::WATCHDOG);
    rig.until(LinkState::Streaming);
    for id in 101..106 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
    }
    assert!(rig.cable.device().is_lit());
    rig.cable.device_mut().check_laws();
}

#[test]
fn a_missing_frame_repeats_or_blanks_by_policy() {
    for (underrun, kind) in [(Underrun::Repeat, LightKind::Repeated), (Underrun::Blank, LightKind::Blank)] {
        let mut rig = clean(LinkSettings { underrun, ..settings() }, FirmwareConfig::new(raster()));
        rig.stream();
        for id in 0..6 {
            rig.step(id);
        }
        rig.idle(5);
        let mut kinds = Vec::new();
        while let Some(e) = rig.cable.device_mut().next_light() {
            kinds.push(e.kind);
        }
        assert_eq!(kinds[kinds.len() - 3..], [kind; 3]);
        assert_eq!(rig.cable.device().is_lit(), underrun == Underrun::Repeat);
        rig.cable.device().check_laws();
    }
}

#[test]
fn the_newest_due_frame_wins_and_late_ones_are_dropped_unless_asked() {
    for late_slots in [0u8, 3] {
        let mut rig = clean(LinkSettings { late_slots, ..settings() }, FirmwareConfig::new(raster()));
        rig.stream();
        let slots = rig.link.slots().unwrap();
        let send = |rig: &mut Rig<_>, id, slot| {
            rig.poll().unwrap();
            let planes = planes(id);
            let dark_from = slots.dark_from(slot, LONG_NS);
            rig.link.send_frame(rig.now, id, slots.start(slot), dark_from, &planes, &mut rig.cable)
        };
        let k = rig.slot;
        // Two for the same slot, then one whose slot is over.
        assert_eq!(send(&mut rig, 1, k + 1), SendOutcome::Sent);
        assert_eq!(send(&mut rig, 2, k + 1), SendOutcome::Sent);
        rig.now = HostTime(slots.start(k + 1).0 as i64);
        rig.poll().unwrap();
        assert_eq!(rig.cable.device().lit_frame(), Some(2));
        assert_eq!(send(&mut rig, 3, k), SendOutcome::Sent);
        rig.now = HostTime(slots.start(k + 2).0 as i64);
        rig.poll().unwrap();
        let s = rig.cable.device().status();
        assert_eq!((s.frames_superseded, s.frames_late), (1, u32::from(late_slots == 0)));
        assert_eq!(rig.cable.device().lit_frame(), Some(if late_slots == 0 { 2 } else { 3 }));
        // And one so far ahead that it would occupy its buffer too long.
        assert_eq!(send(&mut rig, 4, k + 947 * 10), SendOutcome::Sent);
        assert_eq!(rig.cable.device().status().frames_refused, 1);
        rig.cable.device().check_laws();
    }
}

#[test]
fn credit_is_what_the_buffers_hold() {
    let mut rig = clean(settings(), FirmwareConfig { frame_buffers: 3, ..FirmwareConfig::new(raster()) });
    rig.stream();
    // Frames for a distant slot fill the buffers; the fourth has no credit; when they are lit, credit returns.
    let (target, dark_from) = rig.times(rig.slot + 100);
    for id in 0..5u64 {
        rig.poll().unwrap();
        let outcome = rig.link.send_frame(rig.now, id, target, dark_from, &planes(id), &mut rig.cable);
        let expected =
            if id < 3 { SendOutcome::Sent } else { SendOutcome::Dropped { reason: DropReason::NoCredit } };
        assert_eq!(outcome, expected, "frame {id}");
    }
    rig.idle(110);
    assert_eq!(rig.link.credit(), 3);
    let s = rig.cable.device().status();
    assert_eq!((s.frames_lit, s.frames_superseded), (1, 2));
    assert_eq!(rig.cable.device().credit_violations(), 0);
    let c = rig.link.counters();
    assert_eq!((c.frames_offered, c.frames_sent, c.no_credit), (5, 3, 2));
}

#[test]
fn verbs_darken_hold_and_latch() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    let mut id = 0;
    let mut run = |rig: &mut Rig<Direct<ProjectorFirmware>>, n| {
        for _ in 0..n {
            id += 1;
            rig.step(id);
            rig.cable.device().check_laws();
        }
        id
    };
    run(&mut rig, 5);
    rig.link.command(rig.now, Verb::Black, &mut rig.cable).unwrap();
    assert!(!rig.cable.device().is_lit(), "black at once, not at the next slot");
    run(&mut rig, 5);
    assert!(!rig.cable.device().is_lit());
    assert_eq!(rig.link.status().unwrap().state, DeviceState::Black);
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
    rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0);
    run(&mut rig, 5);
    assert!(rig.cable.device().is_lit());
    let held = rig.cable.device().lit_frame();
    rig.link.command(rig.now, Verb::Freeze, &mut rig.cable).unwrap();
    run(&mut rig, 5);
    assert_eq!(rig.cable.device().lit_frame(), held);
    assert!(rig.cable.device().is_lit());
    rig.link.command(rig.now, Verb::Stop, &mut rig.cable).unwrap();
    rig.until(LinkState::Ready);
    assert!(!rig.cable.device().is_lit());
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
    rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0);
    run(&mut rig, 5);
    assert!(rig.cable.device().is_lit());
    rig.link.command(rig.now, Verb::Safe, &mut rig.cable).unwrap();
    rig.until(LinkState::Faulted);
    assert_eq!(rig.cable.device().status().faults, faults::HOST_SAFE);
    rig.link.arm(faults::WATCHDOG);
    rig.poll().unwrap();
    assert!(matches!(rig.poll(), Err(LinkError::ArmRefused { .. })), "another fault's acknowledgement");
    rig.link.arm(faults::HOST_SAFE);
    rig.until(LinkState::Streaming);
}

#[test]
fn a_present_fault_cannot_be_acknowledged_away() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..5 {
        rig.step(id);
    }
    rig.cable.device_mut().set_faults(rig.now, faults::OVER_TEMPERATURE);
    assert!(!rig.cable.device().is_lit());
    rig.until(LinkState::Faulted);
    rig.link.arm(faults::OVER_TEMPERATURE);
    rig.poll().unwrap();
    assert!(matches!(rig.poll(), Err(LinkError::ArmRefused { .. })));
    rig.cable.device_mut().set_faults(rig.now, 0);
    rig.link.arm(faults::OVER_TEMPERATURE);
    rig.until(LinkState::Streaming);
}

#[test]
fn a_device_that_lost_its_power_is_greeted_again_and_stays_dark() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..5 {
        rig.step(id);
    }
    rig.cable.device_mut().power_cycle(rig.now);
    let failed_at = rig.now;
    rig.until(LinkState::Greeting);
    rig.until(LinkState::Ready);
    assert!(rig.now.ns_since(failed_at) < 500_000_000);
    assert!(!rig.cable.device().is_lit());
    rig.link.arm(0);
    rig.until(LinkState::Streaming);
}

#[test]
fn impossible_rigs_are_refused_by_name() {
    let check = |s: LinkSettings, setup: FirmwareConfig| {
        let mut rig = clean(s, setup);
        rig.link.connect();
        let _ = rig.poll();
        let result = rig.poll();
        assert_eq!(rig.link.state(), LinkState::Closed);
        result.unwrap_err().to_string()
    };
    let big = FirmwareConfig::new(Raster::new(1024, 768).unwrap());
    assert!(check(settings(), big).contains("1024x768 mirrors, the rig is configured for 20x3"));
    let fast = LinkSettings { rate: FrameRate::new(1000, 1).unwrap(), ..settings() };
    let text = check(fast, FirmwareConfig::new(raster()));
    assert!(
        text.contains("24 planes at 1000.000 Hz leave 41666 ns for a plane, the mirrors need 43220 ns"),
        "{text}"
    );
    let old = FirmwareConfig { version: 9, ..FirmwareConfig::new(raster()) };
    let text = check(settings(), old);
    assert!(text.contains("version 9, this program 2"), "{text}");
}

#[test]
fn a_skewed_clock_lights_on_its_own_slots() {
    let clock = DeviceClock {
        tick_hz: 27_000_000,
        skew_ppb: 50_000,
        start_ticks: (1 << 32) - 1_000_000, // passes 2^32 during the run
        power_on_at: HostTime(-5),
    };
    let s = LinkSettings { epoch: Epoch::AfterHello(2_000_000), late_slots: 8, ..settings() };
    let mut rig = clean(s, FirmwareConfig { clock, ..FirmwareConfig::new(raster()) });
    rig.stream();
    let slots = rig.link.slots().unwrap();
    let mut last = None;
    for id in 0..200u64 {
        rig.now = rig.now.plus_ns(1_055_966);
        rig.poll().unwrap();
        // The host knows the device's clock only through the link.
        let now = rig.link.status().unwrap().now;
        let (target, dark_from) = rig.times(slots.slot_at(now).unwrap() + 2);
        rig.link.send_frame(rig.now, id, target, dark_from, &planes(id), &mut rig.cable);
        while let Some(e) = rig.cable.device_mut().next_light() {
            assert_eq!(e.lit_at, slots.start(e.slot));
            let ticks = clock.ticks_at(e.first_photon_at);
            assert_eq!(ticks, e.lit_at, "the first photon leaves in the nanosecond in which the tick comes");
            if let Some(last) = last {
                assert_eq!(e.slot, last + 1, "no slot twice, none left out");
            }
            last = Some(e.slot);
        }
    }
    assert!(slots.start(last.unwrap()).0 > 1 << 32);
    // A fast device begins a slot more often than the host sends: 50 ppm of 200 frames is none or one.
    let s = rig.cable.device().status();
    assert!(s.frames_lit >= 195, "{s:?}");
    rig.cable.device().check_laws();
    let mut echoes = 0;
    rig.link.take_echoes(|e| {
        echoes += 1;
        assert_eq!(clock.ticks_at(e.host_sent_at), e.device_received_at);
        assert!(e.host_received_at >= e.host_sent_at && e.device_sent_at >= e.device_received_at);
    });
    assert_eq!(echoes, 16);
}

/// The packets printed in docs/PROTOCOL.md, in their order.
fn packets_of_the_document() -> Vec<Vec<u8>> {
    let text = include_str!("../../../docs/PROTOCOL.md");
    let bytes = |block: &str| {
        let hex = block.split("```").next().unwrap();
        hex.split_whitespace().map(|b| u8::from_str_radix(b, 16).unwrap()).collect()
    };
    text.split("```hex").skip(1).map(bytes).collect()
}

/// The packets printed in docs/PROTOCOL.md, byte for byte: the example makes the light that the document promises.
#[test]
fn the_documents_example_makes_light() {
    let packets = packets_of_the_document();
    let [hello, config, arm, plane, commit, stop, _tracks, _shift] = &packets[..] else {
        panic!("{} packets", packets.len())
    };
    let mut mock = ProjectorFirmware::new(FirmwareConfig::new(Raster::new(16, 1).unwrap()));
    let mut states = Vec::new();
    for control in [hello, config, arm] {
        mock.receive(HostTime(0), Lane::Control, control);
        states.push(mock.status().state);
    }
    assert_eq!(states, [DeviceState::Greeted, DeviceState::Configured, DeviceState::Armed]);
    mock.receive(HostTime(1), Lane::Data, plane);
    mock.receive(HostTime(2), Lane::Data, commit);
    mock.advance_to(HostTime(1_055_965));
    assert!(!mock.is_lit());
    mock.advance_to(HostTime(1_055_966));
    let light = mock.light_of_frame().expect("frame 1").to_vec();
    let expected: Vec<[u8; 3]> =
        (0..16).map(|x| if (4..12).contains(&x) { [0; 3] } else { [128, 0, 0] }).collect();
    assert_eq!(light, expected);
    mock.advance_to(HostTime(5_279_830));
    assert!(mock.is_lit());
    mock.advance_to(HostTime(5_279_831));
    assert!(!mock.is_lit(), "dark from there on by itself");
    assert_eq!(mock.status().state, DeviceState::Armed);
    mock.receive(HostTime(5_300_000), Lane::Control, stop);
    assert_eq!(mock.status().state, DeviceState::Configured);
    assert_eq!(mock.status().frames_lit, 1);
}
