//! The firmware of a bit-plane projector: the device's half of the link, from packets to light, as a state machine without
//! I/O. The mock projector is this firmware with an ideal panel. An adapter gives it a panel that takes pictures in other
//! ways, and this process is then the projector at the end of an in-process cable.
//!
//! [`LinkDevice::receive`] and [`LinkDevice::advance_to`] drive everything, with the true time as an argument; the
//! device's own clock is derived from it ([`DeviceClock`]). The projector starts dark, makes light only after HELLO,
//! CONFIG and ARM, goes dark and latches when the host falls silent, and lights a frame only after every bit of it has
//! arrived.

mod ahead;
mod clock;
mod config;
mod following;
mod frames;
mod guard;
mod light;
mod receive;
mod session;
mod slots;
mod status;
#[cfg(feature = "std")]
mod thread;

use alloc::collections::VecDeque;
use alloc::{vec, vec::Vec};

use crate::link::{
    faults, packet_bytes, Codec, Config, Decoder, DecoderCounters, DeviceMessage, DeviceState, Echo, Fault,
    FaultCode, FlashLimiter, Header, Packet, SlotClock, Status, MAX_CONTROL_BYTES,
};
use crate::planes::{Raster, MAX_PLANES};
use crate::time::{DeviceTicks, HostTime};
use crate::transport::{Lane, LinkDevice};

pub use crate::light::{LightEvent, LightKind};
pub use ahead::WaitingFrame;
pub use clock::DeviceClock;
pub use config::{FirmwareConfig, LightChange, Shown, ShownPlanes};
use following::Following;
pub use following::SlotMoves;
use frames::FrameStore;
use guard::LightGuard;
pub use light::{gather_bits, light_of_planes, Exposure, Run};
use status::summed;
#[cfg(feature = "std")]
pub use thread::{serve_cable, Served};

/// Echo answers that may wait; later requests are dropped, as a busy device would.
const ECHOES_KEPT: usize = 16;
/// Number of damaged packets without one whole frame among them that ends the light.
const CHECKSUM_STORM: u32 = 1000;
/// A target further ahead than this is refused, seconds: it would occupy a buffer too long.
const MAX_LEAD_S: u64 = 2;

/// Whether the projector is armed, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Disarmed,
    Normal,
    Black,
    Frozen,
}

/// A projector. See the module's documentation. A clone is in the same state, but has no room set aside: it allocates when
/// it first needs some.
#[derive(Clone, Debug)]
pub struct ProjectorFirmware {
    decoders: [Decoder; 2],
    core: Core,
}

/// Everything but the decoders, so that packets that a decoder finds can act on it.
#[derive(Clone, Debug)]
struct Core {
    setup: FirmwareConfig,
    now: HostTime,
    session: u32,
    config: Option<(Config, SlotClock)>,
    mode: Mode,
    latched: u32,
    /// Causes of faults that are present now; ARM cannot acknowledge them.
    present: u32,
    last_heard: DeviceTicks,
    next_slot: u64,
    flash: Option<FlashLimiter>,
    guard: LightGuard,
    /// The time up to which the guard has counted.
    counted_to: Option<HostTime>,
    /// Luminance of the frame on the mirrors.
    luminance: u32,
    /// No ARM before this, during the rest after too many flashes.
    rest_until: DeviceTicks,
    /// Count of damaged packets when a frame was last whole.
    damaged_at_whole: u32,
    whole_since: bool,
    store: FrameStore,
    /// Buffer for an arriving LZ4 block.
    staging: Vec<u8>,
    lit_now: bool,
    /// The panel takes no new frame now; see [`ProjectorFirmware::panel_busy`].
    panel_busy: bool,
    /// What the slots before the last one's new frame showed, while the panel has not taken that frame.
    untaken: Option<LightKind>,
    last_seen_frame: Option<u32>,
    status: Status,
    credit_violations: u64,
    incoming: [receive::Incoming; 2],
    events: VecDeque<LightEvent>,
    events_lost: u64,
    shown: VecDeque<Shown>,
    shown_lost: u64,
    following: Following,
    moves: VecDeque<SlotMoves>,
    /// The instant of the present event: `now`, or the exact instant of the device's own events.
    at: HostTime,
    changes: VecDeque<LightChange>,
    before: (bool, DeviceState),
    light: Vec<[u8; 3]>,
    light_is_of: Option<u64>,
    /// Counts lit frames over all sessions.
    generation: u64,
    /// Session whose HELLO waits for an answer.
    hello_due: Option<u32>,
    /// Session that was not opened because its host speaks only other versions.
    version_refused_due: Option<u32>,
    fault_due: Option<Fault>,
    echoes: VecDeque<Echo>,
    status_due: bool,
    /// A session was opened since the decoders' counters were last read, and their values then.
    counters_due: bool,
    counted_before: DecoderCounters,
}

