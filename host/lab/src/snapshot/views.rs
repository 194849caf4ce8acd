//! One frame's buffers into pictures.

use super::SnapshotImage;
use crate::paint::{self, Canvas, Scale};
use crate::twins::rate_map::{estimate, PixelGuide, RateConstants};
use dpm_device::planes::Raster;
use dpm_render::method::Method;
use dpm_render::{FrameSlot, Guide, History, Renderer, Surface};
use dpm_rig::pictures::to_srgb;
use dpm_shaders::structs::NO_HIT;
use glam::{DAffine3, Vec3};

/// Side of a tile, pixels.
const TILE: usize = dpm_render::tiles::TILE as usize;

/// What the pictures of one frame are made from.
pub(crate) struct Views<'a> {
    /// The raster.
    pub raster: Raster,
    /// How rays were spent.
    pub method: &'a Method,
    /// The frame; its slot was made for debugging.
    pub slot: &'a FrameSlot,
    /// Who drew it.
    pub renderer: &'a Renderer,
    /// world-from-body of the frame.
    pub poses: &'a [DAffine3],
    /// Error of every tile when rates were last decided, see [`tile_errors`].
    pub tile_errors: &'a [Option<f32>],
    /// Factor from radiance to what is shown, of which 1 is white; `None`: 1, or less where that is too bright.
    pub exposure: Option<f32>,
}

/// What [`SnapshotImage`] needs that `method` does not compute; `None`: nothing is missing.
pub(crate) fn missing(image: SnapshotImage, method: &Method) -> Option<&'static str> {
    use SnapshotImage as I;
    let guides = method.needs_history() || method.needs_spatial() || method.spp_by_angle;
    let (there, why) = match image {
        I::Rate | I::Error => (
            method.needs_rates(),
            "no shading rates are decided: method paper does, with effects.rate_map on",
        ),
        I::Size | I::Angle | I::Motion => {
            (guides, "this method needs nothing of the kind; any other than full does")
        }
        I::History => {
            (method.needs_history(), "nothing is kept from frame to frame; any method other than full does")
        }
        I::Variance | I::Albedo => (method.dpm, "only method dpm keeps it"),
        I::Radiance | I::Spp | I::Normal | I::Depth | I::Light | I::Viewer => (true, ""),
    };
    (!there).then_some(why)
}

