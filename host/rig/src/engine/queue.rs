//! Finds a standing queue between the stages.
//!
//! A queue that empties now and then only evens out bursts. One that never does delays every frame, keeps more memory
//! in use than the caches hold, makes the stages slower by that, and so feeds itself. It is judged as CoDel judges one
//! [RFC 8289]: by the least time that a frame waited in it during an interval.
//!
//! It feeds itself in a second way if its wait counts as time that frames need: then they begin earlier, and the queue
//! is longer by as much. So what all frames of a row have waited is taken out of their need.

use dpm_device::time::HostTime;

/// Shortest interval over which the least wait is taken, nanoseconds ...
const INTERVAL_NS: i64 = 100_000_000;
/// ... and the fewest frames in one.
const FRAMES: u32 = 8;

/// A frame that waited no longer than this found no queue, nanoseconds: a quarter of a slot is what wakes of threads
/// may take.
fn target_ns(slot_ns: i64) -> i64 {
    slot_ns / 4
}

/// See the module's documentation.
#[derive(Debug)]
pub(crate) struct QueueWatch {
    target_ns: i64,
    began_at: Option<HostTime>,
    frames: u32,
    stands: bool,
}

impl QueueWatch {
    /// For slots of `slot_ns`.
    pub(crate) fn new(slot_ns: i64) -> Self {
        Self { target_ns: target_ns(slot_ns), began_at: None, frames: 0, stands: false }
    }

    /// A frame left the last queue at `now`, after it had waited `waited_ns` for stages that were busy. True while the
    /// queue stands: from the end of an interval in which no frame found it empty, to the first frame that does.
    pub(crate) fn observe(&mut self, waited_ns: i64, now: HostTime) -> bool {
        if waited_ns <= self.target_ns {
            *self = Self { began_at: Some(now), frames: 0, stands: false, ..*self };
            return false;
        }
        let began_at = *self.began_at.get_or_insert(now);
        self.frames += 1;
        self.stands |= self.frames >= FRAMES && now.ns_since(began_at) >= INTERVAL_NS;
        self.stands
    }
}

/// Frames in a row, each of which had to wait, whose least wait is a standing one. After a hiccup of one slot, a
/// pipeline that is busy for nine tenths of the time has caught up before so many frames.
const ROW: usize = 16;

/// Times that frames needed, and how long of that they waited for stages that were busy with frames before them,
/// nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct FrameNeed {
    pub needed_ns: i64,
    pub behind_ns: i64,
}

/// Takes the wait in a standing queue out of the times that frames needed.
#[derive(Debug)]
pub(crate) struct StandingWait {
    target_ns: i64,
    /// Frames in a row of which none found the queue empty.
    row: [FrameNeed; ROW],
    len: usize,
}

impl StandingWait {
    /// For slots of `slot_ns`.
    pub(crate) fn new(slot_ns: i64) -> Self {
        Self { target_ns: target_ns(slot_ns), row: [FrameNeed::default(); ROW], len: 0 }
    }

    /// Takes the next frame, in the order in which they were sent, and passes on what it and those kept back before it
    /// needed. A frame that had to wait is kept back until one finds the queue empty, at most [`ROW`] frames.
    pub(crate) fn observe(&mut self, need: FrameNeed, mut needed_ns: impl FnMut(i64)) {
        self.row[self.len] = need;
        self.len += 1;
        let is_empty = need.behind_ns <= self.target_ns;
        if !is_empty && self.len < ROW {
            return;
        }
        let row = &self.row[..std::mem::take(&mut self.len)];
        let standing_ns = if is_empty { 0 } else { row.iter().map(|n| n.behind_ns).min().unwrap_or(0) };
        row.iter().for_each(|need| needed_ns(need.needed_ns - standing_ns));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is learned of frames that waited `behind` microseconds and needed 1000 more.
    fn learned(behind: impl Iterator<Item = i64>) -> Vec<i64> {
        let (mut standing, mut learned) = (StandingWait::new(SLOT), Vec::new());
        for us in behind {
            let need = FrameNeed { needed_ns: 1000 * (1000 + us), behind_ns: 1000 * us };
            standing.observe(need, |ns| learned.push(ns / 1000));
        }
        learned
    }

    /// Found by measuring: with a queue of two slots in front of the link, frames of one millisecond of work seemed to
    /// need 3.5, were begun as early, and the queue stood until the end of the run.
    #[test]
    fn the_wait_in_a_standing_queue_is_no_need() {
        let all = learned((0..160).map(|k| 2_000 + k % 3));
        assert_eq!(all.len(), 160);
        assert!(all.iter().all(|us| (1000..=1002).contains(us)), "{all:?}");
    }

    /// Frames behind one that took long did need the time: an earlier start would have helped them.
    #[test]
    fn the_wait_behind_a_hiccup_is() {
        let waits = |k: i64| if k % 40 < 10 { 2_000 - 200 * (k % 40) } else { 0 };
        let all = learned((0..400).map(waits));
        assert_eq!(all, (0..400).map(|k| 1000 + waits(k)).collect::<Vec<_>>());
    }

    /// No frame is forgotten or counted twice, however they wait.
    #[test]
    fn every_frame_is_learned_once() {
        for empty_every in [1, 2, 15, 16, 17, 31] {
            let all = learned((0..310).map(|k| if k % empty_every == 0 { 0 } else { 900 }));
            assert!((310 - ROW..=310).contains(&all.len()), "{} of 310", all.len());
        }
    }

    const SLOT: i64 = 1_000_000;

    /// Whether the queue stands after each of the frames, one a slot, that waited `waits` microseconds.
    fn stands(waits: impl Iterator<Item = i64>) -> Vec<bool> {
        let mut watch = QueueWatch::new(SLOT);
        waits.enumerate().map(|(k, us)| watch.observe(1000 * us, HostTime(k as i64 * SLOT))).collect()
    }

    #[test]
    fn a_queue_stands_if_no_frame_of_an_interval_finds_it_empty() {
        let all = stands((0..150).map(|_| 900));
        assert_eq!(all.iter().position(|stands| *stands), Some(100));
        assert!(all[100..].iter().all(|stands| *stands), "until it is empty");
    }

    /// However long most frames wait: a queue that empties is no standing one.
    #[test]
    fn a_burst_is_no_standing_queue() {
        assert!(!stands((0..2000).map(|k| if k % 90 == 0 { 100 } else { 5_000 })).contains(&true));
    }

    #[test]
    fn the_first_frame_that_finds_it_empty_ends_it() {
        let all = stands((0..300).map(|k| if k == 150 { 20 } else { 700 }));
        assert!(all[149] && !all[150] && !all[200] && all[299]);
    }

    /// At 20 frames a second an interval has two frames, which say little.
    #[test]
    fn few_frames_decide_nothing() {
        let mut watch = QueueWatch::new(50 * SLOT);
        let all: Vec<bool> = (0..9).map(|k| watch.observe(40 * SLOT, HostTime(50 * k * SLOT))).collect();
        assert_eq!(all.iter().position(|stands| *stands), Some(7));
    }
}
