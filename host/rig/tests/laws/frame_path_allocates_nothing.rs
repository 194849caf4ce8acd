//! The parts of the frame path except the GPU, with a counting allocator: after construction nothing is allocated.

use counting_allocator::{requests_in, Counting};
use dpm_common::clock::{Clock, ManualClock};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_handoff::latest::latest;
use dpm_handoff::ring::{exchange, ring};
use dpm_handoff::wake::{WaitPolicy, Waiter};
use dpm_render::pack::BitPlaneFrame;
use dpm_rig::frame::FrameTimeline;
use dpm_rig::pack::eye_mask::EyeMask;
use dpm_rig::plan::budget::{BudgetConfig, BudgetController};
use dpm_rig::plan::eyes::{EyeGuard, GuardedEyes};
use dpm_rig::plan::lead::LeadEstimator;
use dpm_rig::telemetry::profile::Profiler;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_tracking::{PoseFilterBank, PoseFilterConfig, TrackState};
use glam::DVec3;

#[global_allocator]
static ALLOCATOR: Counting = Counting::BY_THREAD;

#[test]
fn a_hundred_thousand_frames_allocate_nothing() {
    let rate = FrameRate::new(947, 1).unwrap();
    let clock = ManualClock::new(HostTime(0));
    let mut bank = PoseFilterBank::new(&[PoseFilterConfig::default(); 2]);
    let (mut publisher, mut reader) = latest([None::<TrackState>; 2]);
    let (mut filler, mut drainer) = exchange(vec![Box::new([0u8; 64]), Box::new([0u8; 64])]);
    let (mut events_in, mut events_out) = ring::<u64>(16);
    let waiter = Waiter::new(WaitPolicy::SpinThenPark { spin_ns: 1_000 });
    let waker = waiter.waker();
    let mut lead = LeadEstimator::new(1_055_966, 2_000_000, 3_000_000);
    let mut budget = BudgetController::new(BudgetConfig {
        slot_ns: 1_055_966,
        aim: 0.8,
        limit: 0.92,
        min_rays: 1_000,
        max_rays: 10_000_000,
        initial_rays: 100_000,
    })
    .unwrap();
    let mut profiler = Profiler::new(rate, true, 947);
    let raster = Raster::new(64, 48).unwrap();
    let camera = ProjectorCamera::look_at(raster, DVec3::ZERO, -DVec3::Z, DVec3::Y, 0.6).unwrap();
    let mut mask = EyeMask::new(&camera, true);
    let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
    let mut eyes = GuardedEyes { spheres: Vec::with_capacity(4), lost: None };
    let (mut predicted, mut cut) = (0u64, 0u64);
    let allocated = requests_in(|| {
        for frame in 0..100_000u64 {
            let due = HostTime(rate.slot_start_ns(frame));
            clock.wait_until(due);
            lead.measured(300_000 + (frame % 1_000) as i64 * 5_000);
            assert!(lead.typical_ns() <= lead.lead_ns());
            for body in 0..2 {
                let captured_at = due.plus_ns(-4_000_000);
                // An occasional drop-out, outlier and duplicate, so that the unusual paths are included.
                let x = if frame % 1_000 == 7 { 50.0 } else { 1e-3 * (frame % 500) as f64 };
                let sample = TrackerSample {
                    body: BodyIndex(body),
                    pose: Pose { position_m: [x, 0.0, 0.0], ..Pose::IDENTITY },
                    tracked: frame % 5_000 > 40,
                    mean_error_m: 0.0,
                    covariance: None,
                    sequence: frame as u32,
                    captured_at,
                    received_at: captured_at.plus_ns(2_000_000),
                };
                bank.update(&sample);
                bank.update(&sample);
            }
            publisher.publish([bank.state(BodyIndex(0)), bank.state(BodyIndex(1))]);
            waker.wake();
            assert!(waiter.wait(rate.slot_start_ns(frame + 1), || clock.now().0, || reader.has_news()));
            for state in reader.latest().0.iter().flatten() {
                predicted += u64::from(state.predict(due).pose.is_valid(1e-9));
            }
            let mut buffer = filler.take_free().expect("one goes round");
            buffer[0] = frame as u8;
            filler.send(buffer).expect("it came from here");
            let (buffer, _) = drainer.receive_newest().expect("just sent");
            drainer.give_back(buffer).expect("it came from here");
            events_in.push(frame).expect("drained every frame");
            assert_eq!(events_out.pop(), Some(frame));
            eyes.spheres.clear();
            for head in 0..frame % 5 {
                let centre = DVec3::new(0.1 * head as f64 - 0.2, 1e-5 * frame as f64 - 0.5, -1.0);
                eyes.spheres.push(EyeGuard { centre, radius_m: 0.05 });
            }
            cut += u64::from(mask.cut(&eyes, &camera, &mut planes));
            budget.measured(budget.rays(), 800_000 + (frame % 300_000) as i64);
            let timeline = FrameTimeline { lit_at: Some(due), due_at: due, ..FrameTimeline::default() };
            profiler.lit(&timeline, frame, frame % 100 == 0);
        }
    });
    assert_eq!(allocated, 0, "{allocated} allocations and releases in 100,000 frames");
    assert!(cut > 1_000_000, "{cut} mirrors: heads were in the beam");
    assert!(predicted > 190_000, "{predicted} poses: the loop did its work");
}
