//! A camera made of software: what it would see of bodies with printed tags and bright markers.
//!
//! Every pixel is an integral over its area and over the exposure, by stratified samples along true rays: perspective, lens,
//! blur by motion and by the lens, rolling shutter, shading, noise of photons and of reading, and a background with clutter. A picture is a
//! pure function of the seed and its number; the optics share no code with what they judge.

mod board;
mod clutter;
mod host;
mod lit;
mod lit_camera;
mod optics;
mod paint;
mod soften;

pub use board::BoardHold;
pub use host::{CameraHost, PictureMaker};
pub use lit::{LitStage, LitThing, LitView};
pub use lit_camera::{LitCamera, ShownLight};
pub use optics::CameraOptics;

use crate::faults::{FaultError, FaultKind, FaultPlan};
use crate::motion::Motion;
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_device::time::FrameRate;
use soften::Softness;

/// A printed tag of the family AprilTag 36h11 on a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PrintedTag {
    /// Its number.
    pub id: u16,
    /// Length of a side of the black border, metres.
    pub side_m: f64,
    /// Where its middle lies in the body: x to the right and y up as printed, z towards the reader.
    pub place: Pose,
}

/// Two tags of 80 mm on the front of body number `n`, turned out by 25 degrees: numbers 2 n and 2 n + 1.
pub fn two_tags(n: usize) -> [PrintedTag; 2] {
    [-1.0, 1.0].map(|side: f64| {
        let half = 0.5 * (side * 25.0).to_radians();
        let rotation_xyzw = [0.0, libm::sin(half), 0.0, libm::cos(half)];
        let place = Pose { position_m: [side * 0.055, 0.0, 0.0], rotation_xyzw };
        PrintedTag { id: (2 * n + usize::from(side > 0.0)) as u16, side_m: 0.08, place }
    })
}

impl PrintedTag {
    /// The tag as an entry of `tracker.tags` of a rig file.
    pub fn as_toml(&self, body: &str) -> String {
        let (id, side, at) = (self.id, self.side_m, &self.place);
        let place = format!("position = {:?}, rotation = {:?}", at.position_m, at.rotation_xyzw);
        format!("{{ body = {body:?}, id = {id}, side_m = {side:?}, {place} }}")
    }
}

/// A ball of retro-reflective tape on a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BrightMarker {
    /// Its middle in the body, metres.
    pub middle_m: [f64; 3],
    /// Its radius, metres.
    pub radius_m: f64,
}

/// A body as the camera sees it.
#[derive(Clone, Debug)]
pub struct MarkedBody {
    /// How it moves.
    pub motion: Motion,
    /// Its tags.
    pub tags: Vec<PrintedTag>,
    /// Its markers.
    pub markers: Vec<BrightMarker>,
}

/// A camera and what is before it.
#[derive(Clone, Debug)]
pub struct MockCameraConfig {
    /// Raster and lens.
    pub optics: CameraOptics,
    /// World from camera; the camera looks along -Z, +Y is up.
    pub pose: Pose,
    /// Pictures a second.
    pub rate: FrameRate,
    /// Exposure of each row, nanoseconds, above 0.
    pub exposure_ns: i64,
    /// By how much later each row is exposed than the one above it, nanoseconds; 0 for a global shutter.
    pub row_ns: i64,
    /// From the end of a picture's exposure to its arrival, nanoseconds.
    pub latency_ns: i64,
    /// How far the lens spreads the light of a point: standard deviation along each axis, pixels, 0 to 10. The area of a
    /// pixel comes on top.
    pub softness_px: f64,
    /// Grey level of white paper that faces the camera, 0 to 255.
    pub white: f64,
    /// Noise of reading, grey levels.
    pub read_noise: f64,
    /// Noise of photons: variance for each grey level, grey levels.
    pub photon_noise: f64,
    /// Shapes in the background, among them squares with borders and cells that are no tag's.
    pub clutter: u32,
    /// Samples along each side of a pixel where its content is not uniform, 1 to 16.
    pub samples: u32,
    /// Instants of the exposure that are told apart, 1 to 64.
    pub instants: u32,
    /// Seed of noise, clutter and faults.
    pub seed: u64,
    /// What goes wrong: [`CAMERA_FAULTS`].
    pub faults: FaultPlan,
}

