//! Tracks from end to end at virtual pace: a host that sends them, and a mock projector that follows them. What is judged
//! is the light that the mock emitted: every plane with the shifts with which it was lit, at points of the bodies, each
//! weighted with the light of its plane. It is in a file of its own so that nothing else runs at the same time.

use dpm_device::projector::SlotMoves;
use dpm_rig::config::TracksUse;
use dpm_rig::light::planes::{PlaneMeter, PlanePoint};
use dpm_rig::pipeline::{self, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::rigs::demo_rig;
use std::sync::Arc;

/// Frames of a run: a body turns twice in them, at places where it never turned before.
const FRAMES: u64 = 800;
/// Frames after which the filters know the motion.
const BEGUN: u64 = 60;
/// No shift of this host is greater, mirrors.
const CLAMP: u8 = 8;

/// A tracker, and the time from latch to light.
#[derive(Clone, Copy)]
struct Setting {
    rate_hz: u32,
    latency_us: u32,
    lead_us: u32,
}

/// Trackers and delays, with the greatest 99th percentile that turns may have, pixels.
const SETTINGS: [(Setting, f64); 3] = [
    (Setting { rate_hz: 500, latency_us: 2000, lead_us: 2200 }, 2.0),
    (Setting { rate_hz: 500, latency_us: 2000, lead_us: 4500 }, 2.0),
    (Setting { rate_hz: 1000, latency_us: 500, lead_us: 2200 }, 1.0),
];

const STEADY: &str = "{kind=\"translate\",speed_m_s=1.0,amplitude_m=2.0,acceleration_m_s2=50.0}";

/// Reaching with a hand: swings of two paces along two lines, and a tremor of half a millimetre at 8 Hz.
const HUMAN: &str = "{kind=\"together\",parts=[\
    {kind=\"sinusoid\",peak_speed_m_s=0.8,peak_acceleration_m_s2=5.0},\
    {kind=\"sinusoid\",direction=[0,1,0.3],peak_speed_m_s=0.3,peak_acceleration_m_s2=3.1},\
    {kind=\"sinusoid\",direction=[0.3,1,0],peak_speed_m_s=0.025,peak_acceleration_m_s2=1.26}]}";

/// Straight lines of 1 m/s with turns of 50 m/s2 between them, in run `k`.
fn turning(k: usize) -> String {
    let amplitude_m = [0.2, 0.14, 0.29, 0.17, 0.25, 0.31, 0.155, 0.22][k % 8];
    let (sense, rise) = (if k & 1 == 0 { 1 } else { -1 }, 0.3 * (k % 3) as f64);
    format!(
        "{{kind=\"translate\",direction=[{sense},{rise},0.1],speed_m_s=1.0,amplitude_m={amplitude_m},acceleration_m_s2=50.0}}"
    )
}

/// The demo at full size with both bodies in `motion`, and 0.1 mm of noise.
fn rig(motion: &str, setting: Setting, tracks: &str) -> Arc<Rig> {
    let Setting { rate_hz, latency_us, lead_us } = setting;
    // 50 us of the lead are the pipeline's own margin.
    let render_us = lead_us - 50 - 250;
    let flags = [
        format!("scene.bodies.0.motion={motion}"),
        format!("scene.bodies.1.motion={motion}"),
        format!("tracker.rate_hz={rate_hz}"),
        format!("tracker.latency_us={latency_us}"),
        "tracker.noise_m=0.0001".into(),
        format!("real_time.stage_costs_us={{track=50,plan=50,render={render_us},pack=100,send=100}}"),
        format!("projector.tracks=\"{tracks}\""),
    ];
    demo_rig(1024, 768, &flags.each_ref().map(String::as_str))
}

fn lit(rig: &Arc<Rig>, frames: u64) -> RunOutcome {
    lit_keeping(rig, frames, 0)
}

/// The same with the last `keep_frames` frames of light.
fn lit_keeping(rig: &Arc<Rig>, frames: u64, keep_frames: usize) -> RunOutcome {
    let options = RunOptions { frames, keep_frames, keep_records: frames as usize, ..RunOptions::default() };
    let outcome = pipeline::run_prepared(rig.clone(), options, &Arc::new(RunMonitor::default()));
    outcome.unwrap_or_else(|e| panic!("{e}"))
}

/// The light of runs: distances in pixels with the light that fell there, as drawn and as lit.
#[derive(Default)]
struct Light {
    drawn: Vec<(f64, f64)>,
    lit: Vec<(f64, f64)>,
    /// Ages of the tracks in milliseconds, with the light of their planes.
    ages_ms: Vec<(f64, f64)>,
    planes_moved: usize,
}

impl Light {
    /// Adds the light of a run.
    fn add(&mut self, rig: &Arc<Rig>, outcome: &RunOutcome) {
        let meter = PlaneMeter::new(rig.clone());
        let planes = rig.schedule.planes();
        for record in outcome.recent.iter().filter(|record| record.id.0 >= BEGUN) {
            let of_frame = |m: &&SlotMoves| m.frame == record.id.0 as u32 && m.slot == record.slot;
            // The light of the last frames ends with the run.
            let moves = outcome.moves.iter().find(of_frame);
            if rig.config.projector.tracks == TracksUse::Off {
                meter.measure(record, None, &mut |p: PlanePoint| self.lit.push((p.off_px, p.light)));
                continue;
            }
            let Some(moves) = moves else { continue };
            meter.measure(record, Some(moves), &mut |p: PlanePoint| {
                self.drawn.push((p.drawn_off_px, p.light));
                self.lit.push((p.off_px, p.light));
            });
            for ((plane, age), spec) in moves.planes().iter().zip(moves.ages()).zip(planes) {
                let age = age.expect("tracks hold for every plane");
                self.ages_ms.push((f64::from(age) * 1e-6, f64::from(1u32 << spec.bit)));
                self.planes_moved += usize::from(plane.is_any());
                assert!(plane.all().len() <= rig.bodies.len(), "a region for each body that is seen");
                assert!(plane.all().iter().flat_map(|one| one.shift).all(|s| s.unsigned_abs() <= CLAMP));
            }
        }
    }

    /// The 50th and the 99th percentile as drawn and as lit, pixels.
    fn quantiles(&mut self) -> [[f64; 2]; 2] {
        [&mut self.drawn, &mut self.lit].map(|all| [quantile(all, 0.5), quantile(all, 0.99)])
    }
}

/// The value below which a share of the light lies.
fn quantile(points: &mut [(f64, f64)], share: f64) -> f64 {
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all: f64 = points.iter().map(|p| p.1).sum();
    let mut below = 0.0;
    let reaches = |p: &&(f64, f64)| {
        below += p.1;
        below >= share * all
    };
    points.iter().find(reaches).map_or(f64::NAN, |p| p.0)
}

fn light_of(motions: &[String], setting: Setting) -> Light {
    let mut light = Light::default();
    for motion in motions {
        let rig = rig(motion, setting, "auto");
        light.add(&rig, &lit(&rig, FRAMES));
    }
    light
}

fn told(what: &str, setting: Setting, light: &mut Light) -> [[f64; 2]; 2] {
    let [drawn, lit] = light.quantiles();
    let age = quantile(&mut light.ages_ms, 0.99);
    println!(
        "| {} Hz, {} ms; {} ms | {what} | {:.2} / {:.2} | {:.2} / {:.2} | {age:.2} | {} |",
        setting.rate_hz,
        f64::from(setting.latency_us) / 1e3,
        f64::from(setting.lead_us) / 1e3,
        drawn[0],
        drawn[1],
        lit[0],
        lit[1],
        light.planes_moved
    );
    [drawn, lit]
}

/// What a run keeps of its light and what its report says of it have the shifts in them: every mirror of every plane shows
/// what docs/PROTOCOL.md says, and an eye that follows the bodies sees less error than without tracks, and never more.
#[test]
fn the_light_and_the_report_of_a_run_have_tracks_in_them() {
    let [on, off] = ["auto", "off"].map(|tracks| {
        let rig = rig(&turning(1), SETTINGS[1].0, tracks);
        let outcome = lit_keeping(&rig, 300, 30);
        (rig, outcome)
    });
    let ((rig, on), (_, off)) = (on, off);
    let seen = |outcome: &RunOutcome| outcome.report.followed_offset_px.expect("the mock tells the truth");
    println!("offset with tracks {:?}, without {:?}", seen(&on), seen(&off));
    // In so short a run the filters hardly expect the turn yet, and correct little.
    assert!(
        seen(&on).p50 < seen(&off).p50 && seen(&on).max <= seen(&off).max,
        "{:?} {:?}",
        seen(&on),
        seen(&off)
    );
    assert_eq!((on.report.followed_light, off.report.followed_light), (Some("as lit"), Some("as lit")));
    assert!(on.report.to_table().contains("px (with tracks)"));
    assert!(!off.report.to_table().contains("tracks"));
    let mut moved = 0;
    for (seen, sent) in on.light.iter().zip(&off.light) {
        assert_eq!(seen.frame, sent.frame);
        let of_frame = |m: &&SlotMoves| m.frame == seen.frame && m.first_photon_at == seen.first_photon_at;
        let Some(moves) = on.moves.iter().find(of_frame) else { continue };
        assert_eq!(seen.is_moved, moves.is_any());
        if moves.is_any() && moved < 3 {
            moved += 1;
            let expected = moved_light(&rig, &sent.codes, moves);
            assert!(seen.codes == expected && seen.codes != sent.codes, "frame {}", seen.frame);
        }
    }
    assert_eq!(moved, 3);
}

/// The light `sent`, each mirror of each plane by itself as `moves` say: a mirror of a region shows the mirror that lies the
/// region's shift before it, if that is of the same region, and is dark otherwise.
fn moved_light(rig: &Rig, sent: &[[u8; 3]], moves: &SlotMoves) -> Vec<[u8; 3]> {
    let raster = rig.camera.raster;
    let (width, height) = (i64::from(raster.width()), i64::from(raster.height()));
    let mut light = vec![[0; 3]; sent.len()];
    for (plane, moves) in rig.schedule.planes().iter().zip(moves.planes()) {
        let region = |x: i64, y: i64| moves.all().iter().position(|one| one.area.contains(x, y));
        for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
            let [dx, dy] = moves.of_mirror(x, y).map(i64::from);
            let (from_x, from_y) = (x - dx, y - dy);
            let is_on = (0..width).contains(&from_x)
                && (0..height).contains(&from_y)
                && region(x, y) == region(from_x, from_y);
            if is_on {
                let channel = plane.channel as usize;
                let code = sent[(from_y * width + from_x) as usize][channel];
                light[(y * width + x) as usize][channel] |= code & (1 << plane.bit);
            }
        }
    }
    light
}

