//! What became of the tracker's samples: the tracking thread adds to numbers, and observers read them as the report has
//! them.

use crate::config::MAX_TRACKED;
use dpm_device::tracker::{BodyCounters, BodyIndex, SampleGate, TrackerCounters};
use std::sync::atomic::{AtomicI32, AtomicU64, Ordering};
use std::sync::OnceLock;

/// What became of the tracker's samples in a run, over all times that the tracker was opened. A sample is one pose of
/// one body.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct TrackerReport {
    /// Datagrams or messages that arrived; 0 for a tracker without any.
    pub packets: u64,
    /// Of these, packets that were not used: from elsewhere, malformed, or of another kind.
    pub packets_refused: u64,
    /// Samples that arrived.
    pub samples: u64,
    /// Of these, samples that were used.
    pub used: u64,
    /// Samples that never came, by the numbers that are missing.
    pub lost: u64,
    /// Samples that came after a newer one, and were not used.
    pub reordered: u64,
    /// Samples that came twice.
    pub doubled: u64,
    /// Samples of a body that the rig file does not name.
    pub unlabelled: u64,
    /// Samples that no tracker can mean: not finite, out of reach, not a rotation, or of unknown age.
    pub impossible: u64,
    /// Of the used samples, those of a body that the tracker did not see.
    pub unseen: u64,
    /// Samples that contradicted the motion of their body, such as those of two bodies that were exchanged.
    pub contradictory: u64,
    /// The same by body, in the order of the rig file.
    pub bodies: Vec<BodySamples>,
}

/// What became of the samples of one body.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct BodySamples {
    /// Its name.
    pub body: String,
    /// Samples used.
    pub used: u64,
    /// As of all bodies.
    pub lost: u64,
    /// As of all bodies.
    pub reordered: u64,
    /// As of all bodies.
    pub doubled: u64,
    /// As of all bodies.
    pub contradictory: u64,
}

/// Share of samples that are lost, reordered or contradictory from which the operator is warned.
const WORTH_A_WARNING: f64 = 0.01;

impl TrackerReport {
    /// What an operator should know; `None` if nearly all samples came and could be used.
    pub fn warning(&self) -> Option<String> {
        let all = (self.samples + self.lost).max(1) as f64;
        let share = |n: u64| n as f64 / all;
        let told: Vec<String> = [
            ("never came", self.lost),
            ("came after newer ones", self.reordered),
            ("contradicted the motion of their body", self.contradictory),
            ("were of bodies that the rig file does not name", self.unlabelled),
        ]
        .into_iter()
        .filter(|(_, n)| share(*n) >= WORTH_A_WARNING)
        .map(|(what, n)| format!("{:.1} % {what}", 100.0 * share(n)))
        .collect();
        (!told.is_empty()).then(|| {
            let all = told.join(", ");
            format!("of the tracker's samples {all}; `dpm record` shows more, and a cable in place of wireless often helps")
        })
    }
}

/// The numbers of a [`TrackerReport`]. Adding to them takes no lock and allocates nothing. Accesses are relaxed: each
/// number is right, but they are not all of one instant.
#[derive(Debug, Default)]
pub(crate) struct TrackerGauges {
    counts: [AtomicU64; COUNTS],
    bodies: OnceLock<Box<[[AtomicU64; BODY_COUNTS]]>>,
    /// By body: steps by which the keys for acceleration and turning are wrong, each a factor of two; 0 if they are not, or
    /// once that was read.
    contradicted: OnceLock<Box<[[AtomicI32; 2]]>>,
}

const COUNTS: usize = 10;
const BODY_COUNTS: usize = 5;

fn counts(c: &TrackerCounters) -> [u64; COUNTS] {
    let s = &c.samples;
    let impossible = s.unknown_age + s.not_finite + s.out_of_reach + s.bad_rotation;
    [
        c.packets.received,
        c.packets.dropped(),
        s.received,
        s.used,
        c.lost,
        s.late,
        s.duplicate,
        s.unknown_body,
        impossible,
        c.untracked,
    ]
}

fn body_counts(c: &BodyCounters, contradictory: u64) -> [u64; BODY_COUNTS] {
    [c.used, c.lost, c.late, c.duplicate, contradictory]
}

/// What the counters of one opened tracker were when they were last added.
#[derive(Debug, Default)]
pub(crate) struct AddedCounts {
    counts: [u64; COUNTS],
    bodies: Vec<[u64; BODY_COUNTS]>,
}

impl AddedCounts {
    /// Of a tracker of `bodies` bodies that has just been opened.
    pub(crate) fn new(bodies: usize) -> Self {
        Self { counts: [0; COUNTS], bodies: vec![[0; BODY_COUNTS]; bodies] }
    }
}

fn add<const N: usize>(to: &[AtomicU64; N], now: [u64; N], added: &mut [u64; N]) {
    for ((to, now), added) in to.iter().zip(now).zip(added) {
        to.fetch_add(now - std::mem::replace(added, now), Ordering::Relaxed);
    }
}

