//! A thread that lets libusb deliver what has completed, so that replies are stamped when they arrive and not when they are looked for.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use rusb::{Context, UsbContext};

use crate::time::HostTime;
use crate::transport::priority::Follower;

/// Longest wait for an event; the thread is woken when it shall end.
const PATIENCE: Duration = Duration::from_millis(100);
/// Rest after an error of the event loop itself.
const AFTER_ERROR: Duration = Duration::from_millis(1);

/// The thread. Dropping it ends the thread.
pub(super) struct Events {
    context: Context,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    follower: Follower,
}

impl Events {
    /// Handles the events of `context` from now on. `None` when the system has no thread to give: then the caller must.
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

    /// Lets the thread run as the calling thread does.
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
            // It cannot panic on its own; were it to, there is nobody left to tell.
            let _ = thread.join();
        }
    }
}
