//! The scenes and methods whose pipelines are compiled: what a rig file gives, with the constants that the renderer would set.

use dpm_render::albedo_map::AlbedoMap;
use dpm_render::drive::Response;
use dpm_render::pack::Halftone;
use dpm_render::{Keep, Output, RendererPlan, RendererSettings};
use dpm_rig::config::{Overrides, RenderMethod, RigConfig};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::shapes::{add, diffuse, image_sky, scene_of, sky, sphere};
use dpm_scene::Scene;
use glam::Vec3;
use std::sync::Arc;

/// Pipelines that belong together.
pub struct Case {
    /// Name in tables: the scene, and the method unless it is `dpm`.
    pub name: String,
    /// What the renderer is made from.
    pub plan: RendererPlan,
}

/// Two bodies of one diffuse material under an even sky, of 82,000 triangles together: what `rigs/bunny-venus.toml` is for. Of a scene the
/// pipelines depend on its kinds of material and light, and on the depth of its trees.
fn bunny_venus() -> Scene {
    let mut scene = scene_of(sphere(Vec3::ZERO, 0.05, 5, true), diffuse(Vec3::splat(0.7)));
    add(&mut scene, sphere(Vec3::ZERO, 0.1, 6, true), diffuse(Vec3::splat(0.7)));
    scene.environment = sky(1.0);
    scene
}

/// Every part of the shaders, with tables for all that may have one: a sky from a picture, a lens, a response, a flat field, a map of albedo
/// and halftones.
fn with_everything(settings: RendererSettings, camera: ProjectorCamera) -> Result<RendererSettings, String> {
    let lens = Lens::opencv(&[-0.1, 0.01, 1e-3, 1e-3, 1e-3]).map_err(|e| e.to_string())?;
    let mut drive = settings.drive.clone();
    drive.response = Some(Response::gamma([2.2; 3], [0.0; 3]).map_err(|e| e.to_string())?);
    drive.flat_field = Some(Arc::new(vec![[1.0; 3]; settings.raster.pixel_count()]));
    drive.albedo_maps = vec![AlbedoMap::new(1, 1, vec![[0.5; 3]]).map(Arc::new)];
    Ok(RendererSettings {
        drive,
        lens: Some(ProjectorCamera { lens, ..camera }),
        leave_nothing_out: true,
        clamp_indirect: Some(10.0),
        halftone: Some(Halftone { parts: 8, depth: 1, white: false }),
        ..settings
    })
}

/// All cases: the demo, bunny-venus and everything by method `dpm`, and two of them by the paper's, whose passes are others.
///
/// # Errors
/// The rig of the demo cannot be built.
pub fn all() -> Result<Vec<Case>, String> {
    let config = RigConfig::demo(&Overrides::default()).map_err(|e| e.to_string())?;
    let rig = Rig::build(&config, None).map_err(|e| e.to_string())?;
    let mut everything = rig.scene.clone();
    everything.environment = image_sky(1.0);
    let scenes = [("demo", &rig.scene), ("bunny-venus", &bunny_venus()), ("everything", &everything)];
    let mut cases = Vec::new();
    for (scene_name, scene) in scenes {
        for method in [RenderMethod::Dpm, RenderMethod::Paper] {
            // The passes of the paper's method are the same in every scene, apart from what `everything` adds.
            if method == RenderMethod::Paper && scene_name == "bunny-venus" {
                continue;
            }
            let mut render = rig.config.render.clone();
            render.method = method;
            let mut settings = RendererSettings {
                method: render.to_method(),
                output: Output::Planes(rig.schedule),
                ..renderer_settings(&rig)
            };
            if scene_name == "everything" {
                settings = with_everything(settings, rig.camera)?;
            }
            let plan = RendererPlan::new(scene, settings, Keep::default()).map_err(|e| e.to_string())?;
            let by = if method == RenderMethod::Paper { ", paper" } else { "" };
            cases.push(Case { name: format!("{scene_name}{by}"), plan });
        }
    }
    Ok(cases)
}
