//! A host made of single packets: what a rule sends is what it says, and everything that the device answers is kept and held against the
//! laws that no report may break.
//!
//! Every wait has an end. While a rule waits, the driver feeds the device's watchdog, unless the rule wants silence.

use super::laws::Laws;
use super::Stop;
use dpm_device::link::{
    Assembly, Config, Decoder, DeviceHello, DeviceMessage, Echo, Fault, FaultCode, Header, HostMessage,
    MessageType, Packet, PacketSink, SessionNumbers, SlotClock, Status, MAX_CONTROL_BYTES,
};
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_device::transport::{Lane, SendError, Transport};
use std::collections::VecDeque;
use std::time::Duration;

/// What a rule and its steps return.
pub(super) type R<T = ()> = Result<T, Stop>;

/// Longest wait for an answer that is due at once, on a medium that takes no time.
const ANSWER_NS: i64 = 400_000_000;
/// While a rule waits, the device hears of the host this often.
const FEED_NS: i64 = 60_000_000;
/// Watchdog of the rules that are not about it: this machine may be busy for a while.
pub(super) const WATCHDOG_US: u32 = 2_000_000;

/// What the device's packets arrive on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MediumKind {
    /// COBS frames: a delimiter ends every packet, and both lanes are one.
    Serial,
    /// Bulk transfers: a short one ends a packet.
    Usb,
    /// A device in this process: nothing ends a packet but its length.
    InProcess,
}

/// Where the device is.
pub struct Medium<'a> {
    /// Open, and nobody else's.
    pub transport: &'a mut dyn Transport,
    /// What kind it is.
    pub kind: MediumKind,
    /// Bytes a second that it carries; `None` where that is no matter.
    pub bytes_per_s: Option<u32>,
    /// The host's clock.
    pub clock: &'a dyn Fn() -> HostTime,
    /// True when the judging shall end.
    pub stop: &'a dyn Fn() -> bool,
}

/// A message of the device, and when it arrived.
#[derive(Clone, Copy, Debug)]
pub(super) struct DeviceWord {
    /// Host's clock.
    pub at: HostTime,
    /// Session field of its header.
    pub session: u32,
    /// What it says.
    pub message: DeviceMessage,
}

/// Packets into messages.
#[derive(Default)]
struct Inbox {
    now: HostTime,
    assembly: Option<Assembly>,
    heard: VecDeque<DeviceWord>,
    laws: Laws,
}

impl PacketSink for Inbox {
    fn begin(&mut self, header: &Header) -> bool {
        self.laws.header(header);
        self.assembly = Assembly::new(header);
        self.assembly.is_some()
    }

    fn payload(&mut self, bytes: &[u8]) {
        if let Some(assembly) = &mut self.assembly {
            assembly.push(bytes);
        }
    }

    fn end(&mut self, intact: bool) {
        let Some(assembly) = self.assembly.take().filter(|_| intact) else { return };
        let header = assembly.header();
        match DeviceMessage::parse(header.kind, assembly.payload()) {
            Ok(message) => {
                self.laws.message(&message);
                // What nobody waits for any more goes; a device that talks without end costs no memory.
                if self.heard.len() >= 4096 {
                    self.heard.pop_front();
                }
                self.heard.push_back(DeviceWord { at: self.now, session: header.session, message });
            }
            Err(e) => self.laws.unreadable(&e),
        }
    }
}

/// The driver.
pub(super) struct ConformanceDriver<'a> {
    pub medium: Medium<'a>,
    decoders: [Decoder; 2],
    inbox: Inbox,
    pub sessions: SessionNumbers,
    /// The device's first answer.
    pub hello: Option<DeviceHello>,
    pub session: u32,
    pub config: Option<Config>,
    pub slots: Option<SlotClock>,
    /// Frames sent in this session, those that were lost on purpose included.
    pub frames_sent: u32,
    pub next_frame: u32,
    /// Packets with a right header, sent in this session.
    pub packets_sent: u32,
    /// `packets` of the session's first report less those sent until then.
    pub packets_base: Option<u32>,
    /// The device's clock as it was told last, and when.
    pub clock: (u64, HostTime),
    pub newest: Option<Status>,
    /// The watchdog is fed while a rule waits.
    pub feed: bool,
    fed_at: HostTime,
    /// The light may flash.
    pub may_flash: bool,
}

