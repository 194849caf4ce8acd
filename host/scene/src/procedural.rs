//! Generates the textures of the built-in scene by code. All tile without a seam.

use glam::{Vec2, Vec3};

use super::srgb::from_linear;
use super::Texture;

const SIZE: u32 = 256;

/// Base colour (sRGB) and normal map of a crackled blue-and-white glaze.
pub(crate) fn glaze_textures() -> [Texture; 2] {
    let color = |p: Vec2| {
        let petals = cells(p, 6, 11);
        let ring = 1.0 - smooth(0.24, 0.30, petals.nearest);
        let heart = 1.0 - smooth(0.07, 0.10, petals.nearest);
        let cloud = fractal(p, 4, 3);
        let body = Vec3::new(0.86, 0.84, 0.78).lerp(Vec3::new(0.74, 0.80, 0.78), cloud);
        let blue = Vec3::new(0.05, 0.16, 0.50).lerp(Vec3::new(0.16, 0.36, 0.66), cloud);
        let gold = Vec3::new(0.85, 0.52, 0.10);
        let crackle = 1.0 - 0.25 * (1.0 - smooth(0.0, 0.03, cells(p, 14, 29).edge));
        body.lerp(blue, ring).lerp(gold, heart) * crackle
    };
    let height = |p: Vec2| 0.010 * smooth(0.20, 0.32, cells(p, 6, 11).nearest) + 0.006 * fractal(p, 8, 5);
    [srgb_image(color), normal_map(height)]
}

/// Base colour (sRGB) and metallic-roughness of bronze with green patina in its hollows.
pub(crate) fn bronze_textures() -> [Texture; 2] {
    let patina = |p: Vec2| smooth(0.56, 0.70, fractal(p, 6, 17));
    let color = |p: Vec2| {
        let metal = Vec3::new(0.80, 0.52, 0.28).lerp(Vec3::new(0.66, 0.40, 0.20), fractal(p, 16, 7));
        metal.lerp(Vec3::new(0.14, 0.36, 0.29), patina(p))
    };
    let surface =
        |p: Vec2| Vec3::new(0.0, 0.24 + 0.14 * fractal(p, 12, 23) + 0.45 * patina(p), 1.0 - patina(p));
    [srgb_image(color), linear_image(surface)]
}

fn image(srgb: bool, texel: impl Fn(Vec2) -> Vec3) -> Texture {
    let texels = (0..SIZE * SIZE)
        .map(|i| {
            let p = (Vec2::new((i % SIZE) as f32, (i / SIZE) as f32) + 0.5) / SIZE as f32;
            let c = texel(p).clamp(Vec3::ZERO, Vec3::ONE);
            let [r, g, b] = c.to_array().map(|x| (255.0 * x + 0.5) as u8);
            [r, g, b, 255]
        })
        .collect();
    Texture::repeated([SIZE; 2], texels, srgb)
}

fn linear_image(texel: impl Fn(Vec2) -> Vec3) -> Texture {
    image(false, texel)
}

fn srgb_image(linear: impl Fn(Vec2) -> Vec3) -> Texture {
    image(true, |p| linear(p).map(from_linear))
}

/// Tangent-space normals of a height field in tile coordinates; green points up in the image.
fn normal_map(height: impl Fn(Vec2) -> f32) -> Texture {
    let n = SIZE as usize;
    let at_centre = |i: usize| height((Vec2::new((i % n) as f32, (i / n) as f32) + 0.5) / SIZE as f32);
    let heights: Vec<f32> = (0..n * n).map(at_centre).collect();
    image(false, |p| {
        let (x, y) = ((p.x * SIZE as f32) as usize, (p.y * SIZE as f32) as usize);
        let at = |x: usize, y: usize| heights[(y % n) * n + x % n];
        let across = at(x + 1, y) - at(x + n - 1, y);
        let up = at(x, y + n - 1) - at(x, y + 1);
        let normal = Vec3::new(-across, -up, 2.0 / SIZE as f32).normalize();
        0.5 * (normal + 1.0)
    })
}

fn smooth(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A number in 0..1 for a lattice point of a tile with `period` cells.
fn lattice(x: i32, y: i32, period: i32, seed: u32) -> f32 {
    let (x, y) = (x.rem_euclid(period) as u32, y.rem_euclid(period) as u32);
    let mut h = x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77) ^ seed.wrapping_mul(0xC2B2_AE3D);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    ((h ^ (h >> 15)) >> 8) as f32 / 16_777_216.0
}

/// Smoothly interpolated lattice noise with `period` cells a tile, in 0..1.
fn value_noise(p: Vec2, period: i32, seed: u32) -> f32 {
    let q = p * period as f32;
    let base = q.floor();
    let t = q - base;
    let t = t * t * t * (t * (6.0 * t - 15.0) + 10.0);
    let at = |dx, dy| lattice(base.x as i32 + dx, base.y as i32 + dy, period, seed);
    let low = at(0, 0) + (at(1, 0) - at(0, 0)) * t.x;
    let high = at(0, 1) + (at(1, 1) - at(0, 1)) * t.x;
    low + (high - low) * t.y
}

/// Four octaves of noise, in 0..1.
fn fractal(p: Vec2, period: i32, seed: u32) -> f32 {
    let octave = |k: u32| 0.5f32.powi(k as i32) * value_noise(p, period << k, seed + k);
    (0..4).map(octave).sum::<f32>() / 1.875
}

/// Distances in a field of scattered points, in cells.
struct Cells {
    /// To the nearest point.
    nearest: f32,
    /// Second nearest minus nearest: zero on the border between two points.
    edge: f32,
}

fn cells(p: Vec2, period: i32, seed: u32) -> Cells {
    let q = p * period as f32;
    let base = q.floor();
    let (mut first, mut second) = (f32::MAX, f32::MAX);
    for dy in -1..=1 {
        for dx in -1..=1 {
            let (x, y) = (base.x as i32 + dx, base.y as i32 + dy);
            let jitter = Vec2::new(lattice(x, y, period, seed), lattice(x, y, period, seed + 1));
            let d = q.distance(Vec2::new(x as f32, y as f32) + 0.15 + 0.7 * jitter);
            if d < first {
                (first, second) = (d, first);
            } else {
                second = second.min(d);
            }
        }
    }
    Cells { nearest: first, edge: second - first }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn textures_tile_and_vary() {
        let all = glaze_textures().into_iter().chain(bronze_textures());
        for (k, t) in all.enumerate() {
            let step = |a: usize, b: usize| {
                (0..3).map(|c| f64::from(t.texels[a][c].abs_diff(t.texels[b][c]))).sum::<f64>()
            };
            let (w, h) = (t.width as usize, t.height as usize);
            let seam: f64 = (0..h).map(|y| step(y * w, y * w + w - 1)).sum::<f64>() / h as f64;
            let inner: f64 = (0..h).map(|y| step(y * w + w / 2, y * w + w / 2 - 1)).sum::<f64>() / h as f64;
            assert!(seam < 3.0 * inner + 6.0, "texture {k}: seam {seam} against {inner}");
            assert!(t.texels.iter().collect::<std::collections::HashSet<_>>().len() > 50);
        }
    }

    #[test]
    fn normal_map_texels_are_unit_vectors_facing_out() {
        for texel in &glaze_textures()[1].texels {
            let n = Vec3::new(f32::from(texel[0]), f32::from(texel[1]), f32::from(texel[2])) / 127.5 - 1.0;
            assert!((n.length() - 1.0).abs() < 0.02 && n.z > 0.2);
        }
    }
}
