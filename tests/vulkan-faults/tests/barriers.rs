//! A frame is recorded with one of its barriers left out, for each of them in turn: synchronisation validation says so. This is the proof
//! that its silence in all other tests means something, and that no barrier of a frame is idle.

mod common;

use common::{assert_no_validation_messages, layer, rig, Bench};
use dpm_render::gpu::validation_messages;
use dpm_render::{Renderer, RendererSettings};
use dpm_rig::config::RenderMethod;
use dpm_rig::pipeline::renderer_settings;
use vulkan_faults::Call;

#[test]
fn every_barrier_of_a_frame_is_missed_by_validation() {
    let session = layer("");
    let gpu = Bench::open().gpu;
    assert_no_validation_messages();
    for method in [RenderMethod::Dpm, RenderMethod::Paper, RenderMethod::Full] {
        let mut render = rig().config.render.clone();
        render.method = method;
        let settings = RendererSettings { method: render.to_method(), ..renderer_settings(rig()) };
        let renderer = Renderer::new(&gpu, &rig().scene, settings).unwrap_or_else(|e| panic!("{e}"));
        // Both lists of a slot hold the same passes, each for one of the two history buffers.
        session.set("");
        let told = validation_messages().0;
        drop(renderer.create_slot(false).unwrap_or_else(|e| panic!("{e}")));
        assert_eq!(validation_messages().0, told, "{method:?}: {:?}", validation_messages().1);
        let barriers = session.count(Call::Barrier);
        assert!(barriers >= 8, "{method:?}: {barriers}");
        let silent: Vec<u64> = (1..=barriers)
            .filter(|left_out| {
                session.set(&format!("skip@barrier={left_out}"));
                let told = validation_messages().0;
                drop(renderer.create_slot(false).unwrap_or_else(|e| panic!("{e}")));
                validation_messages().0 == told
            })
            .collect();
        // The last barrier of a list makes its results visible to the host, whose reads validation does not see.
        assert_eq!(silent, [barriers / 2, barriers], "{method:?}: barriers that nobody misses");
    }
}