impl<'a> ConformanceDriver<'a> {
    /// Nothing is sent yet.
    pub(super) fn new(medium: Medium<'a>) -> Self {
        let now = (medium.clock)();
        Self {
            medium,
            decoders: [Decoder::new(), Decoder::new()],
            inbox: Inbox::default(),
            sessions: SessionNumbers::from_system(),
            hello: None,
            session: 0,
            config: None,
            slots: None,
            frames_sent: 0,
            next_frame: 1,
            packets_sent: 0,
            packets_base: None,
            clock: (0, now),
            newest: None,
            feed: true,
            fed_at: now,
            may_flash: false,
        }
    }

    /// STOP, for whoever listens; a device that is gone is dark by itself.
    pub(super) fn darken(&mut self) {
        for _ in 0..3 {
            let _ = self.say(&HostMessage::Stop);
            let _ = self.rest();
        }
    }

    /// The laws that hold over all of it.
    pub(super) fn laws(&self) -> &Laws {
        &self.inbox.laws
    }

    /// Bytes on the way back that were no intact packets: damaged headers, damaged payloads, foreign packets, bytes outside.
    pub(super) fn noise(&self) -> [u32; 4] {
        let mut all = [0; 4];
        for c in self.decoders.iter().map(Decoder::counters) {
            for (sum, n) in
                all.iter_mut().zip([c.header_errors, c.payload_errors, c.foreign, c.bytes_skipped])
            {
                *sum += n;
            }
        }
        all
    }

    pub(super) fn now(&self) -> HostTime {
        (self.medium.clock)()
    }

    /// Time that `bytes` take on the medium, ns.
    pub(crate) fn carry_ns(&self, bytes: usize) -> i64 {
        self.medium.bytes_per_s.map_or(0, |rate| (bytes as i64 * 1_000_000_000) / i64::from(rate.max(1)))
    }

    /// How long an answer to a short message may take.
    pub(crate) fn answer_ns(&self) -> i64 {
        ANSWER_NS + self.carry_ns(2000)
    }

    // --- sending ---

