//! What the mock projector wrote about its light: a line for every change, on the machine's clock.

use std::io::{Read, Seek, SeekFrom};
use std::path::PathBuf;

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Change {
    /// CLOCK_MONOTONIC, nanoseconds.
    pub(crate) at_ns: i64,
    /// Light is on.
    pub(crate) is_lit: bool,
    /// The projector's state.
    pub(crate) state: String,
}

/// The log, read as it grows.
pub(crate) struct LightLog {
    path: PathBuf,
    offset: u64,
    rest: String,
    /// The changes so far; long ago ones are forgotten.
    pub(crate) changes: Vec<Change>,
}

/// Changes that are remembered.
const MOST: usize = 4096;

impl LightLog {
    pub(crate) fn new(path: PathBuf) -> Self {
        Self { path, offset: 0, rest: String::new(), changes: Vec::new() }
    }

    /// Reads what is new.
    pub(crate) fn read(&mut self) {
        let Ok(mut file) = std::fs::File::open(&self.path) else { return };
        let mut text = String::new();
        if file.seek(SeekFrom::Start(self.offset)).is_err() || file.read_to_string(&mut text).is_err() {
            return;
        }
        self.offset += text.len() as u64;
        self.rest += &text;
        while let Some(end) = self.rest.find('\n') {
            self.changes.extend(parse(&self.rest[..end]));
            self.rest.drain(..=end);
        }
        if self.changes.len() > MOST {
            self.changes.drain(..MOST / 2);
        }
    }

    /// The newest change.
    pub(crate) fn now(&self) -> Option<&Change> {
        self.changes.last()
    }

    /// True if the projector is frozen with what it showed before: FREEZE takes no light away, and makes none (docs/PROTOCOL.md,
    /// section 6).
    pub(crate) fn is_held(&self) -> bool {
        let frozen = self.changes.iter().rev().take_while(|c| c.state == "frozen");
        let count = frozen.clone().count();
        let before = self.changes.iter().rev().nth(count);
        count > 0 && before.is_some_and(|before| frozen.into_iter().all(|c| c.is_lit == before.is_lit))
    }

    /// When light went off for good, at or after `since`: `None` while it is on.
    pub(crate) fn dark_since(&self, since_ns: i64) -> Option<i64> {
        let last = self.now()?;
        if last.is_lit {
            return None;
        }
        let first_dark = self.changes.iter().rev().take_while(|c| !c.is_lit).last()?;
        Some(first_dark.at_ns.max(since_ns))
    }

    /// The longest time without light that ended after `from_ns`, as far as it lies after it; one that still lasts ends
    /// now. Nanoseconds.
    pub(crate) fn longest_dark(&self, from_ns: i64, now_ns: i64) -> i64 {
        let mut longest = 0;
        let mut off: Option<i64> = None;
        for change in &self.changes {
            match (change.is_lit, off) {
                (false, None) => off = Some(change.at_ns),
                (true, Some(began)) => {
                    longest = longest.max(change.at_ns - began.max(from_ns));
                    off = None;
                }
                _ => {}
            }
        }
        longest.max(off.map_or(0, |began| now_ns - began.max(from_ns))).max(0)
    }
}

/// `123 lit 7 armed` or `123 dark faulted: watchdog`.
fn parse(line: &str) -> Option<Change> {
    let mut words = line.split_whitespace();
    let at_ns = words.next()?.parse().ok()?;
    let is_lit = match words.next()? {
        "lit" => words.next().map(|_| true)?,
        "dark" => false,
        _ => return None,
    };
    Some(Change { at_ns, is_lit, state: words.next()?.trim_end_matches(':').to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_log_is_read_and_the_dark_is_measured() {
        assert_eq!(parse("5 lit 7 armed"), Some(Change { at_ns: 5, is_lit: true, state: "armed".into() }));
        let dark = parse("9 dark faulted: watchdog, heat").expect("a line");
        assert_eq!((dark.is_lit, dark.state.as_str()), (false, "faulted"));
        assert_eq!((parse("x"), parse("5 grey armed"), parse("")), (None, None, None));
        let mut log = LightLog::new("/nonexistent".into());
        assert_eq!((log.dark_since(0), log.longest_dark(0, 100)), (None, 0));
        log.changes =
            ["0 dark configured", "10 lit 1 armed", "20 dark armed", "25 dark black", "40 lit 2 armed"]
                .iter()
                .filter_map(|l| parse(l))
                .collect();
        assert_eq!((log.dark_since(0), log.longest_dark(0, 100)), (None, 20));
        assert_eq!((log.longest_dark(30, 100), log.longest_dark(50, 100)), (10, 0));
        assert!(!log.is_held());
        for (lines, is_held) in [
            (&["1 lit 1 armed", "2 lit 1 frozen"][..], true),
            (&["1 dark armed", "2 dark frozen"], true),
            (&["1 lit 1 armed", "2 dark frozen"], false),
            (&["1 dark armed", "2 lit 1 frozen"], false),
            (&["1 lit 1 armed", "2 lit 1 frozen", "3 dark frozen"], false),
            (&["1 lit 1 frozen", "2 lit 1 armed"], false),
        ] {
            let changes = lines.iter().filter_map(|l| parse(l)).collect();
            assert_eq!(LightLog { changes, ..LightLog::new("".into()) }.is_held(), is_held, "{lines:?}");
        }
        log.changes.extend(parse("60 dark armed"));
        log.changes.extend(parse("61 dark faulted: watchdog"));
        assert_eq!((log.dark_since(0), log.dark_since(65)), (Some(60), Some(65)));
        assert_eq!(log.longest_dark(50, 100), 40);
    }
}
