//! Two frames on the device at once: a frame's first list goes to one queue and its second list to another, so that the end of a frame and the
//! beginning of the next one share the device.
//!
//! Two timeline semaphores keep the order. The first lists run one after the other, because each needs what the one before left. A second list runs
//! once its frame's first list has ended. And a first list waits for the second list of an earlier frame if it writes what that one reads.

use super::commands::{submit_in_turn, CommandList, FrameFence, LAST_WAIT_NS};
use super::context::{Gpu, On as _};
use super::error::GpuError;
use ash::vk;
use dpm_handoff::path::{within, Place};
use std::sync::Arc;

/// The order of the frames of one renderer.
pub(crate) struct Overlap {
    /// Counts the first lists that have ended, and the second ones.
    ended: [vk::Semaphore; 2],
    gpu: Arc<Gpu>,
}

/// A frame's place in the order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FrameOrder {
    /// Its number: above those of all frames before, those that could not be submitted included.
    number: u64,
    /// The frame whose second list must have ended before; 0: none.
    after: u64,
}

/// Gives frames their places. Frames write two histories in turns, and the second list of a frame reads the one that its first has written.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Orders {
    numbered: u64,
    /// For each history the last frame that has it.
    has: [u64; 2],
}

impl Orders {
    /// The place of the next frame, which writes the history `parity`.
    pub(crate) fn next(&mut self, parity: usize) -> FrameOrder {
        self.numbered += 1;
        FrameOrder { number: self.numbered, after: self.has[parity] }
    }

    /// The frame of this place was submitted.
    pub(crate) fn submitted(&mut self, parity: usize, order: FrameOrder) {
        self.has[parity] = order.number;
    }
}

impl Overlap {
    /// For a renderer of `gpu`.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub(crate) fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        gpu.alive("making semaphores")?;
        let mut overlap = Self { ended: [vk::Semaphore::null(); 2], gpu: gpu.clone() };
        for semaphore in &mut overlap.ended {
            let mut kind = vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
            let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
            // SAFETY: valid create infos, and the device was opened with timeline semaphores; destroyed in Drop.
            *semaphore =
                unsafe { gpu.device.create_semaphore(&info, None) }.on(gpu, "creating a semaphore")?;
        }
        Ok(overlap)
    }

    /// Runs `before` and a frame's lists. `fence` is signalled when the last is done.
    ///
    /// # Errors
    /// As [`CommandList::submit`]. Nothing of the frame runs then, or the device is given up.
    fn submit(
        &self,
        before: Option<&CommandList>,
        lists: [&CommandList; 2],
        order: FrameOrder,
        fence: &mut FrameFence,
    ) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        fence.check_free()?;
        let (queues, _held) = gpu.queues()?;
        fence.reset()?;
        let [first, second] = self.ended;
        // A first list may have nothing to wait for: every count has reached 0.
        let waits = [(second, order.after), (first, order.number)];
        for (i, list) in lists.into_iter().enumerate() {
            let all = [before.unwrap_or(list).buffer, list.buffer];
            let buffers = if before.is_some() && i == 0 { &all[..] } else { &all[1..] };
            let (signals, values) = ([self.ended[i]], [order.number]);
            let ((semaphore, value), stages) = (waits[i], [vk::PipelineStageFlags::ALL_COMMANDS]);
            let (semaphores, wait_values) = ([semaphore], [value]);
            let mut timeline = vk::TimelineSemaphoreSubmitInfo::default()
                .wait_semaphore_values(&wait_values)
                .signal_semaphore_values(&values);
            let info = [vk::SubmitInfo::default()
                .wait_semaphores(&semaphores)
                .wait_dst_stage_mask(&stages)
                .command_buffers(buffers)
                .signal_semaphores(&signals)
                .push_next(&mut timeline)];
            let signalled = if i == 1 { fence.fence } else { vk::Fence::null() };
            // SAFETY: the fence is unsignalled, the turn at the queues is this thread's, and the values of each semaphore rise.
            let submitted =
                within(Place::Vulkan, || unsafe { gpu.device.queue_submit(queues[i], &info, signalled) });
            if let Err(e) = submitted {
                if i == 1 && e != vk::Result::ERROR_DEVICE_LOST {
                    self.let_end(order.number);
                }
                return Err(e).on(gpu, "submitting a frame");
            }
        }
        fence.pending = true;
        Ok(())
    }

    /// Waits for a first list whose second one could not be submitted: nobody else will.
    #[cold]
    fn let_end(&self, number: u64) {
        let (semaphores, values) = ([self.ended[0]], [number]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is alive and will be signalled by what was submitted.
        if unsafe { self.gpu.device.wait_semaphores(&info, LAST_WAIT_NS) }.is_err() {
            self.gpu.give_up();
        }
    }
}

impl Drop for Overlap {
    fn drop(&mut self) {
        for semaphore in self.ended {
            // SAFETY: every frame that uses it was waited for: slots hold this until their fences were.
            self.gpu.destroy(move |gpu| unsafe { gpu.device.destroy_semaphore(semaphore, None) });
        }
    }
}

/// Runs `before`, if there is one, and a frame's lists: in the order of `overlap`, or without one after the other on one queue. `fence` is signalled
/// when all are done.
///
/// # Errors
/// As [`CommandList::submit`].
pub(crate) fn submit_frame(
    before: Option<&CommandList>,
    lists: [&CommandList; 2],
    overlap: Option<(&Overlap, FrameOrder)>,
    fence: &mut FrameFence,
) -> Result<(), GpuError> {
    match (overlap, before) {
        (Some((overlap, order)), _) => overlap.submit(before, lists, order, fence),
        (None, Some(before)) => submit_in_turn(&[before, lists[0], lists[1]].map(|list| list.buffer), fence),
        (None, None) => submit_in_turn(&lists.map(|list| list.buffer), fence),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_waits_for_the_last_one_that_reads_the_history_it_writes() {
        let mut orders = Orders::default();
        let mut frame = |parity, is_submitted: bool| {
            let order = orders.next(parity);
            if is_submitted {
                orders.submitted(parity, order);
            }
            (order.number, order.after)
        };
        assert_eq!([frame(1, true), frame(0, true), frame(1, true)], [(1, 0), (2, 0), (3, 1)]);
        // A frame that was not submitted signals nothing, and the next one takes its turn and another number.
        assert_eq!([frame(0, false), frame(0, true), frame(1, true)], [(4, 2), (5, 2), (6, 3)]);
    }
}
