//! The bit-plane projector whose panel is an ALP, at virtual pace: the host's own link on one side, the fake panel on the other.

use dpm_alp::{Alp, AlpError, AlpProjector, ShowMode, Weights, MEMORY_SPARE};
use dpm_device::link::{
    faults, Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome, Underrun, Verb,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::LinkDevice;
use fake_alp::{library, FakeAlp, Shown};

const MS: i64 = 1_000_000;
const S: i64 = 1_000_000_000;
const RASTER: (u32, u32) = (80, 3);

#[derive(Clone, Copy)]
struct Case {
    schedule: PlaneSchedule,
    weights: Weights,
    hz: u32,
    runs: u32,
    panel: &'static str,
}

const EIGHT: fn() -> Case =
    || Case { schedule: PlaneSchedule::mono8(), weights: Weights::Equal, hz: 100, runs: 1, panel: "" };

struct World {
    fake: FakeAlp,
    cable: Direct<AlpProjector>,
    link: HostLink,
    case: Case,
    now: i64,
    sent: u64,
    told: Vec<u32>,
}

fn open(fake: FakeAlp, case: &Case) -> Result<AlpProjector, AlpError> {
    let pause = Box::new(move |time: std::time::Duration| {
        fake.set_time(fake.witness().now_ns + time.as_nanos() as i64);
    });
    let mut alp = Alp::open_paced(Some(&library()), fake.number(), pause)?;
    let rate = FrameRate::new(case.hz, 1).unwrap();
    let frames = 3 + MEMORY_SPARE;
    let showing = ShowMode { schedule: case.schedule, weights: case.weights, rate, frames, runs: case.runs };
    alp.prepare(&showing)?;
    AlpProjector::new(alp, showing, None, HostTime(0))
}

fn link(case: &Case) -> HostLink {
    let mut link = HostLink::new(LinkSettings {
        raster: Raster::new(RASTER.0, RASTER.1).unwrap(),
        schedule: case.schedule,
        rate: FrameRate::new(case.hz, 1).unwrap(),
        watchdog_us: 3_000_000 / case.hz,
        underrun: Underrun::Repeat,
        late_slots: 255,
        epoch: Epoch::AfterHello(5_000_000),
        codecs: 0,
        flash_limit: None,
        limits: LightLimits::OFF,
    });
    link.connect();
    link
}

/// A plane that says which it is: in every row the frame's number and the plane's, and the complement of both, so that every plane gives
/// the same light.
fn plane_of(frame: u64, k: usize) -> [u8; 30] {
    let mix = ((frame as u32).wrapping_mul(0x9e37_79b9) ^ k as u32) >> 24;
    let half = [(frame >> 16) as u8, (frame >> 8) as u8, frame as u8, k as u8, mix as u8];
    std::array::from_fn(|i| if i % 10 < 5 { half[i % 5] } else { !half[i % 5] })
}

fn planes_of(frame: u64, planes: usize) -> Vec<u8> {
    (0..planes).map(|k| plane_of(frame, k)).collect::<Vec<_>>().concat()
}

/// The frame and plane that a picture is, if it is one of `planes_of`, whole.
fn whose(shown: &Shown, planes: usize) -> (u64, usize) {
    let p = &shown.plane;
    let (frame, k) = (u64::from(p[0]) << 16 | u64::from(p[1]) << 8 | u64::from(p[2]), usize::from(p[3]));
    assert!(k < planes && **p == plane_of(frame, k), "a picture that nobody sent: {shown:?}");
    (frame, k)
}

impl World {
    fn new(case: Case) -> Self {
        let settings = format!("size={}x{},call=2,{}", RASTER.0, RASTER.1, case.panel);
        Self::on(FakeAlp::at_virtual_pace(&settings), case)
    }

    fn on(fake: FakeAlp, case: Case) -> Self {
        let projector = open(fake, &case).unwrap_or_else(|e| panic!("{e}"));
        let now = fake.witness().now_ns;
        Self { fake, cable: Direct::new(projector), link: link(&case), case, now, sent: 0, told: Vec::new() }
    }

    /// A world in which light may be.
    fn streaming(case: Case) -> Self {
        let mut world = Self::new(case);
        world.come_up();
        world
    }

    fn come_up(&mut self) {
        for _ in 0..10_000 {
            match self.poll() {
                LinkState::Ready => self.link.arm(0),
                LinkState::Streaming => return,
                _ => {}
            }
            self.go_to(self.now + MS / 2);
        }
        panic!("the link does not come up: {:?}", self.link.state());
    }

    fn poll(&mut self) -> LinkState {
        self.link.poll(HostTime(self.now), &mut self.cable).unwrap_or_else(|e| panic!("{e}"))
    }

    /// Lets time pass, while the projector does what is due.
    fn go_to(&mut self, end: i64) {
        loop {
            let due = dpm_device::projector::Served::next_due(self.cable.device()).map_or(end, |due| due.0);
            self.now = self.now.max(due.min(end)).max(self.fake.witness().now_ns);
            self.fake.set_time(self.now);
            self.cable.device_mut().advance_to(HostTime(self.now));
            if self.now >= end && due >= end || self.cable.device().error().is_some() {
                self.now = self.now.max(end);
                return self.fake.set_time(self.now);
            }
        }
    }

    fn slot_ns(&self) -> i64 {
        S / i64::from(self.case.hz)
    }

    /// Sends one frame for the slot after the next, and lives until half of the next slot.
    fn frame(&mut self) -> SendOutcome {
        let slots = self.link.slots().expect("configured");
        let slot = slots.slot_at(DeviceTicks(self.now as u64)).unwrap_or(0) + 2;
        let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 3 * self.slot_ns() as u64));
        let planes = planes_of(self.sent, self.case.schedule.len());
        let outcome =
            self.link.send_frame(HostTime(self.now), self.sent, target, dark_from, &planes, &mut self.cable);
        self.sent += 1;
        self.go_to(slots.start(slot - 1).0 as i64 + self.slot_ns() / 2);
        self.poll();
        outcome
    }

    /// Pictures with light that are over.
    fn light(&self) -> Vec<Shown> {
        let all = std::iter::from_fn(|| self.fake.next_shown());
        all.filter(|shown| shown.plane.iter().any(|byte| *byte != 0)).collect()
    }

    /// The law of a quiet end: dark, nothing refused, nothing leaked.
    fn end(self) {
        let Self { fake, cable, .. } = self;
        drop(cable);
        let witness = fake.witness();
        assert_eq!((witness.leaked, witness.sequences, witness.is_allocated), (0, 0, 0));
        fake.set_time(witness.now_ns + S);
        assert_eq!(fake.witness().is_lit, 0);
    }
}

