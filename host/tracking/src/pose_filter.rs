//! Estimates the motion of one body from its samples: each sample is judged, and the good ones feed two banks of Kalman
//! filters.
//!
//! Three samples that agree with one another start a track. A sample far from the predicted position is set aside, and
//! three such samples that agree replace the track. So a teleport is accepted within three samples and never
//! extrapolated across, and a burst of outliers changes nothing.

use super::course::{Continuation, Course};
use super::imm::{Chart, Covariance, Kinematics, Rotations, Translations};
use super::learner::Learner;
use super::noise::NoiseEstimator;
use super::recall::Recall;
#[cfg(test)]
use super::state::Freshness;
use super::state::{PosePrediction, TrackState};
use dpm_common::so3::so3_between;
use dpm_device::time::HostTime;
use dpm_device::tracker::TrackerSample;
use glam::{DQuat, DVec3};

/// Samples that must agree before a track starts or is replaced.
pub(crate) const ACQUIRE_SAMPLES: usize = 3;

/// A quaternion whose norm differs from 1 by more is refused instead of normalised.
const QUATERNION_TOLERANCE: f64 = 1e-3;

/// A sample stamped later than this after its own arrival is refused: it would make every correct one look old.
const FUTURE_TOLERANCE_NS: i64 = 1_000_000;

/// Number of recent intervals between samples from which the tracker's rate is measured.
const INTERVALS: usize = 9;
/// Number of intervals that must be known before the measured rate is used.
const LEAST_INTERVALS: usize = 3;
/// The slowest rate that is accepted, as ns between two samples: 10 Hz.
const LONGEST_PERIOD_NS: i64 = 100_000_000;
/// A track survives a gap of this many half periods: two samples in a row may be missing, and the third may be late.
const HALF_PERIODS_CARRIED: i64 = 7;
/// A track survives a gap of this length in any case, ns.
const CARRIED_NS: i64 = 20_000_000;
/// The part of [`PoseFilterConfig::tracked_for_ns`] for the rig's own latency, ns; a missing sample or two come on top.
const OWN_LATENCY_NS: i64 = 6_000_000;

/// Whether poses are predicted to the instant of light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Prediction {
    /// Filtered and predicted.
    On,
    /// The newest accepted pose is held unchanged: the result of a rig without prediction, for comparison.
    Off,
}

/// Settings of one body's filter. Everything has a default for a 500 Hz optical tracker and hand-held objects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseFilterConfig {
    /// Predict or hold.
    pub prediction: Prediction,
    /// Standard deviation of a sample's position along one axis before it has been measured, metres, > 0.
    pub position_noise_m: f64,
    /// Standard deviation of a sample's rotation about one axis before it has been measured, rad, > 0.
    pub rotation_noise_rad: f64,
    /// Measure the noise from the samples themselves instead of using the two values above permanently.
    pub measure_noise: bool,
    /// About how much bodies accelerate in turns, m/s^2. The filter learns from their samples what it is.
    pub acceleration_m_s2: f64,
    /// The same for rotations, rad/s^2.
    pub angular_acceleration_rad_s2: f64,
    /// Mean time after which a body that moves as it did before is believed to repeat itself, seconds.
    pub recall_after_s: f64,
    /// Samples further than this many standard deviations from the prediction are set aside.
    pub gate_sigmas: f64,
    /// Fastest plausible motion, m/s.
    pub max_speed_m_s: f64,
    /// Strongest plausible acceleration, m/s^2.
    pub max_acceleration_m_s2: f64,
    /// Strongest plausible angular acceleration, rad/s^2.
    pub max_angular_acceleration_rad_s2: f64,
    /// Horizons up to this count as [`super::state::Freshness::Tracked`]: the rig's own latency and a missing sample or
    /// two, ns. With a tracker below 500 Hz it is that latency and two periods, at most `lost_after_ns`.
    pub tracked_for_ns: i64,
    /// Longest time for which motion is extrapolated without samples, ns; then the body is lost. A track may be older
    /// or younger: it continues with the next sample if no more than two are missing, at the measured rate, or within 20 ms.
    pub lost_after_ns: i64,
    /// A body that moved and then delivers this many identical poses is reported as stuck.
    pub stuck_after: u32,
    /// Time between two samples of one of several sources that see the same body, ns; 0 for a single source. Samples of the
    /// newest instant, and older ones by up to this, are used too: they are another source's.
    pub source_period_ns: i64,
}

