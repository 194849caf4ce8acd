//! Orders to the rig of this process. They go to the light first and then to the disk, so that they outlive the
//! program.
//!
//! A source of orders (the control socket, a key) gives its order here and continues at once. A separate thread
//! writes the order down, which may take as long as a disk takes. It passes ARM to the light only after the standing
//! order is forgotten. Orders that come as signals reach the light by themselves (see [`dpm_common::stopping`]); the
//! thread only writes them down.

use crate::order::Order;
use crate::standing::{By, OrderFile, Stands};
use crate::telemetry::monitor::RunMonitor;
use dpm_common::stopping;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// How often to check for orders that came as signals.
const LOOK: Duration = Duration::from_millis(20);
/// How long the end of a run waits for the disk.
const END_WITHIN: Duration = Duration::from_millis(500);

/// Identifies an order that was given, so that its result can be asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(u64);

/// What happened to an order on the disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum KeepResult {
    /// It is kept over restarts, in this file.
    In(PathBuf),
    /// The standing order is forgotten (after ARM).
    Forgotten,
    /// It is not kept over restarts, or (for ARM) the standing order is not forgotten; the reason.
    Not(String),
    /// In no file: there is no state folder, and a rig with a mock projector does not need one; or every start is by
    /// hand.
    Nowhere,
}

/// An order on its way to the disk.
#[derive(Debug)]
pub(crate) struct OrderOnItsWay {
    /// Number of the order.
    number: u64,
    order: Order,
    by: By,
    /// Number of orders that had come as signals when it was given.
    signals: u32,
    /// It changes the standing order. Otherwise the file stays as it is, including who gave the order.
    changes: bool,
    /// What became of the order before it.
    before: Option<KeepResult>,
    /// The projector's serial number, if it has given one.
    device: Option<u64>,
}

impl OrderOnItsWay {
    /// Writes the order down, or forgets what stands. This may take as long as the disk takes.
    pub(crate) fn write(&self, file: &OrderFile, keeps: bool) -> KeepResult {
        file.hear(self.device);
        match &self.before {
            Some(kept @ KeepResult::In(_)) if !self.changes => return kept.clone(),
            _ if !keeps => return KeepResult::Nowhere,
            _ => {}
        }
        let done = match self.order {
            Order::Arm => file.forget().map(|()| KeepResult::Forgotten),
            order => file.keep(order, self.by).map(KeepResult::In),
        };
        done.unwrap_or_else(|e| KeepResult::Not(e.to_string()))
    }
}

/// Decides what becomes of orders: which one stands, which is written next, and when ARM reaches the light. It has no
/// thread and no file.
#[derive(Debug)]
pub(crate) struct OrderDesk {
    monitor: Arc<RunMonitor>,
    /// Number of the newest order.
    newest: u64,
    /// The newest order, until it is taken to be written.
    waiting: Option<OrderOnItsWay>,
    /// Orders up to this number are settled.
    settled: u64,
    outcome: Option<KeepResult>,
    /// The standing order, whether or not it could be written down.
    stands: Option<Order>,
}

impl OrderDesk {
    /// For a run that begins while `stands` stands in `path`. The light receives that order before this returns, so
    /// that the link comes up dark.
    pub(crate) fn new(monitor: Arc<RunMonitor>, stands: Option<&Stands>, path: PathBuf) -> Self {
        stands.into_iter().for_each(|stands| monitor.give_order(stands.order));
        let outcome =
            stands.map(|stands| if stands.is_on_disk { KeepResult::In(path) } else { KeepResult::Nowhere });
        Self { monitor, newest: 0, waiting: None, settled: 0, outcome, stands: stands.map(|s| s.order) }
    }

    /// Gives an order: to the light at once (ARM only when no order stands on the disk any more), then to the disk.
    pub(crate) fn give(&mut self, order: Order, by: By) -> Ticket {
        self.absorb();
        self.newest += 1;
        if order != Order::Arm {
            self.monitor.give_order(order);
        }
        self.queue(order, by)
    }

