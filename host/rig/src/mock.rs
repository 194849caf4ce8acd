//! The mock tracker and the mock projector, as the rig uses them. No other file of the rig names the crate
//! `hil-mock`.

use dpm_mock::faults::FaultKind;
use dpm_mock::projector::FaultyProjector;
use dpm_mock::tracker::TRACKER_FAULTS;
use std::net::{Ipv4Addr, SocketAddrV4};

#[cfg(feature = "camera")]
pub(crate) use dpm_mock::camera::{
    two_tags, CameraHost, CameraOptics, MarkedBody, MockCamera, MockCameraConfig,
};
pub(crate) use dpm_mock::faults::{FaultError, FaultPlan};
pub(crate) use dpm_mock::motion::{Motion, MotionError, MotionSpec};
pub(crate) use dpm_mock::natnet_host::{free_port, NatNetHost};
pub(crate) use dpm_mock::natnet_server::{NatNetServer, NatNetServerConfig};
pub(crate) use dpm_mock::projector::{
    serve_cable, DeviceClock, EmulatedProjector, MockConfig, MockProjector, Served, GREATEST_SHIFT,
};
pub(crate) use dpm_mock::serial_server::{pseudo_terminal, SerialPoseDevice, SerialPoseHost};
pub(crate) use dpm_mock::tracker::{MockTracker, MockTrackerConfig, SampleSource};
pub(crate) use dpm_mock::vrpn_host::VrpnHost;
pub(crate) use dpm_mock::vrpn_server::{VrpnNames, VrpnReports};

/// Any free port of this machine, for a mock server.
pub(crate) const ANY_PORT: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0);

/// What to write as `faults`.
pub(crate) const FAULTS_REMEDY: &str = "for example \"loss=0.01,dropout@1.5s+20ms\"";

/// Checks `tracker.faults` of a rig file.
///
/// # Errors
/// The text is not a list of faults, or a tracker does not have one of them.
pub(crate) fn check_tracker_faults(text: &str) -> Result<(), FaultError> {
    check_faults(text, &TRACKER_FAULTS, "the mock tracker")
}

/// Checks `projector.backend.faults` of a rig file.
///
/// # Errors
/// The text is not a list of faults, or a projector does not have one of them.
pub(crate) fn check_projector_faults(text: &str) -> Result<(), FaultError> {
    check_faults(text, &FaultyProjector::KNOWN, "the mock projector")
}

fn check_faults(text: &str, known: &[FaultKind], mock: &'static str) -> Result<(), FaultError> {
    text.parse::<FaultPlan>()?.check_supported(known, mock)
}
