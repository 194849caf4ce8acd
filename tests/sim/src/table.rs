//! How often each kind of fault struck in each state.

use crate::kinds::{Kind, State};

/// Counts by kind and state.
#[derive(Clone, Debug)]
pub struct Table {
    counts: Vec<[u64; 7]>,
}

impl Default for Table {
    fn default() -> Self {
        Self { counts: vec![[0; 7]; Kind::ALL.len()] }
    }
}

impl Table {
    /// One more.
    pub fn count(&mut self, kind: Kind, state: State) {
        self.counts[kind as usize][state as usize] += 1;
    }

    /// Adds another table.
    pub fn add(&mut self, other: &Self) {
        for (mine, theirs) in self.counts.iter_mut().zip(&other.counts) {
            mine.iter_mut().zip(theirs).for_each(|(a, b)| *a += b);
        }
    }

    /// All faults.
    pub fn total(&self) -> u64 {
        self.counts.iter().flatten().sum()
    }

    /// Faults of one kind, in all states.
    pub fn of(&self, kind: Kind) -> u64 {
        self.counts[kind as usize].iter().sum()
    }

    /// Possible cells with fewer than `most` faults.
    pub fn cells_below(&self, most: u64) -> usize {
        let cells = Kind::ALL.iter().flat_map(|kind| State::ALL.map(|state| (*kind, state)));
        cells
            .filter(|(kind, state)| kind.impossible(*state).is_none())
            .filter(|(kind, state)| self.counts[*kind as usize][*state as usize] < most)
            .count()
    }

    /// As a table of Markdown. A cell in which a kind cannot strike has a dash.
    pub fn to_markdown(&self) -> String {
        let mut out = String::from("| kind |");
        State::ALL.iter().for_each(|state| out += &format!(" {} |", state.word()));
        out += " what it is |\n|---|";
        out += &"---:|".repeat(State::ALL.len());
        out += "---|\n";
        for kind in Kind::ALL {
            out += &format!("| {kind:?} |");
            for state in State::ALL {
                match kind.impossible(state) {
                    Some(_) => out += " - |",
                    None => out += &format!(" {} |", self.counts[*kind as usize][state as usize]),
                }
            }
            out += &format!(" {} |\n", kind.text());
        }
        out
    }
}
