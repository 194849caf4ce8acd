//! A whole run under a clock that the test moves, on a machine that is simple enough to reason about.

use super::*;
use crate::config::{Overrides, RigConfig};
use crate::mock::{DeviceClock, EmulatedProjector, MockConfig};
use crate::tracks::open_for;
use dpm_device::link::Packet;
use dpm_device::planes::Raster;
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::{Lane, LinkDevice, SendError, TransportError};
use std::collections::VecDeque;

const MS: i64 = 1_000_000;
/// What pack and link take of a frame that is alone in the caches, nanoseconds.
const ALONE_NS: i64 = 280_000;

/// What strikes the machine, at [`STRIKES_AT`] and for [`STRUCK_NS`].
#[derive(Clone, Copy, Debug, PartialEq)]
enum Strikes {
    Nothing,
    /// A thread gets no core.
    Thread(RunPart),
    /// Another program streams through memory: all stages are four times slower.
    Memory,
    /// A cable that carries a frame in seven tenths of a slot, and holds two more, moves nothing for 60 ms.
    Cable,
}

/// Such a cable. Replies pass it at once.
struct SteppedCable {
    inner: Direct<EmulatedProjector>,
    frame_ns: i64,
    stops_at: HostTime,
    /// What it holds, by when it will have been carried.
    holds: VecDeque<(HostTime, Vec<u8>)>,
}

/// For so long it moves nothing.
const STOPPED_NS: i64 = 60 * MS;
/// Frames that find room.
const ROOM: usize = 3;

impl Transport for SteppedCable {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        if lane == Lane::Control {
            return self.inner.send(now, lane, packets);
        }
        if !self.has_room(lane) {
            return Err(SendError::Busy);
        }
        let begins_at = self.holds.back().map_or(now, |(at, _)| now.max(*at));
        let ends_at = begins_at.plus_ns(self.frame_ns);
        let is_stopped = begins_at < self.stops_at.plus_ns(STOPPED_NS) && ends_at > self.stops_at;
        let ends_at = if is_stopped { ends_at.plus_ns(STOPPED_NS) } else { ends_at };
        self.holds.push_back((ends_at, packets.iter().flat_map(Packet::to_vec).collect()));
        Ok(())
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        lane == Lane::Control || self.holds.len() < ROOM
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        while self.holds.front().is_some_and(|(at, _)| *at <= now) {
            let Some((at, bytes)) = self.holds.pop_front() else { break };
            self.inner.device_mut().receive(at, Lane::Data, &bytes);
        }
        self.inner.receive(now, sink)
    }

    fn name(&self) -> &str {
        "cable"
    }
}

const STRIKES_AT: HostTime = HostTime(1_000 * MS);
const STRUCK_NS: i64 = 200 * MS;

/// A frame as the link sent it.
#[derive(Clone, Copy, Debug)]
struct LinkFrame {
    sent_at: HostTime,
    due_at: HostTime,
    captured_at: Option<HostTime>,
    planned_at: HostTime,
}

/// A machine whose stages are slower the more frames are under way, as where the frames do not fit the caches: with four
/// of them pack and link each take nearly a slot, so a queue that stands keeps itself standing.
struct CacheMachine {
    rig: Arc<Rig>,
    strikes: Strikes,
    has_struck: bool,
    /// The newest frames that planning and the link have worked on: those between them are under way.
    newest: [u64; 2],
    /// One in so many steps takes longer.
    steps: i64,
    /// When the newest frames were planned, by number.
    planned: [HostTime; 64],
    alone_ns: i64,
    sent: Vec<LinkFrame>,
    /// The collector takes so long for a pass.
    collector_ns: i64,
}

impl CacheMachine {
    fn stage_ns(&mut self, now: HostTime) -> i64 {
        self.steps += 1;
        let under_way = self.newest[0].saturating_sub(self.newest[1]) as i64;
        let crowd = self.alone_ns * (under_way - 1).clamp(0, 3) * 9 / 10;
        let hiccup = if self.steps % 97 == 0 { 250_000 } else { self.steps * 7919 % 40_000 };
        let slow = self.strikes == Strikes::Memory && (0..STRUCK_NS).contains(&now.ns_since(STRIKES_AT));
        (self.alone_ns + crowd + hiccup) * if slow { 4 } else { 1 }
    }
}

