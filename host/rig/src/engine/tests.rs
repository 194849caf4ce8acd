//! Tests of the engine under a clock that the test moves. No thread runs, and nobody sleeps.

use super::connect::Connecting;
use super::error::PipelineError;
use super::facts::{CrewFacts, Facts};
use super::keeper::LinkKeeper;
use super::link::{LinkStage, Offer};
use super::options::RunOptions;
use super::pace::{Pace, Real, Virtual};
use super::pack::PackStage;
use super::plan::PlanStage;
use super::pulse::Pulse;
use super::supervision::{CrewVerdict, Irreplaceable, Making, Remake, Supervision, Trouble};
use crate::config::{Overrides, RigConfig};
use crate::frame::job::{Fate, FrameNote};
use crate::mock::{EmulatedProjector, MockConfig};
use crate::order::Order;
use crate::pipeline::projector;
use crate::plan::lead::LeadEstimator;
use crate::plan::link_time::LinkTime;
use crate::rig::Rig;
use crate::telemetry::light_gauge::{LightReport, NEVER};
use crate::telemetry::light_state::LightState;
use crate::telemetry::monitor::{ProjectorHealth, RunMonitor};
use crate::tracks::TrackSnapshot;
use dpm_device::link::{DeviceState, DropReason, HostLink, LinkState, Packet, SendOutcome, Status};
use dpm_device::planes::Raster;
use dpm_device::rng::Draws;
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::{Lane, LinkDevice, SendError, Transport, TransportError};
use dpm_render::pack::BitPlaneFrame;
use std::sync::atomic::Ordering;
use std::sync::Arc;

const MS: i64 = 1_000_000;

