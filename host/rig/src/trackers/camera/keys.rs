//! The keys of a camera.

use crate::trackers::transform::TrackerTransformConfig;
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::section;
use std::path::PathBuf;

section! {
    /// A printed tag on a body.
    pub struct TagConfig {
        /// Name of the body: one of `scene.bodies[].name`, or what a person wears.
        body: String = String::new(), "", NotEmpty;
        /// Its number in the family AprilTag 36h11.
        id: u16 = 0, "", Within(0, 586);
        /// Length of a side of its black border, without the white margin. Measure the print.
        side_m: f64 = 0.08, "m", Within(0.005, 2.0);
        /// Where its middle lies in the body.
        position: [f64; 3] = [0.0; 3], "m", Within(-100.0, 100.0);
        /// Rotations about x, then y, then z, from the body's axes to the tag's: x to the right and y up as printed, z towards
        /// who reads it.
        rotation_deg: [f64; 3] = [0.0; 3], "deg", Within(-360.0, 360.0);
        /// The rotation as a quaternion x, y, z, w instead; its length does not matter.
        rotation: Option<[f64; 4]> = None, "", Within(-1e6, 1e6);
    }
}

section! {
    /// A marker of retro-reflective tape on a body.
    pub struct MarkerConfig {
        /// Name of the body: one of `scene.bodies[].name`, or what a person wears.
        body: String = String::new(), "", NotEmpty;
        /// Where its middle lies in the body.
        position: [f64; 3] = [0.0; 3], "m", Within(-100.0, 100.0);
    }
}

section! {
    /// Another camera of the same tracker. What it has not of its own is as of the first.
    pub struct OtherCameraConfig {
        /// As `tracker.device`.
        device: String = String::new(), "", NotEmpty;
        /// Where it stands in the space of the first camera, which looks along -Z with +Y up. Must be given.
        position: Option<[f64; 3]> = None, "m", Within(-100.0, 100.0);
        /// Rotations about x, then y, then z, from its own axes to those of the first camera.
        rotation_deg: [f64; 3] = [0.0; 3], "deg", Within(-360.0, 360.0);
        /// The rotation as a quaternion x, y, z, w instead; its length does not matter.
        rotation: Option<[f64; 4]> = None, "", Within(-1e6, 1e6);
        /// Columns and rows of its pictures.
        size: Option<[u32; 2]> = None, "px", Within(16, 8192);
        /// Exposure of its pictures; as of the first camera if left out.
        exposure_us: Option<u32> = None, "us", Within(1, 1_000_000);
        /// Gain, in its own units; as of the first camera if left out.
        gain: Option<u32> = None, "", Within(0, 1_000_000);
        /// From the exposure of its first row to that of its last.
        readout_us: Option<u32> = None, "us", Within(0, 1_000_000);
        /// A calibration file of its lens; a file of the first camera is not its own.
        calibration: Option<PathBuf> = None, "", NotEmpty;
        /// Horizontal angle of view without a calibration file.
        view_deg: f64 = 60.0, "deg", Within(5.0, 170.0);
    }
}

section! {
    /// A camera.
    pub struct CameraTrackerConfig {
        /// A camera of this machine through V4L2, by `/dev/video0` or better by its name below `/dev/v4l/by-id`; or
        /// `tcp:HOST:PORT` of `hil-mock serve camera`.
        device: String = "tcp:127.0.0.1:8951".into(), "", NotEmpty;
        /// Columns and rows of its pictures.
        size: [u32; 2] = [1280, 800], "px", Within(16, 8192);
        /// Pictures per second.
        rate_hz: u32 = 60, "Hz", Within(1, 1_000);
        /// Exposure, which the camera then leaves alone; keep it short, because motion blurs. Without it the camera's
        /// own setting counts, which must be by hand. `dpm rehearse` counts with it for `tcp:`, too, and with 2000 us
        /// without it.
        exposure_us: Option<u32> = None, "us", Within(1, 1_000_000);
        /// Gain, in the camera's own units (`v4l2-ctl -L` lists them). Without it the camera keeps its own. Not for `tcp:`.
        gain: Option<u32> = None, "", Within(0, 1_000_000);
        /// Time from the exposure of the first row to that of the last, of a camera with a rolling shutter; 0 for a global
        /// shutter. Not for `tcp:`.
        readout_us: u32 = 0, "us", Within(0, 1_000_000);
        /// A calibration file of its lens, as OpenCV and others write it (docs/CALIBRATION.md); it needs
        /// no pose, and one is not used.
        calibration: Option<PathBuf> = None, "", NotEmpty;
        /// Horizontal angle of view of a camera without a calibration file, whose lens then bends nothing.
        view_deg: f64 = 60.0, "deg", Within(5.0, 170.0);
        /// More cameras that look at the same bodies, each with its place relative to the first.
        others: Vec<OtherCameraConfig> = Vec::new(), "", Any;
        /// Tags on the bodies.
        tags: Vec<TagConfig> = Vec::new(), "", Any;
        /// Markers on the bodies: at least 4 on a body that has any.
        markers: Vec<MarkerConfig> = Vec::new(), "", Any;
        /// Grey level that markers reach and nothing else does.
        marker_level: u8 = 100, "", Within(1, 255);
        /// From the camera's coordinates to the world's; the camera looks along -Z, and +Y is up. It is the camera's pose.
        transform: TrackerTransformConfig = TrackerTransformConfig::default(), "", Any;
        /// Time by which a sample is older than its time stamp says. `dpm calibrate latency` measures it. Negative if
        /// stamps are too old.
        latency_us: i64 = 0, "us", Within(-200_000, 200_000);
    }
}
