//! The host's half of the conversation: whole frames and wishes into packets, the device's packets into state.
//!
//! [`HostLink::poll`] moves it along: HELLO, CONFIG, and after an explicit [`HostLink::arm`] ARM, each repeated until the device
//! confirms. It never waits; time is an argument. Nothing is allocated after [`HostLink::new`].

use super::decoder::{Decoder, PacketSink};
use super::header::{frame_newer, Codec, Header, MessageType, Packet, VERSION};
use super::message::{
    Assembly, Commit, Config, ConfigRefusal, DeviceHello, DeviceMessage, DeviceState, Echo, Fault, FaultCode,
    HostHello, HostMessage, Status, Underrun, MAX_CONTROL_BYTES,
};
use super::slots::SlotClock;
use crate::planes::{PlaneSchedule, Raster, MAX_PLANES};
use crate::time::{DeviceTicks, FrameRate, HostTime};
use crate::transport::{Lane, SendError, Transport, TransportError};

/// An unanswered request is repeated after this long.
const RETRY_NS: i64 = 20_000_000;
/// Echoes of the first second of a session come this fast, to learn the clock soon.
const FAST_ECHO_NS: i64 = 2_000_000;
/// Number of fast echoes.
const FAST_ECHOES: u32 = 16;
/// Echo answers kept for the caller.
const ECHOES_KEPT: usize = 16;

/// Where slot 0 lies on the device's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Epoch {
    /// At this instant of the device's clock.
    At(DeviceTicks),
    /// This many nanoseconds (nominal) after the instant that the device's HELLO reports.
    AfterHello(u64),
}

/// What a host asks of a device.
#[derive(Clone, Debug)]
pub struct LinkSettings {
    /// Must be the device's raster.
    pub raster: Raster,
    /// Planes of a frame in the order shown.
    pub schedule: PlaneSchedule,
    /// Frames a second.
    pub rate: FrameRate,
    /// Silence after which the device goes dark, microseconds, 1 to [`super::MAX_WATCHDOG_US`].
    pub watchdog_us: u32,
    /// What to light without a new frame.
    pub underrun: Underrun,
    /// Slots by which a frame may miss its target and still be lit.
    pub late_slots: u8,
    /// Where slot 0 lies.
    pub epoch: Epoch,
    /// Seed of the session numbers; two hosts should not use the same.
    pub session_seed: u32,
}

/// Progress of a [`HostLink`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkState {
    /// Not connecting. [`HostLink::connect`] starts.
    Closed,
    /// HELLO is under way.
    Greeting,
    /// CONFIG is under way.
    Configuring,
    /// Configured and dark; waits for [`HostLink::arm`].
    Ready,
    /// ARM is under way.
    Arming,
    /// Frames are taken.
    Streaming,
    /// The device latched faults and is dark; [`HostLink::arm`] acknowledges.
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
        /// Planes asked for.
        planes: usize,
        /// Frame rate asked for.
        rate_hz: f64,
        /// Time that leaves for a plane.
        plane_ns: u64,
        /// Time the device needs.
        min_plane_ns: u32,
        /// Planes the device takes.
        max_planes: u8,
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
    #[error("{device}: not armed, latched faults: {}; remove the cause and acknowledge them", super::message::faults::names(*.faults))]
    ArmRefused {
        /// Name of the transport.
        device: String,
        /// Faults that stand in the way.
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
}

/// Fate of a frame handed to [`HostLink::send_frame`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SendOutcome {
    /// All of it is on its way.
    Sent,
    /// None of it was sent.
    Dropped {
        /// Why.
        reason: DropReason,
    },
}

/// Counters since [`HostLink::new`]: `frames_offered = frames_sent + not_streaming + no_credit + link_busy + link_lost + not_newer`.
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
    /// Bytes handed to the medium.
    pub bytes_sent: u64,
    /// Intact packets from the device without effect: other session, out of order, malformed.
    pub packets_ignored: u64,
    /// Damaged packets from the device.
    pub packets_damaged: u64,
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
    /// Answer arrived, host's clock.
    pub host_received_at: HostTime,
}

