//! The contents of the control messages, as values. Section 4 of docs/PROTOCOL.md lists the same fields as bytes.

use crate::link::limits::LightLimits;
use crate::planes::{PlaneSchedule, Raster};
use crate::time::{DeviceTicks, FrameRate};

/// Longest watchdog a host may ask for, microseconds.
pub const MAX_WATCHDOG_US: u32 = 10_000_000;

/// Faults as bits of a mask. A latched fault keeps the device dark until an ARM acknowledges it.
pub mod faults {
    /// The host was silent for longer than the configured watchdog.
    pub const WATCHDOG: u32 = 1 << 0;
    /// Temperature out of range.
    pub const OVER_TEMPERATURE: u32 = 1 << 1;
    /// Lamp or LED driver failed.
    pub const LAMP: u32 = 1 << 2;
    /// The host sent SAFE.
    pub const HOST_SAFE: u32 = 1 << 3;
    /// Too many damaged packets in a short time.
    pub const CHECKSUM_STORM: u32 = 1 << 4;
    /// Emergency-stop input.
    pub const EMERGENCY_STOP: u32 = 1 << 5;

    /// The light flashed more than eyes should bear.
    pub const FLASH_LIMIT: u32 = 1 << 6;
    /// A limit on the amount of light was reached.
    pub const LIGHT_LIMIT: u32 = 1 << 7;
    /// Those that say something about a host or a cable alone. Light may come back after them without the operator; heat, lamp,
    /// emergency stop and flashes have to be acknowledged.
    pub const PASSING: u32 = WATCHDOG | CHECKSUM_STORM;
    /// Those that frames cause: what they showed exceeded a limit.
    pub const OF_FRAMES: u32 = FLASH_LIMIT | LIGHT_LIMIT;

    /// Names of the faults in `mask`, for messages: `"watchdog, lamp"`; `"none"` when empty.
    #[cfg(feature = "std")]
    pub fn names(mask: u32) -> String {
        const NAMES: [&str; 8] = [
            "watchdog",
            "over-temperature",
            "lamp",
            "host safe",
            "checksum storm",
            "emergency stop",
            "flash limit",
            "light limit",
        ];
        let mut all: Vec<String> = NAMES
            .iter()
            .enumerate()
            .filter(|(i, _)| mask >> i & 1 == 1)
            .map(|(_, n)| n.to_string())
            .collect();
        if mask >> NAMES.len() != 0 {
            all.push(format!("unknown {:#x}", mask >> NAMES.len() << NAMES.len()));
        }
        if all.is_empty() {
            "none".into()
        } else {
            all.join(", ")
        }
    }
}

/// HELLO from the host. The header's session is the one to open (not 0).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HostHello {
    /// Lowest protocol version that the host speaks.
    pub version_min: u16,
    /// Highest protocol version that the host speaks.
    pub version_max: u16,
    /// Codecs that the host may send, bits [`crate::link::Codec::mask`].
    pub codecs: u32,
}

/// HELLO from the device: its properties.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceHello {
    /// Protocol version the device will use; when it is outside the host's range, the session did not open.
    pub version: u16,
    /// Firmware version: major * 256 + minor.
    pub firmware: u16,
    /// Codecs that the device can read, bits [`crate::link::Codec::mask`].
    pub codecs: u32,
    /// Mirrors.
    pub raster: Raster,
    /// Most planes a frame may have.
    pub max_planes: u8,
    /// Whole frames that can wait to be lit.
    pub frame_buffers: u8,
    /// By how many mirrors it moves regions of planes at most as TRACKS say; `None` if it follows no TRACKS.
    pub greatest_shift: Option<u8>,
    /// It measures how early frames are whole, and reports it if CONFIG asks.
    pub measures_timing: bool,
    /// Its slots can be shifted by SHIFT, if CONFIG asks.
    pub shifts_slots: bool,
    /// It lights schedules whose planes give more than full light together ([`PlaneSchedule::exceeding`]).
    pub exceeds: bool,
    /// Nominal ticks a second of the device's clock.
    pub tick_hz: u32,
    /// Shortest time one plane can be shown, nanoseconds.
    pub min_plane_ns: u32,
    /// Serial number.
    pub serial: u64,
    /// The device's clock when it answered.
    pub now: DeviceTicks,
}

/// What to show in a slot for which no new frame is whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Underrun {
    /// The frame before again.
    Repeat = 0,
    /// Nothing.
    Blank = 1,
}

