//! The properties of a projector, and its reports of light.

use crate::light::LightEvent;
use crate::link::{Codec, DeviceState, LightLimits, MAX_FLASHES_PER_S, VERSION};
use crate::planes::{PlaneSchedule, Raster};
use crate::time::HostTime;

use super::DeviceClock;

/// The properties of a projector.
#[derive(Clone, Copy, Debug)]
pub struct FirmwareConfig {
    /// Mirrors.
    pub raster: Raster,
    /// Most planes of a frame, 1 to [`crate::planes::MAX_PLANES`].
    pub max_planes: u8,
    /// Whole frames that can wait, 1 to 64.
    pub frame_buffers: u8,
    /// Its clock.
    pub clock: DeviceClock,
    /// Shortest time a plane can be shown, nanoseconds.
    pub min_plane_ns: u32,
    /// From the start of a slot to the first photon (load and mirror settling), nanoseconds.
    pub settle_ns: u32,
    /// Codecs that it decodes, bits [`Codec::mask`]; raw always.
    pub codecs: u32,
    /// Serial number; see [`FirmwareConfig::serial_number`].
    pub serial: u64,
    /// Firmware version that it reports.
    pub firmware: u16,
    /// Protocol version that it reports; any other than [`VERSION`] makes it refuse every session.
    pub version: u16,
    /// Flashes of the whole field a second above which it goes dark and latches; `None` switches the limiter off.
    pub flash_limit: Option<u8>,
    /// Its own limits on light, whatever the host requests.
    pub limits: LightLimits,
    /// Light events kept for [`super::ProjectorFirmware::next_light`]; when full, the oldest are dropped and counted.
    pub events_kept: usize,
    /// Lit slots that are kept with their planes for [`super::ProjectorFirmware::next_shown`]; when full, the oldest are
    /// dropped and counted. Each holds a frame.
    pub shown_kept: usize,
    /// By how many mirrors it moves regions of planes at most as TRACKS say, at most [`crate::link::MAX_SHIFT`]; `None` if
    /// it follows no tracks.
    pub greatest_shift: Option<u8>,
    /// It measures how early frames are whole. Firmware 1.0 did not.
    pub measures_timing: bool,
    /// Its slots can be shifted by SHIFT.
    pub shifts_slots: bool,
    /// Its LEDs bear planes that give more than full light together ([`crate::planes::PlaneSchedule::exceeding`]).
    pub exceeds: bool,
    /// Lit slots of which the shifts are kept for [`super::ProjectorFirmware::next_moves`]; when full, the oldest are
    /// dropped and counted with the light events.
    pub moves_kept: usize,
    /// Changes of light or state that are kept for [`super::ProjectorFirmware::next_change`]; when full, the oldest are
    /// dropped and counted with the light events.
    pub changes_kept: usize,
}

/// Planes that slots which show the same frame share; a processor that cannot count references between threads (Cortex-M0)
/// copies them.
#[cfg(target_has_atomic = "ptr")]
pub type ShownPlanes = alloc::sync::Arc<[u8]>;
/// Planes that slots which show the same frame share; a processor that cannot count references between threads (Cortex-M0)
/// copies them.
#[cfg(not(target_has_atomic = "ptr"))]
pub type ShownPlanes = alloc::boxed::Box<[u8]>;

/// A lit slot that is over: what was on the mirrors, and when.
#[derive(Clone, Debug)]
pub struct Shown {
    /// When, and which frame. Its last photon is that of the light that really fell.
    pub event: LightEvent,
    /// When the last plane would have ended had nothing cut the light short: the planes share the time from the first
    /// photon to here equally.
    pub planes_end_at: HostTime,
    /// The order of the planes.
    pub schedule: PlaneSchedule,
    /// The planes as they arrived, one after the other; [`super::ProjectorFirmware::next_moves`] says by how much tracks moved
    /// them.
    pub planes: ShownPlanes,
}

impl FirmwareConfig {
    /// A panel of `raster` with 24-plane memory for four waiting frames, an ideal clock, and mirrors that show a plane in
    /// 43.22 us (32,552 loads a second and 12.5 us of reset, as a DLP7000 does).
    pub fn new(raster: Raster) -> Self {
        Self {
            raster,
            max_planes: 24,
            frame_buffers: 4,
            clock: DeviceClock::IDEAL,
            min_plane_ns: 43_220,
            settle_ns: 0,
            codecs: Codec::ALL,
            serial: 1,
            firmware: 0x0101,
            version: u16::from(VERSION),
            flash_limit: Some(MAX_FLASHES_PER_S),
            limits: LightLimits::OFF,
            events_kept: 4096,
            shown_kept: 0,
            greatest_shift: None,
            measures_timing: true,
            shifts_slots: false,
            exceeds: false,
            moves_kept: 0,
            changes_kept: 1024,
        }
    }
}

impl FirmwareConfig {
    /// The serial number of a projector: the one that it has `kept`, or a new one from `draw`, which gives 64 random bits. The
    /// caller keeps it for ever. By 0 and 1 no projector is known, and by all ones no memory that is erased.
    pub fn serial_number(kept: Option<u64>, mut draw: impl FnMut() -> u64) -> u64 {
        let names_one = |serial: &u64| (2..u64::MAX).contains(serial);
        kept.filter(names_one).unwrap_or_else(|| loop {
            if let Some(serial) = Some(draw()).filter(names_one) {
                return serial;
            }
        })
    }
}

/// Light went on or off, or the state of the projector changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LightChange {
    /// True time of the first photon, of the beginning of darkness, or of the change of state: exact, however late the model was
    /// called.
    pub at: HostTime,
    /// The frame that is lit from here on (low 32 bits of its number); `None` when it is dark.
    pub frame: Option<u32>,
    /// State of the projector from here on.
    pub state: DeviceState,
    /// Faults that are latched from here on.
    pub faults: u32,
}