/// What a device in trouble or an operator can ask for at any time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verb {
    /// Dark and no longer armed.
    Stop,
    /// Dark, still armed; [`HostLink::arm`] shows the picture again.
    Black,
    /// Hold the frame that is lit; [`HostLink::arm`] lets it move again.
    Freeze,
    /// Dark and latched.
    Safe,
}

impl Verb {
    fn message(self) -> HostMessage {
        match self {
            Self::Stop => HostMessage::Stop,
            Self::Black => HostMessage::Black,
            Self::Freeze => HostMessage::Freeze,
            Self::Safe => HostMessage::Safe,
        }
    }

    fn confirmed_by(self, state: DeviceState) -> bool {
        use DeviceState::{Armed, Black, Faulted, Frozen};
        match self {
            Self::Stop => !matches!(state, Armed | Black | Frozen),
            Self::Black => state != Armed && state != Frozen,
            Self::Freeze => state != Armed,
            Self::Safe => state == Faulted || state == DeviceState::Idle,
        }
    }
}

/// Everything that arrives.
#[derive(Debug)]
struct Inbox {
    now: HostTime,
    session: u32,
    assembly: Option<Assembly>,
    hello: Option<DeviceHello>,
    status: Option<Status>,
    fault: Option<Fault>,
    device_forgot: bool,
    echoes: [Option<EchoSample>; ECHOES_KEPT],
    next_echo: usize,
    ignored: u64,
    damaged: u64,
}

impl PacketSink for Inbox {
    fn begin(&mut self, header: &Header) -> bool {
        self.assembly = Assembly::new(header);
        if self.assembly.is_none() {
            self.ignored += 1;
        }
        self.assembly.is_some()
    }

    fn payload(&mut self, bytes: &[u8]) {
        if let Some(a) = &mut self.assembly {
            a.push(bytes);
        }
    }

    fn end(&mut self, intact: bool) {
        let Some(assembly) = self.assembly.take() else { return };
        if !intact {
            self.damaged += 1;
            return;
        }
        let header = *assembly.header();
        match DeviceMessage::parse(header.kind, assembly.payload()) {
            Ok(message) if header.session == self.session => self.apply(&message),
            // The device lost its power or its memory: it answers, but knows nothing of this session.
            Ok(DeviceMessage::Status(_)) if header.session == 0 => {
                self.device_forgot = true;
            }
            _ => self.ignored += 1,
        }
    }
}

impl Inbox {
    fn apply(&mut self, message: &DeviceMessage) {
        match message {
            DeviceMessage::Hello(h) => self.hello = Some(*h),
            DeviceMessage::Status(s) => {
                // An older one that came late would take credit back.
                if self.status.is_some_and(|last| last.now > s.now) {
                    self.ignored += 1;
                } else {
                    self.status = Some(*s);
                }
            }
            DeviceMessage::Echo(e) => {
                let sent_at = HostTime(e.host_sent_ns as i64);
                if sent_at > self.now || e.device_sent < e.device_received {
                    self.ignored += 1;
                    return;
                }
                self.echoes[self.next_echo % ECHOES_KEPT] = Some(EchoSample {
                    host_sent_at: sent_at,
                    device_received_at: e.device_received,
                    device_sent_at: e.device_sent,
                    host_received_at: self.now,
                });
                self.next_echo += 1;
            }
            DeviceMessage::Fault(f) => self.fault = Some(*f),
        }
    }
}

/// The host's side of one link.
#[derive(Debug)]
pub struct HostLink {
    settings: LinkSettings,
    state: LinkState,
    inbox: Inbox,
    decoders: [Decoder; 2],
    slots: Option<SlotClock>,
    acknowledge: u32,
    verb: Option<Verb>,
    requested_at: HostTime,
    verb_sent_at: HostTime,
    echo_sent_at: HostTime,
    data_sent_at: HostTime,
    echoes_sent: u32,
    frames_sent: u32,
    last_frame: Option<u32>,
    counters: LinkCounters,
}

/// Long before any instant that a caller may pass.
const NEVER: HostTime = HostTime(i64::MIN);

