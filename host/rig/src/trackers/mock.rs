//! `tracker.kind = "mock"`: a software tracker in this process.

use super::keys::{SampleErrors, SourceError, TrackerConfig, TrackerKeys, TrackerPlace};
use super::kind::{MockServer, PoseOrigin, TrackerKind};
use super::transform::TrackerTransformConfig;
use crate::mock::{self, FaultPlan, MockTracker};
use dpm_common::keys::read::{refuse, Any, KeyReader, Within};
use dpm_common::keys::rows::OfKind;
use dpm_common::section;
use dpm_device::time::FrameRate;
use dpm_device::tracker::Tracker;
use std::sync::Arc;

section! {
    /// The embedded mock tracker.
    pub struct MockTrackerConfig {
        /// Samples per second.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
        /// Time from mid-exposure to arrival at the host.
        latency_us: u32 = 2_000, "us", Within(0, 1_000_000);
        /// Longest extra delay of a sample, uniformly distributed.
        jitter_us: u32 = 0, "us", Within(0, 1_000_000);
        /// Standard deviation of the reported position on each axis.
        noise_m: f64 = 0.0, "m", Within(0.0, 1.0);
        /// Standard deviation of the reported rotation about each axis.
        noise_rad: f64 = 0.0, "rad", Within(0.0, 1.0);
        /// Share of samples that never arrive.
        drop_out: f64 = 0.0, "", Within(0.0, 1.0);
        /// Faults to inject, in the mock's own notation; empty for none.
        faults: String = String::new(), "", Any;
        /// Seed of noise, jitter and drop-out.
        seed: u64 = 1, "", Any;
    }
}

pub(super) static KIND: TrackerKind = TrackerKind::of::<MockTrackerConfig>(
    "mock",
    "a software tracker in this process, driven by `scene.bodies[].motion`.",
    PoseOrigin::Simulated,
    "docs/TRACKERS.md#faults",
    &[],
    // It is one itself.
    |_| Ok(MockServer { keys: Vec::new(), running: Box::new(()) }),
);

/// The mock that plays in place of a tracker with `rate_hz` samples per second.
pub fn simulated(rate_hz: Option<u32>) -> TrackerConfig {
    let keys = MockTrackerConfig::default();
    let rate_hz = rate_hz.unwrap_or(keys.rate_hz);
    OfKind::new(&KIND, Arc::new(MockTrackerConfig { rate_hz, ..keys }))
}

impl TrackerKeys for MockTrackerConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        None
    }

    fn errors(&self) -> Option<SampleErrors> {
        Some(SampleErrors {
            position_m: self.noise_m,
            rotation_rad: self.noise_rad,
            delivery_ns: i64::from(self.latency_us) * 1000,
        })
    }

    fn place(&self) -> String {
        "the mock in this process".into()
    }

    fn remedy(&self) -> &'static str {
        "`tracker.faults` and `tracker.drop_out` may silence the mock"
    }

    fn check(&self, reader: &mut KeyReader) {
        if let Err(e) = mock::check_tracker_faults(&self.faults) {
            let remedy = mock::FAULTS_REMEDY.to_owned();
            refuse(reader, &["tracker.faults"], e.to_string(), remedy);
        }
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let mut faults = self.faults.clone();
        // `drop_out` is an additional fault.
        if self.drop_out > 0.0 {
            let separator = if faults.trim().is_empty() { "" } else { "," };
            faults.push_str(&format!("{separator}loss={}", self.drop_out));
        }
        let faults = faults.parse::<FaultPlan>();
        let config = mock::MockTrackerConfig {
            seed: self.seed,
            rate: FrameRate::new(self.rate_hz, 1)
                .expect("the rate was checked when the configuration was read"),
            position_noise_m: self.noise_m,
            rotation_noise_rad: self.noise_rad,
            latency_ns: i64::from(self.latency_us) * 1000,
            latency_jitter_ns: i64::from(self.jitter_us) * 1000,
            faults: faults.map_err(|e| SourceError::of_key("tracker.faults", e))?,
            ..Default::default()
        };
        let tracker = MockTracker::new(config, place.motions);
        Ok(Box::new(tracker.map_err(|e| SourceError::of_key("tracker", e))?))
    }
}
