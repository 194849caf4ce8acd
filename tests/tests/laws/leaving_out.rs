//! What a scene does not need is compiled away, and tables are read in the way that suits the device. This may affect
//! only the speed: every pixel stays the same, on software Vulkan bit for bit.

use dpm_lab::scene_plan::scene_plan;
use dpm_lab::sequence::{draw, poses_at};
use dpm_lab::stability::gpu_shot::Shot;
use dpm_render::scene_data::Keep;
use dpm_render::{Renderer, RendererSettings};
use dpm_rig::config::{Overrides, RenderMethod, RigConfig};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::lobes::*;
use dpm_scene::shapes::*;
use dpm_scene::{Material, PunctualKind, PunctualLight, Scene};
use dpm_shaders::structs::Counters;
use dpm_tests::compare::{assert_same_picture, bits};
use dpm_tests::gpu::with_gpu;
use glam::{DVec3, Vec3};

/// Gives a material a lobe.
type Change = fn(&mut Lobes);

/// One scene per thing that can be left out.
fn scenes() -> Vec<(&'static str, Scene)> {
    let room = |material: Material| {
        let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::splat(0.7)));
        let mut ball = sphere(Vec3::ZERO, 0.4, 2, true);
        ball.positions.iter_mut().for_each(|p| p.y += 0.5);
        add(&mut scene, ball, material);
        scene.environment = sky(0.8);
        scene
    };
    let mut out = vec![
        ("diffuse", room(diffuse(Vec3::new(0.8, 0.5, 0.3)))),
        ("coated", room(Material { roughness: 0.3, ..diffuse(Vec3::splat(0.5)) }.tap(|m| m.ior = 1.5))),
        ("metal", room(Material { roughness: 0.4, ..Material::default() })),
        (
            "glass",
            room(Material {
                metallic: 0.0,
                roughness: 0.2,
                transmission: 1.0,
                thin_walled: false,
                ..Material::default()
            }),
        ),
        ("emissive", room(emitter(Vec3::splat(2.0)))),
    ];
    // The lamp shines down, and a part of its own body stands in the way.
    let mut shaded = room(diffuse(Vec3::splat(0.5)));
    let [lamp, shade] = [(1.4, 0.4), (1.2, 0.2)]
        .map(|(y, side)| quad(Vec3::new(-0.2, y, 0.4), Vec3::X * side, Vec3::Z * side));
    add(&mut shaded, join([lamp, shade]), emitter(Vec3::splat(6.0)));
    shaded.bodies.last_mut().expect("the lamp").mesh.materials[2..].fill(0);
    out.push(("a lamp with a shade", shaded));
    let mut metal_only =
        scene_of(sphere(Vec3::ZERO, 0.5, 2, true), Material { roughness: 0.5, ..Material::default() });
    metal_only.environment = image_sky(1.0);
    out.push(("nothing diffuse", metal_only));
    let mut dark = room(diffuse(Vec3::ONE));
    dark.environment = sky(0.0);
    dark.lights.push(PunctualLight {
        kind: PunctualKind::Point,
        intensity: Vec3::splat(3.0),
        body: None,
        position: Vec3::new(1.0, 2.0, 1.0),
        direction: Vec3::NEG_Y,
        range: f32::INFINITY,
    });
    out.push(("one point light", dark));
    let mut textured = room(diffuse(Vec3::ONE));
    textured.materials[0].base_color_texture = use_texture(&mut textured, noise_texture(4, 1, 0, 255, true));
    out.push(("one texture", textured.clone()));
    textured.materials[0].alpha_cutoff = Some(0.5);
    out.push(("a mask without holes", textured));
    // Each lobe alone: the code of the others must not touch it.
    let plastic = Material { roughness: 0.4, ..diffuse(Vec3::splat(0.5)) }.tap(|m| m.ior = 1.5);
    let glass = Material { transmission: 1.0, thin_walled: false, ..plastic.clone() };
    let lobes: [(&str, &Material, Change); 8] = [
        ("a coat", &plastic, |l| l.coat = Coat { factor: 1.0, roughness: 0.3, ..Coat::default() }),
        ("a colour of its own", &plastic, |l| l.specular.color = Vec3::new(2.0, 1.0, 0.0)),
        ("brushed", &plastic, |l| l.anisotropy.strength = 0.6),
        ("sheen", &plastic, |l| l.sheen = Sheen { color: Vec3::ONE, roughness: 0.5, ..Sheen::default() }),
        ("a film", &plastic, |l| l.film.factor = 1.0),
        ("light shines through", &plastic, |l| l.diffuse_transmission.factor = 0.5),
        ("absorption", &glass, |l| l.absorption = Vec3::new(1.0, 2.0, 0.0)),
        ("dispersion", &glass, |l| l.dispersion = 0.5),
    ];
    for (name, base, change) in lobes {
        out.push((name, room(base.clone().tap(|m| change(&mut m.lobes)))));
    }
    out.push(("a veil", room(plastic.tap(|m| (m.alpha, m.alpha_blend) = (0.4, true)))));
    out
}