impl Default for PoseFilterConfig {
    fn default() -> Self {
        Self {
            prediction: Prediction::On,
            position_noise_m: 1e-4,
            rotation_noise_rad: 1e-3,
            measure_noise: true,
            acceleration_m_s2: 5.0,
            angular_acceleration_rad_s2: 20.0,
            recall_after_s: 0.03,
            gate_sigmas: 6.0,
            max_speed_m_s: 20.0,
            max_acceleration_m_s2: 500.0,
            max_angular_acceleration_rad_s2: 20_000.0,
            tracked_for_ns: 10_000_000,
            lost_after_ns: 20_000_000,
            stuck_after: 5,
            source_period_ns: 0,
        }
    }
}

impl PoseFilterConfig {
    /// The same without recall ([`super::recall`]): for comparison.
    #[cfg(test)]
    pub(crate) fn without_recall(mut self) -> Self {
        // So late that it never happens.
        self.recall_after_s = f64::INFINITY;
        self
    }

    /// Settings for bodies that accelerate by about `acceleration` (m/s^2) and `angular_acceleration` (rad/s^2), and
    /// that are lost if no sample has arrived for `lost_after_ms`, at least 1.
    pub fn for_bodies(acceleration: f64, angular_acceleration: f64, lost_after_ms: u32) -> Self {
        let lost_after_ns = i64::from(lost_after_ms.max(1)) * 1_000_000;
        let defaults = Self::default();
        Self {
            acceleration_m_s2: acceleration,
            angular_acceleration_rad_s2: angular_acceleration,
            max_acceleration_m_s2: (100.0 * acceleration).max(defaults.max_acceleration_m_s2),
            max_angular_acceleration_rad_s2: (100.0 * angular_acceleration)
                .max(defaults.max_angular_acceleration_rad_s2),
            tracked_for_ns: lost_after_ns / 2,
            lost_after_ns,
            ..defaults
        }
    }
}

/// The outcome of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Used.
    Accepted,
    /// Used, but the body no longer moves although it did, and its noise is gone: the tracker repeats itself.
    Stuck,
    /// Used; a track starts here, or the body is elsewhere than its track was.
    Acquired,
    /// Agrees with no track yet; waits for further samples that agree with it.
    SetAside,
    /// The tracker reports that it does not see the body.
    Untracked,
    /// A component is not finite.
    NotFinite,
    /// The quaternion's norm is further than 1e-3 from 1.
    NotUnit,
    /// Same stamp as the newest.
    Duplicate,
    /// Older than the newest.
    OutOfOrder,
    /// Stamped after its own arrival.
    FromFuture,
}

impl Verdict {
    /// True when the sample changed the track.
    pub fn is_accepted(self) -> bool {
        matches!(self, Self::Accepted | Self::Stuck | Self::Acquired)
    }
}

/// Number of samples by verdict since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(missing_docs)] // one per Verdict, named after it
pub(crate) struct PoseFilterCounters {
    pub accepted: u64,
    pub stuck: u64,
    pub acquired: u64,
    pub set_aside: u64,
    pub untracked: u64,
    pub not_finite: u64,
    pub not_unit: u64,
    pub duplicate: u64,
    pub out_of_order: u64,
    pub from_future: u64,
}

impl PoseFilterCounters {
    fn count(&mut self, verdict: Verdict) {
        *match verdict {
            Verdict::Accepted => &mut self.accepted,
            Verdict::Stuck => &mut self.stuck,
            Verdict::Acquired => &mut self.acquired,
            Verdict::SetAside => &mut self.set_aside,
            Verdict::Untracked => &mut self.untracked,
            Verdict::NotFinite => &mut self.not_finite,
            Verdict::NotUnit => &mut self.not_unit,
            Verdict::Duplicate => &mut self.duplicate,
            Verdict::OutOfOrder => &mut self.out_of_order,
            Verdict::FromFuture => &mut self.from_future,
        } += 1;
    }
}

/// A checked measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PoseReading {
    at: HostTime,
    position: DVec3,
    rotation: DQuat,
    /// Variances along and about the axes by the tracker's own account, m^2 and rad^2.
    stated: Option<[DVec3; 2]>,
}

