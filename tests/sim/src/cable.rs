//! The cable between host and projector: two lanes there, one back, with a speed, a delay, and faults. Where the
//! projector hangs on a serial line, the bytes are on [`crate::line`] instead.

use crate::calls::Calls;
use crate::dice::Dice;
use crate::guard::{darkens, freezes, stretched};
use crate::line::{Echo, SerialLine};
use dpm_device::link::Packet;
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, SendError, Transport, TransportError};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Bytes of frames that the host's side holds before it refuses more, in frames.
const FRAMES_QUEUED: usize = 2;
/// Replies that wait for the host; older ones are lost.
const REPLIES_QUEUED: usize = 256;

/// How the cable and the port behave at present.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CableFaults {
    /// The device takes nothing on the data lane (an endpoint is halted, or it answers NAK).
    pub stalled: bool,
    /// It is slower by this factor, in thousandths; 0: full speed.
    pub slow_milli: i64,
    /// A byte of frames takes so many more picoseconds.
    pub crawl_ps: i64,
    /// Share of packets to the device that are damaged.
    pub corrupt: f64,
    /// Share of packets to the device that are lost.
    pub loss: f64,
    /// Share of packets to the device that arrive twice.
    pub twice: f64,
    /// Share of transfers to the device that end too early.
    pub short: f64,
    /// Share of replies that are damaged or followed by other bytes.
    pub babble: f64,
    /// Share of replies that are an old one again.
    pub stale: f64,
    /// The port cannot be opened.
    pub denied: bool,
    /// Packets on the control lane to the device arrive so much later.
    pub control_late_ns: i64,
    /// Of a serial line: who hears itself.
    pub echo: Echo,
    /// Of a serial line: nothing arrives at either end, while the port stays open.
    pub silent: bool,
    /// Of a serial line: its ends run at different rates.
    pub garbled: bool,
}

/// How often each fault of the cable had an effect.
#[derive(Clone, Copy, Debug, Default)]
pub struct CableEffects {
    /// It was pulled out of a port.
    pub pulls: u64,
    /// The port was not opened.
    pub denied: u64,
    /// Frames were refused.
    pub stalled: u64,
    /// Bytes took longer.
    pub slowed: u64,
    /// Frames waited for one before them, of those that crawl.
    pub crawled: u64,
    /// Transfers ended too early.
    pub short: u64,
    /// Replies were damaged.
    pub babble: u64,
    /// Old replies came again.
    pub stale: u64,
    /// Packets were damaged, lost or doubled.
    pub spoiled: u64,
    /// Packets of the control lane were late.
    pub late: u64,
    /// Orders to go dark were lost.
    pub orders: u64,
    /// Bytes travelled on a serial line that has a fault.
    pub on_line: u64,
}

/// Bytes on their way.
#[derive(Debug)]
pub struct Transfer {
    /// True time of its arrival.
    pub at: i64,
    /// Which lane.
    pub lane: Lane,
    /// The bytes.
    pub bytes: Vec<u8>,
    /// It ended too early.
    pub cut: bool,
}

/// State of the cable, shared by the world and the host's end.
#[derive(Debug)]
pub struct Cable {
    /// True time.
    pub now: i64,
    /// True time minus the host's clock.
    pub host_lag: i64,
    /// The device is plugged in.
    pub plugged: bool,
    /// Counts plugs: an end that was opened before is dead.
    pub plug: u64,
    /// Nanoseconds for a byte of a frame.
    pub ns_per_byte: i64,
    /// Travel time of any transfer.
    pub travel_ns: i64,
    /// The faults.
    pub faults: CableFaults,
    /// The program's calls to it.
    pub calls: Calls,
    /// Where it is a serial line.
    pub line: Option<SerialLine>,
    /// To the device.
    pub out: VecDeque<Transfer>,
    /// To the host: when each arrives.
    back: VecDeque<(i64, Vec<u8>)>,
    old_reply: Vec<u8>,
    free_at: i64,
    /// The control lane keeps the order of its packets. Without tracks they are so few that it does not matter.
    pub keeps_order: bool,
    /// Then: when its last packet arrives.
    control_at: i64,
    /// Packets to the device may have been lost, doubled or damaged since this was looked at.
    pub disturbed: bool,
    dice: Dice,
    spare: Vec<Vec<u8>>,
    /// What its faults did.
    pub met: CableEffects,
    /// Light of frames ends so many ticks later than the host says.
    pub stretch: u64,
    /// So many of the next orders to go dark are lost.
    pub loses_orders: u32,
    /// The most transfers that ever waited in either direction.
    pub longest: usize,
}

