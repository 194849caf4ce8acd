//! Bodies on which no light fell although their frames were lit. They are counted by cause, and reported to the
//! operator once per episode.
//!
//! This runs beside the frame path, so it may allocate.

use crate::plan::dark::DarkCause;
use crate::telemetry::report::DarkBody;
use dpm_device::time::HostTime;

/// An episode begins when a body has been dark for this long, and ends when it has been lit for this long. An
/// occasional lost sample is not reported.
const EPISODE_NS: i64 = 100_000_000;

#[derive(Clone, Debug, Default)]
struct BodyDarkness {
    frames: [u64; DarkCause::ALL.len()],
    /// Since when it has been dark, or lit, without interruption.
    since: Option<(HostTime, bool)>,
    /// Since when the reported episode lasts.
    told: Option<HostTime>,
}

/// Per tracked body.
#[derive(Clone, Debug)]
pub(crate) struct DarkBodies {
    bodies: Vec<BodyDarkness>,
}

impl DarkBodies {
    /// For `bodies` tracked bodies.
    pub(crate) fn new(bodies: usize) -> Self {
        Self { bodies: vec![BodyDarkness::default(); bodies] }
    }

    /// A frame was lit at `at`, with or without light on each body. Calls `note` with the number of a body whose
    /// episode began or ended, and with the message about it.
    pub(crate) fn lit(
        &mut self,
        dark: &[Option<DarkCause>],
        at: HostTime,
        mut note: impl FnMut(usize, String),
    ) {
        for (i, (body, cause)) in self.bodies.iter_mut().zip(dark).enumerate() {
            if let Some(cause) = cause {
                body.frames[*cause as usize] += 1;
            }
            let since = match body.since {
                Some((since, was_dark)) if was_dark == cause.is_some() => since,
                _ => {
                    body.since = Some((at, cause.is_some()));
                    at
                }
            };
            if at.ns_since(since) < EPISODE_NS {
                continue;
            }
            match (cause, body.told) {
                // That is told once for the whole rig.
                (Some(DarkCause::HeadLost), None) => {}
                (Some(cause), None) => {
                    body.told = Some(since);
                    note(i, format!("is dark: {}", cause.told()));
                }
                (None, Some(began)) => {
                    body.told = None;
                    note(i, format!("has light again, after {:.1} s", since.ns_since(began) as f64 * 1e-9));
                }
                _ => {}
            }
        }
    }

    /// The counters, with the bodies' names.
    pub(crate) fn report<'a>(&self, names: impl Iterator<Item = &'a str>) -> Vec<DarkBody> {
        let of = |body: &BodyDarkness, cause: DarkCause| body.frames[cause as usize];
        self.bodies
            .iter()
            .zip(names)
            .map(|(body, name)| DarkBody {
                body: name.to_owned(),
                never_seen: of(body, DarkCause::NeverSeen),
                silent: of(body, DarkCause::Silent),
                beyond_horizon: of(body, DarkCause::BeyondHorizon),
                head_lost: of(body, DarkCause::HeadLost),
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use DarkCause::{BeyondHorizon, NeverSeen, Silent};

    /// Found in use, R6: bodies were black for minutes without any message. Every frame counts. An episode gives one
    /// note at its beginning and one at its end, however often a body flickers in between.
    #[test]
    fn every_dark_frame_counts_and_an_episode_is_told_once() {
        let mut bodies = DarkBodies::new(2);
        let mut notes = Vec::new();
        // 100 frames per second. The first body is dark from 1 s to 3 s, with single lit frames in between, and later
        // in single frames.
        for k in 0..600i64 {
            let at = HostTime(k * 10_000_000);
            let first = match k {
                100..300 if k % 50 != 49 => Some(BeyondHorizon),
                400.. if k % 50 == 0 => Some(Silent),
                _ => None,
            };
            bodies.lit(&[first, Some(NeverSeen)], at, |body, told| notes.push((k, body, told)));
        }
        let report = bodies.report(["bunny", "venus"].into_iter());
        assert_eq!((report[0].beyond_horizon, report[0].silent, report[0].never_seen), (196, 4, 0));
        assert_eq!((report[1].body.as_str(), report[1].never_seen, report[1].total()), ("venus", 600, 600));
        let told: Vec<(i64, usize)> = notes.iter().map(|(k, body, _)| (*k, *body)).collect();
        assert_eq!(told, [(10, 1), (110, 0), (309, 0)]);
        assert!(
            notes[1].2.contains("safety.predict_ms") && notes[2].2.contains("again, after 2.0 s"),
            "{notes:?}"
        );
    }
}
