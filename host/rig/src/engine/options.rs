//! Options of a run that are not in the rig file.

/// A thread of the host that a test may stall.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StallIn {
    /// From samples to tracks.
    Tracking,
    /// From tracks to the poses of a frame.
    Plan,
    /// From code values to bit planes; with a GPU, also the wait for it.
    Pack,
    /// From bit planes to the transport.
    Link,
    /// Plan, pack and tracking in turn, where a stall repeats.
    Crew,
}

/// A stage that stalls, for tests of the recovery.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stall {
    /// The stage.
    pub stage: StallIn,
    /// It stalls before it works on this frame. Tracking, which has no frames, stalls as soon as this frame is
    /// planned.
    pub frame: u64,
    /// For this long.
    pub length: std::time::Duration,
    /// And again so many frames later, for so many stalls in all; 1: once.
    pub times: u64,
    /// Frames from one stall to the next.
    pub every: u64,
}

impl Stall {
    /// Whether `stage` stalls before `frame`, after `struck` stalls.
    pub(crate) fn strikes(&self, stage: StallIn, frame: u64, struck: u64) -> bool {
        let turn = [StallIn::Plan, StallIn::Pack, StallIn::Tracking][(struck % 3) as usize];
        let is_meant = if self.stage == StallIn::Crew { turn == stage } else { self.stage == stage };
        is_meant && struck < self.times && frame >= self.frame + struck * self.every
    }
}

/// How a run differs from the rig file.
#[derive(Clone, Copy, Debug)]
pub struct RunOptions {
    /// Number of frames to plan; 0: until a stop is requested.
    pub frames: u64,
    /// Number of slots to plan for, whether or not frames meet them; 0: no limit.
    pub slots: u64,
    /// Frames of light (and their records) kept for pictures.
    pub keep_frames: usize,
    /// Records of lit frames that are kept, if more than that.
    pub keep_records: usize,
    /// Compare the light with what was rendered, frame by frame.
    pub verify: bool,
    /// Frames in flight at once.
    pub in_flight: usize,
    /// Tell the operator if frames are rendered more slowly than slots come.
    pub tells_slow: bool,
    /// A stage that stalls.
    pub stall: Option<Stall>,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self {
            frames: 0,
            slots: 0,
            keep_frames: 0,
            keep_records: 0,
            verify: true,
            in_flight: 4,
            tells_slow: true,
            stall: None,
        }
    }
}