/// Seconds of motion.
mod breadth {
    use super::*;
    use dpm_device::pose::Pose;
    use dpm_device::rng::Sampler;
    use glam::{DQuat, DVec3};
    use hil_mock::motion::Motion;
    use std::f64::consts::TAU;

    /// A run repeats, shifts included. "off" sends none, and changes nothing else.
    #[test]
    fn tracks_repeat_and_can_be_switched_off() {
        let run = |tracks: &str| {
            let outcome = lit(&rig(&turning(1), SETTINGS[1].0, tracks), 300);
            let moves: Vec<String> = outcome.moves.iter().map(|m| format!("{m:?}")).collect();
            let poses: Vec<_> = outcome.recent.iter().map(|r| r.tracked_poses.clone()).collect();
            let projector = outcome.report.projector.expect("the mock was used");
            let [moved, clamped, stale] = projector.planes_by_tracks;
            assert_eq!(moved > 0, tracks == "auto", "{moved} planes moved");
            assert_eq!((clamped, stale), (0, 0));
            // Four messages a millisecond, and those of the next frame beside them.
            let sent = 300..3000;
            assert_eq!(sent.contains(&projector.tracks_sent), tracks == "auto", "{}", projector.tracks_sent);
            (moves, poses, outcome.report.frames_lit)
        };
        let (on, again, off) = (run("auto"), run("auto"), run("off"));
        assert!(on.0.len() > 250 && on == again);
        assert!(off.0.is_empty());
        assert_eq!((on.1, on.2), (off.1, off.2));
    }

