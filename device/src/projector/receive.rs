//! Applies packets to the projector's state, with every check between a byte and light.

use crate::link::{
    frame_newer, Assembly, Codec, Commit, ConfigRefusal, Echo, FaultCode, FrameTiming, Header, HostMessage,
    MessageType, PacketSink, RleDecoder, SlotClock,
};
use crate::packet::copy_block;
use crate::time::DeviceTicks;
use crate::transport::Lane;

use super::frames::{Assembling, Held, Pending};
use super::{Core, Mode, ECHOES_KEPT, MAX_LEAD_S};

/// The packet that is arriving on a lane.
#[derive(Clone, Debug, Default)]
#[allow(clippy::large_enum_variant)] // There are two, and nothing may be allocated for a packet.
pub(super) enum Incoming {
    #[default]
    Nothing,
    Control(Assembly),
    /// A plane on its way into a frame buffer.
    Plane {
        plane: u8,
        frame: u32,
        buffer: usize,
        form: Form,
    },
}

/// Encoding of an arriving plane.
#[derive(Clone, Debug)]
pub(super) enum Form {
    /// The bytes are the bits; the number counts those written.
    Raw { filled: usize },
    /// Tokens, decoded as they arrive.
    Rle { decoder: RleDecoder, failed: bool },
    /// One block, decoded when it is complete and intact; the number counts the bytes staged.
    Lz4 { staged: usize },
}

pub(super) struct LaneSink<'a> {
    pub core: &'a mut Core,
    pub lane: Lane,
}

impl PacketSink for LaneSink<'_> {
    fn begin(&mut self, header: &Header) -> bool {
        let incoming = self.core.begin(header, self.lane);
        let wanted = !matches!(incoming, Incoming::Nothing);
        self.core.incoming[self.lane as usize] = incoming;
        wanted
    }

    fn payload(&mut self, bytes: &[u8]) {
        // Taken out during processing, because it acts on the rest of the core.
        let mut incoming = core::mem::take(&mut self.core.incoming[self.lane as usize]);
        match &mut incoming {
            Incoming::Control(assembly) => assembly.push(bytes),
            Incoming::Plane { plane, frame, buffer, form } => {
                self.core.plane_bytes_arrived(*plane, *frame, *buffer, form, bytes);
            }
            Incoming::Nothing => {}
        }
        self.core.incoming[self.lane as usize] = incoming;
    }

    fn end(&mut self, intact: bool) {
        match core::mem::take(&mut self.core.incoming[self.lane as usize]) {
            Incoming::Control(assembly) if intact => self.core.control(&assembly),
            Incoming::Plane { plane, frame, buffer, form } if intact => {
                // Only now: an intact header in front of a damaged payload does not count as a sign of life.
                self.core.last_heard = self.core.ticks();
                self.core.plane_arrived(plane, frame, buffer, &form);
            }
            _ => {}
        }
    }
}

impl Core {
    fn begin(&mut self, header: &Header, lane: Lane) -> Incoming {
        use MessageType::{FrameCommit, Plane, Sync};
        if matches!(header.kind, Plane | FrameCommit | Sync) && lane != Lane::Data {
            // On the control lane they could overtake the planes that they refer to.
            return self.ignore();
        }
        if header.kind == Plane {
            return self.begin_plane(header);
        }
        match Assembly::new(header) {
            Some(assembly) => Incoming::Control(assembly),
            None => self.ignore(),
        }
    }

    fn ignore(&mut self) -> Incoming {
        self.count_ignored();
        Incoming::Nothing
    }

    /// Counts a packet without effect.
    pub(super) fn count_ignored(&mut self) {
        self.status.packets_ignored = self.status.packets_ignored.wrapping_add(1);
    }

    /// True if an intact packet of `session` belongs to the open one, which feeds the watchdog; else as
    /// [`Core::is_ours`].
    fn heard(&mut self, session: u32) -> bool {
        let ours = self.is_ours(session);
        if ours {
            self.last_heard = self.ticks();
        }
        ours
    }

