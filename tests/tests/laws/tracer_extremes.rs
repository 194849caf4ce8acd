//! Rays, shapes, lights and histories at the limits of number formats: all stability cases on the GPU, with
//! validation. Also a lost body, for which there is no stability case.

use dpm_lab::stability::gpu::cases;
use dpm_lab::stability::gpu_shot::{Picture, Shot};
use dpm_lab::stability::{CaseVerdict, StabilityReport, SEED};
use dpm_scene::shapes::*;
use dpm_scene::Material;
use dpm_tests::gpu::with_gpu;
use glam::{DVec3, Vec3};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

/// Number of cases that run at the same time, each on a device of its own. A case keeps little more than one core busy,
/// and one after the other took six minutes.
const WORKERS: usize = 2;

/// Every case, because those that guard the newest code are among the slow ones.
#[test]
fn every_case_passes_on_the_gpu() {
    let next = AtomicUsize::new(0);
    let report = Mutex::new(StabilityReport::default());
    let worker = || {
        with_gpu(|gpu| {
            let all = cases(&Ok(gpu.clone()));
            assert!(all.len() >= 50, "{}", all.len());
            while let Some(case) = all.get(next.fetch_add(1, Ordering::Relaxed)) {
                let mut one = StabilityReport::default();
                one.run_cases(std::slice::from_ref(case), None, SEED..=SEED, |c| {
                    println!("{:<28} {:?} <= {} {} {:.1} s", c.name, c.error, c.bound, c.unit, c.wall_s);
                });
                report.lock().unwrap().cases.extend(one.cases);
            }
        });
    };
    std::thread::scope(|threads| {
        for _ in 0..WORKERS {
            threads.spawn(worker);
        }
    });
    let report = report.into_inner().unwrap();
    let all = cases(&Err("only to be counted".into())).len();
    assert_eq!(report.cases.len(), all);
    let failed: Vec<_> = report.cases.iter().filter(|c| c.verdict != CaseVerdict::Pass).collect();
    assert!(failed.is_empty(), "{failed:#?}");
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
        let on_ball = |p: &Picture| {
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
