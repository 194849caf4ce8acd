//! `hil-mock serve lit-camera`: a projector, what it lights, and a camera that sees that.

use super::projector::{run_beside, Beside, ProjectorArguments};
use super::{cannot_serve, say};
use clap::Args;
use dpm_device::tag36h11::TagBoard;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use hil_mock::camera::{CameraHost, LitCamera, LitStage, MockCameraConfig, ShownLight};
use hil_mock::projector::Shown;
use hil_mock::usb_plug::{monotonic_clock, Clock};
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Lit slots that may wait for the camera.
const SHOWN_KEPT: usize = 64;

/// Arguments of `hil-mock serve lit-camera`. --port and what follows belongs to the projector.
#[derive(Args)]
pub(crate) struct LitCameraArguments {
    /// TCP port of the camera on 127.0.0.1
    #[arg(long, default_value_t = 8951)]
    camera_port: u16,
    /// Columns and rows of the camera, as 1280x800
    #[arg(long, default_value = "1280x800")]
    camera_size: String,
    /// Pictures per second of the camera
    #[arg(long, default_value_t = 10)]
    camera_rate: u32,
    /// Exposure of the camera, milliseconds
    #[arg(long, default_value_t = 20.0)]
    exposure_ms: f64,
    /// Grey level of white in the projector's full light at a metre
    #[arg(long, default_value_t = 620.0)]
    brightness: f64,
    /// File into which the camera's lens is written
    #[arg(long, value_name = "FILE", default_value = "lit-camera.yaml")]
    lens_file: PathBuf,
    /// Draws lens and place of the projector, the camera's place, and what stands before them: a wall, balls and the board for A3
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    projector: ProjectorArguments,
}

/// The camera beside the projector.
struct Eye {
    light: Arc<ShownLight>,
    camera: CameraHost,
}

impl Beside for Eye {
    fn see(&mut self, shown: Vec<Shown>, _: HostTime) -> Result<(), Box<dyn Error>> {
        shown.iter().for_each(|s| self.light.add(s));
        if self.camera.is_running() {
            Ok(())
        } else {
            Err("the camera's socket failed".into())
        }
    }
}

/// Serves until the time is over or a port fails.
pub(super) fn run(arguments: &LitCameraArguments) -> Result<(), Box<dyn Error>> {
    let size = super::camera::numbers(&arguments.camera_size, 'x', "columns and rows such as 1280x800")?;
    let raster = arguments.projector.raster();
    let drawn = LitStage::drawn(size, [raster.width(), raster.height()], &TagBoard::LARGE, arguments.seed);
    let stage = LitStage { light: arguments.brightness, ..drawn };
    let rate = FrameRate::new(arguments.camera_rate, 1).ok_or("--camera-rate: must be above 0")?;
    let exposure_ns = (arguments.exposure_ms * 1e6) as i64;
    let config = MockCameraConfig { rate, exposure_ns, ..MockCameraConfig::default() };
    let (light, view) = (Arc::new(ShownLight::new(raster)), stage.clone().view());
    let camera = LitCamera::new(config, view, light.clone())?;
    let clock: Clock = monotonic_clock();
    let host_clock: Arc<dyn HostClock> = {
        let clock = clock.clone();
        Arc::new(move || clock())
    };
    let address = SocketAddrV4::new(Ipv4Addr::LOCALHOST, arguments.camera_port);
    let camera = CameraHost::start(camera, address, host_clock)
        .map_err(|e| cannot_serve("a camera", address, &e, "--camera-port"))?;
    tell(&stage, &camera, &arguments.lens_file)?;
    run_beside(&arguments.projector, SHOWN_KEPT, clock, &mut Eye { light, camera })
}

/// Writes the camera's lens, and says what goes into the rig file, and the truth.
fn tell(stage: &LitStage, camera: &CameraHost, lens: &Path) -> Result<(), String> {
    let (c, p) = (&stage.camera, &stage.projector);
    // OpenCV counts from the middle of the first pixel.
    let matrix = [c.focal[0], 0.0, c.centre[0] - 0.5, 0.0, c.focal[1], c.centre[1] - 0.5, 0.0, 0.0, 1.0];
    let entry = |name: &str, [rows, columns]: [usize; 2], data: &[f64]| {
        format!("{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {data:?}\n")
    };
    let size = format!("image_width: {}\nimage_height: {}\n", c.size[0], c.size[1]);
    let (inside, bends) =
        (entry("camera_matrix", [3, 3], &matrix), entry("distortion_coefficients", [5, 1], &c.lens));
    std::fs::write(lens, format!("%YAML:1.0\n---\n{size}{inside}{bends}"))
        .map_err(|e| format!("cannot write {}: {e}", lens.display()))?;
    let (place, turn) = (stage.camera_pose.position_m, stage.camera_pose.rotation_xyzw);
    say(format_args!("camera on {}; in the rig file:", camera.address()));
    say(format_args!(
        "[tracker]\nkind = \"camera\"\ndevice = \"tcp:{}\"\nsize = {:?}",
        camera.address(),
        c.size
    ));
    say(format_args!("calibration = {:?}", lens.display().to_string()));
    say(format_args!("transform = {{ position = {place:?}, rotation = {turn:?} }}"));
    let (at, turn) = (stage.projector_pose.position_m, stage.projector_pose.rotation_xyzw);
    say(format_args!("# truth: projector at {at:?}, turned by {turn:?}"));
    say(format_args!("# truth: focal {:?}, centre {:?}, lens {:?}", p.focal, p.centre, p.lens));
    Ok(())
}
