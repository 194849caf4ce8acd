//! Emitters into light samples: emissive triangles by power, punctual lights, and the environment by its luminance.
//!
//! One sample of each of the three kinds is taken at a vertex; the expectation is that of choosing one of them.

use super::bvh::Bvh;
use super::texture;
use dpm_scene::{Environment, PunctualKind, Scene};
use glam::{DAffine3, DVec3, Vec3};
use std::f64::consts::PI;

/// Weight of a colour in choices (never in results): the mean of the channels, so that no colour gets none.
fn brightness(c: DVec3) -> f64 {
    (c.x + c.y + c.z) / 3.0
}

/// A list of weights from which one is drawn in proportion.
#[derive(Clone, Debug, Default)]
pub(crate) struct Choice {
    cumulative: Vec<f64>,
}

impl Choice {
    /// From weights, none negative.
    pub(super) fn new(weights: impl Iterator<Item = f64>) -> Self {
        let mut sum = 0.0;
        let cumulative = weights
            .map(|w| {
                sum += w;
                sum
            })
            .collect();
        Self { cumulative }
    }

    /// Sum of the weights.
    pub(super) fn total(&self) -> f64 {
        self.cumulative.last().copied().unwrap_or(0.0)
    }

    /// Probability of entry `i`; 0 when there is nothing to choose.
    pub(super) fn probability(&self, i: usize) -> f64 {
        let below = if i == 0 { 0.0 } else { self.cumulative[i - 1] };
        if self.total() > 0.0 {
            (self.cumulative[i] - below) / self.total()
        } else {
            0.0
        }
    }

    /// The entry for `u` in 0..1 and where in it `u` fell (0..1); `None` when the sum is 0.
    pub(super) fn draw(&self, u: f64) -> Option<(usize, f64)> {
        let total = self.total();
        if total.is_nan() || total <= 0.0 {
            return None;
        }
        let target = u * total;
        // The first entry whose sum exceeds the target has weight above 0.
        let i = self.cumulative.partition_point(|c| *c <= target);
        let i = if i < self.cumulative.len() {
            i
        } else {
            // u so near 1 that u * total rounded up: the last entry that has weight.
            self.cumulative.partition_point(|c| *c < total)
        };
        let below = if i == 0 { 0.0 } else { self.cumulative[i - 1] };
        let share = self.cumulative[i] - below;
        Some((i, ((target - below) / share).clamp(0.0, 1.0 - f64::EPSILON)))
    }
}

/// A triangle chosen as light, and a point on it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TriangleSample {
    /// Triangle of the hierarchy.
    pub triangle: usize,
    /// Barycentric weights of the point.
    pub weights: [f64; 3],
    /// Per square metre.
    pub pdf_area: f64,
}

/// Punctual light in world space.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WorldLight {
    kind: PunctualKind,
    intensity: DVec3,
    position: DVec3,
    direction: DVec3,
    range: f64,
}

/// Light arriving at a point from a light that has no extent.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arriving {
    /// Unit direction toward the light.
    pub l: DVec3,
    /// Distance to it; infinite for directional light.
    pub distance: f64,
    /// Irradiance on a plane facing it, W/m^2.
    pub irradiance: DVec3,
}

impl WorldLight {
    /// What arrives at `x`; `None` outside the cone or range, or at the light itself.
    pub(super) fn arriving(&self, x: DVec3) -> Option<Arriving> {
        if self.kind == PunctualKind::Directional {
            return Some(Arriving {
                l: -self.direction,
                distance: f64::INFINITY,
                irradiance: self.intensity,
            });
        }
        let way = self.position - x;
        let distance = way.length();
        let l = way.try_normalize()?;
        if distance >= self.range {
            return None;
        }
        let mut factor = 1.0 / (distance * distance);
        if self.range.is_finite() {
            factor *= (1.0 - (distance / self.range).powi(4)).clamp(0.0, 1.0);
        }
        if let PunctualKind::Spot { inner, outer } = self.kind {
            let (inner, outer) = (f64::from(inner).cos(), f64::from(outer).cos());
            let cos = -l.dot(self.direction);
            let edge = ((cos - outer) / (inner - outer).max(1e-3)).clamp(0.0, 1.0);
            factor *= edge * edge;
        }
        (factor > 0.0 && factor.is_finite()).then(|| Arriving {
            l,
            distance,
            irradiance: self.intensity * factor,
        })
    }
}

