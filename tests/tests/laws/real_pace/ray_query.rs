//! The hits that a device finds itself (ray query) against those of the shaders' walk, on the same device: the same
//! surfaces and the same light, bit for bit, but where two surfaces are equally near.
//!
//! Debian 12's software Vulkan has no ray query. Where no device of this machine has it, the software Vulkan of newer
//! packages draws, which `tests/gpu-compile/drivers` unpacks, in a process of its own.

use dpm_lab::sequence::{draw, poses_at};
use dpm_lab::stability::gpu_shot::Shot;
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_render::{FrameInputs, Renderer, RendererSettings, Surface, Tracing};
use dpm_rig::pipeline::renderer_settings;
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use dpm_shaders::structs::NO_HIT;
use dpm_tests::compare::bits;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;
use glam::{DAffine3, DVec3, Vec3};
use gpu_compile::targets::SOFTWARE;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

/// The two ways.
const BOTH: [Tracing; 2] = [Tracing::Walk, Tracing::RayQuery];
/// Largest share of a picture's pixels whose light may differ, because a ray on the way met another of two surfaces
/// that are equally near.
const MOST_TIES: f64 = 0.01;

/// A line of a comparison: how many pixels differ in what.
#[derive(Debug, Default)]
struct Ties {
    pixels: usize,
    surfaces: usize,
    light: usize,
}

impl Ties {
    fn of_surfaces(what: &str, walk: &[Surface], query: &[Surface]) -> Self {
        assert_eq!(walk.len(), query.len(), "{what}");
        let differ = walk.iter().zip(query).filter(|(a, b)| a != b);
        let tie = |(a, b): (&Surface, &Surface)| {
            let (near, far) = (a.distance.abs(), b.distance.abs());
            let equally_near = a.id != NO_HIT && b.id != NO_HIT && (near - far).abs() <= 2e-6 * far;
            assert!(equally_near, "{what}: the walk found {a:?} and the device {b:?}");
        };
        Self { pixels: walk.len(), surfaces: differ.map(tie).count(), light: 0 }
    }

    fn and_light(self, walk: &[[f32; 4]], query: &[[f32; 4]]) -> Self {
        let light = bits(walk).iter().zip(&bits(query)).filter(|(a, b)| a != b).count();
        Self { light, ..self }
    }

    fn are_few(self, what: &str) {
        println!(
            "{what}: {} surfaces and the light of {} of {} pixels differ",
            self.surfaces, self.light, self.pixels
        );
        let most = MOST_TIES * self.pixels as f64;
        assert!(self.surfaces as f64 <= most && self.light as f64 <= most, "{what}: {self:?}");
    }
}

/// Bodies of [`room`] by their numbers: the ball with holes, the lamp, and the one without triangles.
const BALL: u32 = 1;
const LAMP: u32 = 4;
const EMPTY: u32 = 5;

/// A floor with three balls above it, of a cloth with holes, of metal and of glass, with a lamp that exists in the
/// virtual world only, and with a body that has no triangles.
fn room() -> Scene {
    let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::splat(0.7)));
    let cloth = Material { double_sided: true, alpha_cutoff: Some(0.5), ..diffuse(Vec3::ONE) };
    add(&mut scene, sphere(Vec3::Y * 0.5, 0.4, 3, true), cloth);
    scene.materials[1].base_color_texture = use_texture(&mut scene, noise_texture(16, 1, 0, 255, true));
    let ball = &mut scene.bodies[1].mesh;
    for (uv, p) in ball.uvs.iter_mut().zip(&ball.positions) {
        *uv = p.truncate() * 3.0;
    }
    let metal = Material { roughness: 0.3, ..Material::default() };
    add(&mut scene, sphere(Vec3::ZERO, 0.15, 2, false), metal);
    let solid = Material { metallic: 0.0, roughness: 0.2, ..Material::default() };
    let glass = Material { transmission: 1.0, thin_walled: false, ..solid };
    add(&mut scene, sphere(Vec3::ZERO, 0.2, 2, true), glass);
    let lamp = quad(Vec3::new(0.4, 0.9, -0.2), Vec3::X * 0.4, Vec3::Z * 0.4);
    add(&mut scene, lamp, Material { double_sided: true, ..emitter(Vec3::splat(6.0)) });
    scene.bodies[LAMP as usize].projected = false;
    add(&mut scene, mesh(Vec::new(), Vec::new(), Vec::new()), diffuse(Vec3::ONE));
    scene.environment = sky(0.8);
    scene
}

