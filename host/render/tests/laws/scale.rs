//! A share of the panel's raster that is traced (`render.scale`): what the passes `prepare`, `cells`, `enlarge` and `edges` make of it, against first hits in f64, against every pixel
//! traced, and against light that is known.

use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_render::method::{Method, SamplerKind, HISTORY_CAP};
use dpm_render::{
    reduced, FrameInputs, Keep, Output, Overlapping, Renderer, RendererPlan, RendererSettings, Scale,
    Surface, Tracing, LADDER, PASSES,
};
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use glam::{DAffine3, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// The passes that a reduced raster adds.
const NEW: [&str; 4] = ["prepare", "cells", "enlarge", "edges"];
const WAIT_NS: u64 = 60_000_000_000;
/// Bright enough that no code value is at its end, and white enough that every lit pixel has one.
const GAIN: f32 = 0.05;
/// The even sky's radiance.
const SKY: f32 = 1.0;

pub(super) fn dpm() -> Method {
    Method {
        dpm: true,
        rate_map: true,
        sampler: SamplerKind::Continued,
        temporal: true,
        spatial: true,
        history_cap: HISTORY_CAP,
        ..Method::full(2)
    }
}

fn settings(camera: &ProjectorCamera, scale: Scale, method: &Method) -> RendererSettings {
    RendererSettings {
        raster: camera.raster,
        scale,
        depth: 2,
        seed: 3,
        clamp_indirect: None,
        drive: dpm_render::drive::Drive::even(GAIN),
        lens: (!camera.lens.is_pinhole()).then_some(*camera),
        camera_is_eye: false,
        leave_nothing_out: false,
        method: method.clone(),
        halftone: None,
        plane_groups: vec![],
        output: Output::Codes,
        overlap: Overlapping::Never,
        tracing: Tracing::Auto,
        most_live_texels: 0,
    }
}

/// What a frame shows on the panel.
pub(super) struct PanelPicture {
    pub(super) codes: Vec<u32>,
    pub(super) light: Vec<Vec3>,
    surfaces: Vec<Surface>,
    lit: u32,
}

/// A scene before a projector and an eye.
pub(super) struct ScaleScene<'a> {
    gpu: Arc<Gpu>,
    scene: &'a Scene,
    pub(super) camera: ProjectorCamera,
    eye: DVec3,
}

impl<'a> ScaleScene<'a> {
    fn new(scene: &'a Scene, camera: ProjectorCamera, eye: DVec3) -> Self {
        let gpu = Gpu::open(&GpuOptions::default()).expect("a Vulkan device");
        Self { gpu, scene, camera, eye }
    }

    /// The last of so many frames, each on its rung.
    fn show(&self, scale: Scale, method: &Method, rungs: &[usize]) -> PanelPicture {
        self.show_by(2.0, scale, method, rungs)
    }

    /// The same by so many samples of a pixel a frame.
    pub(super) fn show_by(
        &self,
        budget_spp: f32,
        scale: Scale,
        method: &Method,
        rungs: &[usize],
    ) -> PanelPicture {
        let settings = settings(&self.camera, scale, method);
        let mut renderer = Renderer::new(&self.gpu, self.scene, settings).expect("the scene fits");
        let mut slot = renderer.create_slot(true).expect("memory");
        let poses: Vec<DAffine3> = self.scene.bodies.iter().map(|b| b.world_from_body_rest).collect();
        let mut lit = 0;
        for (frame, &rung) in rungs.iter().enumerate() {
            let still = FrameInputs::new(&self.camera, (self.eye, DVec3::ZERO), &poses);
            let inputs = FrameInputs { frame: frame as u32, spp: 2, budget_spp, rung, ..still };
            renderer.submit(&mut slot, &inputs).expect("a frame");
            lit = slot.wait(WAIT_NS).expect("the frame ends").counters().lit_pixels;
        }
        let light = slot.radiance().expect("for debugging").iter().map(|&[r, g, b, _]| Vec3::new(r, g, b));
        PanelPicture {
            codes: slot.codes().to_vec(),
            light: light.collect(),
            surfaces: slot.surfaces().expect("for debugging"),
            lit,
        }
    }

