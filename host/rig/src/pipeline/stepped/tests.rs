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

/// A frame as the link sent it.
#[derive(Clone, Copy, Debug)]
struct Sent {
    due_at: HostTime,
    captured_at: Option<HostTime>,
}

/// A machine whose stages are slower the more frames are under way, as where the frames do not fit the caches: with four
/// of them pack and link each take nearly a slot, so a queue that stands keeps itself standing.
struct Cached {
    rig: Arc<Rig>,
    /// The newest frames that planning and the link have worked on: those between them are under way.
    newest: [u64; 2],
    /// One in so many steps takes longer.
    steps: i64,
    sent: Vec<Sent>,
}

impl Cached {
    fn stage_ns(&mut self) -> i64 {
        self.steps += 1;
        let under_way = self.newest[0].saturating_sub(self.newest[1]) as i64;
        let crowd = ALONE_NS * (under_way - 1).clamp(0, 3) * 9 / 10;
        let hiccup = if self.steps % 97 == 0 { 250_000 } else { self.steps * 7919 % 40_000 };
        ALONE_NS + crowd + hiccup
    }
}

impl Machine for Cached {
    fn takes(&mut self, part: Part, frame: u64, _: HostTime) -> Takes {
        Takes::Ns(match part {
            Part::Tracking => 10_000,
            Part::Plan => {
                self.newest[0] = frame;
                20_000
            }
            Part::Pack => self.stage_ns(),
            // It looks for frames more often than there are any.
            Part::Link if frame == 0 => 1_000,
            Part::Link => {
                self.newest[1] = frame;
                self.stage_ns()
            }
            Part::Collector => 100_000,
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
        self.sent.push(Sent { due_at: frame.due_at, captured_at: frame.captured_at });
    }
}

/// What was sent in a run of `ms` milliseconds with these keys.
fn run(keys: &[&str], shifts_slots: bool, ms: i64) -> Vec<Sent> {
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
    let machine = Cached { rig: rig.clone(), newest: [0; 2], steps: 0, sent: Vec::new() };
    let monitor = Arc::new(RunMonitor::default());
    let mut run = SteppedRun::begin(rig, monitor, medium, machine, now);
    while now < HostTime(ms * MS) {
        now = run.step(now).min(HostTime(ms * MS));
    }
    assert!(run.is_running(), "it goes on");
    std::mem::take(&mut run.machine().sent)
}

/// Where one rate divides the other, each frame shows a sample that has just become ready, though the clocks of tracker and
/// projector drift apart by 60 ppm; and all frames are equally fresh.
#[test]
fn slots_follow_the_tracker_where_one_rate_divides_the_other() {
    let ages = |rate: &str, shifts: bool| {
        let sent = run(&[&format!("projector.frame_rate=\"{rate}\"")], shifts, 4_000);
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
