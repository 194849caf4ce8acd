//! The host's half of the link protocol: turns whole frames and requests into packets, and the device's packets into
//! state.
//!
//! [`HostLink::poll`] advances the handshake: HELLO, CONFIG, and after an explicit [`HostLink::arm`] ARM, each repeated
//! until the device confirms it. It never blocks; time is an argument. Nothing is allocated after [`HostLink::new`].

mod frames;
mod inbox;
mod light;
mod reported;
mod shift;
mod types;

use super::compact::Compactor;
use super::flash::REST_US;
use super::limits::LimitReached;
use super::message::{
    Config, ConfigRefusal, DeviceHello, DeviceState, Echo, Fault, FaultCode, HostHello, HostMessage, Status,
};
use super::session::SessionNumbers;
use super::slots::SlotClock;
use super::tracks::Tracks;
use crate::packet::Decoder;
use crate::packet::{Codec, Header, Packet, MAX_CONTROL_BYTES, VERSION};
use crate::time::{DeviceTicks, HostTime};
use crate::transport::{Lane, SendError, Transport, TransportError};
use inbox::{Inbox, ECHOES_KEPT};
use light::FieldCount;
use reported::ReportedField;
use shift::Shifting;
pub use types::{
    DropReason, EchoSample, Epoch, LinkCounters, LinkError, LinkSettings, LinkState, SendOutcome, Verb,
};

/// An unanswered request is repeated after this long.
const RETRY_NS: i64 = 20_000_000;
/// Interval between attempts to reopen a lost medium.
const REOPEN_NS: i64 = 100_000_000;
/// A device that has said nothing to this session for this long, and for two of its watchdog's times, is greeted again.
const SILENT_NS: i64 = 500_000_000;
/// Interval of the first echoes of a session, which are frequent so that the clock is known soon.
const FAST_ECHO_NS: i64 = 2_000_000;
/// Number of fast echoes.
const FAST_ECHOES: u32 = 16;
/// How long the caller should poll closely for the answer to a clock exchange.
const ECHO_AWAITED_NS: i64 = 5_000_000;
/// Detail of a refused ARM: CONFIG has not arrived.
const ARM_BEFORE_CONFIG: u16 = 1;

/// The host's side of one link.
#[derive(Debug)]
pub struct HostLink {
    settings: LinkSettings,
    sessions: SessionNumbers,
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
    /// Counts light and flashes against the limits.
    field: FieldCount,
    /// `None` without a limit of flashes.
    reported: Option<ReportedField>,
    /// The caller wants to send tracks, if the device follows them.
    wants_tracks: bool,
    /// The caller wants to shift slots, if the device lets it.
    wants_shifts: bool,
    shifting: Shifting,
    /// TRACKS sent in this session.
    tracks_sent: u32,
    /// While the host keeps the projector dark because of a limit: the end of this rest, and its reason.
    rest: Option<(HostTime, DropReason)>,
    /// The last order of [`HostLink::command`] that [`HostLink::arm`] has not withdrawn.
    ordered: Option<Verb>,
    /// `None` when only raw planes are sent.
    compactor: Option<Compactor>,
    /// The next frame must not refer to another frame.
    key_due: bool,
    /// The device's count of lost frames when a key frame was last requested.
    losses: u32,
    counters: LinkCounters,
}

/// Earlier than any instant that a caller may pass.
const NEVER: HostTime = HostTime(i64::MIN);

impl HostLink {
    /// A closed link with session numbers from the operating system. It allocates all its buffers here.
    pub fn new(settings: LinkSettings) -> Self {
        Self::with_sessions(settings, SessionNumbers::from_system())
    }

    /// As [`HostLink::new`], with session numbers from another source, for tests that must repeat byte for byte.
    pub fn with_sessions(settings: LinkSettings, sessions: SessionNumbers) -> Self {
        let compactor = (settings.codecs & !Codec::Raw.mask() != 0).then(|| {
            let frame_ns = settings.rate.slot_len_ns(0);
            Compactor::new(settings.raster, settings.schedule.len(), frame_ns, settings.codecs)
        });
        let field = FieldCount::new(&settings);
        let reported =
            settings.flash_limit.map(|limit| ReportedField::new(settings.rate, limit, &settings.schedule));
        Self {
            settings,
            sessions,
            state: LinkState::Closed,
            inbox: Inbox::new(),
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
            field,
            reported,
            wants_tracks: false,
            wants_shifts: false,
            shifting: Shifting::IDLE,
            tracks_sent: 0,
            rest: None,
            ordered: None,
            compactor,
            key_due: true,
            losses: 0,
            counters: LinkCounters::default(),
        }
    }

