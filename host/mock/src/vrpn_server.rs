//! Sends true poses as VRPN messages: the server's side of one connection as a state machine, and the samples of all
//! connections.

use crate::faults::{FaultError, FaultKind, FaultPlan};
use crate::report_queue::ReportQueue;
use crate::tracker::SampleSource;
use dpm_device::time::HostTime;
use dpm_device::tracker::vrpn::wire::{self, system, type_name, Message, COOKIE, COOKIE_BYTES};
use dpm_device::tracker::BodyIndex;

/// The faults of a VRPN server. A stream loses no bytes, so a lost or overtaken report is one that was not sent, or
/// late.
pub const VRPN_FAULTS: [FaultKind; 18] = FaultKind::ALL;

/// Number of the pose type on our side; ping and pong follow.
const POS_QUAT: i32 = 0;
const PING: i32 = 1;
const PONG: i32 = 2;
/// Maximum number of senders and types that a client may describe.
const MAX_NUMBERS: usize = 1024;

/// Names of the server's devices, and where each body appears.
#[derive(Clone, Debug)]
pub struct VrpnNames {
    /// Name of the one tracker whose sensors are the bodies.
    pub tracker: String,
    /// Names of the bodies; with `each_body` set, each is also a tracker of its own with sensor 0.
    pub bodies: Vec<String>,
    /// See `bodies`.
    pub each_body: bool,
}

/// One client's connection: bytes in, bytes out.
pub struct VrpnConnection {
    /// The client's numbers of our senders: the index is theirs, the value ours.
    their_senders: Vec<Option<i32>>,
    their_ping: Option<i32>,
    greeted: bool,
    pending: Vec<u8>,
    sequence: u32,
    pongs: u64,
}

impl VrpnConnection {
    /// Maximum number of bytes kept of an incomplete message; a client that sends more is cut off.
    const MAX_PENDING: usize = wire::HEADER_BYTES + wire::MAX_PAYLOAD + 8;

    /// A newly accepted connection; appends the greeting and the names to `out`.
    pub fn new(names: &VrpnNames, out: &mut Vec<u8>) -> Self {
        out.extend_from_slice(&COOKIE);
        for (number, name) in
            [(POS_QUAT, type_name::POS_QUAT), (PING, type_name::PING), (PONG, type_name::PONG)]
        {
            wire::put_description(out, system::TYPE, number, name);
        }
        for (number, name) in (0..).zip(senders(names)) {
            wire::put_description(out, system::SENDER, number, name);
        }
        Self {
            their_senders: Vec::new(),
            their_ping: None,
            greeted: false,
            pending: Vec::new(),
            sequence: 0,
            pongs: 0,
        }
    }

    /// True once the client has greeted: poses may follow.
    pub fn is_greeted(&self) -> bool {
        self.greeted
    }

    /// Pings answered.
    pub fn pongs(&self) -> u64 {
        self.pongs
    }

    /// Handles bytes of the client and appends answers to `out`. `wall_us` is the server's clock. On an error, close
    /// the connection.
    pub fn on_bytes(
        &mut self,
        names: &VrpnNames,
        bytes: &[u8],
        wall_us: u64,
        out: &mut Vec<u8>,
    ) -> Result<(), wire::VrpnError> {
        self.pending.extend_from_slice(bytes);
        let mut pending = std::mem::take(&mut self.pending);
        let mut start = 0;
        if !self.greeted {
            let Some(cookie) = pending.first_chunk::<COOKIE_BYTES>() else {
                self.pending = pending;
                return Ok(());
            };
            wire::check_cookie(cookie)?;
            self.greeted = true;
            start = COOKIE_BYTES;
        }
        while let Some((message, used)) = wire::split(&pending[start..])? {
            self.on_message(names, &message, wall_us, out)?;
            start += used;
        }
        pending.drain(..start);
        debug_assert!(pending.len() < Self::MAX_PENDING, "split refuses longer messages");
        self.pending = pending;
        Ok(())
    }

