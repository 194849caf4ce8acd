//! A frame in which device and host take turns: the device runs a list of commands and asks, the host answers, and the next list runs.
//!
//! All lists of a frame are submitted at once. Two semaphores that count keep the order: the device counts what it has asked, and the host what it has
//! answered. A list waits for the answer to what the one before asked.

use super::commands::{CommandList, FrameFence};
use super::context::{Gpu, On as _};
use super::error::GpuError;
use ash::vk;
use dpm_handoff::path::{within, Place};
use std::sync::Arc;

/// Most lists of a frame.
const LISTS: usize = 64;

/// The turns of device and host in the frames of one renderer.
pub(crate) struct Relay {
    /// Counts what the device has asked.
    asked: vk::Semaphore,
    /// Counts what the host has answered.
    answered: vk::Semaphore,
    gpu: Arc<Gpu>,
}

impl Relay {
    /// Most questions of a frame.
    pub(crate) const QUESTIONS: usize = LISTS - 1;

    /// For a renderer of `gpu`, which has semaphores that count.
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub(crate) fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        gpu.alive("making semaphores")?;
        let mut relay =
            Self { asked: vk::Semaphore::null(), answered: vk::Semaphore::null(), gpu: gpu.clone() };
        for semaphore in [&mut relay.asked, &mut relay.answered] {
            let mut kind = vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
            let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
            // SAFETY: valid create infos, and the device was opened with timeline semaphores; destroyed in Drop.
            *semaphore =
                unsafe { gpu.device.create_semaphore(&info, None) }.on(gpu, "creating a semaphore")?;
        }
        Ok(relay)
    }

    /// Runs `before`, if there is one, and then `lists`, of which all but the last ask one question, numbered from `first` on; and with the last list
    /// `end`. `fence` is signalled when all are done. Allocates nothing.
    ///
    /// # Errors
    /// As [`CommandList::submit`].
    ///
    /// # Panics
    /// If there are no lists or too many, which is a mistake of the caller.
    pub(crate) fn submit(
        &self,
        before: Option<&CommandList>,
        lists: &[CommandList],
        end: &CommandList,
        first: u64,
        fence: &mut FrameFence,
    ) -> Result<(), GpuError> {
        let (gpu, count) = (&self.gpu, lists.len());
        assert!((1..=LISTS).contains(&count), "so many lists");
        fence.check_free()?;
        let start = [before.unwrap_or(&lists[0]).buffer, lists[0].buffer];
        let mut buffers = [[vk::CommandBuffer::null(); 2]; LISTS];
        let (mut asks, mut answers) = ([[0u64]; LISTS], [[0u64]; LISTS]);
        for (i, list) in lists.iter().enumerate() {
            buffers[i] = [list.buffer, end.buffer];
            asks[i] = [first + i as u64];
            answers[i] = [(first + i as u64).saturating_sub(1)];
        }
        let (asked, answered, stages) =
            ([self.asked], [self.answered], [vk::PipelineStageFlags::ALL_COMMANDS]);
        let mut timelines: [vk::TimelineSemaphoreSubmitInfo<'_>; LISTS] = std::array::from_fn(|i| {
            let info = vk::TimelineSemaphoreSubmitInfo::default();
            let info = if i == 0 { info } else { info.wait_semaphore_values(&answers[i]) };
            if i + 1 == count {
                info
            } else {
                info.signal_semaphore_values(&asks[i])
            }
        });
        let mut infos = [vk::SubmitInfo::default(); LISTS];
        for (i, (info, timeline)) in infos.iter_mut().zip(&mut timelines).enumerate().take(count) {
            let is_last = i + 1 == count;
            let own =
                if i == 0 && before.is_some() { &start[..] } else { &buffers[i][..1 + usize::from(is_last)] };
            *info = info.command_buffers(own);
            if i > 0 {
                *info = info.wait_semaphores(&answered).wait_dst_stage_mask(&stages);
            }
            if !is_last {
                *info = info.signal_semaphores(&asked);
            }
            *info = info.push_next(timeline);
        }
        let ([queue, _], _turn) = gpu.queues()?;
        fence.reset()?;
        // SAFETY: the fence is unsignalled, the turn at the queue is this thread's, and the values of each semaphore rise.
        within(Place::Vulkan, || unsafe { gpu.device.queue_submit(queue, &infos[..count], fence.fence) })
            .on(gpu, "submitting a frame")?;
        fence.pending = true;
        Ok(())
    }

    /// Waits at most `timeout_ns` until the device has asked the question. Allocates nothing.
    ///
    /// # Errors
    /// The device is lost or was given up.
    pub(crate) fn wait(&self, question: u64, timeout_ns: u64) -> Result<bool, GpuError> {
        let gpu = &self.gpu;
        gpu.alive("waiting for rays")?;
        let (semaphores, values) = ([self.asked], [question]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is alive.
        match within(Place::Vulkan, || unsafe { gpu.device.wait_semaphores(&info, timeout_ns) }) {
            Ok(()) => Ok(true),
            Err(vk::Result::TIMEOUT) => Ok(false),
            Err(e) => Err(e).on(gpu, "waiting for rays"),
        }
    }

    /// The host has answered all questions up to this one. Allocates nothing.
    ///
    /// # Errors
    /// The device is lost or was given up.
    pub(crate) fn answer(&self, question: u64) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        gpu.alive("handing back rays")?;
        let info = vk::SemaphoreSignalInfo::default().semaphore(self.answered).value(question);
        // SAFETY: the semaphore is alive, and its value rises.
        within(Place::Vulkan, || unsafe { gpu.device.signal_semaphore(&info) }).on(gpu, "handing back rays")
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        for semaphore in [self.asked, self.answered] {
            // SAFETY: every frame that uses it was waited for: slots hold this until their fences were.
            self.gpu.destroy(move |gpu| unsafe { gpu.device.destroy_semaphore(semaphore, None) });
        }
    }
}
