//! The orders that an operator can give to the projector; `docs/ORDERS.md` defines them.

/// An order that an operator can give to the projector of a running rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Order {
    /// Dark at once. Frames continue to be made.
    Black = 1,
    /// Hold the frame that is lit.
    Freeze = 2,
    /// Dark and latched.
    Safe = 3,
    /// Light again, after any of the other orders or after a fault.
    Arm = 4,
}

impl Order {
    /// Every order with its name.
    pub const ALL: [(Self, &'static str); 4] =
        [(Self::Black, "black"), (Self::Freeze, "freeze"), (Self::Safe, "safe"), (Self::Arm, "arm")];

    /// Its name.
    pub fn word(self) -> &'static str {
        Self::ALL.iter().find(|(order, _)| *order == self).map_or("", |(_, word)| word)
    }

    /// True for the orders that make the projector dark.
    pub fn is_dark(self) -> bool {
        matches!(self, Self::Black | Self::Safe)
    }

    /// Its strength. A standing order is replaced only by an order of equal or greater strength, or by ARM.
    pub(crate) fn strength(self) -> u8 {
        match self {
            Self::Arm => 0,
            Self::Freeze => 1,
            Self::Black => 2,
            Self::Safe => 3,
        }
    }

    pub(crate) fn from_code(code: u8) -> Option<Self> {
        Self::ALL.iter().map(|(order, _)| *order).find(|order| *order as u8 == code)
    }

    /// The order that a key on the terminal of a run gives: the first letter of its name, in either case.
    pub fn from_key(key: u8) -> Option<Self> {
        Self::ALL.iter().find(|(_, w)| w.as_bytes()[0] == key.to_ascii_lowercase()).map(|(order, _)| *order)
    }

    /// The order with this name.
    pub(crate) fn from_word(word: &str) -> Option<Self> {
        Self::ALL.iter().find(|(_, w)| *w == word).map(|(order, _)| *order)
    }
}