/// Poses of its bodies: turned by angles that no float has.
fn poses() -> Vec<DAffine3> {
    let turned = |angle: f64, [x, y, z]: [f64; 3]| {
        DAffine3::from_translation(DVec3::new(x, y, z)) * DAffine3::from_rotation_y(angle)
    };
    vec![
        turned(0.1, [0.0; 3]),
        turned(0.7, [0.1, 0.0, -0.1]),
        turned(1.3, [-0.6, 0.3, 0.4]),
        turned(2.9, [0.5, 0.25, 0.6]),
        turned(0.3, [0.0; 3]),
        turned(0.0, [0.0; 3]),
    ]
}

/// A small picture of a scene for an eye.
fn shot_of(scene: &Scene, tracing: Tracing) -> Shot<'_> {
    Shot {
        eye: Some(EYE),
        poses: poses().into_iter().take(scene.bodies.len()).collect(),
        spp: 2,
        depth: 4,
        drive_gain: 0.2,
        tracing,
        ..Shot::new(scene, camera(64, 48, DVec3::new(0.3, 1.4, 2.4), DVec3::new(0.0, 0.3, 0.0)))
    }
}

const EYE: DVec3 = DVec3::new(-0.6, 1.5, 2.2);

/// Pixels that see a body.
fn pixels_of(body: u32, surfaces: &[Surface]) -> usize {
    surfaces.iter().filter(|s| s.id != NO_HIT && s.id >> 24 == body).count()
}

/// A scene with holes, lamps, glass and metal, lit by the projector for an eye and seen by an ordinary camera.
fn one_picture_is_the_same(gpu: &Arc<Gpu>) {
    let scene = room();
    for (what, eye) in [("an eye", Some(EYE)), ("the camera as eye", None)] {
        let [walk, query] = BOTH.map(|tracing| Shot { eye, ..shot_of(&scene, tracing) }.draw(gpu));
        Ties::of_surfaces(what, &walk.surfaces, &query.surfaces)
            .and_light(&walk.radiance, &query.radiance)
            .are_few(what);
        let lit = walk.lit_estimates().count();
        assert!(lit > 300, "{what}: {lit} pixels are lit");
        let [ball, lamp, empty] = [BALL, LAMP, EMPTY].map(|body| pixels_of(body, &walk.surfaces));
        assert!(ball > 50 && empty == 0, "{what}: {ball} pixels of the ball with holes");
        // The projector does not see the lamp, and an ordinary camera does.
        assert_eq!(lamp > 10, eye.is_none(), "{what}: {lamp} pixels of the lamp");
    }
}

/// Scenes without bodies, and with none that has triangles.
fn empty_scenes_are_empty(gpu: &Arc<Gpu>) {
    let mut scene = Scene { environment: sky(0.5), ..Scene::default() };
    for what in ["no body", "an empty body"] {
        let drawn = Shot { eye: None, ..shot_of(&scene, Tracing::RayQuery) }.draw(gpu);
        assert!(drawn.surfaces.iter().all(|s| s.id == NO_HIT), "{what}");
        assert!(drawn.radiance.iter().all(|r| r[..3] == [0.5; 3]), "{what}: the sky alone");
        println!("{what}: no surface");
        add(&mut scene, mesh(Vec::new(), Vec::new(), Vec::new()), diffuse(Vec3::ONE));
    }
}