impl ProjectorFirmware {
    /// A projector that was just powered on. It allocates all its buffers here.
    ///
    /// # Panics
    /// When a field of `setup` is outside its documented range.
    pub fn new(mut setup: FirmwareConfig) -> Self {
        setup.codecs |= Codec::Raw.mask();
        assert!((1..=MAX_PLANES).contains(&(setup.max_planes as usize)), "max_planes {}", setup.max_planes);
        assert!((1..=64).contains(&setup.frame_buffers), "frame_buffers {}", setup.frame_buffers);
        assert!(setup.clock.tick_hz > 0, "tick_hz 0");
        let frame_bytes = setup.raster.plane_bytes() * setup.max_planes as usize;
        Self {
            decoders: [Decoder::new(), Decoder::new()],
            core: Core {
                setup,
                now: HostTime(i64::MIN),
                session: 0,
                config: None,
                mode: Mode::Disarmed,
                latched: 0,
                present: 0,
                last_heard: DeviceTicks(0),
                next_slot: 0,
                flash: None,
                guard: LightGuard::default(),
                counted_to: None,
                luminance: 0,
                rest_until: DeviceTicks(0),
                damaged_at_whole: 0,
                whole_since: false,
                store: FrameStore::new(setup.frame_buffers as usize, frame_bytes),
                staging: vec![0; setup.raster.plane_bytes()],
                lit_now: false,
                panel_busy: false,
                untaken: None,
                last_seen_frame: None,
                status: Status::default(),
                credit_violations: 0,
                incoming: Default::default(),
                events: VecDeque::with_capacity(setup.events_kept),
                events_lost: 0,
                shown: VecDeque::with_capacity(setup.shown_kept),
                shown_lost: 0,
                following: Following::default(),
                moves: VecDeque::with_capacity(setup.moves_kept),
                at: HostTime(i64::MIN),
                changes: VecDeque::with_capacity(setup.changes_kept),
                before: (false, DeviceState::Idle),
                light: Vec::new(),
                light_is_of: None,
                generation: 0,
                hello_due: None,
                version_refused_due: None,
                fault_due: None,
                echoes: VecDeque::with_capacity(ECHOES_KEPT),
                status_due: false,
                counters_due: false,
                counted_before: DecoderCounters::default(),
            },
        }
    }

    /// The oldest light event not yet taken.
    pub fn next_light(&mut self) -> Option<LightEvent> {
        self.core.events.pop_front()
    }

    /// The oldest lit slot that is over and was not yet taken. None is kept unless [`FirmwareConfig::shown_kept`] says so.
    pub fn next_shown(&mut self) -> Option<Shown> {
        let core = &mut self.core;
        core.shown.front().filter(|shown| shown.event.last_photon_at <= core.now)?;
        core.shown.pop_front()
    }

    /// Up to here everything that was shown is known and has been, or can be, taken.
    pub fn shown_until(&self) -> HostTime {
        let waiting = self.core.shown.iter().find(|shown| shown.event.last_photon_at > self.core.now);
        waiting.map_or(self.core.now, |shown| shown.event.first_photon_at.min(self.core.now))
    }

    /// Lit slots that were dropped before they were taken.
    pub fn shown_lost(&self) -> u64 {
        self.core.shown_lost
    }

    /// What tracks made of the planes of the oldest lit slot that is over and was not yet taken. None is kept unless
    /// [`FirmwareConfig::moves_kept`] says so, and only while CONFIG asks for tracks.
    pub fn next_moves(&mut self) -> Option<SlotMoves> {
        let core = &mut self.core;
        core.moves.front().filter(|moves| moves.planes_end_at <= core.now)?;
        core.moves.pop_front()
    }

