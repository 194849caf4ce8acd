//! What the histories of method dpm are relit by: the sky filtered by the lobes of materials, and the strongest lamps, each as one.
//!
//! A history holds light divided by what sky and lamps would send from its point toward the eye with nothing in the way, so that it need not be
//! exact: what is missing here stays in the history.

use super::{bounded, luminance, SceneData};
use bytemuck::Zeroable;
use dpm_shaders::structs::{self as gpu, Light, SKY_LOBES, SKY_NODES};
use glam::{Vec2, Vec3};
use std::collections::BTreeMap;
use std::f32::consts::PI;

/// The sky is averaged to at most so many columns, and half as many rows, before it is filtered.
const COLUMNS: usize = 64;
/// The most lamps, the strongest first.
const MOST_LAMPS: usize = 8;
/// The most suns: small bright places of the sky that are lamps, because a filtered sky is too coarse for the edge of their light.
const MOST_SUNS: usize = 4;
/// A sun is brighter than so many times the mean of the sky ...
const SUN_BRIGHTER: f32 = 12.0;
/// ... lies within the cosine of this angle about its brightest part ...
const SUN_ACROSS_DEG: f32 = 6.0;
/// ... and gives at least this share of the light of the whole sky.
const SUN_SHARE: f32 = 0.01;

/// The direction of a node of an octahedral map: +y is its middle.
fn node_direction(column: usize, row: usize) -> Vec3 {
    let of = |node: usize| 2.0 * node as f32 / (SKY_NODES - 1) as f32 - 1.0;
    let q = Vec2::new(of(column), of(row));
    let up = 1.0 - q.x.abs() - q.y.abs();
    let beyond = (-up).max(0.0);
    let inward = |v: f32| if v >= 0.0 { v - beyond } else { v + beyond };
    Vec3::new(inward(q.x), up, inward(q.y)).normalize()
}

/// Perceptual roughness of a lobe.
fn roughness(lobe: u32) -> f32 {
    0.25 + 0.125 * lobe as f32
}

/// A part of the sky: its direction, its radiance, its solid angle.
struct SkyPart {
    toward: Vec3,
    radiance: Vec3,
    size: f32,
}

/// The sky in few parts of nearly even size.
fn parts([width, height]: [usize; 2], texels: &[Vec3], rotation: f32) -> Vec<SkyPart> {
    let (columns, rows) = (width.min(COLUMNS), height.min(COLUMNS / 2));
    let cosine = |y: usize| (PI * y as f32 / height as f32).cos();
    let mut all = Vec::with_capacity(columns * rows);
    for row in 0..rows {
        let (y0, y1) = (row * height / rows, (row + 1) * height / rows);
        let up = 0.5 * (cosine(y0) + cosine(y1));
        let across = (1.0 - up * up).max(0.0).sqrt();
        for column in 0..columns {
            let (x0, x1) = (column * width / columns, (column + 1) * width / columns);
            let (mut sum, mut size) = (Vec3::ZERO, 0.0);
            for y in y0..y1 {
                let each = (cosine(y) - cosine(y + 1)) * 2.0 * PI / width as f32;
                sum +=
                    texels[y * width + x0..y * width + x1].iter().map(|t| bounded(*t)).sum::<Vec3>() * each;
                size += each * (x1 - x0) as f32;
            }
            let azimuth = ((x0 + x1) as f32 / (2 * width) as f32 - 0.5) * 2.0 * PI - rotation;
            let toward = Vec3::new(across * azimuth.sin(), up, -across * azimuth.cos());
            all.push(SkyPart { toward, radiance: sum / size.max(1e-20), size });
        }
    }
    all
}

/// What a lobe about a direction weighs light by that comes from `cosine` beside it: GGX seen along its normal, or the cosine lobe.
fn weight(lobe: u32, cosine: f32) -> f32 {
    if cosine <= 0.0 {
        return 0.0;
    }
    if lobe == SKY_LOBES {
        return cosine;
    }
    let a2 = roughness(lobe).powi(4);
    // The half vector's cosine, squared.
    let h2 = 0.5 + 0.5 * cosine;
    let d = h2 * (a2 - 1.0) + 1.0;
    a2 / (d * d) * cosine
}