#[derive(Clone, Debug)]
struct Track {
    position: Learner<Translations>,
    rotation: Learner<Rotations>,
    /// Of the position alone.
    course: Course,
    newest: PoseReading,
    /// Length of the current run of identical poses, and whether the body moved before it.
    repeats: u32,
    moved_before_repeats: bool,
}

/// Tracks one body. Allocates once and never blocks; one update costs a few microseconds, and ten more when it adds a
/// new point of the past.
#[derive(Clone, Debug)]
pub struct PoseFilter {
    config: PoseFilterConfig,
    track: Option<Track>,
    candidates: [Option<PoseReading>; ACQUIRE_SAMPLES],
    position_noise: NoiseEstimator<Translations>,
    rotation_noise: NoiseEstimator<Rotations>,
    position_recall: Recall<Translations>,
    rotation_recall: Recall<Rotations>,
    counters: PoseFilterCounters,
    last_nis: Option<[f64; 2]>,
    rate: SampleRate,
}

/// The measured time between two samples of a tracker. The rig file's value may be wrong. And only the rate
/// distinguishes a tracker at 30 Hz, whose samples are all "late" by the standard of one at 500 Hz, from a tracker that
/// loses most of its samples.
#[derive(Clone, Copy, Debug, Default)]
struct SampleRate {
    newest: Option<HostTime>,
    intervals: [i64; INTERVALS],
    filled: usize,
    next: usize,
}

impl SampleRate {
    fn push(&mut self, at: HostTime) {
        let interval = self.newest.map_or(0, |newest| at.ns_since(newest));
        if self.newest.is_none() || interval > 0 {
            self.newest = Some(at);
        }
        if interval > 0 {
            self.intervals[self.next] = interval;
            self.next = (self.next + 1) % INTERVALS;
            self.filled = (self.filled + 1).min(INTERVALS);
        }
    }

    /// The median of the last intervals, which occasional missing samples do not move, at most [`LONGEST_PERIOD_NS`],
    /// nanoseconds; 0 while it is not known.
    fn period_ns(&self) -> i64 {
        if self.filled < LEAST_INTERVALS {
            return 0;
        }
        let mut sorted = self.intervals;
        let known = &mut sorted[..self.filled];
        known.sort_unstable();
        known[(known.len() - 1) / 2].min(LONGEST_PERIOD_NS)
    }
}

impl PoseFilter {
    /// A filter without samples.
    pub fn new(config: PoseFilterConfig) -> Self {
        Self {
            config,
            track: None,
            candidates: [None; ACQUIRE_SAMPLES],
            position_noise: NoiseEstimator::new(config.position_noise_m, 1e-6),
            rotation_noise: NoiseEstimator::new(config.rotation_noise_rad, 1e-6),
            position_recall: Recall::new(),
            rotation_recall: Recall::new(),
            counters: PoseFilterCounters::default(),
            last_nis: None,
            rate: SampleRate::default(),
        }
    }

    /// Longest gap between two samples that a track survives, ns. However long poses may be predicted, what was seen of an
    /// acceleration before a longer one says nothing of the motion now: the first sample would throw the light ahead.
    fn carried_for_ns(&self) -> i64 {
        CARRIED_NS.max(HALF_PERIODS_CARRIED * self.period_ns() / 2)
    }

    /// As measured; of several sources not shorter than that of one: between them lie intervals of any length, and any of them
    /// may see a body alone.
    fn period_ns(&self) -> i64 {
        self.rate.period_ns().max(self.config.source_period_ns)
    }

    fn tracked_for_ns(&self) -> i64 {
        let slow = OWN_LATENCY_NS + 2 * self.period_ns();
        self.config.tracked_for_ns.max(slow).min(self.config.lost_after_ns)
    }

    /// The settings.
    pub fn config(&self) -> &PoseFilterConfig {
        &self.config
    }

    /// Counts of all samples so far, by verdict.
    #[cfg(test)]
    pub(crate) fn counters(&self) -> PoseFilterCounters {
        self.counters
    }

    /// Normalised innovation squared of the last accepted sample, position and rotation: its mean is 3 if the filter's
    /// covariance is right.
    pub fn last_nis(&self) -> Option<[f64; 2]> {
        self.last_nis
    }

