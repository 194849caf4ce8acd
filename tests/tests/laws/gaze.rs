//! A gaze that is no longer tracked is held; then the zones of full quality grow until they contain the whole
//! picture.

use dpm_render::{FrameInputs, Renderer, RendererSettings};
use dpm_rig::pipeline::renderer_settings;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;

#[test]
fn wider_zones_are_the_zones_of_a_rig_file_with_wider_angles() {
    with_gpu(|gpu| {
        // Angles that divide the small picture. There is no rate map and no checkerboard, so samples follow the zones
        // alone.
        let rig = demo_rig(
            64,
            48,
            &[
                "render.method=\"paper\"",
                "render.effects.rate_map=false",
                "render.effects.checkerboard=false",
                "render.paper.phi_h_deg=4.0",
                "render.paper.phi_q_deg=8.0",
                "render.paper.zone_spp=[6,3,1]",
                "observer.gaze={kind=\"point\",point=[-0.2,0.0,0.0]}",
            ],
        );
        let samples = |widen_deg: f32, phi_deg: [f64; 2]| {
            let mut settings: RendererSettings = renderer_settings(&rig);
            [settings.method.paper.phi_h_deg, settings.method.paper.phi_q_deg] = phi_deg;
            let mut renderer = Renderer::new(gpu, &rig.scene, settings).unwrap();
            let mut slot = renderer.create_slot(false).unwrap();
            let tracked: Vec<_> = rig.bodies.iter().map(|b| dpm_rig::rig::affine(&b.rest)).collect();
            let mut poses = Vec::new();
            rig.scene_poses(&tracked, 0, &mut poses);
            let still = FrameInputs::new(&rig.camera, rig.observer.eye_and_gaze(&tracked), &poses);
            let inputs = FrameInputs { widen_deg, ..still };
            renderer.submit(&mut slot, &inputs).unwrap();
            let counters = slot.wait(60_000_000_000).unwrap().counters();
            (counters.samples, counters.lit_pixels)
        };
        let (narrow, lit) = samples(0.0, [4.0, 8.0]);
        let (wider, _) = samples(3.0, [4.0, 8.0]);
        assert!(
            lit < narrow && narrow < wider && wider < 6 * lit,
            "{lit} pixels, {narrow} and {wider} samples"
        );
        assert_eq!(wider, samples(0.0, [7.0, 11.0]).0);
        assert_eq!(samples(180.0, [4.0, 8.0]).0, 6 * lit, "everything is in the fovea");
    });
}
