//! The mock tracker and the mock projector as the rig takes them. This is the only file of the rig that names the crate `hil-mock`.

use crate::config::{MockProjectorConfig, MockTrackerConfig};
use dpm_device::planes::Raster;
use dpm_device::time::{FrameRate, HostTime};
use hil_mock::faults::{FaultKind, FaultPlan};
use hil_mock::projector::{DeviceClock, FaultyProjector, MockConfig};
use hil_mock::tracker::{MockTracker, MockTrackerError, TRACKER_FAULTS};

pub(crate) use hil_mock::faults::FaultError;
pub(crate) use hil_mock::motion::{Motion, MotionError, MotionSpec};
pub(crate) use hil_mock::projector::{serve_cable, EmulatedProjector, MockProjector, Served};

/// Why there is no mock tracker.
#[derive(Debug, thiserror::Error)]
pub enum MockOpenError {
    /// Its numbers.
    #[error("tracker: {0}")]
    Numbers(#[from] MockTrackerError),
    /// Its faults.
    #[error("tracker.faults: {0}")]
    Faults(#[from] FaultError),
}

/// Opens the mock tracker of bodies that move by `motions`.
///
/// # Errors
/// Numbers or faults that a mock tracker cannot have.
pub(crate) fn tracker(c: &MockTrackerConfig, motions: Vec<Motion>) -> Result<MockTracker, MockOpenError> {
    let mut faults = c.faults.clone();
    // `drop_out` is one more fault.
    if c.drop_out > 0.0 {
        let separator = if faults.trim().is_empty() { "" } else { "," };
        faults.push_str(&format!("{separator}loss={}", c.drop_out));
    }
    let config = hil_mock::tracker::MockTrackerConfig {
        seed: c.seed,
        rate: FrameRate::new(c.rate_hz, 1).expect("the rate was checked when the configuration was read"),
        position_noise_m: c.noise_m,
        rotation_noise_rad: c.noise_rad,
        latency_ns: i64::from(c.latency_us) * 1000,
        latency_jitter_ns: i64::from(c.jitter_us) * 1000,
        faults: faults.parse::<FaultPlan>()?,
        ..Default::default()
    };
    Ok(MockTracker::new(config, motions)?)
}

/// A mock projector, dark. Times of its injected faults count from `start`.
///
/// # Errors
/// Faults that a mock projector cannot have.
pub(crate) fn projector(
    c: &MockProjectorConfig,
    raster: Raster,
    flash_limit: Option<u8>,
    seed: u64,
    start: HostTime,
) -> Result<EmulatedProjector, FaultError> {
    let mut setup = MockConfig::new(raster);
    setup.frame_buffers = c.buffer_frames.min(64) as u8;
    setup.clock = DeviceClock { skew_ppb: (c.clock_ppm * 1000.0) as i32, ..DeviceClock::IDEAL };
    setup.flash_limit = flash_limit;
    EmulatedProjector::new(setup, &c.faults, seed, start)
}

/// Checks `tracker.faults` of a rig file.
///
/// # Errors
/// Text that is no plan of faults, or faults that a tracker does not have.
pub(crate) fn check_tracker_faults(text: &str) -> Result<(), FaultError> {
    check_faults(text, &TRACKER_FAULTS, "the mock tracker")
}

/// Checks `projector.backend.faults` of a rig file.
///
/// # Errors
/// Text that is no plan of faults, or faults that a projector does not have.
pub(crate) fn check_projector_faults(text: &str) -> Result<(), FaultError> {
    check_faults(text, &FaultyProjector::KNOWN, "the mock projector")
}

fn check_faults(text: &str, known: &[FaultKind], mock: &'static str) -> Result<(), FaultError> {
    text.parse::<FaultPlan>()?.check_supported(known, mock)
}
