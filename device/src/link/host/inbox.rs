//! Collects the device's packets: the newest message of each kind.

use super::types::EchoSample;
use crate::link::message::{Assembly, DeviceHello, DeviceMessage, Fault, Status};
use crate::packet::Header;
use crate::packet::PacketSink;
use crate::time::HostTime;

/// Echo answers kept for the caller.
pub(super) const ECHOES_KEPT: usize = 16;

/// The newest of everything that the device sent.
#[derive(Debug)]
pub(super) struct Inbox {
    /// Arrival time of the bytes that are being read.
    pub arrived_at: HostTime,
    pub session: u32,
    pub assembly: Option<Assembly>,
    pub hello: Option<DeviceHello>,
    pub status: Option<Status>,
    pub fault: Option<Fault>,
    pub device_forgot: bool,
    /// Arrival of the newest message of this session.
    pub heard_at: HostTime,
    pub echoes: [Option<EchoSample>; ECHOES_KEPT],
    pub next_echo: usize,
    /// Start of the newest answered exchange.
    pub echo_answered: HostTime,
    pub ignored: u64,
    pub damaged: u64,
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
            // The host's own question, from a line that echoes. As an answer it would be the quickest of all, and wrong.
            Ok(DeviceMessage::Echo(echo)) if !echo.is_answer() => self.ignored += 1,
            Ok(message) if header.session == self.session => self.apply(&message),
            // The device lost its power or its memory: it answers, but does not know this session.
            Ok(DeviceMessage::Status(_)) if header.session == 0 => {
                self.device_forgot = true;
            }
            _ => self.ignored += 1,
        }
    }
}

impl Inbox {
    pub(super) const fn new() -> Self {
        Self {
            arrived_at: HostTime(i64::MIN),
            session: 0,
            assembly: None,
            hello: None,
            status: None,
            fault: None,
            device_forgot: false,
            heard_at: HostTime(i64::MIN),
            echoes: [None; ECHOES_KEPT],
            next_echo: 0,
            echo_answered: HostTime(i64::MIN),
            ignored: 0,
            damaged: 0,
        }
    }

    /// Forgets the old session and listens to `session`.
    pub(super) fn open(&mut self, session: u32) {
        let (ignored, damaged) = (self.ignored, self.damaged);
        *self = Self { session, ignored, damaged, ..Self::new() };
    }

    fn apply(&mut self, message: &DeviceMessage) {
        self.heard_at = self.arrived_at;
        match message {
            DeviceMessage::Hello(h) => self.hello = Some(*h),
            DeviceMessage::Status(s) => {
                // An older status that arrived late would take credit back.
                if self.status.is_some_and(|last| last.now > s.now) {
                    self.ignored += 1;
                } else {
                    self.status = Some(*s);
                }
            }
            DeviceMessage::Echo(e) => {
                let sent_at = HostTime(e.host_sent_ns as i64);
                if sent_at > self.arrived_at || e.device_sent < e.device_received {
                    self.ignored += 1;
                    return;
                }
                self.echoes[self.next_echo % ECHOES_KEPT] = Some(EchoSample {
                    host_sent_at: sent_at,
                    device_received_at: e.device_received,
                    device_sent_at: e.device_sent,
                    host_received_at: self.arrived_at,
                });
                self.next_echo += 1;
                self.echo_answered = sent_at;
            }
            DeviceMessage::Fault(f) => self.fault = Some(*f),
        }
    }
}
