//! The mock projector: the firmware of a bit-plane projector ([`dpm_device::projector`]) with an ideal panel, and what a
//! mock has beside it: injected faults, and the medium serial port.

mod emulated;
mod faulty;
pub mod serial;

pub use dpm_device::projector::{
    light_of_planes, serve_cable, DeviceClock, Exposure, FirmwareConfig as MockConfig, LightChange,
    LightEvent, LightKind, ProjectorFirmware as MockProjector, Served, Shown,
};
pub use emulated::EmulatedProjector;
pub use faulty::FaultyProjector;

/// By how many mirrors a mock in the same process moves light at most, as tracks say.
pub const GREATEST_SHIFT: u8 = 16;