impl Views<'_> {
    fn lit<T, U>(&self, of: Option<&[T]>, value: impl Fn(&T) -> U) -> Vec<Option<U>> {
        let (surfaces, of) = (self.slot.surfaces().unwrap_or_default(), of.unwrap_or(&[]));
        surfaces.iter().zip(of).map(|(s, t)| s.is_lit().then(|| value(t))).collect()
    }

    fn guide<U>(&self, value: impl Fn(&Guide) -> U) -> Vec<Option<U>> {
        self.lit(self.slot.guides().as_deref(), value)
    }

    fn history(&self, value: impl Fn(&History) -> f32) -> Vec<Option<f32>> {
        self.lit(self.slot.history().as_deref(), value)
    }

    /// Radiance of every pixel, black where nothing is lit.
    pub(crate) fn radiance(&self) -> Vec<Vec3> {
        self.lit(self.slot.radiance(), |r| Vec3::new(r[0], r[1], r[2]))
            .into_iter()
            .map(Option::unwrap_or_default)
            .collect()
    }

    /// The picture; [`missing`] says whether there is one. The observer's view is not made from one frame: see `snapshot`.
    pub(crate) fn paint(&self, image: SnapshotImage) -> Canvas {
        use SnapshotImage as I;
        let raster = self.raster;
        let surfaces = self.slot.surfaces().unwrap_or_default();
        let quantity =
            |values: Vec<Option<f32>>, scale, title| paint::quantity(raster, &values, scale, title);
        match image {
            I::Radiance | I::Viewer => {
                let linear = self.radiance();
                let scale = self.exposure.unwrap_or_else(|| scale_to_white(&linear));
                srgb_canvas(raster, &linear, scale)
            }
            I::Rate => {
                paint::kinds(raster, &self.rates(), &RATES, "rate of a tile\n(pixels x, y\nshare a ray)")
            }
            I::Error => quantity(self.errors(), Scale::FromZero, "e of eq. 1\n(scene units)\npink: unknown"),
            I::Size => quantity(
                self.guide(|g| g.sight.size),
                Scale::Log,
                "d of eq. 3\n(pixel size as\nthe eye sees\nit, relative)",
            ),
            I::Angle => {
                quantity(self.guide(|g| g.sight.angle), Scale::FromZero, "phi, angle\nfrom the gaze\n(deg)")
            }
            I::Motion => paint::directions(raster, &self.guide(|g| g.sight.motion), "motion\n(px/frame)"),
            I::Spp => quantity(
                self.lit(self.slot.traced(), |r| r[3]),
                Scale::FromZero,
                "samples of\nthis frame\n(1/px)",
            ),
            I::History => {
                let title = if self.method.dpm { "history\n(samples/px)" } else { "history\n(frames)" };
                quantity(self.history(|h| h.light.weight), Scale::FromZero, title)
            }
            I::Variance => {
                quantity(self.history(|h| h.noise.variance), Scale::Log, "variance of\none sample\nluminance")
            }
            I::Albedo => paint::colours(raster, &self.guide(albedo_of)),
            I::Normal => {
                let normal = |s: &Surface| {
                    let n = self.renderer.shading_normal(s).as_dvec3();
                    let n = self.poses[(s.id >> 24) as usize].transform_vector3(n).normalize_or_zero();
                    (n * 0.5 + 0.5).as_vec3().to_array()
                };
                let values: Vec<_> = surfaces.iter().map(|s| (s.id != NO_HIT).then(|| normal(s))).collect();
                paint::colours(raster, &values)
            }
            I::Depth => {
                let values = surfaces.iter().map(|s| (s.id != NO_HIT).then(|| s.distance.abs())).collect();
                quantity(values, Scale::Span, "distance from\nthe projector\n(m)")
            }
            I::Light => {
                let bytes = self.slot.codes().iter().flat_map(|c| {
                    let [r, g, b, _] = c.to_le_bytes();
                    [r, g, b]
                });
                Canvas {
                    width: raster.width() as usize,
                    height: raster.height() as usize,
                    rgb: bytes.collect(),
                }
            }
        }
    }

    fn tile_of(&self, pixel: usize) -> usize {
        let w = self.raster.width() as usize;
        pixel / w / TILE * w.div_ceil(TILE) + pixel % w / TILE
    }

    /// Index into [`RATES`] of every lit pixel.
    fn rates(&self) -> Vec<Option<usize>> {
        let (surfaces, rates) = (self.slot.surfaces().unwrap_or_default(), self.slot.rates().unwrap_or(&[]));
        surfaces
            .iter()
            .enumerate()
            .map(|(i, s)| s.is_lit().then(|| kind_of(rates[self.tile_of(i)])))
            .collect()
    }

    fn errors(&self) -> Vec<Option<f32>> {
        let surfaces = self.slot.surfaces().unwrap_or_default();
        // Some pixel of the tile had no history: there is no estimate.
        let tile = |i: usize| self.tile_errors.get(self.tile_of(i)).copied().flatten().or(Some(f32::NAN));
        surfaces.iter().enumerate().map(|(i, s)| if s.is_lit() { tile(i) } else { None }).collect()
    }
}

/// The six allowed rates with their colours, fine to coarse.
pub(crate) const RATES: [(&str, [u8; 3]); 6] = [
    ("1 x 1", [215, 48, 39]),
    ("1 x 2", [252, 141, 89]),
    ("2 x 1", [254, 224, 144]),
    ("2 x 2", [171, 217, 233]),
    ("2 x 4", [116, 173, 209]),
    ("4 x 2", [69, 117, 180]),
];

/// Index into [`RATES`] of a tile's code (log2 of the sides); beyond the end for what is not allowed.
fn kind_of(code: u32) -> usize {
    match (code & 3, code >> 2 & 3) {
        (0, 0) => 0,
        (0, 1) => 1,
        (1, 0) => 2,
        (1, 1) => 3,
        (1, 2) => 4,
        (2, 1) => 5,
        _ => RATES.len(),
    }
}

