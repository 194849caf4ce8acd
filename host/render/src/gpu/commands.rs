//! Command lists recorded once and submitted every frame, with time stamps between passes.

use super::buffer::Buffer;
use super::context::{Gpu, On as _};
use super::error::GpuError;
use super::pipeline::{BindingSet, ComputePipeline};
use ash::vk;
use dpm_handoff::path::{within, Place};
use std::sync::Arc;

/// A list of passes that the GPU runs in order. Recorded once; each submission runs it again.
pub struct CommandList {
    pub(super) buffer: vk::CommandBuffer,
    pool: vk::CommandPool,
    queries: Option<vk::QueryPool>,
    stamps: u32,
    max_stamps: u32,
    pub(super) gpu: Arc<Gpu>,
}

impl CommandList {
    /// Records the commands of `record`, with at most `max_stamps` time stamps.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub fn record(
        gpu: &Arc<Gpu>,
        max_stamps: u32,
        record: impl FnOnce(&mut Recorder<'_>),
    ) -> Result<Self, GpuError> {
        gpu.alive("recording commands")?;
        let d = &gpu.device;
        let info = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.queue_family);
        // SAFETY: valid create infos; everything is destroyed in Drop.
        unsafe {
            let pool = d.create_command_pool(&info, None).on(gpu, "creating a command pool")?;
            let buffer = vk::CommandBuffer::null();
            let mut list = Self { buffer, pool, queries: None, stamps: 0, max_stamps, gpu: gpu.clone() };
            let info = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            list.buffer = d.allocate_command_buffers(&info).on(gpu, "allocating a command buffer")?[0];
            if max_stamps > 0 && gpu.summary().timestamp_period_ns > 0.0 {
                let info = vk::QueryPoolCreateInfo::default()
                    .query_type(vk::QueryType::TIMESTAMP)
                    .query_count(max_stamps);
                list.queries = Some(d.create_query_pool(&info, None).on(gpu, "creating time stamps")?);
            }
            let begin = vk::CommandBufferBeginInfo::default();
            d.begin_command_buffer(list.buffer, &begin).on(gpu, "beginning a command buffer")?;
            if let Some(q) = list.queries {
                d.cmd_reset_query_pool(list.buffer, q, 0, max_stamps);
            }
            record(&mut Recorder { list: &mut list });
            d.end_command_buffer(list.buffer).on(gpu, "ending a command buffer")?;
            Ok(list)
        }
    }

    /// Records other commands in the place of the list's own, without time stamps. Its last run has ended. Allocates nothing.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub(crate) fn record_again(&mut self, record: impl FnOnce(&mut Recorder<'_>)) -> Result<(), GpuError> {
        let gpu = self.gpu.clone();
        gpu.alive("recording commands")?;
        let begin = vk::CommandBufferBeginInfo::default();
        within(Place::Vulkan, || {
            // SAFETY: the pool has this buffer alone, which is not pending.
            unsafe {
                gpu.device.reset_command_pool(self.pool, vk::CommandPoolResetFlags::empty())?;
                gpu.device.begin_command_buffer(self.buffer, &begin)?;
            }
            record(&mut Recorder { list: self });
            // SAFETY: recording began above.
            unsafe { gpu.device.end_command_buffer(self.buffer) }
        })
        .on(&gpu, "recording commands")
    }

    /// Fills in the time stamps of the last finished run, in nanoseconds since the first of them, and returns their number.
    /// Allocates nothing.
    pub(crate) fn stamps_ns(&self, out: &mut [u64]) -> usize {
        let n = self.ticks(out);
        let first = out.first().copied().unwrap_or(0);
        out[..n].iter_mut().for_each(|stamp| *stamp = self.ns(stamp.wrapping_sub(first)));
        n
    }

    /// The same since a time of the device's own.
    pub(crate) fn own_stamps_ns(&self, out: &mut [u64]) -> usize {
        let n = self.ticks(out);
        out[..n].iter_mut().for_each(|stamp| *stamp = self.ns(*stamp));
        n
    }

    fn ns(&self, ticks: u64) -> u64 {
        (ticks as f64 * f64::from(self.gpu.summary().timestamp_period_ns)) as u64
    }

    fn ticks(&self, out: &mut [u64]) -> usize {
        let Some(queries) = self.queries.filter(|_| !self.gpu.is_lost()) else { return 0 };
        let n = (self.stamps as usize).min(out.len());
        // SAFETY: the queries were written by the last submission, whose fence the caller waited for.
        let ok = within(Place::Vulkan, || unsafe {
            self.gpu.device.get_query_pool_results(queries, 0, &mut out[..n], vk::QueryResultFlags::TYPE_64)
        });
        if ok.is_err() {
            0
        } else {
            n
        }
    }

    /// Runs the list. `fence` is signalled when it is done. A device that is lost or was given up is not used.
    ///
    /// # Errors
    /// Device lost or given up, [`GpuError::InFlight`] when the fence's last submission was not waited for to its end, out of memory in
    /// the driver.
    pub fn submit(&self, fence: &mut FrameFence) -> Result<(), GpuError> {
        submit_in_turn(&[self.buffer], fence)
    }
}

