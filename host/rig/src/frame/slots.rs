//! Why a slot got no frame of its own.
//!
//! A stall never shifts the phase. Missed slots are counted by cause, and the next frame is planned for the next slot
//! that it can still meet. A slot in which darkness (or a still picture) was ordered is not a missed slot; it has its
//! own reason.

/// Why a slot got no frame of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum MissCause {
    /// Planning was not ready.
    Plan,
    /// Rendering took too long.
    Render,
    /// Packing took too long.
    Pack,
    /// The link or the device accepted no frame, or nothing is known about the slot.
    Link,
    /// There was no memory for another frame, because a later stage held all buffers.
    Buffers,
    /// It was left out to end a standing queue: none was begun before all earlier ones were sent.
    Queue,
    /// The projector was dark with a latched fault that frames of this rig had caused: the limit on flashes, or one on
    /// light.
    Fault,
    /// The machine itself stood still.
    Standstill,
}

impl MissCause {
    /// All causes, in the order of their counters.
    pub(crate) const ALL: [Self; 8] = [
        Self::Plan,
        Self::Render,
        Self::Pack,
        Self::Link,
        Self::Buffers,
        Self::Queue,
        Self::Fault,
        Self::Standstill,
    ];

    /// As printed.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Render => "render",
            Self::Pack => "pack",
            Self::Link => "link",
            Self::Buffers => "buffers",
            Self::Queue => "queue",
            Self::Fault => "fault",
            Self::Standstill => "standstill",
        }
    }
}

/// Why no new picture was wanted in a slot: an order of the operator, or a rule of safety.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub(crate) enum OrderedDark {
    /// The operator ordered BLACK.
    Black,
    /// The operator ordered FREEZE: the frame is held.
    Frozen,
    /// The operator ordered SAFE.
    Safe,
    /// A rest that a limit on light demands, for example the limit on flashes.
    Rest,
    /// The interlock is open, so light is not allowed.
    Interlock,
    /// The projector has a fault that requires the operator and that came from without: heat, lamp, emergency stop.
    Fault,
    /// The run was asked to end.
    Stop,
    /// The projector latched a limit that frames of this rig exceeded. Nobody ordered that: its slots count as missed.
    Exceeded,
}

impl OrderedDark {
    /// All reasons, in the order of their counters.
    pub(crate) const ALL: [Self; 8] = [
        Self::Black,
        Self::Frozen,
        Self::Safe,
        Self::Rest,
        Self::Interlock,
        Self::Fault,
        Self::Stop,
        Self::Exceeded,
    ];

    /// As printed.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Black => "black",
            Self::Frozen => "frozen",
            Self::Safe => "safe",
            Self::Rest => "rest",
            Self::Interlock => "interlock",
            Self::Fault => "fault",
            Self::Stop => "stop",
            Self::Exceeded => "exceeded",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_and_reasons_have_their_own_counters() {
        for (i, cause) in MissCause::ALL.into_iter().enumerate() {
            assert_eq!(cause as usize, i);
        }
        for (i, reason) in OrderedDark::ALL.into_iter().enumerate() {
            assert_eq!(reason as usize, i);
        }
    }
}