    fn on_message(
        &mut self,
        names: &VrpnNames,
        message: &Message<'_>,
        wall_us: u64,
        out: &mut Vec<u8>,
    ) -> Result<(), wire::VrpnError> {
        match message.kind {
            system::SENDER => {
                let name = wire::described_name(message.payload)?;
                let ours = senders(names).position(|n| n.as_bytes() == name).map(|i| i as i32);
                if let Some(theirs) = usize::try_from(message.sender).ok().filter(|n| *n < MAX_NUMBERS) {
                    if self.their_senders.len() <= theirs {
                        self.their_senders.resize(theirs + 1, None);
                    }
                    self.their_senders[theirs] = ours;
                }
            }
            system::TYPE => {
                let is_ping = wire::described_name(message.payload)? == type_name::PING.as_bytes();
                self.their_ping = if is_ping { Some(message.sender) } else { self.their_ping };
            }
            kind if Some(kind) == self.their_ping => {
                let ours = usize::try_from(message.sender).ok().and_then(|s| *self.their_senders.get(s)?);
                if let Some(sender) = ours {
                    self.pongs += 1;
                    self.put(out, sender, PONG, wall_us, &[]);
                }
            }
            _ => {}
        }
        Ok(())
    }

    fn put(&mut self, out: &mut Vec<u8>, sender: i32, kind: i32, stamp_us: u64, payload: &[u8]) {
        let message = Message {
            seconds: (stamp_us / 1_000_000) as u32,
            microseconds: (stamp_us % 1_000_000) as u32,
            sender,
            kind,
            sequence: self.sequence,
            payload,
        };
        self.sequence = self.sequence.wrapping_add(1);
        wire::put(out, &message);
    }
}

/// Names of all senders in the order of their numbers.
fn senders(names: &VrpnNames) -> impl Iterator<Item = &str> {
    let bodies = names.bodies.iter().filter(|_| names.each_body).map(String::as_str);
    std::iter::once(names.tracker.as_str()).chain(bodies)
}

/// The reports of all bodies as they become due.
pub struct VrpnReports {
    source: SampleSource,
    queue: ReportQueue,
}

impl VrpnReports {
    /// Reports of `source`. Bodies that the source marks as not tracked are not reported, as VRPN servers do.
    pub fn new(source: SampleSource) -> Result<Self, FaultError> {
        source.config().faults.check_supported(&VRPN_FAULTS, "the VRPN server")?;
        Ok(Self { source, queue: ReportQueue::new() })
    }

    /// From now on the server has these faults, with times relative to the source's start.
    pub fn set_faults(&mut self, faults: FaultPlan) {
        self.source.set_faults(faults);
    }

    /// The server begins at `now`: what was captured before is never sent.
    pub fn begin_at(&mut self, now: HostTime) {
        let _ = self.queue.take_due(&self.source, now);
    }

    /// The source of the poses.
    pub fn source(&self) -> &SampleSource {
        &self.source
    }

    /// When the next report is due, at the latest.
    pub fn next_due(&self) -> HostTime {
        self.queue.next_due(&self.source)
    }

    /// Numbers of the reports due by `now`, in order; each is returned once.
    pub fn take_due(&mut self, now: HostTime) -> Vec<u64> {
        self.queue.take_due(&self.source, now).to_vec()
    }

    /// Appends report `k` to `out` for `connection`. `wall_us_at` converts a host time to the server's clock,
    /// microseconds. Returns false if the plan truncates this report; close the connection after it.
    pub fn put_report(
        &self,
        k: u64,
        names: &VrpnNames,
        connection: &mut VrpnConnection,
        wall_us_at: &dyn Fn(HostTime) -> u64,
        out: &mut Vec<u8>,
    ) -> bool {
        let start = out.len();
        for body in 0..names.bodies.len() {
            let Some(sample) = self.source.sample(BodyIndex(body as u16), k).filter(|s| s.tracked) else {
                continue;
            };
            let stamp = wall_us_at(sample.captured_at);
            connection.put(out, 0, POS_QUAT, stamp, &wire::encode_pos_quat(body as i32, &sample.pose));
            if names.each_body {
                connection.put(
                    out,
                    body as i32 + 1,
                    POS_QUAT,
                    stamp,
                    &wire::encode_pos_quat(0, &sample.pose),
                );
            }
        }
        let length = out.len() - start;
        if let (Some(bits), true) = (self.source.byte_fault(FaultKind::Corrupt, 0, k), length > 0) {
            out[start + bits as usize % length] ^= ((bits >> 32) as u8).max(1);
        }
        if let (Some(bits), true) = (self.source.byte_fault(FaultKind::Truncate, 0, k), length > 0) {
            out.truncate(start + bits as usize % length);
            return false;
        }
        true
    }
}