impl Cable {
    /// A cable that is plugged in.
    pub fn new(seed: u64, ns_per_byte: i64, travel_ns: i64) -> Self {
        Self {
            now: 0,
            host_lag: 0,
            plugged: true,
            plug: 1,
            ns_per_byte,
            travel_ns,
            faults: CableFaults::default(),
            calls: Calls::default(),
            line: None,
            out: VecDeque::new(),
            back: VecDeque::new(),
            old_reply: Vec::new(),
            free_at: 0,
            keeps_order: false,
            control_at: 0,
            disturbed: false,
            dice: Dice::new(seed, 0xcab1e),
            spare: Vec::new(),
            stretch: 0,
            loses_orders: 0,
            met: CableEffects::default(),
            longest: 0,
        }
    }

    /// When the next transfer reaches the device.
    pub fn due(&self) -> i64 {
        match &self.line {
            Some(line) => line.due(&self.faults),
            None => self.out.front().map_or(i64::MAX, |t| t.at),
        }
    }

    /// It is `now`.
    pub fn advance(&mut self, now: i64) {
        self.now = now;
        if let Some(line) = &mut self.line {
            let carried = line.carry(now, &self.faults, self.plugged);
            self.met.on_line += u64::from(carried && self.faults != CableFaults::default());
            self.longest = self.longest.max(line.pieces());
        }
    }

    /// The next transfer that has reached the device.
    pub fn arrived(&mut self) -> Option<Transfer> {
        if let Some(line) = &mut self.line {
            let (at, bytes) = line.arrived(self.now)?;
            return Some(Transfer { at, lane: Lane::Data, bytes, cut: false });
        }
        if self.out.front()?.at > self.now {
            return None;
        }
        self.out.pop_front()
    }

    /// Takes a transfer's memory back.
    pub fn recycle(&mut self, mut bytes: Vec<u8>) {
        bytes.clear();
        if self.spare.len() < 64 {
            self.spare.push(bytes);
        }
    }

    fn memory(&mut self) -> Vec<u8> {
        self.spare.pop().unwrap_or_default()
    }

    /// The device sends a reply.
    pub fn reply(&mut self, packet: &[u8]) {
        let mut bytes = self.memory();
        bytes.extend_from_slice(packet);
        if self.faults.babble > 0.0 && self.dice.happens(self.faults.babble) {
            self.met.babble += 1;
            let at = self.dice.bits() as usize % bytes.len();
            bytes[at] ^= (self.dice.bits() as u8).max(1);
            for _ in 0..self.dice.bits() % 40 {
                let byte = self.dice.bits() as u8;
                bytes.push(byte);
            }
        }
        let at = self.now + self.travel_ns;
        if self.faults.stale > 0.0 && self.dice.happens(self.faults.stale) && !self.old_reply.is_empty() {
            self.met.stale += 1;
            let again = self.old_reply.clone();
            self.back.push_back((at, again));
        }
        if self.old_reply.is_empty() || self.faults.stale > 0.0 && self.dice.happens(0.2) {
            self.old_reply.clear();
            self.old_reply.extend_from_slice(packet);
        }
        self.back.push_back((at, bytes));
        if self.back.len() > REPLIES_QUEUED {
            self.back.pop_front();
        }
        self.longest = self.longest.max(self.back.len());
    }

    /// The plug is pulled: everything on its way is lost.
    pub fn pull(&mut self) {
        self.met.pulls += u64::from(self.plugged);
        self.plugged = false;
        self.disturbed = true;
        self.out.clear();
        self.back.clear();
        if let Some(line) = &mut self.line {
            line.pull(self.now);
        }
    }

    /// It is plugged in again.
    pub fn push_in(&mut self) {
        self.plugged = true;
        self.plug += 1;
        self.free_at = self.now;
    }

    fn frames_queued(&self) -> usize {
        self.out.iter().filter(|t| t.lane == Lane::Data).count()
    }

