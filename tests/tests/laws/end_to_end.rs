//! The whole rig with the mock projector and the mock tracker: the light is what was rendered, it falls where the
//! object is, and it falls at the right time.

use dpm_device::planes::{Channel, PlaneSpec};
use dpm_device::time::HostTime;
use dpm_lab::error::planes::{centre_of, middle_of};
use dpm_lab::sequence::{draw, BodyPlaces};
use dpm_render::Renderer;
use dpm_rig::light::recorder::LightFrame;
use dpm_rig::pipeline::{self, renderer_settings, RunOptions};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::report::Report;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use glam::DVec3;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Every frame independently: no picture depends on previous ones, so a single frame can be drawn again.
const FULL: &str = "render.method=\"full\"";
const REAL: &str = "real_time.pace=\"real\"";

#[test]
fn the_light_is_the_rendered_picture_in_all_24_planes() {
    with_gpu(|gpu| {
        let rig = demo_rig(64, 48, &[FULL]);
        let (outcome, monitor) = run(gpu, &rig, 40, 12);
        assert_eq!(outcome.light_mismatches, 0);
        let r = &outcome.report;
        assert_eq!((r.frames_lit, r.frames_dropped, r.frames_late, r.planes), (40, 0, 0, 24));
        assert_eq!(monitor.counts().frames_planned, 40);

        // In addition to the pipeline's own comparison, the kept frames are drawn again, one by one, with a separate
        // renderer.
        let mut renderer = Renderer::new(gpu, &rig.scene, renderer_settings(&rig)).unwrap();
        let mut slot = renderer.create_slot(false).unwrap();
        assert_eq!((outcome.light.len(), outcome.recent.len()), (12, 12));
        let mut bodies = BodyPlaces::default();
        let (mut lit_pixels, mut levels) = (0, [[false; 256]; 3]);
        for (light, record) in outcome.light.iter().zip(&outcome.recent) {
            assert_eq!(light.frame, record.id.0 as u32);
            rig.scene_poses(&record.tracked_poses, 0, &mut bodies.poses);
            assert_eq!(rig.observer.eye_and_gaze(&record.tracked_poses).0, record.eye);
            let spp = rig.config.render.spp;
            draw(&rig, &mut renderer, &mut slot, &bodies, light.frame, spp as f32).unwrap();
            for (i, (code, fell)) in slot.codes().iter().zip(&light.codes).enumerate() {
                let rendered = [*code as u8, (*code >> 8) as u8, (*code >> 16) as u8];
                assert_eq!(rendered, *fell, "frame {} pixel {i}", light.frame);
                lit_pixels += usize::from(*fell != [0; 3]);
                (0..3).for_each(|c| levels[c][usize::from(fell[c])] = true);
            }
        }
        // The comparison is meaningful: there is light at many levels, so every plane of every colour has set bits.
        assert!(lit_pixels > 12 * 64 * 48 / 20, "{lit_pixels}");
        for (channel, seen) in levels.iter().enumerate() {
            for bit in 0..8 {
                let used = (0..256).any(|v| seen[v] && v >> bit & 1 == 1);
                assert!(used, "channel {channel} bit {bit} never lit");
            }
        }
    });
}

/// The content of a report except wall times, which depend on the machine.
fn told(report: &Report) -> serde_json::Value {
    let mut json: serde_json::Value = serde_json::from_str(&report.to_json()).unwrap();
    let fields = json.as_object_mut().unwrap();
    for wall in ["stages_ms", "frames_per_wall_second", "mrays_per_s", "walked_mrays_per_s", "wall_s"] {
        assert!(fields.remove(wall).is_some(), "no {wall}");
    }
    assert!(fields.len() > 20, "{json}");
    json
}

/// Runs `work` while other threads keep every core busy.
fn beside_others<T>(work: impl FnOnce() -> T) -> T {
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..6 {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let done = work();
        over.store(true, Ordering::Relaxed);
        done
    })
}

