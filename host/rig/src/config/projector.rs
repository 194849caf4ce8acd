//! `[projector]`: the projector, its position, and its connection.

use super::values::{BitOrder, Each, PerChannel};
use crate::projectors::{FrameKeys, LitTime, PlaneTiming, PlaneWeights, ProjectorBackend};
use crate::trackers::PoseConfig;
use dpm_common::keys::read::{Any, Limit, NotEmpty, Within};
use dpm_common::keys::RateBound;
use dpm_common::{kinds, section, words};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;
use dpm_render::warp::FOLLOW_SHARE;
use glam::DAffine3;
use std::path::PathBuf;

section! {
    /// The projector. Pixel (0, 0) is the upper left mirror in the projected picture.
    pub struct ProjectorConfig {
        /// Mirrors in a row. Change it to the panel's size; every size from 1 on works.
        width: u32 = 1024, "px", Within(1, Raster::MAX_SIDE);
        /// Rows of mirrors.
        height: u32 = 768, "px", Within(1, Raster::MAX_SIDE);
        /// Frames per second, as a whole number or as a fraction in a string, for example "60000/1001". Set it to
        /// the projector's rate.
        frame_rate: FrameRate = FrameRate::new(947, 1).expect("not zero"), "frames/s", Within(RateBound(1, 1), RateBound(100_000, 1));
        /// Bit planes in a frame: 24 are eight bits of red, green and blue; 8 are eight bits of one white channel,
        /// which shows the green of the picture.
        planes: u32 = 24, "", OneOf(&[8, 24]);
        /// How much light the planes of a channel give. "binary" halves it from plane to plane; "equal" gives every
        /// plane the same, and shows grey as a halftone. Change it if the projector lights all planes alike, as a
        /// DLPC900 behind a video signal or an ALP. "split" shows the highest bit three times in place of the two
        /// lowest: twice the light, and half the levels. It needs a projector that offers it (docs/PROTOCOL.md, section
        /// 17). "auto" is "split" where a projector offers it and the rig has no limits on light, no calibration file,
        /// no `response`, no `flat_field` and no `plane_order` of its own; otherwise "binary".
        weights: PlaneWeights = PlaneWeights::Binary, "", Any;
        /// The order in which a frame shows the bits of a code value, in red, green and blue in turn. The default
        /// lights the highest bits together, which smears a moving picture least; "7 6 5 4 3 2 1 0" needs the least
        /// prediction. Has no effect on planes of equal or split weights.
        plane_order: BitOrder = BitOrder::default(), "", Any;
        /// The instant for which each bit plane shows the bodies. "own": the planes of each bit show them where they
        /// are while these planes are lit, so that a moving picture is not smeared. "frame": all at the centre of the
        /// frame's light, which saves two passes.
        plane_poses: PlanePoses = PlanePoses::Own, "", Any;
        /// How far the planes of each bit go from the centre of the frame's light towards their own instant with
        /// `plane_poses = "own"`, at 947 frames/s and above; at lower rates they stop the same time short of it. 1 is
        /// sharpest for an eye that follows a body; less is less noisy for one that rests. Planes of equal and split
        /// weights, and those that show a whole code value, always go to their own instant.
        plane_follow: f64 = FOLLOW_SHARE, "", Within(0.0, 1.0);
        /// Whether the projector gets the places of the bodies between frames, so that it moves their light while the
        /// planes are lit. "auto": if it offers that, and not on a serial line. Not tried on real hardware.
        tracks: TracksUse = TracksUse::Off, "", Any;
        /// Position of the projector's lens in the world. Measure it, or give `calibration` instead.
        position: [f64; 3] = [0.0, 0.35, 1.1], "m", Within(-1e6, 1e6);
        /// The point in the world that the centre of the raster shows.
        look_at: [f64; 3] = [0.0, 0.1, 0.0], "m", Within(-1e6, 1e6);
        /// The direction in the world that is up in the picture. It need not be perpendicular to the view.
        up: [f64; 3] = [0.0, 1.0, 0.0], "", Within(-1e6, 1e6);
        /// Full angle of view across the raster's width. Change it to match the lens.
        horizontal_fov_deg: f64 = 30.0, "deg", Within(0.1, 170.0);
        /// A calibration file that replaces `position`, `look_at`, `up` and `horizontal_fov_deg`, in any form of
        /// docs/CALIBRATION.md. If the file names a raster, it must have this one's shape. Use it for every real
        /// rig.
        calibration: Option<PathBuf> = None, "", NotEmpty;
        /// Unit of the lengths in the calibration file; its numbers do not show it. Required with `calibration`.
        calibration_unit: Option<CalibrationUnit> = None, "", Any;
        /// Model of the lens in the calibration file. "auto" takes the file's word; four coefficients without a word
        /// are k1 k2 p1 p2. "fisheye" is OpenCV's `cv::fisheye`.
        calibration_lens: CalibrationLens = CalibrationLens::Auto, "", Any;
        /// The region of an MPCDI file that is this projector; needed if the file has several.
        calibration_region: Option<String> = None, "", NotEmpty;
        /// The device of a calibration file that is this projector, by the name of its section or "projector"; needed
        /// if the file describes several devices.
        calibration_device: Option<String> = None, "", NotEmpty;
        /// Pose in the world of the camera that made the calibration file.
        calibration_camera: Option<CalibrationCameraConfig> = None, "", Any;
        /// Columns and rows of the raster that the calibration file refers to; the projector's own if left out. Its
        /// view is kept if `width` and `height` differ.
        calibration_raster: Option<[u32; 2]> = None, "px", Within(1, Raster::MAX_SIDE);
        /// Radiant intensity of one pixel at full drive, in scene units: one number, or one for each channel. The
        /// scene's radiance 1 needs `pi * d^2 / albedo` at distance d. Raise it if light is clipped; lower it if
        /// the picture uses few of its levels.
        max_intensity: PerChannel = PerChannel([8.0; 3]), "scene units/sr", Each(1e-6, 1e12);
        /// How much light a code value gives. Binary planes of calibrated LEDs are linear; a display's are not.
        response: ResponseConfig = ResponseConfig::default(), "", Any;
        /// A picture of a white field, as measured on a surface at an even distance (linear PNG with 8 or 16 bits, or
        /// PFM, of any size). Pixels that are darker than the brightest one, whose light `max_intensity` is, are
        /// driven harder.
        flat_field: Option<PathBuf> = None, "", NotEmpty;
        /// The `weights` with which `response` and `flat_field` were measured; the rig's own if left out, but never
        /// "split". A rig with other planes is refused.
        measured_with: Option<PlaneWeights> = None, "", Any;
        /// Time by which light falls later than the projector reports. Set it if a check shows that light trails the
        /// motion whatever the tracker.
        latency_us: u32 = 0, "us", Within(0, 200_000);
        /// Bit planes that the panel can show per second; a greater `frame_rate * planes` is refused. The default is
        /// 44.0 us a plane, which is 947 frames of 24 planes.
        max_planes_per_second: u32 = 22_728, "planes/s", Within(1, 10_000_000);
        /// How the program reaches the projector.
        backend: ProjectorBackend = Default::default(), "", Any;
    }
}

