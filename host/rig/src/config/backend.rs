//! `[projector.backend]`: how the program reaches the projector.

use dpm_common::keys::read::{Any, ConfigValue, NotEmpty, Reader, Within};
use dpm_common::keys::source::{Node, Value};
use dpm_common::{kinds, section, words};
use dpm_device::alp::Weights;
use dpm_device::dlpc900::lut::Dmd;
use dpm_device::dlpc900::video::{exposure_us, BadExposure, Receiver, VideoBits, VideoPatterns};
use dpm_device::link::Codec;
use dpm_device::planes::{Parts, PlaneSchedule};
use dpm_device::time::FrameRate;
use std::path::PathBuf;

use super::projector::PlaneWeights;

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
    /// A display on a graphics card of this machine, which shows nothing else meanwhile, or lends this display alone.
    /// docs/DISPLAY.md says how to set it up. Nothing of it has been tried on real hardware yet.
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
        /// Whether a desktop is asked to lend the connector. "auto" takes the card where no other program drives it, and
        /// else asks the desktop that the environment names: by WAYLAND_DISPLAY, or else by DISPLAY. "off" asks none. "x11"
        /// and "wayland" ask at once. docs/DISPLAY.md says what a desktop lends.
        lease: DisplayLease = DisplayLease::Auto, "", Any;
        /// How long before its vertical blank a frame is chosen and written. Half a frame and at most 8000 if left out.
        /// Raise it if the report counts repeated frames although frames were there in time; each microsecond is one
        /// of latency.
        commit_us: Option<u32> = None, "us", Within(100, 35_000);
        /// Properties of the connector without which bits are shown although they may be lost, for example ["Broadcast
        /// RGB"]. Name one only after you have measured that bits arrive.
        without: Vec<String> = Vec::new(), "", Any;
        /// The DLPC900 at the other end of the cable, if the display is one. The rig sets it up over USB, and watches it.
        dlpc900: Option<Dlpc900BehindConfig> = None, "", Any;
    }
}

section! {
    /// A TI DLPC900 whose video input the display feeds: every frame is cut into patterns, which are shown one after the other
    /// while the next frame arrives. `encoding` says into which; the planes and their weights follow from it, so leave
    /// `projector.weights` out.
    pub struct Dlpc900BehindConfig {
        /// The panel at the controller; it must have the projector's width and height.
        panel: Dlpc900Panel = Dlpc900Panel::Dlp6500, "", Any;
        /// Its video input.
        input: VideoInput = VideoInput::Hdmi, "", Any;
        /// The controller, as BUS:ADDRESS in `lsusb`; needed if several are plugged in.
        device: Option<String> = None, "", NotEmpty;
        /// Exposure of each pattern. If left out, nine tenths of what a frame has for it: 620 of at most 684 for 24
        /// patterns at 60 frames/s.
        exposure_us: Option<u32> = None, "us", Within(24, 40_000);
    }
}

impl DisplayEncoding {
    /// How each channel shows its code value in a frame of a DLPC900.
    pub const fn parts(self) -> Parts {
        let (count, depth, white) = match self {
            Self::Rgb8 => (1, 8, false),
            Self::Rgb4x2 => (2, 4, false),
            Self::Rgb2x4 => (4, 2, false),
            Self::Planes24 | Self::Binary24 => (8, 1, false),
            Self::Mono8x3 => (3, 8, true),
            Self::Mono6x4 => (4, 6, true),
            Self::Mono4x6 => (6, 4, true),
            Self::Mono3x8 => (8, 3, true),
            Self::Mono2x12 => (12, 2, true),
            Self::Mono1x24 => (24, 1, true),
        };
        Parts { count, depth, white }
    }

    /// How a DLPC900 cuts a pixel into patterns.
    pub const fn video_bits(self) -> VideoBits {
        VideoBits::new(self.parts().depth).expect("each word's bits fill a pixel")
    }

    /// How much light the planes of a channel give behind a DLPC900: the bits of a pattern weigh as those of a number do.
    pub const fn weights(self) -> PlaneWeights {
        match self.parts().depth {
            1 => PlaneWeights::Equal,
            _ => PlaneWeights::Binary,
        }
    }

    /// It says how a DLPC900 cuts pixels, and nothing to a display by itself.
    pub const fn needs_dlpc900(self) -> bool {
        !matches!(self, Self::Rgb8 | Self::Planes24)
    }
}