    /// Opens a new session with a new number at the next [`HostLink::poll`]. An old session, and its light, end.
    pub fn connect(&mut self) {
        self.counters.sessions += 1;
        self.inbox.open(self.sessions.draw());
        self.decoders = [Decoder::new(), Decoder::new()];
        self.state = LinkState::Greeting;
        self.slots = None;
        self.shifting = Shifting::IDLE;
        self.verb = None;
        self.requested_at = NEVER;
        self.echo_sent_at = NEVER;
        self.echoes_sent = 0;
        self.frames_sent = 0;
        self.tracks_sent = 0;
        self.last_frame = None;
        self.key_due = true;
        self.losses = 0;
        self.rest = None;
        self.field.new_session();
        if let Some(reported) = &mut self.reported {
            reported.new_session();
        }
    }

    /// Permits light once the device is configured, shows the picture again after BLACK or FREEZE, or acknowledges latched
    /// faults (bits of [`super::faults`]) after a fault.
    pub fn arm(&mut self, acknowledge: u32) {
        self.acknowledge = acknowledge;
        self.verb = None;
        self.rest = None;
        self.ordered = None;
        self.requested_at = NEVER;
        if matches!(self.state, LinkState::Ready | LinkState::Faulted | LinkState::Streaming) {
            self.inbox.fault = None;
            self.state = LinkState::Arming;
            // When it was disarmed, the device dropped the frames that others could refer to.
            self.key_due = true;
        }
    }

    /// True while light rests after too many flashes, or after a limit on light was reached.
    pub fn is_resting(&self, now: HostTime) -> bool {
        self.rest.is_some_and(|(end, _)| now < end)
    }

    /// True while light rests because the field flashed too often.
    pub fn rests_after_flashes(&self) -> bool {
        matches!(self.rest, Some((_, DropReason::FlashLimit)))
    }

    /// The limit on light that caused the present rest.
    pub fn resting_for(&self) -> Option<LimitReached> {
        match self.rest {
            Some((_, DropReason::LightLimit(limit))) => Some(limit),
            _ => None,
        }
    }

    /// Sends `verb` now, and repeats it every 20 ms until the device confirms it. An order to go dark (all but FREEZE)
    /// overtakes everything that waits on the medium, and until it is confirmed no frame is sent. While a stronger
    /// order is unconfirmed (SAFE, then STOP, then BLACK, then FREEZE), that order is sent again instead.
    pub fn command(
        &mut self,
        now: HostTime,
        verb: Verb,
        transport: &mut dyn Transport,
    ) -> Result<(), SendError> {
        // The light returns when the operator says so, not when a rest ends.
        self.rest = None;
        let given = self.give(now, verb, transport);
        self.ordered = self.verb;
        given
    }

    /// Sends `verb` until the device confirms it.
    fn give(&mut self, now: HostTime, verb: Verb, transport: &mut dyn Transport) -> Result<(), SendError> {
        let verb = self.verb.filter(|pending| pending.strength() > verb.strength()).unwrap_or(verb);
        // Flush only once per order: on a slow line, repeated flushes would discard the order itself each time.
        if verb.is_dark() && self.verb != Some(verb) {
            transport.flush_output();
        }
        self.verb = Some(verb);
        self.verb_sent_at = now;
        if self.state == LinkState::Arming {
            self.state = LinkState::Ready;
        }
        self.control(now, &verb.message(), transport)
    }

