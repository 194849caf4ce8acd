//! Passes every value in order from one thread to another: a bounded ring, and a pair of rings that recycles buffers.
//!
//! Positions count values since the start and wrap; `position % capacity` is the cell. Only the producer writes `tail`,
//! only the consumer writes `head`. Each side caches its last reading of the other's position, so that in steady state
//! an operation touches one shared cache line.
#![allow(unsafe_code)]

use crate::sync::{Arc, AtomicUsize, Ordering, UnsafeCell};
use crossbeam::utils::CachePadded;
use std::mem::MaybeUninit;

struct RingState<T> {
    cells: Box<[UnsafeCell<MaybeUninit<T>>]>,
    /// Number of values ever taken.
    head: CachePadded<AtomicUsize>,
    /// Number of values ever put in.
    tail: CachePadded<AtomicUsize>,
}

// SAFETY: the producer accesses the cell at a position before it stores a greater `tail` (release), and the consumer
// accesses it after it loads that `tail` (acquire), and the other way round through `head`. So accesses never overlap;
// values move, hence Send.
unsafe impl<T: Send> Sync for RingState<T> {}

impl<T> RingState<T> {
    fn cell(&self, position: usize) -> &UnsafeCell<MaybeUninit<T>> {
        // The capacity is a power of two, so wrapping positions stay consistent.
        &self.cells[position & (self.cells.len() - 1)]
    }
}

impl<T> Drop for RingState<T> {
    fn drop(&mut self) {
        let (mut head, tail) = (self.head.load(Ordering::Relaxed), self.tail.load(Ordering::Relaxed));
        while head != tail {
            self.cell(head).with_mut(|cell| {
                // SAFETY: both sides are gone (`&mut self`); cells from head to tail are initialised and dropped once.
                unsafe { (*cell).assume_init_drop() }
            });
            head = head.wrapping_add(1);
        }
    }
}

/// The producer's side.
pub struct Producer<T> {
    shared: Arc<RingState<T>>,
    tail: usize,
    head_seen: usize,
    capacity: usize,
}

/// The consumer's side.
pub struct Consumer<T> {
    shared: Arc<RingState<T>>,
    head: usize,
    tail_seen: usize,
}

impl<T> std::fmt::Debug for Producer<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Producer").field("put", &self.tail).field("capacity", &self.capacity).finish()
    }
}

impl<T> std::fmt::Debug for Consumer<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Consumer").field("taken", &self.head).finish()
    }
}

/// A ring for up to `capacity` values (at least 1). Allocates its memory here, rounded up to the next power of two.
pub fn ring<T: Send>(capacity: usize) -> (Producer<T>, Consumer<T>) {
    let capacity = capacity.max(1);
    let cells = (0..capacity.next_power_of_two()).map(|_| UnsafeCell::new(MaybeUninit::uninit())).collect();
    let shared = Arc::new(RingState {
        cells,
        head: CachePadded::new(AtomicUsize::new(0)),
        tail: CachePadded::new(AtomicUsize::new(0)),
    });
    (
        Producer { shared: shared.clone(), tail: 0, head_seen: 0, capacity },
        Consumer { shared, head: 0, tail_seen: 0 },
    )
}

impl<T> Producer<T> {
    /// Puts a value in, or returns it if the ring is full.
    pub fn push(&mut self, value: T) -> Result<(), T> {
        if self.tail.wrapping_sub(self.head_seen) >= self.capacity {
            // Acquire: the consumer has moved the value out of the cell we are about to fill.
            self.head_seen = self.shared.head.load(Ordering::Acquire);
            if self.tail.wrapping_sub(self.head_seen) >= self.capacity {
                return Err(value);
            }
        }
        self.shared.cell(self.tail).with_mut(|cell| {
            // SAFETY: the position lies in [tail, head + capacity), which belongs to the producer; the cell holds no value.
            unsafe { (*cell).write(value) };
        });
        self.tail = self.tail.wrapping_add(1);
        // Release: the value is in the cell before the consumer can count it.
        self.shared.tail.store(self.tail, Ordering::Release);
        Ok(())
    }

    /// Upper bound of the number of values put in and not yet taken; the consumer may be taking some right now.
    pub fn len(&self) -> usize {
        self.tail.wrapping_sub(self.shared.head.load(Ordering::Relaxed))
    }

