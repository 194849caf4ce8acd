//! The atomics and cells in use: the standard library's, or loom's when the model checker runs.

#[cfg(loom)]
pub(crate) use loom::{
    cell::UnsafeCell,
    sync::atomic::{fence, AtomicBool, AtomicU8, AtomicUsize, Ordering},
    sync::Arc,
    thread,
};

#[cfg(not(loom))]
pub(crate) use std::{
    sync::atomic::{fence, AtomicBool, AtomicU8, AtomicUsize, Ordering},
    sync::Arc,
    thread,
};

/// The thread that waits: set once, by itself. Under the model checker its two states are atomics that loom sees, with
/// the orderings of the standard library's [`std::sync::OnceLock`], whose own are hidden from it.
#[derive(Debug)]
pub(crate) struct WaitingThread {
    #[cfg(loom)]
    is_set: AtomicBool,
    thread: std::sync::OnceLock<thread::Thread>,
}

impl WaitingThread {
    pub(crate) fn new() -> Self {
        Self {
            #[cfg(loom)]
            is_set: AtomicBool::new(false),
            thread: std::sync::OnceLock::new(),
        }
    }

    pub(crate) fn set_to_this(&self) {
        self.thread.get_or_init(thread::current);
        #[cfg(loom)]
        self.is_set.store(true, Ordering::Release);
    }

    pub(crate) fn get(&self) -> Option<&thread::Thread> {
        #[cfg(loom)]
        if !self.is_set.load(Ordering::Acquire) {
            return None;
        }
        self.thread.get()
    }
}

/// The standard cell with loom's interface: access by closure, so that loom can see how long it lasts.
#[cfg(not(loom))]
#[derive(Debug)]
pub(crate) struct UnsafeCell<T>(std::cell::UnsafeCell<T>);

#[cfg(not(loom))]
impl<T> UnsafeCell<T> {
    pub(crate) fn new(value: T) -> Self {
        Self(std::cell::UnsafeCell::new(value))
    }

    pub(crate) fn with<R>(&self, f: impl FnOnce(*const T) -> R) -> R {
        f(self.0.get())
    }

    pub(crate) fn with_mut<R>(&self, f: impl FnOnce(*mut T) -> R) -> R {
        f(self.0.get())
    }
}