impl Machine for CacheMachine {
    fn takes(&mut self, part: RunPart, frame: u64, now: HostTime) -> Takes {
        // A link that waits for a frame is woken by it.
        let works = part != RunPart::Link || frame > 0;
        if self.strikes == Strikes::Thread(part) && works && !self.has_struck && now >= STRIKES_AT {
            self.has_struck = true;
            return Takes::Ns(STRUCK_NS);
        }
        Takes::Ns(match part {
            RunPart::Tracking => 10_000,
            RunPart::Plan => {
                self.newest[0] = frame;
                self.planned[frame as usize % 64] = now;
                20_000
            }
            RunPart::Pack => self.stage_ns(now),
            // It looks for frames more often than there are any.
            RunPart::Link if frame == 0 => 1_000,
            RunPart::Link => {
                self.newest[1] = frame;
                self.stage_ns(now)
            }
            RunPart::Collector => self.collector_ns,
        })
    }

    fn renders(&mut self, _: u64, _: HostTime) -> GpuWork {
        GpuWork::After(0)
    }

    fn makes_crew(&mut self, _: bool, _: HostTime) -> (i64, Result<i64, GpuError>) {
        (20 * MS, Ok(0))
    }

    fn opens_tracker(&mut self, _: HostTime) -> Box<dyn Tracker> {
        open_for(&self.rig, Arc::new(|| HostTime(0)), HostTime(0)).unwrap_or_else(|e| panic!("{e}"))
    }

    fn next_sample_at(&self, now: HostTime) -> HostTime {
        // The mock's samples arrive a whole number of its periods after its start.
        HostTime((now.0 / (2 * MS) + 1) * 2 * MS)
    }

    fn sent(&mut self, frame: &SentFrame<'_>) {
        let (sent_at, due_at, captured_at) = (frame.sent_at, frame.due_at, frame.captured_at);
        let planned_at = self.planned[frame.frame as usize % 64];
        self.sent.push(LinkFrame { sent_at, due_at, captured_at, planned_at });
    }
}

/// What was sent in a run of `ms` milliseconds with these keys.
fn run(keys: &[&str], strikes: Strikes, collector_ns: i64, shifts_slots: bool, ms: i64) -> Vec<LinkFrame> {
    run_of(keys, strikes, collector_ns, shifts_slots, ms, ALONE_NS)
}

/// The same where pack and link each take `alone_ns`.
fn run_of(
    keys: &[&str],
    strikes: Strikes,
    collector_ns: i64,
    shifts_slots: bool,
    ms: i64,
    alone_ns: i64,
) -> Vec<LinkFrame> {
    let flags = keys.iter().map(|key| (*key).to_owned()).chain(["real_time.pace=\"real\"".to_owned()]);
    let overrides = Overrides { variables: vec![], flags: flags.collect() };
    let config = RigConfig::demo(&overrides).unwrap_or_else(|e| panic!("{e}"));
    let raster = Raster::new(16, 16).expect("not empty");
    let rig = Arc::new(Rig::build(&config, Some(raster)).unwrap_or_else(|e| panic!("{e}")));
    let mut setup = MockConfig::new(raster);
    setup.shifts_slots = shifts_slots;
    setup.clock = DeviceClock { skew_ppb: 60_000, ..DeviceClock::IDEAL };
    let mut now = HostTime(5 * MS);
    let projector = EmulatedProjector::new(setup, "", 1, now).expect("no faults");
    let inner = Direct::new(projector);
    let medium: Box<dyn Transport> = match strikes {
        Strikes::Cable => {
            let frame_ns = rig.rate().slot_len_ns(0) * 7 / 10;
            Box::new(SteppedCable { inner, frame_ns, stops_at: STRIKES_AT, holds: VecDeque::new() })
        }
        _ => Box::new(inner),
    };
    let machine = CacheMachine {
        rig: rig.clone(),
        strikes,
        has_struck: false,
        newest: [0; 2],
        steps: 0,
        planned: [now; 64],
        alone_ns,
        sent: Vec::new(),
        collector_ns,
    };
    let monitor = Arc::new(RunMonitor::default());
    let mut run = SteppedRun::begin(rig, monitor, medium, machine, now);
    while now < HostTime(ms * MS) {
        now = run.step(now).min(HostTime(ms * MS));
    }
    assert!(run.is_running(), "it goes on");
    let slack = run.carried().expect("the link is up").slack;
    println!("{keys:?}, {strikes:?}: {slack:?}");
    std::mem::take(&mut run.machine().sent)
}

