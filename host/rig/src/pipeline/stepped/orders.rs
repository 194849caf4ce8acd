//! Orders that are written down without a thread: whoever steps them says how long the disk takes.

use crate::config::Restart;
use crate::control::orders::{KeepResult, OrderDesk, OrderOnItsWay, Ticket};
use crate::order::Order;
use crate::standing::{standing_in_folder, By, Identity, OrderFile, Stands, StateFolder};
use crate::telemetry::monitor::RunMonitor;
use dpm_device::time::HostTime;
use std::sync::Arc;

/// What happened to an order on the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoredOrder {
    /// It is kept over restarts.
    Kept,
    /// The standing order is forgotten.
    Forgotten,
    /// The disk refused.
    Refused,
}

/// The orders of one process.
pub struct SteppedOrders {
    desk: OrderDesk,
    file: OrderFile,
    keeps: bool,
    writes: Option<(HostTime, OrderOnItsWay)>,
}

impl SteppedOrders {
    /// Reads what stands for `identity` in `folder`, and gives it, or what `start` demands, to the run that is about to
    /// begin.
    ///
    /// # Errors
    /// The folder cannot be used: the process ends with exit code 2 before it makes any light.
    pub fn begin(
        folder: Box<dyn StateFolder>,
        identity: Identity,
        monitor: Arc<RunMonitor>,
        start: Restart,
    ) -> Result<Self, String> {
        let stands = Stands::begin(standing_in_folder(folder.as_ref(), &identity), start, &monitor);
        let (file, error) = OrderFile::in_folder(folder, identity);
        if let Some(e) = error {
            return Err(e.to_string());
        }
        monitor.hold_devices(file.by_serial_number());
        let desk = OrderDesk::new(monitor, stands.as_ref(), file.path());
        Ok(Self { desk, file, keeps: true, writes: None })
    }

    /// Gives an order to the light and to the disk.
    pub fn give(&mut self, order: Order, by: By) -> Ticket {
        self.desk.give(order, by)
    }

    /// What became of the order; `None` while it is not settled.
    pub fn outcome(&self, ticket: Ticket) -> Option<StoredOrder> {
        Some(match self.desk.outcome(ticket)? {
            KeepResult::In(_) | KeepResult::Nowhere => StoredOrder::Kept,
            KeepResult::Forgotten => StoredOrder::Forgotten,
            KeepResult::Not(_) => StoredOrder::Refused,
        })
    }

    /// The standing order, once it is kept over restarts.
    pub fn kept(&self) -> Option<Order> {
        self.desk.kept()
    }

    /// Begins and ends the writing of orders. `disk_ns`: how long the next one takes. Returns when to call again.
    pub fn step(&mut self, now: HostTime, disk_ns: i64) -> Option<HostTime> {
        if let Some((at, given)) = self.writes.take() {
            if at > now {
                self.writes = Some((at, given));
                return Some(at);
            }
            let outcome = given.write(&self.file, self.keeps);
            self.desk.settle(&given, outcome);
        }
        let given = self.desk.next()?;
        let at = now.plus_ns(disk_ns);
        self.writes = Some((at, given));
        Some(at)
    }

    /// The process ends: all that waits is written.
    pub fn end(mut self, orderly: bool) {
        self.desk.end(orderly && self.file.ends_with_the_run());
        let writes = self.writes.take().map(|(_, given)| given);
        let mut next = writes.or_else(|| self.desk.next());
        while let Some(given) = next {
            let outcome = given.write(&self.file, self.keeps);
            self.desk.settle(&given, outcome);
            next = self.desk.next();
        }
    }
}
