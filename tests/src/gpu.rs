//! Opens the GPU with validation.

use dpm_render::gpu::{validation_messages, Gpu, GpuOptions};
use std::sync::Arc;

/// Opens the GPU with validation and synchronisation validation, runs the test, closes the GPU, and checks that
/// validation reported nothing.
///
/// # Panics
/// There is no Vulkan driver (the message has the advice of `dpm doctor`), or validation reported something.
pub fn with_gpu(test: impl FnOnce(&Arc<Gpu>)) {
    let gpu = Gpu::open(&GpuOptions { validation: true, device: None })
        .unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    test(&gpu);
    drop(gpu);
    let (count, texts) = validation_messages();
    assert_eq!(count, 0, "Vulkan validation reported:\n{}", texts.join("\n"));
}