/// Frames that were sent in time for their slots between two instants, and slots in that time.
fn in_time(sent: &[LinkFrame], slot_ns: i64, from: HostTime, to: HostTime) -> [i64; 2] {
    let all = sent.iter().filter(|s| s.due_at >= from && s.due_at < to && s.sent_at <= s.due_at);
    [all.count() as i64, to.ns_since(from) / slot_ns]
}

/// The mean age of light between two instants, from the tracker's exposure to the slot, nanoseconds.
fn mean_age_ns(sent: &[LinkFrame], from: HostTime, to: HostTime) -> i64 {
    let ages = sent.iter().filter(|s| s.due_at >= from && s.due_at < to);
    let ages: Vec<i64> = ages.filter_map(|s| Some(s.due_at.ns_since(s.captured_at?))).collect();
    ages.iter().sum::<i64>() / ages.len().max(1) as i64
}

/// Half a second after 200 ms in which `strikes` held something up, the share of slots that get a frame in time is that of a
/// quiet machine, and light is as young; though the stages are as slow as in a bad state while a queue stands.
fn returns_after(strikes: Strikes) {
    let slot_ns = 1_055_966;
    let after_ms = |ms: i64| STRIKES_AT.plus_ns(ms * MS);
    let (from, to) = (after_ms(700), after_ms(1_400));
    let [quiet, struck] = [Strikes::Nothing, strikes].map(|strikes| run(&[], strikes, 100_000, false, 2_500));
    let [good, after] = [&quiet, &struck].map(|sent| in_time(sent, slot_ns, from, to));
    let [good_age, age] = [&quiet, &struck].map(|sent| mean_age_ns(sent, from, to));
    assert!(good[0] * 1000 >= good[1] * 995, "{good:?} on a quiet machine");
    // Without tracking frames go on, dark as soon as the samples are too old.
    let lit = struck.iter().filter(|s| s.captured_at.is_some()).copied().collect::<Vec<_>>();
    let during = in_time(&lit, slot_ns, STRIKES_AT, after_ms(200));
    assert!(during[0] * 10 < during[1] * 9, "{strikes:?} struck nothing: {during:?}");
    assert!(after[0] * 1000 >= after[1] * 990, "{strikes:?}: {after:?} of the slots half a second later");
    assert!(age < good_age + 300_000, "{strikes:?}: light is {age} ns old, not {good_age}");
}

#[test]
fn the_good_state_returns_after_a_stall_of_tracking() {
    returns_after(Strikes::Thread(RunPart::Tracking));
}

#[test]
fn the_good_state_returns_after_a_stall_of_planning() {
    returns_after(Strikes::Thread(RunPart::Plan));
}

#[test]
fn the_good_state_returns_after_a_stall_of_packing() {
    returns_after(Strikes::Thread(RunPart::Pack));
}

#[test]
fn the_good_state_returns_after_a_stall_of_the_link() {
    returns_after(Strikes::Thread(RunPart::Link));
}

#[test]
fn the_good_state_returns_after_memory_was_slow() {
    returns_after(Strikes::Memory);
}

