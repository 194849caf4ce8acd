//! A stage that stalls for 100 ms, at real pace: two frames later the stall has no effect any more.

use dpm_device::planes::Raster;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::light::FrameRecord;
use dpm_rig::pipeline::{run_prepared, RunOptions, Stall, StallIn};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;
use std::time::Duration;

const STALLED: u64 = 60;
const FRAMES: u64 = 120;
/// Slots of 10 ms: ten of them pass during the stall, and other tests on the machine have little effect.
const SLOT_NS: i64 = 10_000_000;
const STALL: Duration = Duration::from_millis(100);

/// Frames lit after the stalled one, oldest first, and the latch of the stalled one.
fn run(stage: StallIn, watchdog_ms: u32) -> Vec<FrameRecord> {
    let set = |s: &str| s.to_owned();
    let flags = vec![
        set("real_time.pace=\"real\""),
        set("projector.frame_rate=\"100\""),
        format!("safety.watchdog_ms={watchdog_ms}"),
        // Bodies are shown throughout a stall; the test checks how old their samples are.
        "safety.predict_ms=500".to_owned(),
    ];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let rig = Arc::new(Rig::build(&config, Raster::new(64, 48)).unwrap_or_else(|e| panic!("{e}")));
    let options = RunOptions {
        frames: FRAMES,
        keep_frames: FRAMES as usize,
        stall: Some(Stall { stage, frame: STALLED, length: STALL, times: 1, every: 0 }),
        ..RunOptions::default()
    };
    let outcome =
        run_prepared(rig, options, &Arc::new(RunMonitor::default())).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((outcome.frames_torn, outcome.frames_reordered), (0, 0), "{stage:?}");
    outcome.recent.into_iter().filter(|r| r.id.0 > STALLED).collect()
}

fn is_on_time(r: &FrameRecord) -> bool {
    let t = &r.timeline;
    t.lit_at.is_some_and(|lit| lit.ns_since(t.due_at) < SLOT_NS / 2)
        && t.sent_at.ns_since(t.latched_at) < 4 * SLOT_NS
}

/// If the machine itself stands still, a run proves nothing, so there are three attempts.
fn holds(what: impl Fn() -> Result<(), String>) {
    let mut told = String::new();
    for _ in 0..3 {
        match what() {
            Ok(()) => return,
            Err(e) => told = e,
        }
    }
    panic!("{told}");
}

#[test]
fn a_stall_in_any_stage_leaves_no_backlog_two_frames_later() {
    for stage in [StallIn::Plan, StallIn::Pack, StallIn::Link] {
        holds(|| {
            let after = run(stage, 1_000);
            let lost = FRAMES - STALLED - 1 - after.len() as u64;
            // At most the frames that were in flight when it happened.
            if lost > 4 {
                return Err(format!("{stage:?}: {lost} frames after the stall were not lit"));
            }
            match after.iter().skip(2).find(|r| !is_on_time(r)) {
                Some(late) => {
                    Err(format!("{stage:?}: frame {} after the stall: {:?}", late.id.0, late.timeline))
                }
                None => Ok(()),
            }
        });
    }
}

/// Tracking stalls while the frames continue, each in its slot, with the last known tracks. When tracking continues,
/// it reads at once what the tracker has collected meanwhile: the next frame but one has a sample as recent as ever.
#[test]
fn a_stall_of_tracking_delays_no_frame_and_leaves_no_old_sample_two_frames_later() {
    holds(|| {
        let after = run(StallIn::Tracking, 1_000);
        if let Some(late) = after.iter().find(|r| !is_on_time(r)) {
            return Err(format!("frame {} was delayed: {:?}", late.id.0, late.timeline));
        }
        let age = |r: &FrameRecord| r.timeline.latched_at.ns_since(r.timeline.captured_at);
        let old: Vec<u64> = after.iter().filter(|r| age(r) > SLOT_NS).map(|r| r.id.0).collect();
        // The stall begins within the frame after the one that triggers it, and lasts ten slots.
        let (Some(&first), Some(&last)) = (old.first(), old.last()) else {
            return Err("no frame was without new samples".to_owned());
        };
        let slots = STALL.as_nanos() as u64 / SLOT_NS as u64;
        let bound = slots - 3..=slots + 1;
        (first <= STALLED + 2 && bound.contains(&(last - first + 1)))
            .then_some(())
            .ok_or_else(|| format!("old samples in the frames {old:?}"))
    });
}

/// The device's watchdog acts during the stall of the link. Light comes back by itself and stays in time.
#[test]
fn light_comes_back_after_a_silence_longer_than_the_watchdog() {
    holds(|| {
        let after = run(StallIn::Link, 50);
        let on_time = after.iter().filter(|r| is_on_time(r)).count();
        // Arming takes a slot or two; half of the remaining run is much more than that costs.
        let enough = on_time as u64 > (FRAMES - STALLED) / 2;
        enough.then_some(()).ok_or_else(|| format!("{on_time} of {} frames in time", after.len()))
    });
}