fn rig(flags: &[&str]) -> Arc<Rig> {
    let flags = flags.iter().map(|f| (*f).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    Arc::new(Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}")))
}

/// A rig whose link to a mock is up, and the current time.
struct LinkedRig {
    facts: Arc<Facts>,
    crew: Arc<CrewFacts>,
    link: Option<(HostLink, LinkKeeper)>,
    cable: Direct<EmulatedProjector>,
    lead: LeadEstimator,
    time: LinkTime,
    now: HostTime,
    slot_ns: i64,
}

fn bench(flags: &[&str], options: RunOptions) -> LinkedRig {
    bench_with(flags, options, 1)
}

/// The same with a mock that holds so many frames.
fn bench_with(flags: &[&str], options: RunOptions, frame_buffers: u8) -> LinkedRig {
    bench_of(flags, options, |setup| setup.frame_buffers = frame_buffers, Arc::default())
}

/// The same with any mock and monitor.
fn bench_of(
    flags: &[&str],
    options: RunOptions,
    change: impl Fn(&mut MockConfig),
    monitor: Arc<RunMonitor>,
) -> LinkedRig {
    let rig = rig(flags);
    let mut now = HostTime(5 * MS);
    let mut setup = MockConfig::new(rig.camera.raster);
    change(&mut setup);
    let mock = EmulatedProjector::new(setup, "", 1, now).expect("no faults");
    let mut cable = Direct::new(mock);
    let mut link = HostLink::new(projector::link_settings(&rig.config, rig.camera.raster));
    let mut connecting = Connecting::begin(&mut link, 0, now);
    let time = loop {
        now = now.plus_ns(50_000);
        if let Some(time) = connecting.step(now, &mut link, &mut cable, &monitor, false).expect("it comes up")
        {
            break time;
        }
    };
    let slot_ns = rig.rate().slot_len_ns(0);
    let lead = LeadEstimator::new(slot_ns, 3 * MS, 2 * slot_ns);
    let facts = Arc::new(Facts::new(rig.clone(), monitor, options, &lead, now));
    let keeper = LinkKeeper::new(time, &link, rig.bodies.len(), None);
    let crew = Arc::new(CrewFacts::new(0, slot_ns));
    LinkedRig { facts, crew, link: Some((link, keeper)), cable, lead, time, now, slot_ns }
}

impl LinkedRig {
    fn plan<P: Pace>(&self) -> PlanStage<P> {
        PlanStage::new(self.facts.clone(), self.crew.clone(), &self.time, self.now)
    }

    fn link<P: Pace>(&mut self) -> LinkStage<P> {
        let (link, keeper) = self.link.take().expect("once");
        LinkStage::new(self.facts.clone(), link, keeper, self.lead.clone())
    }

    /// Plans the next frame at the instant that planning asks for.
    fn planned<P: Pace>(&mut self, stage: &mut PlanStage<P>) -> Option<Box<FrameNote>> {
        let latch = stage.choose_slot(&self.time, self.now)?;
        self.now = self.now.max(latch.at);
        let mut note = Box::new(FrameNote::new(&self.facts.rig));
        let nothing = TrackSnapshot::empty(self.facts.rig.tracked_count());
        stage.plan(&latch, &mut note, &self.time, &nothing, self.now);
        stage.submitted(&mut note, self.now);
        Some(note)
    }
}

/// Issue 51: a projector is known by the serial number in HELLO. An order that stands for it is obeyed before it is armed.
#[test]
fn a_projector_for_which_an_order_stands_is_never_armed_wherever_it_is_plugged_in() {
    for (serial, held, stays_dark) in [(7, 7, true), (7, 8, false), (1, 1, false), (0, 0, false)] {
        let monitor = Arc::new(RunMonitor::default());
        monitor.hold_devices(vec![(held, Order::Black), (held, Order::Safe), (9, Order::Black)]);
        let options = RunOptions::default();
        let bench = bench_of(&[], options, |setup| setup.serial = serial, monitor.clone());
        let (link, _) = bench.link.expect("a link");
        assert_eq!(link.state() == LinkState::Streaming, !stays_dark, "{serial}, {held}");
        assert_eq!(monitor.take_found_held(), stays_dark.then_some(Order::Safe));
        assert_eq!(monitor.take_order(), stays_dark.then_some(Order::Safe));
        assert_eq!(monitor.device(), Some(serial).filter(|s| *s > 1));
        // A HELLO that is repeated, and one after a person has armed it, gives no order again.
        monitor.meet_device(serial);
        monitor.lift_held(serial);
        monitor.meet_device(3);
        monitor.meet_device(serial);
        assert_eq!(monitor.take_order(), None);
        monitor.meet_device(9);
        assert_eq!(monitor.take_order(), Some(Order::Black), "another one, for which one stands too");
        // An order of this run holds it when it is back.
        monitor.hold_device(11, Order::Black);
        monitor.hold_device(11, Order::Safe);
        monitor.meet_device(11);
        assert_eq!(monitor.take_order(), Some(Order::Safe));
        // More than are remembered are all held.
        monitor.hold_devices((100..200).map(|device| (device, Order::Black)).collect());
        monitor.meet_device(12);
        assert_eq!(monitor.take_order(), Some(Order::Black));
    }
}

#[test]
fn every_slot_gets_a_frame_that_is_latched_its_lead_before() {
    let mut bench = bench(&[], RunOptions { frames: 50, ..RunOptions::default() });
    let mut stage = bench.plan::<Real>();
    let mut slots = Vec::new();
    while let Some(note) = bench.planned(&mut stage) {
        let lead_ns =
            bench.facts.lead_ns.load(Ordering::Relaxed) + bench.facts.travel_ns.load(Ordering::Relaxed);
        assert_eq!(note.timeline.due_at.ns_since(note.timeline.latched_at), lead_ns);
        slots.push(note.plan.slot);
    }
    assert_eq!(slots.len(), 50);
    assert!(slots.windows(2).all(|w| w[1] == w[0] + 1), "{slots:?}");
    assert!(stage.is_complete());
}

#[test]
fn a_planner_that_stood_still_goes_on_with_the_first_slot_that_a_usual_frame_can_reach() {
    let mut bench = bench(&[], RunOptions::default());
    let mut stage = bench.plan::<Real>();
    let before = bench.planned(&mut stage).expect("no end");
    bench.now = bench.now.plus_ns(500 * MS);
    let needed_ns =
        bench.facts.typical_ns.load(Ordering::Relaxed) + bench.facts.travel_ns.load(Ordering::Relaxed);
    let earliest = bench.now.plus_ns(needed_ns);
    let after = bench.planned(&mut stage).expect("no end");
    assert!(after.timeline.due_at >= earliest, "the slot can still be reached");
    assert!(after.timeline.due_at.ns_since(earliest) < bench.slot_ns, "and it is the first one");
    let missed = 500 * MS / bench.slot_ns;
    assert!((after.plan.slot - before.plan.slot) as i64 >= missed - 1);
}

#[test]
fn a_gpu_slower_than_its_slots_gets_its_frames_one_at_a_time() {
    let bench = bench(&[], RunOptions::default());
    let stage = bench.plan::<Real>();
    assert!(stage.may_begin());
    bench.crew.gpu.submit();
    assert!(stage.may_begin(), "a quick one may have several");
    for _ in 0..20 {
        bench.crew.gpu.submit();
        bench.crew.gpu.finish(3 * bench.slot_ns);
    }
    assert!(!stage.may_begin());
    bench.crew.gpu.finish(3 * bench.slot_ns);
    assert!(stage.may_begin(), "it is free");
}

#[test]
fn a_run_by_slots_ends_at_its_last_slot_whether_frames_made_it_or_not() {
    let mut bench = bench(&[], RunOptions { slots: 100, ..RunOptions::default() });
    let mut stage = bench.plan::<Real>();
    let first = bench.planned(&mut stage).expect("begins").plan.slot;
    bench.now = bench.now.plus_ns(60 * bench.slot_ns);
    let mut last = first;
    while let Some(note) = bench.planned(&mut stage) {
        last = note.plan.slot;
    }
    assert_eq!(last, first + 99);
    // A crew that takes over keeps the same end.
    assert!(bench.plan::<Real>().choose_slot(&bench.time, bench.now).is_none());
}

#[test]
fn at_virtual_pace_a_frame_is_latched_as_early_as_the_rig_file_says_that_its_stages_take() {
    let mut bench = bench(&[], RunOptions { frames: 20, ..RunOptions::default() });
    let mut stage = bench.plan::<Virtual>();
    let costs: i64 = bench.facts.modelled_costs().iter().sum();
    // What was learned at real pace has no effect.
    bench.facts.lead_ns.store(123 * MS, Ordering::Relaxed);
    while let Some(note) = bench.planned(&mut stage) {
        let lead_ns = note.timeline.due_at.ns_since(note.timeline.latched_at);
        assert_eq!(lead_ns, costs + 50_000);
    }
}

#[test]
fn packing_leaves_out_what_a_newer_frame_has_overtaken_but_shows_a_slow_gpus_late_frames() {
    let mut bench = bench(&[], RunOptions { in_flight: 4, ..RunOptions::default() });
    let mut plan = bench.plan::<Real>();
    let mut stage = PackStage::new(bench.facts.clone(), bench.crew.clone(), None);
    let mut note = bench.planned(&mut plan).expect("no end");
    let due = note.timeline.due_at;
    assert!(stage.is_wanted(&mut note, due.plus_ns(-1), false), "in time");
    assert!(stage.is_wanted(&mut note, due, true), "late, and the newest there is");
    assert!(!stage.is_wanted(&mut note, due, false));
    assert_eq!(note.fate, Fate::Overtaken);
    // Consecutive late rendered frames are not a stall, from the fifth on with four in flight.
    let wanted: Vec<bool> = (0..8)
        .map(|_| {
            let mut note = bench.planned(&mut plan).expect("no end");
            note.cost = Some(Default::default());
            let late = note.timeline.due_at.plus_ns(MS);
            stage.is_wanted(&mut note, late, false)
        })
        .collect();
    // The two late frames above count.
    assert_eq!(wanted, [false, false, true, true, true, true, true, true]);
}

/// A frame waits for a buffer of the projector, but not beyond the beginning of its slot. A frame that is overtaken
/// or too old is not sent.
#[test]
fn a_frame_waits_for_room_until_its_slot_begins() {
    let mut bench = bench(&[], RunOptions::default());
    let mut plan = bench.plan::<Real>();
    let mut stage = bench.link::<Real>();
    let schedule = bench.facts.rig.config.projector.schedule();
    let planes = BitPlaneFrame::new(bench.facts.rig.camera.raster, schedule);
    // The mock holds one frame besides the one on its mirrors, so the second frame finds no room before the first is
    // lit.
    let begin = bench.now;
    let mut first = bench.planned(&mut plan).expect("no end");
    let at = bench.now;
    for ms in 0..at.ns_since(begin) / MS {
        // The watchdog needs to hear from the host.
        stage.poll(begin.plus_ns(ms * MS), &mut bench.cable);
    }
    assert_eq!(stage.offer(at, &mut first, planes.bytes(), true, &mut bench.cable), Offer::Settled);
    assert_eq!(first.fate, Fate::Offered(SendOutcome::Sent));
    stage.taken(&mut first, at.plus_ns(MS));
    assert_eq!(first.timeline.sent_at, at.plus_ns(MS));
    let mut second = bench.planned(&mut plan).expect("no end");
    second.timeline.packed_at = bench.now;
    let (mut now, mut waits) = (bench.now, 0);
    while let Offer::Again(at) = stage.offer(now, &mut second, planes.bytes(), true, &mut bench.cable) {
        assert!(at > now && at.ns_since(now) <= MS, "it asks again soon");
        assert!(now < second.timeline.due_at, "it does not wait beyond its slot");
        (now, waits) = (at, waits + 1);
    }
    assert!(waits > 0 && second.is_sent(), "{waits} waits, {:?}", second.fate);
    assert!(now >= first.timeline.due_at, "the first frame made room when it was lit");
    // Overtaken: its slot has begun, and a newer frame waits.
    let mut third = bench.planned(&mut plan).expect("no end");
    let late = third.timeline.due_at.plus_ns(MS);
    assert_eq!(stage.offer(late, &mut third, planes.bytes(), false, &mut bench.cable), Offer::Settled);
    assert_eq!(third.fate, Fate::Overtaken);
    // It would be too old when lit.
    let mut fourth = bench.planned(&mut plan).expect("no end");
    let old_ns = fourth.plan.predict_ns + bench.slot_ns + 1;
    (fourth.plan.is_lit, fourth.plan.captured_at) = (true, late.plus_ns(-old_ns));
    fourth.timeline.due_at = late;
    assert_eq!(stage.offer(late, &mut fourth, planes.bytes(), true, &mut bench.cable), Offer::Settled);
    assert_eq!(fourth.fate, Fate::TooOld);
}

/// A cable on which a frame takes `frame_ns` if it is even, else up to three times and now and then eight times as long, and on
/// which one frame finds room at a time.
struct Narrow {
    cable: Direct<EmulatedProjector>,
    frame_ns: i64,
    is_even: bool,
    carried: u64,
    waiting: Option<(HostTime, Vec<u8>)>,
}

impl Narrow {
    /// How long the next frame takes, nanoseconds.
    fn next_ns(&mut self) -> i64 {
        self.carried += 1;
        let draw = Draws::new(7).bits(self.carried);
        match (self.is_even, draw % 16) {
            (true, _) => self.frame_ns,
            (false, 0) => 8 * self.frame_ns,
            (false, _) => self.frame_ns + self.frame_ns * ((draw >> 8) % 256) as i64 / 128,
        }
    }
}

impl Transport for Narrow {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        match lane {
            Lane::Control => self.cable.send(now, lane, packets),
            Lane::Data if self.waiting.is_some() => Err(SendError::Busy),
            Lane::Data => {
                let bytes = packets.iter().flat_map(Packet::to_vec).collect();
                self.waiting = Some((now.plus_ns(self.next_ns()), bytes));
                Ok(())
            }
        }
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        lane == Lane::Control || self.waiting.is_none()
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        if let Some((at, bytes)) = self.waiting.take_if(|(at, _)| *at <= now) {
            self.cable.device_mut().receive(at, Lane::Data, &bytes);
        }
        self.cable.receive(now, sink)
    }

    fn name(&self) -> &str {
        "narrow"
    }
}

