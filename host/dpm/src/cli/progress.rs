//! Shows steps of known cost as a bar with the remaining time; if the output is not a terminal, as one line per part.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::Write;
use std::time::Instant;

/// Work in parts, each of which has steps. Some parts may turn out to be done already.
pub(super) struct WorkProgress {
    bar: ProgressBar,
    /// Position at the end of each part.
    ends: Vec<u64>,
    part: usize,
    /// Cost of the current step.
    running: u64,
    started: Instant,
}

impl WorkProgress {
    /// For parts of these costs, in any unit.
    pub(super) fn new(parts: &[u64]) -> Self {
        let sum = |end: &mut u64, part: &u64| {
            *end += part;
            Some(*end)
        };
        let ends: Vec<u64> = parts.iter().scan(0, sum).collect();
        let bar = ProgressBar::new(ends.last().copied().unwrap_or(0));
        let style = ProgressStyle::with_template("{bar:30} {percent:>3} % {elapsed} (left {eta}) {msg}");
        bar.set_style(style.expect("the template is right"));
        Self { bar, ends, part: 0, running: 0, started: Instant::now() }
    }

    /// Ends the previous step and begins this one.
    pub(super) fn step(&mut self, what: &str, cost: u64) {
        let end = self.ends.get(self.part).copied().unwrap_or(0);
        self.bar.set_position((self.bar.position() + self.running).min(end));
        self.running = cost;
        self.bar.set_message(what.to_owned());
    }

    /// Ends a part, whatever the estimated costs of its steps were.
    pub(super) fn end_of_part(&mut self, name: &str) {
        let before = if self.part > 0 { self.ends[self.part - 1] } else { 0 };
        let end = self.ends.get(self.part).copied().unwrap_or(before);
        self.part += 1;
        self.running = 0;
        self.bar.set_position(end);
        if self.bar.is_hidden() && end > before {
            let total = self.ends.last().copied().unwrap_or(end);
            let elapsed = self.started.elapsed().as_secs_f64();
            let left = elapsed * (total - end) as f64 / end as f64;
            // The stream may have no reader.
            let _ = writeln!(
                std::io::stderr(),
                "{name} done, {} of {}, {elapsed:.0} s, about {left:.0} s left",
                self.part,
                self.ends.len()
            );
        }
    }
}

impl Drop for WorkProgress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
