//! The laws of a soak, what broke them, and the table at the end.

use crate::crew::{Crew, Runs};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Duration;

/// An order must have made it dark after this time. The manual says 50 ms of a machine that serves its threads; here
/// the time of a process that gives the order and of a busy machine come on top. The table has what was measured.
pub(crate) const ORDER_WITHIN_MS: f64 = 1_000.0;
/// The same for the watchdog of [`crate::crew`]'s rig file, 500 ms.
pub(crate) const WATCHDOG_WITHIN_MS: f64 = 1_500.0;
/// Light must be back after this time; a run that starts opens a GPU first.
pub(crate) const LIGHT_WITHIN: Duration = Duration::from_secs(30);
/// A process that was asked to end is gone after this time: two seconds, and what a busy machine adds.
pub(crate) const GONE_WITHIN: Duration = Duration::from_millis(3_500);
/// Dark times of this length that nobody ordered are findings, milliseconds.
const DARK_MS: f64 = 1_000.0;
/// Growth of a process between its first quiet look and a later one that counts as a leak.
const MORE_DESCRIPTORS: u64 = 2;
const MORE_THREADS: u64 = 2;
const MORE_KIB: u64 = 24 << 10;
/// And the share of its first size by which its memory may grow besides, one part in so many.
const MEMORY_PART: u64 = 4;
/// Findings that are kept with their text.
const MOST: usize = 100;

/// What a process holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Held {
    pub(crate) kib: u64,
    pub(crate) descriptors: u64,
    pub(crate) threads: u64,
}

/// What was judged so far.
pub(crate) struct Laws {
    findings: Vec<String>,
    more: u64,
    hopeless: bool,
    pub(crate) deeds: u64,
    pub(crate) killed: u64,
    /// Longest times by what was waited for, milliseconds.
    longest: BTreeMap<String, f64>,
    longest_dark_ms: f64,
    /// Largest growth of each program.
    growth: BTreeMap<&'static str, (Held, Held)>,
}

impl Laws {
    pub(crate) fn new() -> Self {
        Self {
            findings: Vec::new(),
            more: 0,
            hopeless: false,
            deeds: 0,
            killed: 0,
            longest: BTreeMap::new(),
            longest_dark_ms: 0.0,
            growth: BTreeMap::new(),
        }
    }

    /// A law was broken.
    pub(crate) fn found(&mut self, text: String) {
        eprintln!("            FOUND: {text}");
        if self.findings.len() < MOST {
            self.findings.push(text);
        } else {
            self.more += 1;
        }
    }

    /// Nothing more can be learnt.
    pub(crate) fn give_up(&mut self, text: String) {
        self.found(text);
        self.hopeless = true;
    }

    pub(crate) fn is_hopeless(&self) -> bool {
        self.hopeless
    }

    pub(crate) fn are_kept(&self) -> bool {
        self.findings.is_empty()
    }

    /// Something took a time.
    pub(crate) fn took(&mut self, what: &str, ms: f64) {
        let longest = self.longest.entry(what.to_owned()).or_default();
        *longest = longest.max(ms);
    }

    /// A time without light that nobody ordered.
    pub(crate) fn dark(&mut self, ms: f64) {
        if ms > DARK_MS && ms > self.longest_dark_ms {
            self.found(format!("dark for {ms:.0} ms, and nobody ordered it"));
        }
        self.longest_dark_ms = self.longest_dark_ms.max(ms);
    }

    /// A process held `first` at its first quiet look, and holds `now`. False if it leaks.
    pub(crate) fn holds(&mut self, program: &'static str, first: Held, now: Held) -> bool {
        let (worst_first, worst) = self.growth.entry(program).or_insert((first, now));
        if now.kib.saturating_sub(first.kib) >= worst.kib.saturating_sub(worst_first.kib) {
            (*worst_first, *worst) = (first, now);
        }
        let leaks = leaks(first, now);
        if let Some(what) = leaks {
            self.found(format!("{program} leaks {what}: {first:?} became {now:?}"));
        }
        leaks.is_none()
    }

    /// The table at the end.
    pub(crate) fn table(&self, length: Duration, seed: u64, crew: &Crew, out: &Path) -> String {
        let Runs { reports, frames_lit, frames_dark, frames_dropped, slots, missed, by_cause, flights } =
            crew.runs();
        let mut t = format!("Soak of {:.3} hours, seed {seed}\n", length.as_secs_f64() / 3600.0);
        let _ = writeln!(t, "  deeds                    {} (see the plan above)", self.deeds);
        let _ = writeln!(t, "  runs of dpm              {reports} with a report, {} killed", self.killed);
        let _ = writeln!(t, "  frames                   {frames_lit} lit, {frames_dark} without a lit body, {frames_dropped} dropped");
        let _ = writeln!(t, "  slots                    {slots} wanted a frame, {missed} missed");
        for (cause, n) in by_cause.iter().filter(|(_, n)| **n > 0) {
            let _ = writeln!(t, "    missed by {cause:<14} {n}");
        }
        let _ = writeln!(t, "  longest unordered dark   {:.0} ms", self.longest_dark_ms);
        for (what, ms) in &self.longest {
            let _ = writeln!(t, "  longest until {what:<28} {ms:.0} ms");
        }
        for (program, (first, last)) in &self.growth {
            let _ = writeln!(
                t,
                "  {program:<9} memory {} to {} KiB, descriptors {} to {}, threads {} to {}",
                first.kib, last.kib, first.descriptors, last.descriptors, first.threads, last.threads
            );
        }
        let _ = writeln!(t, "  flights recorded         {flights} files in {}/run-*", out.display());
        for finding in &self.findings {
            let _ = writeln!(t, "  FOUND: {finding}");
        }
        if self.more > 0 {
            let _ = writeln!(t, "  and {} more findings", self.more);
        }
        t + if self.are_kept() { "Every law was kept." } else { "Laws were BROKEN." }
    }
}

/// What a process has too much of.
fn leaks(first: Held, now: Held) -> Option<&'static str> {
    if now.descriptors > first.descriptors + MORE_DESCRIPTORS {
        return Some("descriptors");
    }
    if now.threads > first.threads + MORE_THREADS {
        return Some("threads");
    }
    (now.kib > first.kib + first.kib / MEMORY_PART + MORE_KIB).then_some("memory")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growth_is_a_leak_beyond_its_bound_only() {
        let first = Held { kib: 100_000, descriptors: 20, threads: 10 };
        assert_eq!(leaks(first, first), None);
        assert_eq!(leaks(first, Held { kib: 120_000, descriptors: 22, threads: 12 }), None);
        assert_eq!(leaks(first, Held { kib: 200_000, ..first }), Some("memory"));
        assert_eq!(leaks(first, Held { descriptors: 23, ..first }), Some("descriptors"));
        assert_eq!(leaks(first, Held { threads: 13, ..first }), Some("threads"));
        let mut laws = Laws::new();
        assert!(laws.holds("dpm", first, first) && laws.are_kept());
        laws.dark(900.0);
        assert!(laws.are_kept());
        laws.dark(1_100.0);
        laws.dark(1_050.0);
        assert!(!laws.are_kept() && laws.findings.len() == 1, "the longest only");
    }
}