/// A cable that stood still has frames before each other in it, and carries them as fast as they come. Such a queue is shed as
/// one between the stages is: half a second later frames travel alone again.
#[test]
fn a_queue_on_the_cable_is_shed() {
    for rate in [60, 240, 947] {
        let key = format!("projector.frame_rate=\"{rate}\"");
        let slot_ns = 1_000 * MS / rate;
        let sent = run(&[&key], Strikes::Cable, 100_000, false, 3_000);
        let from = STRIKES_AT.plus_ns(STOPPED_NS + 500 * MS + 8 * slot_ns);
        let to = HostTime(2_900 * MS);
        let after = sent.iter().filter(|s| s.due_at >= from && s.due_at < to);
        // As long before its slot as the cable needs for a frame that travels alone.
        let early = after.clone().filter(|s| s.due_at.ns_since(s.sent_at) >= slot_ns * 7 / 10).count();
        let ages: Vec<i64> = after.map(|s| s.due_at.ns_since(s.planned_at)).collect();
        let slots = (to.ns_since(from) / slot_ns) as usize;
        assert!(early * 100 >= slots * 97, "{rate}: {early} of {slots} frames in time");
        let mean = ages.iter().sum::<i64>() / ages.len() as i64;
        assert!(mean < slot_ns + 1_600_000, "{rate}: latched {mean} ns before their slots");
        // Frames that wait for each other leave no two slots apart.
        let during = sent.iter().filter(|s| s.due_at >= STRIKES_AT && s.due_at < from);
        assert!(
            during.count() < (from.ns_since(STRIKES_AT) / slot_ns) as usize,
            "{rate}: nothing was left out"
        );
    }
}

/// Passes of a collector that gets no core take a second each: it reads nothing while frames go on.
#[test]
fn a_starved_collector_changes_nothing_about_the_light() {
    let of = |collector_ns: i64| {
        let sent = run(&[], Strikes::Nothing, collector_ns, false, 2_500);
        sent.iter().map(|s| (s.sent_at, s.due_at, s.captured_at)).collect::<Vec<_>>()
    };
    let (usual, starved) = (of(100_000), of(1_000 * MS));
    let first = usual.iter().zip(&starved).position(|(a, b)| a != b);
    assert!(
        usual.len() > 1_000 && first.is_none(),
        "frame {first:?} of {} and {}",
        usual.len(),
        starved.len()
    );
}

/// The lead needs no thousand frames: after three seconds at 240 frames/s, or at 60, most frames are latched no earlier than
/// half as long again as their work takes, and nearly all are in time.
#[test]
fn the_lead_of_few_frames_is_no_longer_than_they_need() {
    for rate in [240, 60] {
        let rate = format!("projector.frame_rate=\"{rate}\"");
        let sent = run_of(&[&rate], Strikes::Nothing, 100_000, false, 6_000, 700_000);
        let settled = sent.iter().filter(|s| s.due_at > HostTime(3_000 * MS));
        let median = |of: fn(&LinkFrame) -> i64| {
            let mut all: Vec<i64> = settled.clone().map(of).collect();
            all.sort_unstable();
            all[all.len() / 2]
        };
        let work = median(|s| s.sent_at.ns_since(s.planned_at));
        let lead = median(|s| s.due_at.ns_since(s.planned_at));
        assert!(work > 1_400_000 && 2 * lead <= 3 * work, "{rate}: {lead} ns for {work} ns of work");
        let late = settled.clone().filter(|s| s.sent_at > s.due_at).count();
        assert!(late * 100 <= settled.count(), "{rate}: {late} late");
    }
}

/// Where one rate divides the other, each frame shows a sample that has just become ready, though the clocks of tracker and
/// projector drift apart by 60 ppm; and all frames are equally fresh.
#[test]
fn slots_follow_the_tracker_where_one_rate_divides_the_other() {
    let ages = |rate: &str, shifts: bool| {
        let sent =
            run(&[&format!("projector.frame_rate=\"{rate}\"")], Strikes::Nothing, 100_000, shifts, 4_000);
        let mut ages: Vec<i64> = sent
            .iter()
            .filter(|s| s.due_at > HostTime(1_500 * MS))
            .filter_map(|s| Some(s.due_at.ns_since(s.captured_at?)))
            .collect();
        ages.sort_unstable();
        [ages[ages.len() / 2], ages[ages.len() * 99 / 100]]
    };
    let [p50, p99] = ages("500", true);
    assert!(p99 - p50 <= 300_000, "{p50} and {p99} ns in step");
    // The tracker's own 2 ms, the work, and what is left to late wake-ups.
    assert!(p50 < 3_600_000, "{p50} ns in step");
    // 60 ppm drift through a fifth of the period in these seconds: without shifts the phase is what it is by chance.
    let [by_chance, _] = ages("500", false);
    assert!(by_chance > p50, "{by_chance} ns by chance, {p50} in step");
    let [_, beats] = ages("947", true);
    assert!(beats > p99 + 1_000_000, "{beats} ns where the rates beat");
}
