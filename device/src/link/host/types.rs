//! What a host requests of a link, and what it learns from it: settings, states, errors, outcomes, counters.

use crate::link::limits::{LightLimits, LimitReached};
use crate::link::message::{ConfigRefusal, DeviceState, HostMessage, Underrun};
use crate::packet::VERSION;
use crate::planes::{PlaneSchedule, Raster};
use crate::time::{DeviceTicks, FrameRate, HostTime};
use crate::transport::TransportError;

/// Where slot 0 lies on the device's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Epoch {
    /// At this instant of the device's clock.
    At(DeviceTicks),
    /// This many nanoseconds (nominal) after the instant that the device's HELLO reports.
    AfterHello(u64),
}

/// The configuration that a host requests of a device.
#[derive(Clone, Debug)]
pub struct LinkSettings {
    /// Must be the device's raster.
    pub raster: Raster,
    /// Planes of a frame in the order shown.
    pub schedule: PlaneSchedule,
    /// Frames a second.
    pub rate: FrameRate,
    /// Silence after which the device goes dark, microseconds, 1 to [`crate::link::MAX_WATCHDOG_US`].
    pub watchdog_us: u32,
    /// What to show without a new frame.
    pub underrun: Underrun,
    /// Slots by which a frame may miss its target and still be lit.
    pub late_slots: u8,
    /// Where slot 0 lies.
    pub epoch: Epoch,
    /// Codecs that may be used, bits [`crate::link::Codec::mask`]; raw always is. With others, planes that do not change are not sent
    /// and the host spends time to save bytes on the link.
    pub codecs: u32,
    /// Flashes of the whole field a second above which the host darkens the projector for two seconds; `None` switches
    /// the limiter off.
    pub flash_limit: Option<u8>,
    /// Limits on light. The host goes dark before a limit is exceeded. CONFIG passes the limits to the device, which
    /// does the same by itself.
    pub limits: LightLimits,
}

/// State of a [`HostLink`](super::HostLink).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkState {
    /// Not connecting. [`super::HostLink::connect`] starts.
    Closed,
    /// The medium is gone. Polling tries to reopen it ten times a second; then a new session begins.
    Lost,
    /// HELLO was sent and is not answered yet.
    Greeting,
    /// CONFIG was sent and is not confirmed yet.
    Configuring,
    /// Configured and dark; waits for [`super::HostLink::arm`].
    Ready,
    /// ARM was sent and is not confirmed yet.
    Arming,
    /// The link accepts frames.
    Streaming,
    /// The device latched faults and is dark; [`super::HostLink::arm`] acknowledges.
    Faulted,
}

/// Why the link cannot be brought up.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// No common version.
    #[error("{device}: the device speaks link protocol version {theirs}, this program {VERSION}; update the older of the two")]
    Version {
        /// Name of the transport.
        device: String,
        /// The device's version.
        theirs: u16,
    },
    /// The device is another panel.
    #[error("{device}: the panel has {}x{} mirrors, the rig is configured for {}x{}", .theirs.width(), .theirs.height(), .ours.width(), .ours.height())]
    Raster {
        /// Name of the transport.
        device: String,
        /// The device's raster.
        theirs: Raster,
        /// The configured raster.
        ours: Raster,
    },
    /// The device cannot show that many planes that fast.
    #[error("{device}: {planes} planes at {rate_hz:.3} Hz leave {plane_ns} ns for a plane, the mirrors need {min_plane_ns} ns and take at most {max_planes} planes; lower the frame rate or the plane count")]
    TooFast {
        /// Name of the transport.
        device: String,
        /// Requested number of planes.
        planes: usize,
        /// Requested frame rate.
        rate_hz: f64,
        /// The resulting time per plane.
        plane_ns: u64,
        /// Time the device needs.
        min_plane_ns: u32,
        /// Planes the device takes.
        max_planes: u8,
    },
    /// The device does not light planes that give more than full light together.
    #[error("{device}: the device does not offer planes of more than full light together; write projector.weights = \"binary\"")]
    Exceeds {
        /// Name of the transport.
        device: String,
    },
    /// The device refused CONFIG for a reason that HELLO did not show.
    #[error("{device}: configuration refused: {reason:?}")]
    ConfigRefused {
        /// Name of the transport.
        device: String,
        /// The device's reason.
        reason: Option<ConfigRefusal>,
    },
    /// The device refused ARM.
    #[error("{device}: not armed, latched faults: {}; remove the cause and acknowledge them (after too many flashes light rests two seconds, after a limit on light for as long as its window)", crate::link::faults::names(*.faults))]
    ArmRefused {
        /// Name of the transport.
        device: String,
        /// Faults that prevent it.
        faults: u32,
    },
    /// The medium failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// Why a frame was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DropReason {
    /// The link is not streaming.
    NotStreaming,
    /// The device has no free buffer.
    NoCredit,
    /// The medium has no room.
    LinkBusy,
    /// The medium failed.
    LinkLost,
    /// The frame number does not follow the one sent before.
    NotNewer,
    /// The picture flashed too much; the projector rests in the dark.
    FlashLimit,
    /// This frame would have exceeded a limit on light, or the projector rests in the dark after an earlier one would
    /// have.
    LightLimit(LimitReached),
}

