//! The lights of a scene and its environment, with the tables by which samples find them.

use super::relight::relit_sky;
use super::{bounded, luminance, SceneData};
use bytemuck::Zeroable;
use dpm_scene::{Environment, PunctualKind, Scene};
use dpm_shaders::structs::{self as gpu, Light};
use glam::Vec3;

impl SceneData {
    pub(super) fn add_punctual(&mut self, scene: &Scene, radius: f32, powers: &mut Vec<f32>) {
        use std::f32::consts::PI;
        for l in &scene.lights {
            let intensity = luminance(bounded(l.intensity));
            let (kind, power, scale, offset) = match l.kind {
                PunctualKind::Point => (gpu::LIGHT_POINT, 4.0 * PI * intensity, 0.0, 0.0),
                PunctualKind::Spot { inner, outer } => {
                    // KHR_lights_punctual: linear in the cosine between the two cones, then squared.
                    let scale = 1.0 / (inner.cos() - outer.cos()).max(0.001);
                    (gpu::LIGHT_SPOT, 2.0 * PI * (1.0 - outer.cos()) * intensity, scale, -outer.cos() * scale)
                }
                PunctualKind::Directional => {
                    (gpu::LIGHT_DIRECTIONAL, PI * radius * radius * intensity, 0.0, 0.0)
                }
            };
            if power.is_nan() || power <= 0.0 {
                continue;
            }
            powers.push(power);
            self.lights.push(Light {
                kind,
                instance: l.body.unwrap_or(gpu::NO_INSTANCE),
                position: l.position.into(),
                direction: l.direction.into(),
                intensity: bounded(l.intensity).into(),
                cone_scale: scale,
                cone_offset: offset,
                range: if l.range.is_finite() { l.range } else { 3.0e38 },
                ..Light::zeroed()
            });
            self.needs.punctual = true;
        }
    }

    pub(super) fn add_environment(&mut self, scene: &Scene, radius: f32, light_power: f32) {
        let mean = match &scene.environment {
            Environment::Constant(c) => {
                self.environment_constant = bounded(*c);
                let lit = c.max_element() > 0.0;
                self.needs.environment_kind =
                    if lit { gpu::ENVIRONMENT_CONSTANT } else { gpu::ENVIRONMENT_NONE };
                luminance(bounded(*c))
            }
            Environment::Equirect { width, height, texels, rotation_rad } => {
                self.environment_size = [*width, *height];
                self.environment_rotation = *rotation_rad;
                self.environment_constant = Vec3::ONE;
                let mean = self.tabulate_environment(*width as usize, *height as usize, texels);
                let sky = relit_sky([*width as usize, *height as usize], texels, *rotation_rad);
                (self.filtered_sky, self.lamps) = (sky.filtered, sky.suns);
                self.needs.environment_kind =
                    if mean > 0.0 { gpu::ENVIRONMENT_MAP } else { gpu::ENVIRONMENT_NONE };
                mean
            }
        };
        self.mean_light = mean;
        if self.needs.environment_kind == gpu::ENVIRONMENT_NONE {
            return;
        }
        let power = 4.0 * std::f32::consts::PI.powi(2) * radius * radius * mean;
        self.environment_select =
            if light_power > 0.0 { (power / (power + light_power)).clamp(0.2, 0.8) } else { 1.0 };
    }

    /// Tabulates the texels with the conditional cdf, and the marginal cdf. Returns the mean luminance over the sphere.
    fn tabulate_environment(&mut self, width: usize, height: usize, texels: &[Vec3]) -> f32 {
        let mut row_sums = Vec::with_capacity(height);
        self.environment.clear();
        for y in 0..height {
            let row = &texels[y * width..(y + 1) * width];
            let sum: f64 = row.iter().map(|t| f64::from(luminance(bounded(*t)))).sum();
            let mut run = 0.0f64;
            for (x, t) in row.iter().enumerate() {
                run += f64::from(luminance(bounded(*t)));
                let cdf = if sum > 0.0 { run / sum } else { (x + 1) as f64 / width as f64 };
                let cdf = if x + 1 == width { 1.0 } else { cdf };
                let t = bounded(*t);
                self.environment.push([t.x, t.y, t.z, cdf as f32]);
            }
            let c = |k: usize| (std::f64::consts::PI * k as f64 / height as f64).cos();
            row_sums.push(sum / width as f64 * (c(y) - c(y + 1)));
        }
        let total: f64 = row_sums.iter().sum();
        let mut run = 0.0;
        for (y, s) in row_sums.iter().enumerate() {
            run += s;
            let cdf = if total > 0.0 { run / total } else { (y + 1) as f64 / height as f64 };
            let cdf = if y + 1 == height { 1.0 } else { cdf };
            self.environment.push([cdf as f32, 0.0, 0.0, 0.0]);
        }
        (total / 2.0) as f32
    }

    /// The alias table of \[Vose91\], which finds a light in constant time, with a probability proportional to its power.
    pub(super) fn make_alias_table(&mut self, powers: &[f32]) {
        let n = powers.len();
        let total: f64 = powers.iter().map(|&p| f64::from(p)).sum();
        if n == 0 || total <= 0.0 {
            return;
        }
        let mut scaled: Vec<f64> = powers.iter().map(|&p| f64::from(p) / total * n as f64).collect();
        let (mut small, mut large): (Vec<usize>, Vec<usize>) = (0..n).partition(|&i| scaled[i] < 1.0);
        for (light, &p) in self.lights.iter_mut().zip(powers) {
            light.select = (f64::from(p) / total) as f32;
            light.alias_keep = 1.0;
        }
        for i in 0..n {
            self.lights[i].alias_other = i as u32;
        }
        while let (Some(s), Some(&l)) = (small.pop(), large.last()) {
            self.lights[s].alias_keep = scaled[s] as f32;
            self.lights[s].alias_other = l as u32;
            scaled[l] -= 1.0 - scaled[s];
            if scaled[l] < 1.0 {
                large.pop();
                small.push(l);
            }
        }
    }
}
