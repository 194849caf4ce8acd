//! Why a body gets no light in a frame.

/// Why no light falls on a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DarkCause {
    /// The tracker has not seen it since the start.
    NeverSeen,
    /// The tracker has not told of it for longer than `safety.predict_ms`.
    Silent,
    /// The tracker tells of it, but light comes so long after its samples that it would have to be predicted for longer than
    /// `safety.predict_ms`.
    BeyondHorizon,
}

impl DarkCause {
    /// All causes.
    pub const ALL: [Self; 3] = [Self::NeverSeen, Self::Silent, Self::BeyondHorizon];
}
