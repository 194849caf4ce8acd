//! `[projector]`: the projector, its position, and its connection.

use super::values::{BitOrder, Each, PerChannel};
use super::world::PoseConfig;
use dpm_common::keys::read::{Any, ConfigValue, Limit, NotEmpty, Reader, Within};
use dpm_common::keys::source::{Node, Value};
use dpm_common::keys::Rate;
use dpm_common::{kinds, section, words};
use dpm_device::alp::Weights;
use dpm_device::dlpc900::lut::Dmd;
use dpm_device::link::Codec;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;
use dpm_scene::camera_files::LensKind;
use glam::DAffine3;
use std::path::PathBuf;

section! {
    /// The projector. Pixel (0, 0) is the upper left mirror in the projected picture.
    pub struct ProjectorConfig {
        /// Mirrors in a row. Change it to the panel's size; every size from 1 on works.
        width: u32 = 1024, "px", Within(1, Raster::MAX_SIDE);
        /// Rows of mirrors.
        height: u32 = 768, "px", Within(1, Raster::MAX_SIDE);
        /// Frames per second, as a whole number or as a fraction in a string, for example "60000/1001". Change it to
        /// the rate at which the projector is driven.
        frame_rate: FrameRate = FrameRate::new(947, 1).expect("not zero"), "frames/s", Within(Rate(1, 1), Rate(100_000, 1));
        /// Bit planes in a frame. 24 planes are eight bits of red, green and blue. 8 planes are eight bits of one
        /// white channel, which shows the green of the picture; this gives a monochrome rig three times the frame
        /// rate.
        planes: u32 = 24, "", OneOf(&[8, 24]);
        /// How much light the planes of a channel give: "binary" halves it from plane to plane, so that their bits are the
        /// code value; "equal" gives every plane the same, and shows grey as a halftone of mirrors and planes. Change it
        /// if the projector lights all planes alike: a DLPC900 that shows the bits of a video signal, or an ALP. On a
        /// bit-plane projector equal planes together give 128 / 255 of full white.
        weights: PlaneWeights = PlaneWeights::Binary, "", Any;
        /// The order in which a frame shows the bits of a code value, from its first plane on; red, green and blue in
        /// turn for each bit. The light of "7 6 5 4 3 2 1 0" is over soonest. "0 2 4 6 7 5 3 1" puts most of it into
        /// the middle of the frame, which smears a moving picture by a quarter less. Has no effect on planes of equal
        /// weights.
        plane_order: BitOrder = BitOrder::default(), "", Any;
        /// The instant for which each bit plane shows the bodies. "own": the planes of each bit (each plane, if all give equal
        /// light) are shown where the bodies are while these planes are lit, so that a moving picture is not smeared.
        /// "frame": all planes show the bodies at the centre of the frame's light, which saves two passes where bodies move.
        plane_poses: PlanePoses = PlanePoses::Own, "", Any;
        /// Whether the projector is told between frames where the bodies are by now, so that it moves their light while the
        /// planes are lit. "auto": if it offers that (the link's TRACKS), and not on a serial line. "off": never. Change it to
        /// "auto" if bodies turn sharply and the projector can; it has not been tried on real hardware.
        tracks: TracksUse = TracksUse::Off, "", Any;
        /// Position of the projector's lens in the world. Measure it, or give `calibration` instead.
        position: [f64; 3] = [0.0, 0.35, 1.1], "m", Within(-1e6, 1e6);
        /// The point in the world that the centre of the raster shows.
        look_at: [f64; 3] = [0.0, 0.1, 0.0], "m", Within(-1e6, 1e6);
        /// The direction in the world that is up in the picture. It need not be perpendicular to the view.
        up: [f64; 3] = [0.0, 1.0, 0.0], "", Within(-1e6, 1e6);
        /// Full angle of view across the raster's width. Change it to match the lens.
        horizontal_fov_deg: f64 = 30.0, "deg", Within(0.1, 170.0);
        /// A calibration file that replaces `position`, `look_at`, `up` and `horizontal_fov_deg`: OpenCV FileStorage
        /// XML, YAML or JSON (also as mapamok, procam-calibration and ROS name the entries), or the XML of MPCDI with
        /// profile sl. If the file names a raster, it must have this one's shape; the view is scaled. Use it for every
        /// real rig.
        calibration: Option<PathBuf> = None, "", NotEmpty;
        /// Unit of the lengths in the calibration file; its numbers do not show it. Required with `calibration`.
        calibration_unit: Option<CalibrationUnit> = None, "", Any;
        /// Model of the lens in the calibration file. "auto" takes the file's word (`fisheye_model`,
        /// `distortion_model`); four coefficients without a word are k1 k2 p1 p2. "fisheye" is OpenCV's `cv::fisheye`.
        calibration_lens: CalibrationLens = CalibrationLens::Auto, "", Any;
        /// The region of an MPCDI file that is this projector; needed if the file has several.
        calibration_region: Option<String> = None, "", NotEmpty;
        /// Pose in the world of the camera that made the calibration file.
        calibration_camera: Option<CalibrationCameraConfig> = None, "", Any;
        /// Columns and rows of the raster that the calibration file refers to; the projector's own if left out. The
        /// file's view is kept if `width` and `height` differ, for example to trace fewer pixels (`--raster` then
        /// sets this key).
        calibration_raster: Option<[u32; 2]> = None, "px", Within(1, Raster::MAX_SIDE);
        /// Radiant intensity of one pixel at full drive, in scene units: one number, or one for each channel. The
        /// scene's radiance 1 needs `pi * d^2 / albedo` at distance d. Raise it if the report says that light is
        /// clipped; lower it if the picture uses few of its levels.
        max_intensity: PerChannel = PerChannel([8.0; 3]), "scene units/sr", Each(1e-6, 1e12);
        /// How much light a code value gives. Binary planes of calibrated LEDs are linear; a display's are not.
        response: ResponseConfig = ResponseConfig::default(), "", Any;
        /// A picture of a white field, as measured on a surface at an even distance (linear PNG with 8 or 16 bits, or
        /// PFM; its size need not be the raster's). Pixels that are darker than the brightest one are driven harder,
        /// so that an even picture is even; `max_intensity` is that of the brightest.
        flat_field: Option<PathBuf> = None, "", NotEmpty;
        /// Time by which light falls later than the projector reports. Set it if a check shows that light trails the
        /// motion whatever the tracker.
        latency_us: u32 = 0, "us", Within(0, 200_000);
        /// Bit planes that the panel can show per second; a greater `frame_rate * planes` is refused. The default is
        /// a 1024 x 768 panel at 44.0 us per plane, which is 947 frames of 24 planes.
        max_planes_per_second: u32 = 22_728, "planes/s", Within(1, 10_000_000);
        /// How the program reaches the projector.
        backend: ProjectorBackend = ProjectorBackend::default(), "", Any;
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
        match &self.backend {
            ProjectorBackend::Display(display) if display.encoding == DisplayEncoding::Rgb8 => {
                PlaneTiming::Held
            }
            ProjectorBackend::Window(_) => PlaneTiming::Held,
            ProjectorBackend::Alp(alp) if alp.weights == AlpWeights::Binary => PlaneTiming::ByWeight,
            _ => PlaneTiming::Equal,
        }
    }

    /// Light of a mirror that is on in all planes, as a code value of which 255 is full light. It is less where planes of
    /// equal light are lit by LEDs that are dimmed for the bits of a code value.
    pub fn full_light(&self) -> u32 {
        match &self.backend {
            ProjectorBackend::Display(_) | ProjectorBackend::Window(_) | ProjectorBackend::Alp(_) => 255,
            _ => self.schedule().full_light(),
        }
    }

    /// From the start of a slot on the projector's clock to the light of its frame, nanoseconds: `latency_us`, and for a
    /// display or a window the time until the vertical blank and until the middle row.
    pub fn light_delay_ns(&self) -> i64 {
        let frame_ns = self.frame_rate.slot_len_ns(0);
        let commit_ns = match &self.backend {
            ProjectorBackend::Display(display) => display.commit_ns(frame_ns),
            ProjectorBackend::Window(window) => window.commit_ns(frame_ns),
            _ => return i64::from(self.latency_us) * 1000,
        };
        // The blank comes `commit_us` and half of the time without rows later, the middle row half of the rows after it:
        // together half a frame, whatever the mode.
        i64::from(self.latency_us) * 1000 + commit_ns + frame_ns / 2
    }

    /// The planes of a frame in the order in which they are shown.
    pub fn schedule(&self) -> PlaneSchedule {
        let BitOrder(bits) = self.plane_order;
        let binary = match self.planes {
            8 => PlaneSchedule::mono8_in(bits),
            _ => PlaneSchedule::rgb24_in(bits),
        };
        match (self.planes, self.weights) {
            (8, PlaneWeights::Equal) => PlaneSchedule::equal_mono8(),
            (_, PlaneWeights::Equal) => PlaneSchedule::equal_rgb24(),
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
        /// A text file of 256 lines with the light of each code value, from 0 on, in any unit: one number for all
        /// channels, or red, green and blue, separated by commas or blanks. Required.
        file: PathBuf = PathBuf::new(), "", NotEmpty;
    }
}

kinds! {
    /// The connections to a projector.
    pub enum ProjectorBackend {
        /// a software projector in this process.
        Mock(MockProjectorConfig) = "mock",
        /// a bit-plane projector on USB.
        Usb(UsbProjectorConfig) = "usb",
        /// a bit-plane projector on a serial port.
        Serial(SerialProjectorConfig) = "serial",
        /// a ViALUX ALP-4 or ALP-5, driven by the vendor's library that its user has installed.
        Alp(AlpConfig) = "alp",
        /// a TI DLPC900 evaluation module, driven by its USB HID commands.
        Dlpc900(Dlpc900Config) = "dlpc900",
        /// a display: any projector or monitor on HDMI or DisplayPort.
        Display(DisplayConfig) = "display",
        /// a window on the desktop, for a desk without a projector.
        Window(WindowConfig) = "window",
    }
    default Mock
}

section! {
    /// The embedded mock projector.
    pub struct MockProjectorConfig {
        /// How much faster its clock runs than the host's. Change it to test the clock mapping.
        clock_ppm: f64 = 0.0, "ppm", Within(-1000.0, 1000.0);
        /// Frames that it can hold before one is shown.
        buffer_frames: u32 = 3, "frames", Within(2, 64);
        /// Faults to inject, in the mocks' notation, for example "loss=0.01,dropout@1.5s+20ms"; empty for none. Times
        /// count from the start of the run.
        faults: String = String::new(), "", Any;
        /// How planes are compacted. Raw is fastest for a projector in this process.
        compaction: Compaction = Compaction::RAW, "", Any;
    }
}

section! {
    /// A bit-plane projector on USB.
    pub struct UsbProjectorConfig {
        /// USB vendor id.
        vendor_id: u16 = dpm_device::transport::usb::VENDOR_ID, "", Any;
        /// USB product id.
        product_id: u16 = dpm_device::transport::usb::PRODUCT_ID, "", Any;
        /// Serial number of the device; needed if several are plugged in.
        serial_number: Option<String> = None, "", NotEmpty;
        /// Frames queued at once. More frames bridge longer pauses of the host, and each adds a frame of latency to a
        /// full link. Together they must fit into the kernel's `usbfs_memory_mb`.
        transfers_in_flight: u32 = 2, "frames", Within(1, 64);
        /// How planes are compacted. "auto" chooses for each plane the smallest of raw, RLE, XOR with the previous
        /// frame + RLE, and LZ4, and does not send planes that have not changed. A list permits only those codecs.
        /// "raw" saves the host's time on a link that can carry every frame (`dpm link-test` shows whether it can).
        compaction: Compaction = Compaction::Auto, "", Any;
    }
}

section! {
    /// A bit-plane projector on a serial port: small rasters and tests.
    pub struct SerialProjectorConfig {
        /// Device file of the port.
        port: String = "/dev/ttyUSB0".into(), "", NotEmpty;
        /// Bits per second on the wire.
        baud: u32 = 921_600, "bit/s", Within(300, 20_000_000);
        /// How planes are compacted, as for kind = "usb".
        compaction: Compaction = Compaction::Auto, "", Any;
    }
}

section! {
    /// A TI DLPC900 evaluation module (LightCrafter 6500 and 9000). docs/DLPC900.md says what a rig does with it.
    pub struct Dlpc900Config {
        /// The panel at the controller; it must have the projector's width and height.
        panel: Dlpc900Panel = Dlpc900Panel::Dlp6500, "", Any;
        /// Source of its patterns.
        mode: Dlpc900Mode = Dlpc900Mode::Preloaded, "", Any;
        /// Its video input in mode "video".
        input: VideoInput = VideoInput::Hdmi, "", Any;
        /// The controller, as BUS:ADDRESS in `lsusb`; needed if several are plugged in.
        device: Option<String> = None, "", NotEmpty;
        /// Exposure of each pattern; its whole share of the frame if left out.
        exposure_us: Option<u32> = None, "us", Within(24, 2_000_000);
    }
}

section! {
    /// A ViALUX ALP-4 or ALP-5. docs/ALP.md says how it is set up, and what was never tried on hardware.
    pub struct AlpConfig {
        /// The vendor's library, for example "/usr/lib/x86_64-linux-gnu/libalp44.so". The newest one that the system has, if left out.
        library: Option<PathBuf> = None, "", NotEmpty;
        /// Serial number of the device; 0 is the first one that is found.
        device_number: u32 = 0, "", Within(0, 2_147_483_647);
        /// How long the planes of a frame are lit. With "equal" write `projector.weights` = "equal", so that grey is
        /// made of equal planes, or dim the light source from plane to plane.
        weights: AlpWeights = AlpWeights::Equal, "", Any;
        /// Slots for which a frame is lit if the host is late with the next one. The device shows it so often by itself, and no longer:
        /// it is also the longest time of light after the host has died.
        slots_per_sequence: u32 = 1, "slots", Within(1, 3);
        /// Frames that may wait in the device's memory; fewer, if it holds fewer.
        frames_in_flight: u32 = 4, "frames", Within(1, 60);
        /// Temperature of any of its sensors above which it goes dark; what the device recommends, if left out.
        max_celsius: Option<f64> = None, "degC", Within(0.0, 150.0);
    }
}

words! {
    /// How the planes of a frame share its time on an ALP.
    pub enum AlpWeights {
        /// All are lit equally long.
        Equal = "equal",
        /// By their bits, with a constant light source: `projector.planes` = 8 only.
        Binary = "binary",
    }
}

impl AlpWeights {
    /// The weights in the driver's type.
    pub const fn weights(self) -> Weights {
        match self {
            Self::Equal => Weights::Equal,
            Self::Binary => Weights::Binary,
        }
    }
}

section! {
    /// A display on a graphics card of this machine, which shows nothing else meanwhile. docs/DISPLAY.md says how to set
    /// it up. Nothing of it has been tried on real hardware yet.
    pub struct DisplayConfig {
        /// The connector, as `dpm display` lists them, for example "HDMI-A-1"; the only one with a display if left out.
        connector: Option<String> = None, "", NotEmpty;
        /// The mode: a size and a rate that the display offers, or a timing of one's own, as in "138.51 1920 1968 2000
        /// 2080 1080 1083 1088 1111 +hsync -vsync" (MHz, row, frame, pulses). `projector.width`, `height` and
        /// `frame_rate` must be exactly the mode's; `dpm display` prints what to write.
        mode: String = "1920x1080@60".into(), "", NotEmpty;
        /// What the bits of a pixel mean.
        encoding: DisplayEncoding = DisplayEncoding::Rgb8, "", Any;
        /// The graphics card's device file; the first with such a connector if left out.
        card: Option<PathBuf> = None, "", NotEmpty;
        /// How long before its vertical blank a frame is chosen and written. Half a frame and at most 8000 if left out.
        /// Raise it if the report counts repeated frames although frames were there in time; each microsecond is one
        /// of latency.
        commit_us: Option<u32> = None, "us", Within(100, 35_000);
        /// Properties of the connector without which bits are shown although they may be lost, for example ["Broadcast
        /// RGB"]. Name one only after you have measured that bits arrive.
        without: Vec<String> = Vec::new(), "", Any;
    }
}

impl DisplayConfig {
    /// From the choice of a frame to its vertical blank, without the half of the blank that is added to it, nanoseconds;
    /// `frame_ns`: time of a frame.
    pub fn commit_ns(&self, frame_ns: i64) -> i64 {
        self.commit_us.map_or((frame_ns / 2).min(8_000_000), |us| i64::from(us) * 1000)
    }
}

section! {
    /// A window on the desktop of this machine, for previews and for a desk without a projector. docs/DISPLAY.md says what it
    /// is good for. Closing it ends the run.
    pub struct WindowConfig {
        /// The monitor that the window fills, by the name that a start lists, for example "HDMI-1". `projector.width` and
        /// `height` must be the monitor's, and `frame_rate` within one percent of its rate. An ordinary window of `width` x
        /// `height` pixels if left out.
        monitor: Option<String> = None, "", NotEmpty;
        /// The X server, for example ":0"; the one of the environment variable DISPLAY if left out.
        server: Option<String> = None, "", NotEmpty;
        /// How long before its vertical blank a frame is chosen and sent to the X server. Three quarters of a frame if left
        /// out: some servers count a blank from half a frame before it on.
        commit_us: Option<u32> = None, "us", Within(100, 35_000);
    }
}

impl WindowConfig {
    /// From the choice of a frame to its vertical blank, nanoseconds; `frame_ns`: time of a frame.
    pub fn commit_ns(&self, frame_ns: i64) -> i64 {
        self.commit_us.map_or(frame_ns / 4 * 3, |us| i64::from(us) * 1000)
    }
}

words! {
    /// What the bits of a display's pixel mean.
    pub enum DisplayEncoding {
        /// Code values: the display shows grey by itself. `projector.response` says how much light a code value gives.
        Rgb8 = "rgb8",
        /// The 24 planes of a frame, in the order in which a DLPC900 shows the bits of a pixel: green 0 to 7, red 0 to 7,
        /// blue 0 to 7.
        Planes24 = "planes24",
    }
}

/// The codecs that a link may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compaction {
    /// All that both sides support.
    Auto,
    /// Those of this mask, as bits of [`Codec::mask`], and raw. With raw alone every plane of every frame is sent.
    Only(u32),
}