    /// True when every value put in has been taken.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl<T> Consumer<T> {
    /// Takes the oldest value.
    pub fn pop(&mut self) -> Option<T> {
        if self.head == self.tail_seen {
            // Acquire: the values counted are in their cells.
            self.tail_seen = self.shared.tail.load(Ordering::Acquire);
            if self.head == self.tail_seen {
                return None;
            }
        }
        let value = self.shared.cell(self.head).with(|cell| {
            // SAFETY: the position lies in [head, tail): the cell is initialised, belongs to the consumer, and is read
            // once because head moves on.
            unsafe { (*cell).assume_init_read() }
        });
        self.head = self.head.wrapping_add(1);
        // Release: the value is out of the cell before the producer can fill it again.
        self.shared.head.store(self.head, Ordering::Release);
        Some(value)
    }

    /// Lower bound of the number of waiting values; the producer may be adding more.
    pub fn len(&self) -> usize {
        self.shared.tail.load(Ordering::Relaxed).wrapping_sub(self.head)
    }

    /// True when nothing waits.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The side that fills buffers.
#[derive(Debug)]
pub struct Filler<T> {
    filled: Producer<T>,
    free: Consumer<T>,
}

/// The side that empties them.
#[derive(Debug)]
pub struct Drainer<T> {
    filled: Consumer<T>,
    free: Producer<T>,
}

/// A fixed set of buffers that circulates: the filler takes a free one, fills and sends it; the drainer receives it and
/// returns it. Nothing is allocated after this call, and no more than these buffers are ever in flight.
pub fn exchange<T: Send>(buffers: Vec<T>) -> (Filler<T>, Drainer<T>) {
    let n = buffers.len();
    let (filled_in, filled_out) = ring(n);
    let (mut free_in, free_out) = ring(n);
    for buffer in buffers {
        // The ring holds n, so none is refused.
        let _ = free_in.push(buffer);
    }
    (Filler { filled: filled_in, free: free_out }, Drainer { filled: filled_out, free: free_in })
}

impl<T> Filler<T> {
    /// A buffer to fill; `None` while all are in flight (the next stage is slow: skip this frame and count it).
    pub fn take_free(&mut self) -> Option<T> {
        self.free.pop()
    }

    /// Sends a filled buffer. An error (with the buffer) means that the buffer is not one of this exchange.
    pub fn send(&mut self, buffer: T) -> Result<(), T> {
        self.filled.push(buffer)
    }

    /// True when a buffer is free.
    pub fn has_free(&self) -> bool {
        !self.free.is_empty()
    }

    /// Filled buffers that wait for the drainer.
    pub fn queued(&self) -> usize {
        self.filled.len()
    }
}

impl<T> Drainer<T> {
    /// The oldest filled buffer.
    pub fn receive(&mut self) -> Option<T> {
        self.filled.pop()
    }

    /// The newest filled buffer; older ones are returned at once and counted. After a stall this leaves no backlog.
    pub fn receive_newest(&mut self) -> Option<(T, usize)> {
        let mut newest = self.filled.pop()?;
        let mut skipped = 0;
        while let Some(newer) = self.filled.pop() {
            let _ = self.give_back(std::mem::replace(&mut newest, newer));
            skipped += 1;
        }
        Some((newest, skipped))
    }

    /// Returns an emptied buffer. An error (with the buffer) means that the buffer is not one of this exchange.
    pub fn give_back(&mut self, buffer: T) -> Result<(), T> {
        self.free.push(buffer)
    }

    /// True when a filled buffer waits.
    pub fn has_filled(&self) -> bool {
        !self.filled.is_empty()
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize as Count, Ordering::SeqCst};

    #[test]
    fn keeps_order_and_capacity() {
        for capacity in [1, 2, 3, 5, 8] {
            let (mut producer, mut consumer) = ring(capacity);
            for round in 0..10 {
                for i in 0..capacity {
                    assert_eq!(producer.push(round * 100 + i), Ok(()));
                }
                assert_eq!(producer.push(9999), Err(9999));
                assert_eq!(consumer.len(), capacity);
                for i in 0..capacity {
                    assert_eq!(consumer.pop(), Some(round * 100 + i));
                }
                assert_eq!(consumer.pop(), None);
            }
        }
    }

    #[test]
    fn positions_wrap() {
        let (mut producer, mut consumer) = ring(3);
        let near_end = usize::MAX - 1;
        producer.shared.head.store(near_end, SeqCst);
        producer.shared.tail.store(near_end, SeqCst);
        (producer.tail, producer.head_seen) = (near_end, near_end);
        (consumer.head, consumer.tail_seen) = (near_end, near_end);
        for i in 0..20 {
            producer.push(i).unwrap();
            producer.push(i + 1).unwrap();
            assert_eq!(producer.len(), 2);
            assert_eq!((consumer.pop(), consumer.pop(), consumer.pop()), (Some(i), Some(i + 1), None));
        }
    }

