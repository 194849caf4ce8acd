//! A projector behind a bad cable: applies the common vocabulary of faults to its packets.
//!
//! Implements `loss`, `corrupt`, `truncate`, `duplicate`, `reorder` (packets of the host), `stall` (nothing gets
//! through until the window ends, then everything that waited), `dropout` (nothing gets through in either direction),
//! `reset` (power fails and returns). The choice of packets depends only on seed and packet number.

use dpm_device::link::{Decoder, Header, Packet, PacketSink};
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};

use super::MockProjector;
use crate::faults::{FaultError, FaultKind, FaultPlan};
use dpm_device::rng::Draws;

/// Packets of a stalled host that wait; a host that obeys its credits has fewer in flight.
const STALLED_KEPT: usize = 512;

/// A [`MockProjector`] and a [`FaultPlan`].
pub struct FaultyProjector {
    projector: MockProjector,
    plan: FaultPlan,
    draws: Draws,
    start: HostTime,
    previous_ns: i64,
    checked_ns: i64,
    packets: u64,
    lanes: [Reassembly; 2],
    decoders: [Decoder; 2],
    overtaken: Option<(Lane, Vec<u8>)>,
    stalled: Vec<(Lane, Vec<u8>)>,
    struck: u64,
}

/// Reassembles whole packets from the stream, because faults strike packets.
#[derive(Default)]
struct Reassembly {
    header: Option<Header>,
    payload: Vec<u8>,
    whole: Vec<Vec<u8>>,
}

impl PacketSink for Reassembly {
    fn begin(&mut self, header: &Header) -> bool {
        self.header = Some(*header);
        self.payload.clear();
        true
    }
    fn payload(&mut self, bytes: &[u8]) {
        self.payload.extend_from_slice(bytes);
    }
    fn end(&mut self, intact: bool) {
        if let Some(header) = self.header.take().filter(|_| intact) {
            self.whole.push(Packet::new(header, &self.payload).to_vec());
        }
    }
}

impl FaultyProjector {
    /// Faults that this mock implements.
    pub const KNOWN: [FaultKind; 8] = [
        FaultKind::Loss,
        FaultKind::Corrupt,
        FaultKind::Truncate,
        FaultKind::Duplicate,
        FaultKind::Reorder,
        FaultKind::Stall,
        FaultKind::Dropout,
        FaultKind::Reset,
    ];

    /// `start` is the instant that the plan's times count from.
    ///
    /// # Errors
    /// When the plan has a fault that does not apply to a projector.
    pub fn new(
        projector: MockProjector,
        plan: FaultPlan,
        seed: u64,
        start: HostTime,
    ) -> Result<Self, FaultError> {
        plan.check_supported(&Self::KNOWN, "the projector")?;
        Ok(Self {
            projector,
            plan,
            draws: Draws::new(seed),
            start,
            previous_ns: -1,
            checked_ns: -1,
            packets: 0,
            lanes: Default::default(),
            decoders: [Decoder::new(), Decoder::new()],
            overtaken: None,
            stalled: Vec::new(),
            struck: 0,
        })
    }

    /// The projector inside.
    pub fn projector(&mut self) -> &mut MockProjector {
        &mut self.projector
    }

    /// Time of the next own event of the projector inside; `None` if there is none.
    pub fn next_due(&self) -> Option<HostTime> {
        self.projector.next_due()
    }

    /// Packets that a fault struck.
    pub fn struck(&self) -> u64 {
        self.struck
    }

    fn since_start(&self, now: HostTime) -> i64 {
        now.ns_since(self.start)
    }

    /// Processes the events of the clock alone: the end of a stall, a reset.
    fn live(&mut self, now: HostTime) {
        let t = self.since_start(now);
        if self.plan.starts_within(FaultKind::Reset, self.checked_ns, t) {
            self.projector.power_cycle(now);
            self.struck += 1;
        }
        self.checked_ns = self.checked_ns.max(t);
        if !self.stalled.is_empty() && !self.plan.is_on(FaultKind::Stall, t) {
            for (lane, packet) in std::mem::take(&mut self.stalled) {
                self.projector.receive(now, lane, &packet);
            }
        }
    }