    /// Turns of 50 m/s2 that nothing foretells: with tracks the light lies within the limits, and without them it does not.
    /// The tracks in the light are young.
    #[test]
    fn tracks_keep_light_on_bodies_that_turn() {
        let motions: Vec<String> = (0..4).map(turning).collect();
        for (setting, limit_px) in SETTINGS {
            let mut light = light_of(&motions, setting);
            let [drawn, lit] = told("turns", setting, &mut light);
            assert!(lit[1] <= limit_px, "p99 {} px, at most {limit_px}", lit[1]);
            assert!(drawn[1] > 1.25 * lit[1], "p99 {} px as drawn, {} px as lit", drawn[1], lit[1]);
            assert!(lit[0] <= 1.02 * drawn[0], "p50 {} px as drawn, {} px as lit", drawn[0], lit[0]);
            assert!(quantile(&mut light.ages_ms, 0.99) <= 0.6);
        }
    }

    /// A hand by chance: sums of waves of all frequencies up to 6 Hz along and about all axes, that never repeat. `sharp`: m/s2
    /// and, times four, rad/s2, of all together.
    fn hand(seed: u64, sharp: f64) -> Vec<Pose> {
        const WAVES: usize = 24;
        let mut sampler = Sampler::new(seed, 0);
        let mut unit = || (sampler.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
        let waves: Vec<(f64, f64, DVec3, DVec3)> = (0..WAVES)
            .map(|_| {
                let rate = TAU * 0.2 * 30.0f64.powf(unit());
                let phase = TAU * unit();
                let mut along = || DVec3::new(unit() - 0.5, unit() - 0.5, unit() - 0.5).normalize();
                // No wave is wider than 8 cm or 0.2 rad.
                let size = sharp * (2.0 / WAVES as f64).sqrt() / (rate * rate);
                (rate, phase, along() * size.min(0.08), along() * (4.0 * size).min(0.2))
            })
            .collect();
        let steps = (FRAMES as usize) * 3 / 2 + 500;
        let at = |s: f64| {
            let sum = |of: fn(&(f64, f64, DVec3, DVec3)) -> DVec3| -> DVec3 {
                waves.iter().map(|wave| of(wave) * (wave.0 * s + wave.1).sin()).sum()
            };
            (sum(|wave| wave.2), DQuat::from_scaled_axis(sum(|wave| wave.3)))
        };
        (0..steps).map(|k| at(k as f64 * STEP_NS as f64 * 1e-9)).map(rigid).collect()
    }

    /// The time between two poses of a recording, nanoseconds.
    const STEP_NS: i64 = 1_000_000;

    fn rigid((position, rotation): (DVec3, DQuat)) -> Pose {
        Pose { position_m: position.to_array(), rotation_xyzw: rotation.normalize().to_array() }
    }

    /// A recorded motion without its slow travel, which would leave the picture, from `from_s` on. A line of the file has
    /// seconds, x y z in metres and a quaternion x y z w.
    fn recording(path: &std::path::Path, from_s: f64) -> Vec<Pose> {
        let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let rows: Vec<[f64; 8]> = text
            .lines()
            .filter(|line| !line.starts_with('#'))
            .map(|line| {
                line.split_whitespace().map(|word| word.parse().expect("a number")).collect::<Vec<f64>>()
            })
            .map(|row| row.try_into().expect("eight numbers"))
            .collect();
        let smooth = |k: usize, sigma: usize, column: usize, turn: Option<&[f64; 8]>| {
            let reach = (3 * sigma).min(k).min(rows.len() - 1 - k);
            let of = |row: &[f64; 8]| {
                let same = turn.is_none_or(|first| (4..8).map(|i| first[i] * row[i]).sum::<f64>() >= 0.0);
                if same {
                    row[column]
                } else {
                    -row[column]
                }
            };
            let weighted = (k - reach..=k + reach).map(|j| {
                let weight = (-0.5 * ((j as f64 - k as f64) / sigma as f64).powi(2)).exp();
                (weight * of(&rows[j]), weight)
            });
            let (sum, weight) = weighted.fold((0.0, 0.0), |(s, w), (a, b)| (s + a, w + b));
            sum / weight
        };
        let per_s = rows.len() as f64 / (rows[rows.len() - 1][0] - rows[0][0]);
        let slow = (0.5 * per_s) as usize;
        let rigid_rows: Vec<(f64, DVec3, DQuat)> = (0..rows.len())
            .map(|k| {
                let place = |i: usize| smooth(k, 2, i, None) - smooth(k, slow, i, None);
                let turn = |i: usize| smooth(k, 2, i, Some(&rows[k]));
                let rotation = DQuat::from_xyzw(turn(4), turn(5), turn(6), turn(7)).normalize();
                (rows[k][0] - rows[0][0], DVec3::new(place(1), place(2), place(3)), rotation)
            })
            .collect();
        let first = rigid_rows[0].2.inverse();
        let steps = (FRAMES as usize) * 3 / 2 + 500;
        (0..steps)
            .map(|k| {
                let t = from_s + k as f64 * STEP_NS as f64 * 1e-9;
                let i = rigid_rows.partition_point(|row| row.0 <= t).clamp(2, rows.len() - 2) - 1;
                let around = &rigid_rows[i - 1..i + 3];
                let weight = |n: usize| -> f64 {
                    (0..4)
                        .filter(|&m| m != n)
                        .map(|m| (t - around[m].0) / (around[n].0 - around[m].0))
                        .product()
                };
                let position = (0..4).map(|n| around[n].1 * weight(n)).sum();
                let turn = (0..4).fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, n| {
                    let q = around[n].2;
                    sum + if q.dot(around[0].2) < 0.0 { -q } else { q } * weight(n)
                });
                (position, first * turn.normalize())
            })
            .map(rigid)
            .collect()
    }

