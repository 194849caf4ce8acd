//! Calls of an allocator into counts: the system's allocator, for tests of code that must allocate nothing.
//!
//! A test makes it the allocator of its program: `#[global_allocator] static ALLOCATOR: Counting = Counting::BY_THREAD;`.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static OF_THIS_THREAD: Cell<u64> = const { Cell::new(0) };
}

/// What an allocator is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Memory of this many bytes.
    Allocation(usize),
    /// To take back this many bytes.
    Release(usize),
    /// To move what is there to this many bytes.
    Reallocation(usize),
}

/// Passes every request on to the system's allocator, counts those of each thread, and tells a hook.
#[derive(Clone, Copy, Debug)]
pub struct Counting {
    hook: fn(Request),
}

impl Counting {
    /// Counts by thread and tells nobody.
    pub const BY_THREAD: Self = Self::telling(|_| ());

    /// Also calls `hook` before every request. The hook runs inside the allocator: a request of its own calls it again, so one that allocates
    /// must see to its end. It must not unwind, and touch no thread-local that has a destructor.
    pub const fn telling(hook: fn(Request)) -> Self {
        Self { hook }
    }

    fn count(&self, request: Request) {
        // During a thread's end there may be no counter any more; nothing is measured then.
        let _ = OF_THIS_THREAD.try_with(|n| n.set(n.get() + 1));
        (self.hook)(request);
    }
}

// SAFETY: every call goes to the system's allocator with the caller's arguments unchanged; counting touches a thread-local without
// destructor only, and hooks may do no more than `telling` allows.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        self.count(Request::Allocation(layout.size()));
        // SAFETY: the caller's duty, passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        self.count(Request::Release(layout.size()));
        // SAFETY: the caller's duty, passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        self.count(Request::Reallocation(size));
        // SAFETY: the caller's duty, passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

/// Requests that this thread made during `work`.
pub fn requests_in(work: impl FnOnce()) -> u64 {
    let before = OF_THIS_THREAD.with(Cell::get);
    work();
    OF_THIS_THREAD.with(Cell::get) - before
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::hint::black_box;

    #[global_allocator]
    static ALLOCATOR: Counting = Counting::BY_THREAD;

    #[test]
    fn every_kind_of_request_counts_on_the_thread_that_makes_it() {
        let mut kept: Vec<u8> = Vec::new();
        assert_eq!(requests_in(|| kept.reserve_exact(100)), 1);
        assert_eq!(requests_in(|| kept.reserve_exact(1000)), 1, "moved");
        assert_eq!(requests_in(|| drop(black_box(std::mem::take(&mut kept)))), 1);
        assert_eq!(requests_in(|| assert_eq!(black_box([1u8; 100])[99], 1)), 0);
        let elsewhere = std::sync::Barrier::new(2);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                elsewhere.wait();
                drop(black_box(vec![0u8; 100]));
                elsewhere.wait();
            });
            let counted = requests_in(|| {
                elsewhere.wait();
                elsewhere.wait();
            });
            assert_eq!(counted, 0, "of another thread");
        });
    }
}