/// The demo, whose two bodies move from frame to frame, with histories and with the spatial filter.
fn moving_frames_are_the_same(gpu: &Arc<Gpu>) {
    let rig = demo_rig(64, 48, &[]);
    let [walk, query] = BOTH.map(|tracing| {
        let settings = RendererSettings { tracing, ..renderer_settings(&rig) };
        let mut renderer = Renderer::new(gpu, &rig.scene, settings).expect("the demo fits the GPU");
        assert_eq!(renderer.asks_device(), tracing == Tracing::RayQuery);
        let mut slot = renderer.create_slot(true).expect("memory for a small frame");
        let frame = |frame: u32| {
            let poses = poses_at(&rig, u64::from(frame) * 40);
            draw(&rig, &mut renderer, &mut slot, &poses, frame, 2.0).expect("the frame ends");
            let light = slot.radiance().expect("a debug slot").to_vec();
            (slot.surfaces().expect("a debug slot"), light)
        };
        (0..6).map(frame).collect::<Vec<_>>()
    });
    for (i, (walk, query)) in walk.iter().zip(&query).enumerate() {
        let what = format!("frame {i} of the demo");
        let hits = walk.0.iter().filter(|s| s.id != NO_HIT).count();
        assert!(hits > 300, "{what}: {hits} hits");
        Ties::of_surfaces(&what, &walk.0, &query.0).and_light(&walk.1, &query.1).are_few(&what);
    }
}

/// Three frames in flight, each with its own poses, all submitted before the first is waited for: no frame sees the
/// bodies of another.
fn frames_in_flight_have_their_own_bodies(gpu: &Arc<Gpu>) {
    let scene = room();
    let shot = shot_of(&scene, Tracing::RayQuery);
    let mut renderer = Renderer::new(gpu, &scene, shot.settings()).expect("the scene fits the GPU");
    let places = [0.0, 0.3, -0.4].map(|x| {
        let mut all = poses();
        all[1].translation.x += x;
        all
    });
    let mut slots = places.each_ref().map(|_| renderer.create_slot(true).expect("memory"));
    for (i, (slot, poses)) in slots.iter_mut().zip(&places).enumerate() {
        let inputs = FrameInputs { frame: i as u32, ..FrameInputs::new(&shot.camera, (EYE, EYE), poses) };
        renderer.submit(slot, &inputs).expect("submit");
    }
    for (slot, poses) in slots.iter_mut().zip(places) {
        slot.wait(120_000_000_000).expect("the frame ends");
        let alone = Shot { poses, ..shot.clone() }.draw(gpu);
        assert_eq!(slot.surfaces().as_ref(), Some(&alone.surfaces));
    }
}

/// A device that was left is opened anew, and the same renderer draws the same picture with trees of that device.
fn a_device_that_comes_back_draws_the_same(gpu: &Arc<Gpu>) {
    let (scene, poses) = (room(), poses());
    let shot = shot_of(&scene, Tracing::RayQuery);
    let surfaces_by = |mut renderer: Renderer| {
        let mut slot = renderer.create_slot(true).expect("memory");
        let inputs = FrameInputs::new(&shot.camera, (EYE, EYE), &poses);
        renderer.submit(&mut slot, &inputs).expect("submit");
        slot.wait(120_000_000_000).expect("the frame ends");
        slot.surfaces().expect("a debug slot")
    };
    let renderer = Renderer::new(gpu, &scene, shot.settings()).expect("the scene fits the GPU");
    let plan = renderer.plan();
    let before = surfaces_by(renderer);
    let left = Gpu::open(&GpuOptions::default()).expect("the same device once more");
    let in_use = Renderer::from_plan(&left, &plan).expect("the scene fits the GPU");
    let back = left.reopen().expect("the device comes back");
    let again = Renderer::from_plan(&back, &plan).expect("the scene fits the GPU");
    assert!(left.is_lost() && again.asks_device());
    assert_eq!(surfaces_by(again), before);
    drop(in_use);
}

/// Opens a device for some of the checks.
fn on_this_device(checks: &[fn(&Arc<Gpu>)]) {
    with_gpu(|gpu| {
        println!("{}, {}", gpu.summary().name, gpu.summary().driver);
        assert!(gpu.summary().ray_query, "this device has no ray query");
        checks.iter().for_each(|check| check(gpu));
    });
}

