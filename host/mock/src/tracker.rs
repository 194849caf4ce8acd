//! Turns true poses into the samples of a 500 Hz tracker: noise, latency, faults, all seeded and deterministic.
//!
//! A sample is a pure function of (seed, body, sample number); polling only decides when it is delivered. So two runs
//! that poll at different instants see the same samples.

use crate::faults::{FaultError, FaultKind, FaultPlan};
use crate::hand::Hand;
use crate::motion::{add, from_rotation_vector, multiply, normalize4, scale, Motion, Twist};
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{BodyIndex, SampleGate, Tracker, TrackerCounters, TrackerError, TrackerSample};
use std::collections::VecDeque;
use std::sync::Arc;

/// Configuration of the mock tracker. All randomness follows from `seed`.
#[derive(Clone, Debug)]
pub struct MockTrackerConfig {
    /// Seed of noise, jitter and faults.
    pub seed: u64,
    /// Samples per second and body.
    pub rate: FrameRate,
    /// Capture of sample 0, nanoseconds after `start`: the tracker's own phase. 0 to one period.
    pub phase_ns: i64,
    /// Time 0 of the motions and of the fault plan.
    pub start: HostTime,
    /// Standard deviation of the position noise on each axis, metres, 0 to 1.
    pub position_noise_m: f64,
    /// Standard deviation of the rotation noise about each axis, radians, 0 to 1.
    pub rotation_noise_rad: f64,
    /// From capture to arrival, nanoseconds, 0 to 1 s.
    pub latency_ns: i64,
    /// Added to the latency: uniform in `0..jitter`, nanoseconds, 0 to 1 s.
    pub latency_jitter_ns: i64,
    /// The faults, with times relative to `start`.
    pub faults: FaultPlan,
    /// Whether samples pass the gate that every real client has. Without it, faults reach the consumer raw, including
    /// disorder and NaN, which breaks the guarantees of [`Tracker`]: for tests of later stages.
    pub gated: bool,
}

impl Default for MockTrackerConfig {
    /// 500 Hz, 2 ms latency, no noise, no faults.
    fn default() -> Self {
        Self {
            seed: 1,
            rate: FrameRate::new(500, 1).expect("500 Hz"),
            phase_ns: 0,
            start: HostTime(0),
            position_noise_m: 0.0,
            rotation_noise_rad: 0.0,
            latency_ns: 2_000_000,
            latency_jitter_ns: 0,
            faults: FaultPlan::default(),
            gated: true,
        }
    }
}

/// Why a mock tracker cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum MockTrackerError {
    /// A number out of range.
    #[error("mock tracker: `{field}` is {value}; it must be {rule}")]
    OutOfRange {
        /// Field of [`MockTrackerConfig`].
        field: &'static str,
        /// Value given.
        value: f64,
        /// Range.
        rule: &'static str,
    },
    /// A fault that does not apply to a tracker without bytes.
    #[error(transparent)]
    Fault(#[from] FaultError),
}

/// The faults that a stream of samples (not of bytes) can have.
pub const TRACKER_FAULTS: [FaultKind; 15] = [
    FaultKind::Loss,
    FaultKind::Duplicate,
    FaultKind::Reorder,
    FaultKind::Nan,
    FaultKind::Norm,
    FaultKind::Flip,
    FaultKind::Invalid,
    FaultKind::Dropout,
    FaultKind::Stuck,
    FaultKind::Jump,
    FaultKind::Stall,
    FaultKind::Slow,
    FaultKind::Reset,
    FaultKind::Unseen,
    FaultKind::Exchange,
];

/// The samples of a set of bodies as pure functions of their number: shared by [`MockTracker`] and the network servers.
#[derive(Clone, Debug)]
pub struct SampleSource {
    config: MockTrackerConfig,
    bodies: Vec<Motion>,
    /// The body that a hand holds, in place of its motion.
    hand: Option<(BodyIndex, Arc<Hand>)>,
    draws: Draws,
}

/// The passage of one report from the tracker to its consumer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Passage {
    /// When it arrives.
    pub arrives_at: HostTime,
    /// When a second copy arrives, if one does.
    pub copy_at: Option<HostTime>,
}