/// CONFIG from the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// Must equal the device's raster.
    pub raster: Raster,
    /// Planes of a frame in the order shown.
    pub schedule: PlaneSchedule,
    /// Frames a second.
    pub rate: FrameRate,
    /// Silence after which the device goes dark and latches, microseconds, 1 to [`MAX_WATCHDOG_US`].
    pub watchdog_us: u32,
    /// What to light without a new frame.
    pub underrun: Underrun,
    /// Slots by which a whole frame may miss its target and still be lit; 0 drops late frames.
    pub late_slots: u8,
    /// Start of slot 0 on the device's clock.
    pub epoch: DeviceTicks,
    /// Limits on light that the device must not exceed, whatever is sent.
    pub limits: LightLimits,
    /// The host sends TRACKS. Only for a device that follows them.
    pub tracks: bool,
    /// STATUS reports how early frames are whole. Only for a device that measures it.
    pub timing: bool,
    /// The host shifts the slots by SHIFT. Only for a device whose slots can be shifted, and only with `timing`.
    pub shifts: bool,
}

/// FRAME_COMMIT: the end of a frame and how it is composed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Commit {
    /// Bit k set: plane k was sent with this frame.
    pub sent: u32,
    /// Bit k set: plane k equals plane k of `base_frame` and was not sent. `sent` and `kept` share no bit.
    pub kept: u32,
    /// The frame that kept and XOR planes refer to: the frame sent just before.
    pub base_frame: u32,
    /// Frames sent in this session, this one included.
    pub frames_sent: u32,
    /// From this tick of the device's clock on there is no light of this frame, whatever the host does or fails to do. It lies after
    /// the frame's target, see [`Commit::ends_after`].
    pub dark_from: DeviceTicks,
}

impl Commit {
    /// True when the frame's light ends after `target_at`, the instant in the header at which it shall begin. A FRAME_COMMIT for which
    /// this is false has a wrong field: the device ignores it.
    pub const fn ends_after(&self, target_at: DeviceTicks) -> bool {
        self.dark_from.0 > target_at.0
    }
}

/// State of the device as STATUS reports it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum DeviceState {
    /// No session. Dark.
    #[default]
    Idle = 0,
    /// Session open, not configured. Dark.
    Greeted = 1,
    /// Configured, not armed. Dark.
    Configured = 2,
    /// May make light.
    Armed = 3,
    /// Armed, and dark by order.
    Black = 4,
    /// Armed and holding the frame that is lit.
    Frozen = 5,
    /// Faults are latched. Dark.
    Faulted = 6,
}

impl DeviceState {
    pub(super) const fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            0 => Self::Idle,
            1 => Self::Greeted,
            2 => Self::Configured,
            3 => Self::Armed,
            4 => Self::Black,
            5 => Self::Frozen,
            6 => Self::Faulted,
            _ => return None,
        })
    }
}

/// STATUS: counters are absolute since the session opened and wrap at 2^32, so a lost STATUS costs nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// State.
    pub state: DeviceState,
    /// Light is on now.
    pub lit: bool,
    /// Plane that arrived last intact.
    pub last_plane: u8,
    /// Frame buffers that are free now.
    pub buffers_free: u8,
    /// Latched faults, bits of [`faults`].
    pub faults: u32,
    /// Credit: frames that the host may have sent in this session, in all.
    pub frame_limit: u32,
    /// Frames of this session that the device knows to have been sent.
    pub frames_accounted: u32,
    /// Newest frame that arrived whole; meaningless while none has.
    pub last_whole_frame: u32,
    /// Newest frame lit; meaningless while `frames_lit` is 0.
    pub last_lit_frame: u32,
    /// When that frame was first lit, device's clock.
    pub last_lit_at: DeviceTicks,
    /// The device's clock when this was written.
    pub now: DeviceTicks,
    /// Slots that began while armed, black or frozen: `frames_lit + slots_repeated + slots_blank`.
    pub slots: u32,
    /// Frames of which anything arrived:
    /// `frames_lit + frames_incomplete + frames_late + frames_superseded + frames_refused` and those in flight.
    pub frames_seen: u32,
    /// Frames lit.
    pub frames_lit: u32,
    /// Slots that repeated the previous frame.
    pub slots_repeated: u32,
    /// Dark slots.
    pub slots_blank: u32,
    /// Frames dropped because a plane or the base frame was missing or damaged.
    pub frames_incomplete: u32,
    /// Whole frames dropped because their slot was over.
    pub frames_late: u32,
    /// Whole frames dropped because a newer one was due too.
    pub frames_superseded: u32,
    /// Frames dropped because of the device's state, of credit, or of a target out of reach.
    pub frames_refused: u32,
    /// Packets with a right header.
    pub packets: u32,
    /// Damaged headers.
    pub header_errors: u32,
    /// Damaged payloads.
    pub payload_errors: u32,
    /// Intact packets without effect: other session, older frame, duplicate, wrong field.
    pub packets_ignored: u32,
    /// Bytes that belonged to no packet.
    pub bytes_skipped: u32,
    /// What became of TRACKS; `None` unless CONFIG asked for them.
    pub tracks: Option<TrackCounts>,
    /// How early the newest frame was whole; `None` unless CONFIG asked for it.
    pub timing: Option<FrameTiming>,
}

