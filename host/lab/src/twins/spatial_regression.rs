//! A pixel and its neighbours into filtered light: the oracle of `spatial_regression.comp`, in f64.
//!
//! It is no twin bit for bit. It solves the normal equations with pivots and for all unknowns, where the shader takes them out one after the other
//! and wants one of them, so it knows nothing of the shader's order.

use dpm_render::Surface;
use dpm_shaders::structs::HISTORY_USED;
use glam::{DVec3, Vec3};

/// Unknowns: two slopes over the raster, two over the normal, and the constant.
const UNKNOWNS: usize = 5;

/// What the filter reads of a pixel.
#[derive(Clone, Copy, Debug)]
pub struct FilterPixel {
    /// What the projector's ray met.
    pub surface: Surface,
    /// Light without what it is divided by.
    pub light: DVec3,
    /// Samples of the history.
    pub weight: f64,
    /// Variance of the luminance of one sample, undivided.
    pub variance: f64,
    /// Luminance of what light is divided by.
    pub albedo: f64,
    /// Surface point, body space, metres.
    pub position: DVec3,
    /// Unit normal there.
    pub normal: DVec3,
    /// `HistoryNoise::body_and_used`.
    pub body_and_used: u32,
    /// How far in the periphery: 0 where the eye looks, 1 where the picture is coarsest.
    pub periphery: f64,
}

/// A picture as the filter reads it.
#[derive(Clone, Debug)]
pub struct FilterPicture {
    /// Pixels in a row.
    pub width: usize,
    /// Row by row.
    pub pixels: Vec<FilterPixel>,
    /// Side of a pixel at a distance of one metre, metres.
    pub pixel_size: f64,
    /// Samples of a pixel and frame.
    pub samples_a_frame: f64,
}

fn luminance(c: DVec3) -> f64 {
    c.dot(Vec3::new(0.2126, 0.7152, 0.0722).as_dvec3())
}

fn mix(a: f64, b: f64, t: f64) -> f64 {
    a + (b - a) * t
}

/// Solves `a x = b` with three right sides by elimination with pivots. Returns the rows of `x`.
fn solve(mut a: [[f64; UNKNOWNS]; UNKNOWNS], mut b: [DVec3; UNKNOWNS]) -> [DVec3; UNKNOWNS] {
    for k in 0..UNKNOWNS {
        let largest = |i: &usize, j: &usize| a[*i][k].abs().total_cmp(&a[*j][k].abs());
        let pivot = (k..UNKNOWNS).max_by(largest).unwrap_or(k);
        a.swap(k, pivot);
        b.swap(k, pivot);
        for i in (0..UNKNOWNS).filter(|&i| i != k) {
            let f = a[i][k] / a[k][k];
            let (row, right) = (a[k], b[k]);
            a[i].iter_mut().zip(row).for_each(|(x, y)| *x -= f * y);
            b[i] -= f * right;
        }
    }
    std::array::from_fn(|k| b[k] / a[k][k])
}

impl FilterPicture {
    /// Variance of the mean of a sequence's points, as a share of that of independent samples.
    fn sequence_variance(&self, held: f64) -> f64 {
        mix(0.5, 0.27, (held / (60.0 * self.samples_a_frame)).clamp(0.0, 1.0))
    }

