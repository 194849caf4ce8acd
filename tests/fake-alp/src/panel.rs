//! The panel: memory, sequences, queue and light, as a state machine. Time is an argument, in nanoseconds.

use std::collections::{BTreeMap, VecDeque};

use crate::codes::*;
use crate::sequence::Sequence;
use crate::Settings;

/// Records of light that are kept; older ones are dropped and counted.
const SHOWN_KEPT: usize = 100_000;

/// A picture that was on the mirrors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shown {
    /// From when.
    pub from_ns: i64,
    /// Until when.
    pub until_ns: i64,
    /// The sequence that it belongs to.
    pub sequence: u32,
    /// Its number in the sequence.
    pub picture: u32,
    /// Nothing followed, and the mirrors kept it.
    pub kept: bool,
    /// Its bits: rows top to bottom, bit 7 of a byte is the leftmost mirror.
    pub plane: std::sync::Arc<[u8]>,
}

/// A sequence in the queue, or on the mirrors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    pub queue_id: u32,
    pub sequence: u32,
    /// Runs left; `None` runs for ever.
    pub runs: Option<u32>,
    /// Ends after the present run.
    pub end_of_run: bool,
    /// Ends after the present picture.
    pub end_of_picture: bool,
}

/// What is on the mirrors now.
#[derive(Clone, Debug)]
pub(crate) struct Running {
    pub entry: Entry,
    pub picture: u32,
    /// Start of the present picture.
    pub from_ns: i64,
}

/// The last picture of what was shown, kept.
#[derive(Clone, Debug)]
struct Kept {
    sequence: u32,
    picture: u32,
    from_ns: i64,
    plane: std::sync::Arc<[u8]>,
}

/// One device.
#[derive(Debug)]
pub struct Panel {
    /// Its properties.
    pub settings: Settings,
    pub(crate) sequences: BTreeMap<u32, Sequence>,
    pub(crate) queue: VecDeque<Entry>,
    pub(crate) running: Option<Running>,
    pub(crate) queue_mode: i32,
    pub(crate) disconnect: i32,
    pub(crate) last_queue_id: u32,
    next_sequence: u32,
    kept: Option<Kept>,
    halt_at: Option<i64>,
    now_ns: i64,
    shown: VecDeque<Shown>,
    shown_lost: u64,
    /// Sequences that were not freed when their device was.
    pub leaked: u64,
}

