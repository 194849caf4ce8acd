//! Histories, shading rates and filters on the GPU: what is constant stays, what changes is followed, what is broken is forgotten.

use super::gpu::GpuCase;
use super::gpu_exact::{chance_comes_in, noise_free};
use super::gpu_paper::{gaze_aside, ALPHAS};
use super::gpu_shot::Shot;
use super::gpu_tracer::still_life;
use crate::error::plan::method_of;
use crate::twins::rate_map::{decide, PixelGuide, RateConstants};
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::rate_table::rate_table;
use dpm_render::{FrameSlot, History, Renderer};
use dpm_rig::config::{RenderConfig, RenderMethod};
use dpm_scene::shapes::*;
use dpm_scene::{Environment, PunctualKind, PunctualLight, Scene};
use dpm_shaders::structs::{HistoryNoise, NO_HIT};
use glam::{DAffine3, DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-tiles-at-borders",
        "rasters of 1 x 1 to 33 x 31, every method",
        "closed form: 1 in every lit pixel",
        "radiance",
        1e-4,
        borders,
    ),
    GpuCase(
        "gpu-constant-input",
        "300 frames of even light, every method",
        "closed form: 1, no drift",
        "radiance",
        1e-4,
        constant_input,
    ),
    GpuCase(
        "gpu-step-input",
        "a light that drops by 3 m in one step, every method without shading rates, a quarter of a second later",
        "closed form, in steps of 8-bit codes",
        "codes",
        1.0,
        step_input,
    ),
    GpuCase(
        "gpu-step-follows-the-paper",
        "the same step frame by frame, method paper, 5, 22 and 40 degrees from the gaze",
        "closed form: (1 - alpha)^n, alpha 0.2, 0.1 and 0.05",
        "radiance by step",
        1e-3,
        step_paper,
    ),
    GpuCase(
        "gpu-poisoned-history",
        "NaN and infinity in all of the history or one pixel, every method",
        "gone two frames later, neighbours clean",
        "faults",
        0.0,
        poisoned,
    ),
    GpuCase(
        "gpu-rate-map-equals-cpu",
        "64 x 48 of moving surfaces, method paper",
        "the CPU's decision, bit for bit",
        "tiles",
        0.0,
        rate_map,
    ),
    GpuCase(
        "gpu-nobody-waits",
        "24 frames of method paper at mixed rates with checkerboard, all drawn, or every second one dropped",
        "every block is traced in every second frame",
        "frames over 2",
        0.0,
        nobody_waits,
    ),
    GpuCase(
        "gpu-rates-keep-energy",
        "every method against all pixels traced, 48 frames",
        "mean radiance",
        "relative",
        5e-3,
        energy_kept,
    ),
    GpuCase(
        "gpu-noise-free-is-exact",
        "a mirror ball that crosses the picture under an uneven sky, method dpm, one sample requested, and four",
        "each frame as drawn without a history, one sample a lit pixel",
        "radiance",
        1e-5,
        noise_free,
    ),
    GpuCase(
        "gpu-chance-comes-in",
        "a matte ball that passes a standing mirror ball, method dpm, two samples requested",
        "a pixel that begins to mirror it takes four samples in that frame and drops its earlier ones; a pixel that ceases to is exact at once",
        "faults",
        0.0,
        chance_comes_in,
    ),
    GpuCase(
        "gpu-new-points-at-once",
        "a matte ball that crosses the picture under an uneven sky, method dpm, one sample requested",
        "a point never seen before gets a sample in its first frame, whatever the noise elsewhere",
        "faults",
        0.0,
        new_points,
    ),
];

/// Every method with its authors' constants.
pub(super) fn methods() -> Vec<Method> {
    RenderMethod::DRAWN.into_iter().map(|which| method_of(&RenderConfig::default(), which)).collect()
}

/// Method dpm with its own constants.
pub(super) fn dpm() -> Method {
    method_of(&RenderConfig::default(), RenderMethod::Dpm)
}

/// A white Lambertian floor in even light: whatever is sampled, a lit pixel is 1.
pub(super) fn even() -> Scene {
    let mut scene = scene_of(floor(20.0, 0.0), diffuse(Vec3::ONE));
    scene.environment = sky(1.0);
    scene
}