/// What became of the light over a narrow cable.
struct NarrowLight {
    status: Status,
    /// Dark slots until the end of the first second, and until the end.
    dark: [u32; 2],
    /// Slots a frame, and frames that the host left out because the field flashed too often.
    slots: u64,
    rested: u64,
}

/// 4 s of bright frames over a cable that takes so many tenths of a slot for each.
fn carried(tenths: i64, is_even: bool) -> NarrowLight {
    let mut bench = bench_with(&["real_time.pace=\"real\""], RunOptions::default(), 4);
    let (mut plan, mut stage) = (bench.plan::<Real>(), bench.link::<Real>());
    let frame_ns = tenths * bench.slot_ns / 10;
    let raster = bench.facts.rig.camera.raster;
    let other = EmulatedProjector::new(MockConfig::new(raster), "", 2, bench.now).expect("no faults");
    let cable = std::mem::replace(&mut bench.cable, Direct::new(other));
    let mut medium = Narrow { cable, frame_ns, is_even, carried: 0, waiting: None };
    let schedule = bench.facts.rig.config.projector.schedule();
    let planes = vec![0xff; BitPlaneFrame::new(raster, schedule).bytes().len()];
    let begin = bench.now;
    let (mut dark, mut rested) = ([0; 2], 0);
    while bench.now.ns_since(begin) < 4_000 * MS {
        let before = bench.now;
        let mut note = bench.planned(&mut plan).expect("no end");
        let mut now = before;
        while now < bench.now {
            now = bench.now.min(now.plus_ns(MS / 5));
            stage.poll(now, &mut medium);
        }
        (note.timeline.rendered_at, note.timeline.packing_at, note.timeline.packed_at) = (now, now, now);
        while let Offer::Again(at) = stage.offer(now, &mut note, &planes, true, &mut medium) {
            now = at;
        }
        stage.taken(&mut note, now);
        let flashed = Fate::Offered(SendOutcome::Dropped { reason: DropReason::FlashLimit });
        rested += u64::from(note.fate == flashed);
        bench.now = bench.now.max(now);
        dark[1] = medium.cable.device_mut().projector().status().slots_blank;
        if bench.now.ns_since(begin) < 1_000 * MS {
            dark[0] = dark[1];
        }
    }
    let status = medium.cable.device_mut().projector().status();
    NarrowLight { status, dark, slots: bench.facts.slots_a_frame.load(Ordering::Relaxed), rested }
}