/// Changes a value in place and returns it.
trait Tap: Sized {
    fn tap(mut self, change: impl FnOnce(&mut Self)) -> Self {
        change(&mut self);
        self
    }
}

impl Tap for Material {}

fn check_plan(method: &str) {
    let flags = ["render.software_raster=[48,36]", &format!("render.method=\"{method}\"")];
    let overrides = Overrides { variables: vec![], flags: flags.map(str::to_owned).to_vec() };
    let config = RigConfig::demo(&overrides).unwrap_or_else(|e| panic!("{e}"));
    let plan = scene_plan(&config, true).unwrap_or_else(|e| panic!("{e}"));
    let of = |feature: &str| {
        let entry = plan.entries.iter().find(|e| e.feature == feature);
        entry.and_then(|e| e.saving.clone()).unwrap_or_else(|| panic!("{feature} of {method}"))
    };
    for spare in ["alpha mask", "transmission", "punctual lights", "firefly clamp", "tiles without bodies"] {
        let s = of(spare);
        assert!(s.pixels_identical && !s.changes_pictures && s.difference == 0.0, "{spare}: {s:?}");
        // Rays that hit nothing also count.
        let of_tiles = spare == "tiles without bodies" && s.without_rays < s.with_rays;
        assert!(of_tiles || s.without_rays == s.with_rays, "{spare} of {method}: {s:?}");
    }
    let parts: &[&str] = match method {
        // The paper's filter begins at 15 degrees, which is outside this picture.
        "dpm" => &["allocation by variance", "spatial filter taps"],
        _ => &["rate map", "checkerboard", "spp by angle", "history and reprojection"],
    };
    let common = ["blue noise and sequences", "temporal blending", "indirect light"];
    for part in common.iter().chain(parts) {
        let s = of(part);
        assert!(s.changes_pictures && !s.pixels_identical && s.difference > 1e-4, "{part}: {s:?}");
        assert!(s.without_ms > 0.0 && s.with_ms > 0.0 && !s.is_wrong(true), "{part}: {s:?}");
    }
    // A scene with each of these parts is compared with the scene without it.
    for part in ["textures", "normal maps", "specular", "diffuse", "emissive", "environment"] {
        let s = of(part);
        assert!(s.changes_pictures && s.difference > 1e-4 && s.without_ms > 0.0, "{part}: {s:?}");
    }
    let image = of("environment image");
    assert!(image.changes_pictures && image.difference < 0.6, "the same light by other samples: {image:?}");
    // Tracing fewer pixels traces fewer rays; filters trace none.
    if method == "paper" {
        assert!(of("checkerboard").with_rays < 0.8 * of("checkerboard").without_rays);
        assert!(of("rate map").with_rays < of("rate map").without_rays);
        // The same light with more noise; a pass that read unwritten memory would differ more.
        assert!(of("history and reprojection").difference < 0.6);
    }
    assert!(of("indirect light").with_rays > of("indirect light").without_rays);
    let taps = of("spatial filter taps");
    assert!((taps.with_rays / taps.without_rays - 1.0).abs() < 0.02, "{taps:?}");
    assert!(plan.together.is_some_and(|s| s.pixels_identical));
}

