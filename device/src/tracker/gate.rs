//! Admits decoded samples that may be used: finite, rigid, in capture order, each once. The rest are counted by reason.
//!
//! Every [`super::Tracker`] of this project ends in one gate, which is the only implementation of the trait's
//! guarantees and of the law *received = used + dropped by reason*.

use super::{BodyIndex, TrackerSample};
use crate::pose::Pose;
use crate::time::HostTime;

/// Counts of datagrams or stream messages by outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PacketCounters {
    /// All that arrived.
    pub received: u64,
    /// Understood and used.
    pub used: u64,
    /// Not from the configured address.
    pub foreign_source: u64,
    /// From the configured address, but from a port that the server does not send from.
    pub foreign_port: u64,
    /// Inconsistent: lengths, counts, checksums, terminators.
    pub malformed: u64,
    /// Of a version or kind that this client does not speak or did not ask for.
    pub unsupported: u64,
}

impl PacketCounters {
    /// Sum of all reasons for not using a packet.
    pub const fn dropped(&self) -> u64 {
        self.foreign_source + self.foreign_port + self.malformed + self.unsupported
    }
}

/// Counts of samples of single bodies by outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampleCounters {
    /// All that were decoded.
    pub received: u64,
    /// Passed on (including those marked as not tracked).
    pub used: u64,
    /// Of a body that the rig does not know.
    pub unknown_body: u64,
    /// Already seen: same sequence number and capture instant.
    pub duplicate: u64,
    /// Captured before a sample that was already passed on.
    pub late: u64,
    /// Of unknown age: they had waited in a serial port before the first echo, or the sender's clock contradicts their
    /// arrival, and no echo has told yet which of both is wrong.
    pub unknown_age: u64,
    /// With NaN or infinite numbers.
    pub not_finite: u64,
    /// Farther than [`SampleGate::REACH_M`] from the origin.
    pub out_of_reach: u64,
    /// With a quaternion whose norm is not within [`SampleGate::NORM_TOLERANCE`] of 1.
    pub bad_rotation: u64,
}

impl SampleCounters {
    /// Sum of all reasons for not using a sample.
    pub const fn dropped(&self) -> u64 {
        self.unknown_body
            + self.duplicate
            + self.late
            + self.unknown_age
            + self.not_finite
            + self.out_of_reach
            + self.bad_rotation
    }
}

/// Counters of a tracker since it was made. Counters only grow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrackerCounters {
    /// Packets; all zero for trackers without packets.
    pub packets: PacketCounters,
    /// Samples of single bodies.
    pub samples: SampleCounters,
    /// Of the used samples, those that the tracker marked as not seen.
    pub untracked: u64,
    /// Samples that are missing according to their sequence numbers (gaps up to [`SampleGate::MAX_GAP`]).
    pub lost: u64,
    /// Restarts of a body's sequence or clock.
    pub restarts: u64,
    /// Episodes in which a body that had moved repeated the same pose bit for bit.
    pub stuck: u64,
}

impl TrackerCounters {
    /// The conservation law: received = used + dropped by reason, for packets and for samples.
    pub const fn is_conserved(&self) -> bool {
        self.packets.received == self.packets.used + self.packets.dropped()
            && self.samples.received == self.samples.used + self.samples.dropped()
    }
}

impl core::fmt::Display for TrackerCounters {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (p, s) = (&self.packets, &self.samples);
        write!(f, "samples {} used of {}", s.used, s.received)?;
        let reasons = [
            ("packets received", p.received),
            ("from elsewhere", p.foreign_source),
            ("from another port", p.foreign_port),
            ("malformed", p.malformed),
            ("unsupported", p.unsupported),
            ("unknown body", s.unknown_body),
            ("duplicate", s.duplicate),
            ("late", s.late),
            ("of unknown age", s.unknown_age),
            ("not finite", s.not_finite),
            ("out of reach", s.out_of_reach),
            ("bad rotation", s.bad_rotation),
            ("not tracked", self.untracked),
            ("lost", self.lost),
            ("restarts", self.restarts),
            ("stuck", self.stuck),
        ];
        for (name, count) in reasons {
            if count > 0 {
                write!(f, ", {name} {count}")?;
            }
        }
        Ok(())
    }
}