/// Light from infinity.
#[derive(Clone, Debug)]
pub(crate) enum Sky {
    /// Even; found by scattering alone.
    Constant(DVec3),
    /// An image.
    Image(SkyImage),
}

/// A latitude-longitude image with its sampling tables.
#[derive(Clone, Debug)]
pub(crate) struct SkyImage {
    width: usize,
    height: usize,
    texels: Vec<Vec3>,
    rotation: f64,
    rows: Choice,
    columns: Vec<Choice>,
}

impl SkyImage {
    /// Tables for an image of `width * height` texels, each of even radiance.
    pub(super) fn new(width: usize, height: usize, texels: Vec<Vec3>, rotation: f64) -> Self {
        let columns: Vec<Choice> = texels
            .chunks_exact(width)
            .map(|row| Choice::new(row.iter().map(|t| brightness(t.as_dvec3()))))
            .collect();
        let rows = Choice::new((0..height).map(|y| columns[y].total() * band(y, height)));
        Self { width, height, texels, rotation, rows, columns }
    }

    /// Radiance from a direction (unit, world).
    pub(super) fn radiance(&self, direction: DVec3) -> DVec3 {
        let (x, y) = self.texel(direction);
        self.texels[y * self.width + x].as_dvec3()
    }

    /// A direction by brightness and its density per steradian; `None` for a black sky.
    pub(super) fn sample(&self, u: [f64; 2]) -> Option<(DVec3, f64)> {
        let (y, fy) = self.rows.draw(u[1])?;
        let (x, fx) = self.columns[y].draw(u[0])?;
        let azimuth = ((x as f64 + fx) / self.width as f64 - 0.5) * 2.0 * PI;
        // Even in area within the row: even in the cosine of the polar angle.
        let (top, bottom) =
            ((PI * y as f64 / self.height as f64).cos(), (PI * (y + 1) as f64 / self.height as f64).cos());
        let cos = top + (bottom - top) * fy;
        let sin = (1.0 - cos * cos).max(0.0).sqrt();
        let local = DVec3::new(sin * azimuth.sin(), cos, -sin * azimuth.cos());
        let direction = glam::DQuat::from_rotation_y(self.rotation) * local;
        Some((direction, self.texel_pdf(x, y)))
    }

    /// Density of [`Self::sample`], per steradian.
    pub(crate) fn pdf(&self, direction: DVec3) -> f64 {
        let (x, y) = self.texel(direction);
        self.texel_pdf(x, y)
    }

    fn texel_pdf(&self, x: usize, y: usize) -> f64 {
        let solid_angle = 2.0 * PI / self.width as f64 * band(y, self.height);
        self.rows.probability(y) * self.columns[y].probability(x) / solid_angle
    }

    /// Column and row of a direction.
    fn texel(&self, direction: DVec3) -> (usize, usize) {
        let d = glam::DQuat::from_rotation_y(-self.rotation) * direction;
        let u = 0.5 + d.x.atan2(-d.z) / (2.0 * PI);
        let v = d.x.hypot(d.z).atan2(d.y) / PI;
        let index = |x: f64, n: usize| ((x * n as f64) as usize).min(n - 1);
        (index(u, self.width), index(v, self.height))
    }
}

/// Height of a row on the unit sphere: difference of the cosines of its edges.
fn band(y: usize, height: usize) -> f64 {
    let edge = |y: usize| (PI * y as f64 / height as f64).cos();
    edge(y) - edge(y + 1)
}

/// All that emits.
#[derive(Clone, Debug)]
pub(super) struct Lights {
    triangles: Vec<(usize, f64)>,
    choice: Choice,
    /// Density per square metre of every triangle of the hierarchy; 0 for what is no light.
    pdf_area: Vec<f64>,
    punctual: Vec<WorldLight>,
    punctual_choice: Choice,
    /// Light from infinity.
    pub sky: Sky,
}

/// Up to so many punctual lights are all evaluated; of more, one is drawn.
const ALL_PUNCTUAL: usize = 16;

