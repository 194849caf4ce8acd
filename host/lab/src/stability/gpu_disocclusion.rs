//! Bodies that jump and turn on the GPU: a surface takes up no history but its own.
//!
//! What is drawn has no noise, so a picture with a past that must not show agrees with one without.

use super::gpu::GpuCase;
use super::gpu_history::{dpm, even, from_one, methods, play};
use super::gpu_shot::Shot;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{History, Renderer, Surface};
use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, Scene};
use glam::{DAffine3, DQuat, DVec3, Vec3};
use std::sync::Arc;

const fn case(name: &'static str, input: &'static str, measure: fn(&Arc<Gpu>, u64) -> f64) -> GpuCase {
    GpuCase(name, input, "a picture without the past", "radiance", 1e-4, measure)
}

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    case(
        "gpu-pose-jump",
        "a glowing plate over a glowing floor that jumps by its width, every method without shading rates",
        pose_jump,
    ),
    case(
        "gpu-uncovered-by-itself",
        "a floor and a box on it, one body with three glows, that jumps and turns, every method without shading rates",
        uncovered_by_itself,
    ),
    case(
        "gpu-stale-history",
        "histories of wrong light that are two frames old, every method",
        stale_history,
    ),
    GpuCase(
        "gpu-eye-looks-again",
        "a plate that glides and jumps between the eye and a floor, out of the projector's light, all frames drawn or every fourth, method dpm",
        "the picture with an eye ray for every pixel in every frame: nothing seen is dark; nothing hidden is lit for more than three frames, and not at all where it glides",
        "frames over 3",
        0.0,
        looks_again,
    ),
    GpuCase(
        "gpu-dark-stays-dark",
        "a ball and a turning plate that glide; a tile that a fast shadow hides wholly; method dpm",
        "the picture of `full`: gliding surfaces are lit there and nowhere else, with less than 0.7 of the rays; nothing seen is dark for more than three frames",
        "frames over 3",
        0.0,
        stays_dark,
    ),
];

fn glow(color: Vec3) -> Material {
    Material { base_color: Vec3::splat(0.5), ..emitter(color) }
}

const BLUE: Vec3 = Vec3::new(0.0, 0.2, 1.0);
const RED: Vec3 = Vec3::new(1.0, 0.1, 0.0);
const GREEN: Vec3 = Vec3::new(0.1, 0.8, 0.1);

/// Every method, each pixel for itself: a block of the paper's shading rates shows one of its pixels, of either surface.
fn without_rates() -> impl Iterator<Item = Method> {
    methods().into_iter().map(|mut method| {
        method.rate_map &= method.dpm;
        method
    })
}

/// The last of so many frames of a shot.
fn last(gpu: &Arc<Gpu>, shot: &Shot<'_>, poses: impl Fn(u32) -> Vec<DAffine3>) -> Vec<[f32; 4]> {
    let mut last = Vec::new();
    play(gpu, shot, poses, |_, slot| last = slot.radiance().unwrap_or(&[]).to_vec());
    last
}

/// Largest difference of two pictures. `NaN`, which no bound holds, when fewer than a hundred pixels of the second show anything.
fn apart(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    if b.iter().filter(|r| r[..3].iter().any(|v| *v > 0.0)).count() < 100 {
        return f64::NAN;
    }
    let off = a.iter().zip(b).flat_map(|(a, b)| (0..3).map(|c| f64::from((a[c] - b[c]).abs())));
    off.fold(0.0, |worst: f64, d| if d.is_nan() { f64::INFINITY } else { worst.max(d) })
}

fn worse(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() {
        f64::NAN
    } else {
        a.max(b)
    }
}

/// Pictures after `poses` jumped from the first to the second in frame 12, against those that were at the second all the time.
fn jump(gpu: &Arc<Gpu>, seed: u64, scene: &Scene, poses: [&[DAffine3]; 2]) -> f64 {
    let mut worst: f64 = 0.0;
    for method in without_rates() {
        // A checkerboard needs two frames to fill a new place.
        for frames in [14, 16] {
            let shot = Shot {
                eye: Some(DVec3::new(-0.4, 5.0, 1.2)),
                gaze: Some(DVec3::ZERO),
                depth: 1,
                frames,
                seed: seed as u32,
                method: Some(method.clone()),
                ..Shot::new(scene, camera(40, 30, DVec3::new(0.0, 5.0, 1.5), DVec3::ZERO))
            };
            let jumped = last(gpu, &shot, |frame| poses[usize::from(frame >= 12)].to_vec());
            let fresh = last(gpu, &shot, |_| poses[1].to_vec());
            worst = worse(worst, apart(&jumped, &fresh));
        }
    }
    worst
}

fn pose_jump(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut scene = Scene::default();
    add(&mut scene, floor(4.0, 0.0), glow(BLUE));
    // In its own coordinates the plate lies in the floor, over the place that it uncovers: only that they are two bodies tells them apart.
    add(&mut scene, quad(Vec3::new(-0.4, 0.0, 0.5), Vec3::X * 0.8, Vec3::NEG_Z), glow(RED));
    scene.environment = Environment::Constant(Vec3::ZERO);
    let at = |x: f64| [DAffine3::IDENTITY, DAffine3::from_translation(DVec3::new(x, 0.3, 0.0))];
    jump(gpu, seed, &scene, [&at(0.0), &at(0.9)])
}