/// Runs command buffers one after the other on the first queue. `fence` is signalled when all are done.
///
/// # Errors
/// As [`CommandList::submit`].
pub(super) fn submit_in_turn(buffers: &[vk::CommandBuffer], fence: &mut FrameFence) -> Result<(), GpuError> {
    let gpu = fence.gpu.clone();
    fence.check_free()?;
    let info = [vk::SubmitInfo::default().command_buffers(buffers)];
    let ([queue, _], _turn) = gpu.queues()?;
    fence.reset()?;
    // SAFETY: the fence is unsignalled, and the turn at the queue is this thread's.
    within(Place::Vulkan, || unsafe { gpu.device.queue_submit(queue, &info, fence.fence) })
        .on(&gpu, "submitting a frame")?;
    fence.pending = true;
    Ok(())
}

impl Drop for CommandList {
    fn drop(&mut self) {
        let (queries, pool) = (self.queries, self.pool);
        self.gpu.destroy(move |gpu| {
            // SAFETY: owners wait for the fence first.
            unsafe {
                if let Some(q) = queries {
                    gpu.device.destroy_query_pool(q, None);
                }
                gpu.device.destroy_command_pool(pool, None);
            }
        });
    }
}

/// Records passes.
pub struct Recorder<'a> {
    pub(super) list: &'a mut CommandList,
}

impl Recorder<'_> {
    /// Runs `pipeline` over as many workgroups as `arguments` holds at `offset` (three u32) when the list runs.
    pub(crate) fn dispatch_indirect(
        &mut self,
        pipeline: &ComputePipeline,
        set: &BindingSet,
        arguments: &Buffer,
        offset: u64,
    ) {
        self.bind(pipeline, set);
        // SAFETY: recording; the argument buffer is kept alive by the owner of the list.
        unsafe { self.list.gpu.device.cmd_dispatch_indirect(self.list.buffer, arguments.handle, offset) }
    }

    /// Runs `pipeline` over a fixed number of workgroups.
    pub fn dispatch(&mut self, pipeline: &ComputePipeline, set: &BindingSet, groups: [u32; 3]) {
        self.bind(pipeline, set);
        // SAFETY: recording.
        unsafe { self.list.gpu.device.cmd_dispatch(self.list.buffer, groups[0], groups[1], groups[2]) }
    }

    fn bind(&mut self, pipeline: &ComputePipeline, set: &BindingSet) {
        let d = &self.list.gpu.device;
        // SAFETY: recording; pipeline and set are kept alive by the owner of the list.
        unsafe {
            d.cmd_bind_pipeline(self.list.buffer, vk::PipelineBindPoint::COMPUTE, pipeline.pipeline);
            d.cmd_bind_descriptor_sets(
                self.list.buffer,
                vk::PipelineBindPoint::COMPUTE,
                pipeline.table.layouts.pipeline,
                0,
                &[set.set],
                &[],
            );
        }
    }

    /// Makes everything written so far visible to what follows: shaders, indirect arguments and copies.
    pub fn barrier(&mut self) {
        use vk::{AccessFlags as A, PipelineStageFlags as S};
        let barrier = vk::MemoryBarrier::default()
            .src_access_mask(A::SHADER_WRITE | A::TRANSFER_WRITE)
            .dst_access_mask(
                A::SHADER_READ
                    | A::SHADER_WRITE
                    | A::UNIFORM_READ
                    | A::TRANSFER_READ
                    | A::TRANSFER_WRITE
                    | A::INDIRECT_COMMAND_READ,
            );
        let stages = S::COMPUTE_SHADER | S::TRANSFER;
        self.pipeline_barrier(stages, stages | S::DRAW_INDIRECT, barrier);
    }

    /// Makes everything written so far visible to the host after the fence.
    pub fn barrier_to_host(&mut self) {
        use vk::{AccessFlags as A, PipelineStageFlags as S};
        let barrier = vk::MemoryBarrier::default()
            .src_access_mask(A::SHADER_WRITE | A::TRANSFER_WRITE)
            .dst_access_mask(A::HOST_READ);
        self.pipeline_barrier(S::COMPUTE_SHADER | S::TRANSFER, S::HOST, barrier);
    }

    /// Makes what the host has written meanwhile visible to what follows.
    pub(crate) fn barrier_from_host(&mut self) {
        use vk::{AccessFlags as A, PipelineStageFlags as S};
        let barrier = vk::MemoryBarrier::default()
            .src_access_mask(A::HOST_WRITE)
            .dst_access_mask(A::SHADER_READ | A::TRANSFER_READ | A::INDIRECT_COMMAND_READ);
        self.pipeline_barrier(S::HOST, S::COMPUTE_SHADER | S::TRANSFER | S::DRAW_INDIRECT, barrier);
    }

    pub(super) fn pipeline_barrier(
        &mut self,
        from: vk::PipelineStageFlags,
        to: vk::PipelineStageFlags,
        barrier: vk::MemoryBarrier<'_>,
    ) {
        // SAFETY: recording.
        unsafe {
            self.list.gpu.device.cmd_pipeline_barrier(
                self.list.buffer,
                from,
                to,
                vk::DependencyFlags::empty(),
                &[barrier],
                &[],
                &[],
            );
        }
    }

    /// Copies the first `bytes` of one buffer to another.
    pub fn copy(&mut self, from: &Buffer, to: &Buffer, bytes: usize) {
        self.copy_to(from, to, bytes, 0);
    }

    /// Copies the first `bytes` of one buffer to another, from the byte `at` there on.
    pub(crate) fn copy_to(&mut self, from: &Buffer, to: &Buffer, bytes: usize, at: usize) {
        self.copy_part((from, 0), (to, at), bytes);
    }

    /// Copies `bytes` of one buffer, from a byte on, to another, from a byte there on.
    pub(crate) fn copy_part(
        &mut self,
        (from, src): (&Buffer, usize),
        (to, dst): (&Buffer, usize),
        bytes: usize,
    ) {
        let region = [vk::BufferCopy { src_offset: src as u64, dst_offset: dst as u64, size: bytes as u64 }];
        // SAFETY: recording; both buffers have transfer usage and are kept alive by the owner.
        unsafe { self.list.gpu.device.cmd_copy_buffer(self.list.buffer, from.handle, to.handle, &region) }
    }

    /// Fills a buffer with zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        // SAFETY: recording; the buffer has transfer usage.
        unsafe { self.list.gpu.device.cmd_fill_buffer(self.list.buffer, buffer.handle, 0, vk::WHOLE_SIZE, 0) }
    }

    /// A time stamp after all passes so far. Stamps beyond the list's maximum are left out.
    pub(crate) fn stamp(&mut self) {
        if let Some(queries) = self.list.queries {
            if self.list.stamps < self.list.max_stamps {
                // SAFETY: recording; the index is below the pool's size.
                unsafe {
                    self.list.gpu.device.cmd_write_timestamp(
                        self.list.buffer,
                        vk::PipelineStageFlags::BOTTOM_OF_PIPE,
                        queries,
                        self.list.stamps,
                    );
                }
                self.list.stamps += 1;
            }
        }
    }
}

