//! Rasters at the limit of what a device can bind at once: every method whose own buffers fit can trace them, and the
//! others are refused by name.

use dpm_lab::sequence::{draw, poses_at};
use dpm_render::{RenderError, Renderer, RendererSettings};
use dpm_rig::config::{RenderConfig, RenderMethod};
use dpm_rig::pipeline::renderer_settings;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;

#[test]
fn a_raster_is_traced_where_the_buffers_of_its_method_fit() {
    with_gpu(|gpu| {
        for (width, height, which, bytes_per_pixel) in [
            (1280, 1024, RenderMethod::Dpm, 64),
            (2560, 1440, RenderMethod::Full, 16),
            (2560, 1440, RenderMethod::Dpm, 64),
        ] {
            let rig = demo_rig(width, height, &[]);
            let method = RenderConfig { method: which, ..rig.config.render.clone() }.to_method();
            let settings = RendererSettings { method, ..renderer_settings(&rig) };
            let fits = u64::from(width * height * bytes_per_pixel) <= gpu.max_buffer_bytes();
            let what = format!("{which:?} at {width} x {height}");
            let mut renderer = match (Renderer::new(gpu, &rig.scene, settings), fits) {
                (Ok(renderer), true) => renderer,
                (Err(RenderError::Raster(e)), false) => {
                    assert_eq!((e.what, e.frugal_fits), ("history", true), "{what}");
                    continue;
                }
                (Ok(_), false) => panic!("{what} binds more than the device allows"),
                (Err(e), _) => panic!("{what}: {e}"),
            };
            // The buffers that are read back afterwards fit too.
            let mut slot = renderer.create_slot(true).unwrap_or_else(|e| panic!("{what}: {e}"));
            let poses = poses_at(&rig, 0);
            let mut frame = |k| draw(&rig, &mut renderer, &mut slot, &poses, k, 1.0).map(|c| c.counters());
            // Both of the buffers that frames write alternately.
            let counted = [frame(0).unwrap(), frame(1).unwrap()];
            for c in counted {
                assert!(c.lit_pixels > width * height / 20 && c.samples > 0, "{what}: {c:?}");
            }
            let last = slot.codes().iter().rposition(|c| *c != 0).unwrap_or(0);
            assert!(last > slot.codes().len() / 2, "{what}: the lower half is dark");
            assert_eq!(slot.history().is_some(), which == RenderMethod::Dpm, "{what}");
        }
    });
}
