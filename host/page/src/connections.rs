//! The open connections: how many there may be, and which one ends when one more comes.
//!
//! A connection that moves no byte for a while ends. When all places are taken, the one that is of least use ends for
//! the new one: a silent one before one that waits for an answer, and that before one that follows the rig's events.
//! One whose order is being carried out never ends for another.

use std::sync::atomic::{AtomicU64, AtomicU8, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::AbortHandle;

/// Places for connections.
pub(crate) const PLACES: usize = 64;
/// Viewers that follow the rig's events at once.
pub(crate) const VIEWERS: usize = 8;
/// A connection that moves no byte for so long ends.
const STILL: Duration = Duration::from_secs(15);

/// What a connection is doing; the larger, the more it matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub(crate) enum Doing {
    /// It has asked for nothing, or has its answer.
    Nothing = 0,
    /// It waits for an answer.
    Asks = 1,
    /// It follows the rig's events.
    Views = 2,
    /// It waits for the answer to an order.
    Orders = 3,
}

/// The state of one connection, shared with its task.
#[derive(Debug)]
pub(crate) struct Connection {
    doing: AtomicU8,
    began: Instant,
    /// Milliseconds after `began` at which the last byte moved.
    moved_ms: AtomicU64,
}

impl Connection {
    pub(crate) fn new() -> Arc<Self> {
        Arc::new(Self { doing: AtomicU8::new(0), began: Instant::now(), moved_ms: AtomicU64::new(0) })
    }

    /// A byte came or went.
    pub(crate) fn moved(&self) {
        self.moved_ms.store(self.began.elapsed().as_millis() as u64, Ordering::Relaxed);
    }

    pub(crate) fn now_does(&self, doing: Doing) {
        self.doing.store(doing as u8, Ordering::Relaxed);
    }

    pub(crate) fn doing(&self) -> u8 {
        self.doing.load(Ordering::Relaxed)
    }

    fn still_for(&self) -> Duration {
        let moved = Duration::from_millis(self.moved_ms.load(Ordering::Relaxed));
        self.began.elapsed().saturating_sub(moved)
    }
}

/// A connection's task.
#[derive(Debug)]
struct ConnectionSlot {
    connection: Arc<Connection>,
    task: AbortHandle,
}

/// All connections, oldest first.
#[derive(Debug, Default)]
pub(crate) struct Connections(Vec<ConnectionSlot>);

impl Connections {
    /// Ends those that stand still, and makes room for one more. False if every place is taken by an order.
    pub(crate) fn make_room(&mut self) -> bool {
        self.sweep();
        if self.0.len() < PLACES {
            return true;
        }
        // The first of the smallest is the oldest.
        let least = self.0.iter().enumerate().min_by_key(|(_, p)| p.connection.doing()).map(|(i, _)| i);
        match least {
            Some(i) if self.0[i].connection.doing() < Doing::Orders as u8 => {
                self.0.remove(i).task.abort();
                true
            }
            _ => false,
        }
    }

    /// Forgets connections that have ended, and ends those that stand still.
    pub(crate) fn sweep(&mut self) {
        self.0.retain(|place| {
            let is_still =
                place.connection.still_for() > STILL && place.connection.doing() < Doing::Orders as u8;
            if is_still {
                place.task.abort();
            }
            !is_still && !place.task.is_finished()
        });
    }

    /// Takes a place; call [`Connections::make_room`] before.
    pub(crate) fn take(&mut self, connection: Arc<Connection>, task: AbortHandle) {
        self.0.push(ConnectionSlot { connection, task });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn full(doing: impl Fn(usize) -> Doing) -> Connections {
        let mut all = Connections::default();
        for k in 0..PLACES {
            assert!(all.make_room());
            let connection = Connection::new();
            connection.now_does(doing(k));
            all.take(connection, tokio::spawn(std::future::pending::<()>()).abort_handle());
        }
        all
    }

    fn run(test: impl FnOnce()) {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(async { test() });
    }

    #[test]
    fn the_oldest_of_the_least_use_ends_for_a_new_one() {
        run(|| {
            let mut all = full(|k| if k % 3 == 0 { Doing::Views } else { Doing::Asks });
            let viewers = |all: &Connections| all.0.iter().filter(|p| p.connection.doing() == 2).count();
            let before = viewers(&all);
            let second = all.0[1].connection.clone();
            assert!(all.make_room());
            assert_eq!((all.0.len(), viewers(&all)), (PLACES - 1, before));
            assert!(!all.0.iter().any(|p| Arc::ptr_eq(&p.connection, &second)), "the oldest that asks");
        });
    }

    #[test]
    fn nobody_takes_the_place_of_an_order() {
        run(|| {
            let mut all = full(|_| Doing::Orders);
            assert!(!all.make_room());
            assert_eq!(all.0.len(), PLACES);
            all.0[9].connection.now_does(Doing::Nothing);
            assert!(all.make_room());
        });
    }
}