/// Takes the suns out of the sky: what their parts have beyond the brightest of the rest.
fn take_suns(parts: &mut [SkyPart]) -> Vec<Light> {
    let light = |parts: &[SkyPart]| parts.iter().map(|p| luminance(p.radiance) * p.size).sum::<f32>();
    let whole = light(parts);
    let bright = SUN_BRIGHTER * whole / (4.0 * PI);
    let mut suns = Vec::new();
    for _ in 0..MOST_SUNS {
        let brightest = parts.iter().max_by(|a, b| luminance(a.radiance).total_cmp(&luminance(b.radiance)));
        let Some(middle) = brightest.filter(|p| luminance(p.radiance) > bright).map(|p| p.toward) else {
            break;
        };
        let across = SUN_ACROSS_DEG.to_radians().cos();
        let (mut irradiance, mut toward, mut size) = (Vec3::ZERO, Vec3::ZERO, 0.0);
        for part in
            parts.iter_mut().filter(|p| p.toward.dot(middle) > across && luminance(p.radiance) > bright)
        {
            let beyond = part.radiance * (1.0 - bright / luminance(part.radiance));
            irradiance += beyond * part.size;
            toward += part.toward * luminance(beyond) * part.size;
            size += part.size;
            part.radiance -= beyond;
        }
        if luminance(irradiance) >= SUN_SHARE * whole {
            suns.push(Light {
                kind: gpu::LIGHT_DIRECTIONAL,
                instance: gpu::NO_INSTANCE,
                direction: (-toward.normalize_or(middle)).into(),
                intensity: irradiance.into(),
                // The radius of a disk of their size.
                cone_offset: (size / PI).sqrt(),
                range: 3.0e38,
                ..Light::zeroed()
            });
        }
    }
    suns
}

/// A sky as histories are relit by it.
pub(super) struct RelitSky {
    /// Its suns.
    pub suns: Vec<Light>,
    /// The rest filtered by [`SKY_LOBES`] lobes and then by the cosine lobe, each as an octahedral map of [`SKY_NODES`] squared nodes in world
    /// space: mean radiance over the lobe, so that an even sky stays as it is.
    pub filtered: Vec<[f32; 4]>,
}

/// The sky of so many columns and rows, turned about +Y, as histories are relit by it.
pub(super) fn relit_sky(size: [usize; 2], texels: &[Vec3], rotation: f32) -> RelitSky {
    let mut parts = parts(size, texels, rotation);
    let suns = take_suns(&mut parts);
    RelitSky { suns, filtered: filtered_sky(&parts) }
}

fn filtered_sky(parts: &[SkyPart]) -> Vec<[f32; 4]> {
    let nodes = SKY_NODES as usize;
    let directions: Vec<Vec3> = (0..nodes * nodes).map(|i| node_direction(i % nodes, i / nodes)).collect();
    let map = |lobe: u32| {
        directions.iter().map(move |&direction| {
            let (mut sum, mut weights) = (Vec3::ZERO, 0.0);
            for part in parts {
                let w = weight(lobe, direction.dot(part.toward)) * part.size;
                sum += w * part.radiance;
                weights += w;
            }
            let mean = if weights > 0.0 { sum / weights } else { Vec3::ZERO };
            [mean.x, mean.y, mean.z, 0.0]
        })
    };
    (0..=SKY_LOBES).flat_map(map).collect()
}

impl SceneData {
    /// Lamps for histories beside the suns of the sky, and the mean light; `radius` is that of the scene, and `powers` are those of the lights.
    pub(super) fn add_lamps(&mut self, radius: f32, powers: &[f32]) {
        let spread = 4.0 * PI * PI * (radius * radius).max(1e-6);
        let mean = self.mean_light + powers.iter().sum::<f32>() / spread;
        self.mean_light = if mean.is_finite() && mean > 0.0 { mean } else { 1.0 };
        let mut lamps: Vec<(f32, Light)> = Vec::new();
        let mut bodies: BTreeMap<u32, Glow> = BTreeMap::new();
        for (light, &power) in self.lights.iter().zip(powers) {
            if light.kind == gpu::LIGHT_TRIANGLE {
                bodies.entry(light.instance).or_default().add(&self.triangle(light), power);
            } else {
                lamps.push((power, *light));
            }
        }
        lamps.extend(bodies.iter().map(|(&body, glow)| (glow.power, glow.lamp(body))));
        lamps.sort_by(|a, b| b.0.total_cmp(&a.0));
        self.lamps.extend(lamps.into_iter().take(MOST_LAMPS).map(|(_, lamp)| lamp));
    }