    #[test]
    fn drops_each_value_once() {
        struct DropCount<'a>(&'a Count);
        impl Drop for DropCount<'_> {
            fn drop(&mut self) {
                self.0.fetch_add(1, SeqCst);
            }
        }
        let dropped = Count::new(0);
        let (mut producer, mut consumer) = ring(4);
        for _ in 0..4 {
            assert!(producer.push(DropCount(&dropped)).is_ok());
        }
        drop(consumer.pop());
        assert_eq!(dropped.load(SeqCst), 1);
        drop((producer, consumer));
        assert_eq!(dropped.load(SeqCst), 4);
    }

    #[test]
    fn nothing_lost_or_swapped_between_threads() {
        let n = if cfg!(miri) { 200 } else { 20_000u64 };
        let (mut producer, mut consumer) = ring(7);
        let writer = std::thread::spawn(move || {
            for i in 0..n {
                while producer.push(i).is_err() {
                    std::thread::yield_now();
                }
            }
        });
        for i in 0..n {
            let got = loop {
                match consumer.pop() {
                    Some(v) => break v,
                    None => std::thread::yield_now(),
                }
            };
            assert_eq!(got, i);
        }
        writer.join().unwrap();
        assert_eq!(consumer.pop(), None);
    }

    #[test]
    fn a_stall_leaves_no_backlog() {
        let (mut filler, mut drainer) = exchange(vec![[0u64; 4]; 3]);
        let mut refused = 0;
        // The drainer stands still for ten frames.
        for frame in 1..=10 {
            match filler.take_free() {
                Some(mut buffer) => {
                    buffer.fill(frame);
                    filler.send(buffer).unwrap();
                }
                None => refused += 1,
            }
        }
        assert_eq!((refused, filler.queued()), (7, 3));
        let (newest, skipped) = drainer.receive_newest().unwrap();
        assert_eq!((newest[0], skipped), (3, 2));
        drainer.give_back(newest).unwrap();
        // The next frame arrives alone.
        let mut buffer = filler.take_free().unwrap();
        buffer.fill(11);
        filler.send(buffer).unwrap();
        assert_eq!(drainer.receive_newest().map(|(b, skipped)| (b[0], skipped)), Some((11, 0)));
        // A buffer that is not one of the three is refused, not lost.
        let (mut filler, mut drainer) = exchange(vec![1]);
        assert_eq!(drainer.give_back(5), Err(5));
        assert_eq!(filler.take_free(), Some(1));
    }
}

#[cfg(all(test, loom))]
mod loom_tests {
    use super::*;

    /// A ring of one cell: each value is written where the last one was read, so both pairs of orderings matter.
    #[test]
    fn loom_ring_of_one_keeps_values_whole() {
        loom::model(|| {
            let (mut producer, mut consumer) = ring::<[u32; 2]>(1);
            let writer = loom::thread::spawn(move || {
                let mut sent = 0;
                for i in 1..=3 {
                    match producer.push([i; 2]) {
                        Ok(()) => sent = i,
                        Err(_) => loom::thread::yield_now(),
                    }
                }
                sent
            });
            let mut last = 0;
            for _ in 0..3 {
                match consumer.pop() {
                    Some(v) => {
                        assert_eq!(v[0], v[1]);
                        assert!(v[0] > last);
                        last = v[0];
                    }
                    None => loom::thread::yield_now(),
                }
            }
            let sent = writer.join().unwrap();
            if let Some(v) = consumer.pop() {
                last = v[0];
            }
            assert_eq!(last, sent);
        });
    }

    #[test]
    fn loom_exchange_never_shares_a_buffer() {
        loom::model(|| {
            let (mut filler, mut drainer) = exchange(vec![Box::new(0u32)]);
            let writer = loom::thread::spawn(move || {
                for i in 1..=2 {
                    if let Some(mut buffer) = filler.take_free() {
                        *buffer = i;
                        filler.send(buffer).unwrap();
                    } else {
                        loom::thread::yield_now();
                    }
                }
            });
            for _ in 0..2 {
                if let Some((buffer, _)) = drainer.receive_newest() {
                    assert!(*buffer == 1 || *buffer == 2);
                    drainer.give_back(buffer).unwrap();
                } else {
                    loom::thread::yield_now();
                }
            }
            writer.join().unwrap();
        });
    }
}