/// How early a frame was whole, in STATUS of a device that measures it. Zeros before the first frame of a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameTiming {
    /// The newest frame that was whole and whose slot was in reach. A frame that came too late for its slot counts.
    pub frame: u32,
    /// From the instant at which it was whole to the beginning of its slot, nanoseconds; negative for a frame that came
    /// late. Limited to the range of the type.
    pub slack_ns: i32,
    /// From the arrival of its first packet to the instant at which it was whole, nanoseconds. Limited to the range of
    /// the type.
    pub transfer_ns: u32,
    /// Low 32 bits of the tick at which slot 0 begins as the present slot counts it, if CONFIG asked for shifts; else 0.
    pub epoch: u32,
}

/// Counters of a device that follows TRACKS, in STATUS.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrackCounts {
    /// TRACKS taken.
    pub taken: u32,
    /// TRACKS without effect: not newer than one before, or of a region that is not on the raster.
    pub refused: u32,
    /// Planes lit of which a region was moved.
    pub planes_moved: u32,
    /// Planes lit for which a shift was clamped.
    pub planes_clamped: u32,
    /// Planes lit as drawn, because the TRACKS of their frame no longer held, or did not hold yet.
    pub planes_stale: u32,
    /// Greatest age of the TRACKS at the middle of a plane that followed them, in the newest slot that is over, ticks.
    pub greatest_age: u32,
}

/// ECHO. The host writes `host_sent_ns` and zeros; the device fills the rest in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Echo {
    /// Host's clock when the request left, nanoseconds; the device returns it unchanged.
    pub host_sent_ns: u64,
    /// Device's clock when the request arrived.
    pub device_received: DeviceTicks,
    /// Device's clock when the answer left.
    pub device_sent: DeviceTicks,
}

impl Echo {
    /// True for a device's answer, false for a host's question. On a line that echoes, each side hears its own.
    pub const fn is_answer(&self) -> bool {
        self.device_received.0 != 0 || self.device_sent.0 != 0
    }
}

/// What a FAULT message is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum FaultCode {
    /// The mask of latched faults grew.
    Latched = 0,
    /// No common protocol version; detail = the device's version.
    Version = 1,
    /// CONFIG refused; detail = [`ConfigRefusal`].
    Config = 2,
    /// ARM refused: faults not acknowledged, or a cause persists, or not configured.
    Arm = 3,
}

/// Why a device refuses a CONFIG.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum ConfigRefusal {
    /// The raster is not the device's.
    Raster = 1,
    /// More planes than the device can show.
    Planes = 2,
    /// Frame rate x planes is faster than the mirrors.
    Rate = 3,
    /// The payload breaks a rule of the format.
    Format = 4,
    /// The device does not count light, or not over such a long time.
    Limits = 5,
}

impl ConfigRefusal {
    /// The refusal with this number, or `None`.
    pub const fn from_code(code: u16) -> Option<Self> {
        Some(match code {
            1 => Self::Raster,
            2 => Self::Planes,
            3 => Self::Rate,
            4 => Self::Format,
            5 => Self::Limits,
            _ => return None,
        })
    }
}

/// FAULT from the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// All faults latched now, bits of [`faults`].
    pub latched: u32,
    /// What this is about.
    pub code: FaultCode,
    /// Depends on the code.
    pub detail: u16,
    /// When it happened.
    pub at: DeviceTicks,
}