    /// Puts the packets of one call on the cable.
    fn send(&mut self, lane: Lane, packets: &[Packet<'_>]) {
        let mut bytes = self.memory();
        let faults = self.faults;
        let is_bad = faults.corrupt > 0.0 || faults.loss > 0.0 || faults.twice > 0.0;
        self.disturbed |= is_bad || faults.short > 0.0;
        let mut is_lost = false;
        for packet in packets {
            let from = bytes.len();
            if self.loses_orders > 0 && freezes(packet) {
                // Nothing but such an order ends a held picture: from now on they are repeated in time.
                self.loses_orders = self.loses_orders.min(2);
            }
            if self.loses_orders > 0 && darkens(packet) {
                self.loses_orders -= 1;
                self.met.orders += 1;
                is_lost = true;
                continue;
            }
            let told = (self.stretch > 0).then(|| stretched(packet, self.stretch)).flatten();
            bytes.extend(told.unwrap_or_else(|| packet.to_vec()));
            if !is_bad {
                continue;
            }
            if self.dice.happens(faults.loss) {
                self.met.spoiled += 1;
                bytes.truncate(from);
                continue;
            }
            let end = bytes.len();
            if self.dice.happens(faults.twice) {
                self.met.spoiled += 1;
                bytes.extend_from_within(from..end);
            }
            if self.dice.happens(faults.corrupt) {
                self.met.spoiled += 1;
                let at = from + self.dice.bits() as usize % (end - from);
                bytes[at] ^= 1 << (self.dice.bits() % 8);
            }
        }
        if bytes.is_empty() && is_lost {
            return self.recycle(bytes);
        }
        let mut cut = false;
        if self.dice.happens(faults.short) && !bytes.is_empty() {
            let len = self.dice.bits() as usize % bytes.len();
            bytes.truncate(len);
            cut = true;
            self.met.short += 1;
        }
        let mut ns = bytes.len() as i64 * self.ns_per_byte;
        if faults.slow_milli > 0 {
            ns = ns * faults.slow_milli / 1000;
            self.met.slowed += 1;
        }
        let begin = self.now.max(if lane == Lane::Data { self.free_at } else { 0 });
        if lane == Lane::Data && faults.crawl_ps > 0 {
            ns += bytes.len() as i64 * faults.crawl_ps / 1000;
            self.met.crawled += u64::from(begin > self.now);
        }
        let mut at = begin + ns + self.travel_ns;
        if lane == Lane::Data {
            self.free_at = begin + ns;
        } else if self.keeps_order {
            // What was late holds up what follows it.
            at = (at + faults.control_late_ns).max(self.control_at);
            self.control_at = at;
            self.met.late += u64::from(faults.control_late_ns > 0);
        }
        let place = self.out.partition_point(|t| t.at <= at);
        self.out.insert(place, Transfer { at, lane, bytes, cut });
        self.longest = self.longest.max(self.out.len());
    }
}

/// Locks the shared state; nothing panics while it holds the lock, and if it did, the run is over anyway.
pub fn lock<T>(shared: &Arc<Mutex<T>>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The host's end.
pub struct HostEnd {
    cable: Arc<Mutex<Cable>>,
    plug: u64,
}

impl HostEnd {
    /// Opens the cable.
    ///
    /// # Errors
    /// It is not plugged in, or may not be opened.
    pub fn open(cable: &Arc<Mutex<Cable>>) -> Result<Self, TransportError> {
        let mut end = Self { cable: cable.clone(), plug: 0 };
        end.reopen()?;
        Ok(end)
    }
}

fn unplugged() -> TransportError {
    TransportError::Unplugged { device: NAME.into() }
}

const NAME: &str = "simulated cable";

impl Transport for HostEnd {
    fn send(&mut self, _: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        let mut cable = lock(&self.cable);
        if cable.calls.fails() || !cable.plugged || cable.plug != self.plug {
            return Err(SendError::Failed(unplugged()));
        }
        if lane == Lane::Data && (cable.faults.stalled || cable.frames_queued() >= FRAMES_QUEUED) {
            cable.met.stalled += u64::from(cable.faults.stalled);
            return Err(SendError::Busy);
        }
        cable.send(lane, packets);
        Ok(())
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        let mut cable = lock(&self.cable);
        cable.met.stalled += u64::from(lane == Lane::Data && cable.faults.stalled);
        lane == Lane::Control || !cable.faults.stalled && cable.frames_queued() < FRAMES_QUEUED
    }

    fn flush_output(&mut self) {
        let mut cable = lock(&self.cable);
        let (now, free_at) = (cable.now, cable.free_at);
        cable.disturbed = true;
        // The transfer that is being carried ends here, cut off; what waits behind it is discarded.
        cable.out.retain(|t| t.at <= now);
        cable.free_at = free_at.min(now);
    }

    fn receive(
        &mut self,
        _: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        let mut cable = lock(&self.cable);
        if cable.calls.fails() || !cable.plugged || cable.plug != self.plug {
            return Err(unplugged());
        }
        while cable.back.front().is_some_and(|(at, _)| *at <= cable.now) {
            let Some((at, bytes)) = cable.back.pop_front() else { break };
            sink(Lane::Control, HostTime(at - cable.host_lag), &bytes);
            cable.recycle(bytes);
        }
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), TransportError> {
        let mut cable = lock(&self.cable);
        if cable.faults.denied {
            cable.met.denied += 1;
            return Err(TransportError::InUse { device: NAME.into() });
        }
        if cable.calls.fails() || !cable.plugged {
            return Err(TransportError::NotFound { device: NAME.into() });
        }
        self.plug = cable.plug;
        cable.back.clear();
        Ok(())
    }

    fn name(&self) -> &str {
        NAME
    }
}
