//! The link's host side against the projector at virtual pace, over a clean and over a bad cable.

use super::*;
use crate::rng::Draws;
use dpm_device::link::{
    DropReason, Epoch, HostLink, LinkError, LinkSettings, LinkState, MessageType, SendOutcome, Verb,
};
use dpm_device::planes::PlaneSchedule;
use dpm_device::time::FrameRate;
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::{SendError, Transport, TransportError};
use proptest::prelude::*;

const WATCHDOG_US: u32 = 50_000;

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
        session_seed: 7,
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

fn clean(settings: LinkSettings, setup: MockConfig) -> Rig<Direct<MockProjector>> {
    Rig {
        link: HostLink::new(settings),
        cable: Direct::new(MockProjector::new(setup)),
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
        let target = self.link.slots().unwrap().start(self.slot + 2);
        self.link.send_frame(self.now, id, target, planes, &mut self.cable)
    }

    fn idle(&mut self, slots: u64) {
        for _ in 0..slots {
            self.slot += 1;
            self.now = HostTime(self.link.settings().rate.slot_start_ns(self.slot));
            self.poll().expect("poll");
        }
    }
}

/// The laws that every report must obey, whatever happened.
fn laws(s: &Status, waiting: u32) {
    assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank, "{s:?}");
    assert_eq!(
        s.frames_seen,
        s.frames_lit + s.frames_incomplete + s.frames_late + s.frames_superseded + s.frames_refused + waiting,
        "{s:?}"
    );
}

impl MockProjector {
    /// Frames on their way to the light.
    pub(super) fn waiting(&self) -> u32 {
        let assembling = self.core.store.assembling.is_some_and(|a| a.buffer.is_some());
        self.core.store.waiting() as u32 + u32::from(assembling)
    }

    pub(super) fn check_laws(&self) {
        laws(&self.status(), self.waiting());
    }
}

