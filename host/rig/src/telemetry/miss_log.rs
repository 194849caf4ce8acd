//! The last missed slots of a run, for those who look at it while it goes on.

use crate::frame::slots::MissCause;
use dpm_device::time::HostTime;
use std::collections::VecDeque;

/// Runs of missed slots that are remembered.
const KEPT: usize = 50;

/// Slots that were missed one after the other for one cause.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MissRun {
    /// The first of them.
    pub slot: u64,
    /// How many they are.
    pub count: u64,
    /// When the first one began.
    pub begin: HostTime,
    /// Why, as the report names it.
    pub cause: &'static str,
}

/// The newest runs, oldest first. It is allocated once.
#[derive(Clone, Debug)]
pub(crate) struct MissLog(VecDeque<MissRun>);

impl MissLog {
    pub(crate) fn new() -> Self {
        Self(VecDeque::with_capacity(KEPT))
    }

    /// `slot`, which began at `begin`, was missed.
    pub(crate) fn add(&mut self, slot: u64, begin: HostTime, cause: MissCause) {
        let cause = cause.name();
        if let Some(last) = self.0.back_mut().filter(|l| l.cause == cause && l.slot + l.count == slot) {
            last.count += 1;
            return;
        }
        if self.0.len() >= KEPT {
            self.0.pop_front();
        }
        self.0.push_back(MissRun { slot, count: 1, begin, cause });
    }

    /// The newest first.
    pub(crate) fn newest(&self) -> Vec<MissRun> {
        self.0.iter().rev().copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_that_follow_each_other_are_one_run_and_few_runs_are_kept() {
        let mut log = MissLog::new();
        let at = |slot: u64| HostTime(slot as i64 * 1000);
        for slot in [7, 8, 9, 11, 12] {
            log.add(slot, at(slot), MissCause::ALL[0]);
        }
        log.add(13, at(13), MissCause::ALL[1]);
        let told: Vec<_> = log.newest().iter().map(|r| (r.slot, r.count, r.begin)).collect();
        assert_eq!(told, [(13, 1, at(13)), (11, 2, at(11)), (7, 3, at(7))]);
        (0..1000).for_each(|k| log.add(100 + 2 * k, at(k), MissCause::ALL[0]));
        assert_eq!((log.newest().len(), log.newest()[0].slot), (KEPT, 2098));
    }
}