/// Every frame that was sent in time is lit in its slot, whole, in order and bit for bit; the panel's clock may be off.
#[test]
fn the_light_is_what_was_sent() {
    let rgb = Case { schedule: PlaneSchedule::rgb24(), hz: 140, ..EIGHT() };
    let binary = Case { weights: Weights::Binary, hz: 80, ..EIGHT() };
    let twice = Case { runs: 2, ..EIGHT() };
    let slow = Case { panel: "ppm=-100", ..EIGHT() };
    let fast = Case { panel: "ppm=100,keeps=0", ..EIGHT() };
    for (name, case) in [("rgb", rgb), ("binary", binary), ("twice", twice), ("slow", slow), ("fast", fast)] {
        let mut world = World::streaming(case);
        let planes = case.schedule.len();
        let n = 300;
        for k in 0..n {
            let outcome = world.frame();
            let status = world.cable.device().firmware().status();
            let error = world.cable.device().error();
            assert_eq!(
                outcome,
                SendOutcome::Sent,
                "{name} {k}: {:?} {status:?} {error:?}",
                world.link.state()
            );
        }
        world.go_to(world.now + 10 * world.slot_ns());
        let light: Vec<(u64, usize)> = world.light().iter().map(|shown| whose(shown, planes)).collect();
        let mut expected: Vec<(u64, usize)> = Vec::new();
        for frame in 0..n {
            expected.extend((0..planes).map(|k| (frame, k)));
        }
        // Planes of a frame that is shown again, because nothing follows it or the next one begins a moment late, come on top.
        let mut again = 0;
        let mut at = 0;
        for picture in &light {
            if expected.get(at) == Some(picture) {
                at += 1;
            } else {
                let newest = at.saturating_sub(1) / planes;
                assert_eq!(picture.0, expected[newest * planes].0, "{name}: {picture:?} at {at}");
                again += 1;
            }
        }
        assert_eq!(at, expected.len(), "{name}: everything is lit");
        let status = world.cable.device().firmware().status();
        assert_eq!((status.frames_lit, status.frames_late), (n as u32, 0), "{name}");
        // The last frame is repeated for two slots, until its light must end. With two runs one plane more comes with some frames.
        let most = 2 * planes + if case.runs > 1 { n as usize } else { 0 };
        assert!(again <= most, "{name}: {again} planes more than sent");
        assert!(case.runs > 1 || world.fake.witness().refusals == 0, "{name}: {:?}", world.fake.witness());
        world.end();
    }
}

