//! The scenes and methods whose pipelines are compiled: what a rig file gives, with the constants that the renderer would set.

use dpm_render::albedo_map::AlbedoMap;
use dpm_render::drive::Response;
use dpm_render::pack::Halftone;
use dpm_render::scene_data::SceneNeeds;
use dpm_render::{Keep, Output, RendererPlan, RendererSettings, Scale};
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

/// Name of the case that has every lobe of glTF's extensions at once, which no scene has. The page shows it apart.
pub const EVERY_LOBE: &str = "every lobe";
/// Name of the case that has the commonest of them alone.
pub const COAT: &str = "demo with a clear coat";
/// Name of the case of which fewer pixels are traced than the panel has.
pub const REDUCED: &str = "demo at half the raster";

/// Code of the tracer for every kind of material but the lobes of glTF's extensions.
fn all_but_lobes() -> SceneNeeds {
    SceneNeeds {
        clearcoat: false,
        specular_color: false,
        anisotropy: false,
        sheen: false,
        absorption: false,
        alpha_blend: false,
        iridescence: false,
        diffuse_transmission: false,
        dispersion: false,
        ..SceneNeeds::default().everything()
    }
}

/// Everything that a rig may add to a scene, with tables for all that may have one: a lens, a response, a flat field, a map of albedo and
/// halftones.
fn with_everything(settings: RendererSettings, camera: ProjectorCamera) -> Result<RendererSettings, String> {
    let lens = Lens::opencv(&[-0.1, 0.01, 1e-3, 1e-3, 1e-3]).map_err(|e| e.to_string())?;
    let mut drive = settings.drive.clone();
    drive.response = Some(Response::gamma([2.2; 3], [0.0; 3]).map_err(|e| e.to_string())?);
    drive.flat_field = Some(Arc::new(vec![[1.0; 3]; settings.raster.pixel_count()]));
    drive.albedo_maps = vec![AlbedoMap::new(1, 1, vec![[0.5; 3]]).map(Arc::new)];
    Ok(RendererSettings {
        drive,
        lens: Some(ProjectorCamera { lens, ..camera }),
        clamp_indirect: Some(10.0),
        halftone: Some(Halftone { parts: 8, depth: 1, low: 0, white: false }),
        ..settings
    })
}

/// All cases: the demo, the demo at half the raster, bunny-venus and everything by method `dpm`, and two of them by the paper's, whose passes are others; then the demo with
/// a clear coat, and everything with every lobe.
///
/// # Errors
/// The rig of the demo cannot be built.
pub fn all() -> Result<Vec<Case>, String> {
    let config = RigConfig::demo(&Overrides::default()).map_err(|e| e.to_string())?;
    let rig = Rig::build(&config, None).map_err(|e| e.to_string())?;
    let mut full = rig.scene.clone();
    full.environment = image_sky(1.0);
    let (demo, bunny_venus) = (&rig.scene, &bunny_venus());
    let none = SceneNeeds::default();
    let coat = SceneNeeds { clearcoat: true, ..none };
    // The passes of the paper's method are the same in every scene, apart from what `everything` adds.
    let cases = [
        ("demo", demo, none, RenderMethod::Dpm),
        ("demo, paper", demo, none, RenderMethod::Paper),
        ("bunny-venus", bunny_venus, none, RenderMethod::Dpm),
        (REDUCED, demo, none, RenderMethod::Dpm),
        ("everything", &full, all_but_lobes(), RenderMethod::Dpm),
        ("everything, paper", &full, all_but_lobes(), RenderMethod::Paper),
        (COAT, demo, coat, RenderMethod::Dpm),
        (EVERY_LOBE, &full, none.everything(), RenderMethod::Dpm),
    ];
    let case = |(name, scene, needs, method): (&str, &Scene, SceneNeeds, RenderMethod)| {
        let mut render = rig.config.render.clone();
        render.method = method;
        let mut settings = RendererSettings {
            method: render.to_method(),
            output: Output::Planes(rig.schedule),
            ..renderer_settings(&rig)
        };
        if name == REDUCED {
            settings.scale = Scale::Share(0.5);
        }
        if std::ptr::eq(scene, &full) {
            settings = with_everything(settings, rig.camera)?;
        }
        let keep = Keep { needs, ..Keep::default() };
        let plan = RendererPlan::new(scene, settings, keep).map_err(|e| e.to_string())?;
        Ok(Case { name: name.to_owned(), plan })
    };
    cases.into_iter().map(case).collect()
}