    /// Judges a sample and uses it if it is good. Any bits are accepted as input.
    pub fn update(&mut self, sample: &TrackerSample) -> Verdict {
        let verdict = match check(sample) {
            Ok(measured) => {
                self.rate.push(measured.at);
                self.take(measured)
            }
            Err(verdict) => verdict,
        };
        self.counters.count(verdict);
        verdict
    }

    /// The body at `at`; `None` until a track has started for the first time.
    pub fn predict(&self, at: HostTime) -> Option<PosePrediction> {
        self.state().map(|state| state.predict(at))
    }

    /// The track as plain data, to be predicted elsewhere.
    pub(crate) fn state(&self) -> Option<TrackState> {
        let track = self.track.as_ref()?;
        let (position, rotation) = match self.config.prediction {
            Prediction::On => (track.position.combined(), track.rotation.combined()),
            Prediction::Off => (
                Kinematics::held(track.newest.position, deviation(self.variances(&track.newest).0).powi(2)),
                Kinematics::held(track.newest.rotation, deviation(self.variances(&track.newest).1).powi(2)),
            ),
        };
        Some(TrackState {
            captured_at: track.newest.at,
            position,
            continuation: match self.config.prediction {
                Prediction::On => track.course.of(&position.mean),
                Prediction::Off => Continuation::default(),
            },
            rotation,
            tracked_for_ns: self.tracked_for_ns(),
            lost_after_ns: self.config.lost_after_ns,
        })
    }

    /// Shorthand for the freshness of [`PoseFilter::predict`]; `Lost` before the first track.
    #[cfg(test)]
    pub(crate) fn freshness(&self, at: HostTime) -> Freshness {
        self.predict(at).map_or(Freshness::Lost, |p| p.freshness)
    }

    /// Steps by which the learned accelerations of position and rotation lie above the settings; each doubles them.
    pub fn levels(&self) -> [i32; 2] {
        self.track.as_ref().map_or([0; 2], |track| [track.position.level(), track.rotation.level()])
    }

    /// By how much forecasts 4 ms ahead would err more with the accelerations of the settings, m and rad.
    pub fn excess(&self) -> [f64; 2] {
        self.track.as_ref().map_or([0.0; 2], |track| [track.position.excess(), track.rotation.excess()])
    }

    /// The variances of a sample along each axis: the tracker's own, which knows from where it looks, or those measured of all.
    fn variances(&self, z: &PoseReading) -> (DVec3, DVec3) {
        if let Some([position, rotation]) = z.stated {
            return (position, rotation);
        }
        let (position, rotation) = if self.config.measure_noise {
            (self.position_noise.variance(), self.rotation_noise.variance())
        } else {
            let c = &self.config;
            (c.position_noise_m * c.position_noise_m, c.rotation_noise_rad * c.rotation_noise_rad)
        };
        (DVec3::splat(position), DVec3::splat(rotation))
    }

    fn take(&mut self, z: PoseReading) -> Verdict {
        let (rp, rr) = self.variances(&z);
        let c = self.config;
        let carried_for_ns = self.carried_for_ns();
        if let Some(track) = &mut self.track {
            let gap_ns = z.at.ns_since(track.newest.at);
            if gap_ns <= 0 && gap_ns > -c.source_period_ns {
                return self.take_beside(z, [rp, rr]);
            }
            if gap_ns == 0 {
                return Verdict::Duplicate;
            }
            if gap_ns < 0 {
                return Verdict::OutOfOrder;
            }
            if gap_ns <= carried_for_ns {
                let h = gap_ns as f64 * 1e-9;
                let (position, rotation) = (&mut track.position, &mut track.rotation);
                let before = (position.present(), rotation.present());
                let (from_ns, to_ns) = (track.newest.at.0, z.at.0);
                let (most, most_turn) = (position.greatest_recalled(), rotation.greatest_recalled());
                position.advance(h, self.position_recall.between(from_ns, to_ns, most));
                rotation.advance(h, self.rotation_recall.between(from_ns, to_ns, most_turn));
                // The unseen effect of the strongest plausible acceleration counts as two standard deviations.
                let slack = 0.25 * h * h;
                let gate = c.gate_sigmas * c.gate_sigmas;
                let [slack_p, slack_r] =
                    [c.max_acceleration_m_s2, c.max_angular_acceleration_rad_s2].map(|most| slack * most);
                let inside = position.bank().distance_squared(z.position, rp, slack_p) <= gate
                    && rotation.bank().distance_squared(z.rotation, rr, slack_r) <= gate;
                if inside {
                    self.last_nis = Some([
                        position.update(to_ns, z.position, rp),
                        rotation.update(to_ns, z.rotation, rr),
                    ]);
                    take_course(&mut track.course, position, to_ns, z.position, rp);
                    self.candidates = [None; ACQUIRE_SAMPLES];
                    self.position_noise.push(z.at.0, z.position);
                    self.rotation_noise.push(z.at.0, z.rotation);
                    let (p, r) = (position.bank().mean(), rotation.bank().mean());
                    self.position_recall.push(to_ns, z.position, p.point, p.velocity, deviation(rp));
                    self.rotation_recall.push(to_ns, z.rotation, r.point, r.velocity, deviation(rr));
                    return track.accept(z, c.stuck_after);
                }
                position.back_to(before.0);
                rotation.back_to(before.1);
            }
        }
        self.acquire(z, rp, rr)
    }

