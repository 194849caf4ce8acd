//! Computes capture times on the host's clock from echoes and frame stamps of a NatNet server.

use super::frame::FrameInfo;
use crate::clock_map::{ClockMap, ExchangeOutcome};
use crate::time::{DeviceTicks, HostTime};

const MS: i64 = 1_000_000;
/// Echo requests: this many quickly, the rest slowly.
const QUICK_PROBES: u32 = 20;
const QUICK_PROBE_EVERY_NS: i64 = 5 * MS;
const PROBE_EVERY_NS: i64 = 100 * MS;
/// A transmission time above this means that the server's clock stepped.
const WORST_TRANSPORT_NS: i64 = 500 * MS;
/// A server's own latency above this is implausible: the stamp means something else.
const WORST_LATENCY_NS: i64 = 1_000 * MS;

/// The clock of the server that a client is connected to.
pub(super) struct ServerClock {
    hz: u64,
    map: Option<ClockMap>,
    under_way: [Option<i64>; 8],
    next: usize,
    sent: u32,
    due: HostTime,
    answered: u64,
    doubts: u64,
}

impl ServerClock {
    pub(super) fn new() -> Self {
        Self {
            hz: 0,
            map: None,
            under_way: [None; 8],
            next: 0,
            sent: 0,
            due: HostTime(i64::MIN),
            answered: 0,
            doubts: 0,
        }
    }

    /// The map, once an echo was answered.
    pub(super) fn map(&self) -> Option<&ClockMap> {
        self.map.as_ref().filter(|m| m.is_ready())
    }

    /// Echoes answered.
    pub(super) fn answered(&self) -> u64 {
        self.answered
    }

    /// How often the stamps of a frame contradicted the map.
    pub(super) fn doubts(&self) -> u64 {
        self.doubts
    }

    /// Sets the rate of the server's clock; 0 means that it has none.
    pub(super) fn set_rate(&mut self, hz: u64, at: HostTime) {
        if hz != self.hz || self.map.is_none() {
            self.hz = hz;
            self.restart(at);
        }
    }

    /// The server is gone: the next one may be another.
    pub(super) fn forget(&mut self) {
        self.hz = 0;
        self.map = None;
    }

    fn restart(&mut self, at: HostTime) {
        self.map = ClockMap::new(self.hz).ok();
        self.under_way = [None; 8];
        (self.sent, self.due) = (0, at);
    }

    /// True when an echo request is due at `now`; [`ServerClock::note_sent`] must follow.
    pub(super) fn is_due(&self, now: HostTime) -> bool {
        self.map.is_some() && now >= self.due
    }

    /// Notes that an echo request stamped `t1` was sent.
    pub(super) fn note_sent(&mut self, t1: HostTime) {
        let quick = self.sent < QUICK_PROBES;
        self.due = t1.plus_ns(if quick { QUICK_PROBE_EVERY_NS } else { PROBE_EVERY_NS });
        self.sent = self.sent.saturating_add(1);
        self.under_way[self.next] = Some(t1.0);
        self.next = (self.next + 1) % self.under_way.len();
    }

    /// Adds an answer; false if it matches no pending request: an old or forged answer must not move the clock.
    pub(super) fn on_echo(&mut self, stamp: u64, ticks: u64, at: HostTime) -> bool {
        let t1 = stamp as i64;
        let Some(slot) = self.under_way.iter_mut().find(|s| **s == Some(t1)) else {
            return false;
        };
        *slot = None;
        self.answered += 1;
        if let Some(map) = &mut self.map {
            let ticks = DeviceTicks(ticks);
            let outcome = map.add_exchange(HostTime(t1), ticks, ticks, at);
            if matches!(outcome, ExchangeOutcome::Contradicting | ExchangeOutcome::Stepped) {
                // Send echoes quickly, to find out whether the clock stepped and to fill the new window.
                (self.sent, self.due) = (0, at);
            }
        }
        true
    }

    /// Middle of the exposure of a frame that arrived `at`: through the map if there is one, otherwise arrival less the
    /// server's own latency, which leaves out only the network delay. An arrival that is not known (`is_known`: the
    /// datagram may have waited in its socket) contradicts nothing.
    pub(super) fn captured_at(&mut self, info: &FrameInfo, at: HostTime, is_known: bool) -> HostTime {
        let has_stamps = info.mid_exposure != 0 && info.transmit >= info.mid_exposure && self.hz > 0;
        if !has_stamps {
            return at;
        }
        let ticks = u128::from(info.transmit - info.mid_exposure);
        let latency_ns = i64::try_from(ticks * 1_000_000_000 / u128::from(self.hz)).unwrap_or(i64::MAX);
        let plain = if latency_ns <= WORST_LATENCY_NS { at.plus_ns(-latency_ns) } else { at };
        let stamps = (DeviceTicks(info.transmit), DeviceTicks(info.mid_exposure));
        let Some((sent, captured)) =
            self.map().and_then(|m| Some((m.to_host(stamps.0)?, m.to_host(stamps.1)?)))
        else {
            return plain;
        };
        // Sent after it arrived, or half a second in transit: the server's clock has changed. Restart its map.
        let transport_ns = at.ns_since(sent.at);
        if transport_ns < -sent.uncertainty_ns - MS || is_known && transport_ns > WORST_TRANSPORT_NS {
            self.doubts += 1;
            self.restart(at);
            return plain;
        }
        captured.at.min(at)
    }
}
