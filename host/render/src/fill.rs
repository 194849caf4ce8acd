//! Fills a device buffer with copies of one value at set-up, or changes some of its values between the frames of a check.

use crate::gpu::{run_now, Buffer, Gpu, GpuError, MemoryKind};
use bytemuck::Pod;
use std::sync::Arc;

/// Changes the first bytes of a buffer on the host, and waits.
pub(super) fn edit(
    gpu: &Arc<Gpu>,
    buffer: &Buffer,
    bytes: usize,
    change: impl FnOnce(&[u8]) -> Vec<u8>,
) -> Result<(), GpuError> {
    let back = Buffer::new(gpu, "read back", bytes, MemoryKind::Readback)?;
    run_now(gpu, |r| r.copy(buffer, &back, bytes))?;
    let mut staging = Buffer::new(gpu, "staging", bytes, MemoryKind::Upload)?;
    staging.bytes_mut()[..bytes].copy_from_slice(&change(back.read::<u8>(bytes)));
    run_now(gpu, |r| r.copy(&staging, buffer, bytes))
}

/// Writes `count` copies of `value` and waits.
pub(super) fn fill<T: Pod>(gpu: &Arc<Gpu>, buffer: &Buffer, value: &T, count: usize) -> Result<(), GpuError> {
    let mut staging = Buffer::new(gpu, "staging", count * size_of::<T>(), MemoryKind::Upload)?;
    let bytes = bytemuck::bytes_of(value);
    for chunk in staging.bytes_mut()[..count * size_of::<T>()].chunks_exact_mut(bytes.len()) {
        chunk.copy_from_slice(bytes);
    }
    run_now(gpu, |r| r.copy(&staging, buffer, count * size_of::<T>()))
}
