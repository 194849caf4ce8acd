//! A picture of the GPU against the f64 reference: the same surfaces, the same light, errors that the variances explain.

use crate::gpu::{Picture, Shot};
use crate::statistics::Estimate;
use dpm_host::gpu::Gpu;
use dpm_host::reference::{Reference, ReferenceImage, RenderSettings};
use glam::DVec2;
use std::sync::Arc;

/// Both pictures and the pixels in which they can be compared.
pub struct Comparison {
    /// The GPU's.
    pub picture: Picture,
    /// The reference's.
    pub reference: ReferenceImage,
    /// Pixels that both light, on the same body, at the same distance.
    pub common: Vec<usize>,
    /// Pixels whose surfaces differ.
    pub different: Vec<usize>,
    /// Pixels in which either met a surface.
    pub met: usize,
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
    assert_eq!(reference.dropped_samples, 0);
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

impl Comparison {
    /// Demands the same surfaces in all but `share` of the pixels (silhouettes, where rounding decides).
    pub fn assert_same_surfaces(&self, what: &str, share: f64) {
        let limit = (share * self.met as f64).max(1.0);
        assert!(
            self.met > 0 && self.different.len() as f64 <= limit,
            "{what}: {} of {} surfaces differ, e.g. {:?}",
            self.different.len(),
            self.met,
            &self.different[..self.different.len().min(8)]
        );
    }

    /// Demands that the means agree within `relative` and within what their own noise explains, per channel.
    pub fn assert_same_mean(&self, what: &str, relative: f64) {
        for channel in 0..3 {
            let n = self.common.len() as f64;
            let (mut gpu, mut truth, mut variance) = (0.0, 0.0, 0.0);
            for &i in &self.common {
                gpu += self.picture.estimates[i].mean[channel] / n;
                truth += self.reference.mean[i][channel] / n;
                variance += (self.picture.estimates[i].variance(channel)
                    + self.reference.variance[i][channel])
                    / (n * n);
            }
            let sigma = variance.sqrt();
            let text = format!(
                "{what}, channel {channel}: GPU {gpu}, reference {truth}, sigma of the difference {sigma}"
            );
            assert!(sigma <= 0.5 * relative * truth, "too noisy to judge: {text}");
            assert!((gpu - truth).abs() <= relative * truth, "{text}");
        }
    }

    /// Demands per pixel and channel a difference within four sigma, but for as many as chance allows, and that the squares of all
    /// differences are on average what the variances say.
    pub fn assert_pixels_explained(&self, what: &str) {
        let (mut beyond, mut squares, mut n) = (vec![], 0.0f64, 0.0f64);
        for &i in &self.common {
            for channel in 0..3 {
                let e: &Estimate = &self.picture.estimates[i];
                let difference = e.mean[channel] - self.reference.mean[i][channel];
                let rounding = 2e-5 * self.reference.mean[i][channel].abs();
                let sigma = (e.variance(channel) + self.reference.variance[i][channel]).sqrt();
                if sigma <= rounding {
                    assert!(
                        difference.abs() <= 10.0 * rounding + 1e-9,
                        "{what}: pixel {i} without noise differs by {difference}"
                    );
                    continue;
                }
                let z = difference / sigma;
                squares += z * z;
                n += 1.0;
                if z.abs() > 4.0 {
                    beyond.push((i, channel, e.mean[channel], self.reference.mean[i][channel], z));
                }
            }
        }
        // Student's t of 31 degrees of freedom is beyond 4 with probability 4e-4; rare bright samples make the tails heavier.
        let allowed = f64::max(2e-3 * n, 3.0);
        assert!(
            beyond.len() as f64 <= allowed,
            "{what}: {} of {n} beyond four sigma: {:?}",
            beyond.len(),
            &beyond[..beyond.len().min(8)]
        );
        if n > 100.0 {
            let mean_square = squares / n;
            assert!(
                (0.7..1.4).contains(&mean_square),
                "{what}: the differences are {mean_square} times what the variances say"
            );
        }
    }
}