/// Counts of the samples of one body since the gate was made. Counters only grow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BodyCounters {
    /// Passed on.
    pub used: u64,
    /// Missing according to their sequence numbers, including those that came late.
    pub lost: u64,
    /// Captured before a sample that was already passed on: overtaken on the way.
    pub late: u64,
    /// Already seen.
    pub duplicate: u64,
}

#[derive(Clone, Copy)]
struct BodyState {
    counters: BodyCounters,
    last: Option<TrackerSample>,
    /// Consecutive samples captured before `last`, each newer than the previous one: the sign of a clock that was set
    /// back.
    late_run: u32,
    /// Capture and arrival of the first of them, and capture of the newest.
    late_first: (HostTime, HostTime),
    late_newest: HostTime,
    /// Consecutive equal poses, and whether the pose changed before them.
    equal_run: u32,
    was_moving: bool,
}

/// The gate for a fixed set of bodies. Allocates only when made.
pub struct SampleGate {
    /// Of each body, source by source.
    states: Vec<BodyState>,
    bodies: usize,
    counters: TrackerCounters,
}

impl SampleGate {
    /// Largest accepted distance from the origin, metres: a tracking volume is smaller than a kilometre.
    pub const REACH_M: f64 = 1000.0;
    /// Largest deviation of a quaternion's norm from 1; smaller ones are normalised away.
    pub const NORM_TOLERANCE: f64 = 1e-3;
    /// Largest gap in sequence numbers that counts as loss; a larger one counts as a restart.
    pub const MAX_GAP: u32 = 1000;
    /// Number of consecutive late samples, each newer than the previous one, that reveal a clock set back ...
    pub const RESTART_RUN: u32 = 3;
    /// ... if nothing else arrived for this long, nanoseconds, and they arrived at at least half of the pace at which
    /// they were captured. A burst of overtaken packets arrives at once, whatever the tracker's rate.
    pub const RESTART_QUIET_NS: i64 = 20_000_000;
    /// Number of consecutive equal poses that counts as stuck.
    pub const STUCK_RUN: u32 = 10;

    /// A gate for bodies `0..bodies`.
    pub fn new(bodies: usize) -> Self {
        Self::of_sources(bodies, 1)
    }

    /// The same for a tracker of several sources that see the same bodies, such as cameras. Order, numbers and repetitions are
    /// judged of each source by itself: none is late because another one was faster.
    pub fn of_sources(bodies: usize, sources: usize) -> Self {
        let fresh = BodyState {
            counters: BodyCounters::default(),
            last: None,
            late_run: 0,
            late_first: (HostTime(i64::MIN), HostTime(i64::MIN)),
            late_newest: HostTime(i64::MIN),
            equal_run: 0,
            was_moving: false,
        };
        Self { states: vec![fresh; bodies * sources], bodies, counters: TrackerCounters::default() }
    }

    /// The counters so far.
    pub fn counters(&self) -> &TrackerCounters {
        &self.counters
    }

    /// What is known of `body`, of each source; nothing of a body that the gate does not have.
    fn states_of(&self, body: BodyIndex) -> impl Iterator<Item = &BodyState> {
        let index = usize::from(body.0);
        self.states.iter().skip(index).step_by(self.bodies.max(1)).filter(move |_| index < self.bodies)
    }

    /// The counters of `body`, of all sources together; zeros for one that the gate does not have.
    pub fn body_counters(&self, body: BodyIndex) -> BodyCounters {
        self.states_of(body).fold(BodyCounters::default(), |sum, BodyState { counters, .. }| BodyCounters {
            used: sum.used + counters.used,
            lost: sum.lost + counters.lost,
            late: sum.late + counters.late,
            duplicate: sum.duplicate + counters.duplicate,
        })
    }

    /// The packet counters, for the client in front of this gate.
    pub fn packets_mut(&mut self) -> &mut PacketCounters {
        &mut self.counters.packets
    }

    /// Counts a sample whose body the rig does not know.
    pub fn count_unknown(&mut self) {
        self.counters.samples.received += 1;
        self.counters.samples.unknown_body += 1;
    }

