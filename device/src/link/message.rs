//! Encodes and decodes the payloads of the control messages. PLANE payloads are bits and have no structure of their
//! own.
//!
//! Every payload has one fixed length (that of CONFIG grows with its planes, that of TRACKS with its regions, and STATUS
//! has a longer form for devices that follow tracks). Another length is an error, so a wrong
//! build of one side is noticed at the first message. docs/PROTOCOL.md lists the bytes.

mod types;

use super::limits::LightLimits;
use super::slots::SlotShift;
use super::tracks::Tracks;
use crate::packet::{u16_at, u32_at, u64_at, Header, MessageType, MAX_CONTROL_BYTES};
use crate::planes::{PlaneSchedule, PlaneSpec, Raster, MAX_PLANES};
use crate::time::{DeviceTicks, FrameRate};
pub use types::{
    faults, Commit, Config, ConfigRefusal, DeviceHello, DeviceState, Echo, Fault, FaultCode, FrameTiming,
    HostHello, Status, TrackCounts, Underrun, MAX_WATCHDOG_US,
};

/// Length of a CONFIG's payload before the LED codes of its planes.
pub(super) const CONFIG_BYTES: usize = 40;
/// Length of a FRAME_COMMIT's payload.
pub const COMMIT_BYTES: usize = 24;
/// Why a payload cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PayloadError {
    /// The payload is not as long as its type demands.
    Length {
        /// Type of the message.
        kind: MessageType,
        /// Bytes demanded (CONFIG: by its own plane count).
        expected: usize,
        /// Bytes received.
        got: usize,
    },
    /// A field has a value that it must not have.
    Field {
        /// Type of the message.
        kind: MessageType,
        /// Which field, as docs/PROTOCOL.md names it.
        field: &'static str,
    },
    /// This side never receives that type.
    Direction(MessageType),
}

impl core::fmt::Display for PayloadError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Length { kind, expected, got } => {
                write!(f, "{kind:?} payload has {got} bytes, must have {expected}")
            }
            Self::Field { kind, field } => write!(f, "{kind:?} payload: `{field}` out of range"),
            Self::Direction(kind) => write!(f, "{kind:?} travels the other way"),
        }
    }
}

impl core::error::Error for PayloadError {}

/// A control message as a device receives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, clippy::large_enum_variant)] // Named after the types they carry; there is one at a time, on the stack.
pub enum HostMessage {
    Hello(HostHello),
    Config(Config),
    /// The faults acknowledged, bits of [`faults`].
    Arm(u32),
    Commit(Commit),
    /// Frames sent in this session.
    Sync(u32),
    Echo(Echo),
    Tracks(Tracks),
    Shift(SlotShift),
    Stop,
    Black,
    Freeze,
    Safe,
}

/// A message as a host receives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, clippy::large_enum_variant)] // As above.
pub enum DeviceMessage {
    Hello(DeviceHello),
    Status(Status),
    Echo(Echo),
    Fault(Fault),
}

/// A payload under construction.
struct Writer<'a> {
    out: &'a mut [u8; MAX_CONTROL_BYTES],
    len: usize,
}

impl Writer<'_> {
    fn bytes(&mut self, b: &[u8]) -> &mut Self {
        self.out[self.len..self.len + b.len()].copy_from_slice(b);
        self.len += b.len();
        self
    }
    fn u8(&mut self, v: u8) -> &mut Self {
        self.bytes(&[v])
    }
    fn u16(&mut self, v: u16) -> &mut Self {
        self.bytes(&v.to_le_bytes())
    }
    fn u32(&mut self, v: u32) -> &mut Self {
        self.bytes(&v.to_le_bytes())
    }
    fn u64(&mut self, v: u64) -> &mut Self {
        self.bytes(&v.to_le_bytes())
    }
}

fn expect_len(kind: MessageType, payload: &[u8], expected: usize) -> Result<(), PayloadError> {
    if payload.len() == expected {
        Ok(())
    } else {
        Err(PayloadError::Length { kind, expected, got: payload.len() })
    }
}

fn raster(kind: MessageType, p: &[u8], at: usize) -> Result<Raster, PayloadError> {
    Raster::new(u32::from(u16_at(p, at)), u32::from(u16_at(p, at + 2)))
        .ok_or(PayloadError::Field { kind, field: "raster" })
}

fn echo(p: &[u8]) -> Result<Echo, PayloadError> {
    expect_len(MessageType::Echo, p, 24)?;
    Ok(Echo {
        host_sent_ns: u64_at(p, 0),
        device_received: DeviceTicks(u64_at(p, 8)),
        device_sent: DeviceTicks(u64_at(p, 16)),
    })
}

