//! Wanted radiance into projector drive: the CPU twin of the compensation shader.
//!
//! `drive = pi (L - L_amb) l^2 / (rho max(cos, 1e-3) I_max)`, clamped to 0..1, per channel: linear in light, no display gamma
//! (`docs/RENDERING.md`). The f32 form performs the shader's operations in the shader's order; the f64 form is its oracle.

use dpm_render::albedo_map::AlbedoMap;
use dpm_shaders::structs::{Frame, Rows};

/// Smallest cosine between surface and projector that is still compensated: beyond it the drive would be full anyway.
pub(crate) const LEAST_COS: f64 = 1e-3;

/// What the light falls on and what the projector can give. Fixed for a rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Compensation {
    /// `pi / (rho * I_max)` per channel, rounded once from f64.
    pub gain: [f32; 3],
    /// Radiance that the surface shows without the projector.
    pub ambient: [f32; 3],
}

impl Compensation {
    /// `albedo`: diffuse reflectance of the real surface, above 0 to 1. `max_intensity`: the projector's greatest radiant intensity
    /// in scene units per steradian, above 0. `ambient`: radiance the surface shows without the projector, not negative.
    /// `None` where one of them is out of range.
    pub(crate) fn new(albedo: [f64; 3], max_intensity: [f64; 3], ambient: [f64; 3]) -> Option<Self> {
        let mut gain = [0.0; 3];
        for c in 0..3 {
            let (rho, i, a) = (albedo[c], max_intensity[c], ambient[c]);
            if !(rho > 0.0 && rho <= 1.0 && i > 0.0 && i.is_finite() && a >= 0.0 && a.is_finite()) {
                return None;
            }
            gain[c] = (std::f64::consts::PI / (rho * i)) as f32;
            if !(gain[c] > 0.0 && gain[c].is_finite()) {
                return None;
            }
        }
        Some(Self { gain, ambient: ambient.map(|a| a as f32) })
    }

    /// Drive 0..1 per channel for the radiance wanted toward the eye. `distance`: projector to surface, metres. `cos`: between the
    /// smooth normal and the direction to the projector, either sign. NaN gives 0.
    pub(crate) fn drive(&self, radiance: [f32; 3], distance: f32, cos: f32) -> [f32; 3] {
        self.unlimited_drive(radiance, distance, cos)
            .map(|v| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) })
    }

    /// [`Self::drive`] before clamping, NaN included: what the shader hands to its quantiser.
    pub fn unlimited_drive(&self, radiance: [f32; 3], distance: f32, cos: f32) -> [f32; 3] {
        let geometry = (distance * distance) * (1.0 / cos.abs().max(LEAST_COS as f32));
        std::array::from_fn(|c| (radiance[c] - self.ambient[c]) * (self.gain[c] * geometry))
    }

    /// The same in f64.
    #[cfg(test)]
    pub(crate) fn drive_f64(&self, radiance: [f64; 3], distance: f64, cos: f64) -> [f64; 3] {
        let geometry = distance * distance / cos.abs().max(LEAST_COS);
        std::array::from_fn(|c| {
            let v = (radiance[c] - f64::from(self.ambient[c])) * (f64::from(self.gain[c]) * geometry);
            if v.is_nan() {
                0.0
            } else {
                v.clamp(0.0, 1.0)
            }
        })
    }

    /// Radiance toward the eye that a drive produces on the real surface: the inverse, for judging.
    #[cfg(test)]
    pub(crate) fn radiance(&self, drive: [f64; 3], distance: f64, cos: f64) -> [f64; 3] {
        std::array::from_fn(|c| {
            drive[c] * cos.abs() / (f64::from(self.gain[c]) * distance * distance)
                + f64::from(self.ambient[c])
        })
    }
}

/// Values at the corners of a triangle, interpolated at the weights of the second and third, in the shader's operations and order.
pub fn interpolated<const N: usize>(corners: [[f32; N]; 3], barycentric: [f32; 2]) -> [f32; N] {
    let [b1, b2] = barycentric;
    let w = (1.0 - b1) - b2;
    std::array::from_fn(|k| (corners[0][k] * w + corners[1][k] * b1) + corners[2][k] * b2)
}

/// Drive for a surface of this albedo instead of albedo 1, in the shader's operations and order.
pub fn on_albedo(drive: [f32; 3], albedo: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|c| drive[c] * (1.0 / albedo[c]))
}

/// Albedo at texture coordinates in f64, the oracle of [`AlbedoMap::at`]: every texel counts by its distance, and comes again in every repetition
/// of the picture.
pub fn albedo_f64(map: &AlbedoMap, uv: [f64; 2]) -> [f64; 3] {
    let sides = [map.width(), map.height()].map(f64::from);
    let at = [0, 1].map(|k| uv[k].rem_euclid(1.0) * sides[k]);
    // The tent of a texel on one axis. A picture of one texel comes into the tent three times.
    let weight = |k: usize, texel: usize| -> f64 {
        let distance = |turn: f64| (at[k] - (texel as f64 + 0.5) - turn * sides[k]).abs();
        [-1.0, 0.0, 1.0].map(|turn| (1.0 - distance(turn)).max(0.0)).iter().sum()
    };
    let mut sum = [0.0; 3];
    for (i, texel) in map.texels().iter().enumerate() {
        let (x, y) = (i % map.width() as usize, i / map.width() as usize);
        let share = weight(0, x) * weight(1, y);
        (0..3).for_each(|c| sum[c] += share * f64::from(texel[c]));
    }
    sum
}