/// The faults that a stream of pictures can have.
pub const CAMERA_FAULTS: [FaultKind; 5] =
    [FaultKind::Loss, FaultKind::Dropout, FaultKind::Stuck, FaultKind::Slow, FaultKind::Stall];

impl Default for MockCameraConfig {
    /// 1280 x 800 at 60 Hz, 60 degrees, 2 ms of exposure, global shutter, a lens as soft as those of small cameras in
    /// focus, two grey levels of noise.
    fn default() -> Self {
        Self {
            optics: CameraOptics::pinhole([1280, 800], 60.0),
            pose: Pose::IDENTITY,
            rate: FrameRate::new(60, 1).expect("60 Hz"),
            exposure_ns: 2_000_000,
            row_ns: 0,
            latency_ns: 4_000_000,
            softness_px: 0.5,
            white: 200.0,
            read_noise: 1.5,
            photon_noise: 0.01,
            clutter: 40,
            samples: 4,
            instants: 8,
            seed: 1,
            faults: FaultPlan::default(),
        }
    }
}

/// Why a mock camera cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum MockCameraError {
    /// A number out of range.
    #[error("mock camera: `{field}` is {value}; it must be {rule}")]
    OutOfRange {
        /// Field of [`MockCameraConfig`].
        field: &'static str,
        /// Value given.
        value: f64,
        /// Range.
        rule: &'static str,
    },
    /// A fault that pictures do not have.
    #[error(transparent)]
    Fault(#[from] FaultError),
}

/// When a picture is exposed and arrives, nanoseconds after the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exposure {
    /// The picture's number.
    pub number: u64,
    /// Begin of the exposure of the first row.
    pub begin_ns: i64,
    /// When it arrives.
    pub arrives_ns: i64,
}

/// The camera.
#[derive(Debug)]
pub struct MockCamera {
    config: MockCameraConfig,
    bodies: Vec<MarkedBody>,
    grid: Vec<[f32; 2]>,
    /// What stands behind all bodies, sharp and as the lens shows it.
    background: Vec<f32>,
    soft_background: Vec<f32>,
    /// The picture, in the same two ways.
    light: Vec<f32>,
    soft: Vec<f32>,
    lens: Softness,
    noise: Vec<f32>,
    draws: Draws,
}

impl MockCamera {
    /// A camera before these bodies.
    ///
    /// # Errors
    /// A number is out of its range, or a fault is none of [`CAMERA_FAULTS`].
    pub fn new(config: MockCameraConfig, bodies: Vec<MarkedBody>) -> Result<Self, MockCameraError> {
        let within = |field, value: f64, low: f64, high: f64, rule| {
            let fits = (low..=high).contains(&value);
            fits.then_some(()).ok_or(MockCameraError::OutOfRange { field, value, rule })
        };
        for side in config.optics.size {
            within("size", f64::from(side), 16.0, 8192.0, "16 to 8192")?;
        }
        for focal in config.optics.focal {
            within("focal", focal, 1.0, 1e6, "1 to 1e6 pixels")?;
        }
        within("exposure_ns", config.exposure_ns as f64, 1.0, 1e9, "above 0, and 1 s at most")?;
        within("row_ns", config.row_ns as f64, 0.0, 1e6, "0 to 1e6 ns")?;
        within("softness_px", config.softness_px, 0.0, 10.0, "0 to 10 pixels")?;
        within("white", config.white, 1.0, 255.0, "1 to 255")?;
        within("read_noise", config.read_noise, 0.0, 100.0, "0 to 100")?;
        within("photon_noise", config.photon_noise, 0.0, 10.0, "0 to 10")?;
        within("samples", f64::from(config.samples), 1.0, 16.0, "1 to 16")?;
        within("instants", f64::from(config.instants), 1.0, 64.0, "1 to 64")?;
        config.faults.check_supported(&CAMERA_FAULTS, "the mock camera")?;
        let draws = Draws::new(config.seed);
        let grid = config.optics.grid();
        let background = clutter::background(&config, draws.stream(1));
        let noise = (0..NOISES as u64).map(|i| draws.stream(2).normal(i) as f32).collect();
        let width = config.optics.size[0] as usize;
        let mut lens = Softness::new(config.softness_px, width);
        let mut soft_background = background.clone();
        let whole = [[0, width], [0, config.optics.size[1] as usize]];
        lens.soften(&background, whole, &mut soft_background);
        let (light, soft) = (background.clone(), soft_background.clone());
        Ok(Self { config, bodies, grid, background, soft_background, light, soft, lens, noise, draws })
    }

