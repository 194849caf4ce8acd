//! Method dpm's histories on bodies that move: how short, how long and how steady they are, and how well what comes into view begins.

use super::estimate::Estimate;
use super::gpu::GpuCase;
use super::gpu_history::{dpm, play, play_at_rest};
use super::gpu_shot::Shot;
use crate::snapshot::views::albedo_of;
use dpm_render::gpu::Gpu;
use dpm_render::method::{Method, SamplerKind};
use dpm_render::{FrameSlot, Surface};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, Scene};
use glam::{DAffine3, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-short-histories-stay-bounded",
        "the demo's hare that crosses and bust that turns, one sample requested, histories of two frames, method dpm",
        "nothing shown is brighter than 3 times the brightest traced value: means of at most twice that value, shifted by at most half",
        "ratio",
        3.0,
        short_histories,
    ),
    GpuCase(
        "gpu-light-lost-below-the-surface",
        "a matte icosahedron with a sphere's normals under an even sky, method dpm",
        "closed form: the guide's albedo and the light are b (1 + n g) / 2, so the history holds the sky alone",
        "relative",
        3e-3,
        light_lost,
    ),
    GpuCase(
        "gpu-good-start",
        "a plate that glides in over the picture's border, one that comes nearer, four samples requested, method dpm",
        "a point that begins at the border takes twice the samples of one that begins inside and 5 times those of an old one; the budget holds to 1 %",
        "ratio",
        1.0,
        good_start,
    ),
    GpuCase(
        "gpu-lag-shortens-histories",
        "a metal ball that turns in place under an uneven sky, or stands, method dpm",
        "the picture does not change: mean error at most twice that at rest and 3 %; histories below 20 frames, at rest above 80",
        "ratio",
        1.0,
        lag_shortens,
    ),
    GpuCase(
        "gpu-crisp-light-stays-crisp",
        "a faceted metal ball that glides by a tenth of a pixel a frame under an uneven sky, or stands, method dpm",
        "path tracing of the same 31 frames: their mean is off by at most 6 %; histories at rest of more than 40 frames",
        "ratio",
        1.0,
        crisp_light,
    ),
    GpuCase(
        "gpu-slivers-keep-histories",
        "bars half a pixel wide that lean and glide in a circle by a third of a pixel a frame under an uneven sky, method dpm",
        "a pixel that a bar leaves and enters again keeps what it knew: histories are at least a quarter as long as those of a plate that glides so",
        "ratio",
        1.0,
        slivers_keep_histories,
    ),
    GpuCase(
        "gpu-mean-in-motion",
        "the demo's hare at 1 m/s and its turning bust through a window as dense as the full raster, two samples requested, method dpm",
        "path tracing: mean of the picture; less than a hundredth, which is hardly seen",
        "relative",
        0.005,
        mean_in_motion,
    ),
    GpuCase(
        "gpu-mean-in-motion-matte",
        "a matte faceted ball that glides at 1 m/s and turns by 540 deg/s where a sun grazes it, seen and drawn in the same way",
        "path tracing: mean of the picture; a hundredth is hardly seen",
        "relative",
        0.01,
        matte_in_the_sun,
    ),
    GpuCase(
        "gpu-mean-in-motion-metal",
        "the same ball of rough metal",
        "path tracing: mean of the picture; a hundredth is hardly seen",
        "relative",
        0.01,
        metal_in_the_sun,
    ),
    GpuCase(
        "gpu-lamp-comes-near",
        "a ball of light over a floor that drops by half of its height in one step, method dpm",
        "closed form r^2 L cos / d^2: mean of the picture within 10 % after 32 frames and within 5 % after 56, pixels within 20 %",
        "ratio",
        1.0,
        lamp_comes_near,
    ),
];

/// A window of 64 x 48 pixels as dense as a raster of 1024 over 30 degrees, where a body at 1 m/s and a metre away moves by two pixels a frame.
fn dense_window(eye: DVec3, aim: DVec3) -> ProjectorCamera {
    let mut camera = camera(64, 48, eye, aim);
    let focal = 512.0 / 15f64.to_radians().tan();
    (camera.fx, camera.fy) = (focal, focal);
    camera
}