    /// Queues an order for the disk. A weaker order does not replace a stronger one that stands or waits to be
    /// written.
    fn queue(&mut self, order: Order, by: By) -> Ticket {
        let number = self.newest;
        let standing = self.stands.filter(|s| order != Order::Arm && s.strength() > order.strength());
        self.stands = if order == Order::Arm { self.stands } else { standing.or(Some(order)) };
        match &mut self.waiting {
            // The waiting order is written in its place: the same file, the same result.
            Some(waiting) if standing.is_some() && waiting.order != Order::Arm => waiting.number = number,
            waiting => {
                let (order, changes) = standing.map_or((order, true), |standing| (standing, false));
                let signals = stopping::orders();
                *waiting =
                    Some(OrderOnItsWay { number, order, by, signals, changes, before: None, device: None });
            }
        }
        Ticket(number)
    }

    /// Orders that reached the light as signals are written down like the others.
    fn absorb(&mut self) {
        let order = match stopping::take_order_to_keep() {
            0 => None,
            stopping::BLACK => Some(Order::Black),
            _ => Some(Order::Safe),
        };
        if let Some(order) = order {
            self.newest += 1;
            self.queue(order, By::Signal);
        }
        if self.monitor.take_found_safe() && self.stands != Some(Order::Safe) {
            self.newest += 1;
            self.queue(Order::Safe, By::Projector);
        }
        let found = self.monitor.take_found_held();
        if let Some(order) =
            found.filter(|order| self.stands.is_none_or(|stands| stands.strength() < order.strength()))
        {
            self.newest += 1;
            self.monitor.note(format!(
                "projector: {} stands for the one with this serial number, wherever it is plugged in; it stays dark until ARM",
                order.word()
            ));
            self.queue(order, By::SerialNumber);
        }
        // The interlock itself keeps this run dark; the order keeps the next one dark.
        if self.monitor.interlock_awaits_reset() && self.stands.is_none() {
            self.newest += 1;
            self.queue(Order::Black, By::Interlock);
        }
    }

    /// The next order to be written; pass the result to [`OrderDesk::settle`].
    pub(crate) fn next(&mut self) -> Option<OrderOnItsWay> {
        self.absorb();
        let given = self.waiting.take()?;
        Some(OrderOnItsWay { before: self.outcome.take(), device: self.monitor.device(), ..given })
    }

    /// `given` was written with this outcome.
    pub(crate) fn settle(&mut self, given: &OrderOnItsWay, outcome: KeepResult) {
        self.absorb();
        if given.order == Order::Arm && !matches!(outcome, KeepResult::Not(_)) {
            // An order that came while the disk was busy is newer than this one.
            if self.newest == given.number {
                self.stands = None;
                if let Some(device) = given.device {
                    self.monitor.lift_held(device);
                }
                self.monitor.reset_interlock();
                self.monitor.arm_unless_darkened(given.signals);
            }
        }
        if let Some(device) = given.device.filter(|_| given.order != Order::Arm) {
            // In this run too: another projector may be armed at this port before this one is back.
            let order = if given.order == Order::Safe { Order::Safe } else { Order::Black };
            self.monitor.hold_device(device, order);
        }
        // Orders that came meanwhile get their result when they are settled themselves.
        self.settled = given.number;
        self.outcome = Some(outcome);
    }

    /// The run ends, and with it BLACK and FREEZE if `ends_them`. SAFE remains.
    pub(crate) fn end(&mut self, ends_them: bool) {
        self.absorb();
        if ends_them && matches!(self.stands, Some(Order::Black | Order::Freeze)) {
            // This arms nothing: the run is over, and after a stop request the monitor lets no ARM through.
            self.monitor.request_stop();
            self.give(Order::Arm, By::Signal);
        }
    }

    /// What happened to the order on the disk; `None` while it is not settled. For orders in quick succession the
    /// result of the newest one applies to all.
    pub(crate) fn outcome(&self, ticket: Ticket) -> Option<KeepResult> {
        self.outcome.clone().filter(|_| self.settled >= ticket.0)
    }

    /// The standing order, once it is kept over restarts (or the rig does without, as a mock may).
    pub(crate) fn kept(&self) -> Option<Order> {
        let is_kept = matches!(self.outcome, Some(KeepResult::In(_) | KeepResult::Nowhere));
        self.stands.filter(|_| is_kept && self.settled == self.newest)
    }
}

#[derive(Debug)]
struct OrderState {
    desk: OrderDesk,
    /// The thread must end.
    closing: bool,
    closed: bool,
}

