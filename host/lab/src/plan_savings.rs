//! One part of a rig's plan, in and out, into what it costs: time and rays of a frame, and whether a pixel changes.

use super::median::{median, quartiles};
use super::rounding::Rounding;
use super::sequence::{draw, poses_at};
use dpm_common::clock::Stopwatch;
use dpm_render::gpu::Gpu;
use dpm_render::method::{Method, SamplerKind, HISTORY_CAP};
use dpm_render::{FrameSlot, Keep, RenderError, Renderer, RendererSettings};
use dpm_rig::rig::Rig;
use dpm_scene::lobes::*;
use dpm_scene::{Environment, Material, Scene};
use glam::Vec3;
use serde::Serialize;
use std::sync::Arc;

/// Two renderers side by side: without a part and with it.
#[derive(Clone, Debug, Serialize)]
pub struct Saving {
    /// Median time of a frame without the part, milliseconds.
    pub without_ms: f64,
    /// The same with it.
    pub with_ms: f64,
    /// What the part costs, from frames drawn one right after the other: median of their differences, milliseconds.
    pub saved_ms: f64,
    /// Between these lies the middle half of the differences. Where 0 lies between them the part's cost is not told from chance.
    pub saved_middle_half_ms: [f64; 2],
    /// Rays of a frame without the part, on average.
    pub without_rays: f64,
    /// The same with it.
    pub with_rays: f64,
    /// Those of the rays without the part that were walked; the others were proven to meet nothing.
    pub without_walked_rays: f64,
    /// The same with it.
    pub with_walked_rays: f64,
    /// Every code value and every bit of radiance is the same.
    pub pixels_identical: bool,
    /// How the pictures differ.
    pub rounding: Rounding,
    /// RMS difference of the last frame's radiance by its mean.
    pub difference: f64,
    /// The part is there for the picture: with it another one is drawn. Else it is code that nothing calls for, and no pixel may change.
    pub changes_pictures: bool,
}

impl Saving {
    /// The same of a part that is there for the picture.
    pub(super) fn of_pictures(self) -> Self {
        Self { changes_pictures: true, ..self }
    }

    /// The middle half of the differences lies on one side of 0: the part's cost, or gain, stands out from chance.
    pub fn stands_out(&self) -> bool {
        let [low, high] = self.saved_middle_half_ms;
        low > 0.0 || high < 0.0
    }

    /// A pixel changed that must not, on a device that keeps bits, or by more than rounding on one that does not.
    pub fn is_wrong(&self, keeps_bits: bool) -> bool {
        !self.changes_pictures && !self.pixels_identical && (keeps_bits || !self.rounding.is_rounding())
    }
}

/// Whether the device's compiler keeps the bits of a computation from one program to the next: all parts but at most one
/// keep them, and these are three at least. Then the one that does not is wrong, and is no matter of rounding.
pub(super) fn keeps_bits<'a>(savings: impl Iterator<Item = &'a Saving>) -> bool {
    let (mut same, mut differing) = (0, 0);
    for saving in savings.filter(|s| !s.changes_pictures) {
        *if saving.pixels_identical { &mut same } else { &mut differing } += 1;
    }
    differing <= 1 && same >= 3
}

/// Frames timed of each renderer, in turns so that both meet the same disturbances; the first two of each are not counted.
const FRAMES: u32 = 10;
const SETTLE: usize = 2;