fn uncovered_by_itself(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // The lid covers other floor where it stands aslant from the projector, at its edges two faces meet that face differently.
    let (half, high) = (0.5f32, 0.8f32);
    let corner = |x: f32, z: f32| Vec3::new(x * half, 0.0, z * half);
    let up = Vec3::Y * high;
    let lid = quad(corner(-1.0, 1.0) + up, Vec3::X * 2.0 * half, Vec3::NEG_Z * 2.0 * half);
    let walls =
        [(-1.0, 1.0, Vec3::X), (1.0, 1.0, Vec3::NEG_Z), (1.0, -1.0, Vec3::NEG_X), (-1.0, -1.0, Vec3::Z)]
            .map(|(x, z, along)| quad(corner(x, z), along * 2.0 * half, up));
    let mut scene = scene_of(join([floor(6.0, 0.0), lid].into_iter().chain(walls)), glow(BLUE));
    scene.materials.extend([glow(RED), glow(GREEN)]);
    // Two triangles a face.
    scene.bodies[0].mesh.materials = [&[0u32; 2][..], &[1; 2], &[2; 8]].concat();
    scene.environment = Environment::Constant(Vec3::ZERO);
    let at = |x: f64, turn: f64| {
        [DAffine3::from_rotation_translation(DQuat::from_rotation_y(turn), DVec3::new(x, 0.0, 0.0))]
    };
    jump(gpu, seed, &scene, [&at(-0.7, 0.0), &at(0.6, 0.4)])
}

fn stale_history(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // Tiles that no body touches keep what was in them. Nothing reaches it as tiles are listed today, so it is put where it would be met.
    let scene = even();
    let mut worst: f64 = 0.0;
    for method in methods() {
        let shot = Shot {
            eye: Some(DVec3::new(-0.5, 3.2, 0.8)),
            spp: 2,
            seed: seed as u32,
            method: Some(method),
            ..Shot::new(&scene, camera(33, 33, DVec3::new(0.3, 3.0, 1.0), DVec3::ZERO))
        };
        let mut renderer = Renderer::new(gpu, &scene, shot.settings()).expect("the scene fits the GPU");
        let poses = shot.world_from_body();
        shot.play(&mut renderer, 0..6, |_| poses.clone(), |_, _, _| ());
        let old = |h: &mut History| {
            h.light.mean = [5.0; 3];
            h.tag.frame = h.tag.frame.wrapping_sub(2);
        };
        renderer.edit_history(0..33 * 33, old).expect("memory");
        shot.play(
            &mut renderer,
            6..10,
            |_| poses.clone(),
            |_, slot, _| {
                let off = from_one(slot);
                worst = worse(worst, if off < 0.0 { f64::NAN } else { off });
            },
        );
    }
    worst
}

fn looks_again(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut scene = even();
    add(&mut scene, quad(Vec3::new(-0.1, -0.1, 0.0), Vec3::X * 0.2, Vec3::Y * 0.2), glow(RED));
    let eye = DVec3::new(0.0, 1.2, 3.0);
    // Its shadow is three times as large and as fast: a pixel a frame, and at once elsewhere in every twelfth.
    let poses = |frame: u32| {
        let x = f64::from(frame % 12) * 0.01 + if (frame / 12).is_multiple_of(2) { -0.2 } else { 0.1 };
        vec![DAffine3::IDENTITY, DAffine3::from_translation(DVec3::new(x, 0.8, 2.0))]
    };
    let scene_shot = Shot {
        eye: Some(eye),
        frames: 48,
        seed: seed as u32,
        ..Shot::new(&scene, camera(48, 36, DVec3::new(0.0, 3.0, 0.3), DVec3::ZERO))
    };
    // Blocks ask in turns of four frames, whatever the numbers of those that are drawn.
    let of = |step: u32| looks_again_by(gpu, &Shot { step, ..scene_shot.clone() }, poses);
    worse(of(1), of(4))
}

fn looks_again_by(gpu: &Arc<Gpu>, shot: &Shot<'_>, poses: impl Fn(u32) -> Vec<DAffine3>) -> f64 {
    let (wanted, found) = sights(gpu, shot, poses);
    if wanted.hidden < 1000 {
        return f64::NAN;
    }
    // Four frames after a jump the shadow only glides: its borders are known, and nothing waits there.
    let glides = |frame: usize| frame % 12 >= 5;
    let [dark, _] = longest(&wanted, &found, |_, seen, shown| seen && !shown);
    let [bright, _] = longest(&wanted, &found, |frame, seen, shown| glides(frame) && shown && !seen);
    let [late, _] = longest(&wanted, &found, |_, seen, shown| shown && !seen);
    if dark > 0 || bright > 0 {
        return f64::INFINITY;
    }
    f64::from(late.saturating_sub(3))
}