const ABOVE: DVec3 = DVec3::new(0.3, 3.0, 1.0);
const BESIDE: DVec3 = DVec3::new(-0.5, 3.2, 0.8);

/// Largest difference from 1 of what is shown at lit pixels; infinite when none is lit.
pub(super) fn from_one(slot: &FrameSlot) -> f64 {
    let (shown, surfaces) = (slot.radiance().unwrap_or(&[]), slot.surfaces().unwrap_or_default());
    let lit = shown.iter().zip(surfaces).filter(|(_, s)| s.is_lit());
    let worst = lit.flat_map(|(r, _)| r[..3].iter()).map(|v| f64::from((v - 1.0).abs()));
    worst.fold(-1.0, |a: f64, d| if d.is_nan() { f64::INFINITY } else { a.max(d) })
}

/// Plays frames of a shot with a renderer of its own and a pose list that may change.
pub(super) fn play(
    gpu: &Arc<Gpu>,
    shot: &Shot<'_>,
    poses: impl Fn(u32) -> Vec<DAffine3>,
    mut each: impl FnMut(u32, &FrameSlot),
) {
    let mut renderer = Renderer::new(gpu, shot.scene, shot.settings()).expect("the scene fits the GPU");
    shot.play(&mut renderer, 0..shot.frames, poses, |frame, slot, _| each(frame, slot));
}

/// The same with the shot's own poses in every frame.
pub(super) fn play_at_rest(gpu: &Arc<Gpu>, shot: &Shot<'_>, each: impl FnMut(u32, &FrameSlot)) {
    play(gpu, shot, |_| shot.world_from_body(), each);
}

fn borders(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = even();
    let mut worst: f64 = 0.0;
    for method in methods() {
        for (w, h) in [(1, 1), (1, 17), (15, 17), (16, 16), (33, 31)] {
            let mut camera = camera(w, h, ABOVE, DVec3::ZERO);
            (camera.fx, camera.fy) = (60.0, 60.0);
            let shot = Shot {
                eye: Some(BESIDE),
                gaze: Some(DVec3::new(5.0, 0.0, -5.0)),
                spp: 2,
                frames: 5,
                seed: seed as u32,
                method: Some(method.clone()),
                ..Shot::new(&scene, camera)
            };
            play_at_rest(gpu, &shot, |frame, slot| {
                let off = from_one(slot);
                let dark = slot.surfaces().unwrap_or_default().iter().filter(|s| s.distance <= 0.0).count();
                worst = if off < 0.0 || dark > 0 {
                    f64::INFINITY
                } else if frame >= 2 {
                    worst.max(off)
                } else {
                    worst
                };
            });
        }
    }
    worst
}

fn constant_input(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = even();
    let camera = camera(16, 16, ABOVE, DVec3::ZERO);
    let mut worst: f64 = 0.0;
    for method in methods() {
        let shot = Shot {
            eye: Some(BESIDE),
            spp: 1,
            frames: 300,
            seed: seed as u32,
            method: Some(method),
            ..Shot::new(&scene, camera)
        };
        play_at_rest(gpu, &shot, |frame, slot| {
            if frame % 50 == 49 {
                let off = from_one(slot);
                worst = if off < 0.0 { f64::INFINITY } else { worst.max(off) };
            }
        });
    }
    worst
}

/// A floor under a point light that a second body carries: light without noise that a pose changes.
pub(super) fn carried_light() -> Scene {
    let mut scene = scene_of(floor(20.0, 0.0), diffuse(Vec3::splat(0.8)));
    let carrier = sphere(Vec3::ZERO, 0.01, 1, true);
    add(&mut scene, carrier, diffuse(Vec3::ZERO));
    scene.bodies[1].projected = false;
    scene.environment = Environment::Constant(Vec3::ZERO);
    scene.lights.push(PunctualLight {
        kind: PunctualKind::Point,
        intensity: Vec3::splat(4.0),
        body: Some(1),
        position: Vec3::new(0.0, 0.2, 0.0),
        direction: Vec3::NEG_Y,
        range: f32::INFINITY,
    });
    scene
}