    fn at(&self, share: f64, method: &Method) -> PanelPicture {
        self.show(Scale::Share(share), method, &[0, 0, 0])
    }

    /// Of each pixel of a raster with the same view the body that its ray meets first, in f64 and without any tree, and whether the eye sees it.
    pub(super) fn truth(&self, raster: dpm_device::planes::Raster) -> Vec<Option<(usize, bool)>> {
        let camera = self.camera.at_raster(raster);
        let triangles: Vec<(usize, [DVec3; 3])> = (self.scene.bodies.iter().enumerate())
            .flat_map(|(i, body)| {
                let corner = |v: u32| {
                    body.world_from_body_rest.transform_point3(body.mesh.positions[v as usize].as_dvec3())
                };
                body.mesh.triangles.iter().map(move |t| (i, t.map(corner)))
            })
            .collect();
        let (w, h) = (raster.width(), raster.height());
        (0..w * h)
            .map(|i| {
                let ray = camera.ray(DVec2::new(f64::from(i % w) + 0.5, f64::from(i / w) + 0.5));
                let hits = triangles
                    .iter()
                    .filter_map(|(body, t)| Some((meet(ray.origin, ray.direction, t)?, *body, t)));
                let (distance, body, [a, b, c]) = hits.min_by(|a, b| a.0.total_cmp(&b.0))?;
                let normal = (b - a).cross(c - a).normalize();
                let point = ray.origin + ray.direction * distance;
                let to_eye = self.eye - point;
                let side = normal.dot(to_eye);
                let from = point + normal * side.signum() * 1e-6;
                let blocked =
                    || triangles.iter().any(|(_, t)| meet(from, self.eye - from, t).is_some_and(|s| s < 1.0));
                Some((body, -normal.dot(ray.direction) * side > 0.0 && !blocked()))
            })
            .collect()
    }
}

/// Where a ray meets a triangle, in lengths of its direction [Moeller and Trumbore 1997].
fn meet(origin: DVec3, direction: DVec3, [a, b, c]: &[DVec3; 3]) -> Option<f64> {
    let (e, f) = (b - a, c - a);
    let p = direction.cross(f);
    let inverse = 1.0 / e.dot(p);
    let s = origin - a;
    let u = s.dot(p) * inverse;
    let q = s.cross(e);
    let v = direction.dot(q) * inverse;
    let t = f.dot(q) * inverse;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 1e-9).then_some(t)
}

fn body_of(surface: &Surface) -> Option<(usize, bool)> {
    (surface.id != u32::MAX).then(|| ((surface.id >> 24) as usize, surface.is_lit()))
}

/// A ball before another and before a wall that does not fill the raster, seen by an eye beside the projector.
pub(super) fn balls() -> Scene {
    let mut scene =
        scene_of(sphere(Vec3::new(0.0, 0.0, 0.0), 0.3, 3, true), diffuse(Vec3::new(0.8, 0.4, 0.2)));
    add(&mut scene, sphere(Vec3::new(0.35, 0.1, 0.4), 0.12, 3, true), diffuse(Vec3::new(0.2, 0.5, 0.8)));
    add(
        &mut scene,
        quad(Vec3::new(-0.7, -0.5, -0.6), Vec3::X * 1.2, Vec3::Y * 0.9),
        diffuse(Vec3::splat(0.6)),
    );
    scene.environment = sky(SKY);
    scene
}

pub(super) fn view_of_balls(scene: &Scene) -> ScaleScene<'_> {
    ScaleScene::new(
        scene,
        camera(161, 121, DVec3::new(0.0, 0.0, 2.6), DVec3::ZERO),
        DVec3::new(0.25, 0.15, 2.6),
    )
}

/// The four reduced pixels around a pixel of the panel.
fn around(panel: [u32; 2], coarse: [u32; 2], pixel: [u32; 2]) -> [usize; 4] {
    let first = |c: usize| {
        ((f64::from(pixel[c]) + 0.5) * f64::from(coarse[c]) / f64::from(panel[c]) - 0.5).floor() as i64
    };
    let (x, y) = (first(0), first(1));
    [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| {
        let at = |v: i64, n: u32| v.clamp(0, i64::from(n) - 1) as usize;
        at(y + dy, coarse[1]) * coarse[0] as usize + at(x + dx, coarse[0])
    })
}

