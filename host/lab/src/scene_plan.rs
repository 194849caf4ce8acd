//! `dpm plan`: a rig into what its scene and method need of the renderer, what is left out of it and how, and what that saves.

use super::method_choice::choose;
use super::plan_savings::{changed, compare, flipped, keeping, keeps_bits, Saving, Side};
use super::temporal_light::TemporalLight;
use dpm_common::clock::Stopwatch;
use dpm_device::planes::{Channel, Raster};
use dpm_render::gpu::Gpu;
use dpm_render::method::{Method, SamplerKind};
use dpm_render::scene_data::{SceneData, SceneNeeds};
use dpm_render::warp::LEAST_MOTION_PX;
use dpm_render::{traffic, Keep, Output, RayWalk, RenderError, RendererSettings, Traffic};
use dpm_rig::config::{EffectsConfig, PlanePoses, RenderConfig, RenderMethod, RenderScale, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::method_choice::{self, MethodChoice};
use dpm_rig::pipeline::{renderer_settings, PipelineError};
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::{open_gpu, ray_walk, traced_raster};
use dpm_scene::bvh::{BodyBvh, Refit};
use dpm_scene::{Body, Deformed, Environment, Material, Scene, TextureRef};
use glam::Vec3;
use serde::Serialize;
use std::sync::Arc;

/// One part that not every rig needs.
#[derive(Clone, Debug, Serialize)]
pub struct PlanEntry {
    /// Its name.
    pub feature: &'static str,
    /// Something in the rig calls for it.
    pub needed: bool,
    /// It is left out of what runs. True only for parts that are not needed and were removed.
    pub left_out: bool,
    /// The rig file switched it off; the method would have it.
    pub switched_off: bool,
    /// What calls for it: a material, a light, a key of the rig file; or that nothing does.
    pub why: String,
    /// How it is, or would be, left out.
    pub how: &'static str,
    /// What leaving it out saves or would save; only when measured.
    pub saving: Option<Saving>,
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
    /// Bytes that each pass moves for a pixel, where the GPU packs.
    pub traffic: Vec<Traffic>,
    /// The course of the projector's light, and what a person notices of it; none if another program decides it.
    pub temporal_light: Option<TemporalLight>,
    /// What differs from a run on the rig.
    pub warnings: Vec<String>,
    /// What method "auto" was measured to be; `None` of another method, or without measurement.
    pub method_choice: Option<MethodChoice>,
    /// Who finds what rays meet on the device of a run, and why; `None` where there is no device.
    pub ray_walk: Option<RayWalk>,
}

const BY_CONSTANT: &str = "specialization constant";
const BY_PASS: &str = "pass not recorded";

fn entry(feature: &'static str, why: Option<String>, or: &str, how: &'static str) -> PlanEntry {
    let needed = why.is_some();
    let why = why.unwrap_or_else(|| or.into());
    PlanEntry { feature, needed, left_out: !needed, switched_off: false, why, how, saving: None }
}

/// A part that is always there, needed or not.
fn kept(feature: &'static str, needed: bool, why: String) -> PlanEntry {
    PlanEntry { feature, needed, left_out: false, switched_off: false, why, how: "kept", saving: None }
}

/// The first material on any triangle that calls for something.
fn material(scene: &Scene, calls: impl Fn(&Material) -> bool) -> Option<String> {
    let used = scene.used_materials();
    let mut found = scene.materials.iter().zip(used).filter(|(_, used)| *used).map(|(m, _)| m);
    found.find(|m| calls(m)).map(|m| format!("material \"{}\"", m.name))
}

/// A part of the shaders that materials call for.
struct MaterialPart {
    feature: &'static str,
    /// What the renderer decided.
    need: fn(&SceneNeeds) -> bool,
    /// The materials that are named as the reason.
    calls: fn(&Material) -> bool,
    /// Why the part is left out.
    or: &'static str,
}

#[rustfmt::skip] // a table
const MATERIAL_PARTS: [MaterialPart; 15] = [
    MaterialPart { feature: "normal maps", need: |n| n.normal_maps, calls: |m| m.normal_texture.is_some(), or: "no normal map" },
    MaterialPart { feature: "alpha mask", need: |n| n.alpha_mask, calls: |m| m.alpha_cutoff.is_some() || m.alpha_blend, or: "no material is cut out" },
    MaterialPart { feature: "alpha blend", need: |n| n.alpha_blend, calls: |m| m.alpha_blend, or: "all is there or not" },
    MaterialPart { feature: "transmission", need: |n| n.transmission, calls: |m| m.transmission > 0.0, or: "light passes nothing" },
    MaterialPart { feature: "specular", need: |n| n.specular, calls: |m| m.metallic > 0.0 || m.ior != 1.0, or: "every index is 1 and nothing is metal" },
    MaterialPart { feature: "diffuse", need: |n| n.diffuse, calls: |m| m.metallic < 1.0 || m.metallic_roughness_texture.is_some(), or: "every material is metal" },
    MaterialPart { feature: "clear coat", need: |n| n.clearcoat, calls: |m| m.lobes.coat.factor > 0.0, or: "no material has KHR_materials_clearcoat" },
    MaterialPart { feature: "specular colour", need: |n| n.specular_color, calls: |m| !m.lobes.specular.is_plain(), or: "no material has KHR_materials_specular" },
    MaterialPart { feature: "anisotropy", need: |n| n.anisotropy, calls: |m| m.lobes.anisotropy.strength > 0.0, or: "no material has KHR_materials_anisotropy" },
    MaterialPart { feature: "sheen", need: |n| n.sheen, calls: |m| m.lobes.sheen.color != Vec3::ZERO, or: "no material has KHR_materials_sheen" },
    MaterialPart { feature: "absorption", need: |n| n.absorption, calls: |m| m.lobes.absorption != Vec3::ZERO, or: "no solid absorbs (KHR_materials_volume)" },
    MaterialPart { feature: "thin film", need: |n| n.iridescence, calls: |m| m.lobes.film.factor > 0.0, or: "no material has KHR_materials_iridescence" },
    MaterialPart { feature: "diffuse transmission", need: |n| n.diffuse_transmission, calls: |m| m.lobes.diffuse_transmission.factor > 0.0, or: "no material has KHR_materials_diffuse_transmission" },
    MaterialPart { feature: "dispersion", need: |n| n.dispersion, calls: |m| m.lobes.dispersion > 0.0, or: "no solid has KHR_materials_dispersion" },
    MaterialPart { feature: "emissive", need: |n| n.emissive, calls: |m| m.emissive.max_element() > 0.0, or: "nothing emits" },
];

/// Parts that depend on the scene alone. `needs` is what the renderer decided; the scene only says why.
pub(crate) fn scene_entries(scene: &Scene, needs: &SceneNeeds, clamp: f64) -> Vec<PlanEntry> {
    let part = |feature, need: bool, reason: Option<String>, or| {
        entry(feature, need.then(|| reason.unwrap_or_else(|| "the scene".into())), or, BY_CONSTANT)
    };
    let lights = scene.lights.len();
    let environment = match &scene.environment {
        Environment::Constant(_) => "constant environment",
        Environment::Equirect { .. } => "environment image",
    };
    let is_of_file = |t: &TextureRef| !scene.textures.get(t.texture as usize).is_some_and(|t| t.of_vertices);
    let of_file = material(scene, |m| m.textures().flatten().any(|t| is_of_file(&t)));
    let painted = material(scene, |m| m.textures().any(|t| t.is_some()));
    let textures = match (of_file, painted) {
        (None, Some(name)) => {
            let reason = format!("{name}; they become a texture");
            part("colours of vertices", needs.textures, Some(reason), "no texture on any triangle")
        }
        (of_file, _) => part("textures", needs.textures, of_file, "no texture on any triangle"),
    };
    let of_materials =
        MATERIAL_PARTS.map(|p| part(p.feature, (p.need)(needs), material(scene, p.calls), p.or));
    let of_the_rest = [
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
        part(
            "tree over bodies",
            needs.body_tree,
            Some(format!("{} bodies", scene.bodies.len())),
            "rays ask each of so few bodies",
        ),
        entry(
            "meshes that deform",
            deforming(scene),
            "no animation deforms a mesh",
            "frames in flight share the scene's tables",
        ),
    ];
    std::iter::once(textures).chain(of_materials).chain(of_the_rest).collect()
}

/// Frames whose shapes are worked out to measure how long one takes.
const SHAPES: u64 = 32;

/// The meshes of a scene that deform, and what the host does for a frame of them: vertices are moved, and trees fitted.
fn deforming(scene: &Scene) -> Option<String> {
    let bodies: Vec<_> = scene.bodies.iter().filter_map(|b| b.deforms.as_ref().zip(Some(&b.mesh))).collect();
    let vertices: usize = bodies.iter().map(|(_, mesh)| mesh.positions.len()).sum();
    let triangles: usize = bodies.iter().map(|(_, mesh)| mesh.triangles.len()).sum();
    let mut took_ns = 0;
    for (deforms, mesh) in &bodies {
        let bvh = BodyBvh::build(mesh);
        let (mut nodes, mut refit, mut now) = (bvh.nodes.clone(), Refit::new(&bvh), Deformed::default());
        deforms.at(0, &mut now);
        let watch = Stopwatch::start();
        for shape in 0..SHAPES {
            deforms.at(shape as i64 * 10_000_000, &mut now);
            let corners =
                |place: usize| mesh.triangles[bvh.order[place] as usize].map(|i| now.positions[i as usize]);
            refit.run(&mut nodes, corners);
        }
        took_ns += watch.elapsed_ns() / SHAPES;
    }
    (!bodies.is_empty()).then(|| {
        format!(
            "{} of {vertices} vertices and {triangles} triangles: {:.2} ms of the host in each frame",
            bodies.len(),
            took_ns as f64 * 1e-6
        )
    })
}

/// Parts that depend on the method and its switches. `full` is the method as it is without any switch of the rig file.
pub(crate) fn method_entries(method: &Method, full: &Method, word: &str) -> Vec<PlanEntry> {
    let part = |feature, of: &dyn Fn(&Method) -> bool, key: &str, how| {
        let (on, would) = (of(method), of(full));
        PlanEntry {
            feature,
            needed: on,
            left_out: !on,
            switched_off: would && !on,
            why: match (on, would) {
                (true, true) => format!("method {word}"),
                (true, false) => format!("{key} on"),
                (false, true) => format!("{key} off"),
                (false, false) => format!("method {word} does without"),
            },
            how,
            saving: None,
        }
    };
    let switch = "a bit of the frame's flags, tested per pixel";
    let effects = "render.effects";
    vec![
        part("history and reprojection", &Method::needs_history, effects, BY_PASS),
        part("rate map", &Method::needs_rates, "render.effects.rate_map", BY_PASS),
        part("spatial pass", &Method::needs_spatial, "render.effects.spatial_filter", BY_PASS),
        part("spatial filter taps", &|m| m.spatial, "render.effects.spatial_filter", BY_CONSTANT),
        part("demodulation by albedo", &|m| m.dpm, "render.method", BY_CONSTANT),
        part(
            "blue noise and sequences",
            &|m| m.sampler != SamplerKind::Independent,
            "render.effects.blue_noise",
            BY_CONSTANT,
        ),
        part("temporal blending", &|m| m.temporal, "render.effects.temporal_filter", switch),
        part("checkerboard", &|m| m.checkerboard, "render.effects.checkerboard", switch),
        part("spp by angle", &|m| m.spp_by_angle, "render.effects.spp_by_angle", switch),
        part("allocation by variance", &|m| m.dpm && m.rate_map, "render.effects.rate_map", switch),
    ]
}

fn rig_entries(rig: &Rig) -> Vec<PlanEntry> {
    let config = &rig.config;
    let resting = rig.scene.bodies.iter().filter(|b| b.tracked.is_none() && b.is_whole()).count();
    let planes = rig.schedule.len();
    let mono = rig.schedule.planes().iter().all(|plane| plane.channel == Channel::White);
    let depth = config.render.depth;
    vec![
        PlanEntry {
            feature: "tiles without bodies",
            needed: false,
            left_out: true,
            switched_off: false,
            why: "no ray of theirs can meet a body's bounds".into(),
            how: "tile not listed, decided per frame",
            saving: None,
        },
        entry(
            "pixels out of the light",
            (!config.render.method.takes_a_budget())
                .then(|| format!("method {} does not look back", config.render.method.word())),
            "no light fell there in the last frame, nor within two pixels",
            "no ray in three frames of four while nothing jumps, decided per pixel",
        ),
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
            (!mono).then(|| format!("{planes} planes of red, green and blue")),
            &format!("{planes} planes of one colour"),
            "plane not sent; radiance still has three channels",
        ),
        planes_that_follow(rig),
        entry(
            "reduced raster",
            (config.render.scale != RenderScale::Share(1.0)).then(|| match config.render.scale {
                RenderScale::Share(share) => format!("render.scale = {share}"),
                RenderScale::Auto => "render.scale = \"auto\"".into(),
            }),
            "render.scale = 1",
            "passes prepare, cells, enlarge and edges not recorded, and no buffers for them",
        ),
    ]
}

