//! After a loss: opens the same device again, or another one.

use super::commands::{run_now, CommandList, FrameFence};
use super::context::Gpu;
use super::devices::DeviceId;
use super::error::GpuError;
use crossbeam::channel::bounded;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Time between two attempts on the same device. Drivers need a moment to reset a device.
const BETWEEN: Duration = Duration::from_millis(100);
/// How long to wait for copies at set-up on a device that was opened again, nanoseconds.
const SETUP_WAIT_NS: u64 = 2_000_000_000;
/// Most devices that are tried.
const MOST_TRIED: usize = 8;

impl Gpu {
    /// A device that has not opened and run an empty submission within this time does not come back.
    pub const COMES_BACK_WITHIN: Duration = Duration::from_secs(2);

    /// Opens a device in place of this one, which is given up unless its driver reported it as lost. The same device is tried first, repeatedly
    /// for 2 s. Then the others that the options of [`Gpu::open`] allow are tried, best first, for 2 s each. A device counts as open after an empty
    /// submission ran on it. The log and the summary of the result name the device if it is another one.
    ///
    /// The caller waits for at most 2 s a device, and 2 s for the list of devices. A driver that does not return from a call keeps a thread for ever.
    ///
    /// # Errors
    /// [`GpuError::NoneLeft`] with the devices that were tried.
    pub fn reopen(&self) -> Result<Arc<Gpu>, GpuError> {
        self.give_up();
        let none_left = |tried: &[String]| GpuError::NoneLeft {
            device: self.device_name().clone(),
            tried: tried.join("; "),
        };
        let mut told = Vec::new();
        match self.same_again() {
            Ok(gpu) => return Ok(gpu),
            Err(error) => told.push(error.to_string()),
        }
        let options = self.options.clone();
        let others = match within(Self::COMES_BACK_WITHIN, "listing devices", move || Gpu::ranked(&options)) {
            Ok(all) => all.into_iter().filter(|id| *id != self.id).take(MOST_TRIED),
            Err(error) => {
                told.push(error.to_string());
                return Err(none_left(&told));
            }
        };
        for id in others {
            match self.open_now(id, Self::COMES_BACK_WITHIN) {
                Ok(gpu) => {
                    let (was, is) = (self.device_name(), gpu.device_name());
                    tracing::warn!(
                        "{was} did not come back ({}); {is} goes on in its place",
                        told.join("; ")
                    );
                    return Ok(gpu);
                }
                Err(error) => told.push(error.to_string()),
            }
        }
        Err(none_left(&told))
    }

    /// Whether the device still runs what it is given: an empty submission ends within `limit`. A thread that hangs in the driver with its turn at the
    /// queue keeps it from that.
    pub fn answers(self: &Arc<Self>, limit: Duration) -> bool {
        let gpu = self.clone();
        let asked = within(limit, "running an empty submission", move || {
            let list = CommandList::record(&gpu, 0, |_| ())?;
            let mut fence = FrameFence::new(&gpu)?;
            list.submit(&mut fence)?;
            fence.wait(u64::try_from(limit.as_nanos()).unwrap_or(u64::MAX))
        });
        asked.is_ok()
    }

    /// Opens this device again: tries until it works, or until its time is over.
    fn same_again(&self) -> Result<Arc<Gpu>, GpuError> {
        let begin = Instant::now();
        loop {
            let error = match self
                .open_now(self.id.clone(), Self::COMES_BACK_WITHIN.saturating_sub(begin.elapsed()))
            {
                Ok(gpu) => return Ok(gpu),
                Err(error) => error,
            };
            // An attempt with too little time would only report a timeout.
            if begin.elapsed() + 2 * BETWEEN >= Self::COMES_BACK_WITHIN {
                return Err(error);
            }
            std::thread::sleep(BETWEEN);
        }
    }

    /// Opens a device and runs an empty submission on it.
    fn open_now(&self, id: DeviceId, limit: Duration) -> Result<Arc<Gpu>, GpuError> {
        let options = self.options.clone();
        within(limit, "opening a device", move || {
            let gpu = Gpu::open_device(&options, Some(&id), SETUP_WAIT_NS)?;
            run_now(&gpu, |_| ())?;
            Ok(gpu)
        })
    }
}

/// The result of `work`, if it comes within `limit`. A later result is dropped in its own thread.
fn within<T: Send + 'static>(
    limit: Duration,
    what: &'static str,
    work: impl FnOnce() -> Result<T, GpuError> + Send + 'static,
) -> Result<T, GpuError> {
    let late = |_| GpuError::Timeout {
        device: format!("the Vulkan driver ({what})").into(),
        waited_ms: limit.as_millis() as u64,
    };
    let (sender, receiver) = bounded(1);
    let thread = std::thread::Builder::new().name("dpm-gpu-open".into()).spawn(move || {
        let _ = sender.send(work());
    });
    if let Err(e) = thread {
        return Err(GpuError::NoDriver(format!("no thread for {what}: {e}")));
    }
    receiver.recv_timeout(limit).map_err(late)?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Buffer, GpuOptions, MemoryKind};

    /// Found in use, R12. Without any fault a device can be left and opened anew: what a caller does that sees a stage hang.
    #[test]
    fn a_device_that_was_left_is_refused_and_the_one_in_its_place_works() {
        let options = GpuOptions::default();
        let first = Gpu::open(&options).expect("a Vulkan device");
        assert!(!first.is_lost());
        let second = first.reopen().expect("the device comes back");
        assert!(first.is_lost() && !second.is_lost());
        assert_eq!((second.id.clone(), &second.summary().name), (first.id.clone(), &first.summary().name));
        let refused = Buffer::new(&first, "late", 16, MemoryKind::Device).expect_err("given up");
        assert!(refused.is_loss(), "{refused}");
        Buffer::from_slice(&second, "new", &[1u32, 2, 3]).expect("the new one works");
    }

    #[test]
    fn a_driver_that_does_not_return_holds_nobody_up() {
        let begin = Instant::now();
        let (release, released) = bounded::<()>(0);
        let error = within(Duration::from_millis(50), "sleeping", move || {
            let _ = released.recv();
            Ok(())
        });
        assert!(matches!(error, Err(GpuError::Timeout { .. })), "{error:?}");
        assert!(begin.elapsed() < Duration::from_secs(20));
        drop(release);
    }
}