    /// Reads the input, takes the next step of the handshake, and keeps the device's watchdog fed. Call at least once
    /// per frame slot, with a `now` that was read immediately before. On an error of the handshake the link becomes
    /// [`LinkState::Closed`] (ARM refused: [`LinkState::Faulted`]). If the medium fails, the error is returned once,
    /// and the link is [`LinkState::Lost`] until the medium is back.
    pub fn poll(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<LinkState, LinkError> {
        let result = self.step(now, transport);
        if matches!(result, Err(LinkError::Transport(_))) && self.state != LinkState::Closed {
            self.state = LinkState::Lost;
            self.requested_at = now;
        }
        result
    }

    fn step(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<LinkState, LinkError> {
        if self.state == LinkState::Lost {
            if now.ns_since(self.requested_at) < REOPEN_NS {
                return Ok(self.state);
            }
            self.requested_at = now;
            if transport.reopen().is_err() {
                return Ok(self.state);
            }
            // A new session is dark: the picture returns when the caller arms.
            self.connect();
        }
        self.receive(now, transport)?;
        if self.state == LinkState::Closed {
            return Ok(self.state);
        }
        if std::mem::take(&mut self.inbox.device_forgot) && self.state != LinkState::Greeting {
            // Only a new HELLO helps; the caller decides whether to arm again.
            self.connect();
        }
        if self.is_left_alone(now) {
            // The device listens to another host, or its answers do not arrive: no frame can be lit any more. An order
            // to go dark that it has not confirmed stays in force.
            let unconfirmed = self.verb.filter(|verb| verb.is_dark());
            self.connect();
            self.verb = unconfirmed;
        }
        if self.rest.is_some_and(|(end, _)| now >= end) && self.state == LinkState::Streaming {
            self.rest = None;
            // An order of the operator outlasts any rest.
            if self.ordered.is_none() {
                self.arm(0);
            }
        }
        self.count_reported(now, transport);
        lost(self.follow_shift(now, transport))?;
        self.advance(transport)?;
        // Runs after the input was read: where a medium stamps with the poll's `now`, no answer may be older than its
        // question.
        self.exchange_clocks(now, transport)?;
        self.request(now, transport)?;
        Ok(self.state)
    }

    /// Lets the light rest if what the device reports flashes too often.
    fn count_reported(&mut self, now: HostTime, transport: &mut dyn Transport) {
        let Self { inbox, reported, slots, .. } = self;
        let (Some(reported), Some(status), Some(slots)) = (reported, &inbox.status, slots) else { return };
        let is_struck = slots.slot_at(status.now).is_some_and(|slot| reported.observe(status, slot));
        if is_struck && self.ordered.is_none() && self.rest.is_none() && self.state == LinkState::Streaming {
            self.rest_for(now, u64::from(REST_US), DropReason::FlashLimit, transport);
        }
    }

    /// True if the device has fallen silent.
    fn is_left_alone(&self, now: HostTime) -> bool {
        let heard_at = self.inbox.heard_at;
        let silent_ns = SILENT_NS.max(2_000 * i64::from(self.settings.watchdog_us));
        self.state != LinkState::Greeting && heard_at.0 != i64::MIN && now.ns_since(heard_at) > silent_ns
    }

    fn receive(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<(), TransportError> {
        let Self { inbox, decoders, .. } = self;
        let result = transport.receive(now, &mut |lane, arrived_at, bytes| {
            inbox.arrived_at = arrived_at;
            decoders[lane as usize].push(bytes, inbox);
        });
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
            if let Some(compactor) = &mut self.compactor {
                compactor.restrict(hello.codecs);
            }
            self.slots = SlotClock::new(epoch, hello.tick_hz, self.settings.rate);
            self.state = LinkState::Configuring;
            self.requested_at = NEVER;
        }
        let Some(status) = self.inbox.status else { return Ok(()) };
        use DeviceState as D;
        use LinkState as L;
        let losses = status.frames_incomplete.wrapping_add(status.frames_refused);
        if losses != self.losses {
            self.losses = losses;
            self.key_due = true;
        }
        if self.verb.is_some_and(|v| v.confirmed_by(status.state)) {
            self.verb = None;
        }
        self.state = match (self.state, status.state) {
            (L::Configuring, D::Configured | D::Armed) => L::Ready,
            // Before ARM was sent, "armed" is what the device was before the order that ARM takes back.
            (L::Arming, D::Armed) if self.requested_at != NEVER => L::Streaming,
            (L::Streaming | L::Ready, D::Faulted) => L::Faulted,
            // Latched faults hide whether the device is configured, so CONFIG must have been sent before an ARM can
            // follow it.
            (L::Configuring, D::Faulted) if self.requested_at != NEVER => L::Faulted,
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
            (FaultCode::Arm, LinkState::Arming) if fault.detail == ARM_BEFORE_CONFIG => {
                self.state = LinkState::Configuring;
                self.requested_at = NEVER;
                Ok(())
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

    /// Rejects a configuration that HELLO shows to be impossible.
    fn check(&self, hello: &DeviceHello, transport: &dyn Transport) -> Result<(), LinkError> {
        let device = || transport.name().to_string();
        let s = &self.settings;
        if hello.version != u16::from(VERSION) {
            return Err(LinkError::Version { device: device(), theirs: hello.version });
        }
        if hello.raster != s.raster {
            return Err(LinkError::Raster { device: device(), theirs: hello.raster, ours: s.raster });
        }
        if s.schedule.exceeds() && !hello.exceeds {
            return Err(LinkError::Exceeds { device: device() });
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

    /// Sends a clock exchange when one is due, which also keeps the watchdog fed.
    fn exchange_clocks(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<(), LinkError> {
        if matches!(self.state, LinkState::Closed | LinkState::Lost | LinkState::Greeting) {
            return Ok(());
        }
        let calm = (i64::from(self.settings.watchdog_us) * 1000 / 4).clamp(1_000_000, 100_000_000);
        let every = if self.echoes_sent < FAST_ECHOES { FAST_ECHO_NS.min(calm) } else { calm };
        if !is_due(now, self.echo_sent_at, every) {
            return Ok(());
        }
        self.echo_sent_at = now;
        self.echoes_sent += 1;
        let echo =
            Echo { host_sent_ns: now.0 as u64, device_received: DeviceTicks(0), device_sent: DeviceTicks(0) };
        lost(self.control(now, &HostMessage::Echo(echo), transport))
    }

    /// Sends the requests that are due: the next step of the handshake, a verb, a credit repair.
    fn request(&mut self, now: HostTime, transport: &mut dyn Transport) -> Result<(), LinkError> {
        let due = |last: HostTime, every: i64| is_due(now, last, every);
        if due(self.requested_at, RETRY_NS) {
            let message = match self.state {
                LinkState::Greeting => Some(HostMessage::Hello(HostHello {
                    version_min: u16::from(VERSION),
                    version_max: u16::from(VERSION),
                    codecs: self.settings.codecs | Codec::Raw.mask(),
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
            limits: s.limits,
            tracks: self.greatest_shift().is_some(),
            timing: self.measures_timing(),
            shifts: self.shifts_slots(),
            epoch: self.slots.map_or(DeviceTicks(0), |c| c.epoch_of(u64::MAX)),
        }
    }

    /// From the next session on, the device is asked to follow tracks if it can. Without this call no device is.
    pub fn want_tracks(&mut self) {
        self.wants_tracks = true;
    }

    /// By how many mirrors the device moves regions at most; `None` if it follows no tracks, or is not asked to.
    pub fn greatest_shift(&self) -> Option<u8> {
        self.inbox.hello?.greatest_shift.filter(|_| self.wants_tracks)
    }

    /// True if the device reports how early frames are whole.
    pub fn measures_timing(&self) -> bool {
        self.inbox.hello.is_some_and(|hello| hello.measures_timing)
    }

    /// Sends `tracks` under the next number of this session. They are only sent while frames are, and never repeated:
    /// newer ones follow soon.
    ///
    /// # Errors
    /// The medium has no room, or has failed; nothing was sent.
    pub fn send_tracks(
        &mut self,
        now: HostTime,
        tracks: &Tracks,
        transport: &mut dyn Transport,
    ) -> Result<(), SendError> {
        if self.state != LinkState::Streaming || self.verb.is_some() || self.greatest_shift().is_none() {
            return Ok(());
        }
        let number = self.tracks_sent.wrapping_add(1);
        self.control(now, &HostMessage::Tracks(tracks.numbered(number)), transport)?;
        self.tracks_sent = number;
        self.counters.tracks_sent += 1;
        Ok(())
    }

    /// Frames that the device has room for.
    pub fn credit(&self) -> u32 {
        let limit = self.inbox.status.map_or(0, |s| s.frame_limit);
        (limit.wrapping_sub(self.frames_sent) as i32).max(0) as u32
    }

    /// State of the handshake.
    pub fn state(&self) -> LinkState {
        self.state
    }

    /// The device's HELLO, once it answered.
    pub fn device(&self) -> Option<&DeviceHello> {
        self.inbox.hello.as_ref()
    }

    /// The device's newest report of this session.
    pub fn status(&self) -> Option<&Status> {
        self.inbox.status.as_ref()
    }

    /// The start of each slot on the device's clock, once configured.
    pub fn slots(&self) -> Option<SlotClock> {
        self.slots
    }

    /// The requested configuration.
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

    /// True while a clock exchange that began less than 5 ms ago is unanswered: a caller that polls soon gets a more
    /// precise map of the device's clock.
    pub fn awaits_echo(&self, now: HostTime) -> bool {
        self.echo_sent_at != NEVER
            && self.inbox.echo_answered != self.echo_sent_at
            && now.ns_since(self.echo_sent_at) < ECHO_AWAITED_NS
    }

    /// A frame number that follows those sent in this session.
    pub fn next_frame_id(&self) -> u64 {
        self.last_frame.map_or(1, |last| u64::from(last) + 1)
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

fn is_due(now: HostTime, last: HostTime, every_ns: i64) -> bool {
    last == NEVER || now.ns_since(last) >= every_ns
}

/// A busy medium is tried again later; a lost one is an error.
fn lost(sent: Result<(), SendError>) -> Result<(), LinkError> {
    match sent {
        Err(SendError::Failed(e)) => Err(LinkError::Transport(e)),
        Ok(()) | Err(SendError::Busy) => Ok(()),
    }
}

#[cfg(test)]
mod tests;