impl ProjectorConfig {
    /// The mirror array; sides are in range once the configuration is accepted.
    pub fn raster(&self) -> Raster {
        Raster::new(self.width, self.height).expect("sides were checked when the configuration was read")
    }

    /// The raster that the calibration file refers to.
    pub fn calibrated_raster(&self) -> Raster {
        let own = self.raster();
        self.calibration_raster.map_or(own, |[w, h]| {
            Raster::new(w, h).expect("sides were checked when the configuration was read")
        })
    }

    /// How the light of a frame is shared out over its exposure.
    pub fn plane_timing(&self) -> PlaneTiming {
        self.backend.plane_timing()
    }

    /// Which part of a frame its planes take.
    pub fn lit_time(&self) -> LitTime {
        self.backend.lit_time(&self.frame_keys())
    }

    /// True if the projector's video input, and not this program, decides what is lit.
    pub fn is_lit_by_video_input(&self) -> bool {
        self.backend.is_lit_by_video_input()
    }

    /// True if less than a hundredth of a frame is dark: what the codes of a light sensor are made for.
    pub fn is_lit_without_gap(&self) -> bool {
        let LitTime { whole_ns, dark_ns, frame_ns } = self.lit_time();
        100 * (frame_ns - whole_ns) < frame_ns && dark_ns == 0
    }