    /// True if `session` is the open one; otherwise counts the packet, and informs the host if no session is open.
    fn is_ours(&mut self, session: u32) -> bool {
        if self.session == 0 {
            self.status_due = true;
        }
        if self.session == 0 || session != self.session {
            self.ignore();
            return false;
        }
        true
    }

    fn begin_plane(&mut self, header: &Header) -> Incoming {
        if !self.is_ours(header.session) {
            return Incoming::Nothing;
        }
        let Some((config, _)) = self.config else { return self.ignore() };
        let plane_bytes = config.raster.plane_bytes();
        let spec = config.schedule.planes().get(header.plane as usize);
        let n = header.payload_bytes as usize;
        let fits = spec.is_some_and(|s| s.led_code() == header.led_code)
            && header.codec.mask() & self.setup.codecs != 0
            && if header.codec == Codec::Raw { n == plane_bytes } else { n < plane_bytes };
        if !fits || !self.enter_frame(header) {
            return self.ignore();
        }
        let Some(frame) = self.store.assembling else { return self.ignore() };
        // A plane that is already there is not written again: a damaged copy would spoil it.
        let Some(buffer) = frame.buffer.filter(|_| frame.received >> header.plane & 1 == 0) else {
            return self.ignore();
        };
        let form = match header.codec {
            Codec::Raw => Form::Raw { filled: 0 },
            Codec::Rle => Form::Rle { decoder: RleDecoder::new(), failed: false },
            Codec::Lz4 => Form::Lz4 { staged: 0 },
            Codec::XorRle => {
                let Some(base) = self.store.base else { return self.ignore() };
                self.store.copy(base.buffer, buffer, header.plane as usize * plane_bytes, plane_bytes);
                if let Some(frame) = &mut self.store.assembling {
                    frame.uses_base = true;
                }
                Form::Rle { decoder: RleDecoder::new_xor(), failed: false }
            }
        };
        Incoming::Plane { plane: header.plane, frame: header.frame, buffer, form }
    }

    /// The plane's share of a buffer.
    fn share(&mut self, plane: u8, buffer: usize) -> Option<&mut [u8]> {
        let plane_bytes = self.config.as_ref()?.0.raster.plane_bytes();
        self.store.bytes_mut(buffer).get_mut(plane as usize * plane_bytes..)?.get_mut(..plane_bytes)
    }

    fn plane_bytes_arrived(&mut self, plane: u8, frame: u32, buffer: usize, form: &mut Form, bytes: &[u8]) {
        // Light may have ended while the plane was arriving: then the buffer belongs to another frame by now.
        if !self.is_assembling(frame, buffer) {
            return;
        }
        if let Form::Lz4 { staged } = form {
            if let Some(to) = self.staging.get_mut(*staged..*staged + bytes.len()) {
                to.copy_from_slice(bytes);
                *staged += bytes.len();
            }
            return;
        }
        let Some(share) = self.share(plane, buffer) else { return };
        match form {
            Form::Raw { filled } => {
                if let Some(to) = share.get_mut(*filled..*filled + bytes.len()) {
                    copy_block(to, bytes);
                    *filled += bytes.len();
                }
            }
            Form::Rle { decoder, failed } => *failed |= !*failed && decoder.push(bytes, share).is_err(),
            Form::Lz4 { .. } => {}
        }
    }

    /// Makes the packet's frame the one being assembled. `false` for a frame that is over, or a packet that contradicts it.
    fn enter_frame(&mut self, header: &Header) -> bool {
        if let Some(current) = self.store.assembling {
            if current.frame == header.frame {
                return current.target_at == header.target_at;
            }
        }
        if self.last_seen_frame.is_some_and(|last| !frame_newer(header.frame, last)) {
            return false;
        }
        self.give_up_frame();
        self.last_seen_frame = Some(header.frame);
        self.status.frames_seen = self.status.frames_seen.wrapping_add(1);
        let refused = self.mode == Mode::Disarmed;
        if refused {
            self.refuse();
        }
        self.store.assembling = Some(Assembling {
            frame: header.frame,
            target_at: header.target_at,
            begun_at: self.ticks(),
            received: 0,
            uses_base: false,
            buffer: if refused { None } else { Some(self.store.free_buffer()) },
        });
        true
    }

