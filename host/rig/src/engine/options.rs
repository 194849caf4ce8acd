//! What a run is asked for besides what the rig file says.

/// A thread of the host that a test may let stand still.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StallIn {
    /// Samples into tracks.
    Tracking,
    /// Tracks into the poses of a frame.
    Plan,
    /// Code values into bit planes; where there is a GPU, waiting for it too.
    Pack,
    /// Bit planes to the transport.
    Link,
}

/// A stage that stands still once: for tests of what is left afterwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stall {
    /// Where.
    pub stage: StallIn,
    /// Before it works on this frame; tracking, which knows no frames: as soon as this one is planned.
    pub frame: u64,
    /// For this long.
    pub length: std::time::Duration,
}

/// How a run differs from what the rig file says.
#[derive(Clone, Copy, Debug)]
pub struct RunOptions {
    /// Frames to plan; 0: until asked to stop.
    pub frames: u64,
    /// Slots to plan for, whether frames make it into them or not; 0: no limit.
    pub slots: u64,
    /// Frames of light (and their records) kept for pictures.
    pub keep_frames: usize,
    /// Compare the light with what was rendered, frame by frame.
    pub verify: bool,
    /// Frames under way at once.
    pub in_flight: usize,
    /// A stage that stands still once.
    pub stall: Option<Stall>,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self { frames: 0, slots: 0, keep_frames: 0, verify: true, in_flight: 4, stall: None }
    }
}