    /// Sends packets as they are; waits while the medium has no room.
    pub(crate) fn send_packets(&mut self, lane: Lane, packets: &[Packet<'_>]) -> R {
        let bytes: usize = packets.iter().map(Packet::wire_bytes).sum();
        let limit = self.now().plus_ns(2_000_000_000 + 2 * self.carry_ns(bytes + 4096));
        loop {
            let now = self.now();
            match self.medium.transport.send(now, lane, packets) {
                Ok(()) => break,
                Err(SendError::Failed(e)) => return Err(Stop::Lost(e)),
                Err(SendError::Busy) if now < limit => self.rest()?,
                Err(SendError::Busy) => {
                    return Err(Stop::Failed(
                        "the medium takes nothing any more: expected room within 2 s".into(),
                    ))
                }
            }
        }
        self.fed_at = self.now();
        let whole = packets.iter().filter(|p| Header::decode(p.header()).is_ok());
        self.packets_sent = self.packets_sent.wrapping_add(whole.count() as u32);
        Ok(())
    }

    /// A control message of `session`.
    pub(crate) fn say_as(&mut self, session: u32, message: &HostMessage) -> R {
        let mut payload = [0u8; MAX_CONTROL_BYTES];
        let (kind, n) = message.write(&mut payload);
        let lane = if kind == MessageType::Sync { Lane::Data } else { Lane::Control };
        let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
        self.send_packets(lane, &[packet])
    }

    /// A control message of this session.
    pub(super) fn say(&mut self, message: &HostMessage) -> R {
        self.say_as(self.session, message)
    }

    /// A message of any payload.
    pub(crate) fn say_raw(&mut self, kind: MessageType, payload: &[u8]) -> R {
        let lane = if kind == MessageType::Sync { Lane::Data } else { Lane::Control };
        let packet = Packet::new(Header::control(kind, self.session, 0), payload);
        self.send_packets(lane, &[packet])
    }

    /// An ECHO that says `stamp`.
    pub(super) fn echo(&self, stamp: u64) -> HostMessage {
        HostMessage::Echo(Echo {
            host_sent_ns: stamp,
            device_received: DeviceTicks(0),
            device_sent: DeviceTicks(0),
        })
    }

    // --- hearing ---

    /// Lets a little time pass, and hears what has arrived.
    pub(super) fn rest(&mut self) -> R {
        std::thread::sleep(Duration::from_micros(300));
        self.hear()
    }

    fn hear(&mut self) -> R {
        if (self.medium.stop)() {
            return Err(Stop::Asked);
        }
        let Self { inbox, decoders, medium, .. } = self;
        inbox.now = (medium.clock)();
        let (from, now) = (inbox.heard.len(), inbox.now);
        medium
            .transport
            .receive(now, &mut |lane, at, bytes| {
                inbox.now = at;
                decoders[lane as usize].push(bytes, inbox);
            })
            .map_err(Stop::Lost)?;
        let from = from.min(self.inbox.heard.len());
        for i in from..self.inbox.heard.len() {
            let heard = self.inbox.heard[i];
            match heard.message {
                DeviceMessage::Status(s) if heard.session == self.session => {
                    self.clock = (s.now.0, heard.at);
                    self.newest = Some(s);
                }
                DeviceMessage::Echo(e) if heard.session == self.session => {
                    self.clock = (e.device_sent.0, heard.at)
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Forgets what was heard.
    pub(super) fn forget(&mut self) -> R {
        self.hear()?;
        self.inbox.heard.clear();
        Ok(())
    }

    /// The first message for which `wanted` says something, from those not yet taken; those before it are dropped. `None` after `limit_ns`.
    pub(super) fn wait<T>(
        &mut self,
        limit_ns: i64,
        mut wanted: impl FnMut(&DeviceWord) -> Option<T>,
    ) -> R<Option<T>> {
        let end = self.now().plus_ns(limit_ns);
        loop {
            while let Some(heard) = self.inbox.heard.pop_front() {
                if let Some(found) = wanted(&heard) {
                    return Ok(Some(found));
                }
            }
            let now = self.now();
            if now >= end {
                return Ok(None);
            }
            if self.feed && self.session != 0 && now.ns_since(self.fed_at) >= FEED_NS {
                self.say(&self.echo(0))?;
            }
            self.rest()?;
        }
    }

    /// As [`ConformanceDriver::wait`], for a STATUS of this session.
    pub(crate) fn wait_status(
        &mut self,
        limit_ns: i64,
        mut wanted: impl FnMut(&Status) -> bool,
    ) -> R<Option<Status>> {
        let session = self.session;
        self.wait(limit_ns, |h| match h.message {
            DeviceMessage::Status(s) if h.session == session && wanted(&s) => Some(s),
            _ => None,
        })
    }

    /// A FAULT of any session.
    pub(crate) fn wait_fault(&mut self, limit_ns: i64, code: FaultCode) -> R<Option<Fault>> {
        self.wait(limit_ns, |h| match h.message {
            DeviceMessage::Fault(f) if f.code == code => Some(f),
            _ => None,
        })
    }

    /// The newest STATUS of this session, for what was seen instead of what was expected.
    pub(super) fn newest(&self) -> String {
        self.newest.as_ref().map_or("no STATUS".into(), super::tell)
    }

    /// Lets time pass, feeding the watchdog; what is heard is kept.
    pub(super) fn pass(&mut self, ns: i64) -> R {
        let end = self.now().plus_ns(ns);
        while self.now() < end {
            if self.feed && self.session != 0 && self.now().ns_since(self.fed_at) >= FEED_NS {
                self.say(&self.echo(0))?;
            }
            self.rest()?;
        }
        Ok(())
    }

    /// A STATUS that was made after everything sent so far had been received: SYNC asks for it, on every lane in its order, and the count of
    /// packets tells it from an earlier one.
    pub(super) fn report(&mut self) -> R<Status> {
        self.report_within(self.answer_ns())
    }

    fn report_within(&mut self, limit_ns: i64) -> R<Status> {
        self.forget()?;
        self.say(&HostMessage::Sync(self.frames_sent))?;
        let (expected, base) = (self.packets_sent, self.packets_base);
        // Of a device whose count cannot be used, the last of what comes is taken.
        let limit = if base.is_some() { limit_ns } else { limit_ns / 4 };
        let found = self.wait_status(limit, |s| {
            base.is_some_and(|base| s.packets.wrapping_sub(base).wrapping_sub(expected) as i32 >= 0)
        })?;
        if let Some(status) = found {
            return Ok(status);
        }
        match self.newest.filter(|_| base.is_none()) {
            Some(status) => {
                self.packets_base = Some(status.packets.wrapping_sub(expected));
                Ok(status)
            }
            None if base.is_some() => {
                // Perhaps the count is wrong: it is set anew by what the device says.
                self.packets_base = None;
                self.newest.ok_or_else(|| self.silent("a STATUS after SYNC"))
            }
            None => Err(self.silent("a STATUS after SYNC")),
        }
    }

    /// A failure to answer.
    pub(super) fn silent(&self, wanted: &str) -> Stop {
        Stop::Failed(format!(
            "expected {wanted}, saw none within {} ms; last: {}",
            self.answer_ns() / 1_000_000,
            self.newest()
        ))
    }
}
