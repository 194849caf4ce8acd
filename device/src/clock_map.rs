//! Maps a device's ticks to host time by echo exchanges, with a bound on the error.
//!
//! Method: Cristian's exchange (Distributed Computing 3, 1989). The host sends at `t1`, the device stamps `rx` and
//! `tx`, the host receives at `t4`. Whatever the delays were, the host's clock read at least `t1` when the device's
//! read `rx`, and at most `t4` when it read `tx`. Each exchange thus bounds the offset between the clocks to an
//! interval as wide as its round trip, and the shortest round trips of a short window are the most precise. The drift
//! is the slope between the best exchanges of the window's two halves.
//!
//! The error bound is `round trip / 2 + drift error * age`: it does not assume that both directions take the same time.
//! All arithmetic is in whole nanoseconds; ticks are carried in 128 bits, so neither 400 days nor a wrapping counter
//! loses a tick.

use crate::time::{DeviceTicks, HostTime};

/// Exchanges kept.
const WINDOW: usize = 64;
/// Longest age of a kept exchange, device nanoseconds.
const WINDOW_NS: i64 = 4_000_000_000;
/// Largest plausible rate difference: 1,000 ppm. Crystals stay within 200.
const MAX_SKEW_PPB: i64 = 1_000_000;
/// Largest plausible change of the rate: 1 ppm per second, in ppb per second.
const MAX_WANDER_PPB_PER_S: i64 = 1_000;
/// Number of consecutive exchanges that must contradict the map before the device's clock counts as stepped.
const STEP_RUN: usize = 3;

/// Why a clock cannot be mapped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(thiserror::Error))]
pub enum ClockMapError {
    /// The device reports that its clock does not tick, or ticks faster than any clock does.
    #[cfg_attr(
        feature = "std",
        error("the device gives its clock {0} ticks per second; 1 to 1e12 make sense")
    )]
    Frequency(u64),
    /// A tick counter of fewer than 16 or more than 64 bits.
    #[cfg_attr(feature = "std", error("a tick counter of {0} bits; 16 to 64 make sense"))]
    Bits(u32),
}

/// The outcome of an exchange.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExchangeOutcome {
    /// It joined the window.
    Used,
    /// Its stamps contradict themselves (received before sent); ignored.
    Impossible,
    /// It contradicts the map; ignored for now, and counted as evidence of a step.
    Contradicting,
    /// The third contradiction in a row: the device's clock stepped, and the map restarts from these exchanges.
    Stepped,
}

/// A host instant with the bound on its error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mapped {
    /// The instant.
    pub at: HostTime,
    /// The true instant lies within plus or minus this, nanoseconds.
    pub uncertainty_ns: i64,
}

#[derive(Clone, Copy, Default)]
struct Exchange {
    /// Device time, ns: the middle of `rx` and `tx`.
    device_ns: i64,
    /// Bounds of host minus device time, ns.
    low: i64,
    high: i64,
}

impl Exchange {
    const fn offset(&self) -> i64 {
        self.low + (self.high - self.low) / 2
    }
    const fn half_ns(&self) -> i64 {
        (self.high - self.low + 1) / 2
    }
}

/// The rate difference host over device, and its possible error at device time `at_ns`.
#[derive(Clone, Copy)]
struct Skew {
    ppb: i64,
    error_ppb: i64,
    at_ns: i64,
}

impl Skew {
    const UNKNOWN: Self = Self { ppb: 0, error_ppb: MAX_SKEW_PPB, at_ns: 0 };

    fn error_at(&self, device_ns: i64) -> i64 {
        let age_s = (device_ns - self.at_ns).unsigned_abs() / 1_000_000_000 + 1;
        let wander = MAX_WANDER_PPB_PER_S.saturating_mul(age_s as i64);
        // The true rate lies within the plausible ones, and so no farther from this one than the farther of their ends.
        self.error_ppb.saturating_add(wander).min(MAX_SKEW_PPB.saturating_add(self.ppb.saturating_abs()))
    }
}

