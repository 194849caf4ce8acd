//! Passes the newest value from one thread to another: a triple buffer.
//!
//! There are three cells: one being written, one being read, and one in the middle. Publishing swaps the writer's cell
//! with the middle one and marks it fresh; reading swaps the reader's cell with the middle one if it is fresh. Both are
//! wait-free, and a value is never torn. A slow reader does not hold up the writer: newer values overwrite those that
//! it had no time for, which is intended.
#![allow(unsafe_code)]

use crate::sync::{Arc, AtomicU8, Ordering, UnsafeCell};
use crossbeam::utils::CachePadded;

/// Set when the middle cell holds a value that the reader has not seen.
const FRESH: u8 = 0b100;
const INDEX: u8 = 0b011;

#[derive(Debug)]
struct Slots<T> {
    cells: [UnsafeCell<T>; 3],
    /// Index of the middle cell, and [`FRESH`].
    middle: CachePadded<AtomicU8>,
}

// SAFETY: a cell is accessed only by the side that owns its index at the time; ownership moves through `middle` with
// acquire and release on both sides. Values cross threads, so T must be Send; two threads never share a reference to
// one.
unsafe impl<T: Send> Sync for Slots<T> {}

/// The writing side.
#[derive(Debug)]
pub struct Publisher<T> {
    shared: Arc<Slots<T>>,
    back: u8,
}

/// The reading side.
#[derive(Debug)]
pub struct Reader<T> {
    shared: Arc<Slots<T>>,
    front: u8,
}

/// A slot in which the newest value wins. The reader sees `initial` until something is published.
pub fn latest<T: Clone + Send>(initial: T) -> (Publisher<T>, Reader<T>) {
    let cells = [initial.clone(), initial.clone(), initial].map(UnsafeCell::new);
    let shared = Arc::new(Slots { cells, middle: CachePadded::new(AtomicU8::new(1)) });
    (Publisher { shared: shared.clone(), back: 0 }, Reader { shared, front: 2 })
}

impl<T> Publisher<T> {
    /// Makes `value` the newest. The value that it replaces (an old one) is dropped here, on the writer's thread.
    pub fn publish(&mut self, value: T) {
        self.publish_with(|cell| *cell = value);
    }

    /// Publishes a cell after `write` has modified it in place, without a copy. The cell holds some older value;
    /// nothing is published if `write` panics.
    pub fn publish_with(&mut self, write: impl FnOnce(&mut T)) {
        self.shared.cells[usize::from(self.back)].with_mut(|cell| {
            // SAFETY: `back` belongs to this publisher alone until the swap below; `&mut self` excludes a second call.
            write(unsafe { &mut *cell });
        });
        // Release: the write above is visible to whoever takes the cell. Acquire: the cell that we get back is no
        // longer being read.
        let before = self.shared.middle.swap(self.back | FRESH, Ordering::AcqRel);
        self.back = before & INDEX;
    }

    /// False once the reader is gone.
    pub fn has_reader(&self) -> bool {
        Arc::strong_count(&self.shared) > 1
    }
}

impl<T> Reader<T> {
    /// The newest value, and whether it is new since the last call.
    pub fn latest(&mut self) -> (&T, bool) {
        // Relaxed: only a hint; the swap synchronises. FRESH is set by the other side and cleared only here, so a set bit
        // cannot vanish in between.
        let fresh = self.shared.middle.load(Ordering::Relaxed) & FRESH != 0;
        if fresh {
            // Acquire: see the value in the cell that we get. Release: our reads of the cell that we return are over.
            let before = self.shared.middle.swap(self.front, Ordering::AcqRel);
            self.front = before & INDEX;
        }
        (self.held(), fresh)
    }

    /// The value that [`Reader::latest`] returned last, or the first one.
    pub fn held(&self) -> &T {
        // SAFETY: `front` belongs to this reader alone until its next swap, which needs `&mut self` and so outlives the borrow.
        self.shared.cells[usize::from(self.front)].with(|cell| unsafe { &*cell })
    }

    /// True when [`Reader::latest`] would return something new.
    pub fn has_news(&self) -> bool {
        self.shared.middle.load(Ordering::Relaxed) & FRESH != 0
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;

    #[test]
    fn newest_wins_and_is_fresh_once() {
        let (mut publisher, mut reader) = latest(0);
        assert_eq!(reader.latest(), (&0, false));
        for i in 1..=5 {
            publisher.publish(i);
        }
        assert!(reader.has_news());
        assert_eq!(reader.held(), &0, "nothing is taken before it is asked for");
        assert_eq!(reader.latest(), (&5, true));
        assert_eq!(reader.latest(), (&5, false));
        assert_eq!((reader.held(), publisher.has_reader()), (&5, true));
        drop(reader);
        assert!(!publisher.has_reader());
    }

    #[test]
    fn values_rise_and_are_whole_under_load() {
        // Miri takes a hundred times as long.
        let n = if cfg!(miri) { 200 } else { 50_000u64 };
        let (mut publisher, mut reader) = latest([0u64; 16]);
        let writer = std::thread::spawn(move || (1..=n).for_each(|i| publisher.publish([i; 16])));
        let mut last = 0;
        while last < n {
            let (value, _) = reader.latest();
            assert!(value.iter().all(|v| *v == value[0]), "torn: {value:?}");
            assert!(value[0] >= last, "went back");
            last = value[0];
            if last < n && !reader.has_news() {
                std::thread::yield_now();
            }
        }
        writer.join().unwrap();
    }
}

#[cfg(all(test, loom))]
mod loom_tests {
    use super::*;

    /// The cells of loom fail the test on any access that the orderings do not separate.
    #[test]
    fn loom_latest_is_whole_and_rises() {
        loom::model(|| {
            let (mut publisher, mut reader) = latest([0u32; 2]);
            let writer = loom::thread::spawn(move || {
                for i in 1..=3 {
                    publisher.publish([i; 2]);
                }
            });
            let mut last = 0;
            for _ in 0..3 {
                let (value, fresh) = reader.latest();
                assert_eq!(value[0], value[1]);
                assert!(if fresh { value[0] > last } else { value[0] == last });
                last = value[0];
            }
            writer.join().unwrap();
            assert_eq!(reader.latest().0, &[3; 2]);
        });
    }

    /// The reader must not still hold the cell that the publisher gets back.
    #[test]
    fn loom_latest_survives_two_readings_of_one_value() {
        loom::model(|| {
            let (mut publisher, mut reader) = latest(0u32);
            let writer = loom::thread::spawn(move || {
                publisher.publish(1);
                publisher.publish(2);
                publisher.publish(3);
                publisher.publish(4);
            });
            let first = *reader.latest().0;
            let second = *reader.latest().0;
            assert!(second >= first);
            writer.join().unwrap();
        });
    }
}
