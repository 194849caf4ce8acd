//! A frame's identity and the stamps that travel with it from motion to light.
//!
//! At real pace the stamps are readings of the host's clock. At virtual pace they are the rig's clock, advanced by the modelled cost
//! of each stage, so that a run repeats bit for bit; what the stages really took is kept apart in [`FrameTimeline::wall_ns`].

pub(crate) mod job;
pub(crate) mod slots;

use dpm_device::time::HostTime;

/// The stages whose wall time is kept, in the order in which a frame passes them.
pub(crate) const STAGES: [&str; 5] = ["plan", "render", "pack", "link", "light"];
/// Index of a stage in [`STAGES`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub(crate) enum Stage {
    /// Poses latched and predicted, uniforms written.
    Plan = 0,
    /// Submission to the fence.
    Render = 1,
    /// Code values to bit planes.
    Pack = 2,
    /// Bit planes to the transport.
    Link = 3,
    /// The mock projector's own work (receiving, checking, integrating); not part of a real rig.
    Light = 4,
}

/// One stamp per boundary, host's clock, in the order in which they happen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameTimeline {
    /// Mid-exposure of the newest tracker sample that the frame used; the oldest among its lit bodies. Equal to `due_at`, as
    /// `received_at` then is too, in a frame without any sample.
    pub captured_at: HostTime,
    /// When that sample reached the process.
    pub received_at: HostTime,
    /// When the poses were latched.
    pub latched_at: HostTime,
    /// When the GPU was started.
    pub submitted_at: HostTime,
    /// When the code values were there.
    pub rendered_at: HostTime,
    /// When cutting them into bit planes began.
    pub packing_at: HostTime,
    /// When the bit planes were there.
    pub packed_at: HostTime,
    /// When the transport had taken them.
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
    /// True when a tracker's sample went into the frame, so that it makes sense to count from its exposure.
    pub(crate) fn has_sample(&self) -> bool {
        (self.captured_at, self.received_at) != (self.due_at, self.due_at)
    }

    /// Takes away what the frame has of a sample: no light came of it.
    pub(crate) fn without_sample(mut self) -> Self {
        (self.captured_at, self.received_at) = (self.due_at, self.due_at);
        self
    }
}