/// The map of one device's clock. Fixed size; nothing allocates.
#[derive(Clone)]
pub struct ClockMap {
    ticks_per_second: u64,
    bits: u32,
    /// The newest tick seen, and the ticks from the first one to it, unwrapped. Device nanoseconds count from the first.
    newest_ticks: u64,
    newest_total: i128,
    started: bool,
    window: [Exchange; WINDOW],
    len: usize,
    next: usize,
    doubts: [Exchange; STEP_RUN],
    doubt_count: usize,
    skew: Skew,
    anchor: Exchange,
    steps: u32,
    /// Last answer of [`ClockMap::map_forward`].
    last: HostTime,
}

impl ClockMap {
    /// A map for a 64-bit counter of `ticks_per_second`, 1 to 1e12.
    pub fn new(ticks_per_second: u64) -> Result<Self, ClockMapError> {
        Self::with_bits(ticks_per_second, 64)
    }

    /// A map for a counter that wraps at `bits` bits, 16 to 64. Exchanges must come at least once per half a wrap.
    pub fn with_bits(ticks_per_second: u64, bits: u32) -> Result<Self, ClockMapError> {
        if ticks_per_second == 0 || ticks_per_second > 1_000_000_000_000 {
            return Err(ClockMapError::Frequency(ticks_per_second));
        }
        if !(16..=64).contains(&bits) {
            return Err(ClockMapError::Bits(bits));
        }
        Ok(Self {
            ticks_per_second,
            bits,
            newest_ticks: 0,
            newest_total: 0,
            started: false,
            window: [Exchange::default(); WINDOW],
            len: 0,
            next: 0,
            doubts: [Exchange::default(); STEP_RUN],
            doubt_count: 0,
            skew: Skew::UNKNOWN,
            anchor: Exchange::default(),
            steps: 0,
            last: HostTime(i64::MIN),
        })
    }

    /// Adds one exchange: sent at `t1`, received by the device at `rx`, answered at `tx` (equal to `rx` if the device
    /// stamps only once), received at `t4`.
    pub fn add_exchange(
        &mut self,
        t1: HostTime,
        rx: DeviceTicks,
        tx: DeviceTicks,
        t4: HostTime,
    ) -> ExchangeOutcome {
        let rx_total = self.total(rx);
        let processing = sign_extend(tx.0.wrapping_sub(rx.0), self.bits);
        let rx_ns = self.ns_of(rx_total);
        let tx_ns = self.ns_of(rx_total + processing);
        let (low, high) = (t1.0.saturating_sub(rx_ns), t4.0.saturating_sub(tx_ns));
        if t4 < t1 || tx_ns < rx_ns || high < low {
            return ExchangeOutcome::Impossible;
        }
        let exchange = Exchange { device_ns: rx_ns + (tx_ns - rx_ns) / 2, low, high };
        if self.len > 0 && self.contradicts(&exchange) {
            return self.doubt(exchange, rx, rx_total);
        }
        self.doubt_count = 0;
        self.note_newest(rx, rx_total);
        self.insert(exchange);
        self.refit();
        ExchangeOutcome::Used
    }

    /// Host time of `ticks`; `None` before the first exchange. Meant for instants near the newest exchange; the bound
    /// grows with the distance from it.
    pub fn to_host(&self, ticks: DeviceTicks) -> Option<Mapped> {
        (self.len > 0).then(|| self.map_total(self.total(ticks)))
    }

    /// Like [`ClockMap::to_host`] for a stream of stamps in order: never earlier than the previous answer, even across
    /// a refit or a step of the device's clock.
    pub fn map_forward(&mut self, ticks: DeviceTicks) -> Option<Mapped> {
        let mut mapped = self.to_host(ticks)?;
        mapped.at = mapped.at.max(self.last);
        self.last = mapped.at;
        Some(mapped)
    }