/// Mean of what method dpm shows of a body in a dense window, less that of path tracing by it, over the last 60 of 100 frames: lag, and
/// whatever else histories and filters get wrong alike everywhere. Not a number where the body hardly shows.
fn mean_shift(gpu: &Arc<Gpu>, shot: &Shot<'_>, body: u32, poses: &dyn Fn(u32) -> Vec<DAffine3>) -> f64 {
    let mean = |spp: u32, method: Method| {
        let shot = Shot { spp, method: Some(method), ..shot.clone() };
        let (mut sum, mut n) = (0f64, 0f64);
        play(gpu, &shot, poses, |frame, slot| {
            let (shown, surfaces) = (slot.radiance().unwrap_or(&[]), slot.surfaces().unwrap_or_default());
            for (i, _) in lit(slot).filter(|(i, _)| frame >= 40 && surfaces[*i].id >> 24 == body) {
                sum += (0..3).map(|c| f64::from(shown[i][c])).sum::<f64>();
                n += 1.0;
            }
        });
        if n < 60.0 * 1000.0 {
            f64::NAN
        } else {
            sum / n
        }
    };
    let truth = mean(16, Method { sampler: SamplerKind::PixelSequence, ..Method::full(16) });
    mean(2, dpm()) / truth - 1.0
}

/// Nothing drawn yet of a scene that a dense window shows about `aim`.
fn through_window(scene: &Scene, aim: DVec3, eye: DVec3, seed: u64) -> Shot<'_> {
    Shot {
        eye: Some(eye),
        gaze: Some(aim),
        frames: 100,
        depth: 3,
        seed: seed as u32,
        ..Shot::new(scene, dense_window(DVec3::new(0.0, 0.1, 1.0), aim))
    }
}

/// To and fro by 2 cm, at 1 m/s at most.
fn to_and_fro(frame: u32) -> DVec3 {
    DVec3::X * 0.02 * (f64::from(frame) / 947.0 / 0.02).sin()
}

/// Half a turn a second.
fn slow_turn(frame: u32) -> DAffine3 {
    DAffine3::from_rotation_y(f64::from(frame) * std::f64::consts::PI / 947.0)
}

/// Where the observer of the dense windows is.
const BESIDE_THE_PROJECTOR: DVec3 = DVec3::new(0.1, 0.2, 1.0);

fn mean_in_motion(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = dpm_scene::builtin();
    let mut worst = 0f64;
    for (body, aim) in [(0, DVec3::new(-0.10, -0.02, 0.05)), (1, DVec3::new(0.13, 0.06, -0.1))] {
        let shot = through_window(&scene, aim, BESIDE_THE_PROJECTOR, seed);
        let rest = shot.world_from_body();
        let shift = mean_shift(gpu, &shot, body, &|frame| {
            let mut poses = rest.clone();
            poses[0].translation += to_and_fro(frame);
            poses[1] *= slow_turn(frame);
            poses
        });
        worst = if shift.is_nan() { f64::INFINITY } else { worst.max(shift.abs()) };
    }
    worst
}

/// A finely faceted ball that glides and turns under a sun: light that differs from facet to facet and changes as they turn.
fn ball_in_the_sun(gpu: &Arc<Gpu>, seed: u64, metallic: f32, roughness: f32) -> f64 {
    let look = Material { metallic, roughness, ior: 1.5, ..diffuse(Vec3::new(0.7, 0.6, 0.5)) };
    let mut scene = scene_of(sphere(Vec3::ZERO, 0.1, 4, false), look);
    scene.environment = sun_sky();
    let shot = through_window(&scene, DVec3::new(-0.03, 0.02, 0.09), BESIDE_THE_PROJECTOR, seed);
    // One and a half turns a second.
    let poses = |frame| vec![DAffine3::from_translation(to_and_fro(frame)) * slow_turn(3 * frame)];
    mean_shift(gpu, &shot, 0, &poses).abs()
}

fn matte_in_the_sun(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    ball_in_the_sun(gpu, seed, 0.0, 1.0)
}

fn metal_in_the_sun(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    ball_in_the_sun(gpu, seed, 1.0, 0.35)
}