/// Light is steady, at every n-th slot, over a cable that carries no frame for each slot: after a quarter of a second no slot
/// is dark, no fault is latched, and frames are as many as fit.
#[test]
fn a_cable_slower_than_its_slots_carries_every_nth_frame_steadily() {
    for tenths in [15, 125] {
        let NarrowLight { status, dark, slots, rested } = carried(tenths, true);
        let fits = (tenths as u64).div_ceil(10);
        assert_eq!((status.state, status.faults, rested), (DeviceState::Armed, 0, 0), "{tenths}");
        assert!((fits - fits / 4..=fits).contains(&slots), "{tenths}: {slots} slots a frame");
        assert_eq!(dark[0], dark[1], "{tenths}: dark slots after the first second, {status:?}");
    }
}

/// Found over a pseudo-terminal: where frames take one to three times as long, and one of sixteen eight times, light went out
/// before the next frame came, which counted as flashes, and the host rested in the dark for two of three seconds. It stays
/// lit, but for a fiftieth of the time.
#[test]
fn a_cable_that_is_slow_and_uneven_carries_light_without_a_flicker() {
    for tenths in [30, 60] {
        let NarrowLight { status, dark, rested, slots } = carried(tenths, false);
        assert_eq!((status.state, status.faults, rested), (DeviceState::Armed, 0, 0), "{tenths}: {slots}");
        let (blank, all) = (u64::from(dark[1] - dark[0]), 3 * 947);
        assert!(50 * blank < all, "{tenths}: {blank} dark slots, {slots} slots a frame");
    }
}