/// How long to wait for the end of a submission before its memory is freed. After that the device is given up and keeps the memory until it has
/// finished.
pub(super) const LAST_WAIT_NS: u64 = 2_000_000_000;

/// Signals when a submission is done. Dropping it waits for the submission, at most 2 s, and not at all if the device is lost or was given up.
pub struct FrameFence {
    pub(super) fence: vk::Fence,
    pub(super) pending: bool,
    pub(super) gpu: Arc<Gpu>,
}

impl FrameFence {
    /// # Errors
    /// A call of Vulkan failed.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        gpu.alive("making a fence")?;
        // SAFETY: valid create info; destroyed in Drop.
        let fence = unsafe { gpu.device.create_fence(&vk::FenceCreateInfo::default(), None) }
            .on(gpu, "creating a fence")?;
        Ok(Self { fence, pending: false, gpu: gpu.clone() })
    }

    /// Waits at most `timeout_ns` for the last submission. Returns at once if there is none. May be called again after a timeout as often as needed.
    ///
    /// # Errors
    /// [`GpuError::Timeout`] (the submission is still pending), or device lost or given up.
    pub fn wait(&mut self, timeout_ns: u64) -> Result<(), GpuError> {
        if self.poll(timeout_ns)? {
            return Ok(());
        }
        let device = self.gpu.device_name().clone();
        Err(GpuError::Timeout { device, waited_ms: timeout_ns / 1_000_000 })
    }

    /// The same, but returns false after a timeout. Allocates nothing.
    ///
    /// # Errors
    /// The device is lost or was given up. This is final: the results of the submission will never be valid.
    pub(crate) fn poll(&mut self, timeout_ns: u64) -> Result<bool, GpuError> {
        self.gpu.alive("waiting for a frame")?;
        if !self.pending {
            return Ok(true);
        }
        // SAFETY: the fence is alive.
        let done = within(Place::Vulkan, || unsafe {
            self.gpu.device.wait_for_fences(&[self.fence], true, timeout_ns)
        });
        match done {
            Ok(()) => {
                self.pending = false;
                Ok(true)
            }
            Err(vk::Result::TIMEOUT) => Ok(false),
            // The submission may still be pending, unless the device is lost, which the device remembers.
            Err(e) => Err(e).on(&self.gpu, "waiting for a frame"),
        }
    }

    /// Makes the fence ready for a submission, unless another thread has noticed that the device is lost.
    ///
    /// # Errors
    /// Device lost or given up.
    pub(super) fn reset(&mut self) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        // SAFETY: the fence is unused: `wait` consumed its last run.
        within(Place::Vulkan, || unsafe { gpu.device.reset_fences(&[self.fence]) })
            .on(gpu, "resetting a fence")?;
        gpu.alive("submitting a frame")
    }

    /// Refuses to be used for two submissions at once.
    ///
    /// # Errors
    /// Device lost or given up; [`GpuError::InFlight`].
    pub(crate) fn check_free(&self) -> Result<(), GpuError> {
        self.gpu.alive("submitting a frame")?;
        if self.pending {
            return Err(GpuError::InFlight { device: self.gpu.device_name().clone() });
        }
        Ok(())
    }
}

