//! Finds a standing queue between the stages.
//!
//! A queue that empties now and then only evens out bursts. One that never does delays every frame, keeps more memory
//! in use than the caches hold, makes the stages slower by that, and so feeds itself. It is judged as CoDel judges one
//! [RFC 8289]: by the least time that a frame waited in it during an interval.

use dpm_device::time::HostTime;

/// Shortest interval over which the least wait is taken, nanoseconds ...
const INTERVAL_NS: i64 = 100_000_000;
/// ... and the fewest frames in one.
const FRAMES: u32 = 8;

/// See the module's documentation.
#[derive(Debug)]
pub(crate) struct QueueWatch {
    /// A frame that waited no longer than this found no queue, nanoseconds.
    target_ns: i64,
    began_at: Option<HostTime>,
    frames: u32,
    stands: bool,
}

impl QueueWatch {
    /// For slots of `slot_ns`. A quarter of a slot is what wakes of threads may take.
    pub(crate) fn new(slot_ns: i64) -> Self {
        Self { target_ns: slot_ns / 4, began_at: None, frames: 0, stands: false }
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

#[cfg(test)]
mod tests {
    use super::*;

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