    /// Ticks that the device's clock shows at `host`, `None` before the first exchange.
    pub fn to_device(&self, host: HostTime) -> Option<DeviceTicks> {
        if self.len == 0 {
            return None;
        }
        // host = d + offset + skew (d - d0), solved for d - d0.
        let since = i128::from(host.0) - i128::from(self.anchor.device_ns) - i128::from(self.anchor.offset());
        let device_since = since * 1_000_000_000 / (1_000_000_000 + i128::from(self.skew.ppb));
        let ns = i128::from(self.anchor.device_ns) + device_since;
        let total = ns * i128::from(self.ticks_per_second) / 1_000_000_000;
        let ticks = (i128::from(self.newest_ticks) + total - self.newest_total) as u64;
        Some(DeviceTicks(ticks & mask(self.bits)))
    }

    /// True when the map holds at least one exchange.
    pub fn is_ready(&self) -> bool {
        self.len > 0
    }

    /// Exchanges in the window.
    pub fn exchanges(&self) -> usize {
        self.len
    }

    /// Host rate over device rate minus one, parts per billion, and its error bound.
    pub fn skew_ppb(&self) -> (i64, i64) {
        (self.skew.ppb, self.skew.error_at(self.anchor.device_ns))
    }

    /// Shortest round trip in the window, nanoseconds.
    pub fn min_round_trip_ns(&self) -> Option<i64> {
        self.window[..self.len].iter().map(|e| e.high - e.low).min()
    }