/// Whether planes are shown where the bodies are at their own instants, and from which speed on.
fn planes_that_follow(rig: &Rig) -> PlanEntry {
    let projector = &rig.config.projector;
    let switched_off = projector.plane_poses == PlanePoses::Frame;
    let groups = renderer_settings(rig).plane_groups;
    let reach = groups.iter().map(|g| g.instant.unsigned_abs()).max().unwrap_or(0);
    let seconds = f64::from(reach) / 65536.0 * rig.rate().slot_len_ns(0) as f64 * 1e-9;
    let tracked =
        rig.scene.bodies.iter().filter(|b| b.tracked.is_some() && b.motion.is_none() && b.projected);
    let to_body = |b: &Body| b.world_from_body_rest.translation.distance(rig.camera.position());
    let nearest = tracked.map(to_body).fold(f64::INFINITY, f64::min);
    // Pixels that the nearest body moves at 1 m/s between the frame's instant and that of the farthest group.
    let moved = rig.camera.fx * seconds / nearest.max(1e-3);
    let why = if switched_off {
        "projector.plane_poses = \"frame\"".to_owned()
    } else if groups.is_empty() {
        "the display holds code values and has no planes".to_owned()
    } else if moved == 0.0 {
        "no body is tracked".to_owned()
    } else {
        format!(
            "{} groups of planes; for bodies at {:.2} m/s or more, and {:.0} pixels around a body at 1 m/s",
            groups.len(),
            LEAST_MOTION_PX / moved,
            moved.ceil() + 1.0
        )
    };
    let needed = !switched_off && moved > 0.0;
    let how = "passes not recorded; empty, decided per frame, while no body moves by a quarter of a pixel";
    PlanEntry {
        feature: "planes that follow",
        needed,
        left_out: !needed,
        switched_off,
        why,
        how,
        saving: None,
    }
}

