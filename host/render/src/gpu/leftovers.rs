//! What was dropped of a device that was given up while the device may still use it. It is destroyed as soon as the
//! device has finished with it; only a device that never finishes keeps it.

use super::context::{Gpu, BYTES_GIVEN_UP};
use ash::vk;
use dpm_handoff::path::Lock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, MutexGuard, PoisonError};
use std::time::Duration;

/// Time between two looks at a submission. Between them the thread is not in the driver, which a process that ends may take away.
const LOOK: Duration = Duration::from_millis(20);

/// Devices whose leftovers are waited for.
static WAITED_FOR: AtomicU64 = AtomicU64::new(0);

/// How many devices of this process were given up and have not finished yet. A thread waits for each in the driver, so a
/// process with any should end by `_exit`.
pub fn devices_unfinished() -> u64 {
    WAITED_FOR.load(Ordering::Relaxed)
}

type Destroy = Box<dyn FnOnce(&Gpu) + Send>;

/// The leftovers of one device.
#[derive(Default)]
pub(super) struct Leftovers(Lock<List>);

#[derive(Default)]
struct List {
    /// Fences of submissions that were not seen to end. What they guard was dropped after them.
    pending: Vec<vk::Fence>,
    /// In the order in which it was dropped.
    destroy: Vec<Destroy>,
    is_waited_for: bool,
}

impl Leftovers {
    fn list(&self) -> MutexGuard<'_, List> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Gpu {
    /// Destroys something that no work of the device uses, or once the device has ended what was left to it ([`Gpu::leave`]).
    pub(super) fn destroy(&self, destroy: impl FnOnce(&Gpu) + Send + 'static) {
        if self.is_abandoned() {
            let mut list = self.leftovers.list();
            if !list.pending.is_empty() {
                list.destroy.push(Box::new(destroy));
                return;
            }
        }
        destroy(self);
    }

    /// Takes the fence of a submission that was not seen to end, of a device that was given up. Whatever is dropped from now on is
    /// destroyed when the submission has ended, or the driver reports the device as lost.
    pub(super) fn leave(self: &Arc<Self>, fence: vk::Fence) {
        let mut list = self.leftovers.list();
        list.pending.push(fence);
        if list.is_waited_for {
            return;
        }
        let gpu = self.clone();
        let waits = std::thread::Builder::new().name("dpm-gpu-left".into()).spawn(move || {
            gpu.wait_for_leftovers();
            // Where nobody else has it, this closes the device.
            drop(gpu);
            WAITED_FOR.fetch_sub(1, Ordering::Relaxed);
        });
        // Without a thread the fences stay, and so does what they guard.
        list.is_waited_for = waits.is_ok();
        if list.is_waited_for {
            WAITED_FOR.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Waits until nothing is left.
    fn wait_for_leftovers(&self) {
        loop {
            let Some(fence) = self.leftovers.list().pending.first().copied() else { return };
            // SAFETY: nobody else has the fence any more.
            let ended = unsafe { self.device.get_fence_status(fence) };
            // It has ended, or the device is lost. Any other error says nothing, so that everything stays as it is.
            if !matches!(ended, Ok(true) | Err(vk::Result::ERROR_DEVICE_LOST)) {
                std::thread::sleep(LOOK);
                continue;
            }
            // SAFETY: as above.
            unsafe { self.device.destroy_fence(fence, None) };
            let mut list = self.leftovers.list();
            list.pending.swap_remove(0);
            if list.pending.is_empty() {
                let all = std::mem::take(&mut list.destroy);
                list.is_waited_for = false;
                drop(list);
                all.into_iter().for_each(|destroy| destroy(self));
                let name = &self.summary().name;
                tracing::info!("{name} has finished what was left to it, and its memory is free again");
                return;
            }
        }
    }

    /// True when something is left for good, so that the device cannot be closed.
    pub(super) fn has_leftovers(&self) -> bool {
        !self.leftovers.list().pending.is_empty()
    }

    /// Counts memory of a buffer that was freed.
    pub(super) fn freed(&self, bytes: u64) {
        self.holds(0, bytes);
        if self.is_abandoned() {
            BYTES_GIVEN_UP.fetch_sub(bytes, Ordering::Relaxed);
        }
    }
}