    /// Uses a sample of another source, no newer than the newest: as if it had been taken then, with the motion since. How badly
    /// that is known adds to its variance, on the safe side: the errors of place and velocity may go together. The track stays
    /// at its instant, and the noise, the past and the rate are learned of the others.
    fn take_beside(&mut self, z: PoseReading, r: [DVec3; 2]) -> Verdict {
        let c = self.config;
        let Some(track) = &mut self.track else { return Verdict::OutOfOrder };
        let (at_ns, h) = (track.newest.at.0, track.newest.at.ns_since(z.at) as f64 * 1e-9);
        let (position, rp) = brought(&track.position, z.position, r[0], h);
        let (rotation, rr) = brought(&track.rotation, z.rotation, r[1], h);
        let slack = 0.25 * h * h;
        let gate = c.gate_sigmas * c.gate_sigmas;
        let [slack_p, slack_r] =
            [c.max_acceleration_m_s2, c.max_angular_acceleration_rad_s2].map(|most| slack * most);
        let inside = track.position.bank().distance_squared(position, rp, slack_p) <= gate
            && track.rotation.bank().distance_squared(rotation, rr, slack_r) <= gate;
        if !inside {
            return Verdict::SetAside;
        }
        self.last_nis =
            Some([track.position.update(at_ns, position, rp), track.rotation.update(at_ns, rotation, rr)]);
        take_course(&mut track.course, &track.position, at_ns, position, rp);
        Verdict::Accepted
    }

    /// Collects samples that agree; the third in a row starts a new track.
    fn acquire(&mut self, z: PoseReading, rp: DVec3, rr: DVec3) -> Verdict {
        let c = self.config;
        if let [.., Some(last)] = self.candidates {
            let gap_ns = z.at.ns_since(last.at);
            if gap_ns <= 0 && gap_ns > -c.source_period_ns {
                return Verdict::SetAside;
            }
            if gap_ns == 0 {
                return Verdict::Duplicate;
            }
            if gap_ns < 0 {
                return Verdict::OutOfOrder;
            }
            if gap_ns > c.lost_after_ns.max(self.carried_for_ns()) || !self.agrees(z, rp) {
                self.candidates = [None; ACQUIRE_SAMPLES];
            }
        }
        self.candidates.rotate_left(1);
        self.candidates[ACQUIRE_SAMPLES - 1] = Some(z);
        let [Some(first), rest @ ..] = self.candidates else {
            return Verdict::SetAside;
        };
        // What was learned of the body before it was lost is true of it still.
        let [level_p, level_r] = self.levels();
        let (a, turn, late) = (c.acceleration_m_s2, c.angular_acceleration_rad_s2, c.recall_after_s);
        let mut position = Learner::new(a, late, level_p, first.position, rp);
        let mut rotation = Learner::new(turn, late, level_r, first.rotation, rr);
        self.position_noise.break_track();
        self.rotation_noise.break_track();
        self.position_recall.break_track();
        self.rotation_recall.break_track();
        let mut before = first;
        for z in rest.into_iter().flatten() {
            let h = z.at.ns_since(before.at) as f64 * 1e-9;
            position.advance(h, None);
            rotation.advance(h, None);
            position.update(z.at.0, z.position, rp);
            rotation.update(z.at.0, z.rotation, rr);
            before = z;
        }
        self.last_nis = None;
        self.candidates = [None; ACQUIRE_SAMPLES];
        let course = Course::default();
        self.track =
            Some(Track { position, rotation, course, newest: z, repeats: 0, moved_before_repeats: false });
        Verdict::Acquired
    }