/// The larger of both axes' error of \[paper\] eq. 1 of every tile, from a slot that was made for debugging.
pub(crate) fn tile_errors(raster: Raster, method: &Method, slot: &FrameSlot) -> Vec<Option<f32>> {
    let (Some(surfaces), Some(guides), Some(prior)) =
        (slot.surfaces(), slot.guides(), slot.prior_luminance())
    else {
        return Vec::new();
    };
    let (w, h) = (raster.width() as usize, raster.height() as usize);
    let constants = RateConstants {
        t: method.paper.t as f32,
        l: method.paper.l as f32,
        degrees: [method.paper.phi_h_deg as f32, method.paper.phi_q_deg as f32],
    };
    let pixel = |x: usize, y: usize| {
        let i = y * w + x;
        (x < w && y < h && surfaces[i].is_lit()).then(|| PixelGuide {
            luminance: (prior[i] >= 0.0).then_some(prior[i]),
            motion: guides[i].sight.motion,
            size: guides[i].sight.size,
            angle: guides[i].sight.angle,
        })
    };
    let mut out = Vec::new();
    for ty in 0..h.div_ceil(TILE) {
        for tx in 0..w.div_ceil(TILE) {
            let tile = std::array::from_fn(|i| pixel(tx * TILE + i % TILE, ty * TILE + i / TILE));
            out.push(estimate(&tile, &constants).map(|e| e.error[0].max(e.error[1])));
        }
    }
    out
}

/// Reflectance by which a pixel's radiance is divided before it is filtered.
pub(crate) fn albedo_of(g: &Guide) -> [f32; 3] {
    let half = |bits: u32| half_to_f32(bits as u16);
    [half(g.tint.albedo_rg), half(g.tint.albedo_rg >> 16), half(g.tint.albedo_b_and_angle)]
}

/// Angle at the eye between the gaze point and what a pixel shows, degrees.
pub(crate) fn angle_of(g: &Guide) -> f32 {
    half_to_f32((g.tint.albedo_b_and_angle >> 16) as u16)
}

/// IEEE 754 binary16.
fn half_to_f32(bits: u16) -> f32 {
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023));
    let magnitude = match exponent {
        0 => fraction * 2f32.powi(-24),
        31 if fraction > 0.0 => f32::NAN,
        31 => f32::INFINITY,
        _ => (1024.0 + fraction) * 2f32.powi(exponent - 25),
    };
    if bits >> 15 == 1 {
        -magnitude
    } else {
        magnitude
    }
}

/// The factor, 1 at most, with which nothing is brighter than white.
pub(crate) fn scale_to_white(linear: &[Vec3]) -> f32 {
    let greatest = linear.iter().fold(0.0f32, |m, v| m.max(v.max_element())).max(1e-9);
    (1.0 / greatest).min(1.0)
}

/// Linear colours as an sRGB picture.
pub(crate) fn srgb_canvas(raster: Raster, linear: &[Vec3], scale: f32) -> Canvas {
    Canvas { width: raster.width() as usize, height: raster.height() as usize, rgb: to_srgb(linear, scale) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_have_their_values() {
        for (bits, value) in [
            (0x3c00, 1.0),
            (0x3555, 0.333_251_95),
            (0xc000, -2.0),
            (0x0001, 5.960_464_5e-8),
            (0x7bff, 65504.0),
            (0x0000, 0.0),
            (0x7c00, f32::INFINITY),
        ] {
            assert_eq!(half_to_f32(bits), value, "{bits:x}");
        }
        assert!(half_to_f32(0x7e00).is_nan());
    }

    #[test]
    fn every_allowed_rate_has_its_name_and_no_other_has_one() {
        for code in 0..16u32 {
            let (x, y) = (1 << (code & 3), 1 << (code >> 2));
            let name = format!("{x} x {y}");
            let expected = RATES.iter().position(|r| r.0 == name).unwrap_or(RATES.len());
            assert_eq!(kind_of(code), expected, "{name}");
        }
    }
}
