//! Which thread works on frames, and whose code it runs: the program's own, or that of a library.
//!
//! The law of the frame path is that our own code allocates nothing, takes no lock and makes no system call but those
//! that docs/FRAME.md names. A driver or libusb may do as it likes, so each call of one is marked by [`within`]. The
//! marks cost two writes to a variable of the thread; tests read them in an allocator, in a handler of system calls,
//! and in [`Lock`].

use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LockResult, Mutex, MutexGuard};

/// Whose code a thread runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Place {
    /// Anything, beside the frame path.
    #[default]
    Beside = 0,
    /// Our own, on the frame path.
    Own,
    /// The Vulkan loader's and driver's, called from the frame path.
    Vulkan,
    /// That of libusb, called from the frame path.
    Libusb,
}

impl Place {
    /// All places, in the order of their numbers.
    pub const ALL: [Self; 4] = [Self::Beside, Self::Own, Self::Vulkan, Self::Libusb];
}

thread_local! {
    static PLACE: Cell<Place> = const { Cell::new(Place::Beside) };
}

/// Locks that our own code took on the frame path.
static LOCKS: AtomicU64 = AtomicU64::new(0);

/// The calling thread begins (or ends) to work on frames in the steady state.
pub fn enter(inside: bool) {
    // While a thread ends there is no mark any more, and no frame either.
    let _ = PLACE.try_with(|p| p.set(if inside { Place::Own } else { Place::Beside }));
}

/// Whose code the calling thread runs. It has no destructor, so a signal handler or an allocator may ask.
pub fn place() -> Place {
    PLACE.try_with(Cell::get).unwrap_or_default()
}

/// Calls a library: what happens during `call` is not the work of our own code.
pub fn within<T>(library: Place, call: impl FnOnce() -> T) -> T {
    let caller = place();
    if caller != Place::Own {
        return call();
    }
    let _back = Back(caller);
    let _ = PLACE.try_with(|p| p.set(library));
    call()
}

/// Leaves the frame path for the time of a call: for a test that stands in for the kernel.
pub fn beside<T>(call: impl FnOnce() -> T) -> T {
    let _back = Back(place());
    enter(false);
    call()
}

/// Returns to a place, also in a panic.
struct Back(Place);

impl Drop for Back {
    fn drop(&mut self) {
        let _ = PLACE.try_with(|p| p.set(self.0));
    }
}

/// A mutex for what lies beside the frame path. It counts where it is locked on it; a test demands that there is
/// nothing to count, and another that no other kind of lock is named where frames pass.
#[derive(Debug, Default)]
pub struct Lock<T>(Mutex<T>);

impl<T> Lock<T> {
    /// Unlocked.
    pub const fn new(value: T) -> Self {
        Self(Mutex::new(value))
    }

    /// Waits for the lock.
    ///
    /// # Errors
    /// A thread panicked while it held the lock.
    pub fn lock(&self) -> LockResult<MutexGuard<'_, T>> {
        if place() == Place::Own {
            LOCKS.fetch_add(1, Ordering::Relaxed);
        }
        self.0.lock()
    }
}

/// Locks that our own code took on the frame path, in all threads so far: none.
pub fn locks_taken() -> u64 {
    LOCKS.load(Ordering::Relaxed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_library_is_marked_on_the_frame_path_only_and_a_panic_leads_back() {
        assert_eq!(within(Place::Vulkan, place), Place::Beside);
        enter(true);
        assert_eq!((within(Place::Vulkan, place), place()), (Place::Vulkan, Place::Own));
        // A callback that calls another library stays in the first one.
        assert_eq!(within(Place::Libusb, || within(Place::Vulkan, place)), Place::Libusb);
        let panicked = std::panic::catch_unwind(|| within(Place::Libusb, || panic!("of a library")));
        assert_eq!((panicked.is_err(), place()), (true, Place::Own));
        assert_eq!((within(Place::Libusb, || beside(place)), place()), (Place::Beside, Place::Own));
        enter(false);
        assert_eq!(place(), Place::Beside);
        for (i, place) in Place::ALL.into_iter().enumerate() {
            assert_eq!(place as usize, i);
        }
    }

    #[test]
    fn a_lock_counts_on_the_frame_path_and_nowhere_else() {
        let lock = Lock::new(0);
        let taken = || {
            let before = locks_taken();
            drop(lock.lock());
            locks_taken() - before
        };
        assert_eq!(taken(), 0);
        enter(true);
        assert_eq!(taken(), 1);
        assert_eq!(within(Place::Vulkan, taken), 0);
        enter(false);
    }
}
