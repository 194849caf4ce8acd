//! `dpm plan`: a rig into what its scene and method need of the renderer, what is left out of it and how, and what that saves.

use super::run_rig::{open_gpu, traced_raster};
use super::sequence::{draw, poses_at};
use crate::clock::Stopwatch;
use crate::config::RigConfig;
use crate::failure::{Failure, FailureKind};
use crate::pipeline::{renderer_settings, PipelineError};
use crate::render::method::{Method, SamplerKind};
use crate::render::scene_data::{SceneData, SceneNeeds};
use crate::render::{FrameSlot, RenderError, Renderer};
use crate::rig::Rig;
use crate::scene::{Environment, Material, Scene};
use serde::Serialize;

/// One part that not every rig needs.
#[derive(Clone, Debug, Serialize)]
pub struct PlanEntry {
    /// Its name.
    pub feature: &'static str,
    /// Something in the rig calls for it.
    pub needed: bool,
    /// It is left out of what runs. Never true of what is needed; false for what is not needed but kept.
    pub left_out: bool,
    /// What calls for it: a material, a light, a key of the rig file; or that nothing does.
    pub why: String,
    /// How it is, or would be, left out.
    pub how: &'static str,
    /// What leaving it out saved; only when measured.
    pub saving: Option<Saving>,
}

/// Two renderers side by side: as planned, and with one part compiled in although nothing needs it.
#[derive(Clone, Debug, Serialize)]
pub struct Saving {
    /// Median time of a frame as planned, milliseconds.
    pub without_ms: f64,
    /// The same with the part in.
    pub with_ms: f64,
    /// Every code value and every bit of radiance is the same.
    pub pixels_identical: bool,
}

/// The plan of a rig.
#[derive(Clone, Debug, Serialize)]
pub struct PlanReport {
    /// Method of the rig file.
    pub method: String,
    /// Everything optional.
    pub entries: Vec<PlanEntry>,
    /// All of the scene's parts that are left out, at once; only when measured.
    pub together: Option<Saving>,
    /// What differs from a run on the rig.
    pub warnings: Vec<String>,
}

/// Frames timed of each renderer, in turns so that both meet the same disturbances; the first two of each are not counted.
const FRAMES: u32 = 10;
const SETTLE: usize = 2;

const BY_CONSTANT: &str = "specialization constant";
const BY_PASS: &str = "pass not recorded";

fn entry(feature: &'static str, why: Option<String>, or: &str, how: &'static str) -> PlanEntry {
    let needed = why.is_some();
    PlanEntry { feature, needed, left_out: !needed, why: why.unwrap_or_else(|| or.into()), how, saving: None }
}

/// A part that is always there, needed or not.
fn kept(feature: &'static str, needed: bool, why: String) -> PlanEntry {
    PlanEntry { feature, needed, left_out: false, why, how: "kept", saving: None }
}

/// The first material that calls for something.
fn material(scene: &Scene, calls: impl Fn(&Material) -> bool) -> Option<String> {
    scene.materials.iter().find(|m| calls(m)).map(|m| format!("material \"{}\"", m.name))
}

/// Parts that depend on the scene alone. `needs` is what the renderer decided; the scene only says why.
pub fn scene_entries(scene: &Scene, needs: &SceneNeeds, clamp: f64) -> Vec<PlanEntry> {
    let part = |feature, need: bool, reason: Option<String>, or| {
        entry(feature, need.then(|| reason.unwrap_or_else(|| "the scene".into())), or, BY_CONSTANT)
    };
    let lights = scene.lights.len();
    let environment = match &scene.environment {
        Environment::Constant(_) => "constant environment",
        Environment::Equirect { .. } => "environment image",
    };
    vec![
        part(
            "textures",
            needs.textures,
            Some(format!("{} in the scene file", scene.textures.len())),
            "no texture",
        ),
        part(
            "normal maps",
            needs.normal_maps,
            material(scene, |m| m.normal_texture.is_some()),
            "no normal map",
        ),
        part(
            "alpha mask",
            needs.alpha_mask,
            material(scene, |m| m.alpha_cutoff.is_some()),
            "no material is cut out",
        ),
        part(
            "transmission",
            needs.transmission,
            material(scene, |m| m.transmission > 0.0),
            "light passes nothing",
        ),
        part(
            "specular",
            needs.specular,
            material(scene, |m| m.metallic > 0.0 || m.ior != 1.0),
            "every index is 1 and nothing is metal",
        ),
        part(
            "diffuse",
            needs.diffuse,
            material(scene, |m| m.metallic < 1.0 || m.metallic_roughness_texture.is_some()),
            "every material is metal",
        ),
        part(
            "emissive",
            needs.emissive,
            material(scene, |m| m.emissive.max_element() > 0.0),
            "nothing emits",
        ),
        part(
            "punctual lights",
            needs.punctual,
            Some(format!("{lights} in the scene file")),
            "no point, spot or directional light",
        ),
        part("environment", needs.environment_kind > 0, Some(environment.into()), "black surroundings"),
        part(
            "environment image",
            needs.environment_kind > 1,
            Some(environment.into()),
            "the same radiance from everywhere",
        ),
        part(
            "firefly clamp",
            needs.clamp,
            Some(format!("render.clamp_indirect = {clamp}")),
            "render.clamp_indirect = 0",
        ),
    ]
}