impl Compaction {
    /// Every plane as it is.
    pub const RAW: Self = Self::Only(0);
    /// Names of the codecs in lists.
    const WORDS: [(&'static str, Codec); 4] =
        [("raw", Codec::Raw), ("rle", Codec::Rle), ("xor-rle", Codec::XorRle), ("lz4", Codec::Lz4)];
}

impl ConfigValue for Compaction {
    fn kind() -> String {
        r#""auto" | "raw" | a list of "rle", "xor-rle", "lz4""#.into()
    }

    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
        let word = |node: &Node| match &node.value {
            Value::String(s) => Self::WORDS.iter().find(|(word, _)| word == s).map(|(_, codec)| codec.mask()),
            _ => None,
        };
        let mask = match &node.value {
            Value::String(s) if s == "auto" => return Some(Self::Auto),
            Value::Array(list) => list.iter().map(word).try_fold(0, |mask, one| Some(mask | one?)),
            _ => word(node),
        };
        match mask {
            Some(mask) => Some(Self::Only(mask & !Codec::Raw.mask())),
            None => {
                reader.refuse(&node.origin, key, format!("must be {}", Self::kind()), "");
                None
            }
        }
    }

    fn show(&self) -> String {
        match self {
            Self::Auto => "\"auto\"".into(),
            Self::Only(0) => "\"raw\"".into(),
            Self::Only(mask) => {
                let words = Self::WORDS.iter().filter(|(_, codec)| mask & codec.mask() != 0);
                format!("[{}]", words.map(|(word, _)| format!("{word:?}")).collect::<Vec<_>>().join(", "))
            }
        }
    }
}

section! {
    /// Pose in the world of the camera that made the calibration file: the inverse of the camera's `rvec` and `tvec`.
    pub struct CalibrationCameraConfig {
        /// Position in the world of the camera that made the calibration file. The table `calibration_camera` is
        /// required if the file's origin is that camera, as with procam-calibration, and refused otherwise.
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

/// How the light of a frame is shared out over its exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlaneTiming {
    /// Every plane is lit equally long, with the light of its bit.
    Equal,
    /// Every plane is lit for as long as its bit weighs, always with the same light: an ALP with `weights = "binary"`.
    ByWeight,
    /// There are no planes: code values are shown for the whole frame, by a display that is given them.
    Held,
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
    /// How much light the planes of a channel give.
    pub enum PlaneWeights {
        /// Half as much from plane to plane.
        Binary = "binary",
        /// All the same.
        Equal = "equal",
    }
}

words! {
    /// Units of length.
    pub enum CalibrationUnit {
        /// 1 m.
        Metre = "metre",
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

impl CalibrationLens {
    /// What the reader of the file is told.
    pub const fn lens(self) -> LensKind {
        match self {
            Self::Auto => LensKind::Auto,
            Self::Fisheye => LensKind::Fisheye,
        }
    }
}

words! {
    /// Panels of a DLPC900.
    pub enum Dlpc900Panel {
        /// 1920 x 1080.
        Dlp6500 = "dlp6500",
        /// 2560 x 1600.
        Dlp9000 = "dlp9000",
        /// 2716 x 1600.
        Dlp670s = "dlp670s",
        /// 2048 x 1200.
        Dlp500yx = "dlp500yx",
        /// 1024 x 768.
        Dlp5500 = "dlp5500",
    }
}

impl Dlpc900Panel {
    /// The panel in the driver's type.
    pub const fn dmd(self) -> Dmd {
        match self {
            Self::Dlp6500 => Dmd::Dlp6500,
            Self::Dlp9000 => Dmd::Dlp9000,
            Self::Dlp670s => Dmd::Dlp670s,
            Self::Dlp500yx => Dmd::Dlp500yx,
            Self::Dlp5500 => Dmd::Dlp5500,
        }
    }
}

words! {
    /// Source of a DLPC900's patterns.
    pub enum Dlpc900Mode {
        /// The first frames of the known motion, which are rendered and loaded in advance and then shown repeatedly.
        Preloaded = "preloaded",
        /// The 24 planes of a video signal that another program drives.
        Video = "video",
    }
}

words! {
    /// Video inputs of a DLPC900.
    pub enum VideoInput {
        /// HDMI.
        Hdmi = "hdmi",
        /// DisplayPort.
        DisplayPort = "displayport",
        /// The parallel port.
        Parallel = "parallel",
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