    fn refuse(&mut self) {
        self.status.frames_refused = self.status.frames_refused.wrapping_add(1);
    }

    /// Drops the frame that is being assembled.
    fn give_up_frame(&mut self) {
        if self.store.assembling.take().is_some_and(|f| f.buffer.is_some()) {
            self.status.frames_incomplete = self.status.frames_incomplete.wrapping_add(1);
        }
    }

    fn is_assembling(&self, frame: u32, buffer: usize) -> bool {
        self.store.assembling.is_some_and(|a| a.frame == frame && a.buffer == Some(buffer))
    }

    fn plane_arrived(&mut self, plane: u8, frame: u32, buffer: usize, form: &Form) {
        if !self.is_assembling(frame, buffer) {
            return;
        }
        let staging = core::mem::take(&mut self.staging);
        let whole = self.share(plane, buffer).is_some_and(|share| match form {
            Form::Raw { filled } => *filled == share.len(),
            Form::Rle { decoder, failed } => !failed && decoder.finish(share.len()).is_ok(),
            Form::Lz4 { staged } => {
                lz4_flex::block::decompress_into(&staging[..*staged], share).is_ok_and(|n| n == share.len())
            }
        });
        self.staging = staging;
        if !whole {
            self.ignore();
            return;
        }
        self.status.last_plane = plane;
        if let Some(frame) = &mut self.store.assembling {
            frame.received |= 1 << plane;
        }
    }

    fn control(&mut self, assembly: &Assembly) {
        let header = assembly.header();
        let session = header.session;
        let message = match HostMessage::parse(header.kind, assembly.payload()) {
            Ok(message) => message,
            Err(_) => {
                self.ignore();
                if header.kind == MessageType::Config && session == self.session && session != 0 {
                    self.report(FaultCode::Config, ConfigRefusal::Format as u16);
                }
                return;
            }
        };
        // Orders to go dark are accepted from any session.
        match message {
            // This device's own answer, from a line that echoes: it proves no host alive.
            HostMessage::Echo(echo) if echo.is_answer() => {
                self.ignore();
                return;
            }
            HostMessage::Hello(hello) => return self.greeted(session, hello.version_min..=hello.version_max),
            HostMessage::Stop => return self.disarm(),
            HostMessage::Safe => return self.latch(crate::link::faults::HOST_SAFE),
            HostMessage::Black if self.mode != Mode::Disarmed => {
                self.mode = Mode::Black;
                self.lit_now = false;
                self.status_due = true;
                self.heard(session);
                return;
            }
            _ => {}
        }
        if !self.heard(session) {
            return;
        }
        match message {
            HostMessage::Config(config) => match self.configure(config) {
                Ok(()) => self.status_due = true,
                Err(refusal) => self.report(FaultCode::Config, refusal as u16),
            },
            HostMessage::Arm(acknowledged) => self.arm(acknowledged),
            HostMessage::Freeze if self.mode == Mode::Normal => {
                self.mode = Mode::Frozen;
                self.status_due = true;
            }
            HostMessage::Echo(echo) if self.echoes.len() < ECHOES_KEPT => {
                self.echoes.push_back(Echo { device_received: self.ticks(), ..echo });
            }
            HostMessage::Tracks(tracks) => self.take_tracks(tracks),
            HostMessage::Shift(shift) => self.take_shift(shift),
            HostMessage::Sync(frames_sent) => {
                self.give_up_frame();
                self.account(frames_sent);
            }
            HostMessage::Commit(commit) => self.commit(header, &commit),
            _ => {}
        }
    }

    /// A host speaks these versions and opens `session`, or is refused.
    fn greeted(&mut self, session: u32, versions: core::ops::RangeInclusive<u16>) {
        if session == 0 {
            self.ignore();
        } else if !versions.contains(&self.setup.version) {
            self.hello_due = Some(session);
            self.version_refused_due = Some(session);
        } else {
            if session != self.session {
                self.open_session(session);
            }
            self.last_heard = self.ticks();
            self.hello_due = Some(session);
            self.status_due = true;
        }
    }