    /// The light of both bodies going through `poses`, with tracks or without.
    fn light_along(poses: &[Pose], setting: Setting, tracks: &str) -> Light {
        let mut rig = rig(STEADY, setting, tracks);
        for body in &mut Arc::get_mut(&mut rig).expect("nobody else has it").bodies {
            body.motion = Some(Motion::through(body.rest, poses, STEP_NS).expect("rigid poses"));
        }
        let mut light = Light::default();
        light.add(&rig, &lit(&rig, FRAMES));
        light
    }

    /// Whatever moves, light is never worse with tracks than without at its 99th percentile. `DPM_RECORDINGS` names a folder with
    /// recordings, which are judged as well.
    #[test]
    fn tracks_never_lose_on_motion_of_people() {
        let mut motions: Vec<(String, Vec<Pose>)> = [(1, 2.0), (2, 6.0), (3, 15.0), (4, 40.0)]
            .map(|(k, a)| (format!("hand, {a} m/s2"), hand(k, a)))
            .into();
        if let Ok(folder) = std::env::var("DPM_RECORDINGS") {
            let files = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{folder}: {e}"));
            let mut files: Vec<_> = files.map(|file| file.expect("a file").path()).collect();
            files.sort();
            for path in files {
                let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                motions.push((name, recording(&path, 1.0)));
            }
        }
        let mut lost = Vec::new();
        for (what, poses) in motions {
            for (setting, _) in SETTINGS {
                let [on, off] = ["auto", "off"].map(|tracks| {
                    let mut light = light_along(&poses, setting, tracks);
                    let [_, [p50, p99]] = light.quantiles();
                    (p50, p99, light.planes_moved)
                });
                let Setting { rate_hz, lead_us, .. } = setting;
                println!(
                    "| {what} | {rate_hz} Hz, {lead_us} us | {:.3} / {:.3} | {:.3} / {:.3} | {:.3} | {} |",
                    off.0,
                    off.1,
                    on.0,
                    on.1,
                    on.1 / off.1,
                    on.2
                );
                if on.1 > 1.01 * off.1 {
                    lost.push(format!(
                        "{what} at {rate_hz} Hz, {lead_us} us: {} px, without tracks {} px",
                        on.1, off.1
                    ));
                }
            }
        }
        assert!(lost.is_empty(), "{lost:#?}");
    }

    /// Motion without surprises is at most 15 % worse.
    #[test]
    fn tracks_leave_quiet_motion_alone() {
        for (setting, _) in SETTINGS {
            for (what, motion) in [("steady", STEADY), ("human", HUMAN)] {
                let [drawn, lit] = told(what, setting, &mut light_of(&[motion.into()], setting));
                assert!(
                    lit[1] <= 1.15 * drawn[1],
                    "{what}: p99 {} px as drawn, {} px as lit",
                    drawn[1],
                    lit[1]
                );
            }
        }
    }
}