    /// Counts a sample that cannot be used because its time of capture is unknown.
    pub fn count_unknown_age(&mut self) {
        self.counters.samples.received += 1;
        self.counters.samples.unknown_age += 1;
    }

    /// The newest sample passed on for `body`.
    pub fn last(&self, body: BodyIndex) -> Option<&TrackerSample> {
        self.states_of(body).filter_map(|state| state.last.as_ref()).max_by_key(|last| last.captured_at)
    }

    /// True while `body`, having moved, repeats one pose bit for bit ([`SampleGate::STUCK_RUN`] times or more).
    pub fn is_stuck(&self, body: BodyIndex) -> bool {
        self.states_of(body).any(|b| b.was_moving && b.equal_run >= Self::STUCK_RUN)
    }

    /// Resets order and sequence (the source was reconnected); counters stay.
    pub fn reconnect(&mut self) {
        for body in &mut self.states {
            *body = BodyState { last: None, late_run: 0, equal_run: 0, was_moving: false, ..*body };
        }
    }

    /// The sample to pass on, or `None` if it must not be used; either way it is counted. Its quaternion has unit
    /// length. The pose of a sample marked as not tracked is replaced by the last good one, so nobody can use it by
    /// mistake.
    pub fn admit(&mut self, sample: &TrackerSample) -> Option<TrackerSample> {
        self.admit_from(0, sample)
    }

    /// The same for a sample of one of several sources.
    pub fn admit_from(&mut self, source: usize, sample: &TrackerSample) -> Option<TrackerSample> {
        self.counters.samples.received += 1;
        let counters = &mut self.counters;
        let index = Some(usize::from(sample.body.0)).filter(|body| *body < self.bodies);
        let state = index.and_then(|body| self.states.get_mut(source * self.bodies + body));
        let Some(state) = state else {
            counters.samples.unknown_body += 1;
            return None;
        };
        let mut sample = *sample;
        if sample.tracked {
            if let Err(reason) = check_pose(&mut sample.pose) {
                match reason {
                    Reason::NotFinite => counters.samples.not_finite += 1,
                    Reason::OutOfReach => counters.samples.out_of_reach += 1,
                    Reason::BadRotation => counters.samples.bad_rotation += 1,
                }
                return None;
            }
        } else {
            sample.pose = state.last.map_or(Pose::IDENTITY, |l| l.pose);
        }
        if !sample.mean_error_m.is_finite() || sample.mean_error_m < 0.0 {
            sample.mean_error_m = 0.0;
        }
        if let Some(last) = state.last {
            if sample.captured_at <= last.captured_at {
                admit_late(state, &last, &sample, counters)?;
            } else {
                note_gap(state, &last, &sample, counters);
            }
            note_stuck(state, &last, &sample, counters);
        }
        state.late_run = 0;
        state.late_newest = HostTime(i64::MIN);
        state.last = Some(sample);
        counters.samples.used += 1;
        state.counters.used += 1;
        counters.untracked += u64::from(!sample.tracked);
        Some(sample)
    }
}

/// A sample that was captured no later than the last one: `Some` if it is the newest of a clock that was set back, else it is
/// counted.
fn admit_late(
    state: &mut BodyState,
    last: &TrackerSample,
    sample: &TrackerSample,
    counters: &mut TrackerCounters,
) -> Option<()> {
    if sample.sequence == last.sequence && sample.captured_at == last.captured_at {
        counters.samples.duplicate += 1;
        state.counters.duplicate += 1;
        return None;
    }
    if state.late_run > 0 && sample.captured_at > state.late_newest {
        state.late_run = state.late_run.saturating_add(1);
    } else {
        (state.late_run, state.late_first) = (1, (sample.captured_at, sample.received_at));
    }
    state.late_newest = sample.captured_at;
    let quiet_ns = sample.received_at.ns_since(last.received_at);
    let captured_ns = sample.captured_at.ns_since(state.late_first.0);
    let arrived_ns = sample.received_at.ns_since(state.late_first.1);
    let is_burst = arrived_ns < captured_ns / 2;
    if state.late_run >= SampleGate::RESTART_RUN && is_burst {
        // Restart the measurement of the pace here: samples after a burst must not be measured against its
        // beginning.
        (state.late_run, state.late_first) = (1, (sample.captured_at, sample.received_at));
    }
    if state.late_run < SampleGate::RESTART_RUN || quiet_ns < SampleGate::RESTART_QUIET_NS {
        counters.samples.late += 1;
        state.counters.late += 1;
        return None;
    }
    counters.restarts += 1;
    Some(())
}