    /// Whether `z` continues the candidates: no faster than the fastest plausible motion, and no sharper turn than the
    /// strongest plausible one.
    fn agrees(&self, z: PoseReading, rp: DVec3) -> bool {
        let c = &self.config;
        let [.., previous, Some(last)] = self.candidates else {
            return true;
        };
        let h = z.at.ns_since(last.at) as f64 * 1e-9;
        let step = z.position - last.position;
        let noise = c.gate_sigmas * deviation(rp);
        if step.length() > c.max_speed_m_s * h + 2.0 * noise {
            return false;
        }
        let Some(previous) = previous else {
            return true;
        };
        let h0 = last.at.ns_since(previous.at) as f64 * 1e-9;
        let foretold = (last.position - previous.position) * (h / h0);
        (step - foretold).length() <= c.max_acceleration_m_s2 * h * (h + h0) + noise * (2.0 + 2.0 * h / h0)
    }
}

/// A sample of `h` >= 0 seconds ago with variances `r`, as it were now by what `learner` has of the motion.
fn brought<C: Chart>(learner: &Learner<C>, z: C::Point, r: DVec3, h: f64) -> (C::Point, DVec3) {
    let Kinematics { mean, covariance } = learner.combined();
    let since = C::between(mean.point_after::<C>(-h), mean.point);
    let more = covariance.map(|c| {
        let apart = Covariance { pp: 0.0, pv: c.pv.abs(), pa: c.pa.abs(), va: c.va.abs(), ..c };
        apart.position_variance_at(h)
    });
    (C::moved(z, since), r + DVec3::from_array(more))
}

/// Shows the course of a position what came, and what the filters make of it.
fn take_course(course: &mut Course, position: &Learner<Translations>, at_ns: i64, z: DVec3, r: DVec3) {
    course.take(at_ns, z, r, position.combined().mean);
}

impl Track {
    fn accept(&mut self, z: PoseReading, stuck_after: u32) -> Verdict {
        let identical = z.position == self.newest.position && z.rotation == self.newest.rotation;
        if identical {
            self.repeats += 1;
        } else {
            let h = z.at.ns_since(self.newest.at) as f64 * 1e-9;
            let step = (z.position - self.newest.position).length();
            let turn = so3_between(self.newest.rotation, z.rotation).length();
            self.repeats = 0;
            // 1 cm/s and 0.1 rad/s: motion that cannot stop dead between two samples.
            self.moved_before_repeats = step > 0.01 * h || turn > 0.1 * h;
        }
        self.newest = z;
        if self.moved_before_repeats && self.repeats >= stuck_after {
            Verdict::Stuck
        } else {
            Verdict::Accepted
        }
    }
}

fn check(sample: &TrackerSample) -> Result<PoseReading, Verdict> {
    if !sample.tracked {
        return Err(Verdict::Untracked);
    }
    let finite = |x: &f64| x.is_finite() && x.abs() < 1e9;
    if !sample.pose.position_m.iter().all(finite) || !sample.pose.rotation_xyzw.iter().all(finite) {
        return Err(Verdict::NotFinite);
    }
    if !sample.pose.is_valid(QUATERNION_TOLERANCE) {
        return Err(Verdict::NotUnit);
    }
    if sample.captured_at.ns_since(sample.received_at) > FUTURE_TOLERANCE_NS {
        return Err(Verdict::FromFuture);
    }
    Ok(PoseReading {
        at: sample.captured_at,
        position: DVec3::from_array(sample.pose.position_m),
        rotation: DQuat::from_array(sample.pose.rotation_xyzw).normalize(),
        stated: sample
            .covariance
            .and_then(|c| c.variances())
            .map(|v| v.map(|v| DVec3::from_array(v).max(LEAST_VARIANCE))),
    })
}

/// No sample is better than a micrometre and a microradian, whatever its tracker says.
const LEAST_VARIANCE: DVec3 = DVec3::splat(1e-12);

/// The standard deviation of an axis that is like all three.
fn deviation(variances: DVec3) -> f64 {
    (variances.element_sum() / 3.0).sqrt()
}

#[cfg(test)]
#[path = "pose_filter_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "source_tests.rs"]
mod source_tests;