impl HostLink {
    /// A closed link. Its buffers are all it will ever allocate.
    pub fn new(settings: LinkSettings) -> Self {
        Self {
            settings,
            state: LinkState::Closed,
            inbox: Inbox {
                now: NEVER,
                session: 0,
                assembly: None,
                hello: None,
                status: None,
                fault: None,
                device_forgot: false,
                echoes: [None; ECHOES_KEPT],
                next_echo: 0,
                ignored: 0,
                damaged: 0,
            },
            decoders: [Decoder::new(), Decoder::new()],
            slots: None,
            acknowledge: 0,
            verb: None,
            requested_at: NEVER,
            verb_sent_at: NEVER,
            echo_sent_at: NEVER,
            data_sent_at: NEVER,
            echoes_sent: 0,
            frames_sent: 0,
            last_frame: None,
            counters: LinkCounters::default(),
        }
    }

    /// Opens a new session with the next [`HostLink::poll`]; an old one, and its light, end.
    pub fn connect(&mut self) {
        self.counters.sessions += 1;
        // Odd multiplier: numbers differ for 2^32 sessions of one seed. 0 means "no session".
        let n = (self.counters.sessions as u32)
            .wrapping_mul(0x9e37_79b1)
            .wrapping_add(self.settings.session_seed);
        self.inbox.session = n.max(1);
        self.inbox.assembly = None;
        self.inbox.hello = None;
        self.inbox.status = None;
        self.inbox.fault = None;
        self.inbox.device_forgot = false;
        self.inbox.echoes = [None; ECHOES_KEPT];
        self.decoders = [Decoder::new(), Decoder::new()];
        self.state = LinkState::Greeting;
        self.slots = None;
        self.verb = None;
        self.requested_at = NEVER;
        self.echo_sent_at = NEVER;
        self.echoes_sent = 0;
        self.frames_sent = 0;
        self.last_frame = None;
    }

    /// Permits light once the device is configured, shows the picture again after BLACK or FREEZE, or acknowledges latched
    /// faults (bits of [`super::faults`]) after a fault. Never called by the link itself.
    pub fn arm(&mut self, acknowledge: u32) {
        self.acknowledge = acknowledge;
        self.verb = None;
        self.requested_at = NEVER;
        if matches!(self.state, LinkState::Ready | LinkState::Faulted | LinkState::Streaming) {
            self.inbox.fault = None;
            self.state = LinkState::Arming;
        }
    }

    /// Sends `verb` now and again every 20 ms until the device confirms it.
    pub fn command(
        &mut self,
        now: HostTime,
        verb: Verb,
        transport: &mut dyn Transport,
    ) -> Result<(), SendError> {
        self.verb = Some(verb);
        self.verb_sent_at = now;
        if self.state == LinkState::Arming {
            self.state = LinkState::Ready;
        }
        self.control(now, &verb.message(), transport)
    }

