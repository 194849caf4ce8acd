//! The queue of the panel: starts, ends and progress of sequences, by the rules of the API.

use crate::codes::*;
use crate::panel::{Entry, Panel};

/// What `AlpProjInquireEx` tells of the queue: nine words of 32 bits without padding.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// The entry of the queue that is shown.
    pub queue_id: u32,
    /// Its sequence.
    pub sequence: u32,
    /// Entries that wait.
    pub waiting: u32,
    /// Runs to be done.
    pub runs: u32,
    /// The number of runs has wrapped around.
    pub underflow: u32,
    /// Pictures left in the present run.
    pub pictures: u32,
    /// Picture time, microseconds.
    pub picture_us: u32,
    /// Pictures of a run.
    pub pictures_of_run: u32,
    /// Flags.
    pub flags: u32,
}

impl Panel {
    /// `AlpProjStart` and `AlpProjStartCont` (`for_ever`). Returns the entry's number in the queue.
    pub(crate) fn start(&mut self, sequence: u32, for_ever: bool, now: i64) -> Result<u32, i32> {
        let runs = self.sequences.get(&sequence).ok_or(PARM_INVALID)?.repeat;
        if self.queue_mode == PROJ_LEGACY {
            // One place, and what waits there is replaced.
            self.queue.clear();
        } else if self.running.is_some() && self.queue.len() >= self.settings.queue as usize {
            return Err(NOT_IDLE);
        }
        self.last_queue_id = self.last_queue_id.wrapping_add(1) % INVALID_ID;
        let runs = (!for_ever).then_some(runs);
        let queue_id = self.last_queue_id;
        self.queue.push_back(Entry { queue_id, sequence, runs, end_of_run: false, end_of_picture: false });
        if self.running.is_none() {
            self.begin_next(now + i64::from(self.settings.start_us) * 1000);
        }
        Ok(queue_id)
    }

    pub(crate) fn projection_control(&mut self, what: i32, value: i32, now: i64) -> i32 {
        match (what, value) {
            (PROJ_QUEUE_MODE, PROJ_LEGACY | PROJ_SEQUENCE_QUEUE) => {
                if self.running.is_some() || !self.queue.is_empty() {
                    return NOT_IDLE;
                }
                self.queue_mode = value;
            }
            (PROJ_RESET_QUEUE, 0) => self.queue.clear(),
            (PROJ_ABORT_SEQUENCE | PROJ_ABORT_FRAME, _) => return self.abort(what, value as u32),
            (PROJ_ABORT_ASYNC, 0) => self.abort_now(now),
            _ => return PARM_INVALID,
        }
        OK
    }

    /// Value 0 is the running sequence, all others are numbers in the queue.
    fn abort(&mut self, what: i32, queue_id: u32) -> i32 {
        let is_pending = |entry: &Entry| entry.end_of_run || entry.end_of_picture;
        let running = self.running.as_mut().map(|running| &mut running.entry);
        if running.as_ref().is_some_and(|entry| is_pending(entry)) || self.queue.iter().any(is_pending) {
            return NOT_IDLE;
        }
        let mut entries = running.into_iter().chain(&mut self.queue);
        let found = match queue_id {
            0 => entries.next(),
            id => entries.find(|entry| entry.queue_id == id),
        };
        match found {
            Some(entry) if what == PROJ_ABORT_FRAME => entry.end_of_picture = true,
            Some(entry) => entry.end_of_run = true,
            None if queue_id == 0 => {}
            None => return PARM_INVALID,
        }
        OK
    }

    pub(crate) fn projection_inquire(&self, what: i32) -> Result<i32, i32> {
        let max = if self.queue_mode == PROJ_LEGACY { 1 } else { self.settings.queue as i32 };
        Ok(match what {
            PROJ_STATE if self.running.is_some() => PROJ_ACTIVE,
            PROJ_STATE => PROJ_IDLE,
            PROJ_QUEUE_MODE => self.queue_mode,
            PROJ_QUEUE_ID => self.last_queue_id as i32,
            PROJ_QUEUE_MAX_AVAIL => max,
            PROJ_QUEUE_AVAIL => max - self.queue.len() as i32,
            _ => return Err(PARM_INVALID),
        })
    }

    pub(crate) fn progress(&self) -> Progress {
        let waiting = self.queue.len() as u32;
        let Some(running) = &self.running else {
            let flags = FLAG_QUEUE_IDLE;
            return Progress {
                queue_id: INVALID_ID,
                sequence: INVALID_ID,
                waiting,
                flags,
                ..Progress::default()
            };
        };
        let sequence = &self.sequences[&running.entry.sequence];
        let aborting = running.entry.end_of_run || running.entry.end_of_picture;
        Progress {
            queue_id: running.entry.queue_id,
            sequence: running.entry.sequence,
            waiting,
            runs: running.entry.runs.unwrap_or(0),
            underflow: 0,
            pictures: sequence.last - running.picture + 1,
            picture_us: sequence.active.picture_us as u32,
            pictures_of_run: sequence.pictures_shown(),
            flags: if aborting { FLAG_SEQUENCE_ABORTING } else { 0 }
                | if running.entry.runs.is_none() { FLAG_SEQUENCE_INDEFINITE } else { 0 },
        }
    }
}
