//! Every sampler on the GPU into two laws: what it makes of the light on average, and how fast its noise falls.
//!
//! A wrong sampler gives itself away by one of them: it favours some light (another mean), or repeats itself (noise that more samples or more
//! frames do not take away). That the mean itself is right is judged against the f64 tracer, by cases of independent samples.

use super::gpu::GpuCase;
use super::gpu_history::{dpm, play_at_rest};
use super::gpu_shot::Shot;
use super::gpu_tracer::still_life;
use dpm_render::gpu::Gpu;
use dpm_render::method::{Method, SamplerKind};
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use glam::{DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-noise-falls",
        "independent samples, blue noise and continued sequences, of surface points and of pixels: 1 and 16 samples a frame, 1 and 64 frames",
        "closed form: noise falls with the square root of their number; for independent samples neither faster nor slower",
        "ratio",
        1.15,
        noise_falls,
    ),
    GpuCase(
        "gpu-samplers-agree",
        "the same in 64 frames of 4 samples: means of pixels and of the picture",
        "independent samples: the difference relative to chance",
        "ratio",
        1.0,
        samplers_agree,
    ),
];

/// Methods that trace every pixel alike, and whether their samples are independent of each other.
fn samplers() -> [(Method, bool); 4] {
    let sequences = Method { rate_map: false, ..dpm() };
    [
        (Method::full(1), true),
        (Method { sampler: SamplerKind::BlueNoise, ..Method::full(1) }, false),
        (sequences, false),
        (Method { sampler: SamplerKind::PixelSequence, ..Method::full(1) }, false),
    ]
}

fn scene() -> Scene {
    let mut scene = still_life(1.0);
    scene.environment = image_sky(0.3);
    let ball = sphere(Vec3::new(0.75, 0.2, 0.4), 0.2, 2, true);
    add(&mut scene, ball, Material { metallic: 1.0, roughness: 0.3, ..diffuse(Vec3::new(0.9, 0.7, 0.4)) });
    scene
}

/// Radiance of the lit pixels, three channels each.
type Light = Vec<f64>;

/// What was traced in every frame, without any history or filter.
fn traced(gpu: &Arc<Gpu>, scene: &Scene, method: &Method, spp: u32, frames: u32, seed: u64) -> Vec<Light> {
    let shot = Shot {
        eye: Some(DVec3::new(-0.7, 1.4, 2.1)),
        gaze: Some(DVec3::ZERO),
        spp,
        frames,
        // Light that a surface gets at once: light by way of a mirror is so rare and bright that a few samples make all the noise.
        depth: 2,
        seed: seed as u32,
        method: Some(method.clone()),
        ..Shot::new(scene, camera(32, 24, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO))
    };
    let mut all = Vec::new();
    play_at_rest(gpu, &shot, |_, slot| {
        let (traced, surfaces) = (slot.traced().unwrap_or(&[]), slot.surfaces().unwrap_or_default());
        let lit = traced.iter().zip(surfaces).filter(|(_, s)| s.is_lit());
        all.push(lit.flat_map(|(r, _)| r[..3].iter().map(|v| f64::from(*v))).collect());
    });
    all
}

fn mean(frames: &[Light]) -> Light {
    let mut sum = vec![0.0; frames.first().map_or(0, Vec::len)];
    frames.iter().for_each(|f| sum.iter_mut().zip(f).for_each(|(s, v)| *s += v / frames.len() as f64));
    sum
}

/// Variance of a frame at every value, from two runs that share nothing.
fn variance([a, b]: &[Vec<Light>; 2]) -> Light {
    let squares = |(a, b): (&Light, &Light)| a.iter().zip(b).map(|(a, b)| 0.5 * (a - b) * (a - b)).collect();
    mean(&a.iter().zip(b).map(squares).collect::<Vec<Light>>())
}

/// Root of the mean of squares by what is expected of each, where something is: no few bright values outweigh the others.
fn against(squares: &[f64], expected: &[f64]) -> f64 {
    let ratios = squares.iter().zip(expected).filter(|(_, e)| **e > 0.0).map(|(s, e)| s / e);
    let (sum, n) = ratios.fold((0.0, 0u32), |(sum, n), r| (sum + r, n + 1));
    (sum / f64::from(n)).sqrt()
}

fn noise_falls(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = scene();
    let mut worst: f64 = 0.0;
    for (method, independent) in samplers() {
        let run = |spp, frames, k| traced(gpu, &scene, &method, spp, frames, seed.wrapping_add(k));
        let (few, many) = ([1, 2].map(|k| run(1, 64, k)), [3, 4].map(|k| run(16, 64, k)));
        let one = variance(&few);
        let after_64 = variance(&[vec![mean(&few[0])], vec![mean(&few[1])]]);
        let by_frames = against(&after_64, &one) * 8.0;
        let by_samples = against(&variance(&many), &one) * 4.0;
        for ratio in [by_frames, by_samples] {
            let off = if independent { ratio.max(1.0 / ratio) } else { ratio };
            if !off.is_finite() {
                return f64::NAN;
            }
            worst = worst.max(off);
        }
    }
    worst
}

fn samplers_agree(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = scene();
    let [independent, others @ ..] = samplers();
    // Mean of two runs of 64 frames, and its variance if the frames are independent: a sequence that goes on has less.
    let runs = |method: &Method, at: u64| {
        let runs = [at, at + 1].map(|k| traced(gpu, &scene, method, 4, 64, seed.wrapping_add(k)));
        let of_mean: Light = variance(&runs).iter().map(|v| v / 128.0).collect();
        (mean(&runs.concat()), of_mean)
    };
    let (wanted, chance) = runs(&independent.0, 1);
    let mut worst: f64 = 0.0;
    for (k, (method, _)) in others.iter().enumerate() {
        let (seen, own) = runs(method, 3 + 2 * k as u64);
        let expected: Vec<f64> = chance.iter().zip(&own).map(|(a, b)| a + b).collect();
        let off: Vec<f64> = seen.iter().zip(&wanted).map(|(a, b)| a - b).collect();
        let squares: Vec<f64> = off.iter().map(|d| d * d).collect();
        // Some 600 pixels tell their mean square to a tenth. The three channels of a pixel go together.
        let pixels = against(&squares, &expected) / 1.15;
        let picture = off.iter().sum::<f64>().abs() / (3.0 * expected.iter().sum::<f64>()).sqrt() / 4.0;
        if !(pixels + picture).is_finite() {
            return f64::NAN;
        }
        worst = worst.max(pixels).max(picture);
    }
    worst
}