/// What was lit in every frame.
#[derive(Default)]
struct Sights {
    lit: Vec<Vec<bool>>,
    /// Pixels that the eye does not see, and rays, over all frames.
    hidden: usize,
    rays: u32,
}

/// Of a shot with depth 1: by method full, which asks for every pixel in every frame, and by method dpm.
fn sights(gpu: &Arc<Gpu>, shot: &Shot<'_>, poses: impl Fn(u32) -> Vec<DAffine3>) -> (Sights, Sights) {
    let of = |method: Method| {
        let shot = Shot { spp: 1, depth: 1, method: Some(method), ..shot.clone() };
        let mut renderer = Renderer::new(gpu, shot.scene, shot.settings()).expect("the scene fits the GPU");
        let mut sights = Sights::default();
        shot.play(&mut renderer, 0..shot.frames, &poses, |_, slot, counters| {
            let surfaces = slot.surfaces().unwrap_or_default();
            sights.lit.push(surfaces.iter().map(Surface::is_lit).collect());
            sights.hidden += surfaces.iter().filter(|s| s.distance < 0.0).count();
            sights.rays += counters.rays;
        });
        sights
    };
    (of(Method::full(1)), of(dpm()))
}

/// For how many frames on end, at most, a pixel was at fault, and how many were in all. The fault is told by the frame's place in the sequence,
/// whether the pixel was lit by the first, and whether by the second.
fn longest(wanted: &Sights, found: &Sights, fault: impl Fn(usize, bool, bool) -> bool) -> [u32; 2] {
    let (mut on_end, mut most, mut all) = (vec![0u32; wanted.lit[0].len()], 0, 0);
    for (frame, (wanted, found)) in wanted.lit.iter().zip(&found.lit).enumerate() {
        for ((seen, shown), on_end) in wanted.iter().zip(found).zip(&mut on_end) {
            *on_end = if fault(frame, *seen, *shown) { *on_end + 1 } else { 0 };
            most = most.max(*on_end);
            all += u32::from(*on_end > 0);
        }
    }
    [most, all]
}

fn stays_dark(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // Side light: half of the ball is dark for the eye. Less than a pixel a frame, over tiles and over the picture's border.
    let mut scene = scene_of(sphere(Vec3::ZERO, 0.3, 3, true), glow(BLUE));
    add(&mut scene, quad(Vec3::new(-0.3, -0.05, 0.0), Vec3::X * 0.6, Vec3::Y * 0.1), glow(RED));
    scene.environment = Environment::Constant(Vec3::ZERO);
    let glides = |frame: u32| {
        let way = f64::from(frame) * 0.02;
        let turn = DQuat::from_rotation_z(f64::from(frame) * 0.06);
        vec![
            DAffine3::from_translation(DVec3::new(1.2 - way, 0.2, 0.0)),
            DAffine3::from_rotation_translation(turn, DVec3::new(0.5 * way - 0.6, -0.3, 0.2)),
        ]
    };
    let shot = Shot {
        eye: Some(DVec3::new(2.0, 0.5, 2.0)),
        frames: 96,
        seed: seed as u32,
        ..Shot::new(&scene, camera(64, 48, DVec3::Z * 3.0, DVec3::ZERO))
    };
    let (wanted, found) = sights(gpu, &shot, glides);
    let lit: usize = wanted.lit.iter().flatten().filter(|lit| **lit).count();
    if lit < 10_000 || wanted.hidden < 1000 || f64::from(found.rays) > 0.7 * f64::from(wanted.rays) {
        return f64::NAN;
    }
    if wanted.lit != found.lit {
        return f64::INFINITY;
    }
    // All that is lit goes into a shadow of 3.6 pixels a frame, by a plate of 1.4, and comes out again.
    let tile = quad(Vec3::new(-0.15, 0.0, 0.15), Vec3::X * 0.3, Vec3::NEG_Z * 0.3);
    let mut scene = scene_of(tile, glow(BLUE));
    add(&mut scene, quad(Vec3::new(-0.1, -0.1, 0.0), Vec3::X * 0.2, Vec3::Y * 0.2), glow(RED));
    scene.environment = Environment::Constant(Vec3::ZERO);
    let swings = |frame: u32| {
        let x = 0.035 * (f64::from((frame + 12) % 24) - 12.0).abs() - 0.21;
        vec![DAffine3::IDENTITY, DAffine3::from_translation(DVec3::new(x, 0.8, 2.0))]
    };
    let shot = Shot {
        eye: Some(DVec3::new(0.0, 1.2, 3.0)),
        frames: 72,
        seed: seed as u32,
        ..Shot::new(&scene, camera(48, 36, DVec3::new(0.0, 3.0, 0.3), DVec3::ZERO))
    };
    let (wanted, found) = sights(gpu, &shot, swings);
    let [late, of] = longest(&wanted, &found, |_, seen, shown| seen && !shown);
    let all_hidden = wanted.lit.iter().any(|lit| !lit.contains(&true));
    if !all_hidden || of == 0 {
        return f64::NAN;
    }
    f64::from(late.saturating_sub(3))
}