/// What puts one part back in that nothing calls for. `None`: nothing can without changing what is drawn.
pub(super) fn keeping(feature: &str, method: &Method) -> Option<Keep> {
    let mut keep = Keep::default();
    let flag = match feature {
        "textures" => &mut keep.needs.textures,
        "normal maps" => &mut keep.needs.normal_maps,
        "alpha mask" => &mut keep.needs.alpha_mask,
        "transmission" => &mut keep.needs.transmission,
        "specular" => &mut keep.needs.specular,
        "diffuse" => &mut keep.needs.diffuse,
        "alpha blend" => &mut keep.needs.alpha_blend,
        "clear coat" => &mut keep.needs.clearcoat,
        "specular colour" => &mut keep.needs.specular_color,
        "anisotropy" => &mut keep.needs.anisotropy,
        "sheen" => &mut keep.needs.sheen,
        "absorption" => &mut keep.needs.absorption,
        "thin film" => &mut keep.needs.iridescence,
        "diffuse transmission" => &mut keep.needs.diffuse_transmission,
        "dispersion" => &mut keep.needs.dispersion,
        "emissive" => &mut keep.needs.emissive,
        "punctual lights" => &mut keep.needs.punctual,
        "firefly clamp" => &mut keep.needs.clamp,
        "tree over bodies" => &mut keep.needs.body_tree,
        "tiles without bodies" => &mut keep.every_tile,
        "pixels out of the light" if method.dpm => &mut keep.every_pixel,
        // Its decisions are read only where the frame's flag says so; without a history it has nothing to decide from.
        "rate map" if method.needs_history() && !method.needs_rates() => &mut keep.rate_map,
        _ => return None,
    };
    *flag = true;
    Some(keep)
}

/// The settings with one part of the picture the other way round. `None`: the method is nothing without the part, or has no place for it.
pub(super) fn flipped(feature: &str, settings: &RendererSettings) -> Option<RendererSettings> {
    let mut all = settings.clone();
    let (method, other) = (&settings.method, &mut all.method);
    match feature {
        "history and reprojection" if method.needs_history() && !method.dpm => {
            // And all that reads it.
            (other.temporal, other.rate_map, other.checkerboard, other.spatial) =
                (false, false, false, false);
        }
        "rate map" if !method.dpm => other.rate_map ^= true,
        "spatial filter taps" => other.spatial ^= true,
        "blue noise and sequences" => {
            other.sampler = match (method.sampler, method.dpm) {
                (SamplerKind::Independent, true) => SamplerKind::Continued,
                (SamplerKind::Independent, false) => SamplerKind::BlueNoise,
                _ => SamplerKind::Independent,
            };
        }
        "temporal blending" => {
            other.temporal ^= true;
            other.history_cap = if other.temporal { HISTORY_CAP } else { 0.0 };
        }
        "checkerboard" if !method.dpm => other.checkerboard ^= true,
        "spp by angle" if !method.dpm => other.spp_by_angle ^= true,
        "allocation by variance" if method.dpm => other.rate_map ^= true,
        "indirect light" if settings.depth > 2 => all.depth = 2,
        _ => return None,
    }
    Some(all)
}

/// The scene without a part that it has, or with an image in place of an even sky. `None`: it is no part of scenes, or this one has none of it.
pub(super) fn changed(feature: &str, scene: &Scene) -> Option<Scene> {
    let mut other = scene.clone();
    let mut every = |change: &dyn Fn(&mut Material)| other.materials.iter_mut().for_each(change);
    match feature {
        "textures" => every(&|m| {
            (m.base_color_texture, m.metallic_roughness_texture, m.normal_texture) = (None, None, None);
            (m.emissive_texture, m.transmission_texture) = (None, None);
            m.lobes.textures_mut().into_iter().for_each(|t| *t = None);
        }),
        "normal maps" => every(&|m| m.normal_texture = None),
        "alpha mask" => every(&|m| (m.alpha_cutoff, m.alpha_blend) = (None, false)),
        "alpha blend" => every(&|m| m.alpha_blend = false),
        "clear coat" => every(&|m| m.lobes.coat = Coat::default()),
        "specular colour" => every(&|m| m.lobes.specular = Specular::default()),
        "anisotropy" => every(&|m| m.lobes.anisotropy = Anisotropy::default()),
        "sheen" => every(&|m| m.lobes.sheen = Sheen::default()),
        "absorption" => every(&|m| m.lobes.absorption = Vec3::ZERO),
        "thin film" => every(&|m| m.lobes.film = Film::default()),
        "diffuse transmission" => {
            every(&|m| m.lobes.diffuse_transmission = DiffuseTransmission::default());
        }
        "dispersion" => every(&|m| m.lobes.dispersion = 0.0),
        "transmission" => every(&|m| (m.transmission, m.transmission_texture) = (0.0, None)),
        "specular" => {
            every(&|m| (m.ior, m.metallic, m.metallic_roughness_texture) = (1.0, 0.0, None));
        }
        "diffuse" => every(&|m| (m.metallic, m.metallic_roughness_texture) = (1.0, None)),
        "emissive" => every(&|m| m.emissive = Vec3::ZERO),
        "punctual lights" => other.lights.clear(),
        "environment" => other.environment = Environment::Constant(Vec3::ZERO),
        "environment image" => other.environment = other_sky(&scene.environment)?,
        _ => return None,
    }
    Some(other)
}

