//! What a method should have shown, in two independent halves, so that it tells its own error; kept in files by what it was made from.

use super::runs::{ErrorRunError, EYE_FRAMES};
use crate::sequence::{eye_mean, rmse, Theatre};
use dpm_common::files::write_atomically;
use dpm_common::fnv::Fnv;
use dpm_device::regular_file;
use dpm_render::method::{Method, SamplerKind};
use glam::Vec3;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

/// Two independent halves, and their mean.
pub struct Reference {
    /// What the eye sees of each half.
    pub halves: [Vec<Vec3>; 2],
    /// Mean of both.
    pub eye: Vec<Vec3>,
    /// The last frame alone, mean of both.
    pub last: Vec<Vec3>,
    /// RMS error of `eye`: half of the halves' difference.
    pub error: f64,
}

impl Reference {
    /// Draws every pixel with `spp` samples a frame, both halves together, over [`EYE_FRAMES`] frames; or reads it from `cache`, where it
    /// lies under the hash of `what` (all that it depends on but the samples). `each` is called before each half that is drawn.
    ///
    /// # Errors
    /// The renderer's; the cache cannot be written.
    pub fn new(
        theatre: &Theatre,
        spp: u32,
        what: &str,
        cache: &Path,
        each: &mut dyn FnMut(&str),
    ) -> Result<Self, ErrorRunError> {
        let spp = spp.div_ceil(2);
        let method = Method { sampler: SamplerKind::BlueNoise, ..Method::full(spp) };
        let mut hash = Fnv::default();
        // Writing into a hash cannot fail.
        let _ = write!(hash, "{what}{spp}");
        let n = theatre.probes().len();
        let mut halves = Vec::new();
        for half in 0..2u32 {
            let path = cache.join(format!("reference-{}-{half}.f32", hash.text()));
            let frames = match read_frames(&path, n) {
                Some(frames) => frames,
                None => {
                    each("reference");
                    let seen = theatre.play_whole(&method, spp as f32, 0x9e37_0000 + half)?;
                    write_frames(&path, &seen.frames)?;
                    seen.frames
                }
            };
            halves.push(frames);
        }
        let mean = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| 0.5 * (*a + *b)).collect::<Vec<_>>();
        let last = mean(&halves[0][EYE_FRAMES - 1], &halves[1][EYE_FRAMES - 1]);
        let halves = [0, 1].map(|i: usize| eye_mean(&halves[i], EYE_FRAMES));
        let eye = mean(&halves[0], &halves[1]);
        let error = 0.5 * rmse(&halves[0], &halves[1], |_| true);
        Ok(Self { halves, eye, last, error })
    }

    /// Root of the mean square error of two runs where `keep` holds: as measured, and without the reference's own.
    pub fn perceived(&self, eyes: &[Vec<Vec3>; 2], keep: &dyn Fn(usize) -> bool) -> (f64, f64) {
        let square = |e: &Vec<Vec3>| rmse(e, &self.eye, keep).powi(2);
        let raw = 0.5 * (square(&eyes[0]) + square(&eyes[1]));
        let own = 0.25 * rmse(&self.halves[0], &self.halves[1], keep).powi(2);
        (raw.sqrt(), (raw - own).max(0.0).sqrt())
    }

    /// Error of what the eye sees of either run, as measured.
    pub(crate) fn each_run(&self, eyes: &[Vec<Vec3>; 2]) -> [f64; 2] {
        eyes.each_ref().map(|eye| rmse(eye, &self.eye, |_| true))
    }

    /// RMS bias: the mean product of the two runs' differences from the two halves. No noise of any of the four is in it, so its
    /// expectation is the squared bias; 0 where chance makes it negative. Second: root of the standard error of that mean over the
    /// probes, what chance leaves of a bias of 0.
    pub fn bias(&self, eyes: &[Vec<Vec3>; 2]) -> (f64, f64) {
        let (mut sum, mut squares, mut n) = (0.0f64, 0.0f64, 0u64);
        for (((a, b), r), s) in eyes[0].iter().zip(&eyes[1]).zip(&self.halves[0]).zip(&self.halves[1]) {
            // Mean over channels: they share their paths, so they do not count as three.
            let product = ((*a - *r) * (*b - *s)).as_dvec3().element_sum() / 3.0;
            if product.is_finite() {
                sum += product;
                squares += product * product;
                n += 1;
            }
        }
        let n = n.max(1) as f64;
        let (mean, mean_square) = (sum / n, squares / n);
        let error = ((mean_square - mean * mean).max(0.0) / n).sqrt();
        (mean.max(0.0).sqrt(), error.sqrt())
    }
}

