//! Assembles planes into whole frames that wait to be lit, in a fixed set of buffers.

use alloc::{boxed::Box, vec, vec::Vec};

use crate::time::DeviceTicks;

/// A frame of which something has arrived.
#[derive(Clone, Copy, Debug)]
pub(super) struct Assembling {
    pub frame: u32,
    pub target_at: DeviceTicks,
    /// When its first packet arrived.
    pub begun_at: DeviceTicks,
    /// Bit k: plane k arrived intact.
    pub received: u32,
    /// A plane was decoded against the base frame.
    pub uses_base: bool,
    /// Buffer it is written to; `None` if the frame is refused and its planes are skipped.
    pub buffer: Option<usize>,
}

/// A whole frame that waits for its slot.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pending {
    pub frame: u32,
    pub slot: u64,
    pub dark_from: DeviceTicks,
    pub buffer: usize,
}

/// A frame, the buffer of its planes, and the end of its light.
#[derive(Clone, Copy, Debug)]
pub(super) struct Held {
    pub frame: u32,
    pub dark_from: DeviceTicks,
    pub buffer: usize,
}

/// All buffers. `capacity` frames may wait; one is lit, one is being written, one may serve as the base of the next.
#[derive(Clone, Debug)]
pub(super) struct FrameStore {
    buffers: Vec<Box<[u8]>>,
    pub assembling: Option<Assembling>,
    pending: Vec<Pending>,
    capacity: usize,
    /// The frame on the mirrors.
    pub lit: Option<Held>,
    /// The newest whole frame, lit or not: kept planes refer to it.
    pub base: Option<Held>,
}

impl FrameStore {
    pub(super) fn new(capacity: usize, frame_bytes: usize) -> Self {
        Self {
            buffers: (0..capacity + 3).map(|_| vec![0; frame_bytes].into_boxed_slice()).collect(),
            assembling: None,
            pending: Vec::with_capacity(capacity),
            capacity,
            lit: None,
            base: None,
        }
    }

    /// A buffer that nothing refers to. One always exists while no frame is being assembled.
    pub(super) fn free_buffer(&self) -> usize {
        debug_assert!(self.assembling.is_none_or(|a| a.buffer.is_none()));
        (0..self.buffers.len())
            .find(|&i| {
                self.pending.iter().all(|p| p.buffer != i)
                    && self.lit.is_none_or(|h| h.buffer != i)
                    && self.base.is_none_or(|h| h.buffer != i)
            })
            .expect("capacity + 3 buffers, at most capacity + 2 referred to")
    }

    pub(super) fn bytes(&self, buffer: usize) -> &[u8] {
        &self.buffers[buffer]
    }

    pub(super) fn bytes_mut(&mut self, buffer: usize) -> &mut [u8] {
        &mut self.buffers[buffer]
    }

    /// Copies `len` bytes at `at` from buffer `from` to buffer `to`.
    pub(super) fn copy(&mut self, from: usize, to: usize, at: usize, len: usize) {
        if from == to {
            return;
        }
        let (low, high) = self.buffers.split_at_mut(from.max(to));
        let (source, target) = if from < to { (&low[from], &mut high[0]) } else { (&high[0], &mut low[to]) };
        target[at..at + len].copy_from_slice(&source[at..at + len]);
    }

    /// Frames that wait, and the one that is arriving.
    pub(super) fn in_flight(&self) -> usize {
        self.pending.len() + usize::from(self.assembling.is_some_and(|a| a.buffer.is_some()))
    }

    pub(super) fn pending(&self) -> &[Pending] {
        &self.pending
    }

    pub(super) fn free(&self) -> usize {
        self.capacity - self.pending.len()
    }

    pub(super) fn push(&mut self, pending: Pending) {
        assert!(self.pending.len() < self.capacity, "checked by the caller");
        self.pending.push(pending);
    }

    /// Takes the newest frame due in or before `slot`, and returns the number of older ones that it replaces. Frames
    /// arrive in the order of their numbers, so every earlier one in the queue is older.
    pub(super) fn take_due(&mut self, slot: u64) -> Option<(Pending, u32)> {
        let newest = self.pending.iter().rposition(|p| p.slot <= slot)?;
        let due = self.pending[newest];
        self.pending.drain(..=newest);
        Some((due, newest as u32))
    }

    /// Clears everything: no frame waits, is lit or can be referred to. Returns the number of dropped frames.
    pub(super) fn clear(&mut self) -> u32 {
        let thrown = self.in_flight() as u32;
        self.assembling = None;
        self.pending.clear();
        self.lit = None;
        self.base = None;
        thrown
    }
}