/// An image of an even sky, or the even sky that gives a sphere as much light as an image. `None` without light.
fn other_sky(sky: &Environment) -> Option<Environment> {
    const ROWS: u32 = 32;
    match sky {
        Environment::Constant(light) => (light.max_element() > 0.0).then(|| Environment::Equirect {
            width: 2 * ROWS,
            height: ROWS,
            texels: vec![*light; (2 * ROWS * ROWS) as usize],
            rotation_rad: 0.0,
        }),
        Environment::Equirect { width, height, texels, .. } => {
            let edge = |row: usize| (std::f64::consts::PI * row as f64 / f64::from(*height)).cos();
            let rows = texels.chunks_exact((*width).max(1) as usize).enumerate();
            let mean =
                |row: &[Vec3]| row.iter().map(|t| t.as_dvec3()).sum::<glam::DVec3>() / row.len() as f64;
            let light: glam::DVec3 = rows.map(|(y, row)| 0.5 * (edge(y) - edge(y + 1)) * mean(row)).sum();
            Some(Environment::Constant(light.as_vec3()))
        }
    }
}

/// One of two renderers: its scene, its settings, and what stays in although nothing needs it.
#[derive(Clone, Copy)]
pub(crate) struct Side<'a> {
    /// The rig's, or the rig's with a part changed; the bodies are the rig's.
    pub scene: &'a Scene,
    /// Method and numbers.
    pub settings: &'a RendererSettings,
    /// Spare code.
    pub keep: Keep,
}

/// The same frames by both renderers in turns.
///
/// # Errors
/// The renderer's.
pub(crate) fn compare(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    without: Side<'_>,
    with: Side<'_>,
) -> Result<Saving, RenderError> {
    let open = |side: Side<'_>| Renderer::keeping(gpu, side.scene, side.settings.clone(), side.keep);
    let mut renderers = [open(without)?, open(with)?];
    let mut slots: [FrameSlot; 2] = [renderers[0].create_slot(true)?, renderers[1].create_slot(true)?];
    let (mut times, mut rays, mut walked) = ([Vec::new(), Vec::new()], [0.0f64; 2], [0.0f64; 2]);
    let (mut rounding, mut difference) = (Rounding::default(), 0.0);
    let spp = rig.config.render.spp;
    for k in 0..FRAMES {
        let poses = poses_at(rig, u64::from(k));
        for (i, renderer) in renderers.iter_mut().enumerate() {
            let watch = Stopwatch::start();
            let cost = draw(rig, renderer, &mut slots[i], &poses, k, spp as f32)?;
            let gpu_ns: u64 = cost.pass_ns.iter().sum();
            times[i].push(if gpu_ns > 0 { gpu_ns } else { watch.elapsed_ns() });
            let counters = cost.counters();
            rays[i] += f64::from(counters.rays) / f64::from(FRAMES);
            walked[i] += f64::from(counters.walked_rays()) / f64::from(FRAMES);
        }
        let [a, b] = [0, 1].map(|i: usize| slots[i].radiance().unwrap_or(&[]));
        rounding.add([a, b], [slots[0].codes(), slots[1].codes()]);
        difference = relative_rms(a, b);
    }
    let times = times.map(|t| t.into_iter().skip(SETTLE).map(|ns| ns as f64 * 1e-6).collect::<Vec<f64>>());
    // A disturbance of the machine that lasts meets both of a pair.
    let differences: Vec<f64> =
        times[0].iter().zip(&times[1]).map(|(without, with)| with - without).collect();
    let [without_ms, with_ms] = times.map(median);
    let [without_rays, with_rays] = rays;
    Ok(Saving {
        without_ms,
        with_ms,
        saved_ms: median(differences.iter().copied()),
        saved_middle_half_ms: quartiles(differences),
        without_rays,
        with_rays,
        without_walked_rays: walked[0],
        with_walked_rays: walked[1],
        pixels_identical: rounding.keeps_bits(),
        rounding,
        difference,
        changes_pictures: false,
    })
}

