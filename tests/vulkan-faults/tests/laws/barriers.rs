//! A frame is recorded with one of its barriers left out, for each of them in turn: synchronisation validation says so. This is the proof
//! that its silence in all other tests means something, and that no barrier of a frame is idle.

use crate::common::{assert_no_validation_messages, layer, rig, Bench};
use dpm_render::gpu::validation_messages;
use dpm_render::{Renderer, RendererSettings};
use dpm_rig::config::RenderMethod;
use dpm_rig::pipeline::renderer_settings;
use vulkan_faults::Call;

/// Every barrier.
mod breadth {
    use super::*;

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
            // Both pairs of lists of a slot hold the same passes, each for one of the two history buffers.
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
            // A frame is two lists. Validation does not look from one list into another, so it does not miss the barrier at the end of the first,
            // which comes after the copies of the host's words and each pass that the next frame waits for. The last barrier of the second makes the
            // results visible to the host, whose reads validation does not see.
            let first = match method {
                RenderMethod::Dpm => 6,
                RenderMethod::Paper => 7,
                _ => 4,
            };
            let half = barriers / 2;
            let expected = [first, half, half + first, barriers];
            assert_eq!(silent, expected, "{method:?}: barriers that nobody misses");
        }
    }
}