impl SampleSource {
    /// Checks the configuration.
    pub fn new(config: MockTrackerConfig, bodies: Vec<Motion>) -> Result<Self, MockTrackerError> {
        let wrong = |field, value, rule| Err(MockTrackerError::OutOfRange { field, value, rule });
        let period = config.rate.slot_len_ns(0);
        if bodies.is_empty() || bodies.len() > 1024 {
            return wrong("bodies", bodies.len() as f64, "1 to 1024");
        }
        if !(0.1..=100_000.0).contains(&config.rate.hz()) {
            return wrong("rate", config.rate.hz(), "0.1 to 100,000 Hz");
        }
        if config.phase_ns < 0 || config.phase_ns > period {
            return wrong("phase_ns", config.phase_ns as f64, "0 to one sample period");
        }
        for (field, value) in
            [("position_noise_m", config.position_noise_m), ("rotation_noise_rad", config.rotation_noise_rad)]
        {
            if !(0.0..=1.0).contains(&value) {
                return wrong(field, value, "0 to 1");
            }
        }
        for (field, value) in
            [("latency_ns", config.latency_ns), ("latency_jitter_ns", config.latency_jitter_ns)]
        {
            if !(0..=1_000_000_000).contains(&value) {
                return wrong(field, value as f64, "0 to 1e9 (one second)");
            }
        }
        let draws = Draws::new(config.seed).stream(0x7261_636b);
        Ok(Self { config, bodies, hand: None, draws })
    }

    /// Puts `body` into a hand. Its samples then also depend on what the hand was told, and those that are captured before
    /// an order stay the same.
    pub fn held_by(mut self, body: BodyIndex, hand: Arc<Hand>) -> Self {
        self.hand = Some((body, hand));
        self
    }

    /// The configuration.
    pub fn config(&self) -> &MockTrackerConfig {
        &self.config
    }

    /// Replaces the faults. Samples are functions of their number, so those without a fault do not change.
    pub(crate) fn set_faults(&mut self, faults: FaultPlan) {
        self.config.faults = faults;
    }

    /// Number of bodies.
    pub fn body_count(&self) -> usize {
        self.bodies.len()
    }

    /// Capture instant of sample number `k`, nanoseconds after the start.
    pub fn captured_ns(&self, k: u64) -> i64 {
        self.config.rate.slot_start_ns(k).saturating_add(self.config.phase_ns)
    }

    /// True pose of `body` at `t_ns` after the start; `None` for an unknown body.
    pub fn true_pose(&self, body: BodyIndex, t_ns: i64) -> Option<Pose> {
        match &self.hand {
            Some((held, hand)) if *held == body => Some(hand.pose_at(t_ns)),
            _ => Some(self.bodies.get(usize::from(body.0))?.pose_at(t_ns)),
        }
    }

    /// True velocity of `body` at `t_ns` after the start, by its motion alone: what a hand does to it is not in it.
    pub fn true_twist(&self, body: BodyIndex, t_ns: i64) -> Option<Twist> {
        Some(self.bodies.get(usize::from(body.0))?.twist_at(t_ns))
    }

