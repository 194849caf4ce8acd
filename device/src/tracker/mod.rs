//! Trackers: sources of rigid-body poses with the instant at which the light for them was captured.

mod gate;
pub mod natnet;
pub mod record;
pub mod serial;
#[cfg(feature = "net")]
pub mod udp;
pub mod vrpn;

pub use gate::{BodyCounters, PacketCounters, SampleCounters, SampleGate, TrackerCounters};

use crate::pose::{Pose, PoseCovariance};
pub use crate::stream::{Opener, Stream};
use crate::time::HostTime;
use std::time::Duration;

/// Index of a tracked body in the order the rig file names them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BodyIndex(pub u16);

/// How the rig file names a body to a tracker; a body's index is its place in the list of keys.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BodyKey {
    /// Name in the tracking software; used if the tracker sends names.
    pub name: String,
    /// Number in the tracking software; used if it does not.
    pub id: Option<i64>,
}

/// One pose of one body as a tracker reported it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackerSample {
    /// Which body.
    pub body: BodyIndex,
    /// world-from-body.
    pub pose: Pose,
    /// The tracker's own flag that it sees the body; if false, the pose is meaningless.
    pub tracked: bool,
    /// The tracker's mean marker error, metres; 0 when it gives none.
    pub mean_error_m: f32,
    /// By the tracker's own account, in the world's axes; `None` from a tracker that gives none.
    pub covariance: Option<PoseCovariance>,
    /// The tracker's frame number (wraps as the protocol does).
    pub sequence: u32,
    /// Mid-exposure, mapped to the host's clock.
    pub captured_at: HostTime,
    /// When the packet reached this process, host's clock.
    pub received_at: HostTime,
}

/// Why a tracker cannot deliver.
#[derive(Debug, thiserror::Error)]
pub enum TrackerError {
    /// The operating system refused; the text names the object and the remedy.
    #[error("{context}: {source}")]
    Io {
        /// What was being done, on which object, and what to try.
        context: String,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The other side speaks another protocol.
    #[error("{0}")]
    Protocol(String),
}

/// A source of poses. Implementations MUST return within a bounded time, never block for data, never allocate memory
/// that the input could grow without bound, and deliver samples of one body in the order of `captured_at`.
pub trait Tracker: Send {
    /// Passes every sample that has arrived by `now` to `sink`, oldest first; returns their number. `now` is the host's
    /// clock: network trackers use it to stamp arrivals, simulated trackers to know how far to advance.
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError>;

    /// Name of the tracker, for reports.
    fn name(&self) -> &str;

    /// Counters and the reason for silence in one line, for `dpm doctor` and reports.
    fn status(&self) -> String {
        String::new()
    }

    /// A warning for the operator although poses arrive, for example about data from somebody else; `None` if there is
    /// none.
    fn warning(&self) -> Option<String> {
        None
    }

    /// Waits until something may have arrived, at most for `timeout`. False, at once, if it has nothing to wait for; the
    /// caller then polls again after a rest.
    fn wait(&self, _timeout: Duration) -> bool {
        false
    }

    /// When something will arrive, for a tracker that knows it: one in this process.
    fn due_at(&self) -> Option<HostTime> {
        None
    }

    /// The gate through which its samples pass, which has counted them; `None` for a tracker without one.
    fn gate(&self) -> Option<&SampleGate> {
        None
    }
}

impl<T: Tracker + ?Sized> Tracker for Box<T> {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        (**self).poll(now, sink)
    }

    fn name(&self) -> &str {
        (**self).name()
    }

    fn status(&self) -> String {
        (**self).status()
    }

    fn warning(&self) -> Option<String> {
        (**self).warning()
    }

    fn wait(&self, timeout: Duration) -> bool {
        (**self).wait(timeout)
    }

    fn due_at(&self) -> Option<HostTime> {
        (**self).due_at()
    }

    fn gate(&self) -> Option<&SampleGate> {
        (**self).gate()
    }
}