impl Drop for FrameFence {
    fn drop(&mut self) {
        if !matches!(self.poll(LAST_WAIT_NS), Ok(true)) && !self.gpu.is_lost() {
            self.gpu.give_up();
        }
        let fence = self.fence;
        if self.pending && self.gpu.is_abandoned() {
            return self.gpu.leave(fence);
        }
        // SAFETY: not pending any more, or the device is lost.
        self.gpu.destroy(move |gpu| unsafe { gpu.device.destroy_fence(fence, None) });
    }
}

/// Records, runs and waits. It is used for loading, and never on the way of a frame. A device that does not finish is given up.
///
/// # Errors
/// A call of Vulkan failed, or [`GpuError::Timeout`].
pub(crate) fn run_now(gpu: &Arc<Gpu>, record: impl FnOnce(&mut Recorder<'_>)) -> Result<(), GpuError> {
    let list = CommandList::record(gpu, 0, record)?;
    let mut fence = FrameFence::new(gpu)?;
    list.submit(&mut fence)?;
    let done = fence.wait(gpu.setup_wait_ns());
    if matches!(done, Err(GpuError::Timeout { .. })) {
        gpu.give_up();
    }
    done
}

/// Copies now and waits. It is used for loading, and never on the way of a frame.
pub(super) fn copy_now(gpu: &Arc<Gpu>, from: &Buffer, to: &Buffer, bytes: usize) -> Result<(), GpuError> {
    run_now(gpu, |r| r.copy(from, to, bytes))
}

#[cfg(test)]
mod tests {
    use crate::gpu::{memory_given_up, Buffer, FrameFence, Gpu, GpuOptions, MemoryKind};
    use ash::vk;
    use std::time::{Duration, Instant};

    /// Large enough that its pages go back to the system when it is freed: reading them then would end this process.
    const LEN: usize = 64 << 20;

    #[test]
    fn a_device_that_was_given_up_keeps_its_memory_until_it_has_finished() {
        let gpu = Gpu::open(&GpuOptions::default()).expect("a Vulkan device");
        let mut buffer = Buffer::new(&gpu, "kept", LEN, MemoryKind::Upload).expect("memory");
        buffer.bytes_mut().fill(7);
        let first = buffer.bytes_mut().as_ptr();
        // A submission that does not end: of this fence nothing was submitted yet.
        let mut fence = FrameFence::new(&gpu).expect("a fence");
        fence.pending = true;
        let raw = fence.fence;
        let before = memory_given_up();
        gpu.give_up();
        gpu.give_up();
        drop((fence, buffer));
        // SAFETY: what a device that was given up may use is not freed.
        let bytes = unsafe { std::slice::from_raw_parts(first, LEN) };
        assert!(bytes.iter().step_by(4096).all(|b| *b == 7));
        // Counted once, and by no more than what it held. (Other tests of this process may give up devices of their own meanwhile.)
        let after = memory_given_up();
        assert!(after.devices > before.devices && after.bytes >= before.bytes + LEN as u64);
        // It finishes at last.
        let ([queue, _], turn) = gpu.queues().expect("nobody else submits");
        // SAFETY: the turn is this thread's, and the fence, which waits for its end, is unsignalled.
        unsafe { gpu.device.queue_submit(queue, &[vk::SubmitInfo::default()], raw) }.expect("it works");
        drop(turn);
        let begin = Instant::now();
        while memory_given_up().bytes >= before.bytes + LEN as u64 {
            assert!(begin.elapsed() < Duration::from_secs(60), "never freed");
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