fn write_echo(w: &mut Writer<'_>, e: &Echo) {
    w.u64(e.host_sent_ns).u64(e.device_received.0).u64(e.device_sent.0);
}

/// Flag of CONFIG: an LED code may stand there several times.
const CODES_REPEAT: u8 = 1;
/// Flag of CONFIG: the host sends TRACKS, and the device follows them and says so in STATUS.
const FOLLOWS: u8 = 2;
/// Flag of CONFIG: STATUS reports how early frames are whole.
const TIMES: u8 = 8;
/// Flag of CONFIG: the host sends SHIFT. Only with [`TIMES`].
const SHIFTS: u8 = 16;
/// Flag of CONFIG: the planes share the full light of a frame among them.
const FILLS: u8 = 4;
/// Flag of CONFIG: the planes give more than full light together. Only with [`CODES_REPEAT`], and never with [`FILLS`].
const EXCEEDS: u8 = 32;
/// Feature of a device in HELLO: it follows TRACKS.
const FEATURE_TRACKS: u8 = 1;
/// The same: it measures how early frames are whole.
const FEATURE_TIMING: u8 = 2;
/// The same: its slots can be shifted.
const FEATURE_SHIFT: u8 = 4;
/// The same: its planes may give more than full light together.
const FEATURE_EXCEEDS: u8 = 8;
/// Length of a SHIFT's payload.
const SHIFT_BYTES: usize = 16;
/// Length of a STATUS without the parts that CONFIG may ask for, and of each of them, in the order in which they follow.
const STATUS_BYTES: usize = 96;
const TRACKS_BYTES: usize = 24;
const TIMING_BYTES: usize = 16;

/// The planes of a CONFIG with `flags`; `None` if codes stand there that the flags do not allow.
fn schedule(planes: &[PlaneSpec], flags: u8) -> Option<PlaneSchedule> {
    const BOTH: u8 = CODES_REPEAT | FILLS;
    const MORE: u8 = CODES_REPEAT | EXCEEDS;
    match flags & (CODES_REPEAT | FILLS | EXCEEDS) {
        0 => PlaneSchedule::new(planes),
        CODES_REPEAT => PlaneSchedule::with_repeats(planes),
        FILLS => PlaneSchedule::filling(planes).filter(|schedule| !schedule.has_repeats()),
        BOTH => PlaneSchedule::filling(planes),
        MORE => PlaneSchedule::exceeding(planes),
        _ => None,
    }
}

impl Config {
    fn parse(p: &[u8]) -> Result<Self, PayloadError> {
        let kind = MessageType::Config;
        if p.len() < CONFIG_BYTES {
            return Err(PayloadError::Length { kind, expected: CONFIG_BYTES + 1, got: p.len() });
        }
        let count = p[16] as usize;
        let field = |field| PayloadError::Field { kind, field };
        if count == 0 || count > MAX_PLANES {
            return Err(field("planes"));
        }
        expect_len(kind, p, CONFIG_BYTES + count)?;
        let mut specs = [PlaneSpec::from_led_code(0).expect("code 0 is red bit 0"); MAX_PLANES];
        for (spec, &code) in specs.iter_mut().zip(&p[CONFIG_BYTES..]) {
            *spec = PlaneSpec::from_led_code(code).ok_or(field("led codes"))?;
        }
        let is_unknown = p[19] & !(CODES_REPEAT | FOLLOWS | FILLS | TIMES | SHIFTS | EXCEEDS) != 0;
        if is_unknown || p[19] & (SHIFTS | TIMES) == SHIFTS {
            return Err(field("flags"));
        }
        let watchdog_us = u32_at(p, 12);
        if watchdog_us == 0 || watchdog_us > MAX_WATCHDOG_US {
            return Err(field("watchdog"));
        }
        let limits = LightLimits {
            mean_permille: u16_at(p, 20),
            window_ms: u32_at(p, 32),
            full_white_ms: u32_at(p, 36),
        };
        if !limits.is_valid() {
            return Err(field("limits"));
        }
        Ok(Self {
            raster: raster(kind, p, 0)?,
            schedule: schedule(&specs[..count], p[19]).ok_or(field("led codes"))?,
            rate: FrameRate::new(u32_at(p, 4), u32_at(p, 8)).ok_or(field("frame rate"))?,
            watchdog_us,
            underrun: match p[17] {
                0 => Underrun::Repeat,
                1 => Underrun::Blank,
                _ => return Err(field("underrun")),
            },
            late_slots: p[18],
            epoch: DeviceTicks(u64_at(p, 24)),
            limits,
            tracks: p[19] & FOLLOWS != 0,
            timing: p[19] & TIMES != 0,
            shifts: p[19] & SHIFTS != 0,
        })
    }