/// Fate of a frame handed to [`super::HostLink::send_frame`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SendOutcome {
    /// All of it was sent.
    Sent,
    /// None of it was sent.
    Dropped {
        /// Why.
        reason: DropReason,
    },
}

/// Counters since [`super::HostLink::new`]: `frames_offered = frames_sent + not_streaming + no_credit + link_busy + link_lost +
/// not_newer + flash_limit + light_limit`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(missing_docs)] // Named after `DropReason`.
pub struct LinkCounters {
    pub frames_offered: u64,
    pub frames_sent: u64,
    pub not_streaming: u64,
    pub no_credit: u64,
    pub link_busy: u64,
    pub link_lost: u64,
    pub not_newer: u64,
    pub flash_limit: u64,
    pub light_limit: u64,
    /// Bytes handed to the medium.
    pub bytes_sent: u64,
    /// Of these, bytes of frames.
    pub frame_bytes_sent: u64,
    /// Bytes that the processor has read and written to compact frames before they were handed on.
    pub compaction_bytes: u64,
    /// Planes sent raw.
    pub planes_raw: u64,
    /// Planes sent compressed.
    pub planes_coded: u64,
    /// Planes not sent because they had not changed.
    pub planes_kept: u64,
    /// Frames sent without reference to another frame.
    pub key_frames: u64,
    /// Intact packets from the device without effect: other session, out of order, malformed.
    pub packets_ignored: u64,
    /// Damaged packets from the device.
    pub packets_damaged: u64,
    /// TRACKS sent.
    pub tracks_sent: u64,
    /// Sessions opened.
    pub sessions: u64,
}

/// One clock exchange, for the clock map: host sent, device received, device sent, host received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EchoSample {
    /// Request left, host's clock.
    pub host_sent_at: HostTime,
    /// Request arrived, device's clock.
    pub device_received_at: DeviceTicks,
    /// Answer left, device's clock.
    pub device_sent_at: DeviceTicks,
    /// Answer arrived, host's clock: the arrival, not the reading, which may be much later; see
    /// [`crate::transport::Transport::receive`].
    pub host_received_at: HostTime,
}

/// The orders that can be sent at any time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verb {
    /// Dark and no longer armed.
    Stop,
    /// Dark, still armed; [`super::HostLink::arm`] shows the picture again.
    Black,
    /// Hold the frame that is lit; [`super::HostLink::arm`] lets it move again.
    Freeze,
    /// Dark and latched.
    Safe,
}

impl Verb {
    pub(super) fn message(self) -> HostMessage {
        match self {
            Self::Stop => HostMessage::Stop,
            Self::Black => HostMessage::Black,
            Self::Freeze => HostMessage::Freeze,
            Self::Safe => HostMessage::Safe,
        }
    }

    /// True for an order to go dark, which overtakes everything that waits.
    pub(super) const fn is_dark(self) -> bool {
        !matches!(self, Self::Freeze)
    }

    /// The strength of an order: an unconfirmed order is not replaced by a weaker one.
    pub(super) const fn strength(self) -> u8 {
        match self {
            Self::Freeze => 0,
            Self::Black => 1,
            Self::Stop => 2,
            Self::Safe => 3,
        }
    }

    pub(super) fn confirmed_by(self, state: DeviceState) -> bool {
        use DeviceState::{Armed, Black, Faulted, Frozen};
        match self {
            Self::Stop => !matches!(state, Armed | Black | Frozen),
            Self::Black => state != Armed && state != Frozen,
            Self::Freeze => state != Armed,
            Self::Safe => state == Faulted || state == DeviceState::Idle,
        }
    }
}
