//! What the run of a DLPC900 and its dark thread tell each other: orders, the interlock, the end.

use dpm_common::clock::Stopwatch;
use dpm_common::signals;
use dpm_dlpc900::driver::DarkLine;
use dpm_rig::order::Order;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// How often the dark thread checks for orders, the interlock and the end.
const DARK_STEP: Duration = Duration::from_millis(2);
/// How often a controller is ordered to be dark until the run itself has acted on the order. A start that was in
/// progress may have followed the first order.
const AGAIN_NS: u64 = 10_000_000;

/// What the run's thread and the dark thread share. The dark thread exists because the run's thread may spend a
/// second inside a USB call or half a minute in an upload, or may be stopped.
#[derive(Default)]
pub(super) struct Word {
    /// The run must end. The driver reads this too.
    pub(super) stop: Arc<AtomicBool>,
    /// The run has ended.
    over: AtomicBool,
    /// The order on which the run has not acted yet; 0 for none.
    pub(super) waiting: AtomicU8,
    /// Number of times that the dark thread saw the interlock open or close: odd while it is open. The run therefore
    /// misses no opening, however short.
    pub(super) interlock: AtomicU32,
    /// The value of `interlock` on which the run has acted.
    pub(super) interlock_done: AtomicU32,
    /// Number of commands of the dark thread. A command that is in progress may lose its answer to one of them.
    pub(super) spoken: AtomicU32,
    /// The run has stopped the sequence itself, for an upload or at its end. Nothing is lit, and a command from the
    /// dark thread would only disturb the run's own.
    pub(super) is_dark: AtomicBool,
    pub(super) line: Mutex<Option<DarkLine>>,
}

/// Ends the dark thread when dropped.
pub(super) struct Over<'a>(pub(super) &'a Word);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.over.store(true, Ordering::Release);
    }
}

impl Word {
    /// The dark thread: obeys within milliseconds whatever must be dark, and passes every order on to the run.
    pub(super) fn make_dark_when_told(&self, monitor: &RunMonitor) {
        let (mut was_open, mut told) = (false, None::<Stopwatch>);
        while !self.over.load(Ordering::Acquire) {
            let mut is_due =
                told.as_ref().is_some_and(|told| told.elapsed_ns() >= AGAIN_NS) && self.must_be_dark();
            if let Some(order) = monitor.take_order() {
                // Set before obeying, so that the run does not mistake the stopped sequence for one that stopped by
                // itself.
                let _ = self.waiting.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |waiting| {
                    Some(outweighing(from_code(waiting), order) as u8)
                });
                is_due |= order.is_dark();
            }
            let is_open = !monitor.light_allowed();
            if is_open != was_open {
                // Set before obeying, as above.
                self.interlock.fetch_add(1, Ordering::SeqCst);
                was_open = is_open;
                is_due |= is_open;
            }
            if is_due {
                self.make_dark(false);
                told = Some(Stopwatch::start());
            }
            // Also checks the signal directly, because the thread that passes it on may be the one that hangs.
            if signals::received().is_some() {
                monitor.request_stop();
            }
            if monitor.stop_requested() && !self.stop.swap(true, Ordering::Relaxed) {
                self.make_dark(true);
            }
            std::thread::sleep(DARK_STEP);
        }
    }

    /// Orders the controller to be dark. The run reports a failing cable.
    fn make_dark(&self, leds_off: bool) {
        if self.is_dark.load(Ordering::SeqCst) {
            return;
        }
        if let Some(line) = self.line.lock().unwrap_or_else(PoisonError::into_inner).as_mut() {
            self.spoken.fetch_add(1, Ordering::SeqCst);
            let _ = line.dark(leds_off);
        }
    }

    /// True if the dark thread may have stopped the sequence for a reason on which the run has not acted yet.
    pub(super) fn is_waiting(&self) -> bool {
        self.waiting.load(Ordering::Relaxed) != 0
            || self.stop.load(Ordering::Relaxed)
            || self.interlock.load(Ordering::SeqCst) != self.interlock_done.load(Ordering::SeqCst)
    }

    /// True if there is an order to be dark, or an open interlock, on which the run has not acted.
    fn must_be_dark(&self) -> bool {
        let number = self.interlock.load(Ordering::SeqCst);
        self.order().is_some_and(Order::is_dark)
            || !number.is_multiple_of(2) && number != self.interlock_done.load(Ordering::SeqCst)
    }

    /// Reads the interlock for the run: whether light is permitted, and the number to store in `interlock_done` once
    /// the run has acted.
    pub(super) fn look_at_interlock(&self, monitor: &RunMonitor) -> (bool, u32) {
        let number = self.interlock.load(Ordering::SeqCst);
        // While the dark thread is still sending its command, a start would be undone by it.
        (number.is_multiple_of(2) && monitor.light_allowed(), number)
    }

    /// The order on which the run has not acted yet.
    pub(super) fn order(&self) -> Option<Order> {
        from_code(self.waiting.load(Ordering::Relaxed))
    }

    /// The run has acted on `order`. An order that came meanwhile remains.
    pub(super) fn acted_on(&self, order: Order) {
        let _ = self.waiting.compare_exchange(order as u8, 0, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// Takes the order on which the run has not acted yet.
    pub(super) fn take(&self) -> Option<Order> {
        from_code(self.waiting.swap(0, Ordering::Relaxed))
    }
}

fn from_code(code: u8) -> Option<Order> {
    Order::ALL.iter().map(|(order, _)| *order).find(|order| *order as u8 == code)
}

/// The order that prevails when `new` is given while `old` stands: only ARM takes SAFE back, and FREEZE does not
/// bring light back.
fn outweighing(old: Option<Order>, new: Order) -> Order {
    match (old, new) {
        (Some(Order::Safe), Order::Black | Order::Freeze) => Order::Safe,
        (Some(Order::Black), Order::Freeze) => Order::Black,
        (_, new) => new,
    }
}

/// The order that stands after `new`; `None` after ARM.
pub(super) fn standing_after(old: Option<Order>, new: Order) -> Option<Order> {
    Some(outweighing(old, new)).filter(|order| *order != Order::Arm)
}