/// A frame that is held cannot be cut when a head moves into it, so FREEZE is BLACK where heads are guarded.
#[test]
fn no_frame_is_frozen_where_heads_are_guarded() {
    for (keys, then) in [
        (&[][..], DeviceState::Frozen),
        (&["observer.tracked=\"glasses\""], DeviceState::Black),
        (&["observer.tracked=\"glasses\"", "safety.eyes.guard=false"], DeviceState::Frozen),
    ] {
        let mut bench = bench(keys, RunOptions::default());
        let mut stage = bench.link::<Real>();
        bench.facts.monitor.give_order(Order::Freeze);
        for ms in 0..20 {
            let now = bench.now.plus_ns(ms * MS);
            bench.facts.alive_at_ns.store(now.0, Ordering::Relaxed);
            stage.poll(now, &mut bench.cable);
        }
        assert_eq!(bench.cable.device_mut().projector().status().state, then, "{keys:?}");
    }
}

/// A picture that is held when a crew is lost ends, however soon the next crew works.
#[test]
fn a_frozen_picture_ends_with_the_crew_that_drew_it() {
    let mut bench = bench(&[], RunOptions::default());
    let mut stage = bench.link::<Real>();
    bench.facts.monitor.give_order(Order::Freeze);
    for ms in 0..40 {
        let now = bench.now.plus_ns(ms * MS);
        bench.facts.alive_at_ns.store(now.0, Ordering::Relaxed);
        bench.facts.crew_lost.fetch_or(ms == 20, Ordering::Relaxed);
        stage.poll(now, &mut bench.cable);
        if ms == 19 {
            assert_eq!(bench.cable.device_mut().projector().status().state, DeviceState::Frozen);
        }
    }
    assert_eq!(bench.cable.device_mut().projector().status().state, DeviceState::Black);
}

