//! How often each kind of fault struck in each state, and how often something of it was seen in the world.

use crate::kinds::{Kind, State};

/// Counts by kind and state.
#[derive(Clone, Debug)]
pub struct Table {
    struck: Vec<[u64; 7]>,
    effects: Vec<[u64; 7]>,
}

impl Default for Table {
    fn default() -> Self {
        let none = vec![[0; 7]; Kind::ALL.len()];
        Self { struck: none.clone(), effects: none }
    }
}

impl Table {
    /// A fault strikes.
    pub fn strikes(&mut self, kind: Kind, state: State) {
        self.struck[kind as usize][state as usize] += 1;
    }

    /// Something was seen of a fault of `kind` that struck in `state`.
    pub fn takes_effect(&mut self, kind: Kind, state: State) {
        self.effects[kind as usize][state as usize] += 1;
    }

    /// Adds another table.
    pub fn add(&mut self, other: &Self) {
        for (mine, theirs) in [(&mut self.struck, &other.struck), (&mut self.effects, &other.effects)] {
            for (mine, theirs) in mine.iter_mut().flatten().zip(theirs.iter().flatten()) {
                *mine += theirs;
            }
        }
    }

    /// All faults that struck.
    pub fn total(&self) -> u64 {
        self.struck.iter().flatten().sum()
    }

    /// All faults of which something was seen, but for those of kinds that only stand in for others.
    pub fn effects(&self) -> u64 {
        let own = Kind::ALL.iter().filter(|kind| kind.stands_in().is_none());
        own.map(|kind| self.effects[*kind as usize].iter().sum::<u64>()).sum()
    }

    /// How often a kind struck, in all states.
    pub fn struck(&self, kind: Kind) -> u64 {
        self.struck[kind as usize].iter().sum()
    }

    /// How often something was seen of a kind, in all states.
    pub fn of(&self, kind: Kind) -> u64 {
        self.effects[kind as usize].iter().sum()
    }

    /// Cells in which a kind can strike with an effect of its own.
    fn possible() -> impl Iterator<Item = (Kind, State)> {
        let own = Kind::ALL.iter().copied().filter(|kind| kind.stands_in().is_none());
        let cells = own.flat_map(|kind| State::ALL.map(|state| (kind, state)));
        cells.filter(|(kind, state)| kind.impossible(*state).is_none())
    }

    /// Possible cells with fewer than `most` faults of which something was seen.
    pub fn cells_below(&self, most: u64) -> usize {
        Self::possible().filter(|(kind, state)| self.effects[*kind as usize][*state as usize] < most).count()
    }

    /// As tables of Markdown: faults of which something was seen, where a cell in which a kind cannot strike has a dash; then
    /// the cells of which nothing was ever seen; then the kinds that only stand in for what is not simulated.
    pub fn to_markdown(&self) -> String {
        let mut out = String::from("| kind |");
        State::ALL.iter().for_each(|state| out += &format!(" {} |", state.word()));
        out += " what it is |\n|---|";
        out += &"---:|".repeat(State::ALL.len());
        out += "---|\n";
        for kind in Kind::ALL.iter().filter(|kind| kind.stands_in().is_none()) {
            out += &format!("| {kind:?} |");
            for state in State::ALL {
                match kind.impossible(state) {
                    Some(_) => out += " - |",
                    None => out += &format!(" {} |", self.effects[*kind as usize][state as usize]),
                }
            }
            out += &format!(" {} |\n", kind.text());
        }
        out += "\n| never with an effect | struck |\n|---|---:|\n";
        for (kind, state) in Self::possible() {
            let [effects, struck] = [&self.effects, &self.struck].map(|of| of[kind as usize][state as usize]);
            if effects == 0 {
                out += &format!("| {kind:?} in {} | {struck} |\n", state.word());
            }
        }
        out += "\n| stands in | struck | why it fills no cell |\n|---|---:|---|\n";
        for kind in Kind::ALL {
            if let Some(why) = kind.stands_in() {
                out += &format!("| {kind:?} | {} | {why} |\n", self.struck(*kind));
            }
        }
        out
    }
}