fn light_at(height: f64) -> Vec<DAffine3> {
    vec![DAffine3::IDENTITY, DAffine3::from_translation(DVec3::new(4.0, height - 0.2, 0.0))]
}

/// Radiance of the floor in the middle of the picture (the origin), light at a height.
pub(super) fn lit_by(height: f64) -> f64 {
    let d2 = 16.0 + height * height;
    0.8 / std::f64::consts::PI * 4.0 * height / d2.powf(1.5)
}

/// The middle pixel, frame by frame: the light comes down from 4 m to 1 m after frame `step`.
fn stepped(gpu: &Arc<Gpu>, method: Method, gaze: DVec3, seed: u64, step: u32, frames: u32) -> Vec<f64> {
    let scene = carried_light();
    let camera = camera(17, 17, DVec3::new(0.0, 3.0, 0.01), DVec3::ZERO);
    let shot = Shot {
        eye: Some(BESIDE),
        gaze: Some(gaze),
        spp: 4,
        depth: 2,
        frames,
        seed: seed as u32,
        method: Some(method),
        ..Shot::new(&scene, camera)
    };
    let mut out = Vec::new();
    play(
        gpu,
        &shot,
        |frame| light_at(if frame <= step { 4.0 } else { 1.0 }),
        |_, slot| {
            out.push(slot.radiance().map_or(f64::NAN, |r| f64::from(r[8 * 17 + 8][1])));
        },
    );
    out
}

fn step_input(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for mut method in methods() {
        // A block of the paper's method shows one of its pixels; here the light falls off from pixel to pixel.
        method.rate_map &= method.dpm;
        method.spatial &= method.dpm;
        let seen = stepped(gpu, method, DVec3::ZERO, seed, 120, 120 + 237);
        let before = (seen[119] / lit_by(4.0) - 1.0).abs();
        let after = (seen[seen.len() - 1] / lit_by(1.0) - 1.0).abs();
        worst = worst.max(255.0 * before).max(255.0 * after);
        if !worst.is_finite() {
            return f64::NAN;
        }
    }
    worst
}

fn step_paper(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut method = method_of(&RenderConfig::default(), RenderMethod::Paper);
    // Every pixel in every frame, so that the recursion alone is left.
    (method.checkerboard, method.rate_map, method.spatial) = (false, false, false);
    let (from, to) = (lit_by(4.0), lit_by(1.0));
    let mut worst = 0f64;
    for (alpha, degrees) in ALPHAS {
        let seen = stepped(gpu, method.clone(), gaze_aside(BESIDE, degrees), seed, 40, 60);
        for n in 1..19 {
            let wanted = to + (from - to) * (1.0 - alpha).powi(n);
            let off = ((seen[40 + n as usize] - wanted) / (to - from)).abs();
            worst = if off.is_nan() { f64::INFINITY } else { worst.max(off) };
        }
    }
    worst
}

fn poisoned(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = even();
    let camera = camera(33, 33, ABOVE, DVec3::ZERO);
    let mut faults = 0u32;
    for method in methods() {
        let shot = Shot {
            eye: Some(BESIDE),
            spp: 2,
            frames: 8,
            seed: seed as u32,
            method: Some(method),
            ..Shot::new(&scene, camera)
        };
        let mut renderer = Renderer::new(gpu, &scene, shot.settings()).expect("the scene fits the GPU");
        let poses = shot.world_from_body();
        let mut now = 0;
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for whole in [true, false] {
                shot.play(&mut renderer, now..now + 6, |_| poses.clone(), |_, _, _| ());
                let pixels = 33 * 33;
                let range = if whole { 0..pixels } else { 544..545 };
                renderer.edit_history(range, |h: &mut History| poison(h, bad)).expect("memory");
                now += 6;
                shot.play(
                    &mut renderer,
                    now..now + 6,
                    |_| poses.clone(),
                    |frame, slot, _| {
                        let shown = slot.radiance().unwrap_or(&[]);
                        let near = |i: usize| (i % 33).abs_diff(16).max((i / 33).abs_diff(16)) <= 2;
                        for (i, v) in shown.iter().enumerate() {
                            let right = v[..3].iter().all(|v| (v - 1.0).abs() < 1e-3);
                            let excused = frame < now + 2 && (whole || near(i));
                            faults += u32::from(!right && !excused);
                            faults += u32::from(v.iter().any(|v| !v.is_finite()));
                        }
                    },
                );
                now += 6;
            }
        }
    }
    f64::from(faults)
}