    fn packet(&mut self, now: HostTime, lane: Lane, mut packet: Vec<u8>) {
        let (t, index, before) = (self.since_start(now), self.packets, self.previous_ns);
        self.packets += 1;
        self.previous_ns = t;
        let hit = |kind| self.plan.strikes(kind, self.draws, index, before, t);
        let (lost, corrupt, cut) = (hit(FaultKind::Loss), hit(FaultKind::Corrupt), hit(FaultKind::Truncate));
        let (twice, overtaken) = (hit(FaultKind::Duplicate), hit(FaultKind::Reorder));
        let off = self.plan.is_on(FaultKind::Dropout, t);
        let stalled = self.plan.is_on(FaultKind::Stall, t);
        self.struck += u64::from(lost || corrupt || cut || twice || overtaken || off || stalled);
        if lost || off {
            return;
        }
        let draw = self.draws.stream(u64::MAX).bits(index);
        if corrupt {
            let bit = draw as usize % (packet.len() * 8);
            packet[bit / 8] ^= 1 << (bit % 8);
        }
        if cut {
            packet.truncate((draw >> 32) as usize % packet.len());
        }
        if stalled {
            if self.stalled.len() < STALLED_KEPT {
                self.stalled.push((lane, packet));
            }
            return;
        }
        if overtaken && self.overtaken.is_none() {
            self.overtaken = Some((lane, packet));
            return;
        }
        self.projector.receive(now, lane, &packet);
        if twice {
            self.projector.receive(now, lane, &packet);
        }
        if let Some((lane, late)) = self.overtaken.take() {
            self.projector.receive(now, lane, &late);
        }
    }
}