/// Measures what method "auto" is for this rig on this device, and keeps it for its runs.
fn measured_method(
    config: &RigConfig,
    raster: Option<Raster>,
    gpu: &Arc<Gpu>,
    warnings: &mut Vec<String>,
) -> Result<MethodChoice, Failure> {
    let cache = std::env::temp_dir().join(format!("dpm-methods-{}", std::process::id()));
    let chosen = choose(&|| Rig::build(config, raster), gpu, &cache, &mut |_| ());
    // What cannot be removed lies in a folder for temporary files.
    let _ = std::fs::remove_dir_all(&cache);
    let choice = chosen.map_err(|e| Failure::new(FailureKind::BadInput, e))?;
    let kept = match method_choice::folder() {
        Some(folder) => choice.write(&folder).map_err(|e| e.to_string()),
        None => Err("there is no home directory; set DPM_STATE_DIR".into()),
    };
    match kept {
        Ok(path) => warnings.push(format!("method auto: kept in {}, which runs read", path.display())),
        Err(why) => warnings
            .push(format!("method auto: runs will use dpm, because the choice could not be kept: {why}")),
    }
    Ok(choice)
}

fn gpu_failure(error: impl Into<RenderError>) -> Failure {
    PipelineError::Render(error.into()).into()
}

/// Times frames of `rig` with and without each part of the report that can be put back or taken out.
fn measure_savings(report: &mut PlanReport, rig: &Rig, gpu: &Arc<Gpu>) -> Result<(), Failure> {
    let method = rig.config.render.to_method();
    let (own, lean) = (renderer_settings(rig), Keep::default());
    let mine = Side { scene: &rig.scene, settings: &own, keep: lean };
    let pair = |without: Side<'_>, with: Side<'_>| compare(rig, gpu, without, with).map_err(gpu_failure);
    for e in &mut report.entries {
        let with_code = if e.left_out { keeping(e.feature, &method) } else { None };
        // What no scene of this kind can be drawn without has another scene beside it: of what it needs one without, else one with.
        let scene = changed(e.feature, &rig.scene).filter(|_| e.needed || e.feature == "environment image");
        e.saving = match (with_code, flipped(e.feature, &own), scene) {
            (Some(keep), ..) => {
                let saving = pair(mine, Side { keep, ..mine })?;
                Some(if keep.every_pixel { saving.of_pictures() } else { saving })
            }
            (None, Some(other), _) => {
                let other = Side { settings: &other, ..mine };
                let (without, with) = if e.left_out { (mine, other) } else { (other, mine) };
                Some(pair(without, with)?.of_pictures())
            }
            (None, None, Some(other)) => {
                let other = Side { scene: &other, ..mine };
                let (without, with) = if e.left_out { (mine, other) } else { (other, mine) };
                Some(pair(without, with)?.of_pictures())
            }
            (None, None, None) => None,
        };
    }
    let all = Keep {
        needs: SceneNeeds::default().everything(),
        rate_map: method.needs_history() && !method.needs_rates(),
        every_tile: true,
        // A pixel that only another body's motion uncovers may be lit three frames later.
        every_pixel: false,
        storage_tables: false,
        body_list: false,
    };
    report.together = Some(pair(mine, Side { keep: all, ..mine })?);
    Ok(())
}

