//! Thin films, sheen, and what layers let through, in f64: the parts of a material that `docs/RENDERING.md`, "Lobes of
//! materials", adds to metal, dielectric and transmission.

use super::microfacet::{fresnel_dielectric, fresnel_schlick, sample_visible_normal};
use dpm_scene::albedo_table::{AlbedoTable, LEAST_SHEEN_ALPHA};
use dpm_scene::lobes::Coat;
use glam::{DMat3, DVec2, DVec3};
use std::f64::consts::PI;
use std::sync::LazyLock;

/// The albedo of every clear coat.
pub(super) static COAT: LazyLock<AlbedoTable> = LazyLock::new(|| AlbedoTable::new(Coat::IOR));
/// The albedo of facets that reflect everything.
pub(super) static WHITE: LazyLock<AlbedoTable> = LazyLock::new(AlbedoTable::white);
/// The albedo of a white sheen, as fitted and as it is.
pub(super) static SHEEN: LazyLock<[AlbedoTable; 2]> = LazyLock::new(AlbedoTable::sheen);

/// Widths of a brushed surface are at least this.
pub(super) const LEAST_BRUSHED_ALPHA: f64 = 1e-3;

/// Values of the lobes at one point, textures applied.
#[derive(Clone, Copy, Debug)]
pub struct LobesHere {
    /// Share of the surface that is there.
    pub coverage: f64,
    /// Strength of the clear coat.
    pub coat: f64,
    /// GGX width of the coat.
    pub coat_alpha: f64,
    /// GGX widths along and across the tangent.
    pub brushed: Option<DVec2>,
    /// Strength of the dielectric reflection.
    pub specular: f64,
    /// Its colour at normal incidence.
    pub specular_color: DVec3,
    /// Colour of the sheen.
    pub sheen: DVec3,
    /// Its width.
    pub sheen_alpha: f64,
    /// Strength of the thin film.
    pub film: f64,
    /// Its index.
    pub film_ior: f64,
    /// Its thickness, nanometres.
    pub film_nm: f64,
    /// Share of the diffuse light that leaves on the other side.
    pub shine: f64,
    /// Its colour.
    pub shine_color: DVec3,
    /// Absorption of the solid, per metre.
    pub absorption: DVec3,
    /// 20 over Abbe's number.
    pub dispersion: f64,
}

impl LobesHere {
    /// The index of a channel (0 to 2) of a solid that disperses.
    pub(super) fn index_of_channel(&self, ior: f64, channel: usize) -> f64 {
        let half_spread = (ior - 1.0) * 0.025 * self.dispersion;
        (ior + half_spread * (channel as f64 - 1.0)).max(super::surface::STRAIGHT_BELOW_IOR)
    }

    /// What coat and sheen let through of emitted light at a cosine to the geometric normal.
    pub(super) fn over_emission(&self, cos: f64) -> f64 {
        let cos = cos.abs();
        (1.0 - self.coat_albedo(cos)) * (1.0 - self.sheen_albedo(cos))
    }

    /// What the coat reflects of light at a cosine.
    pub(super) fn coat_albedo(&self, cos: f64) -> f64 {
        if self.coat == 0.0 {
            return 0.0;
        }
        self.coat * COAT.directional(cos, table_row(self.coat_alpha))
    }

    /// The same on average.
    pub(super) fn coat_average(&self) -> f64 {
        self.coat * COAT.average(table_row(self.coat_alpha))
    }

    /// What the sheen keeps of light at a cosine: by its strongest channel.
    pub(super) fn sheen_albedo(&self, cos: f64) -> f64 {
        if self.sheen == DVec3::ZERO {
            return 0.0;
        }
        self.sheen.max_element() * SHEEN[1].directional(cos, self.sheen_alpha)
    }
}

/// A mirror reflects by Fresnel's law, which is row 0 of the table.
pub(super) fn table_row(alpha: f64) -> f64 {
    if alpha < super::bsdf::DELTA_BELOW_ALPHA {
        0.0
    } else {
        alpha
    }
}

/// What is left of light after a way in a medium.
pub(super) fn left_by(absorption: DVec3, way: f64) -> DVec3 {
    // Nothing absorbed over an infinite way is nothing.
    let of = |sigma: f64| if sigma == 0.0 { 1.0 } else { (-sigma * way).exp() };
    DVec3::from(absorption.to_array().map(of))
}

/// D and V times (n.l) of a white sheen \[Estevez17\]: local directions above the surface.
pub(crate) fn sheen(v: DVec3, l: DVec3, alpha: f64) -> f64 {
    let alpha = alpha.max(LEAST_SHEEN_ALPHA);
    let Some(h) = (v + l).try_normalize() else { return 0.0 };
    let sine = h.truncate().length();
    let density = (2.0 + alpha.recip()) * sine.powf(alpha.recip()) / (2.0 * PI);
    // At grazing angles the fit would send out more than it gets.
    let most = SHEEN[0].directional(v.z, alpha).max(SHEEN[0].directional(l.z, alpha)).max(1.0);
    density / (most * 4.0 * v.z * (1.0 + shadow_of_fibres(v.z, alpha) + shadow_of_fibres(l.z, alpha)))
}

fn shadow_of_fibres(cos: f64, alpha: f64) -> f64 {
    // Fits for widths of 1 and 0.
    let rough = [21.5473, 3.82987, 0.19823, -1.97760, -4.32054];
    let fine = [25.3245, 3.32435, 0.16801, -1.27393, -4.85967];
    let share = (1.0 - alpha).powi(2);
    let [a, b, c, d, e]: [f64; 5] = std::array::from_fn(|i| rough[i] * (1.0 - share) + fine[i] * share);
    let fit = |x: f64| a / (1.0 + b * x.powf(c)) + d * x + e;
    let exponent = if cos < 0.5 { fit(cos) } else { 2.0 * fit(0.5) - fit(1.0 - cos) };
    exponent.exp()
}