    fn write(&self, w: &mut Writer<'_>) {
        w.u16(self.raster.width() as u16).u16(self.raster.height() as u16);
        w.u32(self.rate.num()).u32(self.rate.den()).u32(self.watchdog_us);
        w.u8(self.schedule.len() as u8).u8(self.underrun as u8).u8(self.late_slots);
        let flag = |is_set: bool, flag: u8| if is_set { flag } else { 0 };
        w.u8(flag(self.schedule.has_repeats(), CODES_REPEAT)
            | flag(self.tracks, FOLLOWS)
            | flag(self.timing, TIMES)
            | flag(self.shifts, SHIFTS)
            | flag(self.schedule.fills(), FILLS)
            | flag(self.schedule.exceeds(), EXCEEDS));
        w.u16(self.limits.mean_permille).u16(0).u64(self.epoch.0);
        w.u32(self.limits.window_ms).u32(self.limits.full_white_ms);
        for plane in self.schedule.planes() {
            w.u8(plane.led_code());
        }
    }
}

impl TrackCounts {
    fn parse(p: &[u8]) -> Self {
        Self {
            taken: u32_at(p, 0),
            refused: u32_at(p, 4),
            planes_moved: u32_at(p, 8),
            planes_clamped: u32_at(p, 12),
            planes_stale: u32_at(p, 16),
            greatest_age: u32_at(p, 20),
        }
    }

    fn write(&self, w: &mut Writer<'_>) {
        w.u32(self.taken).u32(self.refused).u32(self.planes_moved);
        w.u32(self.planes_clamped).u32(self.planes_stale).u32(self.greatest_age);
    }
}

impl FrameTiming {
    fn parse(p: &[u8]) -> Self {
        let (slack_ns, transfer_ns) = (u32_at(p, 4) as i32, u32_at(p, 8));
        Self { frame: u32_at(p, 0), slack_ns, transfer_ns, epoch: u32_at(p, 12) }
    }

    fn write(&self, w: &mut Writer<'_>) {
        w.u32(self.frame).u32(self.slack_ns as u32).u32(self.transfer_ns).u32(self.epoch);
    }
}

impl HostMessage {
    /// Reads a payload that a device received.
    pub fn parse(kind: MessageType, p: &[u8]) -> Result<Self, PayloadError> {
        let field = |field| PayloadError::Field { kind, field };
        Ok(match kind {
            MessageType::Hello => {
                expect_len(kind, p, 8)?;
                Self::Hello(HostHello {
                    version_min: u16_at(p, 0),
                    version_max: u16_at(p, 2),
                    codecs: u32_at(p, 4),
                })
            }
            MessageType::Config => Self::Config(Config::parse(p)?),
            MessageType::Arm => {
                expect_len(kind, p, 4)?;
                Self::Arm(u32_at(p, 0))
            }
            MessageType::FrameCommit => {
                expect_len(kind, p, COMMIT_BYTES)?;
                let commit = Commit {
                    sent: u32_at(p, 0),
                    kept: u32_at(p, 4),
                    base_frame: u32_at(p, 8),
                    frames_sent: u32_at(p, 12),
                    dark_from: DeviceTicks(u64_at(p, 16)),
                };
                if commit.sent & commit.kept != 0 {
                    return Err(field("kept"));
                }
                Self::Commit(commit)
            }
            MessageType::Sync => {
                expect_len(kind, p, 4)?;
                Self::Sync(u32_at(p, 0))
            }
            MessageType::Echo => Self::Echo(echo(p)?),
            MessageType::Tracks => Self::Tracks(Tracks::parse(p)?),
            MessageType::Shift => {
                expect_len(kind, p, SHIFT_BYTES)?;
                Self::Shift(SlotShift { slot: u64_at(p, 0), epoch: DeviceTicks(u64_at(p, 8)) })
            }
            MessageType::Stop | MessageType::Black | MessageType::Freeze | MessageType::Safe => {
                expect_len(kind, p, 0)?;
                match kind {
                    MessageType::Stop => Self::Stop,
                    MessageType::Black => Self::Black,
                    MessageType::Freeze => Self::Freeze,
                    _ => Self::Safe,
                }
            }
            MessageType::Plane | MessageType::Status | MessageType::Fault => {
                return Err(PayloadError::Direction(kind))
            }
        })
    }