fn poison(h: &mut History, bad: f32) {
    h.light.mean = [bad; 3];
    h.noise = HistoryNoise { drift: bad, variance: bad, surprise: bad, ..h.noise };
}

/// The paper's method with angles that cut through a small picture.
fn paper() -> Method {
    let mut method = method_of(&RenderConfig::default(), RenderMethod::Paper);
    method.paper.zone_spp = [4, 4, 2];
    (method.paper.phi_h_deg, method.paper.phi_q_deg) = (5.0, 10.0);
    (method.paper.filter_from_deg, method.paper.filter_to_deg) = (6.0, 8.0);
    method
}

/// The still life at 64 x 48, its ball drifting by `speed` metres a frame.
fn drift(
    gpu: &Arc<Gpu>,
    method: &Method,
    seed: u64,
    frames: u32,
    speed: f64,
    each: impl FnMut(u32, &FrameSlot),
) {
    drift_by(gpu, method, seed, frames, speed, 1, each);
}

/// The same where the frames' numbers go up by `step`, as they do in a rig that drops the others.
fn drift_by(
    gpu: &Arc<Gpu>,
    method: &Method,
    seed: u64,
    frames: u32,
    speed: f64,
    step: u32,
    each: impl FnMut(u32, &FrameSlot),
) {
    let mut scene = still_life(1.0);
    scene.environment = sky(0.2);
    let camera = camera(64, 48, DVec3::new(0.3, 1.6, 2.4), DVec3::new(0.0, 0.2, 0.0));
    let shot = Shot {
        eye: Some(DVec3::new(-0.3, 1.5, 2.3)),
        gaze: Some(DVec3::new(-0.4, 0.1, 0.2)),
        spp: 4,
        frames,
        step,
        seed: seed as u32,
        method: Some(method.clone()),
        ..Shot::new(&scene, camera)
    };
    let ball = |frame: u32| DAffine3::from_translation(DVec3::X * speed * f64::from(frame));
    play(gpu, &shot, |frame| vec![DAffine3::IDENTITY, ball(frame), DAffine3::IDENTITY], each);
}

fn rate_map(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let paper = paper();
    let constants = RateConstants {
        t: paper.paper.t as f32,
        l: paper.paper.l as f32,
        degrees: [paper.paper.phi_h_deg as f32, paper.paper.phi_q_deg as f32],
    };
    let table = rate_table();
    let (mut wrong, mut compared, mut coarse) = (0u32, 0u32, 0u32);
    drift(gpu, &paper, seed, 10, 0.01, |frame, slot| {
        if frame % 2 == 1 {
            return;
        }
        let (surfaces, guides) = (slot.surfaces().unwrap_or_default(), slot.guides().unwrap_or_default());
        let prior = slot.prior_luminance().unwrap_or_default();
        for (tile, &rate) in slot.rates().unwrap_or(&[]).iter().enumerate() {
            let pixels: [Option<PixelGuide>; 256] = std::array::from_fn(|i| {
                let at = (tile / 4 * 16 + i / 16) * 64 + tile % 4 * 16 + i % 16;
                let s = surfaces.get(at)?;
                s.is_lit().then(|| PixelGuide {
                    luminance: (prior[at] >= 0.0).then_some(prior[at]),
                    motion: guides[at].sight.motion,
                    size: guides[at].sight.size,
                    angle: guides[at].sight.angle,
                })
            });
            if pixels.iter().any(Option::is_some) {
                wrong += u32::from(rate != decide(&pixels, &table, &constants).code());
                compared += 1;
                coarse += u32::from(rate != 0);
            }
        }
    });
    if compared < 30 || coarse < 5 {
        return f64::NAN;
    }
    f64::from(wrong)
}