    /// Light of a mirror that is on in all planes, as a code value of which 255 is full light. It is less where planes of
    /// equal light are lit by LEDs that are dimmed for the bits of a code value, and more where planes exceed full light.
    pub fn full_light(&self) -> u32 {
        self.schedule().full_light()
    }

    /// Radiant intensity of each channel of a mirror whose light is 255, in scene units: what recorders and mocks count light in.
    /// It is `max_intensity`, and more where planes exceed full light.
    pub fn intensity_at_255(&self) -> [f64; 3] {
        let schedule = self.schedule();
        let times = f64::from(schedule.white_weight()) / f64::from(schedule.limit_weight());
        self.max_intensity.0.map(|intensity| intensity * times)
    }

    /// True if each plane has a brightness of its own, as on the bit-plane link: its light source is dimmed, and nothing was
    /// loaded before.
    pub fn dims_planes(&self) -> bool {
        !self.backend.is_lit_fully() && !self.backend.kind().is_loaded()
    }

    /// `schedule` as this projector lights it: a light source that is not dimmed from plane to plane gives full white where
    /// all planes are on, whatever their bits.
    pub fn lit_by(&self, schedule: PlaneSchedule) -> PlaneSchedule {
        if self.backend.is_lit_fully() {
            schedule.filled()
        } else {
            schedule
        }
    }

    /// From the start of a slot on the projector's clock to the light of its frame, nanoseconds: `latency_us`, and what the
    /// kind of projector adds.
    pub fn light_delay_ns(&self) -> i64 {
        i64::from(self.latency_us) * 1000 + self.backend.light_delay_ns(self.frame_rate.slot_len_ns(0))
    }

    /// The planes of a frame in the order in which they are shown.
    pub fn schedule(&self) -> PlaneSchedule {
        self.backend.schedule().unwrap_or_else(|| self.lit_by(self.schedule_of(self.weights)))
    }

    /// What the kind of projector has to know of frames to judge its keys.
    pub(super) fn frame_keys(&self) -> FrameKeys {
        let size = [self.width, self.height];
        FrameKeys { size, rate: self.frame_rate, planes: self.planes, weights: self.weights }
    }

    /// White of planes of these weights as a share of the full white that limits on light count in.
    pub fn white_of(&self, weights: PlaneWeights) -> f64 {
        let of_keys = || f64::from(self.lit_by(self.schedule_of(weights)).full_light()) / 255.0;
        self.backend.schedule().map_or_else(of_keys, |_| 1.0)
    }

    /// The weights of the planes with which light is taken to have been measured, by what a rig file or a calibration file says of
    /// it. What says nothing is older than planes that exceed full light.
    pub(super) fn weights_measured(&self, told: Option<PlaneWeights>) -> PlaneWeights {
        let own = Some(self.weights).filter(|weights| !weights.are_split());
        told.or(own).unwrap_or(PlaneWeights::Binary)
    }

    /// The planes that `planes`, `plane_order` and these weights describe.
    fn schedule_of(&self, weights: PlaneWeights) -> PlaneSchedule {
        let BitOrder(bits) = self.plane_order;
        let binary = match self.planes {
            8 => PlaneSchedule::mono8_in(bits),
            _ => PlaneSchedule::rgb24_in(bits),
        };
        match (self.planes, weights) {
            (8, PlaneWeights::Equal) => PlaneSchedule::equal_mono8(),
            (_, PlaneWeights::Equal) => PlaneSchedule::equal_rgb24(),
            (8, PlaneWeights::Split | PlaneWeights::Auto) => PlaneSchedule::split_mono8(),
            (_, PlaneWeights::Split | PlaneWeights::Auto) => PlaneSchedule::split_rgb24(),
            (_, PlaneWeights::Binary) => {
                binary.expect("the order was checked when the configuration was read")
            }
        }
    }
}