/// When light begins and ends: with the slot but for the panel's start, and at the end that the frame carries but for one plane.
#[test]
fn light_begins_with_the_slot_and_ends_when_the_frame_says() {
    let mut world = World::streaming(EIGHT());
    for _ in 0..20 {
        world.frame();
    }
    let slots = world.link.slots().unwrap();
    let last = slots.slot_at(DeviceTicks(world.now as u64)).unwrap() + 1;
    world.go_to(world.now + S);
    let light = world.light();
    for shown in light.iter().filter(|shown| whose(shown, 8).1 == 0) {
        let slot = slots.slot_at(DeviceTicks(shown.from_ns as u64)).unwrap();
        let after = shown.from_ns - slots.start(slot).0 as i64;
        assert!((0..200_000).contains(&after), "{after} ns after the slot");
    }
    let end = slots.dark_from(last, 3 * world.slot_ns() as u64).0 as i64;
    let (over, plane) = (light.last().unwrap().until_ns - end, world.slot_ns() / 9);
    assert!(over <= plane, "{over} ns beyond the end that the frame carries");
    // The host is silent: the watchdog has latched.
    assert_eq!(world.cable.device().firmware().status().faults, faults::WATCHDOG);
    world.end();
}

#[test]
fn orders_end_the_light_within_a_plane() {
    for verb in [Verb::Black, Verb::Safe, Verb::Stop] {
        let mut world = World::streaming(EIGHT());
        for _ in 0..10 {
            world.frame();
        }
        world.go_to(world.now + MS);
        let _ = world.link.command(HostTime(world.now), verb, &mut world.cable);
        let ordered = world.now;
        world.go_to(world.now + S / 2);
        let end = world.light().last().unwrap().until_ns;
        let limit = if verb == Verb::Black { world.slot_ns() + MS } else { world.slot_ns() / 9 + MS / 10 };
        assert!(end - ordered < limit, "{verb:?}: {} ns", end - ordered);
        assert_eq!(world.fake.witness().is_lit, 0);
        world.end();
    }
}

/// A cable that carries a frame in two slots: every frame that is lit is whole, late ones are told as late, and light and reports agree.
#[test]
fn what_the_cable_delays_is_lit_later_and_told() {
    // 8 planes of 30 bytes in 15 ms, slots of 10 ms.
    let mut world = World::streaming(Case { panel: "usb=16000", ..EIGHT() });
    for _ in 0..100 {
        world.frame();
    }
    world.go_to(world.now + S / 2);
    let lit: Vec<u64> =
        world.light().iter().map(|shown| whose(shown, 8)).filter(|p| p.1 == 0).map(|p| p.0).collect();
    let mut frames = lit.clone();
    frames.dedup();
    assert!(frames.len() > 30 && frames.windows(2).all(|w| w[0] < w[1]), "{frames:?}");
    let status = world.cable.device().firmware().status();
    assert_eq!(status.frames_lit as usize, frames.len());
    assert_eq!(world.fake.witness().refusals, 0);
    world.end();
}

