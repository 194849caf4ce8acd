//! What the projector and its link did in a run, as the report tells it.

/// What the link carried in a run, for its report.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ProjectorReport {
    /// Name of the medium.
    pub name: String,
    /// Sessions opened: 1 and one for every time that the projector came back.
    pub sessions: u64,
    /// Times that light came back after the watchdog or damaged packets.
    pub rearmed: u64,
    /// Megabytes handed to the medium, 10^6 bytes each.
    pub sent_mb: f64,
    /// Planes sent as they are, by a codec, and not at all because they had not changed.
    pub planes: [u64; 3],
    /// Frames not sent: link not up, no buffer in the projector, no room on the medium, medium lost, flashes, limits on light.
    pub not_sent: [u64; 6],
    /// What the projector reported; null for the mock in this process, whose light is seen itself.
    pub device: Option<DeviceCounts>,
    /// Greatest error of the mapping from the projector's clock to the host's, as the newest exchange bounds it, nanoseconds; null at virtual pace,
    /// and where no exchange was heard.
    pub clock_bound_ns: Option<i64>,
    /// From sent to light in time, as learned from the reports, milliseconds; null for the mock in this process.
    pub travel_ms: Option<f64>,
}

/// What the projector counted over all sessions of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct DeviceCounts {
    /// Frames lit.
    pub lit: u64,
    /// Of these, frames whose report was merged into a later one: whether they were late is not known.
    pub lit_unseen: u64,
    /// Slots that showed the frame before again, those after the last frame included.
    pub repeated: u64,
    /// Dark slots while armed.
    pub blank: u64,
    /// Frames dropped because a part was missing or damaged.
    pub incomplete: u64,
    /// Whole frames dropped because their slot was over.
    pub too_late: u64,
    /// Whole frames dropped because a newer one was due too.
    pub superseded: u64,
    /// Frames refused: the projector was told to be dark, was ahead of its memory, or did not believe the target.
    pub refused: u64,
    /// Damaged packets that it received.
    pub damaged_packets: u64,
}