#[test]
fn light_falls_where_the_object_is() {
    with_gpu(|gpu| {
        // A quarter of a second at 1 m/s contains a whole crossing and a reversal at 8 m/s^2.
        let rig = demo_rig(32, 24, &["render.spp=1"]);
        let (outcome, _) = run(gpu, &rig, 260, 0);
        let full_size = 1024.0 / 32.0;
        let error = outcome.report.registration_error_px.expect("the mock tells the truth");
        let held = outcome.report.registration_error_unpredicted_px.expect("the same without prediction");
        let (p99, held_p99) = (error.p99 * full_size, held.p99 * full_size);
        assert!(p99 < 0.25, "99 % within {p99} px at 1024 x 768");
        assert!(held_p99 > 2.0 && held_p99 > 10.0 * p99, "without prediction {held_p99} px, with {p99} px");
        // Without prediction the light itself is late, not only the second line of the report.
        let off = demo_rig(32, 24, &["render.spp=1", "prediction.on=false"]);
        let (outcome, _) = run(gpu, &off, 100, 0);
        let error = outcome.report.registration_error_px.expect("the mock tells the truth");
        assert!(!outcome.report.prediction && error.p99 * full_size > 2.0, "{}", error.p99 * full_size);
    });
}

/// In a rendered run every plane shows each body where that body is at the plane's own instant, or as much of the way there as
/// it is told. Whether planes follow or not, a frame shows the same body, so each plane shows it elsewhere by what it moves in
/// between. What is compared is the light that the mock emitted with the true motion.
#[test]
fn planes_of_a_rendered_run_show_each_body_at_their_own_instants() {
    with_gpu(|gpu| {
        let moving = |i: usize, up: i32| {
            format!(
                "scene.bodies.{i}.motion={{kind=\"translate\",direction=[0,{up},0],speed_m_s=2.0,amplitude_m=0.15,acceleration_m_s2=50.0}}"
            )
        };
        let lit = |poses: &str| {
            let [up, down] = [moving(0, 1), moving(1, -1)];
            let rig = demo_rig(512, 384, &[poses, &up, &down, FULL, "render.exposure=1000.0"]);
            let outcome = run(gpu, &rig, 24, 8).0;
            assert_eq!((outcome.light_mismatches, outcome.light.len()), (0, 8));
            (rig, outcome.light)
        };
        let (rig, one) = lit("projector.plane_poses=\"frame\"");
        // The middle plane of the three of a bit.
        let middle_of_bit = [0, 1, 2, 3, 4, 5, 6, 7].map(|bit| {
            let planes = rig.schedule.planes();
            let is_green = |p: &PlaneSpec| p.bit == bit && p.channel == Channel::Green;
            middle_of(&rig.schedule, planes.iter().position(is_green).expect("eight bits of green"))
        });
        let slot_ns = rig.rate().slot_len_ns(0);
        // The bodies stand side by side and move up and down.
        let centres = [0, 1].map(|i| {
            let body = rig.scene.bodies.iter().find(|b| b.tracked == Some(i)).expect("it has a mesh");
            let all = &body.mesh.positions;
            all.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / all.len() as f64
        });
        let place = |body: usize, at: HostTime| {
            let truth = rig.true_poses(at.0).expect("the mock tells");
            rig.camera.project(truth[body].transform_point3(centres[body])).expect("in front")
        };
        let between = 0.5 * (place(0, HostTime(0)).x + place(1, HostTime(0)).x);
        let runs = [1.0, 0.5].map(|follow| (follow, lit(&format!("projector.plane_follow={follow}")).1));
        for ((follow, own), body) in runs.iter().flat_map(|run| [(run, 0), (run, 1)]) {
            let is_left = place(body, HostTime(0)).x < between;
            let row = |light: &LightFrame, bit: usize| {
                let lit = light.codes.iter().enumerate().filter(|(i, code)| {
                    let is_here = ((*i % 512) as f64) < between;
                    is_here == is_left && code.iter().any(|c| c >> bit & 1 == 1)
                });
                let (count, sum) = lit.fold((0.0, 0.0), |(n, sum), (i, _)| (n + 1.0, sum + (i / 512) as f64));
                (count, sum / count)
            };
            let (mut products, mut squares) = (0.0, 0.0);
            for (own, one) in own.iter().zip(&one) {
                assert_eq!(own.frame, one.frame);
                let centre = own.first_photon_at.plus_ns((slot_ns as f64 * centre_of(&rig.schedule)) as i64);
                for (bit, middle) in middle_of_bit.iter().enumerate() {
                    let at = own.first_photon_at.plus_ns((slot_ns as f64 * middle) as i64);
                    let expected = place(body, at).y - place(body, centre).y;
                    let ((count, own), (_, one)) = (row(own, bit), row(one, bit));
                    assert!(count > 200.0, "body {body}, bit {bit}: {count} mirrors");
                    products += count * expected * (own - one);
                    squares += count * expected * expected;
                }
            }
            let share = products / squares;
            println!("body {body}: planes move by {share:.3} of the body's motion, told {follow}");
            assert!((share - follow).abs() < 0.2, "body {body}: planes move by {share} of its motion");
        }
    });
}