kinds! {
    /// How much light a code value gives.
    pub enum ResponseConfig {
        /// in proportion to the code value.
        Linear(LinearResponseConfig) = "linear",
        /// a power of the code value.
        Gamma(GammaResponseConfig) = "gamma",
        /// the curve of sRGB (IEC 61966-2-1), which most displays follow in their factory setting.
        Srgb(SrgbResponseConfig) = "srgb",
        /// as measured.
        Table(TableResponseConfig) = "table",
    }
    default Linear
}

section! {
    /// Light in proportion to the code value.
    pub struct LinearResponseConfig {}
}

section! {
    /// Light is `black + (1 - black) * (code / 255) ^ gamma`, as a share of full light.
    pub struct GammaResponseConfig {
        /// The power: one number, or one for each channel. 2.2 for most displays.
        gamma: PerChannel = PerChannel([2.2; 3]), "", Each(0.1, 10.0);
        /// Light at code 0 as a share of full light: one number, or one for each channel.
        black: PerChannel = PerChannel([0.0; 3]), "", Each(0.0, 0.5);
    }
}

section! {
    /// Light by the curve of sRGB.
    pub struct SrgbResponseConfig {}
}

section! {
    /// Light as measured.
    pub struct TableResponseConfig {
        /// A text file of 256 lines with the light of each code value, in any unit: one number for all channels,
        /// or red, green and blue, separated by commas or blanks. Required.
        file: PathBuf = PathBuf::new(), "", NotEmpty;
    }
}

section! {
    /// Pose in the world of the camera that made the calibration file: the inverse of the camera's `rvec` and `tvec`.
    pub struct CalibrationCameraConfig {
        /// Position in the world of the camera that made the calibration file. The table is required if the
        /// file's origin is that camera, as with procam-calibration, and refused otherwise.
        position: [f64; 3] = [0.0; 3], "m", Within(-1e6, 1e6);
        /// Turns that camera's axes (x right, y down, z ahead, as in OpenCV) to the world's: rotations about the
        /// world's x, then y, then z.
        rotation_deg: [f64; 3] = [0.0; 3], "deg", Within(-360.0, 360.0);
        /// The rotation as a quaternion x, y, z, w instead; its length does not matter.
        rotation: Option<[f64; 4]> = None, "", Within(-1e6, 1e6);
    }
}

impl CalibrationCameraConfig {
    /// World-from-camera; `None` if the quaternion is zero, which the check refuses.
    pub fn to_affine(&self) -> Option<DAffine3> {
        let (position, rotation_deg, rotation) = (self.position, self.rotation_deg, self.rotation);
        PoseConfig { position, rotation_deg, rotation }.to_affine()
    }
}

words! {
    /// The instant for which each bit plane shows the bodies.
    pub enum PlanePoses {
        /// Its own.
        Own = "own",
        /// The centre of the frame's light.
        Frame = "frame",
    }
}

words! {
    /// Whether the projector is told of bodies between frames.
    pub enum TracksUse {
        /// If it offers to follow tracks.
        Auto = "auto",
        /// Never.
        Off = "off",
    }
}

words! {
    /// Units of length.
    pub enum CalibrationUnit {
        /// 1 m.
        Metre = "metre",
        /// 0.01 m.
        Centimetre = "centimetre",
        /// 0.001 m.
        Millimetre = "millimetre",
    }
}

words! {
    /// Models of a lens in a calibration file.
    pub enum CalibrationLens {
        /// As the file says.
        Auto = "auto",
        /// OpenCV's fisheye.
        Fisheye = "fisheye",
    }
}

/// One of a few numbers.
pub(super) struct OneOf(pub &'static [u32]);

impl Limit<u32> for OneOf {
    fn allows(&self, value: &u32) -> bool {
        self.0.contains(value)
    }
    fn describe(&self) -> String {
        self.0.iter().map(u32::to_string).collect::<Vec<_>>().join(" or ")
    }
}