    /// How often the device's clock stepped.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    fn total(&self, ticks: DeviceTicks) -> i128 {
        if !self.started {
            return 0;
        }
        self.newest_total + sign_extend(ticks.0.wrapping_sub(self.newest_ticks), self.bits)
    }

    fn ns_of(&self, total: i128) -> i64 {
        let ns = (total * 1_000_000_000).div_euclid(i128::from(self.ticks_per_second));
        ns.clamp(i128::from(i64::MIN / 4), i128::from(i64::MAX / 4)) as i64
    }

    fn note_newest(&mut self, ticks: DeviceTicks, total: i128) {
        self.newest_ticks = ticks.0;
        self.newest_total = total;
        self.started = true;
    }

    fn map_total(&self, total: i128) -> Mapped {
        let ns = self.ns_of(total);
        let age = ns.saturating_sub(self.anchor.device_ns);
        let offset = self.anchor.offset().saturating_add(per_billion(age, self.skew.ppb));
        Mapped { at: HostTime(ns.saturating_add(offset)), uncertainty_ns: self.bound(ns) }
    }

    /// Error bound of the map at device time `ns`.
    fn bound(&self, ns: i64) -> i64 {
        let age = ns.saturating_sub(self.anchor.device_ns).saturating_abs();
        let tick_ns = (1_000_000_000 / self.ticks_per_second) as i64 + 1;
        let drift = per_billion(age, self.skew.error_at(ns)).saturating_add(1);
        self.anchor.half_ns().saturating_add(tick_ns).saturating_add(drift)
    }

    fn contradicts(&self, e: &Exchange) -> bool {
        let predicted = self
            .anchor
            .offset()
            .saturating_add(per_billion(e.device_ns.saturating_sub(self.anchor.device_ns), self.skew.ppb));
        let bound = self.bound(e.device_ns);
        e.high < predicted.saturating_sub(bound) || e.low > predicted.saturating_add(bound)
    }

    fn doubt(&mut self, e: Exchange, ticks: DeviceTicks, total: i128) -> ExchangeOutcome {
        self.doubts[self.doubt_count] = e;
        self.doubt_count += 1;
        if self.doubt_count < STEP_RUN {
            return ExchangeOutcome::Contradicting;
        }
        self.doubt_count = 0;
        self.len = 0;
        self.next = 0;
        self.steps = self.steps.saturating_add(1);
        // The rate survives a step (the crystal is the same), but with a larger error: a restarted server may be
        // another machine.
        self.skew = Skew::UNKNOWN;
        self.note_newest(ticks, total);
        let doubts = self.doubts;
        for d in doubts {
            // The contradicting exchanges may disagree among themselves (the clock stepped between them): keep those
            // that fit the newest.
            let slack =
                per_billion((e.device_ns - d.device_ns).saturating_abs(), MAX_SKEW_PPB).saturating_add(1);
            if d.low <= e.high.saturating_add(slack) && e.low <= d.high.saturating_add(slack) {
                self.insert(d);
            }
        }
        self.refit();
        ExchangeOutcome::Stepped
    }

    fn insert(&mut self, e: Exchange) {
        self.window[self.next] = e;
        self.next = (self.next + 1) % WINDOW;
        self.len = (self.len + 1).min(WINDOW);
        // Drop exchanges that are too old; the newest always stays. The order inside the window matters only for the
        // ring's head.
        let newest = e.device_ns;
        let mut kept = [Exchange::default(); WINDOW];
        let mut n = 0;
        for i in 0..self.len {
            let x = self.window[(self.next + WINDOW - self.len + i) % WINDOW];
            if newest.saturating_sub(x.device_ns) <= WINDOW_NS {
                kept[n] = x;
                n += 1;
            }
        }
        self.window = kept;
        self.len = n;
        self.next = n % WINDOW;
    }

    /// New rate and anchor from the window, which is in order of arrival.
    fn refit(&mut self) {
        let window = &self.window[..self.len];
        let newest = window.iter().map(|e| e.device_ns).max().unwrap_or(0);
        let oldest = window.iter().map(|e| e.device_ns).min().unwrap_or(0);
        let middle = oldest + (newest - oldest) / 2;
        let best = |late: bool| {
            let half = window.iter().filter(|e| (e.device_ns > middle) == late);
            half.min_by_key(|e| e.half_ns())
        };
        if let (Some(a), Some(b)) = (best(false), best(true)) {
            let span = b.device_ns - a.device_ns;
            if span > 0 {
                let slope = |d: i64| (i128::from(d) * 1_000_000_000 / i128::from(span)) as i64;
                let error_ppb = slope(a.half_ns() + b.half_ns() + 2).saturating_add(wander_over(span));
                let candidate =
                    Skew { ppb: slope(b.offset() - a.offset()), error_ppb, at_ns: a.device_ns + span / 2 };
                // A good old slope is better than a new one from a bad period (stalls, few exchanges).
                if candidate.error_at(newest) <= self.skew.error_at(newest)
                    && candidate.ppb.abs() <= MAX_SKEW_PPB
                {
                    self.skew = candidate;
                }
            }
        }
        let error = self.skew.error_at(newest);
        let cost = |e: &Exchange| e.half_ns().saturating_add(per_billion(newest - e.device_ns, error));
        if let Some(anchor) = window.iter().min_by_key(|e| cost(e)) {
            self.anchor = *anchor;
        }
    }
}

/// Change of the rate over `span_ns`, ppb.
fn wander_over(span_ns: i64) -> i64 {
    (i128::from(MAX_WANDER_PPB_PER_S) * i128::from(span_ns) / 1_000_000_000) as i64 + 1
}

fn per_billion(ns: i64, ppb: i64) -> i64 {
    // Every exchange asks this for the whole window, where the product nearly always fits: a division of 128 bits takes
    // several times as long.
    match ns.checked_mul(ppb) {
        Some(product) => product / 1_000_000_000,
        None => (i128::from(ns) * i128::from(ppb) / 1_000_000_000) as i64,
    }
}

const fn mask(bits: u32) -> u64 {
    if bits == 64 {
        u64::MAX
    } else {
        (1 << bits) - 1
    }
}

/// A difference of wrapping counters as a signed number.
fn sign_extend(difference: u64, bits: u32) -> i128 {
    let shift = 64 - bits;
    i128::from(((difference << shift) as i64) >> shift)
}

#[cfg(test)]
#[path = "clock_map_tests.rs"]
mod tests;