    /// True while CONFIG asks for tracks that this projector follows. Then [`ProjectorFirmware::next_moves`] tells of every
    /// lit slot, if [`FirmwareConfig::moves_kept`] says so.
    pub fn follows_tracks(&self) -> bool {
        self.core.follows()
    }

    /// Number of light events that were replaced by newer ones before they were taken.
    pub fn light_events_lost(&self) -> u64 {
        self.core.events_lost
    }

    /// The oldest change of light or state not yet taken.
    pub fn next_change(&mut self) -> Option<LightChange> {
        self.core.changes.pop_front()
    }

    /// True when light is on.
    pub fn is_lit(&self) -> bool {
        self.core.lit_now
    }

    /// The frame whose planes are on the mirrors (lit or held dark), low 32 bits of its number.
    pub fn lit_frame(&self) -> Option<u32> {
        self.core.store.lit.map(|h| h.frame)
    }

    /// Counts the frames that were lit; `None` while it is dark. A number stands for one frame's planes.
    pub fn lit_generation(&self) -> Option<u64> {
        (self.core.lit_now && self.core.store.lit.is_some()).then_some(self.core.generation)
    }

    /// The planes on the mirrors, one after the other in the configured order.
    pub fn lit_planes(&self) -> Option<&[u8]> {
        let held = self.core.store.lit?;
        let (config, _) = self.core.config.as_ref()?;
        Some(&self.core.store.bytes(held.buffer)[..config.raster.plane_bytes() * config.schedule.len()])
    }

    /// Light of the frame on the mirrors as code values, rows top to bottom; computed on demand, once per frame. `None`
    /// while no frame is on the mirrors. The first call allocates.
    pub fn light_of_frame(&mut self) -> Option<&[[u8; 3]]> {
        let core = &mut self.core;
        let held = core.store.lit?;
        let (config, _) = core.config.as_ref()?;
        if core.light_is_of != Some(core.generation) {
            core.light.resize(config.raster.pixel_count(), [0; 3]);
            let bytes = config.raster.plane_bytes() * config.schedule.len();
            let planes = &core.store.bytes(held.buffer)[..bytes];
            light_of_planes(config.raster, &config.schedule, planes, &mut core.light);
            core.light_is_of = Some(core.generation);
        }
        Some(&core.light)
    }

    /// The content of a STATUS now.
    pub fn status(&self) -> Status {
        self.core.status_now(&self.decoders)
    }

    /// Frames that arrived without credit: a correct host never causes one.
    pub fn credit_violations(&self) -> u64 {
        self.core.credit_violations
    }

    /// Frames that have begun to arrive and are neither lit nor given up.
    pub fn in_flight(&self) -> u32 {
        self.core.store.in_flight() as u32
    }

    /// The projector's mirrors.
    pub fn raster(&self) -> Raster {
        self.core.setup.raster
    }

    /// The serial number that it reports.
    pub fn serial(&self) -> u64 {
        self.core.setup.serial
    }

    /// The time up to which it has been advanced.
    pub fn now(&self) -> HostTime {
        self.core.now
    }

    /// The projector's clock.
    pub fn clock(&self) -> DeviceClock {
        self.core.setup.clock
    }

    /// True time of the device's next own event (a slot, the end of a frame's light, or the watchdog); `None` while
    /// disarmed.
    pub fn next_due(&self) -> Option<HostTime> {
        let (config, slots) = self.core.config.as_ref()?;
        if self.core.mode == Mode::Disarmed {
            return None;
        }
        let mut due = slots.start(self.core.next_slot).min(self.core.bite_at(config));
        if let Some(dark_from) = self.core.dark_from() {
            due = due.min(dark_from);
        }
        Some(self.core.setup.clock.instant_of(due))
    }

    /// Sets the present causes of faults (bits of [`faults`]): a hot lamp, a pressed button. New ones latch at once.
    pub fn set_faults(&mut self, now: HostTime, present: u32) {
        self.advance_to(now);
        let new = present & !self.core.present;
        self.core.present = present;
        if new != 0 {
            self.core.latch(new);
            self.core.note_change();
        }
    }