/// Root mean square distance in time of a frame's light from its centre, seconds.
fn spread_of_light_s(rig: &Rig) -> f64 {
    let planes = rig.schedule.planes();
    let weight = |bit: u8| f64::from(1u32 << bit);
    let all: f64 = planes.iter().map(|p| weight(p.bit)).sum();
    let moment = |power: i32| {
        let of = |(i, p): (usize, &PlaneSpec)| (i as f64 + 0.5).powi(power) * weight(p.bit);
        planes.iter().enumerate().map(of).sum::<f64>() / all
    };
    (moment(2) - moment(1).powi(2)).sqrt() * rig.rate().slot_len_ns(0) as f64 * 1e-9 / planes.len() as f64
}

#[test]
fn a_lost_body_goes_dark_and_comes_back() {
    with_gpu(|gpu| {
        let (gone_at, back_at) = (HostTime(250_000_000), HostTime(310_000_000));
        let rig = demo_rig(32, 24, &["tracker.faults=\"dropout@250ms+60ms\"", "render.spp=1", FULL]);
        let (outcome, _) = run(gpu, &rig, 220, 220);
        assert_eq!(outcome.light_mismatches, 0);
        let frame_ns = rig.rate().slot_len_ns(0);
        let dark_from = gone_at.plus_ns(20_000_000 + frame_ns);
        let lit_from = back_at.plus_ns(10_000_000);
        let mut seen = [0; 3];
        for light in &outcome.light {
            let at = light.first_photon_at;
            let lit = light.codes.iter().filter(|c| **c != [0; 3]).count();
            if at < gone_at {
                seen[0] += 1;
                assert!(lit > 20, "{lit} pixels at {at:?}, before the tracker fell silent");
            } else if at > dark_from && at < back_at {
                seen[1] += 1;
                assert_eq!(lit, 0, "{at:?}: {} ns after the last sample", at.ns_since(gone_at));
            } else if at > lit_from {
                seen[2] += 1;
                assert!(lit > 20, "{lit} pixels at {at:?}, after the tracker came back");
            }
        }
        assert!(seen.iter().all(|n| *n > 20), "{seen:?}");
    });
}

#[test]
fn a_fifth_of_the_samples_lost_costs_little() {
    with_gpu(|gpu| {
        let rig = demo_rig(32, 24, &["tracker.drop_out=0.2", "render.spp=1"]);
        let (outcome, _) = run(gpu, &rig, 150, 0);
        assert_eq!((outcome.light_mismatches, outcome.report.frames_lit), (0, 150));
        let error = outcome.report.registration_error_px.expect("the mock tells the truth");
        assert!(error.p99 * 32.0 < 1.0, "{} px at 1024 x 768", error.p99 * 32.0);
    });
}

/// Longer runs.
mod breadth {
    use super::*;

