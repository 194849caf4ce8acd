//! What the projector and its link did in a run, for the report.

/// What the link carried in a run.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ProjectorReport {
    /// Name of the medium.
    pub name: String,
    /// Sessions opened: 1, plus one for every time that the projector came back.
    pub sessions: u64,
    /// Times that light came back after the watchdog or damaged packets.
    pub rearmed: u64,
    /// Megabytes handed to the medium, 10^6 bytes each.
    pub sent_mb: f64,
    /// Planes sent raw, sent through a codec, and not sent because they had not changed.
    pub planes: [u64; 3],
    /// Frames not sent: link not up, no buffer in the projector, no room on the medium, medium lost, limit on
    /// flashes, limits on light.
    pub not_sent: [u64; 6],
    /// TRACKS messages sent, which tell a projector between frames where the bodies are; 0 unless `projector.tracks` is
    /// "auto" and the projector follows them.
    pub tracks_sent: u64,
    /// Planes of which the projector has moved, clamped and not moved a part, the last because no track held any more, in the
    /// newest session.
    pub planes_by_tracks: [u64; 3],
    /// What the projector reported; null for the mock in this process, whose light is observed directly.
    pub device: Option<DeviceCounts>,
    /// Greatest error of the mapping from the projector's clock to the host's, as bounded by the newest exchange,
    /// nanoseconds. Null at virtual pace, and if there was no exchange.
    pub clock_bound_ns: Option<i64>,
    /// Learned time from sent to light, milliseconds; null for the mock in this process.
    pub travel_ms: Option<f64>,
    /// How early frames were whole in the device; null for one that does not measure it.
    pub slack: Option<SlackReport>,
    /// How often the processor read or wrote each byte of the planes that were sent, from what was read back of the GPU to
    /// what the medium takes; null if none was sent.
    pub touches: Option<f64>,
    /// The device's hottest sensor, degrees Celsius; null for a device that tells none.
    pub celsius: Option<f64>,
}

/// How early frames were whole in the device, by its own clock, and how long they took to arrive there.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SlackReport {
    /// Slack from the whole frame to its slot that one frame in a thousand had less of, milliseconds; negative: too late.
    pub least_0_1_percent_ms: f64,
    /// The same of one frame in two hundred.
    pub least_0_5_percent_ms: f64,
    /// The same of every other frame.
    pub median_ms: f64,
    /// From the first packet of a frame to the whole frame, the median, milliseconds.
    pub transfer_median_ms: f64,
}

/// What the projector counted over all sessions of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct DeviceCounts {
    /// Frames lit.
    pub lit: u64,
    /// Of these, frames whose report was merged into a later one, so it is not known whether they were late.
    pub lit_unseen: u64,
    /// Slots that repeated the previous frame, including those after the last frame.
    pub repeated: u64,
    /// Dark slots while armed.
    pub blank: u64,
    /// Frames dropped because a part was missing or damaged.
    pub incomplete: u64,
    /// Whole frames dropped because their slot was over.
    pub too_late: u64,
    /// Whole frames dropped because a newer one was due as well.
    pub superseded: u64,
    /// Frames refused: the projector was ordered to be dark, the frame exceeded its memory, or its target was
    /// implausible.
    pub refused: u64,
    /// Damaged packets that it received.
    pub damaged_packets: u64,
}