    /// Sample `k` of `body` as the tracker sees it, before any fault in transit; `received_at` is the capture. `None`
    /// for an unknown body.
    pub fn sample(&self, body: BodyIndex, k: u64) -> Option<TrackerSample> {
        let faults = &self.config.faults;
        let draws = self.draws.stream(u64::from(body.0));
        let (before, t) = self.instants(k);
        let strikes = |kind| faults.strikes(kind, draws, k, before, t);
        // A stuck tracker repeats the last sample before it got stuck, or its first one.
        let seen = match faults.window_start(FaultKind::Stuck, t) {
            Some(since) => self.number_before(since),
            None => k,
        };
        let mut pose = self.noisy_pose(self.labelled(body, t), seen)?;
        let jump = faults.amount(FaultKind::Jump, before, t);
        if jump != 0.0 {
            pose.position_m = add(pose.position_m, scale(jump_direction(draws), jump));
        }
        if strikes(FaultKind::Flip) {
            pose.rotation_xyzw = pose.rotation_xyzw.map(|c| -c);
        }
        let wild = draws.stream(1).bits(k);
        if strikes(FaultKind::Norm) {
            let factor = [0.0, 0.5, 1e-20][(wild % 3) as usize];
            pose.rotation_xyzw = pose.rotation_xyzw.map(|c| c * factor);
        }
        if strikes(FaultKind::Nan) {
            let value = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e38][(wild >> 8) as usize % 4];
            match (wild >> 16) as usize % 7 {
                i @ 0..=2 => pose.position_m[i] = value,
                i => pose.rotation_xyzw[i - 3] = value,
            }
        }
        let first_since_reset =
            faults.last_start(FaultKind::Reset, t).map_or(0, |r| self.number_before(r).saturating_add(1));
        Some(TrackerSample {
            body,
            pose,
            tracked: !strikes(FaultKind::Invalid) && !faults.hides(body.0 + 1, before, t),
            mean_error_m: self.config.position_noise_m as f32,
            covariance: None,
            sequence: k.saturating_sub(first_since_reset) as u32,
            captured_at: self.at(t),
            received_at: self.at(t),
        })
    }

    /// Which body bears the label of `body` at `t_ns`.
    fn labelled(&self, body: BodyIndex, t_ns: i64) -> BodyIndex {
        let is_exchanged =
            body.0 < 2 && self.bodies.len() > 1 && self.config.faults.is_on(FaultKind::Exchange, t_ns);
        BodyIndex(if is_exchanged { 1 - body.0 } else { body.0 })
    }

    /// The passage of report `k`: when it arrives, and when a second copy does. `None` if it is lost. `stream` is the
    /// body's number if each body travels alone, and 0 if one packet carries all.
    pub fn passage(&self, stream: u64, k: u64) -> Option<Passage> {
        let faults = &self.config.faults;
        let draws = self.draws.stream(stream);
        let (before, t) = self.instants(k);
        let strikes = |kind| faults.strikes(kind, draws, k, before, t);
        if faults.is_on(FaultKind::Dropout, t) || strikes(FaultKind::Loss) {
            return None;
        }
        let arrival = self.arrival_ns(draws, k, before, t);
        let copy_at =
            strikes(FaultKind::Duplicate).then(|| self.at(arrival + self.config.rate.slot_len_ns(k) / 4));
        Some(Passage { arrives_at: self.at(arrival), copy_at })
    }

    /// Whether report `k` of `stream` suffers a fault of its bytes (`corrupt`, `truncate`), and if so 64 bits to do it with.
    pub fn byte_fault(&self, kind: FaultKind, stream: u64, k: u64) -> Option<u64> {
        let (before, t) = self.instants(k);
        let draws = self.draws.stream(stream);
        let strikes = self.config.faults.strikes(kind, draws, k, before, t);
        strikes.then(|| draws.stream(6 + kind as u64).bits(k))
    }

    /// Capture of the report before `k`, and of `k`, nanoseconds after the start.
    fn instants(&self, k: u64) -> (i64, i64) {
        (if k == 0 { i64::MIN } else { self.captured_ns(k - 1) }, self.captured_ns(k))
    }

    /// Longest time from capture to arrival of any copy, nanoseconds: the required capacity of a queue.
    pub fn longest_delay_ns(&self) -> i64 {
        let c = &self.config;
        let of = |kind, value: fn(&crate::faults::Fault) -> f64| -> f64 {
            c.faults.faults().iter().filter(|f| f.kind == kind).map(value).sum()
        };
        let slow = of(FaultKind::Slow, |f| f.amount);
        let stall = of(FaultKind::Stall, |f| f.window.map_or(0.0, |w| w.length_ns as f64));
        (c.latency_ns + c.latency_jitter_ns + 2 * c.rate.slot_len_ns(0)).saturating_add((slow + stall) as i64)
    }

    fn at(&self, t_ns: i64) -> HostTime {
        self.config.start.plus_ns(t_ns)
    }

    /// Number of the last sample captured before `t_ns` (0 when there is none).
    fn number_before(&self, t_ns: i64) -> u64 {
        let k = self.config.rate.slot_at_ns(t_ns.saturating_sub(self.config.phase_ns));
        if self.captured_ns(k) < t_ns {
            k
        } else {
            k.saturating_sub(1)
        }
    }

    fn noisy_pose(&self, body: BodyIndex, k: u64) -> Option<Pose> {
        let mut pose = self.true_pose(body, self.captured_ns(k))?;
        let draws = self.draws.stream(u64::from(body.0));
        if self.config.position_noise_m > 0.0 {
            let noise = scale(draws.stream(2).normal3(k), self.config.position_noise_m);
            pose.position_m = add(pose.position_m, noise);
        }
        if self.config.rotation_noise_rad > 0.0 {
            let noise = scale(draws.stream(3).normal3(k), self.config.rotation_noise_rad);
            pose.rotation_xyzw = normalize4(multiply(from_rotation_vector(noise), pose.rotation_xyzw));
        }
        Some(pose)
    }

    fn arrival_ns(&self, draws: Draws, k: u64, before: i64, t: i64) -> i64 {
        let faults = &self.config.faults;
        let jitter = (draws.stream(4).unit(k) * self.config.latency_jitter_ns as f64) as i64;
        let slow = faults.amount(FaultKind::Slow, before, t) as i64;
        let mut arrival = t + self.config.latency_ns + jitter + slow;
        if faults.strikes(FaultKind::Reorder, draws, k, before, t) {
            // After its successor, before the next one.
            arrival += self.config.rate.slot_len_ns(k) * 3 / 2;
        }
        faults.end_of(FaultKind::Stall, arrival)
    }
}

/// A unit vector, the same for all jumps of one body.
fn jump_direction(draws: Draws) -> [f64; 3] {
    let v = draws.stream(5).normal3(0);
    let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-12);
    scale(v, 1.0 / norm)
}

/// A software tracker. Allocates when made, never when polled.
pub struct MockTracker {
    source: SampleSource,
    /// Number of the next sample to be captured.
    next: u64,
    /// Samples in flight, in order of arrival.
    pending: VecDeque<TrackerSample>,
    capacity: usize,
    gate: SampleGate,
    /// Captures that were never generated, because the consumer was away for too long or too many were in flight.
    skipped: u64,
}