/// With every pixel traced there is no further pass, and the passes are those of a panel without a scale, to the bit of their constants. The passes
/// before the new one are compiled as for a panel of the reduced raster.
#[test]
fn a_whole_scale_adds_nothing() {
    let scene = balls();
    let of = |raster: (u32, u32), scale| {
        let camera = camera(raster.0, raster.1, DVec3::new(0.0, 0.0, 2.6), DVec3::ZERO);
        let plan = RendererPlan::new(&scene, settings(&camera, scale, &dpm()), Keep::default()).unwrap();
        let programs = plan.programs().into_iter().map(|p| (p.pass, p.shader.name, p.constants));
        programs.collect::<Vec<_>>()
    };
    let (whole, half) = (of((160, 120), Scale::WHOLE), of((160, 120), Scale::Share(0.5)));
    assert!(whole.iter().all(|(pass, ..)| !NEW.contains(pass)));
    assert_eq!(whole, of((80, 60), Scale::WHOLE));
    let (new, others): (Vec<_>, Vec<_>) = half.into_iter().partition(|(pass, ..)| NEW.contains(pass));
    assert_eq!((new.len(), others), (NEW.len(), whole));
    assert!(NEW.iter().all(|pass| PASSES.contains(pass)));
}

/// What draws frames.
mod breadth {
    use super::*;

    /// Silhouettes, the border of what the eye sees and the border between bodies are those of the panel's own rays in f64. By plain enlargement, each
    /// pixel as the nearest reduced one shows it, they err by reduced pixels.
    #[test]
    fn silhouettes_are_those_of_the_panel() {
        let scene = balls();
        let view = view_of_balls(&scene);
        let panel = view.camera.raster;
        let truth = view.truth(panel);
        for method in [dpm(), Method::full(2)] {
            // By a third, borders between cells lie on centres of pixels.
            for share in [0.75, 0.5, 0.35, 1.0 / 3.0, 0.25] {
                let shown = view.at(share, &method);
                let coarse = reduced(panel, share);
                let traced = view.truth(coarse);
                let wrong = |of: &dyn Fn(usize) -> Option<(usize, bool)>| {
                    (0..truth.len()).filter(|&i| of(i) != truth[i]).count()
                };
                let enlarged = wrong(&|i| body_of(&shown.surfaces[i]));
                let plain = wrong(&|i| {
                    let (x, y) = (i as u32 % panel.width(), i as u32 / panel.width());
                    let near = |v: u32, n: u32, of: u32| {
                        ((f64::from(v) + 0.5) * f64::from(n) / f64::from(of)) as u32
                    };
                    let (x, y) =
                        (near(x, coarse.width(), panel.width()), near(y, coarse.height(), panel.height()));
                    traced[(y * coarse.width() + x) as usize]
                });
                let dark = |i: usize| shown.codes[i] == 0;
                let spilt =
                    (0..truth.len()).filter(|&i| !dark(i) && truth[i].is_none_or(|(_, lit)| !lit)).count();
                let sizes = [panel, coarse].map(|r| [r.width(), r.height()]);
                let inside = |i: usize| {
                    let pixel = [i as u32 % panel.width(), i as u32 / panel.width()];
                    let taps = around(sizes[0], sizes[1], pixel).map(|at| traced[at]);
                    truth[i].is_some_and(|(_, lit)| lit) && taps.iter().all(|tap| *tap == truth[i])
                };
                let missing = (0..truth.len()).filter(|&i| inside(i) && dark(i)).count();
                println!(
                "scale {share}, dpm {}: {enlarged} pixels of {} show another surface than in f64, {plain} by plain enlargement; {spilt} are lit \
                 and should not be, {missing} dark",
                method.dpm,
                truth.len()
            );
                // Where rounding decides.
                assert!(enlarged <= 4 + plain / 50, "{enlarged} against {plain}");
                assert!(plain > 100, "{plain}: the test sees little");
                assert!(spilt <= 4 && missing == 0, "{spilt}, {missing}");
                let lit = truth.iter().flatten().filter(|(_, lit)| *lit).count();
                assert!(shown.lit.abs_diff(lit as u32) <= 8, "{} and {lit} lit pixels", shown.lit);
            }
        }
    }