impl Lights {
    /// Gathers the emitters of a scene.
    pub(super) fn new(scene: &Scene, poses: &[DAffine3], bvh: &Bvh) -> Self {
        let power: Vec<f64> = (scene.materials.iter())
            .map(|m| {
                let mean = m.emissive_texture.map_or(DVec3::ONE, |r| {
                    scene.textures.get(r.texture as usize).map_or(DVec3::ONE, |t| texture::mean(t).truncate())
                });
                brightness(m.emissive.as_dvec3() * mean) * if m.double_sided { 2.0 } else { 1.0 }
            })
            .collect();
        let triangles: Vec<(usize, f64)> = (bvh.triangles().iter().enumerate())
            .filter_map(|(i, t)| {
                let mesh = &scene.bodies[t.body as usize].mesh;
                let power = power[mesh.materials[t.index as usize] as usize];
                let area = 0.5 * (t.p[1] - t.p[0]).cross(t.p[2] - t.p[0]).length();
                (power > 0.0 && area > 0.0).then_some((i, area * power))
            })
            .collect();
        let choice = Choice::new(triangles.iter().map(|t| t.1));
        let mut pdf_area = vec![0.0; bvh.triangles().len()];
        for (k, (i, _)) in triangles.iter().enumerate() {
            let p = bvh.triangle(*i).p;
            pdf_area[*i] = choice.probability(k) / (0.5 * (p[1] - p[0]).cross(p[2] - p[0]).length());
        }
        let punctual: Vec<WorldLight> = (scene.lights.iter())
            .map(|light| {
                let pose =
                    light.body.and_then(|b| poses.get(b as usize)).copied().unwrap_or(DAffine3::IDENTITY);
                WorldLight {
                    kind: light.kind,
                    intensity: light.intensity.as_dvec3(),
                    position: pose.transform_point3(light.position.as_dvec3()),
                    direction: pose.transform_vector3(light.direction.as_dvec3()).normalize_or_zero(),
                    range: f64::from(light.range),
                }
            })
            .collect();
        let punctual_choice = Choice::new(punctual.iter().map(|l| brightness(l.intensity)));
        let sky = match &scene.environment {
            Environment::Constant(l) => Sky::Constant(l.as_dvec3()),
            Environment::Equirect { width, height, texels, rotation_rad } => {
                let (w, h) = (*width as usize, *height as usize);
                if w == 0 || h == 0 || texels.len() < w * h {
                    Sky::Constant(DVec3::ZERO)
                } else {
                    Sky::Image(SkyImage::new(w, h, texels[..w * h].to_vec(), f64::from(*rotation_rad)))
                }
            }
        };
        Self { triangles, choice, pdf_area, punctual, punctual_choice, sky }
    }

    /// A point on an emissive triangle, by power; `None` when nothing emits.
    pub(crate) fn sample_triangle(&self, choose: f64, u: [f64; 2]) -> Option<TriangleSample> {
        let triangle = self.triangles[self.choice.draw(choose)?.0].0;
        let r = u[0].sqrt();
        let weights = [1.0 - r, r * (1.0 - u[1]), r * u[1]];
        Some(TriangleSample { triangle, weights, pdf_area: self.pdf_area[triangle] })
    }

    /// Density per square metre with which [`Self::sample_triangle`] finds points of a triangle.
    pub(crate) fn triangle_pdf(&self, triangle: usize) -> f64 {
        self.pdf_area[triangle]
    }

    /// Visits what arrives from punctual lights: all of them, or one of many with its irradiance divided by its probability.
    pub(super) fn punctual(&self, x: DVec3, choose: f64, mut visit: impl FnMut(Arriving)) {
        if self.punctual.len() <= ALL_PUNCTUAL {
            self.punctual.iter().filter_map(|l| l.arriving(x)).for_each(visit);
        } else if let Some((i, _)) = self.punctual_choice.draw(choose) {
            if let Some(mut a) = self.punctual[i].arriving(x) {
                a.irradiance /= self.punctual_choice.probability(i);
                visit(a);
            }
        }
    }

    /// Radiance from infinity.
    pub(crate) fn sky_radiance(&self, direction: DVec3) -> DVec3 {
        match &self.sky {
            Sky::Constant(l) => *l,
            Sky::Image(image) => image.radiance(direction),
        }
    }

    /// Density with which light sampling finds a direction of the sky, per steradian.
    pub(crate) fn sky_pdf(&self, direction: DVec3) -> f64 {
        match &self.sky {
            Sky::Constant(_) => 0.0,
            Sky::Image(image) => image.pdf(direction),
        }
    }
}
