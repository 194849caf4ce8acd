//! What a signal handler or a panic says to the frame path: flags that every thread reads at once, whoever else hangs.
//!
//! A signal handler may do little more than store into atomics. These are the atomics: the wish to stop and the orders BLACK and
//! SAFE that came as a signal. They belong to the whole process and are set only by `cli::signals`, so tests that run several rigs in
//! one process never meet them.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU32, AtomicU8, Ordering};

/// Code of BLACK among the orders that come as signals.
pub const BLACK: u8 = 1;
/// Code of SAFE among the orders that come as signals; the larger code is the stronger order.
pub const SAFE: u8 = 3;

/// The signal that asked for a stop first; 0 while none has.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// Signals that asked for a stop.
static STOPS: AtomicU32 = AtomicU32::new(0);
static PANICKED: AtomicBool = AtomicBool::new(false);
/// Files are being written after the run has ended in order.
static WRITING: AtomicBool = AtomicBool::new(false);
/// The strongest order that came as a signal and that the light has not taken; 0 for none.
static FOR_LIGHT: AtomicU8 = AtomicU8::new(0);
/// The same for whoever keeps orders over restarts.
static FOR_KEEPER: AtomicU8 = AtomicU8::new(0);
/// Orders that came as signals.
static ORDERS: AtomicU32 = AtomicU32::new(0);

thread_local! {
    static EXPECTED: Cell<bool> = const { Cell::new(false) };
}

/// Notes a signal that asks for a stop; gives how many came before. A signal handler may call it.
pub fn note_signal(signal: i32) -> u32 {
    let _ = SIGNAL.compare_exchange(0, signal, Ordering::SeqCst, Ordering::SeqCst);
    STOPS.fetch_add(1, Ordering::SeqCst)
}

/// Notes an order ([`BLACK`] or [`SAFE`]) that came as a signal. A signal handler may call it.
pub fn note_order(order: u8) {
    // Counted first: an ARM that was asked for before this order must not be taken after it.
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

/// Lives while files are written after a run that has ended in order: its projector is dark and its threads are gone, so a process that
/// was asked to stop is given the time that the files take.
#[derive(Debug)]
pub struct WritingFiles(());

impl WritingFiles {
    /// Begins.
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

/// True while a [`WritingFiles`] lives. A signal handler may call it.
pub fn is_writing_files() -> bool {
    WRITING.load(Ordering::SeqCst)
}

/// Says that panics of the calling thread are caught and turned into errors, so that they end nothing.
pub fn expect_panics() {
    EXPECTED.with(|expected| expected.set(true));
}

/// True when a signal or a panic asked the process to stop. One relaxed load or two: the frame path may call it at every poll.
pub fn is_stopping() -> bool {
    STOPS.load(Ordering::Relaxed) != 0 || PANICKED.load(Ordering::Relaxed)
}

/// The signal that asked for a stop first.
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

/// The order that [`take_order`] would give.
pub fn waiting_order() -> u8 {
    FOR_LIGHT.load(Ordering::Relaxed)
}

/// The strongest order that came as a signal since the last call, for whoever keeps orders; 0 for none.
pub fn take_order_to_keep() -> u8 {
    FOR_KEEPER.swap(0, Ordering::SeqCst)
}

/// How many orders have come as signals.
pub fn orders() -> u32 {
    ORDERS.load(Ordering::SeqCst)
}
