//! A thread that lets libusb deliver completed transfers, so that replies are stamped on arrival and not when they are
//! polled.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use rusb::{Context, UsbContext};

use crate::time::HostTime;
use crate::transport::priority::Follower;

/// Longest wait for an event; the thread is woken when it must end.
const PATIENCE: Duration = Duration::from_millis(100);
/// Pause after an error of the event loop itself.
const AFTER_ERROR: Duration = Duration::from_millis(1);

/// The thread. Dropping it ends the thread.
pub(super) struct Events {
    context: Context,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    follower: Follower,
}

impl Events {
    /// Handles the events of `context` from now on. `None` if the system provides no thread: then the caller must do
    /// it.
    pub(super) fn start(context: &Context) -> Option<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (stopped, ours) = (stop.clone(), context.clone());
        let run = move || {
            while !stopped.load(Ordering::Acquire) {
                if ours.handle_events(Some(PATIENCE)).is_err() {
                    std::thread::sleep(AFTER_ERROR);
                }
            }
        };
        let thread = std::thread::Builder::new().name("dpm-usb-in".into()).spawn(run).ok()?;
        Some(Self { context: context.clone(), stop, thread: Some(thread), follower: Follower::new() })
    }

    /// Gives the thread the scheduling of the calling thread.
    pub(super) fn follow(&mut self, now: HostTime) {
        if let Some(thread) = &self.thread {
            self.follower.follow(now, thread);
        }
    }
}

impl Drop for Events {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.context.interrupt_handle_events();
        if let Some(thread) = self.thread.take() {
            // The thread does not panic; if it did, nobody would be left to inform.
            let _ = thread.join();
        }
    }
}