    #[test]
    fn a_run_repeats_to_the_bit() {
        with_gpu(|gpu| {
            let hash = |method: &str, seed: &str| {
                let rig = demo_rig(32, 24, &[method, seed, "tracker.noise_m=0.0002"]);
                let (outcome, _) = run(gpu, &rig, 24, 0);
                assert_eq!((outcome.light_mismatches, outcome.report.frames_lit), (0, 24), "{method}");
                outcome.report.light_hash
            };
            // Both methods keep histories, in which a race would be visible.
            let (dpm, paper) = ("render.method=\"dpm\"", "render.method=\"paper\"");
            let first = hash(dpm, "render.seed=7");
            assert_ne!(first, "0000000000000000");
            assert_eq!(first, hash(dpm, "render.seed=7"));
            assert_ne!(first, hash(dpm, "render.seed=8"), "the seed has no effect");
            assert_eq!(hash(paper, "render.seed=7"), hash(paper, "render.seed=7"));
        });
    }

    /// Everything that a run at virtual pace reports, not only the light, with samples and packets lost on the way, is
    /// the same on an idle machine and on a busy one.
    #[test]
    fn a_whole_report_repeats_on_a_busy_machine() {
        with_gpu(|gpu| {
            let lossy = ["tracker.drop_out=0.1", "projector.backend={kind=\"mock\",faults=\"loss=0.05\"}"];
            for method in ["dpm", "paper"] {
                let method = format!("render.method=\"{method}\"");
                let settings = [lossy[0], lossy[1], &method, "render.spp=1"];
                let rig = demo_rig(64, 48, &settings);
                let once = || told(&run(gpu, &rig, 60, 0).0.report);
                let first = once();
                assert!(first["frames_dropped"].as_u64() > Some(0), "nothing was lost: {first}");
                assert_eq!(first, once());
                assert_eq!(first, beside_others(once));
            }
        });
        // More frames than the collector can hold at once, faster than it reads them.
        let rig = demo_rig(
            16,
            12,
            &["tracker.drop_out=0.1", "projector.backend={kind=\"mock\",faults=\"loss=0.02\"}"],
        );
        let once = || {
            let options = RunOptions { frames: 3000, ..RunOptions::default() };
            let outcome = pipeline::run_prepared(rig.clone(), options, &Arc::new(RunMonitor::default()));
            told(&outcome.unwrap_or_else(|e| panic!("{e}")).report)
        };
        let first = once();
        assert!(first["missed_slots"].as_u64() > Some(0), "{first}");
        for _ in 0..3 {
            assert_eq!(first, beside_others(once));
        }
    }

    /// Bodies that pass at 1 m/s, without noise: whatever the order and the number of the planes, the light of a frame lies
    /// on the point that it belongs to as an eye sees it that follows the point. If all planes show the bodies at one instant,
    /// the light is spread around the point as far as the point moves while the planes last, which is a closed form. If planes
    /// follow by a share of their way, the rest of it is left, and what the point moves between the three planes of a bit. Aiming at the middle of the exposure would miss by
    /// 0.6 px.
    #[test]
    fn light_of_passing_bodies_is_centred_on_them_whatever_the_order_of_the_planes() {
        let moving = |i: usize| {
            format!("scene.bodies.{i}.motion={{kind=\"translate\",speed_m_s=1.0,amplitude_m=2.0,acceleration_m_s2=50.0}}")
        };
        let orders = ["7 6 5 4 3 2 1 0", "0 1 2 3 4 5 6 7", "0 2 4 6 7 5 3 1", "5 0 7 2 4 6 1 3"];
        let rigs = orders.iter().flat_map(|order| [(24, "binary", *order), (8, "binary", *order)]);
        let rigs = rigs.chain([(24, "equal", orders[0]), (8, "equal", orders[0])]);
        let ways = [("frame", 1.0), ("own", 1.0), ("own", 0.8)];
        for ((planes, weights, order), (poses, follow)) in rigs.flat_map(|rig| ways.map(|way| (rig, way))) {
            let flags = [
                format!("projector.plane_poses=\"{poses}\""),
                format!("projector.plane_follow={follow}"),
                format!("projector.planes={planes}"),
                format!("projector.plane_order=\"{order}\""),
                format!("projector.weights=\"{weights}\""),
                moving(0),
                moving(1),
            ];
            // Planes follow a body that moves by a quarter of a pixel at least.
            let (width, height, frames) = if poses == "own" { (512, 384, 160) } else { (128, 96, 600) };
            let rig = demo_rig(width, height, &flags.each_ref().map(String::as_str));
            let options = RunOptions { frames, ..RunOptions::default() };
            let outcome = pipeline::run_prepared(rig.clone(), options, &Arc::new(RunMonitor::default()));
            let report = outcome.unwrap_or_else(|e| panic!("{e}")).report;
            let full_size = 1024.0 / f64::from(width);
            let offset = report.followed_offset_px.expect("the mock tells the truth").p99 * full_size;
            let smear = report.followed_smear_px.expect("the mock tells the truth").p50 * full_size;
            assert!(offset < 0.03, "{planes} {weights} {order} {poses}: {offset} px off at 1024 x 768");
            // 1 m/s is about 1.75 px a millisecond in the middle of the room; the bodies are some tenths nearer or further.
            let speed_px_s = 1024.0 / (2.0 * 1.1 * (15f64).to_radians().tan());
            let spread = spread_of_light_s(&rig) * speed_px_s;
            if poses == "own" {
                // Red and blue are lit one plane before and after green.
                let apart =
                    if (planes, weights) == (24, "binary") { (2f64 / 3.0).sqrt() / 24.0 } else { 0.0 };
                let apart = apart * rig.rate().slot_len_ns(0) as f64 * 1e-9 * speed_px_s;
                // Planes of equal weights always follow wholly.
                let rest = if weights == "equal" { 0.0 } else { (1.0 - follow) * spread };
                let expected = apart.hypot(rest);
                println!("{planes} {weights} {order}, follow {follow}: {smear:.3} of {expected:.3} px");
                assert!(
                    smear < 1.25 * expected + 0.02,
                    "{planes} {weights} {order}: {smear} of {expected} px"
                );
                assert!(smear >= 0.75 * rest, "{planes} {weights} {order}, follow {follow}: only {smear} px");
                continue;
            }
            assert!(
                (0.8..1.25).contains(&(smear / spread)),
                "{planes} {weights} {order}: {smear} of {spread} px"
            );
        }
    }
}