    /// Writes the payload into `out`; returns the type and the length.
    pub fn write(&self, out: &mut [u8; MAX_CONTROL_BYTES]) -> (MessageType, usize) {
        let mut w = Writer { out, len: 0 };
        let kind = match self {
            Self::Hello(h) => {
                w.u16(h.version_min).u16(h.version_max).u32(h.codecs);
                MessageType::Hello
            }
            Self::Config(c) => {
                c.write(&mut w);
                MessageType::Config
            }
            Self::Arm(acknowledged) => {
                w.u32(*acknowledged);
                MessageType::Arm
            }
            Self::Commit(c) => {
                w.u32(c.sent).u32(c.kept).u32(c.base_frame).u32(c.frames_sent).u64(c.dark_from.0);
                MessageType::FrameCommit
            }
            Self::Sync(frames_sent) => {
                w.u32(*frames_sent);
                MessageType::Sync
            }
            Self::Echo(e) => {
                write_echo(&mut w, e);
                MessageType::Echo
            }
            Self::Tracks(tracks) => {
                w.len = tracks.write(w.out);
                MessageType::Tracks
            }
            Self::Shift(shift) => {
                w.u64(shift.slot).u64(shift.epoch.0);
                MessageType::Shift
            }
            Self::Stop => MessageType::Stop,
            Self::Black => MessageType::Black,
            Self::Freeze => MessageType::Freeze,
            Self::Safe => MessageType::Safe,
        };
        (kind, w.len)
    }
}

/// Reads the payload of STATUS.
fn status(p: &[u8]) -> Result<Status, PayloadError> {
    let kind = MessageType::Status;
    // No two combinations of parts are equally long.
    let more = p.len().saturating_sub(STATUS_BYTES);
    let follows = more == TRACKS_BYTES || more == TRACKS_BYTES + TIMING_BYTES;
    let times = more == TIMING_BYTES || more == TRACKS_BYTES + TIMING_BYTES;
    let tracks_end = STATUS_BYTES + if follows { TRACKS_BYTES } else { 0 };
    expect_len(kind, p, tracks_end + if times { TIMING_BYTES } else { 0 })?;
    Ok(Status {
        state: DeviceState::from_code(p[0]).ok_or(PayloadError::Field { kind, field: "state" })?,
        lit: p[1] & 1 != 0,
        last_plane: p[2],
        buffers_free: p[3],
        faults: u32_at(p, 4),
        frame_limit: u32_at(p, 8),
        frames_accounted: u32_at(p, 12),
        last_whole_frame: u32_at(p, 16),
        last_lit_frame: u32_at(p, 20),
        last_lit_at: DeviceTicks(u64_at(p, 24)),
        now: DeviceTicks(u64_at(p, 32)),
        slots: u32_at(p, 40),
        frames_seen: u32_at(p, 44),
        frames_lit: u32_at(p, 48),
        slots_repeated: u32_at(p, 52),
        slots_blank: u32_at(p, 56),
        frames_incomplete: u32_at(p, 60),
        frames_late: u32_at(p, 64),
        frames_superseded: u32_at(p, 68),
        frames_refused: u32_at(p, 72),
        packets: u32_at(p, 76),
        header_errors: u32_at(p, 80),
        payload_errors: u32_at(p, 84),
        packets_ignored: u32_at(p, 88),
        bytes_skipped: u32_at(p, 92),
        tracks: follows.then(|| TrackCounts::parse(&p[STATUS_BYTES..])),
        timing: times.then(|| FrameTiming::parse(&p[tracks_end..])),
    })
}

