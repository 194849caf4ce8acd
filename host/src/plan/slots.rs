//! Why a slot got no frame of its own.
//!
//! A stall never shifts the phase: what was missed is counted by cause, and the next frame is for the next slot that can still be met.

/// Why a slot got no frame of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MissCause {
    /// Planning was not ready.
    Plan,
    /// Rendering took too long.
    Render,
    /// Packing took too long.
    Pack,
    /// The link or the device took no frame.
    Link,
    /// No memory for another frame in flight: a later stage holds all buffers.
    Buffers,
    /// The machine itself stood still.
    Standstill,
}

impl MissCause {
    /// All causes, in the order of their counters.
    pub const ALL: [Self; 6] =
        [Self::Plan, Self::Render, Self::Pack, Self::Link, Self::Buffers, Self::Standstill];

    /// As printed.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Render => "render",
            Self::Pack => "pack",
            Self::Link => "link",
            Self::Buffers => "buffers",
            Self::Standstill => "standstill",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_have_their_own_counters() {
        for (i, cause) in MissCause::ALL.into_iter().enumerate() {
            assert_eq!(cause as usize, i);
        }
    }
}
