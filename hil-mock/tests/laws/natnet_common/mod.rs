//! What the NatNet tests have in common: a server's two bodies, and where it listens.

use dpm_device::pose::Pose;
use dpm_device::tracker::BodyKey;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::net::Ipv4Addr;

pub(crate) const MS: i64 = 1_000_000;
pub(crate) const S: i64 = 1_000 * MS;
pub(crate) const LOCALHOST: Ipv4Addr = Ipv4Addr::LOCALHOST;

/// Bodies known by name alone.
pub(crate) fn keys(names: &[&str]) -> Vec<BodyKey> {
    names.iter().map(|n| BodyKey { name: (*n).to_owned(), id: None }).collect()
}

/// A body that goes to and fro in x, and one that turns in place; 500 Hz.
pub(crate) fn source(faults: &str, latency_ns: i64) -> SampleSource {
    let rest = Pose { position_m: [0.1, 0.2, 1.5], ..Pose::IDENTITY };
    let rotate = MotionSpec::Rotate { axis: [0.0, 1.0, 0.0], rate_rad_s: 3.0, pivot_offset_m: [0.0; 3] };
    let motions = vec![
        Motion::new(&MotionSpec::paper_translation(), rest).unwrap(),
        Motion::new(&rotate, rest).unwrap(),
    ];
    let config = MockTrackerConfig { faults: faults.parse().unwrap(), latency_ns, ..Default::default() };
    SampleSource::new(config, motions).unwrap()
}