    /// The same through a lens: the reduced raster has the panel's view.
    #[test]
    fn a_lens_bends_both_rasters() {
        let scene = balls();
        let mut view = view_of_balls(&scene);
        view.camera = view.camera.with_lens(Lens::opencv(&[-0.2, 0.08, 0.004, -0.003]).unwrap()).unwrap();
        let truth = view.truth(view.camera.raster);
        let shown = view.at(0.5, &dpm());
        let wrong = (0..truth.len()).filter(|&i| body_of(&shown.surfaces[i]) != truth[i]).count();
        assert!(wrong <= 8, "{wrong} of {}", truth.len());
    }

    /// Light that is known exactly: that of surfaces that glow. Two bodies side by side in one plane, two faces of one body at a crease, and a step in depth of one body: no light of one comes to the other, by any of the three guides alone. This
    /// fails if one of them is taken out of the shader.
    #[test]
    fn light_stays_on_its_side_of_an_edge() {
        let (dark, bright) = (Vec3::splat(0.1), Vec3::splat(0.8));
        let at = |x: f32, z: f32, u: Vec3| quad(Vec3::new(x, -0.6, z), u, Vec3::Y * 1.2);
        // The edge is not on a border of reduced pixels.
        let edge = 0.013;
        let mut bodies = scene_of(at(edge - 0.7, 0.0, Vec3::X * 0.7), emitter(dark));
        add(&mut bodies, at(edge, 0.0, Vec3::X * 0.7), emitter(bright));
        let one_body = |left, right| {
            let mut scene = scene_of(join([left, right]), emitter(dark));
            scene.materials.push(emitter(bright));
            let body = &mut scene.bodies[0];
            let half = body.mesh.materials.len() / 2;
            body.mesh.materials[half..].fill(1);
            scene
        };
        // The faces of the crease open away from each other, and each faces projector and eye.
        let slope = Vec3::new(0.4, 0.0, -0.57);
        let crease = one_body(at(edge - 0.4, -0.57, Vec3::new(0.4, 0.0, 0.57)), at(edge, 0.0, slope));
        let step = one_body(at(edge - 0.7, 0.0, Vec3::X * 0.7), at(edge, -0.3, Vec3::X * 0.7));
        for (name, scene) in [("body", bodies), ("normal", crease), ("depth", step)] {
            let eye = DVec3::new(0.0, 0.05, 2.6);
            let view = ScaleScene::new(&scene, camera(160, 120, DVec3::new(0.0, 0.0, 2.6), DVec3::ZERO), eye);
            let method = Method::full(2);
            let whole = view.at(1.0, &method);
            for share in [0.5, 0.25] {
                let shown = view.at(share, &method);
                let (mut worst, mut wrong, mut lit) = (0.0f32, 0, 0);
                for (i, surface) in whole.surfaces.iter().enumerate().filter(|(_, s)| s.is_lit()) {
                    assert_eq!(body_of(&shown.surfaces[i]), body_of(surface), "{name}: pixel {i}");
                    let apart = (shown.light[i] - whole.light[i]).abs().max_element();
                    worst = worst.max(apart);
                    wrong += u32::from(apart > 0.25);
                    lit += 1;
                }
                println!(
                    "{name}, scale {share}: of {lit} pixels {wrong} show other light, by {worst:.5} at most"
                );
                assert!(lit > 3000, "{lit}");
                assert!(worst < 1e-3 && wrong == 0, "{name}, scale {share}: {wrong}, {worst}");
            }
        }
    }