fn f0_between(a: f64, b: f64) -> f64 {
    ((a - b) / (a + b)).powi(2)
}

/// Reflectance at normal incidence of a dielectric with strength and colour of its own.
pub(super) fn f0_of(ior: f64, lobes: &LobesHere) -> DVec3 {
    (lobes.specular_color * f0_between(ior, 1.0)).min(DVec3::ONE) * lobes.specular
}

/// Fresnel reflectance of the dielectric at `cos` on the side from which it has the relative index `eta`, with strength and colour.
/// Total reflection is total.
pub(super) fn tinted_fresnel(ior: f64, eta: f64, cos: f64, lobes: &LobesHere) -> DVec3 {
    let plain = fresnel_dielectric(eta, cos);
    if plain >= 1.0 {
        return DVec3::ONE;
    }
    if ior == 1.0 {
        return DVec3::ZERO;
    }
    let f0 = f0_between(ior, 1.0);
    let rise = ((plain - f0) / (1.0 - f0)).clamp(0.0, 1.0);
    if lobes.specular == 1.0 && lobes.specular_color == DVec3::ONE {
        return DVec3::splat(plain);
    }
    let color = (lobes.specular_color * f0).min(DVec3::ONE);
    (color + (DVec3::ONE - color) * rise) * lobes.specular
}

/// By how much the film changes the reflectance of facets of base reflectance `f0` at a cosine outside.
pub(super) fn film_change(f0: DVec3, cos: f64, lobes: &LobesHere) -> DVec3 {
    if lobes.film == 0.0 {
        return DVec3::ZERO;
    }
    let with = film_reflectance(f0, lobes.film_ior, lobes.film_nm, cos);
    (with - fresnel_schlick(f0, cos)) * lobes.film
}

/// What the film changes of the light that facets of a width reflect toward a cosine, in its strongest channel: the mean of four
/// facets that light from there sees.
pub(super) fn film_change_of(f0: DVec3, cos: f64, width: f64, lobes: &LobesHere) -> f64 {
    let v = DVec3::new((1.0 - cos * cos).max(0.0).sqrt(), 0.0, cos);
    let seen = [[0.125, 0.25], [0.125, 0.75], [0.375, 0.25], [0.375, 0.75]];
    let of = |u| {
        let h = sample_visible_normal(v, width.max(1e-4), u).unwrap_or(DVec3::Z);
        film_change(f0, v.dot(h).clamp(0.0, 1.0), lobes)
    };
    (seen.map(of).into_iter().sum::<DVec3>() / 4.0).max_element()
}

/// \[Belcour17\] with the constants of KHR_materials_iridescence.
pub(crate) fn film_reflectance(f0: DVec3, ior: f64, nm: f64, cos: f64) -> DVec3 {
    let t = (nm / 0.03).clamp(0.0, 1.0);
    let index = 1.0 + (ior - 1.0) * t * t * (3.0 - 2.0 * t);
    let inside2 = 1.0 - (1.0 - cos * cos) / (index * index);
    if inside2 < 0.0 {
        return DVec3::ONE;
    }
    let inside = inside2.sqrt();
    // Schlick's law would let no interface at all reflect everything at grazing angles.
    let top = fresnel_dielectric(index, cos);
    let way_m = 2.0 * index * nm * 1e-9 * inside;
    let mut out = DVec3::ZERO;
    for channel in 0..3 {
        let root = f0[channel].clamp(0.0, 0.9999).sqrt();
        let base_index = (1.0 + root) / (1.0 - root);
        let bottom = fresnel_schlick(DVec3::splat(f0_between(base_index, index)), inside).x;
        let shift = PI + if base_index < index { PI } else { 0.0 };
        let both = (top * bottom).min(0.9999);
        let through = (1.0 - top).powi(2) * bottom / (1.0 - both);
        let mut sum = top + through;
        for order in 1..=2 {
            let order = f64::from(order);
            let amplitude = (through - (1.0 - top)) * both.sqrt().powf(order);
            sum += 2.0 * amplitude * sensitivity(order * way_m, order * shift)[channel];
        }
        out[channel] = sum.clamp(0.0, 1.0);
    }
    out
}

/// Linear sRGB of an eye's response to interference of an optical path difference (metres) and a phase.
fn sensitivity(way_m: f64, shift: f64) -> DVec3 {
    let phase = 2.0 * PI * way_m;
    let bell = |height: f64, place: f64, variance: f64| {
        height
            * (2.0 * PI * variance).sqrt()
            * (place * phase + shift).cos()
            * (-variance * phase * phase).exp()
            / 1.0685e-7
    };
    let xyz = DVec3::new(
        bell(5.4856e-13, 1.6810e6, 4.3278e9) + bell(9.7470e-14, 2.2399e6, 4.5282e9),
        bell(4.4201e-13, 1.7953e6, 9.3046e9),
        bell(5.2481e-13, 2.2084e6, 6.6121e9),
    );
    let rows = DMat3::from_cols(
        DVec3::new(3.2404542, -0.9692660, 0.0556434),
        DVec3::new(-1.5371385, 1.8760108, -0.2040259),
        DVec3::new(-0.4985314, 0.0415560, 1.0572252),
    );
    rows * xyz
}
