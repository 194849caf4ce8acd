//! A picture of the GPU against the f64 reference: the same surfaces, the same light, errors that the variances explain.

use super::estimate::Estimate;
use super::gpu_shot::{Shot, ShotPicture};
use crate::reference::{Reference, ReferenceImage, RenderSettings};
use dpm_render::gpu::Gpu;
use glam::DVec2;
use std::sync::Arc;

/// Both pictures and the pixels in which they can be compared.
pub struct Comparison {
    /// The GPU's.
    pub picture: ShotPicture,
    /// The reference's.
    pub reference: ReferenceImage,
    /// Pixels that both light, on the same body, at the same distance.
    pub common: Vec<usize>,
    /// Pixels whose surfaces differ.
    pub different: Vec<usize>,
    /// Pixels in which either met a surface.
    pub met: usize,
}

/// Largest share of pixels that two programs of one method may draw otherwise on a GPU.
const OTHERWISE: f64 = 0.02;

/// By how much two programs of one method may draw a value differently: not at all on software Vulkan. The compilers of GPUs join a multiplication and
/// an addition into one operation, in each program where it suits it. So there a pixel is the same up to rounding, and few pixels differ by more, where
/// rounding has decided a branch.
#[derive(Clone, Copy, Debug)]
pub struct Rounding {
    is_exact: bool,
}

impl Rounding {
    /// That of the compiler of `gpu`.
    pub fn of(gpu: &Gpu) -> Self {
        Self { is_exact: gpu.summary().software }
    }

    /// What a value as large as this may differ by.
    pub fn of_value(self, value: f64) -> f64 {
        if self.is_exact {
            0.0
        } else {
            1e-4 + 1e-3 * value.abs()
        }
    }

    /// How many of `pixels` may differ by more.
    pub fn few_of(self, pixels: usize) -> usize {
        if self.is_exact {
            0
        } else {
            (OTHERWISE * pixels as f64) as usize
        }
    }

    /// Pixels of two pictures that differ: by any bit, or by more than rounding.
    pub fn different(self, a: &[[f32; 4]], b: &[[f32; 4]]) -> usize {
        let differs = |a: f32, b: f32| {
            let (a, b) = (f64::from(a), f64::from(b));
            // NaN is near to nothing.
            let is_near = (a - b).abs() <= self.of_value(a);
            !is_near
        };
        let is_other = |(a, b): &(&[f32; 4], &[f32; 4])| {
            let bits = |p: &[f32; 4]| p.map(f32::to_bits);
            bits(a) != bits(b) && (self.is_exact || a.iter().zip(*b).any(|(a, b)| differs(*a, *b)))
        };
        a.iter().zip(b).filter(is_other).count()
    }
}

/// Relative difference of distances above which two surfaces are not the same.
const SAME_DISTANCE: f64 = 1e-4;

/// Draws `shot` with both tracers; the reference takes `spp` samples.
pub fn compare(gpu: &Arc<Gpu>, shot: &Shot<'_>, spp: u32) -> Comparison {
    let picture = shot.draw(gpu);
    let poses = shot.world_from_body();
    let tracer = Reference::new(shot.scene, &poses);
    let settings = RenderSettings { spp, depth: shot.depth, seed: 77, ..RenderSettings::default() };
    let reference = match shot.eye {
        Some(eye) => tracer.render(&shot.camera, eye, &settings),
        None => tracer.render_camera(&shot.camera, &settings),
    };
    let width = shot.camera.raster.width() as usize;
    let (mut common, mut different, mut met) = (vec![], vec![], 0);
    for i in 0..picture.surfaces.len() {
        let at = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let ray = shot.camera.ray(at);
        let truth = tracer.trace(ray.origin, ray.direction, f64::INFINITY, shot.eye.is_some());
        if truth.is_none() && !picture.hit(i) {
            continue;
        }
        met += 1;
        let same = truth.is_some_and(|t| {
            let lit = shot.eye.is_none_or(|eye| tracer.lit(&t, ray.origin, eye));
            let surface = &picture.surfaces[i];
            picture.hit(i)
                && surface.id >> 24 == t.body
                && (f64::from(surface.distance.abs()) - t.distance).abs() < SAME_DISTANCE * t.distance
                && picture.lit(i) == lit
        });
        if !same {
            different.push(i);
        } else if picture.lit(i) {
            common.push(i);
        }
    }
    Comparison { picture, reference, common, different, met }
}

/// How the GPU's mean stands to the reference's, one channel.
#[derive(Clone, Copy, Debug)]
pub struct MeanGap {
    /// Mean of the GPU over the common pixels.
    pub gpu: f64,
    /// Mean of the reference.
    pub truth: f64,
    /// Standard error of their difference.
    pub sigma: f64,
}

/// How well the variances explain the differences of single pixels.
#[derive(Clone, Debug, Default)]
pub struct Explained {
    /// Values with noise: pixels times channels.
    pub values: f64,
    /// Those beyond four sigma: pixel, channel, GPU, reference, distance in sigmas.
    pub beyond: Vec<(usize, usize, f64, f64, f64)>,
    /// Mean square of the distances in sigmas; 1 is right.
    pub mean_square: f64,
    /// Largest difference of a value without noise by what rounding explains (2e-4 of it).
    pub exact: f64,
}

impl Comparison {
    /// Share of the pixels that met anything whose surfaces differ.
    pub(crate) fn different_share(&self) -> f64 {
        if self.met == 0 {
            return f64::NAN;
        }
        self.different.len() as f64 / self.met as f64
    }

    /// The means of one channel.
    pub fn mean_gap(&self, channel: usize) -> MeanGap {
        let n = self.common.len() as f64;
        let (mut gpu, mut truth, mut variance) = (0.0, 0.0, 0.0);
        for &i in &self.common {
            gpu += self.picture.estimates[i].mean[channel] / n;
            truth += self.reference.mean[i][channel] / n;
            variance +=
                (self.picture.estimates[i].variance(channel) + self.reference.variance[i][channel]) / (n * n);
        }
        MeanGap { gpu, truth, sigma: variance.sqrt() }
    }

    /// Every pixel against its own noise.
    pub fn explained(&self) -> Explained {
        let mut out = Explained::default();
        let mut squares = 0.0f64;
        for &i in &self.common {
            for channel in 0..3 {
                let e: &Estimate = &self.picture.estimates[i];
                let difference = e.mean[channel] - self.reference.mean[i][channel];
                let rounding = 2e-5 * self.reference.mean[i][channel].abs();
                let sigma = (e.variance(channel) + self.reference.variance[i][channel]).sqrt();
                if sigma <= rounding {
                    out.exact = out.exact.max(difference.abs() / (10.0 * rounding + 1e-9));
                    continue;
                }
                let z = difference / sigma;
                squares += z * z;
                out.values += 1.0;
                if z.abs() > 4.0 {
                    out.beyond.push((i, channel, e.mean[channel], self.reference.mean[i][channel], z));
                }
            }
        }
        out.mean_square = squares / out.values.max(1.0);
        out
    }
}