/// RMS difference of the pixels that either picture lights, by the mean of both; 0 of black ones.
fn relative_rms(a: &[[f32; 4]], b: &[[f32; 4]]) -> f64 {
    let (mut squares, mut sum, mut n) = (0.0f64, 0.0f64, 0u32);
    for (a, b) in a.iter().zip(b) {
        let lit = a[..3].iter().chain(&b[..3]).any(|v| *v > 0.0);
        for (a, b) in a[..3].iter().zip(&b[..3]).filter(|_| lit) {
            squares += f64::from(a - b).powi(2);
            sum += 0.5 * f64::from(a + b);
            n += 1;
        }
    }
    if sum > 0.0 {
        (squares * f64::from(n)).sqrt() / sum
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_plan::scene_plan;
    use dpm_render::scene_data::SceneData;
    use dpm_rig::config::{Overrides, RigConfig};
    use dpm_rig::pipeline::renderer_settings;

    fn demo() -> (Vec<&'static str>, Rig) {
        let config = RigConfig::demo(&Overrides { variables: vec![], flags: vec![] }).unwrap();
        let plan = scene_plan(&config, false).unwrap();
        (plan.entries.iter().map(|e| e.feature).collect(), Rig::build(&config, None).unwrap())
    }

    #[test]
    fn each_part_that_can_be_put_back_is_a_part_of_the_plan() {
        let (features, _) = demo();
        let with = |method: &Method| features.iter().filter(|f| keeping(f, method).is_some()).count();
        let history = Method { temporal: true, ..Method::full(1) };
        let mut kept: Vec<_> =
            features.iter().filter_map(|f| Some(format!("{:?}", keeping(f, &history)?))).collect();
        kept.sort();
        kept.dedup();
        assert_eq!(kept.len(), 21, "each puts back another part: {kept:#?}");
        assert_eq!(with(&history), 21, "the switches of SceneNeeds but the environment's, and those of Keep");
        assert_eq!(with(&Method { dpm: true, ..history.clone() }), 22, "what the last frame told");
        assert_eq!(with(&Method::full(1)), 20, "without a history there are no rates");
        assert_eq!(with(&Method { rate_map: true, ..history }), 20, "rates that are read are no spare code");
    }

    #[test]
    fn each_part_of_a_picture_flips_alone_and_back() {
        let (features, rig) = demo();
        let full = Method::full(1);
        let paper =
            Method { rate_map: true, temporal: true, spatial: true, checkerboard: true, ..full.clone() };
        let dpm = Method {
            dpm: true,
            temporal: true,
            history_cap: HISTORY_CAP,
            sampler: SamplerKind::Continued,
            ..full.clone()
        };
        for (method, parts) in [(full, 6), (paper, 7), (dpm, 4)] {
            let settings = RendererSettings { method: method.clone(), depth: 3, ..renderer_settings(&rig) };
            let flips: Vec<_> = features.iter().filter_map(|f| Some((f, flipped(f, &settings)?))).collect();
            assert_eq!(flips.len(), parts + 1, "parts of the method, and indirect light");
            for (i, (f, other)) in flips.iter().enumerate() {
                assert_eq!((other.depth == 2, other.method == method), (i == parts, i == parts), "{f}");
                assert!(flips[..i].iter().all(|(_, b)| (&b.method, b.depth) != (&other.method, other.depth)));
                if other.depth == 2 {
                    assert!(flipped(f, other).is_none(), "nothing is left to take out");
                } else if **f != "history and reprojection" {
                    let back = flipped(f, other).unwrap().method;
                    let same = Method { sampler: method.sampler, history_cap: method.history_cap, ..back };
                    assert_eq!(same, method, "{f}");
                }
            }
        }
    }

    #[test]
    fn an_even_sky_becomes_an_image_of_as_much_light_and_back() {
        let even = Environment::Constant(Vec3::new(0.2, 0.5, 1.0));
        let image = other_sky(&even).unwrap();
        let Environment::Constant(back) = other_sky(&image).unwrap() else { panic!("{image:?}") };
        assert!((back - Vec3::new(0.2, 0.5, 1.0)).abs().max_element() < 1e-6, "{back}");
        assert!(other_sky(&Environment::default()).is_none());
        // Upper half 1, lower half 0; then only the row about the zenith: its cap's share of the sphere is (1 - cos 45 deg) / 2.
        let light = |texels: &[f32]| {
            let sky = Environment::Equirect {
                width: 1,
                height: texels.len() as u32,
                texels: texels.iter().map(|t| Vec3::splat(*t)).collect(),
                rotation_rad: 0.3,
            };
            let Some(Environment::Constant(c)) = other_sky(&sky) else { panic!("{sky:?}") };
            f64::from(c.x)
        };
        assert!((light(&[1.0, 0.0]) - 0.5).abs() < 1e-7);
        assert!((light(&[1.0, 0.0, 0.0, 0.0]) - 0.5 * (1.0 - 0.5f64.sqrt())).abs() < 1e-7);
    }

    #[test]
    fn pictures_differ_by_their_mean_light() {
        let plain = |v: f32| vec![[v, v, v, 1.0]; 4];
        assert_eq!(relative_rms(&plain(2.0), &plain(2.0)), 0.0);
        assert!((relative_rms(&plain(1.0), &plain(3.0)) - 1.0).abs() < 1e-12, "2 by a mean of 2");
        assert_eq!(relative_rms(&plain(0.0), &plain(0.0)), 0.0);
        // Black pixels of both do not thin the difference out.
        let some = |v: f32| [plain(v), plain(0.0)].concat();
        assert!((relative_rms(&some(1.0), &some(3.0)) - 1.0).abs() < 1e-12);
    }

    /// Every part of a scene.
    mod breadth {
        use super::*;

        #[test]
        fn each_part_of_a_scene_is_taken_out_and_nothing_else() {
            let (features, rig) = demo();
            let (scene, needs) = (&rig.scene, |s: &Scene| SceneData::build(s).unwrap().needs);
            let own = needs(scene);
            let changes: Vec<_> = features.iter().filter_map(|f| Some((*f, changed(f, scene)?))).collect();
            assert_eq!(
                changes.len(),
                21 - 2,
                "all parts of scenes but the clamp, which is a setting, and the tree"
            );
            for (feature, other) in changes {
                let other = needs(&other);
                let gone = match feature {
                    "textures" => own.textures && !other.textures,
                    "normal maps" => own.normal_maps && !other.normal_maps && other.textures,
                    "specular" => own.specular && !other.specular && other.diffuse,
                    "diffuse" => own.diffuse && !other.diffuse && other.specular,
                    "emissive" => own.emissive && !other.emissive,
                    "environment" => own.environment_kind == 1 && other.environment_kind == 0,
                    "environment image" => other.environment_kind == 2,
                    _ => other == own,
                };
                assert!(gone, "{feature}: {own:?} becomes {other:?}");
            }
        }
    }
}