/// Whatever fails while light is on: it ends, the cause is told, nothing leaks, and the device can be opened again.
#[test]
fn every_fault_ends_in_the_dark() {
    for call in ["put", "start", "progress", "proj-control", "any"] {
        for kind in ["comm", "removed", "not-idle", "memory-full", "in-use", "halted", "unknown"] {
            for when in ["3", "7..", "20..23"] {
                let mut world = World::streaming(EIGHT());
                for _ in 0..5 {
                    world.frame();
                }
                world.fake.plan(&format!("{kind}@{call}={when}"));
                let struck = (0..40).any(|_| {
                    world.frame();
                    world.cable.device().error().is_some()
                });
                let what = format!("{kind} at {call} {when}");
                // Every frame is put, started and asked after; only going dark controls the projection.
                assert!(struck || call == "proj-control", "{what}");
                let at = world.now;
                world.go_to(world.now + S / 2);
                let light = world.light();
                let over = light.last().unwrap().until_ns - at;
                assert!(!struck || over <= 3 * world.slot_ns(), "{what}: {over} ns of light after the fault");
                world.fake.plan("");
                let (fake, case) = (world.fake, world.case);
                drop(world.cable);
                assert_eq!((fake.witness().leaked, fake.witness().is_lit), (0, 0), "{what}");
                assert_eq!(fake.witness().is_allocated, 0, "{what}");
                let again = open(fake, &case).unwrap_or_else(|e| panic!("{what}: {e}"));
                drop(again);
            }
        }
    }
}

#[test]
fn heat_is_a_fault_until_it_is_gone() {
    let mut world = World::streaming(EIGHT());
    world.frame();
    world.fake.set_celsius(86.0);
    for _ in 0..250 {
        world.frame();
        world.told.push(world.cable.device().firmware().status().faults);
    }
    assert!(world.told.contains(&faults::OVER_TEMPERATURE), "{:?}", world.told);
    assert_eq!(world.fake.witness().is_lit, 0);
    assert_eq!(world.link.state(), LinkState::Faulted);
    world.link.arm(faults::OVER_TEMPERATURE);
    let refused = (0..5).find_map(|_| {
        world.go_to(world.now + MS);
        world.link.poll(HostTime(world.now), &mut world.cable).err()
    });
    assert!(refused.is_some_and(|e| e.to_string().contains("over-temperature")), "still too hot");
    world.fake.set_celsius(60.0);
    world.go_to(world.now + 3 * S);
    // The host was silent for so long that the link has opened another session.
    for _ in 0..50 {
        if world.poll() == LinkState::Faulted {
            world.link.arm(faults::OVER_TEMPERATURE);
        }
        world.go_to(world.now + MS);
    }
    let status = world.cable.device().firmware().status();
    assert_eq!(
        world.link.state(),
        LinkState::Streaming,
        "{status:?} {:?}",
        world.cable.device().temperatures()
    );
    world.end();
}

/// A simulated day.
mod breadth {
    use super::*;

    /// A day at four frames a second, with a fault, an order or a new session now and then.
    #[test]
    fn a_day_leaks_nothing() {
        let case = Case {
            schedule: PlaneSchedule::mono8(),
            weights: Weights::Equal,
            hz: 4,
            runs: 1,
            panel: "ppm=40",
        };
        let mut world = World::streaming(case);
        let day = 24 * 3600 * S;
        let (mut frames, mut lit, mut opened) = (0u64, 0u64, 0);
        while world.now < day {
            for _ in 0..2000 {
                if world.frame() == SendOutcome::Sent {
                    frames += 1;
                }
            }
            lit += world.light().iter().filter(|shown| whose(shown, 8).1 == 7).count() as u64;
            assert_eq!(world.fake.witness().sequences as usize, 3 + MEMORY_SPARE + 1);
            let w = world.fake.witness();
            assert_eq!((w.refusals, w.shown_lost), (0, 0), "{w:?}");
            // The device fails and is opened again: a new session on the same panel.
            opened += 1;
            world.fake.plan(["comm@put=2", "removed@start=1", "halted@progress=3"][opened % 3]);
            for _ in 0..4 {
                world.frame();
            }
            assert!(world.cable.device().error().is_some());
            world.go_to(world.now + S);
            lit += world.light().iter().filter(|shown| whose(shown, 8).1 == 7).count() as u64;
            let World { fake, cable, .. } = world;
            drop(cable);
            fake.plan("");
            assert_eq!((fake.witness().leaked, fake.witness().sequences), (0, 0));
            world = World::on(fake, case);
            world.come_up();
        }
        assert!(frames > 340_000 && lit > frames * 99 / 100, "{lit} of {frames} frames lit");
        world.end();
    }
}
