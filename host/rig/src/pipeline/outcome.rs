//! How a run may differ from its rig file, what it leaves behind, and why it may end early.

use crate::light::collector::FrameRecord;
use crate::light::recorder::LightFrame;
use crate::telemetry::profile::Profiler;
use crate::telemetry::report::Report;
use crate::telemetry::slots::SlotCounts;
use crate::telemetry::trace::TracedFrame;
use dpm_common::realtime::standstill::Standstills;

/// What a run leaves behind.
pub struct RunOutcome {
    /// Measurements.
    pub report: Report,
    /// The last lit frames, oldest first.
    pub recent: Vec<FrameRecord>,
    /// Their light, oldest first.
    pub light: Vec<LightFrame>,
    /// Lit frames whose light was not what was rendered.
    pub light_mismatches: u64,
    /// Distributions of every interval.
    pub profiler: Profiler,
    /// Slots by what became of them.
    pub slots: SlotCounts,
    /// Slots in which a frame was wanted and those missed, of equal batches of consecutive slots.
    pub slot_batches: Vec<(u64, u64)>,
    /// Lit frames with parts of another frame (looked for in prepared frames only).
    pub frames_torn: u64,
    /// Frames lit after a newer one, or twice.
    pub frames_reordered: u64,
    /// When the machine itself stood still (real pace).
    pub standstills: Standstills,
    /// The last frames, for a trace, where the rig file asks for one.
    pub traced: Vec<TracedFrame>,
}