/// How long after the last frame the projector is told to be dark, nanoseconds; `None`: never.
fn told_after<P: Pace>(stopped: bool) -> Option<i64> {
    let mut bench = bench(&[], RunOptions::default());
    let mut stage = bench.link::<P>();
    let last = bench.now;
    if stopped {
        bench.facts.monitor.request_stop();
    }
    let (mut now, mut told_at) = (last, None);
    while let Some(at) = stage.end(now, last, &mut bench.cable) {
        assert!(at > now && at.ns_since(now) <= MS);
        let is_armed = bench.cable.device_mut().projector().status().state == DeviceState::Armed;
        if told_at.is_none() && !is_armed {
            told_at = Some(now);
        }
        now = at;
    }
    assert!(now.ns_since(last) < 20 * MS, "it comes to an end");
    told_at.map(|at| at.ns_since(last))
}

#[test]
fn a_run_that_ends_shows_its_last_frames_and_one_that_is_stopped_is_dark_at_once() {
    assert_eq!(told_after::<Real>(true), Some(0));
    assert_eq!(told_after::<Virtual>(true), Some(0));
    assert_eq!(told_after::<Real>(false), Some(10 * MS));
    let slot_ns = rig(&[]).rate().slot_len_ns(0);
    assert_eq!(told_after::<Virtual>(false), Some(2 * slot_ns), "to the nanosecond: a run repeats");
}

fn supervision(facts: &Arc<Facts>) -> Supervision {
    Supervision::new(facts.clone(), |_| None)
}

#[test]
fn three_lost_gpus_a_minute_are_made_good_and_many_more_stages_that_hang() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let gpu = || Trouble::Failed(PipelineError::GpuHangs { frame: 7, ms: 100 });
    let at = |s: i64| HostTime(s * 1_000 * MS);
    for second in 0..20 {
        // The GPU is asked whether it hangs too, and is kept if it answers.
        let verdict = mind.judge(Trouble::Hung(["tracking", "plan", "pack"][second % 3]), at(second as i64));
        assert_eq!(verdict, CrewVerdict::Abandon { remake: Some(Remake::Crew) });
    }
    bench.facts.monitor.take_notes();
    for second in 20..23 {
        let verdict = mind.judge(gpu(), at(second));
        assert_eq!(verdict, CrewVerdict::Abandon { remake: Some(Remake::CrewAndGpu) });
        let notes = bench.facts.monitor.take_notes().join("\n");
        assert!(notes.contains("within 2 s") && notes.contains("after 180 s the run ends"), "{notes}");
        assert!(bench.facts.take_error().is_none(), "the run goes on");
    }
    assert_eq!(mind.judge(gpu(), at(24)), CrewVerdict::Abandon { remake: None });
    assert!(matches!(bench.facts.take_error(), Some(PipelineError::KeepsFailing { most: 3, .. })));
    assert!(bench.facts.monitor.stop_requested());
}

#[test]
fn a_stage_that_hangs_every_other_second_ends_the_run_in_the_end() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let judged = |k: i64| mind.judge(Trouble::Hung("pack"), HostTime(2_000 * MS * k));
    let ended = (0..40).map(judged).position(|v| v == CrewVerdict::Abandon { remake: None });
    assert_eq!(ended, Some(20));
    assert!(matches!(bench.facts.take_error(), Some(PipelineError::KeepsFailing { most: 20, .. })));
}