    /// The bus was reset, or the cable pulled: the session and its light end at once. The device's properties and its
    /// latched faults stay.
    pub fn bus_reset(&mut self, now: HostTime) {
        self.advance_to(now);
        self.core.open_session(0);
        self.core.note_change();
        self.core.incoming = Default::default();
        self.decoders = [Decoder::new(), Decoder::new()];
        (self.core.counters_due, self.core.counted_before) = (false, DecoderCounters::default());
    }

    /// The projector's clock jumps forward by `ticks`.
    pub fn shift_clock(&mut self, now: HostTime, ticks: u64) {
        self.advance_to(now);
        let clock = &mut self.core.setup.clock;
        clock.start_ticks = clock.start_ticks.saturating_add(ticks);
        self.advance_to(now);
    }

    /// Corrects the clock, so that it stays with what paces a panel: the vertical blanks of a display. The new clock must
    /// not read less at `now` than the old one, and slots that have begun stay as they are.
    pub fn discipline(&mut self, now: HostTime, clock: DeviceClock) {
        self.advance_to(now);
        self.core.setup.clock = clock;
    }

    /// For a panel that takes a frame some time after the slot has begun, and may be late: true from the moment at which
    /// a frame is handed to it until it has taken it. A slot that begins meanwhile takes no new frame. If what the panel
    /// is busy with is the new frame of the slot before, then that slot showed what it showed before, and the frame is
    /// lit one slot later. STATUS waits while it is open which of the two is true. Every frame that the panel has taken
    /// is so reported in the slot in which it was really shown.
    pub fn panel_busy(&mut self, busy: bool) {
        self.core.panel_busy = busy;
        if !busy {
            self.core.untaken = None;
        }
    }

    /// True if a STATUS waits because the panel has not taken the newest frame.
    pub fn is_unsettled(&self) -> bool {
        self.core.panel_busy && self.core.untaken.is_some()
    }

    /// Power fails and comes back: dark, no session, no memory, the clock starts again.
    pub fn power_cycle(&mut self, now: HostTime) {
        self.advance_to(now);
        let present = self.core.present;
        self.core.disarm();
        self.core.note_change();
        let changes = core::mem::take(&mut self.core.changes);
        let setup = FirmwareConfig {
            clock: DeviceClock { power_on_at: now, ..self.core.setup.clock },
            ..self.core.setup
        };
        *self = Self::new(setup);
        self.core.present = present;
        self.core.latched = present;
        self.core.changes = changes;
    }
}

impl LinkDevice for ProjectorFirmware {
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]) {
        self.core.advance(now);
        let mut sink = receive::LaneSink { core: &mut self.core, lane };
        self.decoders[lane as usize].push(bytes, &mut sink);
        if core::mem::take(&mut self.core.counters_due) {
            // Earlier packets, including the HELLO, do not belong to this session.
            self.core.counted_before = summed(&self.decoders);
        }
        let [a, b] = self.decoders.each_ref().map(Decoder::counters);
        let damaged = [a.header_errors, a.payload_errors, b.header_errors, b.payload_errors];
        self.core.damaged(damaged.iter().fold(0, |sum, n| sum.wrapping_add(*n)));
        self.core.note_change();
    }

    fn end_of_transfer(&mut self, now: HostTime, lane: Lane) {
        self.core.advance(now);
        let mut sink = receive::LaneSink { core: &mut self.core, lane };
        self.decoders[lane as usize].reset(&mut sink);
    }

    fn advance_to(&mut self, now: HostTime) {
        self.core.advance(now);
    }

    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) {
        self.core.advance(now);
        let now_ticks = self.core.ticks();
        let mut send = |session: u32, message: &DeviceMessage| {
            let mut payload = [0u8; MAX_CONTROL_BYTES];
            let (kind, n) = message.write(&mut payload);
            let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
            let mut wire = [0u8; packet_bytes(MAX_CONTROL_BYTES)];
            let len = packet.write_to(&mut wire);
            sink(Lane::Control, &wire[..len]);
        };
        let session = self.core.session;
        if let Some(asked) = self.core.hello_due.take() {
            send(asked, &DeviceMessage::Hello(self.core.hello(now_ticks)));
        }
        if let Some(asked) = self.core.version_refused_due.take() {
            let (latched, detail) = (self.core.latched, self.core.setup.version);
            let fault = Fault { latched, code: FaultCode::Version, detail, at: now_ticks };
            send(asked, &DeviceMessage::Fault(fault));
        }
        if let Some(fault) = self.core.fault_due.take() {
            send(session, &DeviceMessage::Fault(fault));
        }
        while let Some(echo) = self.core.echoes.pop_front() {
            send(session, &DeviceMessage::Echo(Echo { device_sent: now_ticks, ..echo }));
        }
        let may_tell = !(self.core.panel_busy && self.core.untaken.is_some());
        if may_tell && core::mem::take(&mut self.core.status_due) {
            let status = self.core.status_now(&self.decoders);
            send(session, &DeviceMessage::Status(status));
        }
    }
}

