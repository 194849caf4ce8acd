//! The results of a run.

use crate::light::recorder::LightFrame;
use crate::light::FrameRecord;
use crate::telemetry::profile::Profiler;
use crate::telemetry::report::Report;
use crate::telemetry::slots::SlotCounts;
use crate::telemetry::trace::TracedFrame;
use dpm_common::realtime::standstill::Standstills;
use dpm_device::projector::SlotMoves;

/// The results of a run.
pub struct RunOutcome {
    /// Measurements.
    pub report: Report,
    /// The last lit frames, oldest first.
    pub recent: Vec<FrameRecord>,
    /// The light of these frames, oldest first.
    pub light: Vec<LightFrame>,
    /// What tracks made of the planes of the last lit slots of a mock in this process, oldest first; empty without tracks.
    pub moves: Vec<SlotMoves>,
    /// Lit frames whose light was not what was rendered.
    pub light_mismatches: u64,
    /// Distributions of every interval.
    pub profiler: Profiler,
    /// Slots by what happened in them.
    pub slots: SlotCounts,
    /// For equal batches of consecutive slots: slots in which a frame was wanted, and those of them that were missed.
    pub slot_batches: Vec<(u64, u64)>,
    /// Lit frames that contain parts of another frame (checked for prepared frames only).
    pub frames_torn: u64,
    /// Frames lit after a newer one, or twice.
    pub frames_reordered: u64,
    /// When the machine itself stood still (real pace).
    pub standstills: Standstills,
    /// The last frames, for a trace, where the rig file asks for one.
    pub traced: Vec<TracedFrame>,
}