/// Runs at real pace.
mod real_pace {
    use super::*;

    #[test]
    fn a_stop_request_ends_the_run_at_once() {
        with_gpu(|gpu| {
            for pace in [REAL, "real_time.pace=\"virtual\""] {
                let rig = demo_rig(32, 24, &[pace, "render.spp=1"]);
                let monitor = Arc::new(RunMonitor::default());
                let options = RunOptions::default();
                let took = std::thread::scope(|scope| {
                    let stopper = scope.spawn(|| {
                        let limit = Instant::now() + Duration::from_secs(60);
                        while monitor.counts().frames_planned < 20 && Instant::now() < limit {
                            std::thread::sleep(Duration::from_millis(1));
                        }
                        monitor.request_stop();
                        Instant::now()
                    });
                    let outcome = pipeline::run(rig.clone(), gpu, options, &monitor).unwrap();
                    assert!(monitor.counts().frames_done() >= 20 && outcome.report.slots > 0);
                    Instant::now().duration_since(stopper.join().unwrap())
                });
                assert!(took < Duration::from_millis(500), "{pace}: {took:?}");
                let counts = monitor.counts();
                assert_eq!(counts.frames_planned, counts.frames_done(), "{pace}");
            }
        });
    }

    #[test]
    fn at_real_pace_every_planned_frame_is_accounted_for() {
        with_gpu(|gpu| {
            let rig = demo_rig(32, 24, &[REAL, "render.spp=1", "projector.frame_rate=\"100\""]);
            let (outcome, monitor) = run(gpu, &rig, 60, 4);
            let counts = monitor.counts();
            assert_eq!(counts.frames_planned, 60);
            assert_eq!(counts.frames_planned, counts.frames_done());
            let r = &outcome.report;
            assert_eq!((r.frames_lit, r.frames_dropped), (counts.frames_lit, counts.frames_dropped));
            assert_eq!(r.pace, "real");
            assert!(r.frames_lit > 0, "not one frame in time at 100 Hz");
            assert!(
                r.motion_to_light_ms.as_ref().is_some_and(|m| m.p50 > 2.0),
                "the tracker alone takes 2 ms"
            );
        });
    }
}