/// Found in use, O8: what hangs while the run ends costs neither the report nor the exit code.
#[test]
fn a_stop_during_a_recovery_is_no_failure() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    mind.judge(Trouble::Hung("pack"), HostTime(0));
    assert!(mind.waits_for(Making::Waits, HostTime(MS)));
    bench.facts.monitor.request_stop();
    assert!(!mind.waits_for(Making::Waits, HostTime(2 * MS)), "nobody waits for the crew");
    let gpu = PipelineError::GpuHangs { frame: 7, ms: 100 };
    let verdict = mind.judge(Trouble::Failed(gpu), HostTime(3 * MS));
    assert_eq!(verdict, CrewVerdict::Abandon { remake: None });
    mind.tell_of_recovery(None);
    assert!(bench.facts.take_error().is_none());
    let recoveries = bench.facts.recoveries();
    assert!(recoveries.len() == 1 && recoveries[0].dark_s.is_none() && recoveries[0].cause.contains("pack"));
}

#[test]
fn a_link_that_goes_on_within_two_seconds_costs_no_run() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let (link, collector) = (Pulse::new("link"), Pulse::new("collector"));
    let mut watch = |from_ms: i64, to_ms: i64| {
        let looks = (from_ms / 2..to_ms / 2).map(|k| HostTime(2 * k * MS));
        looks.filter_map(|now| mind.watch(&link, &collector, now, 2 * MS).map(|_| now.0 / MS)).next()
    };
    link.beat(HostTime(0), 20 * MS);
    assert_eq!(watch(0, 1_000), None);
    let told = bench.facts.monitor.take_notes();
    assert!(told.len() == 1 && told[0].contains("the link's thread hangs"), "{told:?}");
    link.beat(HostTime(1_000 * MS), 20 * MS);
    assert_eq!(watch(1_000, 1_100), None);
    assert_eq!(bench.facts.monitor.take_notes(), ["the link's thread goes on"]);
    let ended = watch(1_100, 5_000).expect("it does not go on again");
    assert!((3_020..=3_030).contains(&ended), "{ended} ms");
    assert!(matches!(bench.facts.take_error(), Some(PipelineError::Hung { stage: "link" })));
}

/// Light that was seen before the link's thread hung does not count for longer because nobody says that it is over: a
/// black picture was on the mirrors, FREEZE held it, and then the thread hung.
#[test]
fn light_grows_old_while_the_thread_of_the_link_hangs() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let (link, collector) = (Pulse::new("link"), Pulse::new("collector"));
    let monitor = &bench.facts.monitor;
    monitor.set_projector(ProjectorHealth::Frozen);
    let told = |ms: i64| {
        let at = HostTime(1_000 * MS);
        let seen = LightReport {
            mirrors_lit_at: at,
            frame_lit_at: at,
            sent_at: at,
            head_lost_at: NEVER,
            was_armed: true,
            is_over: false,
            standing: Some(Order::Freeze),
        };
        monitor.light_gauge().tell(&seen, HostTime(ms * MS));
    };
    told(1_000);
    // The last that it says is that there was light 0.8 s ago.
    told(1_800);
    let mut word = |ms: i64| {
        mind.watch(&link, &collector, HostTime(ms * MS), 2 * MS);
        monitor.light()
    };
    assert_eq!(word(1_801), LightState::Lit { is_held: true });
    for ms in [1_950, 2_600, 2_800] {
        assert_eq!(word(ms), LightState::DarkByOrder(Order::Freeze), "{ms} ms");
    }
}

/// The light of frames that the old crew had still sent is no light after it.
#[test]
fn a_recovery_is_told_with_the_time_from_light_to_light() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let (link, collector) = (Pulse::new("link"), Pulse::new("collector"));
    let monitor = &bench.facts.monitor;
    let mut look = |ms: i64, lit: u64| {
        (0..lit).for_each(|_| monitor.count_lit(false, false));
        mind.watch(&link, &collector, HostTime(ms * MS), 2 * MS);
        if ms == 1_100 {
            mind.judge(Trouble::Hung("plan"), HostTime(ms * MS));
        }
        if ms == 1_300 {
            mind.is_remade();
        }
    };
    for (ms, lit) in [(1_000, 5), (1_100, 0), (1_110, 1), (1_300, 0), (1_400, 0), (1_450, 1)] {
        look(ms, lit);
    }
    let recoveries = bench.facts.recoveries();
    assert_eq!(recoveries.len(), 1);
    assert!(recoveries[0].dark_s.is_some_and(|s| (s - 0.34).abs() < 1e-9), "{recoveries:?}");
    assert!(monitor.take_notes().iter().any(|note| note == "light again after 0.34 s"));
}