impl Panel {
    /// A panel with nothing in its memory.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            sequences: BTreeMap::new(),
            queue: VecDeque::new(),
            running: None,
            queue_mode: PROJ_LEGACY,
            disconnect: USB_RESET,
            last_queue_id: INVALID_ID,
            next_sequence: 1,
            kept: None,
            halt_at: None,
            now_ns: i64::MIN,
            shown: VecDeque::new(),
            shown_lost: 0,
            leaked: 0,
        }
    }

    /// Nanoseconds on the host's clock of a time on the panel's.
    fn host_ns(&self, us: i32) -> i64 {
        let exact = f64::from(us) * 1000.0 / (1.0 + self.settings.clock_ppm * 1e-6);
        exact.round() as i64
    }

    /// Shows everything that falls until `now`.
    pub fn advance(&mut self, now: i64) {
        self.now_ns = self.now_ns.max(now);
        while let Some(running) = self.running.clone() {
            let sequence = &self.sequences[&running.entry.sequence];
            let end = running.from_ns + self.host_ns(sequence.active.picture_us);
            if let Some(halt) = self.halt_at.filter(|halt| *halt <= end.min(self.now_ns)) {
                self.note(&running, halt);
                self.keep(&running, halt);
                (self.running, self.halt_at) = (None, None);
                break;
            }
            if end > self.now_ns {
                break;
            }
            self.note(&running, end);
            self.step(running, end);
        }
        if self.running.is_none() {
            self.halt_at = None;
        }
    }

    /// What follows the picture that ends at `end`.
    fn step(&mut self, mut running: Running, end: i64) {
        let sequence = &self.sequences[&running.entry.sequence];
        running.from_ns = end;
        if !running.entry.end_of_picture {
            if running.picture < sequence.last {
                running.picture += 1;
                self.running = Some(running);
                return;
            }
            let left = running.entry.runs.map(|runs| runs - 1);
            if left != Some(0) && !running.entry.end_of_run {
                running.entry.runs = left;
                running.picture = sequence.first;
                self.running = Some(running);
                return;
            }
        }
        self.keep(&running, end);
        self.running = None;
        self.begin_next(end);
    }

    /// Takes the next sequence from the queue at `at`.
    pub(crate) fn begin_next(&mut self, at: i64) {
        if let Some(entry) = self.queue.pop_front() {
            self.end_kept(at);
            let first = self.sequences[&entry.sequence].first;
            self.running = Some(Running { entry, picture: first, from_ns: at });
        }
    }

    fn keep(&mut self, running: &Running, at: i64) {
        if self.settings.keeps_last {
            let plane = self.sequences[&running.entry.sequence].picture(running.picture);
            self.kept =
                Some(Kept { sequence: running.entry.sequence, picture: running.picture, from_ns: at, plane });
        }
    }

    /// Ends the kept picture, and notes it if it was there for a time.
    fn end_kept(&mut self, at: i64) {
        if let Some(kept) = self.kept.take().filter(|kept| kept.from_ns < at) {
            self.push(Shown {
                from_ns: kept.from_ns,
                until_ns: at,
                sequence: kept.sequence,
                picture: kept.picture,
                kept: true,
                plane: kept.plane,
            });
        }
    }

    /// Notes the picture that is on the mirrors until `end`.
    fn note(&mut self, running: &Running, end: i64) {
        let sequence = &self.sequences[&running.entry.sequence];
        let lit = running.from_ns + self.host_ns(sequence.active.light_us());
        let plane = sequence.picture(running.picture);
        self.push(Shown {
            from_ns: running.from_ns,
            until_ns: end.min(lit),
            sequence: running.entry.sequence,
            picture: running.picture,
            kept: false,
            plane,
        });
    }

    fn push(&mut self, shown: Shown) {
        if self.shown.len() >= SHOWN_KEPT {
            self.shown.pop_front();
            self.shown_lost += 1;
        }
        self.shown.push_back(shown);
    }

    /// The oldest picture that was shown and not yet taken.
    pub fn next_shown(&mut self) -> Option<Shown> {
        self.shown.pop_front()
    }

    /// Records that were dropped before they were taken.
    pub fn shown_lost(&self) -> u64 {
        self.shown_lost
    }

    /// Whether a mirror sends light now.
    pub fn is_lit(&self) -> bool {
        let plane = match (&self.running, &self.kept) {
            (Some(running), _) if running.from_ns <= self.now_ns => {
                self.sequences[&running.entry.sequence].picture(running.picture)
            }
            (_, Some(kept)) => kept.plane.clone(),
            _ => return false,
        };
        plane.iter().any(|byte| *byte != 0)
    }

    /// When everything that was started ends by itself; `None` if it never does. What the mirrors keep then counts as light, unless it is
    /// dark: then the answer is `i64::MAX` too late to be true.
    pub fn runs_until(&self) -> Option<i64> {
        let mut at = self.now_ns;
        if let Some(running) = &self.running {
            let sequence = &self.sequences[&running.entry.sequence];
            let left = i64::from(running.entry.runs? - 1) * i64::from(sequence.pictures_shown())
                + i64::from(sequence.last - running.picture + 1);
            at = running.from_ns + left * self.host_ns(sequence.active.picture_us);
        }
        for entry in &self.queue {
            let sequence = &self.sequences[&entry.sequence];
            let pictures = i64::from(entry.runs?) * i64::from(sequence.pictures_shown());
            at += pictures * self.host_ns(sequence.active.picture_us);
        }
        Some(at)
    }

    /// Whether the picture that remains at the end of everything is dark.
    pub fn ends_dark(&self) -> bool {
        let last = self.queue.back().or(self.running.as_ref().map(|running| &running.entry));
        match last {
            Some(entry) => {
                let sequence = &self.sequences[&entry.sequence];
                sequence.picture(sequence.last).iter().all(|byte| *byte == 0)
            }
            None => !self.is_lit(),
        }
    }

    /// Stops everything at once, and the mirrors are dark.
    pub(crate) fn stop(&mut self, now: i64) {
        self.advance(now);
        if let Some(running) = self.running.take().filter(|running| running.from_ns < now) {
            self.note(&running, now);
        }
        self.end_kept(now);
        self.queue.clear();
        self.halt_at = None;
    }

    /// `AlpProjHalt`: empties the queue, and stops a little later.
    pub(crate) fn halt(&mut self, now: i64) {
        self.queue.clear();
        let at = now + i64::from(self.settings.halt_us) * 1000;
        self.halt_at = self.running.is_some().then_some(at);
    }

    /// Ends the sequence on the mirrors now, and goes on with the next one.
    pub(crate) fn abort_now(&mut self, now: i64) {
        if let Some(running) = self.running.take() {
            if running.from_ns < now {
                self.note(&running, now);
            }
            self.keep(&running, now);
            self.begin_next(now);
        }
    }

    /// The cable was pulled.
    pub fn unplug(&mut self, now: i64) {
        self.advance(now);
        if self.disconnect == USB_RESET {
            self.stop(now);
            self.sequences.clear();
            self.queue_mode = PROJ_LEGACY;
        }
    }

    /// Frees what is left, as `AlpDevFree` does.
    pub(crate) fn release(&mut self, now: i64) {
        self.stop(now);
        self.leaked += self.sequences.len() as u64;
        self.sequences.clear();
        self.queue_mode = PROJ_LEGACY;
        self.disconnect = USB_RESET;
    }

    /// Whether `sequence` is being shown or waits.
    pub(crate) fn in_use(&self, sequence: u32) -> bool {
        self.running.as_ref().is_some_and(|running| running.entry.sequence == sequence)
            || self.queue.iter().any(|entry| entry.sequence == sequence)
    }

    /// Free memory in binary pictures.
    pub fn free_memory(&self) -> u32 {
        let used: u32 = self.sequences.values().map(|sequence| sequence.pictures).sum();
        self.settings.memory - used
    }

    /// Sequences in its memory.
    pub fn sequences(&self) -> usize {
        self.sequences.len()
    }

    pub(crate) fn allocate(&mut self, bit_planes: i32, pictures: i32) -> Result<u32, i32> {
        // The model knows binary sequences only.
        let pictures =
            u32::try_from(pictures).ok().filter(|n| *n > 0 && bit_planes == 1).ok_or(PARM_INVALID)?;
        if pictures > self.free_memory() {
            return Err(MEMORY_FULL);
        }
        let id = self.next_sequence;
        self.next_sequence += 1;
        self.sequences.insert(id, Sequence::new(&self.settings, pictures));
        Ok(id)
    }
}