fn nobody_waits(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    [1, 2]
        .map(|step| longest_wait(gpu, seed, step).saturating_sub(2))
        .into_iter()
        .max()
        .map_or(f64::NAN, f64::from)
}

/// For how many frames on end a lit pixel's block is not traced at most, where the frames' numbers go up by `step`.
fn longest_wait(gpu: &Arc<Gpu>, seed: u64, step: u32) -> u32 {
    let mut waited = vec![0u32; 64 * 48];
    let mut worst = 0;
    drift_by(gpu, &paper(), seed, 24, 0.0, step, |_, slot| {
        let (traced, rates) = (slot.traced().unwrap_or(&[]), slot.rates().unwrap_or(&[]));
        for (i, s) in slot.surfaces().unwrap_or_default().iter().enumerate() {
            if s.id == NO_HIT || s.distance <= 0.0 {
                continue;
            }
            let (x, y) = (i % 64, i / 64);
            let rate = rates[y / 16 * 4 + x / 16];
            let (w, h) = (1usize << (rate & 3), 1usize << (rate >> 2 & 3));
            let (bx, by) = (x / w * w, y / h * h);
            let any = (0..w * h).any(|k| traced[(by + k / w) * 64 + bx + k % w][3] > 0.0);
            waited[i] = if any { 0 } else { waited[i] + 1 };
            worst = worst.max(waited[i]);
        }
    });
    worst
}

fn energy_kept(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let total = |method: &Method, frames: u32, from: u32| {
        let (mut sum, mut n) = (0.0f64, 0u32);
        drift(gpu, method, seed, frames, 0.0, |frame, slot| {
            if frame >= from {
                sum +=
                    slot.radiance().unwrap_or(&[]).iter().map(|r| f64::from(r[0] + r[1] + r[2])).sum::<f64>();
                n += 1;
            }
        });
        sum / f64::from(n)
    };
    let wanted = total(&Method::full(4), 160, 0);
    let mut worst: f64 = 0.0;
    for which in [RenderMethod::Paper, RenderMethod::Miyamoto, RenderMethod::Sequence, RenderMethod::Dpm] {
        let mut method = method_of(&RenderConfig::default(), which);
        method.paper.zone_spp = [8; 3];
        worst = worst.max((total(&method, 112, 64) / wanted - 1.0).abs());
        if !method.dpm {
            // The spatial filter alone, on frames that nothing else has touched.
            (method.temporal, method.rate_map, method.checkerboard, method.spatial) =
                (false, false, false, true);
            worst = worst.max((total(&method, 112, 64) / wanted - 1.0).abs());
        }
    }
    worst
}

fn new_points(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // Of an uneven sky: the budget goes to where the noise is.
    let mut scene = scene_of(sphere(Vec3::ZERO, 0.5, 3, true), diffuse(Vec3::splat(0.7)));
    scene.environment = image_sky(1.0);
    let shot = Shot {
        eye: Some(DVec3::new(0.4, 0.5, 3.0)),
        spp: 1,
        frames: 40,
        seed: seed as u32,
        method: Some(dpm()),
        ..Shot::new(&scene, camera(64, 48, DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO))
    };
    let poses = |frame: u32| vec![DAffine3::from_translation(DVec3::X * (f64::from(frame) * 0.06 - 1.2))];
    let (mut new, mut waits, mut faults) = (0u32, 0u32, 0u32);
    play(gpu, &shot, poses, |_, slot| {
        let (history, traced) = (slot.history().unwrap_or_default(), slot.traced().unwrap_or(&[]));
        let surfaces = slot.surfaces().unwrap_or_default();
        for i in (0..surfaces.len()).filter(|i| surfaces[*i].is_lit()) {
            waits += u32::from(traced[i][3] == 0.0);
            new += u32::from(traced[i][3] > 0.0 && history[i].samples_used() == traced[i][3] as u32);
            faults += u32::from(history[i].samples_used() == 0);
        }
    });
    // Some must be new, and some not be traced in every frame, or nothing is told.
    if new < 200 || waits < 200 {
        return f64::NAN;
    }
    f64::from(faults)
}