impl DisplayConfig {
    /// From the choice of a frame to its vertical blank, without the half of the blank that is added to it, nanoseconds;
    /// `frame_ns`: time of a frame.
    pub fn commit_ns(&self, frame_ns: i64) -> i64 {
        self.commit_us.map_or((frame_ns / 2).min(8_000_000), |us| i64::from(us) * 1000)
    }

    /// The planes of a frame behind a DLPC900, in the order in which it shows them; `None` without one.
    pub(super) fn schedule(&self) -> Option<PlaneSchedule> {
        self.dlpc900.as_ref()?;
        match self.encoding.parts() {
            // Colours in turn: a moving edge of grey is less coloured than with eight planes of green, of red, of blue.
            Parts { depth: 1, white: false, .. } => Some(PlaneSchedule::equal_rgb24().filled()),
            parts => PlaneSchedule::of_parts(parts),
        }
    }

    /// How long each pattern of the DLPC900 behind this display is lit, microseconds; `None` without one.
    pub fn exposure_us(&self, rate: FrameRate) -> Option<Result<u32, BadExposure>> {
        let behind = self.dlpc900.as_ref()?;
        Some(exposure_us(self.encoding.video_bits(), behind.panel.dmd(), rate, behind.exposure_us))
    }

    /// How long the patterns of a frame are lit together, nanoseconds; `None` without a DLPC900.
    pub(super) fn lit_ns(&self, rate: FrameRate) -> Option<i64> {
        let exposure_us = self.exposure_us(rate)?.ok()?;
        Some(i64::from(exposure_us * self.encoding.video_bits().patterns()) * 1000)
    }

    /// The patterns of the DLPC900 behind this display; `None` without one.
    pub fn video_patterns(
        &self,
        rate: FrameRate,
        schedule: &PlaneSchedule,
    ) -> Option<Result<VideoPatterns, BadExposure>> {
        let behind = self.dlpc900.as_ref()?;
        let (dmd, receiver) = (behind.panel.dmd(), behind.input.receiver());
        let bits = self.encoding.video_bits();
        let of = |us| VideoPatterns::of_rig(dmd, receiver, rate, schedule, bits, us);
        self.exposure_us(rate).map(|us| us.map(of))
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
        /// Behind them, a DLPC900 shows three patterns of eight bits: green, red, blue.
        Rgb8 = "rgb8",
        /// The 24 planes of a frame, in the order in which a DLPC900 shows the bits of a pixel: green 0 to 7, red 0 to 7,
        /// blue 0 to 7. In front of a DLPC900 the same as "binary24".
        Planes24 = "planes24",
        /// For a DLPC900: 24 halftones of one bit, red, green and blue in turn.
        Binary24 = "binary24",
        /// For a DLPC900: three white patterns of eight bits.
        Mono8x3 = "mono8x3",
        /// For a DLPC900: four white patterns of six bits, halftoned.
        Mono6x4 = "mono6x4",
        /// For a DLPC900: six white patterns of four bits, halftoned.
        Mono4x6 = "mono4x6",
        /// For a DLPC900: eight white patterns of three bits, halftoned.
        Mono3x8 = "mono3x8",
        /// For a DLPC900: twelve white patterns of two bits, halftoned.
        Mono2x12 = "mono2x12",
        /// For a DLPC900: 24 white halftones of one bit.
        Mono1x24 = "mono1x24",
        /// For a DLPC900: two patterns of four bits for each colour, halftoned.
        Rgb4x2 = "rgb4x2",
        /// For a DLPC900: four patterns of two bits for each colour, halftoned.
        Rgb2x4 = "rgb2x4",
    }
}

words! {
    /// Whether a desktop is asked for a display.
    pub enum DisplayLease {
        /// If another program drives the card.
        Auto = "auto",
        /// Never.
        Off = "off",
        /// The X server of the variable DISPLAY, by RandR 1.6.
        X11 = "x11",
        /// The compositor of the variable WAYLAND_DISPLAY, by wp_drm_lease_device_v1.
        Wayland = "wayland",
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

impl VideoInput {
    /// The receiver in the driver's type.
    pub const fn receiver(self) -> Receiver {
        match self {
            Self::Hdmi => Receiver::Hdmi,
            Self::DisplayPort => Receiver::DisplayPort,
            Self::Parallel => Receiver::None,
        }
    }
}