    /// The corners of an emissive triangle, its radiance, and whether both of its sides shine.
    fn triangle(&self, light: &Light) -> Emitter {
        let at = (self.bodies[light.instance as usize].triangle_offset + light.triangle) as usize;
        let corner = |k: usize| {
            let [x, y, z, _] = self.triangles[3 * at + k].map(f32::from_bits);
            Vec3::new(x, y, z)
        };
        let material = &self.materials[self.refs[at].material as usize];
        Emitter {
            corners: [0, 1, 2].map(corner),
            radiance: Vec3::from_array(material.emissive),
            both_sides: material.flags & gpu::MATERIAL_DOUBLE_SIDED != 0,
        }
    }
}

/// A triangle that emits light.
struct Emitter {
    corners: [Vec3; 3],
    radiance: Vec3,
    both_sides: bool,
}

/// The emissive triangles of a body together.
#[derive(Default)]
struct Glow {
    power: f32,
    /// Weighted by power.
    centre: Vec3,
    radiance: Vec3,
    /// The sum of the areas along the normals of triangles that shine on one side.
    facing: Vec3,
    area: f32,
}

impl Glow {
    fn add(&mut self, emitter: &Emitter, power: f32) {
        let [a, b, c] = emitter.corners;
        let along = 0.5 * (b - a).cross(c - a);
        self.power += power;
        self.centre += power * (a + b + c) / 3.0;
        self.radiance += power * emitter.radiance;
        if emitter.both_sides {
            self.area += 2.0 * along.length();
        } else {
            self.facing += along;
            self.area += along.length();
        }
    }