    /// What it was made with.
    pub fn config(&self) -> &MockCameraConfig {
        &self.config
    }

    /// The bodies before it.
    pub fn bodies(&self) -> &[MarkedBody] {
        &self.bodies
    }

    /// Picture `number`; `None` if it is lost on the way.
    pub fn exposure(&self, number: u64) -> Option<Exposure> {
        let c = &self.config;
        let begin_ns = c.rate.slot_start_ns(number);
        let before = number.checked_sub(1).map_or(i64::MIN, |n| c.rate.slot_start_ns(n));
        let lost = c.faults.strikes(FaultKind::Loss, self.draws, number, before, begin_ns)
            || c.faults.is_on(FaultKind::Dropout, begin_ns);
        let read_ns = c.exposure_ns + c.row_ns * i64::from(c.optics.size[1]);
        let arrives_ns =
            begin_ns + read_ns + c.latency_ns + c.faults.amount(FaultKind::Slow, before, begin_ns) as i64;
        let arrives_ns = c.faults.end_of(FaultKind::Stall, arrives_ns);
        (!lost).then_some(Exposure { number, begin_ns, arrives_ns })
    }

    /// Paints the picture with this exposure into `pixels`, which must have the size of the raster.
    pub fn paint(&mut self, exposure: &Exposure, pixels: &mut Vec<u8>) {
        let begin_ns =
            self.config.faults.window_start(FaultKind::Stuck, exposure.begin_ns).unwrap_or(exposure.begin_ns);
        self.light.copy_from_slice(&self.background);
        let mut sheets = paint::sheets(&self.config, &self.bodies, begin_ns);
        // The nearest comes last, and covers what lies behind it.
        sheets.sort_by(|a, b| b.distance.total_cmp(&a.distance));
        for sheet in &sheets {
            paint::paint(&self.config, &self.grid, sheet, begin_ns, &mut self.light);
        }
        self.soft.copy_from_slice(&self.soft_background);
        for sheet in &sheets {
            self.lens.soften(&self.light, sheet.extent(), &mut self.soft);
        }
        self.develop(exposure.number, pixels);
    }

    /// Adds noise, and rounds to grey levels.
    fn develop(&self, number: u64, pixels: &mut Vec<u8>) {
        let width = self.config.optics.size[0] as usize;
        let (read, photon) = (self.config.read_noise.powi(2) as f32, self.config.photon_noise as f32);
        pixels.resize(self.soft.len(), 0);
        let draws = self.draws.stream(3).stream(number);
        for (row, (out, light)) in
            pixels.chunks_exact_mut(width).zip(self.soft.chunks_exact(width)).enumerate()
        {
            let first = draws.bits(row as u64) as usize % (NOISES - width);
            for ((o, l), n) in out.iter_mut().zip(light).zip(&self.noise[first..first + width]) {
                *o = (l + n * (read + photon * l).sqrt() + 0.5) as u8;
            }
        }
    }
}

/// Normal deviates that are drawn once; each row of a picture begins at another.
const NOISES: usize = 1 << 16;