impl MockTracker {
    /// Maximum number of capture instants handled in one poll; after a longer absence the older ones are skipped and
    /// counted.
    pub const MAX_CAPTURES_PER_POLL: u64 = 4096;

    /// A tracker that reports `bodies`: body `i` of the rig is `bodies[i]`.
    pub fn new(config: MockTrackerConfig, bodies: Vec<Motion>) -> Result<Self, MockTrackerError> {
        config.faults.check_supported(&TRACKER_FAULTS, "the mock tracker")?;
        let gate = SampleGate::new(bodies.len());
        let source = SampleSource::new(config, bodies)?;
        let captures = source.longest_delay_ns() / source.config.rate.slot_len_ns(0).max(1) + 4;
        let capacity = (captures as usize).saturating_mul(2 * source.bodies.len()).min(1 << 20);
        Ok(Self { source, next: 0, pending: VecDeque::with_capacity(capacity), capacity, gate, skipped: 0 })
    }

    /// True pose of `body` at `t_ns` nanoseconds after [`MockTrackerConfig::start`]: the reference for registration
    /// errors.
    pub fn true_pose(&self, body: BodyIndex, t_ns: i64) -> Option<Pose> {
        self.source.true_pose(body, t_ns)
    }

    /// True velocity of `body` at `t_ns` after the start.
    pub fn true_twist(&self, body: BodyIndex, t_ns: i64) -> Option<Twist> {
        self.source.true_twist(body, t_ns)
    }

    /// The pure function behind this tracker.
    pub fn source(&self) -> &SampleSource {
        &self.source
    }

    /// Counters of the samples so far, by outcome.
    pub fn counters(&self) -> &TrackerCounters {
        self.gate.counters()
    }

    fn enqueue(&mut self, sample: TrackerSample) {
        if self.pending.len() == self.capacity {
            self.skipped += 1;
            return;
        }
        let at = self.pending.partition_point(|s| s.received_at <= sample.received_at);
        self.pending.insert(at, sample);
    }

    /// Skips captures that are too old, and returns the number of the newest one due, if any.
    fn newest_due(&mut self, now: HostTime) -> Option<u64> {
        let since = now.ns_since(self.source.config.start).saturating_sub(self.source.config.phase_ns);
        if since < 0 {
            return None;
        }
        let newest = self.source.config.rate.slot_at_ns(since);
        if newest >= self.next + Self::MAX_CAPTURES_PER_POLL {
            let first = newest - Self::MAX_CAPTURES_PER_POLL + 1;
            self.skipped += (first - self.next) * self.source.bodies.len() as u64;
            self.next = first;
        }
        Some(newest)
    }

    fn capture(&mut self, k: u64) {
        for body in 0..self.source.bodies.len() {
            let (Some(passage), Some(sample)) =
                (self.source.passage(body as u64, k), self.source.sample(BodyIndex(body as u16), k))
            else {
                continue;
            };
            self.enqueue(TrackerSample { received_at: passage.arrives_at, ..sample });
            if let Some(received_at) = passage.copy_at {
                self.enqueue(TrackerSample { received_at, ..sample });
            }
        }
    }

    fn deliver(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> usize {
        let mut delivered = 0;
        while let Some(sample) = self.pending.front().copied().filter(|s| s.received_at <= now) {
            self.pending.pop_front();
            let passed = if self.source.config.gated { self.gate.admit(&sample) } else { Some(sample) };
            if let Some(sample) = passed {
                sink(&sample);
                delivered += 1;
            }
        }
        delivered
    }
}

impl Tracker for MockTracker {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let mut delivered = 0;
        if let Some(newest) = self.newest_due(now) {
            while self.next <= newest {
                let k = self.next;
                // Later captures cannot arrive before their capture, so samples that arrive by then may be delivered.
                // The queue then never holds more than one latency's worth, however long ago the last poll was.
                delivered += self.deliver(self.source.at(self.source.captured_ns(k)).min(now), sink);
                self.capture(k);
                self.next = k + 1;
            }
        }
        Ok(delivered + self.deliver(now, sink))
    }

    fn name(&self) -> &str {
        "mock"
    }

    fn status(&self) -> String {
        let mut text = format!("{} Hz, {}", self.source.config.rate.hz(), self.gate.counters());
        if self.skipped > 0 {
            text.push_str(&format!(", skipped {}", self.skipped));
        }
        text
    }

    fn due_at(&self) -> Option<HostTime> {
        // Nothing of a capture arrives before it.
        let captured_at = self.source.at(self.source.captured_ns(self.next));
        Some(self.pending.front().map_or(captured_at, |sample| sample.received_at.min(captured_at)))
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

#[cfg(test)]
#[path = "tracker_tests.rs"]
mod tests;