impl TrackerGauges {
    /// Adds what `gate`, and the filters with `contradictory` samples by body, have counted since `added`.
    pub(crate) fn add(&self, gate: &SampleGate, contradictory: &[u64], added: &mut AddedCounts) {
        add(&self.counts, counts(gate.counters()), &mut added.counts);
        let all = self.bodies.get().map_or(&[][..], |bodies| bodies);
        for (body, ((to, added), n)) in all.iter().zip(&mut added.bodies).zip(contradictory).enumerate() {
            add(to, body_counts(&gate.body_counters(BodyIndex(body as u16)), *n), added);
        }
    }

    /// Makes room for `bodies` bodies; once per run.
    pub(crate) fn begin(&self, bodies: usize) {
        let bodies = bodies.min(MAX_TRACKED);
        let _ = self.bodies.set((0..bodies).map(|_| Default::default()).collect());
        let _ = self.contradicted.set((0..bodies).map(|_| Default::default()).collect());
    }

    /// Where [`super::keys`] stores what contradicts the keys, by body.
    pub(super) fn contradicted(&self) -> &[[AtomicI32; 2]] {
        self.contradicted.get().map_or(&[], |all| all)
    }

    /// Takes what contradicts the keys: body, 0 for acceleration or 1 for turning, and steps.
    pub(crate) fn take_contradicted(&self) -> impl Iterator<Item = (usize, usize, i32)> + '_ {
        let all = self.contradicted().iter().enumerate();
        all.flat_map(|(body, keys)| keys.iter().enumerate().map(move |(key, level)| (body, key, level)))
            .filter(|(_, _, level)| level.load(Ordering::Relaxed) != 0)
            .map(|(body, key, level)| (body, key, level.swap(0, Ordering::Relaxed)))
    }

    /// The numbers as a report; `None` if no tracker has counted anything.
    pub(crate) fn report<'a>(&self, names: impl Iterator<Item = &'a str>) -> Option<TrackerReport> {
        let [packets, packets_refused, samples, used, missing, late, doubled, unlabelled, impossible, unseen] =
            self.counts.each_ref().map(|n| n.load(Ordering::Relaxed));
        if packets + samples == 0 {
            return None;
        }
        let bodies: Vec<BodySamples> = names
            .zip(self.bodies.get().map_or(&[][..], |bodies| bodies))
            .map(|(name, counts)| {
                let [used, missing, reordered, doubled, contradictory] =
                    counts.each_ref().map(|n| n.load(Ordering::Relaxed));
                let lost = missing.saturating_sub(reordered);
                BodySamples { body: name.to_owned(), used, lost, reordered, doubled, contradictory }
            })
            .collect();
        Some(TrackerReport {
            packets,
            packets_refused,
            samples,
            used,
            // A sample that was overtaken was missing before it came.
            lost: missing.saturating_sub(late),
            reordered: late,
            doubled,
            unlabelled,
            impossible,
            unseen,
            contradictory: bodies.iter().map(|body| body.contradictory).sum(),
            bodies,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::pose::Pose;
    use dpm_device::time::HostTime;
    use dpm_device::tracker::TrackerSample;

    /// Five in a hundred lost, three reordered and three doubled, by two trackers one after the other: each count is in
    /// the report, by body, and none hides another.
    #[test]
    fn what_became_of_every_sample_is_reported() {
        let gauges = TrackerGauges::default();
        gauges.begin(2);
        assert_eq!(gauges.report(["a", "b"].into_iter()), None);
        for opened in 0..2i64 {
            let (mut gate, mut added) = (SampleGate::new(2), AddedCounts::new(2));
            let mut send = |body: u16, k: i64| {
                let at = HostTime(1_000_000_000 * (opened + 1) + 1_000_000 * k);
                gate.admit(&TrackerSample {
                    body: BodyIndex(body),
                    pose: Pose { position_m: [k as f64 * 1e-3, 0.0, 0.0], ..Pose::IDENTITY },
                    tracked: true,
                    mean_error_m: 0.0,
                    covariance: None,
                    sequence: k as u32,
                    captured_at: at,
                    received_at: at,
                });
            };
            for k in (0..1000).step_by(10) {
                send(1, k);
                // Body 0: number 3 of ten comes after number 4, number 5 twice, and number 7 never.
                for n in [0, 1, 2, 4, 3, 5, 5, 6, 8, 9] {
                    send(0, k + n);
                }
            }
            send(9, 0);
            gauges.add(&gate, &[4, 0], &mut added);
            gauges.add(&gate, &[5, 0], &mut added);
        }
        let told = gauges.report(["a", "b"].into_iter()).expect("there were samples");
        let a = BodySamples {
            body: "a".into(),
            used: 1600,
            lost: 200,
            reordered: 200,
            doubled: 200,
            contradictory: 10,
        };
        assert_eq!(told.bodies[0], a);
        // The numbers of body 1 lack nine of ten.
        assert_eq!((told.bodies[1].used, told.bodies[1].lost), (200, 1782));
        assert_eq!((told.samples, told.used, told.unlabelled), (2202, 1800, 2));
        assert_eq!((told.lost, told.reordered, told.doubled, told.contradictory), (1982, 200, 200, 10));
        assert!(told.warning().is_some_and(|told| told.contains("never came") && !told.contains("file")));
        assert_eq!(
            TrackerReport { samples: 1000, lost: 9, reordered: 9, ..Default::default() }.warning(),
            None
        );
    }
}