    /// Accounts the number of frames that the host has sent: frames that were not seen were lost on the way and occupy
    /// no buffer.
    fn account(&mut self, frames_sent: u32) {
        if frame_newer(frames_sent, self.status.frames_accounted) {
            self.status.frames_accounted = frames_sent;
        }
        self.status_due = true;
    }

    fn commit(&mut self, header: &Header, commit: &Commit) {
        // A frame whose light would end before it begins has a wrong field, and no effect, like every such message.
        if self.config.is_none() || !commit.ends_after(header.target_at) || !self.enter_frame(header) {
            self.ignore();
            return;
        }
        let over_limit = frame_newer(commit.frames_sent, self.frame_limit());
        self.account(commit.frames_sent);
        let Some(frame) = self.store.assembling.take() else { return };
        let Some(buffer) = frame.buffer else { return };
        if over_limit || self.store.free() == 0 {
            self.credit_violations += 1;
            return self.refuse();
        }
        if !self.complete(&frame, buffer, commit) {
            self.status.frames_incomplete = self.status.frames_incomplete.wrapping_add(1);
            return;
        }
        self.status.last_whole_frame = frame.frame;
        self.whole_since = true;
        self.store.base = Some(Held { frame: frame.frame, dark_from: commit.dark_from, buffer });
        self.schedule(&frame, commit.dark_from, buffer);
    }

    /// True if every plane of the frame is in `buffer`; unchanged planes are copied from the base frame.
    fn complete(&mut self, frame: &Assembling, buffer: usize, commit: &Commit) -> bool {
        let Some((config, _)) = self.config else { return false };
        let all = u32::MAX >> (32 - config.schedule.len());
        if commit.sent | commit.kept != all || frame.received != commit.sent {
            return false;
        }
        if commit.kept == 0 && !frame.uses_base {
            return true;
        }
        let Some(base) = self.store.base.filter(|b| b.frame == commit.base_frame) else { return false };
        let plane_bytes = config.raster.plane_bytes();
        for plane in (0..config.schedule.len()).filter(|p| commit.kept >> p & 1 == 1) {
            self.store.copy(base.buffer, buffer, plane * plane_bytes, plane_bytes);
        }
        true
    }

    /// Notes for STATUS how early the frame is whole.
    fn time(&mut self, frame: &Assembling, slots: &SlotClock) {
        let (now, tick_hz) = (self.ticks(), i128::from(self.setup.clock.tick_hz));
        let begin = slots.start(slots.slot_at(frame.target_at).unwrap_or(0));
        let ns = |from: DeviceTicks, to: DeviceTicks| {
            (i128::from(to.0) - i128::from(from.0)) * 1_000_000_000 / tick_hz
        };
        let slack_ns = ns(now, begin).clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        let transfer_ns = ns(frame.begun_at, now).clamp(0, u32::MAX.into()) as u32;
        self.status.timing = Some(FrameTiming { frame: frame.frame, slack_ns, transfer_ns, epoch: 0 });
    }

    /// Queues a whole frame for its slot, or drops it as too late or too early.
    fn schedule(&mut self, frame: &Assembling, dark_from: DeviceTicks, buffer: usize) {
        let Some((config, slots)) = self.config else { return };
        let lead = u64::from(self.setup.clock.tick_hz).saturating_mul(MAX_LEAD_S);
        if frame.target_at > DeviceTicks(self.ticks().0.saturating_add(lead)) {
            return self.refuse();
        }
        self.time(frame, &slots);
        let target = slots.slot_at(frame.target_at).unwrap_or(0);
        let late = self.next_slot.saturating_sub(target);
        if late > u64::from(config.late_slots) || dark_from <= self.ticks() {
            self.status.frames_late = self.status.frames_late.wrapping_add(1);
            return;
        }
        self.store.push(Pending { frame: frame.frame, slot: target, dark_from, buffer });
    }
}