/// Two tests, because software Vulkan keeps one core busy with compiling for each.
#[test]
#[ignore = "the last test runs it, on a device with ray query"]
fn hits_in_a_room() {
    on_this_device(&[
        one_picture_is_the_same,
        empty_scenes_are_empty,
        frames_in_flight_have_their_own_bodies,
        a_device_that_comes_back_draws_the_same,
    ]);
}

#[test]
#[ignore = "the last test runs it, on a device with ray query"]
fn hits_in_the_demo() {
    on_this_device(&[moving_frames_are_the_same]);
}

/// The command that runs a test on the software Vulkan of newer packages, if it is unpacked here.
fn on_unpacked_driver(test: &str) -> Result<Command, String> {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../target/gpu-drivers"));
    let drivers = folder.canonicalize().map_err(|e| e.to_string())?;
    let program = std::env::current_exe().map_err(|e| e.to_string())?;
    let scratch = drivers.join("manifests");
    std::fs::create_dir_all(&scratch).map_err(|e| e.to_string())?;
    let mut command = SOFTWARE.command(&drivers, &program, &scratch)?;
    let cache = std::env::var_os("MESA_SHADER_CACHE_DIR").map_or_else(std::env::temp_dir, PathBuf::from);
    command
        .args(["--exact", test, "--ignored", "--nocapture"])
        .env("MESA_SHADER_CACHE_DISABLE", "false")
        .env("MESA_SHADER_CACHE_DIR", cache.join("ray-query"));
    Ok(command)
}

/// Runs a test in a process of its own, which must pass.
fn passes(mut command: Command) -> String {
    let out = command.output().expect("the test runs again");
    let text = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(out.status.success(), "{text}{}", String::from_utf8_lossy(&out.stderr));
    assert!(text.contains("1 passed"), "{text}");
    text
}

#[test]
fn a_device_that_traces_rays_itself_finds_what_the_walk_finds() {
    let device = Gpu::open(&GpuOptions::default()).unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    let summary = device.summary().clone();
    drop(device);
    if summary.ray_query {
        hits_in_a_room();
        return hits_in_the_demo();
    }
    // All of them are made before the first one runs, because they share the driver's manifest.
    let commands: Result<Vec<_>, _> =
        ["real_pace::ray_query::hits_in_a_room", "real_pace::ray_query::hits_in_the_demo"]
            .into_iter()
            .map(on_unpacked_driver)
            .collect();
    match commands {
        Ok(commands) => std::thread::scope(|scope| {
            let all: Vec<_> = commands.into_iter().map(|c| scope.spawn(move || passes(c))).collect();
            for process in all {
                println!("{}", process.join().expect("the test passes"));
            }
        }),
        Err(reason) => panic!(
            "{} has no ray query, and no newer driver is unpacked here ({reason}): run \
             tests/gpu-compile/drivers target/gpu-drivers backports",
            summary.name
        ),
    }
}

/// A device without ray query is refused by name where it is asked for, and draws by the walk where it is not.
#[test]
fn a_device_without_ray_query_is_refused_only_if_it_is_asked_for() {
    with_gpu(|gpu| {
        let scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::splat(0.7)));
        let of = |tracing| Renderer::new(gpu, &scene, shot_of(&scene, tracing).settings());
        let summary = gpu.summary();
        let auto = of(Tracing::Auto).expect("auto fits every device");
        assert_eq!(auto.asks_device(), summary.ray_query && !summary.software);
        assert!(!of(Tracing::Walk).expect("so does the walk").asks_device());
        match of(Tracing::RayQuery) {
            Ok(renderer) => assert!(summary.ray_query && renderer.asks_device()),
            Err(e) => {
                let text = e.to_string();
                assert!(!summary.ray_query, "{text}");
                for word in [&summary.name, "render.tracing", "ray query", "\"walk\""] {
                    assert!(text.contains(word), "{word} in {text}");
                }
            }
        }
    });
}