impl Core {
    fn ticks(&self) -> DeviceTicks {
        self.setup.clock.ticks_at(self.now)
    }

    /// When the watchdog expires if nothing more arrives.
    fn bite_at(&self, config: &Config) -> DeviceTicks {
        let ticks = u64::from(config.watchdog_us) * u64::from(self.setup.clock.tick_hz) / 1_000_000;
        DeviceTicks(self.last_heard.0.saturating_add(ticks.max(1)))
    }

    /// When the lit frame must go dark if no newer one is lit before; `None` while nothing is lit or light is frozen.
    fn dark_from(&self) -> Option<DeviceTicks> {
        let held = self.store.lit.filter(|_| self.lit_now && self.mode == Mode::Normal)?;
        Some(held.dark_from)
    }

    /// Notes that light went on or off, or that the state changed.
    fn note_change(&mut self) {
        let now = (self.lit_now, self.state());
        if now == self.before {
            return;
        }
        self.before = now;
        if let Some(shown) = self.shown.back_mut().filter(|_| !self.lit_now) {
            shown.event.last_photon_at = shown.event.last_photon_at.min(self.at);
        }
        let settle = if self.lit_now { i64::from(self.setup.settle_ns) } else { 0 };
        if self.changes.len() >= self.setup.changes_kept {
            self.changes.pop_front();
            self.events_lost += 1;
        }
        if self.setup.changes_kept == 0 {
            return;
        }
        self.changes.push_back(LightChange {
            at: self.at.plus_ns(settle),
            frame: self.store.lit.filter(|_| self.lit_now).map(|held| held.frame),
            state: now.1,
            faults: self.latched,
        });
    }

    /// Ends the light of the frame on the mirrors: dark until a newer one is lit, and no frame is left that could be
    /// lit again.
    fn end_light(&mut self) {
        self.lit_now = false;
        self.following.clear();
        self.store.lit = None;
        self.untaken = None;
        self.status_due = true;
    }

    /// Processes slots, ends of light and the watchdog up to `now`, in the order of time. Bounded: the watchdog ends
    /// the loop.
    fn advance(&mut self, now: HostTime) {
        self.now = self.now.max(now);
        let ticks = self.ticks();
        while self.mode != Mode::Disarmed {
            let Some((config, slots)) = self.config else { break };
            let (start, bite) = (slots.start(self.next_slot), self.bite_at(&config));
            // If both fall on one tick, the new frame comes before the end of the old one: there is no dark gap between
            // them.
            let dark = self.dark_from().filter(|dark| *dark < start);
            let next = dark.unwrap_or(start);
            // A plane that would begin when something else does is not lit any more.
            self.light_planes(&config, DeviceTicks(next.min(bite).0.saturating_sub(1)).min(ticks));
            if next.min(bite) > ticks {
                break;
            }
            self.at = self.setup.clock.instant_of(next.min(bite));
            if bite <= next {
                self.latch(faults::WATCHDOG);
                break;
            }
            match dark {
                Some(_) => self.end_light(),
                None => self.slot(&config, &slots, start),
            }
            self.note_change();
        }
        // External events happen now; the watchdog's effect was noted at its own instant.
        self.note_change();
        self.at = self.now;
    }
}

#[cfg(test)]
mod tests;