/// A dim even sky with a small bright sun on the right, which gives a surface that faces it ten times as much light. What the projector
/// sees of the ball lies where the sun grazes it, so that its light changes as fast as it can.
fn sun_sky() -> Environment {
    let (width, height) = (64, 32);
    let sun = |i: u32| (i % width, i / width) == (52, 8);
    let texels =
        (0..width * height).map(|i| if sun(i) { Vec3::splat(3000.0) } else { Vec3::splat(0.5) }).collect();
    Environment::Equirect { width, height, texels, rotation_rad: 0.0 }
}

fn short_histories(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = dpm_scene::builtin();
    let mut camera = camera(80, 60, DVec3::new(0.0, 0.1, 1.0), DVec3::new(0.0, 0.03, -0.05));
    let focal = 40.0 / 15f64.to_radians().tan();
    (camera.fx, camera.fy) = (focal, focal);
    let shot = Shot {
        eye: Some(DVec3::new(0.1, 0.2, 1.0)),
        spp: 1,
        frames: 245,
        depth: 2,
        seed: seed as u32,
        method: Some(Method { history_cap: 2.0, ..dpm() }),
        ..Shot::new(&scene, camera)
    };
    let rest = shot.world_from_body();
    // At the demo's rates: as parts of the bust turn away, surface points close up in few pixels, whose light is carried over each other.
    let poses = |frame: u32| {
        let t = f64::from(frame);
        let mut poses = rest.clone();
        poses[0].translation += DVec3::X * 0.13 * (0.0077 * t).sin();
        poses[1] *= DAffine3::from_rotation_y(t * std::f64::consts::PI / 947.0);
        poses
    };
    let (mut shown, mut traced) = (0f32, 0f32);
    play(gpu, &shot, poses, |_, slot| {
        let brightest = |values: Option<&[[f32; 4]]>, least: f32| {
            let all = values.unwrap_or(&[]).iter().flat_map(|v| &v[..3]);
            all.fold(least, |a, v| if v.is_nan() { f32::INFINITY } else { a.max(*v) })
        };
        shown = brightest(slot.radiance(), shown);
        traced = brightest(slot.traced(), traced);
    });
    f64::from(shown / traced)
}

/// The surface point that a pixel's ray meets, world space.
fn point_of(shot: &Shot<'_>, pixel: usize, distance: f32) -> DVec3 {
    let width = shot.camera.raster.width() as usize;
    let ray = shot.camera.ray(DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5));
    ray.origin + ray.direction * f64::from(distance)
}

/// Lit pixels: index and distance.
fn lit(slot: &FrameSlot) -> impl Iterator<Item = (usize, f32)> {
    let surfaces = slot.surfaces().unwrap_or_default().into_iter().enumerate();
    surfaces.filter(|(_, s)| s.is_lit()).map(|(i, s)| (i, s.distance))
}

fn light_lost(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // At a point p of a face the normals of the sphere around lie along p, so that n g = inradius / |p|.
    let (base, light) = (Vec3::new(0.9, 0.6, 0.3), 1.5);
    let inradius = ((5.0 + 2.0 * 5f64.sqrt()) / 15.0).sqrt();
    let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, 0, true), diffuse(base));
    scene.environment = sky(light);
    let eye = DVec3::new(0.5, 0.4, 5.0);
    let shot = Shot {
        eye: Some(eye),
        spp: 4,
        frames: 160,
        depth: 2,
        seed: seed as u32,
        method: Some(dpm()),
        ..Shot::new(&scene, camera(32, 24, DVec3::Z * 5.0, DVec3::ZERO))
    };
    let (mut worst, mut lost_most) = (0f64, 0f64);
    // Of the light by its closed form: samples of all frames, and what the histories hold at the end.
    let (mut traced, mut samples, mut held, mut pixels) = (0f64, 0f64, 0f64, 0f64);
    play_at_rest(gpu, &shot, |frame, slot| {
        let (guides, history) = (slot.guides().unwrap_or_default(), slot.history().unwrap_or_default());
        for (i, distance) in lit(slot) {
            let p = point_of(&shot, i, distance);
            // Where the shading normal leans away from the eye it is bent.
            if p.normalize().dot((eye - p).normalize()) < 0.01 {
                continue;
            }
            let above = 0.5 + 0.5 * inradius / p.length();
            lost_most = lost_most.max(1.0 - above);
            let exact = |c: usize| f64::from(base[c]) * above;
            let albedo = albedo_of(&guides[i]);
            worst = (0..3).map(|c| (f64::from(albedo[c]) / exact(c) - 1.0).abs()).fold(worst, f64::max);
            let of = slot.traced().unwrap_or(&[])[i];
            traced += f64::from(of[3]) * f64::from(of[1]) / (exact(1) * f64::from(light));
            samples += f64::from(of[3]);
            if frame + 1 == shot.frames {
                held += f64::from(history[i].light.mean[1] / light);
                pixels += 1.0;
            }
        }
    });
    if pixels < 200.0 || lost_most < 0.08 {
        return f64::NAN;
    }
    worst.max((traced / samples - 1.0).abs()).max((held / pixels - 1.0).abs())
}