    /// Receives what has arrived, takes the next step of the handshake, keeps the device's watchdog fed. Call at least once a
    /// frame slot. On an error of the handshake the link is [`LinkState::Closed`] (ARM refused: [`LinkState::Faulted`]).
    pub fn poll(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<LinkState, LinkError> {
        self.receive(now, transport)?;
        if self.state == LinkState::Closed {
            return Ok(self.state);
        }
        if std::mem::take(&mut self.inbox.device_forgot) && self.state != LinkState::Greeting {
            // Only HELLO helps; the caller decides about light again.
            self.connect();
        }
        self.advance(transport)?;
        self.request(now, transport)?;
        Ok(self.state)
    }

    fn receive(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<(), TransportError> {
        let Self { inbox, decoders, .. } = self;
        inbox.now = now;
        let result = transport.receive(now, &mut |lane, bytes| decoders[lane as usize].push(bytes, inbox));
        self.counters.packets_ignored = self.inbox.ignored;
        self.counters.packets_damaged = self.inbox.damaged;
        result
    }

    /// State transitions that the device's answers allow.
    fn advance(&mut self, transport: &dyn Transport) -> Result<(), LinkError> {
        if let Some(fault) = self.inbox.fault.take() {
            self.fault(&fault, transport)?;
        }
        if self.state == LinkState::Greeting {
            let Some(hello) = self.inbox.hello else { return Ok(()) };
            if let Err(e) = self.check(&hello, transport) {
                self.state = LinkState::Closed;
                return Err(e);
            }
            let epoch = match self.settings.epoch {
                Epoch::At(t) => t,
                Epoch::AfterHello(ns) => {
                    let ticks = u128::from(ns) * u128::from(hello.tick_hz) / 1_000_000_000;
                    DeviceTicks(hello.now.0.saturating_add(u64::try_from(ticks).unwrap_or(u64::MAX)))
                }
            };
            self.slots = SlotClock::new(epoch, hello.tick_hz, self.settings.rate);
            self.state = LinkState::Configuring;
            self.requested_at = NEVER;
        }
        let Some(status) = self.inbox.status else { return Ok(()) };
        use DeviceState as D;
        use LinkState as L;
        if self.verb.is_some_and(|v| v.confirmed_by(status.state)) {
            self.verb = None;
        }
        self.state = match (self.state, status.state) {
            (L::Configuring, D::Configured | D::Armed) => L::Ready,
            (L::Arming, D::Armed) => L::Streaming,
            (L::Streaming | L::Ready, D::Faulted) => L::Faulted,
            (L::Configuring, D::Faulted) => L::Faulted,
            (L::Streaming | L::Faulted, D::Configured) => L::Ready,
            (state, _) => state,
        };
        Ok(())
    }

    fn fault(&mut self, fault: &Fault, transport: &dyn Transport) -> Result<(), LinkError> {
        let device = || transport.name().to_string();
        match (fault.code, self.state) {
            (FaultCode::Version, LinkState::Greeting) => {
                self.state = LinkState::Closed;
                Err(LinkError::Version { device: device(), theirs: fault.detail })
            }
            (FaultCode::Config, LinkState::Configuring) => {
                self.state = LinkState::Closed;
                let reason = ConfigRefusal::from_code(fault.detail);
                Err(LinkError::ConfigRefused { device: device(), reason })
            }
            (FaultCode::Arm, LinkState::Arming) => {
                self.state = LinkState::Faulted;
                Err(LinkError::ArmRefused { device: device(), faults: fault.latched })
            }
            (FaultCode::Latched, LinkState::Streaming) => {
                self.state = LinkState::Faulted;
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// What HELLO already shows to be impossible.
    fn check(&self, hello: &DeviceHello, transport: &dyn Transport) -> Result<(), LinkError> {
        let device = || transport.name().to_string();
        let s = &self.settings;
        if hello.version != u16::from(VERSION) {
            return Err(LinkError::Version { device: device(), theirs: hello.version });
        }
        if hello.raster != s.raster {
            return Err(LinkError::Raster { device: device(), theirs: hello.raster, ours: s.raster });
        }
        let planes = s.schedule.len();
        let plane_ns = 1_000_000_000 * u64::from(s.rate.den()) / (u64::from(s.rate.num()) * planes as u64);
        if planes > hello.max_planes as usize
            || plane_ns < u64::from(hello.min_plane_ns)
            || SlotClock::new(DeviceTicks(0), hello.tick_hz, s.rate).is_none()
        {
            return Err(LinkError::TooFast {
                device: device(),
                planes,
                rate_hz: s.rate.hz(),
                plane_ns,
                min_plane_ns: hello.min_plane_ns,
                max_planes: hello.max_planes,
            });
        }
        Ok(())
    }

    /// Requests that are due: the next step of the handshake, a verb, an echo, a credit repair.
    fn request(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<(), LinkError> {
        let due = |last: HostTime, every: i64| last == NEVER || now.ns_since(last) >= every;
        if due(self.requested_at, RETRY_NS) {
            let message = match self.state {
                LinkState::Greeting => Some(HostMessage::Hello(HostHello {
                    version_min: u16::from(VERSION),
                    version_max: u16::from(VERSION),
                    codecs: Codec::Raw.mask(),
                })),
                LinkState::Configuring => Some(HostMessage::Config(self.config())),
                LinkState::Arming => Some(HostMessage::Arm(self.acknowledge)),
                _ => None,
            };
            if let Some(message) = message {
                self.requested_at = now;
                lost(self.control(now, &message, transport))?;
            }
        }
        if let Some(verb) = self.verb.filter(|_| due(self.verb_sent_at, RETRY_NS)) {
            self.verb_sent_at = now;
            lost(self.control(now, &verb.message(), transport))?;
        }
        if self.state != LinkState::Greeting {
            let calm = (i64::from(self.settings.watchdog_us) * 1000 / 4).clamp(1_000_000, 100_000_000);
            let every = if self.echoes_sent < FAST_ECHOES { FAST_ECHO_NS.min(calm) } else { calm };
            if due(self.echo_sent_at, every) {
                self.echo_sent_at = now;
                self.echoes_sent += 1;
                let echo = Echo {
                    host_sent_ns: now.0 as u64,
                    device_received: DeviceTicks(0),
                    device_sent: DeviceTicks(0),
                };
                lost(self.control(now, &HostMessage::Echo(echo), transport))?;
            }
        }
        let starved = self.state == LinkState::Streaming && self.credit() == 0;
        let silence = self.settings.rate.slot_start_ns(4);
        if starved && due(self.data_sent_at, silence) {
            self.data_sent_at = now;
            lost(self.message(now, Lane::Data, &HostMessage::Sync(self.frames_sent), transport))?;
        }
        Ok(())
    }

    fn config(&self) -> Config {
        let s = &self.settings;
        Config {
            raster: s.raster,
            schedule: s.schedule,
            rate: s.rate,
            watchdog_us: s.watchdog_us,
            underrun: s.underrun,
            late_slots: s.late_slots,
            epoch: self.slots.map_or(DeviceTicks(0), |c| c.epoch()),
        }
    }

    /// Hands one frame to the medium, all of it or nothing. `planes` are the frame's planes one after the other in the
    /// configured order, each [`Raster::plane_bytes`] long; they go out as they lie, without a copy on this side. `frame_id`
    /// must grow from frame to frame; the wire carries its low 32 bits. `target_at` is the instant of light on the device's
    /// clock, usually [`SlotClock::start`] of the slot.
    ///
    /// # Panics
    /// When `planes` has not the configured size.
    pub fn send_frame(
        &mut self,
        now: HostTime,
        frame_id: u64,
        target_at: DeviceTicks,
        planes: &[u8],
        transport: &mut dyn Transport,
    ) -> SendOutcome {
        self.counters.frames_offered += 1;
        match self.try_send_frame(now, frame_id as u32, target_at, planes, transport) {
            Ok(()) => {
                self.counters.frames_sent += 1;
                SendOutcome::Sent
            }
            Err(reason) => {
                *match reason {
                    DropReason::NotStreaming => &mut self.counters.not_streaming,
                    DropReason::NoCredit => &mut self.counters.no_credit,
                    DropReason::LinkBusy => &mut self.counters.link_busy,
                    DropReason::LinkLost => &mut self.counters.link_lost,
                    DropReason::NotNewer => &mut self.counters.not_newer,
                } += 1;
                SendOutcome::Dropped { reason }
            }
        }
    }

    fn try_send_frame(
        &mut self,
        now: HostTime,
        frame: u32,
        target_at: DeviceTicks,
        planes: &[u8],
        transport: &mut dyn Transport,
    ) -> Result<(), DropReason> {
        let schedule = self.settings.schedule;
        let plane_bytes = self.settings.raster.plane_bytes();
        let expected = plane_bytes * schedule.len();
        assert!(planes.len() == expected, "frame of {} bytes, configured {expected}", planes.len());
        if self.state != LinkState::Streaming {
            return Err(DropReason::NotStreaming);
        }
        if self.last_frame.is_some_and(|last| !frame_newer(frame, last)) {
            return Err(DropReason::NotNewer);
        }
        if self.credit() == 0 {
            return Err(DropReason::NoCredit);
        }
        let header =
            Header { frame, target_at, ..Header::control(MessageType::Plane, self.inbox.session, 0) };
        let mut payload = [0u8; MAX_CONTROL_BYTES];
        let commit = HostMessage::Commit(Commit {
            sent: mask(schedule.len()),
            kept: 0,
            base_frame: 0,
            frames_sent: self.frames_sent.wrapping_add(1),
        });
        let (kind, n) = commit.write(&mut payload);
        let mut packets = [Packet::new(Header { kind, ..header }, &payload[..n]); MAX_PLANES + 1];
        packets[schedule.len()] = packets[0];
        for (i, (spec, bits)) in schedule.planes().iter().zip(planes.chunks_exact(plane_bytes)).enumerate() {
            packets[i] = Packet::new(Header { plane: i as u8, led_code: spec.led_code(), ..header }, bits);
        }
        let packets = &packets[..=schedule.len()];
        match transport.send(now, Lane::Data, packets) {
            Ok(()) => {
                self.frames_sent = self.frames_sent.wrapping_add(1);
                self.last_frame = Some(frame);
                self.data_sent_at = now;
                self.counters.bytes_sent += packets.iter().map(|p| p.wire_bytes() as u64).sum::<u64>();
                Ok(())
            }
            Err(SendError::Busy) => Err(DropReason::LinkBusy),
            Err(SendError::Failed(_)) => Err(DropReason::LinkLost),
        }
    }

    /// Frames that the device has room for.
    pub fn credit(&self) -> u32 {
        let limit = self.inbox.status.map_or(0, |s| s.frame_limit);
        (limit.wrapping_sub(self.frames_sent) as i32).max(0) as u32
    }

    /// Progress.
    pub fn state(&self) -> LinkState {
        self.state
    }

    /// What the device said it is, once it answered.
    pub fn device(&self) -> Option<&DeviceHello> {
        self.inbox.hello.as_ref()
    }

    /// The device's newest report of this session.
    pub fn status(&self) -> Option<&Status> {
        self.inbox.status.as_ref()
    }

    /// When slots begin on the device's clock, once configured.
    pub fn slots(&self) -> Option<SlotClock> {
        self.slots
    }

    /// What was asked of the device.
    pub fn settings(&self) -> &LinkSettings {
        &self.settings
    }

    /// Counters.
    pub fn counters(&self) -> LinkCounters {
        self.counters
    }

    /// Clock exchanges since the last call, oldest first; at most 16 are kept.
    pub fn take_echoes(&mut self, mut sink: impl FnMut(EchoSample)) {
        let start = self.inbox.next_echo;
        for i in 0..ECHOES_KEPT {
            if let Some(echo) = self.inbox.echoes[(start + i) % ECHOES_KEPT].take() {
                sink(echo);
            }
        }
    }

    /// The full number of the frame whose low 32 bits the device reports, given that it is one of the last 2^31 before
    /// `newest`.
    pub const fn full_frame_id(newest: u64, low: u32) -> u64 {
        newest.wrapping_sub((newest as u32).wrapping_sub(low) as u64)
    }

    fn control(
        &mut self,
        now: HostTime,
        message: &HostMessage,
        transport: &mut dyn Transport,
    ) -> Result<(), SendError> {
        self.message(now, Lane::Control, message, transport)
    }

    fn message(
        &mut self,
        now: HostTime,
        lane: Lane,
        message: &HostMessage,
        transport: &mut dyn Transport,
    ) -> Result<(), SendError> {
        let mut payload = [0u8; MAX_CONTROL_BYTES];
        let (kind, n) = message.write(&mut payload);
        let packet = Packet::new(Header::control(kind, self.inbox.session, 0), &payload[..n]);
        transport.send(now, lane, &[packet])?;
        self.counters.bytes_sent += packet.wire_bytes() as u64;
        Ok(())
    }
}

/// A mask of the lowest `n` bits, `n` from 1 to 32.
const fn mask(n: usize) -> u32 {
    u32::MAX >> (32 - n)
}

/// A busy medium is asked again later; a lost one is an error.
fn lost(sent: Result<(), SendError>) -> Result<(), LinkError> {
    match sent {
        Err(SendError::Failed(e)) => Err(LinkError::Transport(e)),
        Ok(()) | Err(SendError::Busy) => Ok(()),
    }
}
