//! The bit-plane link: encodes planes as packets, decodes packets, and keeps the state of both sides.
//!
//! Reading order: [`header`](Header) is one packet, [`Decoder`] finds packets in a stream, [`HostMessage`] and
//! [`DeviceMessage`] are their contents, [`SlotClock`] computes when frames are lit; [`HostLink`] is the host's half of
//! the protocol. Everything but [`HostLink`] is `no_std` without allocation and is meant to be reused by firmware:
//! docs/PROTOCOL.md is the specification.

mod codec;
#[cfg(feature = "std")]
mod compact;
mod flash;
#[cfg(feature = "std")]
mod host;
mod limits;
#[cfg(feature = "std")]
mod measure;
mod message;
#[cfg(feature = "std")]
mod session;
mod slots;
mod tracks;

pub use crate::packet::{
    crc32c, crc32c_append, crc32c_append_table, frame_newer, packet_bytes, trailer_bytes, Codec, Decoder,
    DecoderCounters, Header, HeaderError, MessageType, Packet, PacketSink, Trailer, HEADER_BYTES, MAGIC,
    MAX_CONTROL_BYTES, MAX_PAYLOAD_BYTES, VERSION,
};
pub use codec::{rle_encode, CodecError, RleDecoder};
pub use flash::{
    breaks_limit, mean_luminance, FlashLimiter, FULL_LUMINANCE, HIGHEST_LIMIT, MAX_FLASHES_PER_S, REST_US,
};
#[cfg(feature = "std")]
pub use host::{
    DropReason, EchoSample, Epoch, HostLink, LinkCounters, LinkError, LinkSettings, LinkState, SendOutcome,
    Verb,
};
pub use limits::{
    light_level, LightLimiter, LightLimits, LimitReached, FULL_WHITE_LEVEL, MAX_LIMIT_MS, MIN_LIMIT_MS,
};
#[cfg(feature = "std")]
pub use measure::{measure, LinkMeasurement};
pub use message::{
    faults, Assembly, Commit, Config, ConfigRefusal, DeviceHello, DeviceMessage, DeviceState, Echo, Fault,
    FaultCode, FrameTiming, HostHello, HostMessage, PayloadError, Status, TrackCounts, Underrun,
    COMMIT_BYTES, MAX_WATCHDOG_US,
};
#[cfg(feature = "std")]
pub use session::SessionNumbers;
pub use slots::{SlotClock, SlotShift, SHIFT_PARTS};
pub use tracks::{move_plane, Area, Move, Moves, Region, Tracks, MAX_REGIONS, MAX_SHIFT, MAX_TRACK_US};
