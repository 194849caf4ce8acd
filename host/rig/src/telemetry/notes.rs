//! The last notes to the operator, for those who look later.

use dpm_handoff::path::Lock;
use std::collections::VecDeque;
use std::sync::PoisonError;
use std::time::{SystemTime, UNIX_EPOCH};

/// Notes kept.
const KEPT: usize = 200;
/// Longest note, bytes; the rest is cut off.
const LONGEST: usize = 1_000;

/// A note, and when it was told.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Note {
    /// Its number since the start of the process.
    pub number: u64,
    /// Milliseconds since 1970-01-01 UTC.
    pub at_ms: u64,
    /// The text.
    pub text: String,
}

/// The last notes.
#[derive(Debug, Default)]
pub struct Notes(Lock<(u64, VecDeque<Note>)>);

impl Notes {
    /// Adds a note.
    pub fn add(&self, text: &str) {
        let mut end = text.len().min(LONGEST);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        let at_ms = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| t.as_millis() as u64);
        let mut notes = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (number, kept) = &mut *notes;
        if kept.len() >= KEPT {
            kept.pop_front();
        }
        kept.push_back(Note { number: *number, at_ms, text: text[..end].to_owned() });
        *number += 1;
    }

    /// The notes from number `from` on, oldest first, as far as they are kept.
    pub fn since(&self, from: u64) -> Vec<Note> {
        let notes = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        notes.1.iter().filter(|note| note.number >= from).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_notes_are_kept_each_with_its_own_number() {
        let notes = Notes::default();
        (0..3 * KEPT).for_each(|k| notes.add(&format!("note {k}")));
        let all = notes.since(0);
        assert_eq!((all.len(), all[0].number), (KEPT, 2 * KEPT as u64));
        assert!(all.iter().all(|n| n.text == format!("note {}", n.number)));
        assert_eq!(notes.since(3 * KEPT as u64 - 1).len(), 1);
        assert!(notes.since(3 * KEPT as u64).is_empty());
    }

    #[test]
    fn a_long_note_is_cut_between_characters() {
        let notes = Notes::default();
        notes.add(&"ä".repeat(LONGEST));
        assert_eq!(notes.since(0)[0].text, "ä".repeat(LONGEST / 2));
    }
}
