//! A whole run under a clock that the test moves, on a machine that is simple enough to reason about.

use super::*;
use crate::config::{Overrides, RigConfig};
use crate::mock::{DeviceClock, EmulatedProjector, MockConfig};
use crate::tracks::open_for;
use dpm_device::planes::Raster;
use dpm_device::transport::inproc::Direct;

const MS: i64 = 1_000_000;
/// What pack and link take of a frame that is alone in the caches, nanoseconds.
const ALONE_NS: i64 = 280_000;

/// What strikes the machine, at [`STRIKES_AT`] and for [`STRUCK_NS`].
#[derive(Clone, Copy, Debug, PartialEq)]
enum Strikes {
    Nothing,
    /// A thread gets no core.
    Thread(Part),
    /// Another program streams through memory: all stages are four times slower.
    Memory,
}

const STRIKES_AT: HostTime = HostTime(1_000 * MS);
const STRUCK_NS: i64 = 200 * MS;

/// A frame as the link sent it.
#[derive(Clone, Copy, Debug)]
struct Sent {
    sent_at: HostTime,
    due_at: HostTime,
    captured_at: Option<HostTime>,
}

/// A machine whose stages are slower the more frames are under way, as where the frames do not fit the caches: with four
/// of them pack and link each take nearly a slot, so a queue that stands keeps itself standing.
struct Cached {
    rig: Arc<Rig>,
    strikes: Strikes,
    has_struck: bool,
    /// The newest frames that planning and the link have worked on: those between them are under way.
    newest: [u64; 2],
    /// One in so many steps takes longer.
    steps: i64,
    sent: Vec<Sent>,
    /// The collector takes so long for a pass.
    collector_ns: i64,
}

impl Cached {
    fn stage_ns(&mut self, now: HostTime) -> i64 {
        self.steps += 1;
        let under_way = self.newest[0].saturating_sub(self.newest[1]) as i64;
        let crowd = ALONE_NS * (under_way - 1).clamp(0, 3) * 9 / 10;
        let hiccup = if self.steps % 97 == 0 { 250_000 } else { self.steps * 7919 % 40_000 };
        let slow = self.strikes == Strikes::Memory && (0..STRUCK_NS).contains(&now.ns_since(STRIKES_AT));
        (ALONE_NS + crowd + hiccup) * if slow { 4 } else { 1 }
    }
}

impl Machine for Cached {
    fn takes(&mut self, part: Part, frame: u64, now: HostTime) -> Takes {
        // A link that waits for a frame is woken by it.
        let works = part != Part::Link || frame > 0;
        if self.strikes == Strikes::Thread(part) && works && !self.has_struck && now >= STRIKES_AT {
            self.has_struck = true;
            return Takes::Ns(STRUCK_NS);
        }
        Takes::Ns(match part {
            Part::Tracking => 10_000,
            Part::Plan => {
                self.newest[0] = frame;
                20_000
            }
            Part::Pack => self.stage_ns(now),
            // It looks for frames more often than there are any.
            Part::Link if frame == 0 => 1_000,
            Part::Link => {
                self.newest[1] = frame;
                self.stage_ns(now)
            }
            Part::Collector => self.collector_ns,
        })
    }

    fn renders(&mut self, _: u64, _: HostTime) -> Rendered {
        Rendered::After(0)
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
        self.sent.push(Sent { sent_at, due_at, captured_at });
    }
}

/// What was sent in a run of `ms` milliseconds with these keys.
fn run(keys: &[&str], strikes: Strikes, collector_ns: i64, shifts_slots: bool, ms: i64) -> Vec<Sent> {
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
    let medium = Box::new(Direct::new(projector));
    let machine = Cached {
        rig: rig.clone(),
        strikes,
        has_struck: false,
        newest: [0; 2],
        steps: 0,
        sent: Vec::new(),
        collector_ns,
    };
    let monitor = Arc::new(RunMonitor::default());
    let mut run = SteppedRun::begin(rig, monitor, medium, machine, now);
    while now < HostTime(ms * MS) {
        now = run.step(now).min(HostTime(ms * MS));
    }
    assert!(run.is_running(), "it goes on");
    std::mem::take(&mut run.machine().sent)
}

/// Frames that were sent in time for their slots between two instants, and slots in that time.
fn in_time(sent: &[Sent], slot_ns: i64, from: HostTime, to: HostTime) -> [i64; 2] {
    let all = sent.iter().filter(|s| s.due_at >= from && s.due_at < to && s.sent_at <= s.due_at);
    [all.count() as i64, to.ns_since(from) / slot_ns]
}

/// The mean age of light between two instants, from the tracker's exposure to the slot, nanoseconds.
fn mean_age_ns(sent: &[Sent], from: HostTime, to: HostTime) -> i64 {
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
    returns_after(Strikes::Thread(Part::Tracking));
}

#[test]
fn the_good_state_returns_after_a_stall_of_planning() {
    returns_after(Strikes::Thread(Part::Plan));
}

#[test]
fn the_good_state_returns_after_a_stall_of_packing() {
    returns_after(Strikes::Thread(Part::Pack));
}

#[test]
fn the_good_state_returns_after_a_stall_of_the_link() {
    returns_after(Strikes::Thread(Part::Link));
}

#[test]
fn the_good_state_returns_after_memory_was_slow() {
    returns_after(Strikes::Memory);
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
