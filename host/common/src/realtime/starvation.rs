//! For how long threads of this process were ready to run and got no core.
//!
//! A stage may wait for threads that it has not made: software Vulkan draws in workers of its own. While one of them waits
//! for a core, the stage looks as if it hung, and is only late.

use super::os::{standing_of, threads, Standing};

/// Time between two samples, nanoseconds: each reads a few files of the kernel a thread.
const SAMPLE_NS: i64 = 10_000_000;

/// Which threads are looked at, by their names.
pub type Wanted = fn(&str) -> bool;

/// The threads that open devices. What a driver starts has their names if it gives none.
const OPENERS: [&str; 2] = ["dpm-run", "dpm-gpu-open"];

/// True for the names of threads that drivers make: those that the program has not given, and those of the threads in which devices are opened. The
/// cache of compiled shaders, on which no frame waits, is left out.
pub fn is_worker(name: &str) -> bool {
    let is_ours = ["dpm-", "standstill", "tracker-"].iter().any(|ours| name.starts_with(ours));
    OPENERS.contains(&name) || !is_ours && !name.contains("disk$")
}

/// Samples the threads of this process.
#[derive(Debug)]
pub struct Starvation {
    wanted: Wanted,
    /// Threads that are left out, by their ids.
    without: [i32; 2],
    sampled_at_ns: Option<i64>,
    /// As they stood at the last sample.
    before: Vec<(i32, Standing)>,
    /// Share of the time from the sample before to the last one in which some thread starved, in thousandths.
    share_milli: i64,
}

impl Starvation {
    /// For the threads whose names are `wanted`, except the process's first one and the one of this id.
    pub fn of(wanted: Wanted, without: i32) -> Self {
        let without = [std::process::id() as i32, without];
        Self { wanted, without, sampled_at_ns: None, before: Vec::new(), share_milli: 0 }
    }

    /// Share of the time between the last two samples in which some thread was ready and got no core, in thousandths. At `now_ns`
    /// of any steady clock; takes a sample if the last is old enough. A second after the last call, or for the first time, nothing is known
    /// yet: 0.
    pub fn share_milli(&mut self, now_ns: i64) -> i64 {
        let span_ns = self.sampled_at_ns.map_or(i64::MAX, |at| now_ns.saturating_sub(at));
        if span_ns < SAMPLE_NS {
            return self.share_milli;
        }
        let mut all = Vec::with_capacity(self.before.len());
        let Self { wanted, without, .. } = *self;
        threads(|id, name| {
            if !without.contains(&id) && wanted(name) {
                all.extend(standing_of(id).map(|standing| (id, standing)));
            }
        });
        self.share_milli = starved_milli(&self.before, &all, span_ns);
        (self.before, self.sampled_at_ns) = (all, Some(now_ns));
        self.share_milli
    }
}

/// The largest share of `span_ns` for which one of the threads starved, in thousandths. A span of more than a second says nothing of its end.
fn starved_milli(before: &[(i32, Standing)], after: &[(i32, Standing)], span_ns: i64) -> i64 {
    if span_ns > 1_000_000_000 {
        return 0;
    }
    let starved = after.iter().filter_map(|&(id, now)| {
        let then = before.iter().find(|(known, _)| *known == id)?.1;
        Some(now.starved_ns(Some(then), span_ns))
    });
    starved.max().unwrap_or(0) * 1000 / span_ns.max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn threads_of_drivers_are_told_from_ours() {
        for name in ["llvmpipe-0", "vkq:0", "dpm-run", "dpm-gpu-open", "some test"] {
            assert!(is_worker(name), "{name}");
        }
        for name in ["dpm-plan", "dpm-page", "standstill", "tracker-record", "dpm:disk$0"] {
            assert!(!is_worker(name), "{name}");
        }
    }

    #[test]
    fn the_thread_that_starves_most_counts_and_sleepers_and_workers_at_work_do_not() {
        let at = |ready, ran_ms: i64, waited_ms: i64| Standing {
            ready,
            ran_ns: ran_ms * MS,
            waited_ns: waited_ms * MS,
        };
        let before = [(1, at(true, 0, 0)), (2, at(false, 5, 7)), (3, at(true, 9, 9))];
        let share = |after: &[(i32, Standing)]| starved_milli(&before, after, 20 * MS);
        assert_eq!(share(&[(1, at(true, 20, 0)), (2, at(false, 5, 7))]), 0, "at work, and asleep");
        assert_eq!(share(&[(1, at(true, 20, 0)), (3, at(true, 9, 9))]), 1000, "ready, and did not run");
        assert_eq!(share(&[(1, at(true, 5, 0))]), 750, "ready, and ran a quarter");
        assert_eq!(share(&[(2, at(false, 8, 17))]), 500, "waited before it ran and slept");
        assert_eq!(share(&[(4, at(true, 0, 0))]), 0, "new: nothing is known of it");
        assert_eq!(starved_milli(&before, &[(3, at(true, 9, 9))], 1001 * MS), 0, "long ago");
    }

    /// On one core two threads that never rest starve each other; alone neither does.
    #[cfg(target_os = "linux")]
    #[test]
    fn the_kernel_says_who_starves() {
        use super::super::os::{allowed_core_list, pin_to_core};
        use std::sync::atomic::{AtomicBool, Ordering};
        use std::sync::Arc;
        let core = allowed_core_list()[0];
        let end = Arc::new(AtomicBool::new(false));
        let spin = |name: &str| {
            let end = end.clone();
            std::thread::Builder::new().name(name.into()).spawn(move || {
                pin_to_core(core).unwrap();
                while !end.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            })
        };
        let threads = ["spin-a", "spin-b"].map(|name| spin(name).unwrap());
        let mut starvation = Starvation::of(|name| name.starts_with("spin-"), 0);
        let mut most = 0;
        // Whatever else the machine does, one of the two waits for the other.
        for k in 0..200 {
            std::thread::sleep(std::time::Duration::from_millis(10));
            most = most.max(starvation.share_milli(k * SAMPLE_NS));
            if most >= 200 {
                break;
            }
        }
        end.store(true, Ordering::Relaxed);
        for thread in threads {
            thread.join().unwrap();
        }
        assert!(most >= 200, "{most}");
    }
}