fn leaving_out_changes_no_bit_of(scenes: impl IntoIterator<Item = (&'static str, Scene)>) {
    with_gpu(|gpu| {
        for (name, scene) in scenes {
            let camera = camera(40, 30, DVec3::new(0.3, 1.4, 2.4), DVec3::new(0.0, 0.3, 0.0));
            let shot = Shot {
                eye: Some(DVec3::new(-0.6, 1.5, 2.2)),
                spp: 4,
                depth: 4,
                drive_gain: 0.2,
                ..Shot::new(&scene, camera)
            };
            let lean = shot.draw(gpu);
            let full = Shot { leave_nothing_out: true, ..shot.clone() }.draw(gpu);
            let lit = lean.lit_estimates().count();
            assert!(lit > 200, "{name}: {lit}");
            assert!(lean.radiance.iter().any(|r| r[0] > 0.0), "{name} is black");
            assert_same_picture(gpu, &lean.radiance, &full.radiance, name);
            if gpu.summary().software {
                assert_eq!(lean.surfaces, full.surfaces, "{name}");
                assert_eq!(lean.codes, full.codes, "{name}");
                assert_eq!(lean.counters, full.counters, "{name}");
            }
            let stored = shot.draw_keeping(gpu, Keep { storage_tables: true, ..Keep::default() });
            assert_eq!(bits(&lean.radiance), bits(&stored.radiance), "{name}: tables in storage");
            assert_eq!(lean.codes, stored.codes, "{name}: tables in storage");
        }
    });
}

/// A ball alone is convex: nothing that leaves it meets it again, so a GPU walks next to none of its paths' rays.
/// Software Vulkan has no horizons, and walks all. The rays are the same.
#[test]
fn rays_that_are_proven_to_miss_are_counted_apart() {
    with_gpu(|gpu| {
        let counted = |scene: &Scene, eye: f64, storage_tables: bool| {
            let shot = Shot {
                spp: 4,
                depth: 4,
                ..Shot::new(scene, camera(40, 30, DVec3::new(0.0, 0.0, eye), DVec3::ZERO))
            };
            let counters = shot.draw_keeping(gpu, Keep { storage_tables, ..Keep::default() }).counters;
            let sum = |of: &dyn Fn(&Counters) -> u32| counters.iter().map(|c| u64::from(of(c))).sum::<u64>();
            assert_eq!(sum(&|c| c.rays), sum(&|c| c.walked_rays() + c.proven_rays));
            [sum(&|c| c.rays), sum(&|c| c.camera_rays), sum(&|c| c.proven_rays)]
        };
        let mut ball = scene_of(sphere(Vec3::ZERO, 0.5, 2, true), diffuse(Vec3::splat(0.7)));
        ball.environment = sky(0.8);
        let [rays, camera, proven] = counted(&ball, 2.0, true);
        assert!(camera > 1000 && rays - camera > 1000, "{rays}, {camera}");
        // Every ray of a path leaves a convex body; horizons are rounded up by a fifteenth, so the flattest are walked.
        let of_paths = rays - camera;
        assert!(proven <= of_paths && 20 * proven >= 19 * of_paths, "{proven} of {of_paths}");
        if gpu.summary().software {
            assert_eq!(counted(&ball, 2.0, false), [rays, camera, 0], "walked as they are");
        }
    });
}

#[test]
fn leaving_out_changes_no_bit() {
    leaving_out_changes_no_bit_of(scenes().into_iter().take(1));
}

/// Every part of a scene, taken out.
mod breadth {
    use super::*;

    #[test]
    fn leaving_out_changes_no_bit_of_any_scene() {
        leaving_out_changes_no_bit_of(scenes());
    }

    #[test]
    fn neither_changes_a_bit_of_a_method_with_histories() {
        let flags = vec!["render.software_raster=[64,48]".to_owned()];
        let config =
            RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
        let rig =
            Rig::build(&config, dpm_device::planes::Raster::new(64, 48)).unwrap_or_else(|e| panic!("{e}"));
        with_gpu(|gpu| {
            for which in [RenderMethod::Paper, RenderMethod::Dpm] {
                let mut render = rig.config.render.clone();
                render.method = which;
                render.paper.zone_spp = [2, 2, 1];
                let shown = |leave_nothing_out: bool, storage_tables: bool| {
                    let settings = RendererSettings {
                        method: render.to_method(),
                        leave_nothing_out,
                        ..renderer_settings(&rig)
                    };
                    let keep = Keep { storage_tables, ..Keep::default() };
                    let mut renderer =
                        Renderer::keeping(gpu, &rig.scene, settings, keep).expect("the demo fits the GPU");
                    let mut slot = renderer.create_slot(true).expect("memory for a small frame");
                    let mut frames = Vec::new();
                    for frame in 0..6 {
                        let poses = poses_at(&rig, u64::from(frame));
                        draw(&rig, &mut renderer, &mut slot, &poses, frame, 2.0).expect("the frame ends");
                        frames.push((slot.radiance().expect("a debug slot").to_vec(), slot.codes().to_vec()));
                    }
                    frames
                };
                let lean = shown(false, false);
                let (full, stored) = (shown(true, false), shown(false, true));
                for (frame, (lean, full)) in lean.iter().zip(&full).enumerate() {
                    let what = format!("{which:?}, frame {frame}");
                    assert_eq!(bits(&lean.0), bits(&stored[frame].0), "{what}: tables in storage");
                    assert_eq!(lean.1, stored[frame].1, "{what}: tables in storage");
                    let lit = lean.1.iter().filter(|c| **c != 0).count();
                    assert!(lit > 50, "{what}: {lit} pixels are lit");
                    assert_same_picture(gpu, &lean.0, &full.0, &what);
                    if gpu.summary().software {
                        assert_eq!(lean.1, full.1, "{what}");
                    }
                }
            }
        });
    }

    /// Two tests, because one of them keeps little more than one core busy.
    #[test]
    fn a_plan_of_paper_tells_spare_code_from_parts_of_the_picture() {
        check_plan("paper");
    }

    #[test]
    fn a_plan_of_dpm_tells_spare_code_from_parts_of_the_picture() {
        check_plan("dpm");
    }
}
