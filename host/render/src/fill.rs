//! Fills a device buffer with copies of one value at set-up, or changes some of its values between the frames of a check.

use crate::gpu::{run_now, Buffer, Gpu, GpuError, MemoryKind};
use bytemuck::Pod;
use std::ops::Range;
use std::sync::Arc;

/// Changes a range of a buffer's values on the host, and waits.
pub(super) fn edit<T: Pod>(
    gpu: &Arc<Gpu>,
    buffer: &Buffer,
    range: Range<usize>,
    mut change: impl FnMut(&mut T),
) -> Result<(), GpuError> {
    let bytes = range.end * size_of::<T>();
    let back = Buffer::new(gpu, "read back", bytes, MemoryKind::Readback)?;
    run_now(gpu, |r| r.copy(buffer, &back, bytes))?;
    let mut staging = Buffer::new(gpu, "staging", bytes, MemoryKind::Upload)?;
    let mut values: Vec<T> = back.read::<T>(range.end).to_vec();
    values[range].iter_mut().for_each(&mut change);
    staging.bytes_mut()[..bytes].copy_from_slice(bytemuck::cast_slice(&values));
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