/// Parts that depend on the method and its switches.
pub fn method_entries(method: &Method, word: &str) -> Vec<PlanEntry> {
    let by = |on: bool, key: &str| on.then(|| format!("method {word}, {key} on"));
    let or = |key: &str| format!("method {word} does without, by itself or by {key}");
    let part = |feature, on: bool, key: &str, how| entry(feature, by(on, key), &or(key), how);
    let switch = "a bit of the frame's flags, tested per pixel";
    vec![
        part("history and reprojection", method.needs_history(), "effects", BY_PASS),
        part("rate map", method.needs_rates(), "effects.rate_map", BY_PASS),
        part("spatial pass", method.needs_spatial(), "effects.spatial_filter", BY_PASS),
        part("spatial filter taps", method.spatial, "effects.spatial_filter", BY_CONSTANT),
        part("demodulation by albedo", method.dpm, "render.method", BY_CONSTANT),
        part(
            "blue noise and sequences",
            method.sampler != SamplerKind::Independent,
            "effects.blue_noise",
            BY_CONSTANT,
        ),
        part("temporal blending", method.temporal, "effects.temporal_filter", switch),
        part("checkerboard", method.checkerboard, "effects.checkerboard", switch),
        part("spp by angle", method.spp_by_angle, "effects.spp_by_angle", switch),
        part("allocation by variance", method.dpm && method.rate_map, "effects.rate_map", switch),
    ]
}

fn rig_entries(rig: &Rig) -> Vec<PlanEntry> {
    let config = &rig.config;
    let resting = rig.scene.bodies.iter().filter(|b| b.tracked.is_none()).count();
    let planes = config.projector.planes;
    let mono = planes == 8;
    let depth = config.render.depth;
    vec![
        PlanEntry {
            feature: "tiles without bodies",
            needed: false,
            left_out: true,
            why: "no ray of theirs can meet a body's bounds".into(),
            how: "tile not listed, decided per frame",
            saving: None,
        },
        entry(
            "indirect light",
            (depth > 2).then(|| format!("render.depth = {depth}")),
            &format!("render.depth = {depth}"),
            "the path ends: a uniform, not compiled out",
        ),
        kept(
            "motion of bodies at rest",
            false,
            format!("{resting} bodies never move; their poses are still written every frame"),
        ),
        entry(
            "planes of three colours",
            (!mono).then(|| format!("projector.planes = {planes}")),
            "projector.planes = 8, one colour",
            "plane not sent; radiance still has three channels",
        ),
    ]
}

fn gpu_failure(error: impl Into<RenderError>) -> Failure {
    PipelineError::Render(error.into()).into()
}

/// Plans the rig; `measure` opens the GPU and times each part of the scene that is left out.
///
/// # Errors
/// Bad scene or numbers (exit code 2), no GPU (4), leaving out changed a pixel (1).
pub fn scene_plan(config: &RigConfig, measure: bool) -> Result<PlanReport, Failure> {
    let gpu = if measure { Some(open_gpu(config)?) } else { None };
    let mut warnings = Vec::new();
    let raster = gpu.as_ref().and_then(|gpu| traced_raster(config, gpu, &mut warnings));
    let rig = Rig::build(config, raster)?;
    let method = Method::from_config(&config.render);
    let mut needs = SceneData::build(&rig.scene).map_err(gpu_failure)?.needs;
    needs.clamp = config.render.clamp_indirect > 0.0;
    let word = config.render.method.word();
    let mut entries = scene_entries(&rig.scene, &needs, config.render.clamp_indirect);
    entries.extend(method_entries(&method, word));
    entries.extend(rig_entries(&rig));
    let mut report = PlanReport { method: word.to_owned(), entries, together: None, warnings };
    let Some(gpu) = gpu else { return Ok(report) };
    let open = |keep: SceneNeeds| {
        Renderer::keeping(&gpu, &rig.scene, renderer_settings(&rig), keep).map_err(gpu_failure)
    };
    let lean = SceneNeeds::default();
    for e in report.entries.iter_mut().filter(|e| e.left_out) {
        if let Some(keep) = keeping(e.feature) {
            e.saving = Some(compare(&rig, open(lean)?, open(keep)?)?);
        }
    }
    let all = SceneNeeds::default().everything();
    let together = compare(&rig, open(lean)?, open(all)?)?;
    report.together = Some(together);
    let changed: Vec<&str> = (report.entries.iter())
        .filter(|e| e.saving.as_ref().is_some_and(|s| !s.pixels_identical))
        .map(|e| e.feature)
        .chain(report.together.iter().filter(|s| !s.pixels_identical).map(|_| "all together"))
        .collect();
    if changed.is_empty() {
        return Ok(report);
    }
    Err(Failure::new(FailureKind::CheckFailed, format!("leaving out changed pixels: {}", changed.join(", "))))
}

