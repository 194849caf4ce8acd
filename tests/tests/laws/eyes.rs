//! The eye guard on the whole rig: what the GPU draws is lit as it is drawn, but for the mirrors about a head that passes,
//! wherever planes are packed and although tracks move the light.

use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use glam::DVec2;

#[test]
fn the_light_on_bodies_spares_a_head_that_passes_before_them() {
    with_gpu(|gpu| {
        for packer in ["cpu", "gpu"] {
            let packer = format!("render.packer=\"{packer}\"");
            let keys = [
                "observer.position=[0.0, 0.2, 0.6]",
                "observer.tracked={ name = \"glasses\", motion = { kind = \"sinusoid\", peak_speed_m_s = 1.8, \
                 peak_acceleration_m_s2 = 30.0 } }",
                "observer.gaze={ kind = \"straight\" }",
                "safety.eyes.radius=0.05",
                &packer,
            ];
            let rig = demo_rig(96, 72, &keys);
            assert_eq!(
                (rig.bodies.len(), rig.tracked_count(), rig.scene.bodies.len()),
                (2, 3, demo_rig(96, 72, &[]).scene.bodies.len())
            );
            let (outcome, _) = run(gpu, &rig, 120, 100);
            assert_eq!(outcome.light_mismatches, 0, "{packer}");
            let eyes = outcome.report.eyes.clone().expect("a head is guarded");
            assert_eq!((eyes.frames_cut, eyes.frames_dark), (120, 0), "{packer}");
            let (raster, origin) = (rig.camera.raster, rig.camera.position());
            let (mut lit, mut spared) = (0, 0);
            for light in &outcome.light {
                let head = rig.true_poses(light.first_photon_at.0).expect("the mock tells")[2].translation;
                for (i, code) in light.codes.iter().enumerate() {
                    let (x, y) = (i as u32 % raster.width(), i as u32 / raster.width());
                    let ray = rig.camera.ray(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).direction;
                    let to = head - origin;
                    let meets = (to - ray * to.dot(ray).max(0.0)).length() <= rig.config.safety.eyes.radius;
                    assert!(!meets || *code == [0; 3], "{packer}: frame {}: light on a head", light.frame);
                    spared += usize::from(meets);
                    lit += usize::from(*code != [0; 3]);
                }
            }
            // The bodies beside the head are lit, and the head is before them.
            assert!(
                lit > 100 * outcome.light.len() / 2 && spared > 100 * outcome.light.len(),
                "{lit} {spared}"
            );
        }
    });
}
