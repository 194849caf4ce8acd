//! What the machine did while a test ran: processor time, load, time that the host of a virtual machine took, standstills.
#![allow(unsafe_code)]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A thread that sleeps for a millisecond and is away longer than this has met a standstill.
const STANDSTILL: Duration = Duration::from_millis(5);
/// Units of `/proc/stat`: Linux gives it in hundredths of a second on every architecture.
const TICKS_PER_S: f64 = 100.0;

/// Seconds of the processor that all children took that this process has waited for, and theirs.
pub fn core_seconds_of_children() -> f64 {
    core_seconds_of(libc::RUSAGE_CHILDREN)
}

/// Seconds of the processor that all threads of this process took so far. A test that bounds the cost of a call measures it
/// by this: cargo-nextest runs one test a process, and other work on the machine does not count.
pub fn core_seconds() -> f64 {
    core_seconds_of(libc::RUSAGE_SELF)
}

fn core_seconds_of(whom: libc::c_int) -> f64 {
    // SAFETY: all bits zero are a valid `rusage`, which holds numbers only.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: the kernel writes one `rusage` into memory of ours that holds one.
    if unsafe { libc::getrusage(whom, &mut usage) } != 0 {
        return f64::NAN;
    }
    let seconds = |time: libc::timeval| time.tv_sec as f64 + time.tv_usec as f64 * 1e-6;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
}

/// Counters of the whole machine at one instant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sample {
    /// Seconds that all processors were busy, those of `steal` not included.
    busy_s: f64,
    /// Seconds in which a processor had work and the host of the virtual machine ran something else.
    steal_s: f64,
    /// The load average of the last minute, as Linux prints it.
    load: String,
}

impl Sample {
    /// Reads `/proc`; what is not there counts as nothing.
    pub fn now() -> Self {
        let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
        Self::of(&read("/proc/stat"), &read("/proc/loadavg"))
    }

    fn of(stat: &str, loadavg: &str) -> Self {
        let all: Vec<f64> = stat
            .lines()
            .find_map(|line| line.strip_prefix("cpu "))
            .map(|rest| rest.split_whitespace().map(|n| n.parse().unwrap_or(0.0)).collect())
            .unwrap_or_default();
        // user nice system idle iowait irq softirq steal ...
        let at = |i: usize| all.get(i).copied().unwrap_or(0.0) / TICKS_PER_S;
        Self {
            busy_s: at(0) + at(1) + at(2) + at(5) + at(6),
            steal_s: at(7),
            load: loadavg.split(' ').next().unwrap_or_default().to_owned(),
        }
    }
}

/// A thread that notices when the machine stands still.
pub struct Watch {
    ends: Arc<AtomicBool>,
    thread: JoinHandle<Vec<Duration>>,
}

impl Watch {
    /// Begins to watch.
    pub fn begin() -> Self {
        let ends = Arc::new(AtomicBool::new(false));
        let seen = ends.clone();
        let thread = std::thread::spawn(move || {
            let mut standstills = Vec::new();
            while !seen.load(Ordering::Relaxed) {
                let begin = Instant::now();
                std::thread::sleep(Duration::from_millis(1));
                let away = begin.elapsed();
                if away > STANDSTILL {
                    standstills.push(away);
                }
            }
            standstills
        });
        Self { ends, thread }
    }

    /// The lengths of all standstills since the beginning.
    pub fn end(self) -> Vec<Duration> {
        self.ends.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}

/// A sentence on what the machine did between two samples, while a test of `core_seconds` ran for `seconds`.
pub fn account(
    before: &Sample,
    after: &Sample,
    seconds: f64,
    core_seconds: f64,
    standstills: &[Duration],
) -> String {
    let (busy, steal) = (after.busy_s - before.busy_s, after.steal_s - before.steal_s);
    let longest = standstills.iter().max().copied().unwrap_or_default();
    format!(
        "While this test ran ({seconds:.1} s, {core_seconds:.1} core-seconds), other work took {:.1} core-seconds, the host of this \
         machine took {steal:.1} (steal), the load average went from {} to {}, and a thread was away for more than {} ms {} times, \
         at most for {} ms.",
        (busy - core_seconds).max(0.0),
        before.load,
        after.load,
        STANDSTILL.as_millis(),
        standstills.len(),
        longest.as_millis(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_read_from_the_kernels_own_words() {
        let sample =
            Sample::of("cpu  100 20 30 4000 50 6 4 70 0 0\ncpu0 1 1 1 1\n", "0.52 0.58 0.59 3/389 1234\n");
        assert_eq!(sample, Sample { busy_s: 1.6, steal_s: 0.7, load: "0.52".into() });
        assert_eq!(Sample::of("", ""), Sample::default());
    }

    #[test]
    fn an_account_has_the_work_of_others_and_the_longest_standstill() {
        let before = Sample { busy_s: 10.0, steal_s: 1.0, load: "0.10".into() };
        let after = Sample { busy_s: 15.5, steal_s: 1.5, load: "2.00".into() };
        let told = account(&before, &after, 3.0, 2.5, &[6, 41, 7].map(Duration::from_millis));
        assert!(told.contains("other work took 3.0 core-seconds"), "{told}");
        assert!(told.contains("took 0.5 (steal)") && told.contains("from 0.10 to 2.00"), "{told}");
        assert!(told.contains("more than 5 ms 3 times, at most for 41 ms"), "{told}");
    }

    #[test]
    fn a_thread_that_is_kept_away_is_noticed() {
        let watch = Watch::begin();
        std::thread::sleep(Duration::from_millis(20));
        // How often depends on the machine; that nobody was away for longer than this took does not.
        assert!(watch.end().iter().all(|away| *away > STANDSTILL));
    }
}