/// A GPU that is still warming up may take two seconds for a frame. The operator does not wait that long for a word,
/// and hears of each frame once.
#[test]
fn a_frame_that_stays_on_the_gpu_for_a_second_is_told_once() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let crew = Arc::new(CrewFacts::new(0, bench.slot_ns));
    let mut stage = PackStage::new(bench.facts.clone(), crew, None);
    let note = FrameNote::new(&bench.facts.rig);
    let (link, collector) = (Pulse::new("link"), Pulse::new("collector"));
    let mut told = |now_ms: i64| {
        mind.watch(&link, &collector, HostTime(now_ms * MS), 2 * MS);
        bench.facts.monitor.take_notes().iter().filter(|note| note.contains("the GPU has worked")).count()
    };
    assert_eq!(told(90_000), 0, "nothing was submitted");
    stage.wait_from(&note, HostTime(100_000 * MS));
    assert_eq!((told(100_999), told(101_000), told(101_002), told(101_900)), (0, 1, 0, 0));
    stage.wait_is_over();
    assert_eq!(told(200_000), 0, "it was finished");
    stage.wait_from(&note, HostTime(300_000 * MS));
    assert_eq!(told(301_500), 1, "the next one is another matter");
}

#[test]
fn a_panic_and_a_failure_at_the_end_are_not_made_good() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    assert_eq!(mind.judge(Trouble::Panicked("plan"), HostTime(0)), CrewVerdict::End);
    assert!(matches!(bench.facts.take_error(), Some(PipelineError::Panicked("plan"))));
    // The first failure requested a stop, so no further crew is made.
    let verdict = mind.judge(Trouble::Hung("plan"), HostTime(MS));
    assert_eq!(verdict, CrewVerdict::Abandon { remake: None });
}

#[test]
fn a_new_crew_is_waited_for_three_minutes() {
    let bench = bench(&[], RunOptions::default());
    let mut mind = supervision(&bench.facts);
    let began = HostTime(7_000 * MS);
    mind.judge(Trouble::Hung("pack"), began);
    let limit_ns = 180_000 * MS;
    assert!(mind.waits_for(Making::Waits, began.plus_ns(limit_ns - 1)));
    assert!(bench.facts.take_error().is_none());
    assert!(!mind.waits_for(Making::Waits, began.plus_ns(limit_ns)));
    assert!(matches!(bench.facts.take_error(), Some(PipelineError::Hung { stage: "GPU" })));
    assert!(!mind.waits_for(Making::Panicked, began));
    assert!(matches!(bench.facts.take_error(), Some(PipelineError::Panicked("GPU"))));
}

#[test]
fn the_run_ends_when_the_link_or_the_collector_falls_silent() {
    // A run that is to stop does not wait for the link to go on.
    for (which, expected) in [(0, Irreplaceable::Link), (1, Irreplaceable::Collector)] {
        let bench = bench(&[], RunOptions::default());
        let mut mind = supervision(&bench.facts);
        bench.facts.monitor.request_stop();
        let pulses = [Pulse::new("link"), Pulse::new("collector")];
        pulses[which].beat(HostTime(0), 20 * MS);
        let mut at_ms = 0;
        let hung = loop {
            at_ms += 2;
            assert!(at_ms < 1_000, "{expected:?} hangs and nobody says so");
            if let Some(hung) = mind.watch(&pulses[0], &pulses[1], HostTime(at_ms * MS), 2 * MS) {
                break hung;
            }
        };
        assert_eq!(hung, expected);
        assert!((120..=124).contains(&at_ms), "a tenth of a second beyond what was announced: {at_ms} ms");
        assert!(matches!(bench.facts.take_error(), Some(PipelineError::Hung { .. })));
        assert!(bench.facts.monitor.stop_requested());
    }
}