/// The constants that compile one part in. `None`: what leaves it out is no constant of the scene.
fn keeping(feature: &str) -> Option<SceneNeeds> {
    let mut keep = SceneNeeds::default();
    let flag = match feature {
        "textures" => &mut keep.textures,
        "normal maps" => &mut keep.normal_maps,
        "alpha mask" => &mut keep.alpha_mask,
        "transmission" => &mut keep.transmission,
        "specular" => &mut keep.specular,
        "diffuse" => &mut keep.diffuse,
        "emissive" => &mut keep.emissive,
        "punctual lights" => &mut keep.punctual,
        "firefly clamp" => &mut keep.clamp,
        _ => return None,
    };
    *flag = true;
    Some(keep)
}

/// The same frames by both renderers in turns.
fn compare(rig: &Rig, mut lean: Renderer, mut full: Renderer) -> Result<Saving, Failure> {
    let mut slots: [FrameSlot; 2] =
        [lean.create_slot(true).map_err(gpu_failure)?, full.create_slot(true).map_err(gpu_failure)?];
    let mut times = [Vec::new(), Vec::new()];
    let mut pixels_identical = true;
    let spp = rig.config.render.spp;
    for k in 0..FRAMES {
        let poses = poses_at(rig, u64::from(k));
        for (i, renderer) in [&mut lean, &mut full].into_iter().enumerate() {
            let watch = Stopwatch::start();
            let cost = draw(rig, renderer, &mut slots[i], &poses, k, spp, spp as f32).map_err(gpu_failure)?;
            let gpu_ns: u64 = cost.pass_ns.iter().sum();
            times[i].push(if gpu_ns > 0 { gpu_ns } else { watch.elapsed_ns() });
        }
        let bits = |s: &FrameSlot| -> Vec<[u32; 4]> {
            s.radiance().unwrap_or(&[]).iter().map(|r| r.map(f32::to_bits)).collect()
        };
        pixels_identical &= slots[0].codes() == slots[1].codes() && bits(&slots[0]) == bits(&slots[1]);
    }
    let [without_ms, with_ms] = times.map(|t| median_ms(&t[SETTLE..]));
    Ok(Saving { without_ms, with_ms, pixels_identical })
}

fn median_ms(ns: &[u64]) -> f64 {
    let mut sorted = ns.to_vec();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).map_or(0.0, |&v| v as f64 * 1e-6)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Overrides;

    fn plan(flags: &[&str]) -> PlanReport {
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let config =
            RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
        scene_plan(&config, false).unwrap_or_else(|e| panic!("{e}"))
    }

    fn is_left_out(plan: &PlanReport, feature: &str) -> bool {
        plan.entries.iter().find(|e| e.feature == feature).unwrap_or_else(|| panic!("{feature}")).left_out
    }

    #[test]
    fn the_demo_needs_what_it_is_made_of() {
        let plan = plan(&[]);
        for feature in
            ["textures", "normal maps", "emissive", "environment", "diffuse", "history and reprojection"]
        {
            assert!(!is_left_out(&plan, feature), "{feature}");
        }
        for feature in [
            "alpha mask",
            "transmission",
            "punctual lights",
            "environment image",
            "firefly clamp",
            "rate map",
        ] {
            assert!(is_left_out(&plan, feature), "{feature}");
        }
        assert!(plan.entries.iter().all(|e| !(e.needed && e.left_out)));
    }

    #[test]
    fn the_rig_file_brings_parts_in_and_out() {
        let paper = plan(&["render.method=\"paper\"", "render.clamp_indirect=4"]);
        for feature in ["rate map", "checkerboard", "spp by angle", "firefly clamp"] {
            assert!(!is_left_out(&paper, feature), "{feature}");
        }
        assert!(is_left_out(&paper, "demodulation by albedo"));
        let full = plan(&["render.method=\"full\""]);
        for feature in ["history and reprojection", "rate map", "spatial pass", "blue noise and sequences"] {
            assert!(is_left_out(&full, feature), "{feature}");
        }
    }

    #[test]
    fn each_part_that_can_be_put_back_is_a_part_of_the_plan() {
        let plan = plan(&[]);
        let n = plan.entries.iter().filter(|e| keeping(e.feature).is_some()).count();
        assert_eq!(n, 9, "one for every switch of SceneNeeds but the kind of environment");
    }
}