/// Counts what was lost between two samples.
fn note_gap(
    state: &mut BodyState,
    last: &TrackerSample,
    sample: &TrackerSample,
    counters: &mut TrackerCounters,
) {
    match sample.sequence.wrapping_sub(last.sequence) {
        // Equal numbers with a newer capture: a source without sequence numbers (VRPN), or one that
        // restarted at the same number.
        0 | 1 => {}
        gap if gap - 1 <= SampleGate::MAX_GAP => {
            counters.lost += u64::from(gap - 1);
            state.counters.lost += u64::from(gap - 1);
        }
        _ => counters.restarts += 1,
    }
}

fn note_stuck(
    state: &mut BodyState,
    last: &TrackerSample,
    sample: &TrackerSample,
    counters: &mut TrackerCounters,
) {
    if !sample.tracked || !last.tracked {
        state.equal_run = 0;
        state.was_moving = false;
    } else if sample.pose == last.pose {
        state.equal_run = state.equal_run.saturating_add(1);
        if state.was_moving && state.equal_run == SampleGate::STUCK_RUN {
            counters.stuck += 1;
        }
    } else {
        state.equal_run = 0;
        state.was_moving = true;
    }
}

enum Reason {
    NotFinite,
    OutOfReach,
    BadRotation,
}

/// Refuses poses that are not a rigid motion within reach, and normalises the quaternion.
fn check_pose(pose: &mut Pose) -> Result<(), Reason> {
    if pose.position_m.iter().chain(&pose.rotation_xyzw).any(|c| !c.is_finite()) {
        return Err(Reason::NotFinite);
    }
    if pose.position_m.iter().any(|c| c.abs() > SampleGate::REACH_M) {
        return Err(Reason::OutOfReach);
    }
    let norm = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
    // A huge component makes the norm infinite, so the comparison fails as it should.
    if (norm - 1.0).abs() <= SampleGate::NORM_TOLERANCE {
        pose.rotation_xyzw = pose.rotation_xyzw.map(|c| c / norm);
        Ok(())
    } else {
        Err(Reason::BadRotation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(k: i64) -> TrackerSample {
        TrackerSample {
            body: BodyIndex(0),
            pose: Pose { position_m: [k as f64 * 1e-3, 0.0, 0.0], ..Pose::IDENTITY },
            tracked: true,
            mean_error_m: 0.0,
            covariance: None,
            sequence: k as u32,
            captured_at: HostTime(k * 2_000_000),
            received_at: HostTime(k * 2_000_000 + 1_000_000),
        }
    }

    fn feed(gate: &mut SampleGate, samples: impl IntoIterator<Item = TrackerSample>) -> Vec<u32> {
        samples.into_iter().filter_map(|s| gate.admit(&s)).map(|s| s.sequence).collect()
    }

    /// Two sources see a body at the same instants, one of them is read a picture later, loses one and repeats one: each counts,
    /// and only what is really missing or doubled is a fault.
    #[test]
    fn sources_are_judged_by_themselves() {
        let mut gate = SampleGate::of_sources(2, 2);
        let body = |k: i64| TrackerSample { body: BodyIndex(1), ..sample(k) };
        for k in 1..=20 {
            assert!(gate.admit_from(0, &body(k)).is_some(), "{k}");
            assert!(gate.admit_from(1, &body(k - 1)).is_some(), "{k}");
            if k == 9 {
                assert!(gate.admit_from(1, &body(k - 1)).is_none());
            }
        }
        assert!(gate.admit_from(1, &body(21)).is_some());
        let counted = gate.body_counters(BodyIndex(1));
        assert_eq!(counted, BodyCounters { used: 41, lost: 1, late: 0, duplicate: 1 });
        assert_eq!(gate.body_counters(BodyIndex(0)), BodyCounters::default());
        assert_eq!(gate.last(BodyIndex(1)).map(|last| last.sequence), Some(21));
        assert!(
            gate.admit_from(2, &body(22)).is_none()
                && gate.admit_from(0, &TrackerSample { body: BodyIndex(2), ..sample(1) }).is_none()
        );
        assert_eq!(gate.counters().samples.unknown_body, 2);
        assert!(gate.counters().is_conserved());
    }

    #[test]
    fn each_reason_is_counted_once_and_nothing_is_lost() {
        let mut gate = SampleGate::new(1);
        let with = |k: i64, change: &dyn Fn(&mut TrackerSample)| {
            let mut s = sample(k);
            change(&mut s);
            s
        };
        let used = feed(
            &mut gate,
            [
                sample(10),
                sample(10),
                sample(9),
                with(11, &|s| s.pose.position_m[1] = f64::NAN),
                with(11, &|s| s.pose.rotation_xyzw[2] = f64::INFINITY),
                with(11, &|s| s.pose.position_m[2] = 1e38),
                with(11, &|s| s.pose.rotation_xyzw = [0.0; 4]),
                with(11, &|s| s.pose.rotation_xyzw = [0.0, 0.0, 0.0, 0.5]),
                with(11, &|s| s.pose.rotation_xyzw = [0.0, 0.0, 1e-20, 0.0]),
                with(11, &|s| s.pose.rotation_xyzw = [1e300, 1e300, 0.0, 0.0]),
                with(11, &|s| s.body = BodyIndex(7)),
                with(12, &|s| s.pose.position_m[0] = 1e-310),
                sample(15),
            ],
        );
        assert_eq!(used, [10, 12, 15]);
        let c = gate.counters();
        let s = c.samples;
        assert_eq!((s.received, s.used, s.duplicate, s.late, s.not_finite), (13, 3, 1, 1, 2));
        assert_eq!((s.out_of_reach, s.bad_rotation, s.unknown_body, c.lost), (1, 4, 1, 3));
        assert!(c.is_conserved());
    }

    #[test]
    fn slightly_long_quaternions_are_normalised_and_signs_kept() {
        let mut gate = SampleGate::new(1);
        let mut s = sample(0);
        s.pose.rotation_xyzw = [0.0, 0.0, 0.0, -1.0009];
        assert_eq!(gate.admit(&s).unwrap().pose.rotation_xyzw, [0.0, 0.0, 0.0, -1.0]);
        s.sequence = 1;
        s.captured_at = HostTime(1);
        s.pose.rotation_xyzw = [0.0, 0.0, 0.0, -1.0011];
        assert!(gate.admit(&s).is_none());
    }

    #[test]
    fn unseen_bodies_keep_their_last_good_pose() {
        let mut gate = SampleGate::new(1);
        let good = gate.admit(&sample(1)).unwrap();
        let mut hidden = sample(2);
        hidden.tracked = false;
        hidden.pose = Pose { position_m: [f64::NAN; 3], rotation_xyzw: [0.0; 4] };
        let out = gate.admit(&hidden).unwrap();
        assert!(!out.tracked);
        assert_eq!(out.pose, good.pose);
        assert_eq!(gate.counters().untracked, 1);
    }

    #[test]
    fn sequence_wrap_restart_and_leap() {
        let mut gate = SampleGate::new(1);
        let at = |k: i64, sequence: u32| TrackerSample { sequence, ..sample(k) };
        // Wrap: no loss, no restart.
        feed(&mut gate, [at(1, u32::MAX - 1), at(2, u32::MAX), at(3, 0), at(4, 1)]);
        assert_eq!((gate.counters().lost, gate.counters().restarts), (0, 0));
        // Counter back to 0 while time goes on (server restarted): used at once, one restart.
        assert_eq!(feed(&mut gate, [at(5, 0), at(6, 1)]).len(), 2);
        assert_eq!(gate.counters().restarts, 1);
        // Leap by a million: no loss of a million samples reported.
        assert_eq!(feed(&mut gate, [at(7, 1_000_001)]).len(), 1);
        assert_eq!((gate.counters().lost, gate.counters().restarts), (0, 2));
    }

    #[test]
    fn a_clock_set_back_is_followed_within_50_ms_but_a_late_burst_is_not() {
        let mut gate = SampleGate::new(1);
        feed(&mut gate, (1000..1010).map(sample));
        // 40 overtaken samples in one burst: all late, none used.
        let burst = (900..940).map(|k| TrackerSample { received_at: sample(1010).received_at, ..sample(k) });
        assert_eq!(feed(&mut gate, burst), [] as [u32; 0]);
        feed(&mut gate, [sample(1011)]);
        assert_eq!(gate.counters().restarts, 0);
        // The clock leaps back one second; arrivals go on at 500 Hz.
        let back = |k: i64| TrackerSample {
            captured_at: HostTime(sample(k).captured_at.0 - 1_000_000_000),
            ..sample(k)
        };
        let mut first = None;
        for k in 1012..1100 {
            if gate.admit(&back(k)).is_some() && first.is_none() {
                first = Some((k - 1011) * 2);
            }
        }
        assert!(first.unwrap() <= 50, "{first:?} ms");
        assert_eq!(gate.counters().restarts, 1);
        assert!(gate.counters().is_conserved());
    }

    /// All tracker rates: the signs of overtaken samples and of a clock set back do not depend on the rate.
    #[test]
    fn a_burst_and_a_clock_set_back_are_told_apart_at_every_rate() {
        for hz in [30, 60, 120, 500, 1000] {
            let period = 1_000_000_000 / hz;
            let at = |k: i64| TrackerSample {
                captured_at: HostTime(k * period),
                received_at: HostTime(k * period + 1_000_000),
                ..sample(k)
            };
            let mut gate = SampleGate::new(1);
            feed(&mut gate, (1000..1010).map(at));
            // Nothing for a second, which is quiet enough, then 40 overtaken samples at once.
            let arrival = HostTime(at(1010).received_at.0 + 1_000_000_000);
            let burst = (900..940).map(|k| TrackerSample { received_at: arrival, ..at(k) });
            assert_eq!(feed(&mut gate, burst), [] as [u32; 0], "{hz} Hz");
            assert_eq!((gate.counters().restarts, gate.counters().samples.late), (0, 40), "{hz} Hz");
            // The clock leaps back one second while samples go on arriving at their pace.
            let back = |k: i64| TrackerSample {
                captured_at: HostTime(at(k).captured_at.0 - 1_000_000_000),
                received_at: HostTime(arrival.0 + (k - 1010) * period),
                ..at(k)
            };
            let followed = (1011..1200).find(|k| gate.admit(&back(*k)).is_some()).expect("followed");
            let took_ns = back(followed).received_at.ns_since(arrival);
            assert!(took_ns <= (4 * period).max(30_000_000), "{hz} Hz: {took_ns} ns");
            assert_eq!(gate.counters().restarts, 1, "{hz} Hz");
            assert!(gate.counters().is_conserved());
        }
    }

    #[test]
    fn stuck_is_flagged_only_after_motion() {
        let mut gate = SampleGate::new(1);
        let frozen = |k: i64, at: i64| TrackerSample { pose: sample(at).pose, ..sample(k) };
        feed(&mut gate, (0..100).map(|k| frozen(k, 0)));
        assert!(!gate.is_stuck(BodyIndex(0)), "a body that never moved is at rest, not stuck");
        feed(&mut gate, (100..110).map(sample));
        feed(&mut gate, (110..119).map(|k| frozen(k, 109)));
        assert!(!gate.is_stuck(BodyIndex(0)));
        feed(&mut gate, (119..150).map(|k| frozen(k, 109)));
        assert!(gate.is_stuck(BodyIndex(0)));
        assert_eq!(gate.counters().stuck, 1);
        feed(&mut gate, [sample(150)]);
        assert!(!gate.is_stuck(BodyIndex(0)));
        assert_eq!(gate.counters().samples.used, 151);
    }
}