    fn lamp(&self, body: u32) -> Light {
        let scale = if self.power > 0.0 { 1.0 / self.power } else { 0.0 };
        // A convex body shows a quarter of its surface from everywhere.
        let even = 0.25 * (self.area - self.facing.length()).max(0.0);
        let radiance = scale * self.radiance;
        Light {
            kind: gpu::LIGHT_BODY,
            instance: body,
            position: (scale * self.centre).into(),
            direction: self.facing.into(),
            intensity: if luminance(radiance) > 0.0 { radiance.into() } else { [0.0; 3] },
            range: even,
            ..Light::zeroed()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nodes_of_a_map_cover_all_directions_and_agree_along_its_border() {
        let nodes = SKY_NODES as usize;
        let middle = nodes / 2;
        assert!(node_direction(middle, middle).distance(Vec3::Y) < 1e-6);
        assert!(node_direction(nodes - 1, middle).distance(Vec3::X) < 1e-6);
        assert!(node_direction(middle, nodes - 1).distance(Vec3::Z) < 1e-6);
        for k in 0..nodes {
            let (a, b) = (node_direction(0, k), node_direction(0, nodes - 1 - k));
            assert!(a.distance(b) < 1e-6, "{k}: {a} and {b}");
        }
        assert!(node_direction(0, 0).distance(-Vec3::Y) < 1e-6);
    }

    /// Mean radiance: an even sky stays as it is in every lobe.
    #[test]
    fn an_even_sky_is_the_same_in_every_lobe() {
        let colour = Vec3::new(0.3, 2.0, 7.0);
        let sky = relit_sky([40, 20], &vec![colour; 800], 0.7).filtered;
        assert_eq!(sky.len(), ((SKY_LOBES + 1) * SKY_NODES * SKY_NODES) as usize);
        for texel in sky {
            assert!((Vec3::new(texel[0], texel[1], texel[2]) / colour - 1.0).abs().max_element() < 1e-5);
        }
    }

    /// The cosine lobe of a sky with one brighter texel follows the cosine to it, and turns with the sky.
    #[test]
    fn a_bright_place_in_the_cosine_lobe_follows_the_cosine_and_the_rotation() {
        let mut texels = vec![Vec3::ZERO; 64 * 32];
        texels[12 * 64 + 40] = Vec3::ONE;
        let nodes = (SKY_NODES * SKY_NODES) as usize;
        for rotation in [0.0, 1.1] {
            let parts = parts([64, 32], &texels, rotation);
            let sky = filtered_sky(&parts);
            let part = parts.iter().find(|p| p.radiance.x > 0.0).unwrap();
            // By the definition of `environment_position` in light.glsl.
            let azimuth = part.toward.x.atan2(-part.toward.z) + rotation;
            let u = (azimuth / (2.0 * PI) + 0.5).rem_euclid(1.0);
            assert!((u * 64.0 - 40.5).abs() < 1e-3 && (part.toward.y.acos() / PI * 32.0 - 12.5).abs() < 0.05);
            for (i, texel) in sky[SKY_LOBES as usize * nodes..].iter().enumerate() {
                let direction = node_direction(i % SKY_NODES as usize, i / SKY_NODES as usize);
                let exact = direction.dot(part.toward).max(0.0) * part.size / PI;
                assert!(
                    (texel[0] - exact).abs() < 0.01 * part.size / PI,
                    "{direction}: {} and {exact}",
                    texel[0]
                );
            }
        }
    }

    /// A sun and what is left of its sky send together what the sky sends, toward every direction; a sky without a small bright place keeps all.
    #[test]
    fn a_sun_is_a_lamp_and_no_light_is_lost() {
        let mut texels = vec![Vec3::new(0.2, 0.3, 0.5); 64 * 32];
        let even = relit_sky([64, 32], &texels, 0.3);
        assert!(even.suns.is_empty());
        let soft = |x: usize, y: usize| (20..36).contains(&x) && (8..16).contains(&y);
        (0..64 * 32).filter(|i| soft(i % 64, i / 64)).for_each(|i| texels[i] = Vec3::splat(2.0));
        assert!(relit_sky([64, 32], &texels, 0.3).suns.is_empty());
        texels[9 * 64 + 43] = Vec3::new(900.0, 800.0, 600.0);
        texels[9 * 64 + 44] = Vec3::new(450.0, 400.0, 300.0);
        let whole = parts([64, 32], &texels, 0.3);
        let mut rest = parts([64, 32], &texels, 0.3);
        let suns = take_suns(&mut rest);
        assert_eq!(suns.len(), 1);
        let toward = -Vec3::from_array(suns[0].direction);
        assert!(toward.dot(whole[9 * 64 + 43].toward) > 3f32.to_radians().cos());
        let (radius, size) = (suns[0].cone_offset, whole[9 * 64 + 43].size);
        assert!((PI * radius * radius / size - 2.0).abs() < 1e-3);
        let irradiance = |parts: &[SkyPart], n: Vec3| {
            parts.iter().map(|p| p.radiance * (p.size * n.dot(p.toward).max(0.0))).sum::<Vec3>()
        };
        // Where all of the sun is above the horizon; the centre of its light stands for it.
        for n in [
            toward,
            (toward + Vec3::Y).normalize(),
            (toward + 0.8 * toward.any_orthonormal_vector()).normalize(),
        ] {
            let sum = irradiance(&rest, n) + Vec3::from_array(suns[0].intensity) * n.dot(toward);
            assert!((sum / irradiance(&whole, n) - 1.0).abs().max_element() < 2e-3, "{n}: {sum}");
        }
    }

    /// A sphere that shines is as bright from everywhere, and a plate only from before it, by the cosine.
    #[test]
    fn lamps_show_the_area_that_they_have() {
        let plate = Emitter {
            corners: [Vec3::ZERO, Vec3::X, Vec3::Y],
            radiance: Vec3::splat(3.0),
            both_sides: false,
        };
        let mut glow = Glow::default();
        glow.add(&plate, 2.0);
        let lamp = glow.lamp(4);
        assert_eq!((lamp.instance, lamp.range, lamp.intensity), (4, 0.0, [3.0; 3]));
        assert!(Vec3::from_array(lamp.direction).distance(0.5 * Vec3::Z) < 1e-6);
        glow.add(&Emitter { corners: [Vec3::ZERO, Vec3::Y, Vec3::X], ..plate }, 2.0);
        let lamp = glow.lamp(4);
        assert!(Vec3::from_array(lamp.direction).length() < 1e-6 && (lamp.range - 0.25).abs() < 1e-6);
    }
}
