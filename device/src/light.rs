//! The light of a projector, slot by slot: as a mock observes it, or as derived from a real projector's status reports.

use crate::time::{DeviceTicks, HostTime};

/// What the mirrors showed in one slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LightKind {
    /// A new frame.
    Lit,
    /// The previous frame again.
    Repeated,
    /// Nothing.
    Blank,
}

/// One slot of an armed projector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LightEvent {
    /// Which slot.
    pub slot: u64,
    /// The frame on the mirrors (low 32 bits of its number); `None` when dark.
    pub frame: Option<u32>,
    /// What was lit.
    pub kind: LightKind,
    /// Start of the slot on the device's clock.
    pub lit_at: DeviceTicks,
    /// True time of the first photon; for a blank slot, of its beginning.
    pub first_photon_at: HostTime,
    /// True time of the last photon; for a blank slot, of its end.
    pub last_photon_at: HostTime,
}