impl LinkDevice for FaultyProjector {
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]) {
        self.live(now);
        let l = lane as usize;
        self.decoders[l].push(bytes, &mut self.lanes[l]);
        for packet in std::mem::take(&mut self.lanes[l].whole) {
            self.packet(now, lane, packet);
        }
    }

    fn end_of_transfer(&mut self, now: HostTime, lane: Lane) {
        let l = lane as usize;
        self.decoders[l].reset(&mut self.lanes[l]);
        self.projector.end_of_transfer(now, lane);
    }

    fn advance_to(&mut self, now: HostTime) {
        self.live(now);
        self.projector.advance_to(now);
    }

    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) {
        self.live(now);
        let off = self.plan.is_on(FaultKind::Dropout, self.since_start(now));
        self.projector.replies(now, &mut |lane, bytes| {
            if !off {
                sink(lane, bytes);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::MockConfig;
    use super::*;
    use dpm_device::link::{
        measure, packet_bytes, Codec, Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome,
        Underrun, COMMIT_BYTES,
    };
    use dpm_device::planes::{PlaneSchedule, Raster};
    use dpm_device::time::{DeviceTicks, FrameRate};
    use dpm_device::transport::inproc::Direct;
    use std::cell::Cell;

    /// The laws that every report of a projector must obey.
    fn check_laws(mock: &MockProjector) {
        let s = mock.status();
        assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank, "{s:?}");
        let ended =
            s.frames_lit + s.frames_incomplete + s.frames_late + s.frames_superseded + s.frames_refused;
        assert_eq!(s.frames_seen, ended + mock.in_flight(), "{s:?}");
    }

    fn raster() -> Raster {
        Raster::new(32, 8).unwrap()
    }

    fn planes(id: u64) -> Vec<u8> {
        let draws = Draws::new(id);
        (0..raster().plane_bytes() as u64 * 24).map(|i| draws.bits(i) as u8).collect()
    }

    fn settings() -> LinkSettings {
        LinkSettings {
            raster: raster(),
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(947, 1).unwrap(),
            watchdog_us: 50_000,
            underrun: Underrun::Repeat,
            late_slots: 0,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: Codec::ALL,
            flash_limit: None,
            limits: LightLimits::OFF,
        }
    }

    struct SecondOfRun {
        cable: Direct<FaultyProjector>,
        link: HostLink,
        lit: Vec<u32>,
        longest_dark_ns: i64,
    }

    /// One second at virtual pace, arming again whenever the link is ready or faulted.
    fn run(plan: &str, seed: u64) -> SecondOfRun {
        let mock = MockProjector::new(MockConfig::new(raster()));
        let faulty = FaultyProjector::new(mock, plan.parse().unwrap(), seed, HostTime(0)).unwrap();
        let mut cable = Direct::new(faulty);
        let mut link = HostLink::new(settings());
        link.connect();
        let rate = settings().rate;
        let mut lit = Vec::new();
        let (mut dark_from, mut longest) = (None, 0);
        for slot in 1..947u64 {
            let now = HostTime(rate.slot_start_ns(slot));
            // A refused ARM is tried again with the next slot.
            match link.poll(now, &mut cable) {
                Ok(LinkState::Ready) => link.arm(0),
                Ok(LinkState::Faulted) | Err(_) => link.arm(u32::MAX),
                Ok(_) => {}
            }
            if link.state() == LinkState::Streaming {
                let slots = link.slots().unwrap();
                let (target, dark_from) = (slots.start(slot + 2), slots.dark_from(slot + 2, 1_000_000_000));
                link.send_frame(now, slot, target, dark_from, &planes(slot), &mut cable);
            }
            let mock = cable.device_mut().projector();
            check_laws(mock);
            assert_eq!(mock.credit_violations(), 0);
            while let Some(e) = mock.next_light() {
                lit.extend(e.frame);
            }
            if let Some(id) = mock.lit_frame() {
                assert_eq!(mock.lit_planes().unwrap(), planes(u64::from(id)), "{plan}: frame {id}");
            }
            if mock.is_lit() {
                dark_from = None;
            } else if !lit.is_empty() {
                longest = longest.max(now.ns_since(*dark_from.get_or_insert(now)));
            }
        }
        SecondOfRun { cable, link, lit, longest_dark_ns: longest }
    }

    #[test]
    fn u7_every_fault_is_survived_and_runs_are_repeatable() {
        for plan in [
            "corrupt=0.000001",
            "corrupt=0.0001",
            "corrupt=0.01",
            "corrupt=0.1",
            "loss=0.02",
            "truncate=0.01",
            "duplicate=0.3",
            "reorder=0.1",
            "stall@200ms+30ms",
            "loss=0.005,corrupt=0.005,duplicate=0.01,reorder=0.005,truncate=0.005",
        ] {
            let a = run(plan, 3);
            let b = run(plan, 3);
            assert_eq!(a.lit, b.lit, "{plan}: same seed, same light");
            assert!(a.lit.windows(2).all(|w| w[0] <= w[1]), "{plan}: light goes forward");
            assert_eq!(a.link.state(), LinkState::Streaming, "{plan}");
            assert!(a.longest_dark_ns == 0, "{plan}: dark for {} ns", a.longest_dark_ns);
            let c = a.link.counters();
            let dropped = c.not_streaming + c.no_credit + c.link_busy + c.not_newer;
            assert_eq!(c.frames_offered, c.frames_sent + dropped, "{plan}");
        }
        let clean = run("", 1);
        assert_eq!(clean.cable.device().struck(), 0);
        assert!(clean.lit.len() > 930);
        let noisy = run("corrupt=0.01", 1);
        assert!(noisy.cable.device().struck() > 50, "faults do strike");
    }

    #[test]
    fn a_dropout_longer_than_the_watchdog_is_dark_and_a_reset_is_greeted() {
        let out = run("dropout@300ms+200ms", 5);
        assert!((140_000_000..260_000_000).contains(&out.longest_dark_ns), "{}", out.longest_dark_ns);
        assert_eq!(out.link.state(), LinkState::Streaming);
        let reset = run("reset@400ms", 5);
        assert_eq!(reset.link.counters().sessions, 2);
        assert!((1..500_000_000).contains(&reset.longest_dark_ns), "{}", reset.longest_dark_ns);
        assert_eq!(reset.link.state(), LinkState::Streaming);
    }

    #[test]
    fn unknown_faults_are_refused_by_name() {
        let mock = MockProjector::new(MockConfig::new(raster()));
        let error = FaultyProjector::new(mock, "jump=1@1s".parse().unwrap(), 1, HostTime(0)).err().unwrap();
        assert!(error.to_string().contains("`jump` means nothing to the projector"), "{error}");
    }

    #[test]
    fn a_measurement_counts_what_arrives() {
        let mock = MockProjector::new(MockConfig::new(raster()));
        let mut cable = Direct::new(mock);
        let mut link = HostLink::new(LinkSettings { late_slots: 3, ..settings() });
        link.connect();
        let now = Cell::new(0i64);
        // A clock that advances with every reading: virtual time.
        let clock = || {
            now.set(now.get() + 20_000);
            HostTime(now.get())
        };
        while link.state() != LinkState::Streaming {
            if link.poll(clock(), &mut cable).unwrap() == LinkState::Ready {
                link.arm(0);
            }
        }
        let target = DeviceTicks(now.get() as u64);
        let dark_from = DeviceTicks(target.0 + 1_000_000_000);
        assert_eq!(link.send_frame(clock(), 1, target, dark_from, &planes(1), &mut cable), SendOutcome::Sent);
        let still = planes(7);
        let m = measure(
            &mut link,
            &mut cable,
            &clock,
            &mut || {},
            &mut |_, p| p.copy_from_slice(&still),
            &|| false,
            1_000_000_000,
        )
        .unwrap();
        // The cable is infinitely fast: the frame rate sets the pace, and only the first of equal frames has planes.
        assert!(!m.link_limits() && m.no_credit > 0, "{m:?}");
        assert!((m.frames_whole as i64 - m.frames_sent as i64).abs() <= 1, "{m:?}");
        assert!((940.0..4.0 * 947.0 + 50.0).contains(&m.frames_per_s), "{m:?}");
        assert_eq!(m.planes[0] + m.planes[1] + m.planes[2], m.frames_sent * 24);
        assert!(m.planes[2] >= (m.frames_sent - 2) * 24, "{m:?}");
        assert!(m.bytes_per_frame < packet_bytes(COMMIT_BYTES) as f64 + 1.0, "{m:?}");
    }
}
