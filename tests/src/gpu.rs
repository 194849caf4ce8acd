//! Opens the GPU with validation, and runs a shader alone.

use dpm_render::gpu::{
    validation_messages, BindingKind, BindingSet, BindingTable, Buffer, CommandList, ComputePipeline,
    FrameFence, Gpu, GpuOptions, MemoryKind,
};
use dpm_shaders::structs::{is_of_enlarging, is_of_software, BINDINGS};
use dpm_shaders::Shader;
use std::sync::Arc;

/// Opens the GPU with validation and synchronisation validation, runs the test, closes the GPU, and checks that
/// validation reported nothing.
///
/// # Panics
/// There is no Vulkan driver (the message has the advice of `dpm doctor`), or validation reported something.
pub fn with_gpu(test: impl FnOnce(&Arc<Gpu>)) {
    let gpu = Gpu::open(&GpuOptions { validation: true, ..GpuOptions::default() })
        .unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    test(&gpu);
    drop(gpu);
    let (count, texts) = validation_messages();
    assert_eq!(count, 0, "Vulkan validation reported:\n{}", texts.join("\n"));
}

/// Runs a shader of the renderer alone, without a scene, and returns the first `len` bytes of the buffer `result`, one
/// of `buffers`, which are given by the names of their bindings. All other bindings are unused ones.
///
/// # Panics
/// When Vulkan refuses something: a failure of the test.
pub fn run_shader(
    gpu: &Arc<Gpu>,
    (shader, constants): (Shader, &[(u32, u32)]),
    workgroups: [u32; 3],
    buffers: &[(&str, &Buffer)],
    (result, len): (&str, usize),
) -> Vec<u8> {
    let unused = Buffer::new(gpu, "unused", 16, MemoryKind::Device).unwrap();
    let host = Buffer::new(gpu, "result", len, MemoryKind::Readback).unwrap();
    // As the renderer on a GPU: devices bind a limited number, and second bindings as texels are for software Vulkan.
    let bound = || BINDINGS.iter().filter(|(name, _)| !is_of_software(name) && !is_of_enlarging(name));
    let kinds: Vec<_> = bound().map(|&(_, binding)| (binding, BindingKind::Storage)).collect();
    let table = BindingTable::new(gpu, &kinds).unwrap();
    let pipeline = ComputePipeline::new(&table, shader, constants).unwrap();
    let find = |name: &str| buffers.iter().find(|(n, _)| *n == name).map(|(_, buffer)| *buffer);
    let bindings: Vec<_> = bound().map(|&(name, binding)| (binding, find(name).unwrap_or(&unused))).collect();
    let set = BindingSet::new(&table, &bindings).unwrap();
    let list = CommandList::record(gpu, 0, |r| {
        r.dispatch(&pipeline, &set, workgroups);
        r.barrier();
        r.copy(find(result).expect("one of the buffers"), &host, len);
        r.barrier_to_host();
    })
    .unwrap();
    let mut fence = FrameFence::new(gpu).unwrap();
    list.submit(&mut fence).unwrap();
    fence.wait(20_000_000_000).unwrap();
    host.read(len).to_vec()
}

/// A buffer that holds `bytes`.
///
/// # Panics
/// When there is no memory for it.
pub fn uploaded(gpu: &Arc<Gpu>, what: &str, bytes: &[u8]) -> Buffer {
    let mut buffer = Buffer::new(gpu, what, bytes.len(), MemoryKind::Upload).unwrap();
    buffer.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
    buffer
}
