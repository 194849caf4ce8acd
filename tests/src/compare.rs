//! Compares a picture of the GPU with the f64 reference: it must have the same surfaces, the same light, and only
//! errors that the variances explain.

use dpm_lab::stability::gpu_compare::{self, Comparison, Rounding};
use dpm_lab::stability::gpu_shot::Shot;
use dpm_render::gpu::Gpu;
use std::sync::Arc;

/// Draws `shot` with both tracers. The reference takes `spp` samples and drops none.
pub fn compare(gpu: &Arc<Gpu>, shot: &Shot<'_>, spp: u32) -> Comparison {
    let comparison = gpu_compare::compare(gpu, shot, spp);
    assert_eq!(comparison.reference.dropped_samples, 0);
    comparison
}

/// The requirements of the tests on a comparison.
pub trait Demands {
    /// The surfaces are the same in all but `share` of the pixels (silhouettes, where rounding decides).
    fn assert_same_surfaces(&self, what: &str, share: f64);
    /// The means of each channel agree within `relative`, and their own noise is small enough to judge that.
    fn assert_same_mean(&self, what: &str, relative: f64);
    /// For each pixel and channel the difference is within four sigma, except for as many as chance permits. The
    /// squares of all differences have the mean that the variances predict.
    fn assert_pixels_explained(&self, what: &str);
}

impl Demands for Comparison {
    fn assert_same_surfaces(&self, what: &str, share: f64) {
        let limit = (share * self.met as f64).max(1.0);
        assert!(
            self.met > 0 && self.different.len() as f64 <= limit,
            "{what}: {} of {} surfaces differ, e.g. {:?}",
            self.different.len(),
            self.met,
            &self.different[..self.different.len().min(8)]
        );
    }

    fn assert_same_mean(&self, what: &str, relative: f64) {
        for channel in 0..3 {
            let gap = self.mean_gap(channel);
            assert!(
                gap.sigma <= 0.5 * relative * gap.truth,
                "{what}, channel {channel}: too noisy to judge: {gap:?}"
            );
            assert!(
                (gap.gpu - gap.truth).abs() <= relative * gap.truth,
                "{what}, channel {channel}: {gap:?}"
            );
        }
    }

    fn assert_pixels_explained(&self, what: &str) {
        let e = self.explained();
        assert!(e.exact <= 1.0, "{what}: a pixel without noise differs by {} times its rounding", e.exact);
        // Student's t of 31 degrees of freedom is beyond 4 with probability 4e-4, and rare bright samples make the
        // tails heavier.
        let allowed = f64::max(2e-3 * e.values, 3.0);
        assert!(
            e.beyond.len() as f64 <= allowed,
            "{what}: {} of {} beyond four sigma: {:?}",
            e.beyond.len(),
            e.values,
            &e.beyond[..e.beyond.len().min(8)]
        );
        if e.values > 100.0 {
            assert!(
                (0.7..1.4).contains(&e.mean_square),
                "{what}: the differences are {} times what the variances say",
                e.mean_square
            );
        }
    }
}

/// The bits of a picture.
pub fn bits(radiance: &[[f32; 4]]) -> Vec<[u32; 4]> {
    radiance.iter().map(|r| r.map(f32::to_bits)).collect()
}

/// Checks that two programs of one method drew the same picture, up to what [`Rounding`] allows the device.
///
/// # Panics
/// The pictures differ: a failure of the test.
pub fn assert_same_picture(gpu: &Gpu, a: &[[f32; 4]], b: &[[f32; 4]], what: &str) {
    let (rounding, pixels) = (Rounding::of(gpu), a.len());
    let (bits, more) =
        (bits(a).iter().zip(&bits(b)).filter(|(a, b)| a != b).count(), rounding.different(a, b));
    println!("{what}: {bits} of {pixels} pixels differ, {more} by more than rounding");
    assert!(more <= rounding.few_of(pixels), "{what}: {more} of {pixels} pixels differ");
    let mean = |p: &[[f32; 4]]| p.iter().map(|r| f64::from(r[1])).sum::<f64>() / p.len() as f64;
    assert!((mean(a) - mean(b)).abs() <= 0.01 * mean(a), "{what}: {} and {}", mean(a), mean(b));
}