/// Plans the rig; `measure` opens the GPU and times frames with and without each part that can be put back or taken out.
///
/// # Errors
/// Bad scene or numbers (exit code 2), no GPU (4), leaving out changed a pixel (1).
pub fn scene_plan(config: &RigConfig, measure: bool) -> Result<PlanReport, Failure> {
    let gpu = if measure { Some(open_gpu(config)?) } else { None };
    let mut warnings = Vec::new();
    let raster = gpu.as_ref().and_then(|gpu| traced_raster(config, gpu, &mut warnings));
    let rig = Rig::build(config, raster)?;
    // What a run would say of the scene: the file's losses and what was changed of it.
    warnings.extend(rig.scene.warnings.iter().cloned());
    let method = config.render.to_method();
    let mut needs = SceneData::build(&rig.scene).map_err(gpu_failure)?.needs;
    needs.clamp = config.render.clamp_indirect > 0.0;
    let word = config.render.method.word();
    let mut entries = scene_entries(&rig.scene, &needs, config.render.clamp_indirect);
    let unswitched = RenderConfig { effects: EffectsConfig::default(), ..config.render.clone() };
    entries.extend(method_entries(&method, &unswitched.to_method(), word));
    entries.extend(rig_entries(&rig));
    let packs = RendererSettings { output: Output::Planes(rig.schedule), ..renderer_settings(&rig) };
    let traffic = traffic(&packs, Keep::default());
    let temporal_light = TemporalLight::of(&config.projector);
    let mut report = PlanReport {
        method: word.to_owned(),
        entries,
        together: None,
        traffic,
        temporal_light,
        warnings,
        method_choice: None,
        ray_walk: gpu.clone().or_else(|| open_gpu(config).ok()).and_then(|gpu| ray_walk(&rig, &gpu).ok()),
    };
    let Some(gpu) = gpu else { return Ok(report) };
    if config.render.method == RenderMethod::Auto {
        report.method_choice = Some(measured_method(config, raster, &gpu, &mut report.warnings)?);
    }
    measure_savings(&mut report, &rig, &gpu)?;
    let keeps_bits = keeps_bits(report.entries.iter().filter_map(|e| e.saving.as_ref()));
    let changed: Vec<&str> = (report.entries.iter())
        .filter(|e| e.saving.as_ref().is_some_and(|s| s.is_wrong(keeps_bits)))
        .map(|e| e.feature)
        .chain(report.together.iter().filter(|s| s.is_wrong(keeps_bits)).map(|_| "all together"))
        .collect();
    if changed.is_empty() {
        return Ok(report);
    }
    Err(Failure::new(FailureKind::CheckFailed, format!("leaving out changed pixels: {}", changed.join(", "))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_render::RayWalker;
    use dpm_rig::config::Overrides;

    fn plan(flags: &[&str]) -> PlanReport {
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let config =
            RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
        scene_plan(&config, false).unwrap_or_else(|e| panic!("{e}"))
    }

    fn is_left_out(plan: &PlanReport, feature: &str) -> bool {
        plan.entries.iter().find(|e| e.feature == feature).unwrap_or_else(|| panic!("{feature}")).left_out
    }

    /// A person reads why the host does not walk, and not that it does.
    #[test]
    fn who_walks_the_rays_is_told_with_its_reason() {
        let told = |tracing: &str, more: &[&str]| {
            let key = format!("render.tracing=\"{tracing}\"");
            let flags = [&[key.as_str()], more].concat();
            plan(&flags).ray_walk.map(|walk| (walk.by, walk.why))
        };
        let Some((by, why)) = told("host", &[]) else { return };
        if why.contains("memory of its own") || by == RayWalker::Device {
            return;
        }
        assert_eq!((by, why), (RayWalker::Host, "render.tracing is \"host\""));
        assert_eq!(told("auto", &[]), Some((RayWalker::Shaders, "render.tracing is not \"host\"")));
        let short = told("host", &["render.depth=1"]);
        assert!(
            short.is_some_and(|(by, why)| by == RayWalker::Shaders && why.contains("no rays")),
            "{short:?}"
        );
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
    fn what_the_rig_file_switches_off_is_told_apart_from_what_is_not_needed() {
        let entry = |flags: &[&str], feature: &str| {
            plan(flags)
                .entries
                .into_iter()
                .find(|e| e.feature == feature)
                .unwrap_or_else(|| panic!("{feature}"))
        };
        let off = entry(&["render.effects.spatial_filter=false"], "spatial filter taps");
        assert!(
            off.left_out && off.switched_off && off.why == "render.effects.spatial_filter off",
            "{off:?}"
        );
        let never = entry(&["render.method=\"full\""], "spatial filter taps");
        assert!(never.left_out && !never.switched_off && never.why.contains("does without"), "{never:?}");
        let on = entry(
            &["render.method=\"miyamoto\"", "render.effects.spatial_filter=true"],
            "spatial filter taps",
        );
        assert!(on.needed && on.why == "render.effects.spatial_filter on", "{on:?}");
        assert!(plan(&[]).entries.iter().all(|e| !e.switched_off));
    }

    /// 1.7 pixels in a frame at 1 m/s, of which 1.1 are between the centre of the light and the last planes: from 0.23 m/s
    /// on.
    #[test]
    fn planes_that_follow_are_needed_where_planes_and_tracked_bodies_are() {
        let entry = |flags: &[&str]| {
            plan(flags)
                .entries
                .into_iter()
                .find(|e| e.feature == "planes that follow")
                .expect("in every plan")
        };
        let own = entry(&[]);
        assert!(own.needed && own.why.starts_with("8 groups of planes; for bodies at 0.2"), "{own:?}");
        let off = entry(&["projector.plane_poses=\"frame\""]);
        assert!(off.left_out && off.switched_off && off.why.contains("plane_poses"), "{off:?}");
        let equal = entry(&["projector.weights=\"equal\""]);
        assert!(equal.needed && equal.why.starts_with("24 groups"), "{equal:?}");
    }

    /// Found in use, O12: the plan named textures of a file that has none, but colours of vertices.
    #[test]
    fn textures_that_no_file_has_are_told_as_colours_of_vertices() {
        let config = RigConfig::demo(&Overrides { variables: vec![], flags: vec![] }).unwrap();
        let mut scene = Rig::build(&config, None).unwrap().scene;
        let needs = SceneData::build(&scene).unwrap().needs;
        let first = |scene: &Scene| scene_entries(scene, &needs, 0.0).remove(0);
        assert_eq!(first(&scene).feature, "textures");
        scene.textures.iter_mut().for_each(|texture| texture.of_vertices = true);
        let entry = first(&scene);
        assert_eq!(entry.feature, "colours of vertices");
        assert!(entry.why.contains("they become a texture"), "{}", entry.why);
    }

    #[test]
    fn materials_that_no_triangle_has_need_nothing() {
        let config = RigConfig::demo(&Overrides { variables: vec![], flags: vec![] }).unwrap();
        let mut scene = Rig::build(&config, None).unwrap().scene;
        let plain = SceneData::build(&scene).unwrap().needs;
        scene.materials.push(Material { transmission: 1.0, alpha_cutoff: Some(0.5), ..Material::default() });
        assert_eq!(SceneData::build(&scene).unwrap().needs, plain);
        let last = scene.materials.len() as u32 - 1;
        scene.bodies[0].mesh.materials[0] = last;
        let needs = SceneData::build(&scene).unwrap().needs;
        assert!(needs.transmission && needs.alpha_mask && !plain.transmission && !plain.alpha_mask);
    }
}