#[derive(Debug)]
struct OrderShare {
    file: OrderFile,
    /// The folder is writable.
    keeps: bool,
    state: Mutex<OrderState>,
    changed: Condvar,
}

/// See the module's documentation. If it is dropped without [`Orders::end`], the standing order remains.
#[derive(Debug)]
pub struct Orders {
    inner: Arc<OrderShare>,
    thread: Option<JoinHandle<()>>,
}

impl Orders {
    /// Starts the thread. The standing order `stands` is given to the light before this returns, so that a later run
    /// comes up dark. `keeps` says that the file can be written.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub fn start(
        monitor: Arc<RunMonitor>,
        file: OrderFile,
        keeps: bool,
        stands: Option<&Stands>,
    ) -> std::io::Result<Self> {
        monitor.hold_devices(file.by_serial_number());
        let desk = OrderDesk::new(monitor, stands, file.path());
        let state = Mutex::new(OrderState { desk, closing: false, closed: false });
        let inner = Arc::new(OrderShare { file, keeps, state, changed: Condvar::new() });
        let thread = std::thread::Builder::new().name("dpm-orders".into()).spawn({
            let inner = inner.clone();
            move || inner.write_down()
        })?;
        Ok(Self { inner, thread: Some(thread) })
    }

    /// Gives an order: to the light at once (ARM only when no order stands on the disk any more), then to the disk.
    /// Never waits for the disk.
    pub fn give(&self, order: Order, by: By) -> Ticket {
        let ticket = self.inner.state().desk.give(order, by);
        self.inner.changed.notify_all();
        ticket
    }

    /// What happened to the order on the disk; `None` while it is not settled. For orders in quick succession the
    /// result of the newest one applies to all.
    pub(crate) fn outcome(&self, ticket: Ticket) -> Option<KeepResult> {
        self.inner.state().desk.outcome(ticket)
    }

    /// The standing order.
    #[cfg(test)]
    pub(crate) fn standing(&self) -> Option<Order> {
        self.inner.state().desk.stands
    }

    /// The standing order, once it is kept over restarts (or the rig does without, as a mock may).
    pub fn kept(&self) -> Option<Order> {
        self.inner.state().desk.kept()
    }

    /// Ends the thread; waits at most half a second. After an orderly end BLACK and FREEZE of a mock are forgotten; all
    /// else remains.
    pub fn end(mut self, orderly: bool) {
        let mut state = self.inner.state();
        state.desk.end(orderly && self.inner.file.ends_with_the_run());
        state.closing = true;
        self.inner.changed.notify_all();
        let waited = self.inner.changed.wait_timeout_while(state, END_WITHIN, |state| !state.closed);
        let closed = waited.map_or_else(|e| e.into_inner().0.closed, |(state, _)| state.closed);
        if let Some(thread) = self.thread.take().filter(|_| closed) {
            let _ = thread.join();
        }
    }
}

impl Drop for Orders {
    fn drop(&mut self) {
        self.inner.state().closing = true;
        self.inner.changed.notify_all();
    }
}

impl OrderShare {
    fn state(&self) -> MutexGuard<'_, OrderState> {
        // Nothing panics while it holds this lock; and even then an order must get through.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn write_down(&self) {
        let mut state = self.state();
        loop {
            let Some(given) = state.desk.next() else {
                if state.closing {
                    break;
                }
                let waited = self.changed.wait_timeout(state, LOOK);
                state = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            };
            drop(state);
            let outcome = given.write(&self.file, self.keeps);
            state = self.state();
            state.desk.settle(&given, outcome);
            self.changed.notify_all();
        }
        state.closed = true;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{ProjectorBackend, Restart};
    use crate::interlock::{Contact, Interlock};
    use crate::projectors::backend;
    use crate::standing::{standing_in, Identity};
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Instant;

    struct OrderedRig {
        dir: PathBuf,
        identity: Identity,
        monitor: Arc<RunMonitor>,
    }

    impl OrderedRig {
        fn new(name: &str) -> Self {
            Self::with(name, &backend("mock").unwrap())
        }

        fn with(name: &str, backend: &ProjectorBackend) -> Self {
            let dir = std::env::temp_dir().join(format!("dpm-order-thread-{}-{name}", std::process::id()));
            let _ = std::fs::remove_dir_all(&dir);
            Self { dir, identity: Identity::of(backend), monitor: Arc::default() }
        }

