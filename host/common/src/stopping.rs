//! Flags from a signal handler or a panic to the frame path: every thread can read them at once, whichever other thread
//! hangs.
//!
//! A signal handler may do little more than store into atomics. These are the atomics: the request to stop, and the
//! orders BLACK and SAFE that came as a signal. They belong to the whole process and are set only by `cli::signals`, so
//! tests that run several rigs in one process are not affected.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU32, AtomicU8, Ordering};

/// Code of BLACK, as an order that came as a signal.
pub const BLACK: u8 = 1;
/// Code of SAFE, as an order that came as a signal; the larger code is the stronger order.
pub const SAFE: u8 = 3;

/// The first signal that requested a stop; 0 while none has.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// Number of signals that requested a stop.
static STOPS: AtomicU32 = AtomicU32::new(0);
static PANICKED: AtomicBool = AtomicBool::new(false);
/// Files are being written after the run has ended in order.
static WRITING: AtomicBool = AtomicBool::new(false);
/// The strongest order that came as a signal and that the link's thread has not taken yet; 0 for none.
static FOR_LIGHT: AtomicU8 = AtomicU8::new(0);
/// The same for the thread that stores orders for later runs.
static FOR_KEEPER: AtomicU8 = AtomicU8::new(0);
/// Number of orders that came as signals.
static ORDERS: AtomicU32 = AtomicU32::new(0);

thread_local! {
    static EXPECTED: Cell<bool> = const { Cell::new(false) };
}

/// Notes a signal that requests a stop; returns the number of earlier ones. A signal handler may call it.
pub fn note_signal(signal: i32) -> u32 {
    let _ = SIGNAL.compare_exchange(0, signal, Ordering::SeqCst, Ordering::SeqCst);
    STOPS.fetch_add(1, Ordering::SeqCst)
}

/// Notes an order ([`BLACK`] or [`SAFE`]) that came as a signal. A signal handler may call it.
pub fn note_order(order: u8) {
    // Counted first: an ARM that was requested before this order must not be carried out after it.
    ORDERS.fetch_add(1, Ordering::SeqCst);
    FOR_KEEPER.fetch_max(order, Ordering::SeqCst);
    FOR_LIGHT.fetch_max(order, Ordering::SeqCst);
}

/// Notes a panic, unless the panicking thread [`expects`](expect_panics) it. True when it was noted.
pub fn note_panic() -> bool {
    let unexpected = !EXPECTED.try_with(Cell::get).unwrap_or(false);
    if unexpected {
        PANICKED.store(true, Ordering::SeqCst);
    }
    unexpected
}

/// Exists while files are written after a run that has ended in order: its projector is dark and its threads are gone,
/// so a process that was asked to stop gets the time to write them.
#[derive(Debug)]
pub struct WritingFiles(());

impl WritingFiles {
    /// Marks the beginning of the writing.
    pub fn begin() -> Self {
        WRITING.store(true, Ordering::SeqCst);
        Self(())
    }
}

impl Drop for WritingFiles {
    fn drop(&mut self) {
        WRITING.store(false, Ordering::SeqCst);
    }
}

/// True while a [`WritingFiles`] exists. A signal handler may call it.
pub fn is_writing_files() -> bool {
    WRITING.load(Ordering::SeqCst)
}

/// Declares that panics of the calling thread are caught and turned into errors, so that they do not end the process.
pub fn expect_panics() {
    EXPECTED.with(|expected| expected.set(true));
}

/// True when a signal or a panic asked the process to stop. One relaxed load or two: the frame path may call it at every poll.
pub fn is_stopping() -> bool {
    STOPS.load(Ordering::Relaxed) != 0 || PANICKED.load(Ordering::Relaxed)
}

/// The first signal that requested a stop.
pub fn signal() -> Option<i32> {
    Some(SIGNAL.load(Ordering::SeqCst)).filter(|signal| *signal != 0)
}

/// True when a thread of this process has panicked.
pub fn has_panicked() -> bool {
    PANICKED.load(Ordering::SeqCst)
}

/// The strongest order that came as a signal since the last call, for the light; 0 for none.
pub fn take_order() -> u8 {
    match FOR_LIGHT.load(Ordering::Relaxed) {
        0 => 0,
        _ => FOR_LIGHT.swap(0, Ordering::SeqCst),
    }
}

/// The order that [`take_order`] would return.
pub fn waiting_order() -> u8 {
    FOR_LIGHT.load(Ordering::Relaxed)
}

/// The strongest order that came as a signal since the last call, for the thread that stores orders; 0 for none.
pub fn take_order_to_keep() -> u8 {
    FOR_KEEPER.swap(0, Ordering::SeqCst)
}

/// Number of orders that have come as signals.
pub fn orders() -> u32 {
    ORDERS.load(Ordering::SeqCst)
}