/// Samples of some pixels and how many these are.
#[derive(Default)]
struct Share {
    samples: f64,
    pixels: f64,
}

impl Share {
    fn add(&mut self, samples: f64) {
        self.samples += samples;
        self.pixels += 1.0;
    }

    fn mean(&self) -> f64 {
        self.samples / self.pixels
    }
}

fn good_start(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let plate = |x: f32| quad(Vec3::new(x, -0.5, 0.0), Vec3::X * 1.6, Vec3::Y);
    let mut scene = scene_of(plate(-2.0), diffuse(Vec3::splat(0.8)));
    add(&mut scene, plate(0.3), diffuse(Vec3::splat(0.8)));
    scene.environment = image_sky(1.0);
    let shot = Shot {
        eye: Some(DVec3::new(0.1, 0.1, 3.0)),
        gaze: Some(DVec3::ZERO),
        spp: 4,
        frames: 120,
        depth: 2,
        seed: seed as u32,
        method: Some(dpm()),
        ..Shot::new(&scene, camera(64, 48, DVec3::Z * 3.0, DVec3::ZERO))
    };
    // By a third of a pixel a frame; a third larger in the end.
    let poses = |frame: u32| {
        let t = f64::from(frame);
        [DVec3::X * (0.009 * t), DVec3::Z * (0.006 * t)].map(DAffine3::from_translation).to_vec()
    };
    let (mut border, mut inside, mut old, mut all) =
        (Share::default(), Share::default(), Share::default(), Share::default());
    let mut before: Vec<Option<u32>> = Vec::new();
    play(gpu, &shot, poses, |frame, slot| {
        let (history, traced) = (slot.history().unwrap_or_default(), slot.traced().unwrap_or(&[]));
        let body = |s: &Surface| s.is_lit().then_some(s.id >> 24);
        let bodies: Vec<_> = slot.surfaces().unwrap_or_default().iter().map(body).collect();
        for (i, _) in lit(slot).filter(|_| frame >= 60) {
            let samples = f64::from(traced[i][3]);
            all.add(samples);
            let (x, y) = (i % 64, i / 64);
            let within =
                |margin: usize| (margin..64 - margin).contains(&x) && (margin..48 - margin).contains(&y);
            // The body filled all around in the last frame.
            let known =
                within(2) && (0..25).all(|k| before[(y + k / 5 - 2) * 64 + x + k % 5 - 2] == bodies[i]);
            let begins = history[i].samples_used() == traced[i][3] as u32;
            match (begins, known) {
                (true, true) => inside.add(samples),
                (true, false) if x == 0 => border.add(samples),
                (false, true) if f64::from(history[i].light.weight) >= 60.0 * 4.0 => old.add(samples),
                _ => {}
            }
        }
        before = bodies;
    });
    if [&border, &inside, &old].iter().any(|s| s.pixels < 100.0) {
        return f64::NAN;
    }
    let off_budget = (all.mean() / 4.0 - 1.0).abs() / 0.01;
    (2.0 * inside.mean() / border.mean()).max(5.0 * old.mean() / border.mean()).max(off_budget)
}