        fn start(&self) -> Orders {
            self.start_by(Restart::ByItself)
        }

        fn start_by(&self, start: Restart) -> Orders {
            let (file, error, kept) = OrderFile::open(Some(self.dir.clone()), self.identity.clone());
            assert!(error.is_none(), "{error:?}");
            let stands = Stands::at_start(kept, start);
            Orders::start(self.monitor.clone(), file, true, stands.as_ref()).unwrap()
        }

        fn on_disk(&self) -> Option<Order> {
            standing_in(&self.dir, &self.identity).map(|s| s.order)
        }
    }

    impl Drop for OrderedRig {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.dir);
        }
    }

    fn settled(orders: &Orders, ticket: Ticket) -> KeepResult {
        let begin = Instant::now();
        loop {
            if let Some(kept) = orders.outcome(ticket) {
                return kept;
            }
            assert!(begin.elapsed() < Duration::from_secs(20), "never settled");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Found in use, R4.
    #[test]
    fn r4_the_light_hears_first_and_arm_comes_after_the_disk_has_forgotten() {
        let rig = OrderedRig::new("first");
        let orders = rig.start();
        assert_eq!(rig.monitor.take_order(), None);
        let ticket = orders.give(Order::Safe, By::Key);
        // The light receives it before the disk can.
        assert_eq!(rig.monitor.take_order(), Some(Order::Safe));
        let KeepResult::In(path) = settled(&orders, ticket) else { panic!("not kept") };
        assert!(path.starts_with(&rig.dir));
        // A weaker order does not replace it, on the disk or in memory.
        let ticket = orders.give(Order::Freeze, By::Key);
        assert!(matches!(settled(&orders, ticket), KeepResult::In(_)));
        assert_eq!((rig.on_disk(), orders.standing()), (Some(Order::Safe), Some(Order::Safe)));
        let _ = rig.monitor.take_order();
        let ticket = orders.give(Order::Arm, By::Key);
        assert_eq!(settled(&orders, ticket), KeepResult::Forgotten);
        assert_eq!((rig.on_disk(), rig.monitor.take_order()), (None, Some(Order::Arm)));
        orders.end(true);
    }

    /// Found in use, R3: a restart of the service brought light back that somebody had ended by BLACK.
    #[test]
    fn r3_no_end_lifts_an_order_but_that_of_a_mock_and_then_only_what_is_no_safe() {
        let real = backend("usb").unwrap();
        let [mut mock, mut real] = [OrderedRig::new("end"), OrderedRig::with("end-real", &real)];
        let (black, safe) = (Some(Order::Black), Some(Order::Safe));
        // What is left of a mock's order and of a real projector's.
        for (order, orderly, of_mock, of_real) in [
            (Order::Black, true, None, black),
            (Order::Arm, true, None, None),
            (Order::Freeze, true, None, black),
            (Order::Safe, true, safe, safe),
            (Order::Arm, true, None, None),
            (Order::Black, false, black, black),
            (Order::Arm, false, None, None),
            (Order::Freeze, false, black, black),
            (Order::Safe, false, safe, safe),
        ] {
            for (rig, left) in [(&mut mock, of_mock), (&mut real, of_real)] {
                // The monitor of a finished run remains stopped.
                rig.monitor = Arc::default();
                let orders = rig.start();
                // The standing order has been given to the light.
                assert_eq!(rig.monitor.dark_is_ordered(), rig.on_disk().is_some());
                let ticket = orders.give(order, By::Key);
                settled(&orders, ticket);
                orders.end(orderly);
                assert_eq!(rig.on_disk(), left, "{} {order:?} {orderly}", rig.identity);
            }
        }
    }

    #[test]
    fn a_start_by_hand_is_dark_until_somebody_arms_and_so_is_the_next() {
        let mut rig = OrderedRig::new("by-hand");
        for _ in 0..2 {
            rig.monitor = Arc::default();
            let orders = rig.start_by(Restart::ByHand);
            assert_eq!((rig.monitor.take_order(), orders.kept()), (Some(Order::Black), Some(Order::Black)));
            assert_eq!(rig.on_disk(), None, "the rig file holds it, and no order of a person");
            let ticket = orders.give(Order::Arm, By::Key);
            assert_eq!(settled(&orders, ticket), KeepResult::Forgotten);
            assert_eq!((rig.monitor.take_order(), orders.kept()), (Some(Order::Arm), None));
            orders.end(true);
        }
        // An order that was given before it was armed is kept as ever.
        rig.monitor = Arc::default();
        let orders = rig.start_by(Restart::ByHand);
        let ticket = orders.give(Order::Freeze, By::Key);
        assert!(matches!(settled(&orders, ticket), KeepResult::In(_)));
        orders.end(false);
        assert_eq!(rig.on_disk(), Some(Order::Black));
    }

    struct ContactFlag(Arc<AtomicBool>);

    impl Contact for ContactFlag {
        fn is_closed(&mut self) -> bool {
            self.0.load(Ordering::Relaxed)
        }
    }

    /// An interlock that is reset by hand and has opened: dark after it has closed, and in the next run.
    #[test]
    fn an_interlock_that_is_reset_by_hand_waits_for_arm_over_restarts() {
        let rig = OrderedRig::with("reset", &backend("usb").unwrap());
        let contact = Arc::new(AtomicBool::new(true));
        let interlock = Interlock::with_contact("a switch", ContactFlag(contact.clone())).unwrap();
        rig.monitor.set_interlock(interlock.reset_by(Restart::ByHand));
        let orders = rig.start();
        let until = |what: &str, done: &dyn Fn() -> bool| {
            let begin = Instant::now();
            while !done() {
                assert!(begin.elapsed() < Duration::from_secs(20), "{what}");
                std::thread::sleep(Duration::from_millis(1));
            }
        };
        // A busy machine that asks the contact too late opens it as well.
        let is_armed = || {
            settled(&orders, orders.give(Order::Arm, By::Key));
            rig.monitor.light_allowed() && rig.on_disk().is_none()
        };
        until("light", &is_armed);
        contact.store(false, Ordering::Relaxed);
        until("kept", &|| rig.on_disk() == Some(Order::Black));
        // ARM while it is open permits nothing, now or when it closes.
        settled(&orders, orders.give(Order::Arm, By::Key));
        until("kept again", &|| rig.on_disk() == Some(Order::Black) && orders.kept().is_some());
        contact.store(true, Ordering::Relaxed);
        for _ in 0..50 {
            assert!(!rig.monitor.light_allowed(), "nobody has armed it since it closed");
            std::thread::sleep(Duration::from_millis(1));
        }
        until("light again", &is_armed);
        orders.end(true);
    }

    #[test]
    fn a_dark_order_that_follows_an_arm_at_once_wins() {
        let rig = OrderedRig::new("race");
        let orders = rig.start();
        for _ in 0..50 {
            orders.give(Order::Safe, By::Key);
            orders.give(Order::Arm, By::Key);
            let ticket = orders.give(Order::Safe, By::Key);
            assert!(matches!(settled(&orders, ticket), KeepResult::In(_)));
            assert_eq!(rig.on_disk(), Some(Order::Safe));
            assert_eq!(rig.monitor.take_order(), Some(Order::Safe));
            assert_eq!(rig.monitor.take_order(), None, "the ARM before it is not taken after it");
        }
        orders.end(true);
    }

    #[test]
    fn an_order_that_cannot_be_kept_is_obeyed_and_an_arm_that_cannot_forget_is_not() {
        let rig = OrderedRig::new("broken");
        let orders = rig.start();
        let ticket = orders.give(Order::Safe, By::Key);
        settled(&orders, ticket);
        let _ = rig.monitor.take_order();
        // An object in its place that no rename replaces and no unlink removes.
        let path = rig.dir.join(rig.identity.order_name(None));
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        std::fs::write(path.join("x"), b"").unwrap();
        let ticket = orders.give(Order::Safe, By::Key);
        assert_eq!(rig.monitor.take_order(), Some(Order::Safe));
        assert!(matches!(settled(&orders, ticket), KeepResult::Not(why) if why.contains("mock-projector")));
        let ticket = orders.give(Order::Arm, By::Key);
        assert!(matches!(settled(&orders, ticket), KeepResult::Not(_)));
        assert_eq!(rig.monitor.take_order(), None);
        orders.end(true);
    }
}