impl DeviceMessage {
    /// Reads a payload that a host received.
    pub fn parse(kind: MessageType, p: &[u8]) -> Result<Self, PayloadError> {
        let field = |field| PayloadError::Field { kind, field };
        Ok(match kind {
            MessageType::Hello => {
                expect_len(kind, p, 40)?;
                Self::Hello(DeviceHello {
                    version: u16_at(p, 0),
                    firmware: u16_at(p, 2),
                    codecs: u32_at(p, 4),
                    raster: raster(kind, p, 8)?,
                    max_planes: p[12],
                    frame_buffers: p[13],
                    greatest_shift: (p[14] & FEATURE_TRACKS != 0).then_some(p[15]),
                    measures_timing: p[14] & FEATURE_TIMING != 0,
                    shifts_slots: p[14] & FEATURE_SHIFT != 0,
                    exceeds: p[14] & FEATURE_EXCEEDS != 0,
                    tick_hz: u32_at(p, 16),
                    min_plane_ns: u32_at(p, 20),
                    serial: u64_at(p, 24),
                    now: DeviceTicks(u64_at(p, 32)),
                })
            }
            MessageType::Status => Self::Status(status(p)?),
            MessageType::Echo => Self::Echo(echo(p)?),
            MessageType::Fault => {
                expect_len(kind, p, 16)?;
                Self::Fault(Fault {
                    latched: u32_at(p, 0),
                    code: match u16_at(p, 4) {
                        0 => FaultCode::Latched,
                        1 => FaultCode::Version,
                        2 => FaultCode::Config,
                        3 => FaultCode::Arm,
                        _ => return Err(field("code")),
                    },
                    detail: u16_at(p, 6),
                    at: DeviceTicks(u64_at(p, 8)),
                })
            }
            _ => return Err(PayloadError::Direction(kind)),
        })
    }

    /// Writes the payload into `out`; returns the type and the length.
    pub fn write(&self, out: &mut [u8; MAX_CONTROL_BYTES]) -> (MessageType, usize) {
        let mut w = Writer { out, len: 0 };
        let kind = match self {
            Self::Hello(h) => {
                w.u16(h.version).u16(h.firmware).u32(h.codecs);
                w.u16(h.raster.width() as u16).u16(h.raster.height() as u16);
                w.u8(h.max_planes).u8(h.frame_buffers);
                let follows = h.greatest_shift.map_or(0, |_| FEATURE_TRACKS);
                let measures = if h.measures_timing { FEATURE_TIMING } else { 0 };
                let shifts = if h.shifts_slots { FEATURE_SHIFT } else { 0 };
                let exceeds = if h.exceeds { FEATURE_EXCEEDS } else { 0 };
                w.u8(follows | measures | shifts | exceeds).u8(h.greatest_shift.unwrap_or(0));
                w.u32(h.tick_hz).u32(h.min_plane_ns).u64(h.serial).u64(h.now.0);
                MessageType::Hello
            }
            Self::Status(s) => {
                w.u8(s.state as u8).u8(u8::from(s.lit)).u8(s.last_plane).u8(s.buffers_free);
                w.u32(s.faults).u32(s.frame_limit).u32(s.frames_accounted);
                w.u32(s.last_whole_frame).u32(s.last_lit_frame).u64(s.last_lit_at.0).u64(s.now.0);
                for v in [
                    s.slots,
                    s.frames_seen,
                    s.frames_lit,
                    s.slots_repeated,
                    s.slots_blank,
                    s.frames_incomplete,
                    s.frames_late,
                    s.frames_superseded,
                    s.frames_refused,
                    s.packets,
                    s.header_errors,
                    s.payload_errors,
                    s.packets_ignored,
                    s.bytes_skipped,
                ] {
                    w.u32(v);
                }
                if let Some(counts) = &s.tracks {
                    counts.write(&mut w);
                }
                if let Some(timing) = &s.timing {
                    timing.write(&mut w);
                }
                MessageType::Status
            }
            Self::Echo(e) => {
                write_echo(&mut w, e);
                MessageType::Echo
            }
            Self::Fault(f) => {
                w.u32(f.latched).u16(f.code as u16).u16(f.detail).u64(f.at.0);
                MessageType::Fault
            }
        };
        (kind, w.len)
    }
}

/// Collects the payload of a control message while it arrives in pieces.
#[derive(Clone, Debug)]
pub struct Assembly {
    header: Header,
    bytes: [u8; MAX_CONTROL_BYTES],
    len: usize,
}

impl Assembly {
    /// For the message that `header` begins; `None` when it claims more than any control message has.
    pub fn new(header: &Header) -> Option<Self> {
        if header.payload_bytes as usize > MAX_CONTROL_BYTES {
            return None;
        }
        Some(Self { header: *header, bytes: [0; MAX_CONTROL_BYTES], len: 0 })
    }

    /// Adds the next bytes; ignores those that do not fit (a [`super::Decoder`] never delivers more than the header
    /// claimed).
    pub fn push(&mut self, bytes: &[u8]) {
        let n = bytes.len().min(MAX_CONTROL_BYTES - self.len);
        self.bytes[self.len..self.len + n].copy_from_slice(&bytes[..n]);
        self.len += n;
    }

    /// The header given.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The bytes collected.
    pub fn payload(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

#[cfg(test)]
mod tests;