/// By pixel of 32 x 24, the mean of what is shown while it is lit from frame `from` on; and how many frames long the histories are, at four
/// samples a frame.
fn watched(
    gpu: &Arc<Gpu>,
    shot: &Shot<'_>,
    from: u32,
    pose: impl Fn(u32) -> DAffine3,
) -> (Vec<Estimate>, f64) {
    let mut means = vec![Estimate::default(); 32 * 24];
    let mut length = Share::default();
    play(
        gpu,
        shot,
        |frame| vec![pose(frame)],
        |frame, slot| {
            let (shown, history) = (slot.radiance().unwrap_or(&[]), slot.history().unwrap_or_default());
            for (i, _) in lit(slot).filter(|_| frame >= from) {
                means[i].add([0, 1, 2].map(|c| f64::from(shown[i][c])));
                length.add(history.get(i).map_or(0.0, |h| f64::from(h.light.weight / 4.0)));
            }
        },
    );
    (means, length.mean())
}

/// A metal ball under an uneven sky, seen for `frames` frames: what histories of method dpm lag behind, or blur.
fn ball(scene: &Scene, seed: u64, frames: u32) -> Shot<'_> {
    Shot {
        eye: Some(DVec3::new(0.4, 0.3, 3.0)),
        gaze: Some(DVec3::ZERO),
        spp: 4,
        depth: 2,
        seed: seed as u32,
        frames,
        method: Some(dpm()),
        ..Shot::new(scene, camera(32, 24, DVec3::Z * 3.0, DVec3::ZERO))
    }
}

fn metal_ball(roughness: f32, level: u32, smooth: bool) -> Scene {
    let metal = Material { metallic: 1.0, roughness, ..diffuse(Vec3::splat(0.8)) };
    let mut scene = scene_of(sphere(Vec3::ZERO, 0.6, level, smooth), metal);
    scene.environment = image_sky(1.0);
    scene
}

fn lag_shortens(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = metal_ball(0.5, 4, true);
    let shot = ball(&scene, seed, 250);
    let turning = |rate: f64| move |frame: u32| DAffine3::from_rotation_y(rate * f64::from(frame));
    let many = Shot { spp: 64, frames: 48, method: None, seed: !shot.seed, ..shot.clone() };
    let (truth, _) = watched(gpu, &many, 0, turning(0.0));
    // Share of the light by which the mean of the last 100 frames is off, less what the truth's own noise adds; and the histories' length.
    let off_by = |rate: f64| {
        let (means, length) = watched(gpu, &shot, shot.frames - 100, turning(rate));
        let (mut off, mut power) = (0f64, 0f64);
        // Whatever is lit most of the time; the outline's pixels come and go.
        for (m, t) in means.iter().zip(&truth).filter(|(m, t)| m.count > 50.0 && t.count > 40.0) {
            off += (m.mean[1] - t.mean[1]).powi(2) - t.variance(1);
            power += t.mean[1].powi(2);
        }
        // Without any pixel nothing is known.
        (if power > 0.0 { (off.max(0.0) / power).sqrt() } else { f64::INFINITY }, length)
    };
    let ((still, long), (turning, short)) = (off_by(0.0), off_by(0.02));
    if !still.is_finite() {
        return f64::NAN;
    }
    (turning / (2.0 * still + 0.03)).max(short / 20.0).max(80.0 / long)
}