    /// The neighbours in 5 x 5 pixels that count for the pixel at `at`, with their places.
    fn alike(&self, at: usize) -> Vec<(DVec3, &FilterPixel)> {
        let own = &self.pixels[at];
        let body = own.surface.id >> 24;
        let farthest = 3.0 * f64::from(own.surface.distance.abs()) * self.pixel_size;
        let (x, y) = ((at % self.width) as i64, (at / self.width) as i64);
        let height = (self.pixels.len() / self.width) as i64;
        let mut found = Vec::new();
        for (dx, dy) in (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (dx, dy))) {
            let (qx, qy) = (x + dx, y + dy);
            if !(0..self.width as i64).contains(&qx) || !(0..height).contains(&qy) {
                continue;
            }
            let p = &self.pixels[qy as usize * self.width + qx as usize];
            let of_body = (p.body_and_used / (HISTORY_USED + 1)) & 255 == body;
            let near = (p.position - own.position).dot(own.normal).abs() <= farthest;
            if p.weight > 0.0 && of_body && p.normal.dot(own.normal) >= 0.6 && near {
                found.push((DVec3::new(dx as f64, dy as f64, 0.0), p));
            }
        }
        found
    }

    /// The filtered light of the pixel at `at`, without albedo and before lag is corrected.
    pub fn filtered(&self, at: usize) -> DVec3 {
        let own = &self.pixels[at];
        let level = luminance(own.light).max(0.02);
        let tolerated = (0.025 * level).powi(2);
        let axis = if own.normal.x.abs() < 0.7 { DVec3::X } else { DVec3::Y };
        let across = own.normal.cross(axis).normalize();
        let along = own.normal.cross(across);
        let mut matrix = [[0.0; UNKNOWNS]; UNKNOWNS];
        let mut right = [DVec3::ZERO; UNKNOWNS];
        let [mut power, mut expected, mut total] = [0.0; 3];
        // Variances of one sample, relative to the squares of what light is divided by, and as they are; sums of what it is divided by.
        let [mut relative, mut plain, mut divisors, mut squares] = [0.0; 4];
        // Neighbours are weighed by how many samples they have, and by the variance of one sample of this pixel.
        let one = own.variance / (own.albedo * own.albedo);
        let around = self.alike(at);
        let used = around.len() as f64;
        if used < 4.0 {
            return own.light;
        }
        for (place, p) in around {
            let of_sample = p.variance * self.sequence_variance(p.weight) / (p.albedo * p.albedo);
            let noise = of_sample / p.weight;
            let w = 1.0 / (one * self.sequence_variance(p.weight) / p.weight + tolerated);
            let row = [place.x, place.y, p.normal.dot(across), p.normal.dot(along), 1.0];
            let apart = p.light - own.light;
            for (i, a) in row.iter().enumerate() {
                right[i] += w * a * apart;
                row.iter().zip(&mut matrix[i]).for_each(|(b, sum)| *sum += w * a * b);
            }
            power += w * luminance(apart).powi(2);
            expected += w * noise;
            relative += of_sample;
            plain += of_sample * p.albedo * p.albedo;
            divisors += p.albedo;
            squares += p.albedo * p.albedo;
            total += w;
        }
        for (i, slopes) in [4e-4, 4e-4, 0.1, 0.1].into_iter().enumerate() {
            matrix[i][i] += 1.0 / (slopes * level * level);
        }
        let fit = solve(matrix, right);
        let explained: f64 = fit.iter().zip(right).map(|(x, b)| luminance(*x) * luminance(b)).sum();
        let step = fit[UNKNOWNS - 1];
        let missed = (power - explained).max(0.0) / total * used / (used - 4.0).max(1.0);
        let single = f64::min(relative, plain / (own.albedo * own.albedo));
        let of_mean = single / used / own.weight.max(1e-6);
        // How uneven the divisor is around, relative to its mean.
        let steep = (squares * used / (divisors * divisors) - 1.0).max(0.0);
        let beyond = own.periphery;
        let structure = (missed - expected / total)
            .max(0.0)
            .max(luminance(step).powi(2) - mix(3.0, 16.0, beyond) * of_mean)
            .max(0.0025 * steep);
        let changing = (20.0 * self.samples_a_frame).min(0.3 * f64::from(own.body_and_used & HISTORY_USED));
        let noise = of_mean * mix(1.0, 5.0, beyond) * own.weight / (own.weight + changing);
        (own.light + step * (noise / (structure + noise).max(1e-12))).max(DVec3::ZERO)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_solved_fulfils_its_equations() {
        let a: [[f64; UNKNOWNS]; UNKNOWNS] = std::array::from_fn(|i| {
            std::array::from_fn(|j| if i == j { 0.0 } else { 1.0 / (1.0 + i as f64 + 2.0 * j as f64) })
        });
        let b: [DVec3; UNKNOWNS] = std::array::from_fn(|i| DVec3::new(i as f64, 1.0, -2.0));
        let x = solve(a, b);
        for i in 0..UNKNOWNS {
            let got: DVec3 = (0..UNKNOWNS).map(|j| a[i][j] * x[j]).sum();
            assert!((got - b[i]).length() < 1e-9, "row {i}: {got} for {}", b[i]);
        }
    }
}