#[test]
fn light_is_the_code_values_of_the_frame_at_its_slot() {
    let mut rig = clean(settings(), MockConfig::new(raster()));
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
    let mut rig = clean(settings(), MockConfig::new(raster()));
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
    // A host that sends all the same is refused.
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
fn silence_is_dark_at_the_watchdogs_tick_and_stays_dark() {
    let mut rig = clean(settings(), MockConfig::new(raster()));
    rig.stream();
    for id in 0..20 {
        rig.step(id);
    }
    assert!(rig.cable.device().is_lit());
    let heard = rig.now;
    // Killed: nothing is sent any more. A nanosecond before the bite the last frame still repeats.
    let bite = heard.plus_ns(i64::from(WATCHDOG_US) * 1000);
    rig.cable.device_mut().advance_to(bite.plus_ns(-1));
    assert!(rig.cable.device().is_lit());
    rig.cable.device_mut().advance_to(bite);
    assert!(!rig.cable.device().is_lit());
    assert_eq!(rig.cable.device().status().faults, faults::WATCHDOG);
    rig.cable.device_mut().check_laws();
    // A host that comes back and goes on sending changes nothing until it arms again, with acknowledgement.
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
        let mut rig = clean(LinkSettings { underrun, ..settings() }, MockConfig::new(raster()));
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
        let mut rig = clean(LinkSettings { late_slots, ..settings() }, MockConfig::new(raster()));
        rig.stream();
        let slots = rig.link.slots().unwrap();
        let send = |rig: &mut Rig<_>, id, slot| {
            rig.poll().unwrap();
            let planes = planes(id);
            rig.link.send_frame(rig.now, id, slots.start(slot), &planes, &mut rig.cable)
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
        // And one so far ahead that it would never give its buffer back.
        assert_eq!(send(&mut rig, 4, k + 947 * 10), SendOutcome::Sent);
        assert_eq!(rig.cable.device().status().frames_refused, 1);
        rig.cable.device().check_laws();
    }
}

#[test]
fn credit_is_what_the_buffers_hold() {
    let mut rig = clean(settings(), MockConfig { frame_buffers: 3, ..MockConfig::new(raster()) });
    rig.stream();
    // Frames for a slot far away fill the buffers; the fourth has no credit; when light takes them, credit returns.
    let target = rig.link.slots().unwrap().start(rig.slot + 100);
    for id in 0..5u64 {
        rig.poll().unwrap();
        let outcome = rig.link.send_frame(rig.now, id, target, &planes(id), &mut rig.cable);
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
    let mut rig = clean(settings(), MockConfig::new(raster()));
    rig.stream();
    let mut id = 0;
    let mut run = |rig: &mut Rig<Direct<MockProjector>>, n| {
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
    let mut rig = clean(settings(), MockConfig::new(raster()));
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
    let mut rig = clean(settings(), MockConfig::new(raster()));
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
    let check = |s: LinkSettings, setup: MockConfig| {
        let mut rig = clean(s, setup);
        rig.link.connect();
        let _ = rig.poll();
        let result = rig.poll();
        assert_eq!(rig.link.state(), LinkState::Closed);
        result.unwrap_err().to_string()
    };
    let big = MockConfig::new(Raster::new(1024, 768).unwrap());
    assert!(check(settings(), big).contains("1024x768 mirrors, the rig is configured for 20x3"));
    let fast = LinkSettings { rate: FrameRate::new(1000, 1).unwrap(), ..settings() };
    let text = check(fast, MockConfig::new(raster()));
    assert!(
        text.contains("24 planes at 1000.000 Hz leave 41666 ns for a plane, the mirrors need 43220 ns"),
        "{text}"
    );
    let old = MockConfig { version: 9, ..MockConfig::new(raster()) };
    let text = check(settings(), old);
    assert!(text.contains("version 9, this program 1"), "{text}");
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
    let mut rig = clean(s, MockConfig { clock, ..MockConfig::new(raster()) });
    rig.stream();
    let slots = rig.link.slots().unwrap();
    let mut last = None;
    for id in 0..200u64 {
        rig.now = rig.now.plus_ns(1_055_966);
        rig.poll().unwrap();
        // The host knows the device's clock only through the link.
        let now = rig.link.status().unwrap().now;
        let target = slots.start(slots.slot_at(now).unwrap() + 2);
        rig.link.send_frame(rig.now, id, target, &planes(id), &mut rig.cable);
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

/// A cable that loses, damages, repeats and swaps packets.
struct BadCable {
    inner: Direct<MockProjector>,
    draws: Draws,
    sent: u64,
    per_mille: u64,
    held: Option<(Lane, Vec<u8>)>,
}

impl Transport for BadCable {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        for packet in packets {
            let mut bytes = packet.parts().concat();
            self.sent += 1;
            let draw = self.draws.bits(self.sent);
            let device = self.inner.device_mut();
            if draw % 1000 < self.per_mille {
                match draw >> 32 & 7 {
                    0 | 1 => continue,
                    2 | 3 => {
                        let bit = (draw >> 40) as usize % (bytes.len() * 8);
                        bytes[bit / 8] ^= 1 << (bit % 8);
                    }
                    4 => device.receive(now, lane, &bytes),
                    5 => {
                        self.held = Some((lane, bytes));
                        continue;
                    }
                    6 => bytes.truncate((draw >> 40) as usize % bytes.len()),
                    _ => device.receive(now, lane, &[0x44; 7][..(draw >> 40) as usize % 8]),
                }
            }
            device.receive(now, lane, &bytes);
            if let Some((lane, held)) = self.held.take() {
                device.receive(now, lane, &held);
            }
        }
        Ok(())
    }

    fn receive(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) -> Result<(), TransportError> {
        // The way back is as bad.
        self.inner.device_mut().advance_to(now);
        let (draws, per_mille) = (self.draws.stream(1), self.per_mille);
        let mut n = now.0 as u64 * 64;
        self.inner.device_mut().replies(now, &mut |lane, bytes| {
            n += 1;
            if draws.bits(n) % 1000 >= per_mille {
                sink(lane, bytes);
            }
        });
        Ok(())
    }

    fn name(&self) -> &str {
        "a bad cable"
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Whatever the cable does: what is lit is a frame that was sent, bit for bit; laws and credits hold; light returns.
    #[test]
    fn a_bad_cable_never_lights_a_wrong_frame(seed in any::<u64>(), per_mille in 0u64..200, codecs in 0u32..16) {
        let r = Raster::new(64, 16).unwrap();
        let mock = MockProjector::new(MockConfig::new(r));
        let cable =
            BadCable { inner: Direct::new(mock), draws: Draws::new(seed), sent: 0, per_mille: 0, held: None };
        let s = LinkSettings { raster: r, codecs, late_slots: 2, ..settings() };
        let mut rig = Rig { link: HostLink::new(s), cable, now: HostTime(0), slot: 0 };
        rig.stream();
        rig.cable.per_mille = per_mille;
        let mut last_lit = None;
        for id in 0..60u64 {
            rig.step_with(id, &structured(r, id));
            let mock = rig.cable.inner.device_mut();
            mock.check_laws();
            prop_assert_eq!(mock.credit_violations(), 0);
            while let Some(event) = mock.next_light() {
                if event.kind == LightKind::Lit {
                    let id = event.frame.unwrap();
                    prop_assert!(last_lit.is_none_or(|l| id > l), "light goes forward only");
                    last_lit = Some(id);
                }
            }
            if let Some(id) = mock.lit_frame() {
                let expected = structured(r, u64::from(id));
                prop_assert_eq!(mock.lit_planes().unwrap(), &expected[..]);
            }
        }
        // The cable heals: within 40 slots (credit repair included) every frame is lit again.
        rig.cable.per_mille = 0;
        for id in 60..100 {
            rig.step_with(id, &structured(r, id));
        }
        let before = rig.cable.inner.device().status().frames_lit;
        for id in 100..110 {
            prop_assert_eq!(rig.step_with(id, &structured(r, id)), SendOutcome::Sent);
        }
        prop_assert_eq!(rig.cable.inner.device().status().frames_lit, before + 10);
    }

    /// Any bytes on any lane, at any time, in any state.
    #[test]
    fn any_bytes_leave_it_standing(
        pieces in prop::collection::vec((any::<bool>(), prop::collection::vec(any::<u8>(), 0..64), 0i64..3_000_000), 0..60),
        messages in prop::collection::vec((1u8..14, any::<u32>(), prop::collection::vec(any::<u8>(), 0..70), any::<bool>()), 0..60),
        armed in any::<bool>(),
    ) {
        let mut rig = clean(settings(), MockConfig::new(raster()));
        if armed {
            rig.stream();
        }
        let session = rig.cable.device().core.session;
        let mut now = rig.now;
        let mock = rig.cable.device_mut();
        for (i, (data, bytes, dt)) in pieces.iter().enumerate() {
            now = now.plus_ns(*dt);
            mock.receive(now, if *data { Lane::Data } else { Lane::Control }, bytes);
            mock.end_of_transfer(now, if *data { Lane::Data } else { Lane::Control });
            if let Some((kind, frame, payload, control)) = messages.get(i) {
                let kind = MessageType::from_code(*kind).unwrap();
                let codec = Codec::from_code((*frame >> 8) as u8 % 4).unwrap();
                let header = Header { frame: *frame, codec, plane: *frame as u8 % 30, led_code: 7, ..Header::control(kind, session, 0) };
                let packet = Packet::new(header, payload).parts().concat();
                mock.receive(now, if *control { Lane::Control } else { Lane::Data }, &packet);
            }
            let mut replies = 0;
            mock.replies(now, &mut |_, _| replies += 1);
            prop_assert!(replies <= 3 + ECHOES_KEPT);
            mock.check_laws();
            prop_assert!(mock.lit_frame().is_none(), "no whole frame was ever sent");
        }
    }
}

/// The packets printed in docs/PROTOCOL.md, byte for byte: the example makes the light that the document promises.
#[test]
fn the_documents_example_makes_light() {
    let text = include_str!("../../../docs/PROTOCOL.md");
    let packets: Vec<Vec<u8>> = text
        .split("```hex")
        .skip(1)
        .map(|block| {
            let hex = block.split("```").next().unwrap();
            hex.split_whitespace().map(|b| u8::from_str_radix(b, 16).unwrap()).collect()
        })
        .collect();
    let [hello, config, arm, plane, commit, stop] = &packets[..] else { panic!("{} packets", packets.len()) };
    let mut mock = MockProjector::new(MockConfig::new(Raster::new(16, 1).unwrap()));
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
    mock.receive(HostTime(1_100_000), Lane::Control, stop);
    assert!(!mock.is_lit());
    assert_eq!(mock.status().frames_lit, 1);
}

#[test]
fn every_codec_saves_and_lights_the_same_frame() {
    let r = Raster::new(64, 16).unwrap();
    let raw_frame = (24 * (32 + r.plane_bytes() + 4) + 32 + 16 + 4) as u64;
    for codecs in [0, Codec::Rle.mask(), Codec::XorRle.mask(), Codec::Lz4.mask(), Codec::ALL] {
        let mut rig = clean(LinkSettings { raster: r, codecs, ..settings() }, MockConfig::new(r));
        rig.stream();
        let before = rig.link.counters().bytes_sent;
        for id in 0..40 {
            assert_eq!(rig.step_with(id, &structured(r, id)), SendOutcome::Sent);
            if let Some(lit) = rig.cable.device().lit_frame() {
                assert_eq!(rig.cable.device().lit_planes().unwrap(), structured(r, u64::from(lit)));
            }
        }
        let c = rig.link.counters();
        let s = rig.cable.device().status();
        assert_eq!((s.frames_incomplete, s.packets_ignored, s.frames_lit), (0, 0, 38), "{codecs:#b} {s:?}");
        let bytes = c.bytes_sent - before;
        if codecs == 0 {
            assert_eq!((c.planes_raw, c.planes_coded, c.planes_kept), (40 * 24, 0, 0));
            assert!((40 * raw_frame..40 * raw_frame + 5000).contains(&bytes), "{bytes}");
            continue;
        }
        // A quarter of the planes never changes: sent once each. A quarter is noise and stays raw.
        assert_eq!(c.planes_kept, 39 * 6);
        assert!(c.planes_raw >= 40 * 6);
        assert_eq!(c.key_frames, 1);
        if codecs != Codec::Rle.mask() {
            assert!(c.planes_coded > 39 * 6 / 2, "{codecs:#b}: {c:?}");
        }
        assert!(bytes < 40 * raw_frame * 3 / 4 + 5000, "{codecs:#b}: {bytes} of {}", 40 * raw_frame);
        if codecs == Codec::ALL {
            assert!(bytes < 40 * raw_frame * 45 / 100, "{bytes} of {}", 40 * raw_frame);
            // A frame like the one before is a FRAME_COMMIT and nothing else.
            let planes = structured(r, 39);
            rig.step_with(40, &planes);
            let at = rig.link.counters().bytes_sent;
            rig.poll().unwrap();
            let target = rig.link.slots().unwrap().start(rig.slot + 3);
            rig.link.send_frame(rig.now, 41, target, &planes, &mut rig.cable);
            assert_eq!(rig.link.counters().bytes_sent - at, 32 + 16 + 4);
            rig.idle(4);
            assert_eq!(rig.cable.device().lit_frame(), Some(41));
            assert_eq!(rig.cable.device().lit_planes().unwrap(), planes);
        }
    }
}

/// A device that reads nothing but raw planes gets nothing else.
#[test]
fn codecs_are_what_both_sides_know() {
    let r = Raster::new(64, 16).unwrap();
    let mut rig = clean(
        LinkSettings { raster: r, codecs: Codec::ALL, ..settings() },
        MockConfig { codecs: 0, ..MockConfig::new(r) },
    );
    rig.stream();
    for id in 0..20 {
        rig.step_with(id, &structured(r, id));
    }
    assert_eq!(rig.link.counters().planes_coded, 0);
    assert!(rig.link.counters().planes_kept > 0, "keeping a plane needs no codec");
    assert_eq!(rig.cable.device().status().packets_ignored, 0);
}

/// A picture that flashes: full light and darkness, each for `half_period` slots.
fn flashing(id: u64, half_period: u64) -> Vec<u8> {
    let lit = (id / half_period).is_multiple_of(2);
    let mut all = vec![if lit { 0xff } else { 0 }; raster().plane_bytes() * 24];
    for row in all.chunks_mut(3) {
        row[2] &= 0xf0;
    }
    all
}

#[test]
fn the_host_does_not_let_the_field_flash() {
    let s = LinkSettings { flash_limit: Some(3), watchdog_us: 3_000_000, ..settings() };
    let mut rig = clean(s, MockConfig::new(raster()));
    rig.stream();
    // 10 Hz: half a period is 47 slots.
    let mut dark_since = None;
    let mut rests = 0;
    for id in 0..4000u64 {
        let outcome = rig.step_with(id, &flashing(id, 47));
        let lit = rig.cable.device().is_lit();
        match (outcome, dark_since) {
            (SendOutcome::Dropped { reason: DropReason::FlashLimit }, None) => {
                assert!(!lit, "dark at once");
                dark_since = Some(rig.now);
                rests += 1;
            }
            (SendOutcome::Dropped { reason: DropReason::FlashLimit }, _) => assert!(!lit),
            (_, Some(since)) if lit => {
                assert!(rig.now.ns_since(since) >= 2_000_000_000, "rested {} ns", rig.now.ns_since(since));
                dark_since = None;
            }
            _ => {}
        }
    }
    assert!(rests >= 2, "it strikes again after the rest: {rests}");
    let status = rig.cable.device().status();
    assert_eq!(status.faults, 0, "the host is before the device: {status:?}");
    // A picture that is calm is never dropped.
    let s = LinkSettings { flash_limit: Some(3), ..settings() };
    let mut rig = clean(s, MockConfig::new(raster()));
    rig.stream();
    for id in 0..3000 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
    }
}

#[test]
fn a_device_does_not_trust_the_host_about_flashes() {
    let mut rig = clean(LinkSettings { watchdog_us: 10_000_000, ..settings() }, MockConfig::new(raster()));
    rig.stream();
    let mut flashes = 0;
    let mut was_bright = false;
    for id in 0..2000u64 {
        rig.step_with(id, &flashing(id, 47));
        let bright = rig.cable.device_mut().light_of_frame().is_some_and(|l| l[0] == [255; 3]);
        flashes += u32::from(bright && !was_bright);
        was_bright = bright;
        if rig.cable.device().status().faults != 0 {
            break;
        }
    }
    assert_eq!(rig.cable.device().status().faults, faults::FLASH_LIMIT);
    assert!(flashes <= 5, "{flashes} flashes before it struck");
    assert!(!rig.cable.device().is_lit());
    let struck_at = rig.now;
    // Not even with acknowledgement within two seconds.
    rig.until(LinkState::Faulted);
    rig.link.arm(faults::FLASH_LIMIT);
    rig.poll().unwrap();
    assert!(matches!(rig.poll(), Err(LinkError::ArmRefused { .. })));
    rig.now = struck_at.plus_ns(2_010_000_000);
    rig.link.arm(faults::FLASH_LIMIT);
    rig.until(LinkState::Streaming);
}

#[test]
fn a_storm_of_damage_ends_the_light() {
    let mut rig = clean(settings(), MockConfig::new(raster()));
    rig.stream();
    for id in 0..10 {
        rig.step(id);
    }
    assert!(rig.cable.device().is_lit());
    let session = rig.cable.device().core.session;
    let mut bad = Packet::new(Header::control(MessageType::Sync, session, 0), &[0; 4]).parts().concat();
    bad[34] ^= 1;
    for n in 0..1000 {
        assert!(rig.cable.device().is_lit(), "after {n}");
        let now = rig.now;
        rig.cable.device_mut().receive(now, Lane::Data, &bad);
    }
    assert!(!rig.cable.device().is_lit());
    assert_eq!(rig.cable.device().status().faults, faults::CHECKSUM_STORM);
}