fn crisp_light(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // Each facet, a pixel or two large, mirrors another part of the sky; neighbours' normals are alike enough to share histories.
    let scene = metal_ball(0.15, 3, false);
    let shot = ball(&scene, seed, 110);
    // What the eye takes for one picture: the last 31 frames, which truth sees alone. 17.5 pixels a metre.
    let from = shot.frames - 31;
    let along = DVec3::new(0.8, 0.6, 0.0) * (0.1 / 17.5);
    let gliding = |first: u32, rate: f64| {
        move |frame: u32| {
            DAffine3::from_translation(along * rate * (f64::from(first + frame) - f64::from(from)))
        }
    };
    let many = Shot { spp: 32, frames: 31, method: None, seed: !shot.seed, ..shot.clone() };
    let (truth, _) = watched(gpu, &many, 0, gliding(from, 1.0));
    let (means, _) = watched(gpu, &shot, from, gliding(0, 1.0));
    let (_, still) = watched(gpu, &shot, from, gliding(0, 0.0));
    let (mut off, mut power, mut pixels) = (0f64, 0f64, 0);
    // Whatever is lit in all of these frames.
    for (m, t) in means.iter().zip(&truth).filter(|(m, t)| m.count == 31.0 && t.count == 31.0) {
        off += (m.mean[1] - t.mean[1]).powi(2);
        power += t.mean[1].powi(2);
        pixels += 1;
    }
    if pixels < 200 || off.is_nan() || still.is_nan() {
        return f64::NAN;
    }
    ((off / power).sqrt() / 0.06).max(40.0 / still)
}

fn slivers_keep_histories(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let pixel = 1.0 / 17.5;
    // Of three rows that follow each other at least one meets a bar, so that there is always something lit beside.
    let up = Vec3::new(8.0, 24.0, 0.0) * pixel;
    let bar = |x: f32, width: f32| quad((Vec3::X * x * pixel) - up / 2.0, Vec3::X * width * pixel, up);
    let bars = join((-4..=4).map(|i| bar(4.0 * i as f32, 0.5)));
    let plate = bar(-12.0, 24.0);
    let length = |mesh| {
        let mut scene = scene_of(mesh, diffuse(Vec3::splat(0.8)));
        scene.environment = image_sky(1.0);
        let circle = |frame: u32| {
            let angle = f64::from(frame) / 6.0;
            DAffine3::from_translation(DVec3::new(angle.cos(), angle.sin(), 0.0) * 2.0 * f64::from(pixel))
        };
        watched(gpu, &ball(&scene, seed, 110), 60, circle).1
    };
    let (wide, narrow) = (length(plate), length(bars));
    if wide.is_nan() || narrow.is_nan() {
        return f64::NAN;
    }
    0.25 * wide / narrow
}

fn lamp_comes_near(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let (radius, albedo, light) = (0.3f32, 0.5f32, 8.0f32);
    let mut scene = scene_of(floor(4.0, 0.0), diffuse(Vec3::splat(albedo)));
    add(&mut scene, sphere(Vec3::ZERO, radius, 4, true), emitter(Vec3::splat(light)));
    scene.bodies[1].projected = false;
    scene.environment = Environment::Constant(Vec3::ZERO);
    let step = 120;
    let shot = Shot {
        eye: Some(DVec3::new(0.3, 1.5, 3.0)),
        gaze: Some(DVec3::ZERO),
        spp: 4,
        depth: 2,
        frames: step + 64,
        seed: seed as u32,
        method: Some(dpm()),
        ..Shot::new(&scene, camera(24, 18, DVec3::new(0.0, 1.5, 3.0), DVec3::ZERO))
    };
    let height = |frame: u32| DVec3::Y * if frame < step { 3.0 } else { 1.5 };
    let poses = |frame: u32| vec![DAffine3::IDENTITY, DAffine3::from_translation(height(frame))];
    let mut worst = 0f64;
    play(gpu, &shot, poses, |frame, slot| {
        let (mut off, mut power, mut n) = (0f64, 0f64, 0f64);
        for (i, distance) in lit(slot) {
            let to = height(frame) - point_of(&shot, i, distance);
            // Of a ball wholly above the horizon.
            let exact = f64::from(albedo * light * radius * radius) / to.length_squared() * to.normalize().y;
            let r = f64::from(slot.radiance().unwrap_or(&[])[i][1]) / exact - 1.0;
            (off, power, n) = (off + r, power + r * r, n + 1.0);
        }
        let (mean, pixel) = ((off / n).abs(), (power / n).sqrt());
        worst = match frame {
            f if n < 400.0 || mean.is_nan() || (f + 1 == step && mean > 0.02) => f64::INFINITY,
            f if f >= step + 56 => worst.max(mean / 0.05).max(pixel / 0.2),
            f if f >= step + 32 => worst.max(mean / 0.1),
            _ => worst,
        };
    });
    worst
}
