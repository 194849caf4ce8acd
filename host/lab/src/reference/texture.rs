//! Texture coordinates into linear texel values, as `scene::Texture` defines them.

use dpm_scene::{Texture, TextureRef, Wrap};
use glam::{DVec2, DVec4};

/// Applies KHR_texture_transform: `offset + R scale uv` with `R = (cos, sin; -sin, cos)`: v runs down, so this turns the coordinates
/// counter-clockwise as seen in the image (the extension's own example fixes the sign).
pub(super) fn transform(r: &TextureRef, uv: DVec2) -> DVec2 {
    let (sin, cos) = f64::from(r.rotation).sin_cos();
    let p = uv * r.scale.as_dvec2();
    r.offset.as_dvec2() + DVec2::new(cos * p.x + sin * p.y, cos * p.y - sin * p.x)
}

/// The value at transformed coordinates: RGB decoded, alpha linear, each 0..1. White for an image without texels.
pub(super) fn sample(texture: &Texture, uv: DVec2) -> DVec4 {
    if texture.width == 0 || texture.height == 0 {
        return DVec4::ONE;
    }
    let size = DVec2::new(f64::from(texture.width), f64::from(texture.height));
    let p = if uv.is_finite() { uv * size } else { DVec2::ZERO };
    if texture.nearest {
        return texel(texture, p.x.floor(), p.y.floor());
    }
    let p = p - 0.5;
    let base = p.floor();
    let f = p - base;
    let row = |y: f64| texel(texture, base.x, y) * (1.0 - f.x) + texel(texture, base.x + 1.0, y) * f.x;
    row(base.y) * (1.0 - f.y) + row(base.y + 1.0) * f.y
}

fn texel(texture: &Texture, x: f64, y: f64) -> DVec4 {
    let x = fold(x, texture.width, texture.wrap_u);
    let y = fold(y, texture.height, texture.wrap_v);
    let t = texture.texels[y * texture.width as usize + x];
    let colour = |v: u8| if texture.srgb { decode_srgb(f64::from(v) / 255.0) } else { f64::from(v) / 255.0 };
    DVec4::new(colour(t[0]), colour(t[1]), colour(t[2]), f64::from(t[3]) / 255.0)
}

fn fold(i: f64, n: u32, wrap: Wrap) -> usize {
    let n = f64::from(n);
    let folded = match wrap {
        Wrap::Repeat => i.rem_euclid(n),
        Wrap::Clamp => i.clamp(0.0, n - 1.0),
        Wrap::Mirror => {
            let m = i.rem_euclid(2.0 * n);
            if m < n {
                m
            } else {
                2.0 * n - 1.0 - m
            }
        }
    };
    // rem_euclid may round up to n for a tiny negative i; i is whole, so only huge values can.
    folded.clamp(0.0, n - 1.0) as usize
}

/// The transfer function of IEC 61966-2-1, code value 0..1 to linear 0..1.
pub(crate) fn decode_srgb(v: f64) -> f64 {
    if v <= 0.04045 {
        v / 12.92
    } else {
        ((v + 0.055) / 1.055).powf(2.4)
    }
}

/// Mean over all texels, linear.
pub(super) fn mean(texture: &Texture) -> DVec4 {
    let mut histogram = [[0u64; 4]; 256];
    for t in &texture.texels {
        for c in 0..4 {
            histogram[usize::from(t[c])][c] += 1;
        }
    }
    let n = (texture.texels.len() as f64).max(1.0);
    let mut sum = DVec4::ZERO;
    for (v, counts) in histogram.iter().enumerate() {
        let v = v as f64 / 255.0;
        let colour = if texture.srgb { decode_srgb(v) } else { v };
        for c in 0..4 {
            sum[c] += counts[c] as f64 * if c < 3 { colour } else { v };
        }
    }
    sum / n
}
