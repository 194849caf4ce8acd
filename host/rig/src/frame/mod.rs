//! A frame's identity and the stamps that travel with it from motion to light.
//!
//! At real pace the stamps are readings of the host's clock. At virtual pace they are readings of the rig's own
//! clock, which advances by the modelled cost of each stage, so that a run repeats bit for bit. The measured times of
//! the stages are kept apart in [`FrameTimeline::wall_ns`].

pub(crate) mod job;
pub(crate) mod slots;

use dpm_device::time::HostTime;

/// The stages whose wall time is kept, in the order in which a frame passes them.
pub(crate) const STAGES: [&str; 5] = ["plan", "render", "pack", "link", "light"];
/// Index of a stage in [`STAGES`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub(crate) enum Stage {
    /// Latching and predicting poses, writing uniforms.
    Plan = 0,
    /// From submission to the fence.
    Render = 1,
    /// From code values to bit planes.
    Pack = 2,
    /// From bit planes to the transport.
    Link = 3,
    /// The mock projector's own work (receiving, checking, integrating). It is not part of a real rig.
    Light = 4,
}

/// One stamp per boundary, on the host's clock, in the order in which they happen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameTimeline {
    /// Mid-exposure of the newest tracker sample that the frame used; of the lit bodies, the one whose newest sample
    /// is oldest. In a frame without any sample this and `received_at` equal `due_at`.
    pub captured_at: HostTime,
    /// When that sample reached the process.
    pub received_at: HostTime,
    /// When the poses were latched.
    pub latched_at: HostTime,
    /// When the GPU was started.
    pub submitted_at: HostTime,
    /// When the code values were available.
    pub rendered_at: HostTime,
    /// When packing into bit planes began.
    pub packing_at: HostTime,
    /// When the bit planes were available.
    pub packed_at: HostTime,
    /// When the transport had accepted them.
    pub sent_at: HostTime,
    /// When the frame's slot was due to start.
    pub due_at: HostTime,
    /// First photon, as the device reports it; `None` until lit.
    pub lit_at: Option<HostTime>,
    /// Centre of the frame's light: the mean instant of its planes, each weighted with its intensity (see
    /// [`crate::plan::light_centre`]); `None` until lit.
    pub centre_at: Option<HostTime>,
    /// Last photon of its last plane; `None` until lit.
    pub last_photon_at: Option<HostTime>,
    /// Wall time of each of [`STAGES`], nanoseconds.
    pub wall_ns: [u64; STAGES.len()],
}

impl FrameTimeline {
    /// True if the frame used a tracker sample, so that intervals from its exposure are meaningful.
    pub(crate) fn has_sample(&self) -> bool {
        (self.captured_at, self.received_at) != (self.due_at, self.due_at)
    }

    /// Removes the sample's stamps, because no light resulted from the sample.
    pub(crate) fn without_sample(mut self) -> Self {
        (self.captured_at, self.received_at) = (self.due_at, self.due_at);
        self
    }
}