/// The ray of a pixel's centre before the pose, of any length, in the shader's operations. `straight`: the pixel's straight ray where the
/// projector has a lens.
pub fn ray_of(frame: &Frame, pixel: [u32; 2], straight: Option<[f32; 2]>) -> [f32; 3] {
    if let Some([x, y]) = straight {
        return [x, -y, -1.0];
    }
    let [x, y] = pixel.map(|v| v as f32 + 0.5);
    let [fx, fy, cx, cy] = frame.intrinsics;
    [(x - cx) * fy, (cy - y) * fx, -(fx * fy)]
}

/// `|cos|` between the smooth normal of a surface and a ray of the projector, in the shader's operations and order. `rows`: the body's
/// world-from-object; `normals`: of the triangle's corners; `ray`: of [`ray_of`]. 0 where the normals cancel.
pub fn real_cosine(
    rows: &Rows,
    normals: [[f32; 3]; 3],
    barycentric: [f32; 2],
    frame: &Frame,
    ray: [f32; 3],
) -> f32 {
    let n = interpolated(normals, barycentric);
    let turn = |row: &[f32; 4], v: [f32; 3]| (row[0] * v[0] + row[1] * v[1]) + row[2] * v[2];
    let (mut dot, mut nn, mut dd) = (0.0f32, 0.0f32, 0.0f32);
    for (row, projector_row) in rows.iter().zip(&frame.world_from_projector) {
        let (ni, di) = (turn(row, n), turn(projector_row, ray));
        dot += ni * di;
        nn += ni * ni;
        dd += di * di;
    }
    let squared = nn * dd;
    if squared.is_nan() || squared <= 0.0 {
        return 0.0;
    }
    dot.abs() * (1.0 / squared.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_white_lambertian_surface_returns_the_wanted_radiance() {
        // Intensity J on a surface of albedo rho at distance l, angle th: E = J cos / l^2, L = rho E / pi.
        let k = Compensation::new([0.8; 3], [10.0, 20.0, 40.0], [0.05, 0.0, 0.0]).unwrap();
        let (wanted, l, cos) = ([0.3, 0.2, 0.1], 1.7, 0.6);
        let drive = k.drive_f64(wanted, l, cos);
        for c in 0..3 {
            let intensity = drive[c] * [10.0, 20.0, 40.0][c];
            let seen = 0.8 / std::f64::consts::PI * intensity * cos / (l * l) + [0.05, 0.0, 0.0][c];
            assert!((seen - wanted[c]).abs() < 1e-7, "{seen} {}", wanted[c]);
        }
        let back = k.radiance(drive, l, cos);
        assert!((back[0] - 0.3).abs() < 1e-12);
    }

    #[test]
    fn f32_follows_f64_over_the_range() {
        let k = Compensation::new([0.8, 0.5, 1.0], [10.0, 200.0, 1e4], [0.0; 3]).unwrap();
        for i in 0..2000 {
            let t = f64::from(i) / 2000.0;
            let (l, cos) = (1e-3 + 50.0 * t, 1.0 - 0.999 * t);
            let radiance = [0.3 * t, 1e-4 + t, 3.0 * t];
            let a = k.drive(radiance.map(|x| x as f32), l as f32, cos as f32);
            let b = k.drive_f64(radiance, l, cos);
            for c in 0..3 {
                assert!((f64::from(a[c]) - b[c]).abs() <= 6e-7 * b[c], "{} {}", a[c], b[c]);
            }
        }
    }

    #[test]
    fn the_albedo_of_a_map_is_that_of_its_texels_by_their_distance() {
        let mut value = 0.11f32;
        let mut next = || {
            value = (value * 7.31).fract().max(AlbedoMap::LEAST);
            value
        };
        for (width, height) in [(1, 1), (1, 4), (5, 1), (7, 3), (16, 9)] {
            let texels = (0..width * height).map(|_| [next(), next(), next()]).collect();
            let map = AlbedoMap::new(width, height, texels).unwrap();
            for i in 0..4000 {
                let t = f64::from(i) / 4000.0;
                let uv = [5.0 * (t * 71.0).fract() - 2.0, 5.0 * t - 2.0].map(|v| v as f32);
                let (is, should) = (map.at(uv), albedo_f64(&map, uv.map(f64::from)));
                for c in 0..3 {
                    let off = (f64::from(is[c]) - should[c]).abs();
                    assert!(off < 2e-5, "{width} x {height} at {uv:?}: {} {}", is[c], should[c]);
                }
            }
        }
    }

    #[test]
    fn out_of_range_is_black_or_full_and_never_nan() {
        let k = Compensation::new([0.8; 3], [1.0; 3], [0.0; 3]).unwrap();
        for (radiance, l, cos, want) in [
            (f32::NAN, 1.0, 1.0, 0.0),
            (-1.0, 1.0, 1.0, 0.0),
            (f32::INFINITY, 1.0, 1.0, 1.0),
            (1.0, 1.0, 0.0, 1.0),
            (1.0, f32::NAN, 1.0, 0.0),
            (0.0, 1e30, 1.0, 0.0),
            (1.0, 1.0, 1e-38, 1.0),
            (0.0, 1.0, 1.0, 0.0),
        ] {
            assert_eq!(k.drive([radiance; 3], l, cos), [want; 3], "{radiance} {l} {cos}");
        }
        assert_eq!(Compensation::new([0.0; 3], [1.0; 3], [0.0; 3]), None);
        assert_eq!(Compensation::new([0.8; 3], [f64::NAN; 3], [0.0; 3]), None);
    }
}