/// Mean over channels of all finite values.
pub(crate) fn mean_of(values: &[Vec3]) -> f64 {
    let finite = || values.iter().filter(|v| v.is_finite());
    finite().map(|v| v.as_dvec3().element_sum()).sum::<f64>() / (3 * finite().count()).max(1) as f64
}

/// Frames of `probes` values from the cache; `None` when there are none or they do not fit.
fn read_frames(path: &Path, probes: usize) -> Option<Vec<Vec<Vec3>>> {
    let bytes = regular_file::read(path, (EYE_FRAMES * probes * 12) as u64).ok()?;
    if probes == 0 || bytes.len() != EYE_FRAMES * probes * 12 {
        return None;
    }
    let value = |c: &[u8]| f32::from_le_bytes([c[0], c[1], c[2], c[3]]);
    let point = |c: &[u8]| Vec3::new(value(&c[..4]), value(&c[4..8]), value(&c[8..]));
    Some(bytes.chunks_exact(12 * probes).map(|f| f.chunks_exact(12).map(point).collect()).collect())
}

fn write_frames(path: &Path, frames: &[Vec<Vec3>]) -> std::io::Result<()> {
    write_atomically(path, |out| {
        for v in frames.iter().flatten().flat_map(|v| v.to_array()) {
            out.write_all(&v.to_le_bytes())?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filled(v: f32, n: usize) -> Vec<Vec3> {
        vec![Vec3::splat(v); n]
    }

    #[test]
    fn shared_error_is_bias_and_the_rest_is_not() {
        // Truth 1 with half-errors of opposite sign; runs shifted by 0.2 with noise of opposite sign on either half of the probes.
        let n = 1000;
        let sign = |i: usize, k: usize| if (i >> k) & 1 == 0 { 1.0f32 } else { -1.0 };
        let noisy = |mean: f32, size: f32, k: usize| -> Vec<Vec3> {
            (0..1024).map(|i| Vec3::splat(mean + size * sign(i, k))).collect()
        };
        let halves = [noisy(1.0, 0.05, 0), noisy(1.0, 0.05, 1)];
        let eye: Vec<Vec3> = halves[0].iter().zip(&halves[1]).map(|(a, b)| 0.5 * (*a + *b)).collect();
        let error = 0.5 * rmse(&halves[0], &halves[1], |_| true);
        let reference = Reference { halves, last: eye.clone(), eye, error };
        let eyes = [noisy(1.2, 0.3, 2), noisy(1.2, 0.3, 3)];
        let (bias, floor) = reference.bias(&eyes);
        assert!((bias - 0.2).abs() < 1e-4, "{bias}");
        // Deviations of 0.3 and 0.05 about 0.2: the product's variance is that of (0.2 + x - r)(0.2 + y - s), over 1024 probes.
        let own = 0.3f64.powi(2) + 0.05f64.powi(2);
        let wanted = ((own * own + 2.0 * 0.04 * own) / 1024.0).sqrt().sqrt();
        assert!((floor / wanted - 1.0).abs() < 0.01, "{floor}, not {wanted}");
        let (raw, clean) = reference.perceived(&eyes, &|_| true);
        let wanted = (0.2f64.powi(2) + 0.3f64.powi(2)).sqrt();
        assert!((clean - wanted).abs() < 1e-4, "{clean}");
        assert!((raw * raw - clean * clean - error * error).abs() < 1e-6);
        assert!((reference.error - 0.05 / 2f64.sqrt()).abs() < 1e-4);
        assert_eq!(mean_of(&[filled(2.0, n), vec![Vec3::NAN]].concat()), 2.0);
    }
}
