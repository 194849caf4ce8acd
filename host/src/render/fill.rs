//! Fills a device buffer with copies of one value, at set-up time.

use crate::gpu::{Buffer, CommandList, FrameFence, Gpu, GpuError, MemoryKind};
use bytemuck::Pod;
use std::sync::Arc;

/// Writes `count` copies of `value` and waits.
pub(super) fn fill<T: Pod>(gpu: &Arc<Gpu>, buffer: &Buffer, value: &T, count: usize) -> Result<(), GpuError> {
    let mut staging = Buffer::new(gpu, "staging", count * size_of::<T>(), MemoryKind::Upload)?;
    let bytes = bytemuck::bytes_of(value);
    for chunk in staging.bytes_mut()[..count * size_of::<T>()].chunks_exact_mut(bytes.len()) {
        chunk.copy_from_slice(bytes);
    }
    let list = CommandList::record(gpu, 0, |r| r.copy(&staging, buffer, count * size_of::<T>()))?;
    let mut fence = FrameFence::new(gpu)?;
    list.submit(&mut fence)?;
    fence.wait(60_000_000_000)
}