    /// A plane under an even sky has the same light as if every pixel were traced, and so has its mean.
    #[test]
    fn a_plane_keeps_its_light() {
        let mut scene = scene_of(
            quad(Vec3::new(-0.9, -0.7, 0.0), Vec3::X * 1.8, Vec3::Y * 1.4),
            diffuse(Vec3::new(0.7, 0.5, 0.3)),
        );
        scene.environment = sky(SKY);
        let eye = DVec3::new(0.1, 0.2, 2.0);
        let view = ScaleScene::new(&scene, camera(160, 120, DVec3::new(0.3, 0.4, 2.0), DVec3::ZERO), eye);
        for method in [dpm(), Method::full(2)] {
            let mean = |shown: &PanelPicture| {
                let codes = shown
                    .codes
                    .iter()
                    .map(|c| f64::from(c & 255) + f64::from(c >> 8 & 255) + f64::from(c >> 16 & 255));
                codes.sum::<f64>() / shown.codes.len() as f64
            };
            let whole = mean(&view.at(1.0, &method));
            for share in [0.75, 0.5, 0.25] {
                let scaled = mean(&view.at(share, &method));
                println!("scale {share}: mean code {scaled:.4}, {whole:.4} with every pixel traced");
                assert!((scaled / whole - 1.0).abs() < 0.005, "scale {share}: {scaled} and {whole}");
            }
        }
    }

    /// What a texture divides the light by is that of the panel's own pixels: it stays sharp.
    #[test]
    fn textures_stay_sharp() {
        let square = quad(Vec3::new(-0.9, -0.7, 0.0), Vec3::X * 1.8, Vec3::Y * 1.4);
        let mut scene = scene_of(square, Material { ..diffuse(Vec3::ONE) });
        let texture = use_texture(&mut scene, noise_texture(64, 5, 40, 220, false));
        scene.materials[0].base_color_texture = texture;
        scene.environment = sky(SKY);
        let eye = DVec3::new(0.1, 0.2, 2.0);
        let view = ScaleScene::new(&scene, camera(160, 120, DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO), eye);
        let whole = view.at(1.0, &dpm());
        let rmse = |shown: &PanelPicture| {
            let apart = whole
                .light
                .iter()
                .zip(&shown.light)
                .map(|(a, b)| f64::from((*a - *b).length_squared()) / 3.0);
            (apart.sum::<f64>() / whole.light.len() as f64).sqrt()
        };
        let [sharp, blurred] = [dpm(), Method::full(2)].map(|method| rmse(&view.at(0.5, &method)));
        println!(
        "error of a noise texture at half the raster: {sharp:.5}; {blurred:.5} if its light is interpolated"
    );
        assert!(sharp < 0.1 * blurred, "{sharp} and {blurred}");
    }

    /// Frames that change the raster, either way, show what a renderer shows that has had this raster all along: nothing of another raster is left.
    #[test]
    fn a_change_of_the_raster_leaves_nothing_behind() {
        let scene = balls();
        let view = view_of_balls(&scene);
        for method in [dpm(), Method::full(2)] {
            for rung in [0, 2, 4] {
                let [steady, later] =
                    [3, 7].map(|frames| view.show(Scale::Ladder, &method, &[rung; 7][..frames]));
                let apart = |a: &PanelPicture, b: &PanelPicture| {
                    let apart = a.light.iter().zip(&b.light).map(|(a, b)| (*a - *b).abs().max_element());
                    apart.sum::<f32>() / a.light.len() as f32
                };
                // How much noise the same renderer has.
                let noise = apart(&steady, &later);
                for before in [[4, 4, 1], [0, 1, 2]] {
                    let rungs: Vec<_> = before.into_iter().chain([rung; 4]).collect();
                    let shown = view.show(Scale::Ladder, &method, &rungs);
                    let same = shown
                        .surfaces
                        .iter()
                        .zip(&steady.surfaces)
                        .filter(|(a, b)| body_of(a) == body_of(b))
                        .count();
                    assert_eq!(same, steady.surfaces.len(), "rung {rung} after {before:?}");
                    let off = |s: &PanelPicture| {
                        (0..s.codes.len()).filter(|&i| s.codes[i] != 0 && !s.surfaces[i].is_lit()).count()
                    };
                    assert_eq!(off(&shown), 0);
                    let mean = apart(&shown, &steady);
                    assert!(
                        mean < 0.005 + 1.5 * noise,
                        "rung {rung} after {before:?}: {mean}, {noise} by chance"
                    );
                }
            }
        }
        assert_eq!(LADDER.len(), 5);
    }
}
