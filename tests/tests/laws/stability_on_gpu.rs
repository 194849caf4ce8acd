//! Rays, shapes, lights and histories at the limits of number formats: stability cases on the GPU. Also a lost body, for
//! which there is no case.

use dpm_lab::stability::gpu::cases;
use dpm_lab::stability::gpu_shot::{Shot, ShotPicture};
use dpm_lab::stability::{StabilityReport, SEED};
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_scene::shapes::*;
use dpm_scene::Material;
use dpm_tests::gpu::with_gpu;
use glam::{DVec3, Vec3};

/// Cases that take several seconds each, and whose law another case holds as well. They are of the second tier, which runs
/// all cases, with validation. `tests/mutations/run` reads this list.
pub(crate) const SLOW: [&str; 14] = [
    "gpu-constant-input",
    "gpu-energy-of-every-lobe",
    "gpu-lights-that-touch",
    "gpu-lobes-against-reference",
    "gpu-lobes-energy",
    "gpu-mean-in-motion",
    "gpu-mean-in-motion-metal",
    "gpu-no-light",
    "gpu-random-scenes-mean",
    "gpu-random-scenes-pixels",
    "gpu-random-scenes-surfaces",
    "gpu-rates-keep-energy",
    "gpu-sun-and-lamp",
    "gpu-tiles-at-borders",
];

/// Runs every `PARTS`th case that is not slow, from `part` on, without validation.
fn cases_pass(part: usize) {
    const PARTS: usize = 4;
    let gpu = Gpu::open(&GpuOptions::default()).unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    let all = cases(&Ok(gpu));
    let is_slow = |name: &str| SLOW.contains(&name);
    assert!(SLOW.iter().all(|slow| all.iter().any(|case| case.name == *slow)), "no such case");
    let mine = all.iter().filter(|case| !is_slow(case.name)).skip(part).step_by(PARTS);
    let mut report = StabilityReport::default();
    for case in mine {
        report.run_cases(std::slice::from_ref(case), None, SEED..=SEED, |c| {
            println!("{:<28} {:?} <= {} {} {:.1} s", c.name, c.error, c.bound, c.unit, c.wall_s);
        });
    }
    assert!(report.cases.len() * PARTS + PARTS > all.len() - SLOW.len(), "{} cases", report.cases.len());
    let failed: Vec<_> = report.cases.iter().filter(|c| !c.verdict.is_as_known()).collect();
    assert!(failed.is_empty(), "{failed:#?}");
}

#[test]
fn cases_pass_on_the_gpu() {
    cases_pass(0);
}

#[test]
fn more_cases_pass_on_the_gpu() {
    cases_pass(1);
}

#[test]
fn still_more_cases_pass_on_the_gpu() {
    cases_pass(2);
}

#[test]
fn the_last_cases_pass_on_the_gpu() {
    cases_pass(3);
}

#[test]
fn a_lost_body_gets_no_light_but_its_reflection_stays() {
    with_gpu(|gpu| {
        let mut scene = scene_of(
            floor(1.0, 0.0),
            Material { roughness: 0.0, base_color: Vec3::splat(0.9), ..Material::default() },
        );
        let mut ball = sphere(Vec3::ZERO, 0.3, 2, true);
        ball.positions.iter_mut().for_each(|p| p.y += 0.5);
        let body =
            add(&mut scene, ball, Material { double_sided: true, ..emitter(Vec3::new(1.0, 0.0, 0.0)) });
        scene.bodies[body].tracked = Some(0);
        let camera = camera(48, 36, DVec3::new(0.0, 1.6, 2.2), DVec3::ZERO);
        let eye = DVec3::new(0.05, 1.6, 2.2);
        let shot = Shot { eye: Some(eye), spp: 4, ..Shot::new(&scene, camera) };
        let there = shot.draw(gpu);
        let lost = Shot { lost: vec![true], ..shot }.draw(gpu);
        let on_ball = |p: &ShotPicture| {
            (0..p.surfaces.len()).filter(|&i| p.hit(i) && p.surfaces[i].id >> 24 == body as u32).count()
        };
        assert!(on_ball(&there) > 50);
        assert_eq!(on_ball(&lost), 0, "no ray of the projector ends on a lost body");
        // In the floor's reflection it is red as before, wherever the floor was lit before.
        let mut mirrored = 0;
        for i in 0..there.surfaces.len() {
            if there.lit(i) && there.surfaces[i].id >> 24 == 0 {
                let (a, b) = (there.estimates[i].mean[0], lost.estimates[i].mean[0]);
                assert!((a - b).abs() < 1e-5, "pixel {i}: {a} {b}");
                mirrored += usize::from(a > 0.5);
            }
        }
        assert!(mirrored > 20, "{mirrored}");
    });
}
