//! Turns patterns into the steps that the controller expects, in the order that it expects.
//!
//! Patterns on the fly: stop, LEDs off, display mode, every LUT entry, LUT configuration (which makes the entries
//! effective), images with the last one first, LEDs on, start. Steps are plain values, so their order can be inspected
//! without a device. \[DLPU018 sections 2.4.4 and 3; DLPT028 for the block lock of firmware 4.0.0 to 5.0.0\]

use std::fmt;
use std::time::Duration;

use super::command::Opcode;
use super::image::{encode, Compression, EncodedImage, ImageError, PlaneOrder};
use super::lut::{
    led, validate, DisplayMode, Dmd, LutEntry, LutError, TableLimits, IMAGE_PLANES, MAX_IMAGES,
};

/// Least time in the 50/50 exercise before it may be left.
pub const IDLE_LEAST: Duration = Duration::from_secs(3);
/// Time from "standby" to parked mirrors: two minutes of exercise and three seconds.
pub const STANDBY_TIME: Duration = Duration::from_secs(123);
/// LED enable (0x1A07): all off, by hand.
pub(super) const LEDS_OFF: u8 = 0;
/// LED enable (0x1A07): the sequencer lights them.
pub(super) const LEDS_BY_SEQUENCER: u8 = 0x08;

/// A firmware version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Version {
    /// Major number.
    pub major: u8,
    /// Minor number.
    pub minor: u8,
    /// Patch number.
    pub patch: u16,
}

impl Version {
    /// From the four bytes of the version reply.
    pub const fn from_bytes(b: [u8; 4]) -> Self {
        Self { patch: u16::from_le_bytes([b[0], b[1]]), minor: b[2], major: b[3] }
    }

    /// The four bytes of the version reply.
    pub const fn to_bytes(self) -> [u8; 4] {
        let p = self.patch.to_le_bytes();
        [p[0], p[1], self.minor, self.major]
    }

    /// Whether mirror blocks stay locked after a mode switch, reset or standby until the DMD is parked and unparked (errata
    /// DLPT028: firmware 4.0.0 to 5.0.0).
    pub fn locks_blocks(self) -> bool {
        let v = |major, minor, patch| Self { major, minor, patch };
        (v(4, 0, 0)..=v(5, 0, 0)).contains(&self)
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}.{}", self.major, self.minor, self.patch)
    }
}

/// One step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step<'a> {
    /// A command with its data, to be acknowledged.
    Write(Opcode, Vec<u8>),
    /// An image: the load command, then its bytes.
    Image {
        /// For the second controller.
        secondary: bool,
        /// Number of the image.
        index: u16,
        /// Header and stream.
        bytes: &'a [u8],
    },
    /// Time that the controller needs.
    Pause(Duration),
    /// Wait until the external video source is locked, at most this long.
    WaitLocked(Duration),
    /// Wait until the controller answers again, at most this long.
    WaitReady(Duration),
}

/// How often a sequence is shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Repeat {
    /// Until it is stopped.
    #[default]
    Forever,
    /// This many times.
    Passes(u32),
}

impl Repeat {
    /// The u32 of the LUT configuration. Revision F of the guide counts passes, revision J (firmware 6) patterns; 0
    /// means without end.
    pub fn number(self, entries: usize, firmware: Version) -> u32 {
        match self {
            Self::Forever => 0,
            Self::Passes(n) if firmware.major >= 6 => n.saturating_mul(entries as u32),
            Self::Passes(n) => n,
        }
    }
}

/// An image for both controllers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImagePair {
    /// Whole DMD, or its left half if there are two controllers.
    pub primary: EncodedImage,
    /// Right half.
    pub secondary: Option<EncodedImage>,
}

/// A pattern sequence ready for upload. Made by [`SequenceBuilder`], so its entries keep every rule of its DMD.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PatternSequence {
    dmd: Dmd,
    entries: Vec<LutEntry>,
    images: Vec<ImagePair>,
    repeat: Repeat,
}

/// Why patterns cannot form a sequence.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SequenceError {
    /// An entry breaks a rule.
    #[error(transparent)]
    Lut(#[from] LutError),
    /// Planes cannot form an image.
    #[error("image {image}: {source}")]
    Image {
        /// Which image.
        image: usize,
        /// What is wrong.
        source: ImageError,
    },
    /// More images than the controller holds.
    #[error("the patterns need {images} images of 24 planes, the controller holds {MAX_IMAGES}: show fewer patterns at once")]
    TooManyImages {
        /// Images needed.
        images: usize,
    },
    /// A sequence for another DMD.
    #[error(
        "the sequence was made for a {made_for}, the projector has a {found}: make it again for that DMD"
    )]
    OtherDmd {
        /// The DMD of the sequence.
        made_for: &'static str,
        /// The DMD of the projector.
        found: &'static str,
    },
}

/// One pattern and how it is shown. `planes` are its bits, least significant first, each in the project's plane layout.
#[derive(Clone, Debug)]
pub struct BitPattern<'a> {
    /// Bits, least significant first; 1 to 8 (16 on a DLP500YX).
    pub planes: Vec<&'a [u8]>,
    /// Time lit, microseconds.
    pub exposure_us: u32,
    /// Time black afterwards, microseconds.
    pub dark_us: u32,
    /// LEDs, see [`led`].
    pub leds: u8,
    /// Waits for a TRIG_IN1 edge.
    pub wait_trigger: bool,
    /// No pulse on TRIG_OUT2.
    pub no_trigger_out2: bool,
}

impl<'a> BitPattern<'a> {
    /// White, no dark time, no triggers in, triggers out.
    pub fn white(planes: Vec<&'a [u8]>, exposure_us: u32) -> Self {
        let leds = led::WHITE;
        Self { planes, exposure_us, dark_us: 0, leds, wait_trigger: false, no_trigger_out2: false }
    }
}

/// Packs patterns into images of 24 planes and makes their LUT entries.
#[derive(Clone, Debug)]
pub struct SequenceBuilder<'a> {
    dmd: Dmd,
    entries: Vec<LutEntry>,
    images: Vec<Vec<&'a [u8]>>,
}

impl<'a> SequenceBuilder<'a> {
    /// An empty sequence for `dmd`.
    pub fn new(dmd: Dmd) -> Self {
        Self { dmd, entries: Vec::new(), images: Vec::new() }
    }

    /// Appends a pattern. Its planes are adjacent in one image; rules are checked when the sequence is finished.
    pub fn push(&mut self, pattern: &BitPattern<'a>) {
        let depth = pattern.planes.len();
        let fits = self.images.last().is_some_and(|i| i.len() + depth <= IMAGE_PLANES);
        if !fits {
            self.images.push(Vec::with_capacity(IMAGE_PLANES));
        }
        let image = self.images.len() - 1;
        let planes = &mut self.images[image];
        self.entries.push(LutEntry {
            index: self.entries.len() as u16,
            exposure_us: pattern.exposure_us,
            dark_us: pattern.dark_us,
            depth: depth.min(255) as u8,
            leds: pattern.leds,
            clear_after: true,
            wait_trigger: pattern.wait_trigger,
            no_trigger_out2: pattern.no_trigger_out2,
            image: image as u16,
            bit: planes.len() as u8,
        });
        planes.extend_from_slice(&pattern.planes);
    }

    /// Checks the rules and encodes the images. With `compression` `None`, uses the smallest encoding.
    pub fn finish(
        self,
        repeat: Repeat,
        order: PlaneOrder,
        compression: Option<Compression>,
    ) -> Result<PatternSequence, SequenceError> {
        let Self { dmd, entries, images } = self;
        validate(&entries, &TableLimits { dmd, images: images.len(), frame_us: None })?;
        if images.len() > MAX_IMAGES {
            return Err(SequenceError::TooManyImages { images: images.len() });
        }
        let raster = dmd.raster();
        let width = raster.width() as usize;
        let halves = if dmd.has_two_controllers() { width / 2 } else { width };
        let pair = |(image, planes): (usize, &Vec<&[u8]>)| {
            let part = |columns| {
                let coded = encode(planes, raster, columns, order, compression);
                coded.map_err(|source| SequenceError::Image { image, source })
            };
            let secondary = if halves < width { Some(part(halves..width)?) } else { None };
            Ok(ImagePair { primary: part(0..halves)?, secondary })
        };
        let images = images.iter().enumerate().map(pair).collect::<Result<_, SequenceError>>()?;
        Ok(PatternSequence { dmd, entries, images, repeat })
    }
}

pub(super) fn write(opcode: Opcode, data: &[u8]) -> Step<'static> {
    Step::Write(opcode, data.to_vec())
}

/// Stops the sequencer.
pub fn stop() -> Vec<Step<'static>> {
    vec![write(Opcode::START_STOP, &[0])]
}

/// LEDs off by hand, whatever the sequencer does.
pub fn leds_off() -> Step<'static> {
    write(Opcode::LED_ENABLE, &[LEDS_OFF])
}

/// Pauses the sequencer; [`start`] resumes it.
pub fn pause() -> Vec<Step<'static>> {
    vec![write(Opcode::START_STOP, &[1])]
}

/// Starts the sequencer.
pub fn start() -> Vec<Step<'static>> {
    vec![write(Opcode::START_STOP, &[2])]
}

/// LED currents and polarity; `None` keeps the present setting.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LedSetup {
    /// Currents R, G, B as the driver board counts them.
    pub current: Option<[u8; 3]>,
    /// PWM polarity byte.
    pub polarity: Option<u8>,
}

impl LedSetup {
    /// Current, polarity, then enable by the sequencer: no LED is lit before its current is right.
    pub(super) fn steps(&self) -> Vec<Step<'static>> {
        let mut steps = Vec::new();
        steps.extend(self.current.map(|c| write(Opcode::LED_CURRENT, &c)));
        steps.extend(self.polarity.map(|p| write(Opcode::LED_POLARITY, &[p])));
        steps.push(write(Opcode::LED_ENABLE, &[LEDS_BY_SEQUENCER]));
        steps
    }
}

/// A mode switch in the dark, with the park cycle that firmware with the block lock needs after it.
pub(super) fn switch_mode(mode: DisplayMode, firmware: Version) -> Vec<Step<'static>> {
    let mut steps = vec![write(Opcode::DISPLAY_MODE, &[mode as u8])];
    steps.extend(unlock_blocks(firmware));
    steps
}

/// Parks and unparks if the firmware locks mirror blocks; else nothing.
pub fn unlock_blocks(firmware: Version) -> Vec<Step<'static>> {
    if firmware.locks_blocks() {
        vec![write(Opcode::DMD_PARK, &[1]), write(Opcode::DMD_PARK, &[0])]
    } else {
        Vec::new()
    }
}

pub(super) fn table(entries: &[LutEntry], repeat: u32) -> Vec<Step<'static>> {
    let mut steps: Vec<_> = entries.iter().map(|e| write(Opcode::LUT_DEFINITION, &e.encode())).collect();
    let n = (entries.len() as u16).to_le_bytes();
    let r = repeat.to_le_bytes();
    steps.push(write(Opcode::LUT_CONFIG, &[n[0], n[1], r[0], r[1], r[2], r[3]]));
    steps
}

impl PatternSequence {
    /// The DMD it was made for.
    pub fn dmd(&self) -> Dmd {
        self.dmd
    }

    /// Its table.
    pub fn entries(&self) -> &[LutEntry] {
        &self.entries
    }

    /// Its images, number 0 first.
    pub fn images(&self) -> &[ImagePair] {
        &self.images
    }

    /// Bytes of all images.
    pub fn image_bytes(&self) -> usize {
        let bytes = |p: &ImagePair| p.primary.bytes.len() + p.secondary.as_ref().map_or(0, |s| s.bytes.len());
        self.images.iter().map(bytes).sum()
    }

    /// All steps from any state to the loaded, stopped sequence.
    pub fn upload(&self, leds: LedSetup, firmware: Version) -> Vec<Step<'_>> {
        let mut steps: Vec<Step<'_>> = stop();
        steps.push(write(Opcode::LED_ENABLE, &[LEDS_OFF]));
        steps.extend(switch_mode(DisplayMode::OnTheFly, firmware));
        steps.extend(table(&self.entries, self.repeat.number(self.entries.len(), firmware)));
        for (index, pair) in self.images.iter().enumerate().rev() {
            let index = index as u16;
            if let Some(right) = &pair.secondary {
                steps.push(Step::Image { secondary: true, index, bytes: &right.bytes });
            }
            steps.push(Step::Image { secondary: false, index, bytes: &pair.primary.bytes });
        }
        steps.extend(leds.steps());
        steps
    }

    /// New exposure and dark times for the same patterns: the table only, no image is sent again.
    pub fn retime(&mut self, times: impl Fn(&LutEntry) -> (u32, u32)) -> Result<(), LutError> {
        let mut entries = self.entries.clone();
        for e in &mut entries {
            (e.exposure_us, e.dark_us) = times(e);
        }
        validate(&entries, &TableLimits { dmd: self.dmd, images: self.images.len(), frame_us: None })?;
        self.entries = entries;
        Ok(())
    }

    /// The steps after [`PatternSequence::retime`].
    pub fn update_table(&self, firmware: Version) -> Vec<Step<'static>> {
        let mut steps = stop();
        steps.extend(table(&self.entries, self.repeat.number(self.entries.len(), firmware)));
        steps
    }
}

/// Enters the 50/50 mirror exercise: stopped, LEDs off by hand (otherwise they were seen to stay on), out of video
/// mode.
pub fn idle(mode: DisplayMode, firmware: Version) -> Vec<Step<'static>> {
    let mut steps = stop();
    steps.push(write(Opcode::LED_ENABLE, &[LEDS_OFF]));
    if mode == DisplayMode::Video {
        steps.extend(switch_mode(DisplayMode::OnTheFly, firmware));
    }
    steps.push(write(Opcode::DMD_IDLE, &[1]));
    steps
}

/// Leaves the exercise, but not before [`IDLE_LEAST`]: `lasted` is how long it has lasted.
pub fn leave_idle(lasted: Duration) -> Vec<Step<'static>> {
    let mut steps = Vec::new();
    if lasted < IDLE_LEAST {
        steps.push(Step::Pause(IDLE_LEAST - lasted));
    }
    steps.push(write(Opcode::DMD_IDLE, &[0]));
    steps.push(write(Opcode::LED_ENABLE, &[LEDS_BY_SEQUENCER]));
    steps
}

/// Parks the mirrors, LEDs off.
pub fn park() -> Vec<Step<'static>> {
    let mut steps = stop();
    steps.push(write(Opcode::LED_ENABLE, &[LEDS_OFF]));
    steps.push(write(Opcode::DMD_PARK, &[1]));
    steps
}

/// Unparks the mirrors. The table must be sent again afterwards.
pub fn unpark() -> Vec<Step<'static>> {
    vec![write(Opcode::DMD_PARK, &[0]), write(Opcode::LED_ENABLE, &[LEDS_BY_SEQUENCER])]
}

/// Must precede a loss of power; the mirrors are safe [`STANDBY_TIME`] later.
pub fn standby() -> Vec<Step<'static>> {
    let mut steps = stop();
    steps.push(write(Opcode::LED_ENABLE, &[LEDS_OFF]));
    steps.push(write(Opcode::POWER_MODE, &[1]));
    steps
}

/// Leaves standby.
pub fn wake(firmware: Version) -> Vec<Step<'static>> {
    let mut steps = vec![write(Opcode::POWER_MODE, &[0]), Step::WaitReady(Duration::from_secs(5))];
    steps.extend(unlock_blocks(firmware));
    steps.push(write(Opcode::LED_ENABLE, &[LEDS_BY_SEQUENCER]));
    steps
}

#[cfg(test)]
mod tests {
    use super::*;

    const NEW: Version = Version { major: 6, minor: 0, patch: 1 };
    const LOCKING: Version = Version { major: 4, minor: 1, patch: 0 };

    fn opcodes(steps: &[Step<'_>]) -> Vec<u16> {
        let code = |s: &Step<'_>| match s {
            Step::Write(o, _) => o.0,
            Step::Image { secondary, index, .. } => 0xf000 + 0x100 * u16::from(*secondary) + index,
            Step::Pause(_) => 1,
            Step::WaitLocked(_) => 2,
            Step::WaitReady(_) => 3,
        };
        steps.iter().map(code).collect()
    }

    fn sequence(dmd: Dmd, patterns: usize, depth: usize) -> PatternSequence {
        let plane = vec![0x0f; dmd.raster().plane_bytes()];
        let mut b = SequenceBuilder::new(dmd);
        (0..patterns).for_each(|_| b.push(&BitPattern::white(vec![&plane[..]; depth], 5000)));
        b.finish(Repeat::Passes(3), PlaneOrder::default(), Some(Compression::Erle)).unwrap()
    }

    #[test]
    fn upload_keeps_the_order_of_the_guide() {
        let s = sequence(Dmd::Dlp5500, 50, 1);
        let steps = s.upload(LedSetup { current: Some([1, 2, 3]), polarity: Some(0) }, NEW);
        let mut expected = vec![0x1a24, 0x1a07, 0x1a1b];
        expected.extend([0x1a34; 50]);
        expected.push(0x1a31);
        // 50 planes are three images, the last one first.
        expected.extend([0xf002, 0xf001, 0xf000]);
        expected.extend([0x0b01, 0x1a05, 0x1a07]);
        assert_eq!(opcodes(&steps), expected);
        assert_eq!(steps[0], Step::Write(Opcode::START_STOP, vec![0]));
        assert_eq!(steps[1], Step::Write(Opcode::LED_ENABLE, vec![0]));
        assert_eq!(steps[2], Step::Write(Opcode::DISPLAY_MODE, vec![3]));
        // Firmware 6 counts patterns, older firmware passes.
        assert_eq!(steps[53], Step::Write(Opcode::LUT_CONFIG, vec![50, 0, 150, 0, 0, 0]));
        let older = s.upload(LedSetup::default(), LOCKING);
        assert_eq!(opcodes(&older[..5]), [0x1a24, 0x1a07, 0x1a1b, 0x0609, 0x0609]);
        assert_eq!(
            older[3..5],
            [Step::Write(Opcode::DMD_PARK, vec![1]), Step::Write(Opcode::DMD_PARK, vec![0])]
        );
        assert_eq!(older[55], Step::Write(Opcode::LUT_CONFIG, vec![50, 0, 3, 0, 0, 0]));
        assert_eq!(older.last(), Some(&Step::Write(Opcode::LED_ENABLE, vec![8])));
    }

    #[test]
    fn deep_patterns_stay_in_one_image_and_two_controllers_get_halves() {
        // 5 planes each: four to an image, the fifth starts the next.
        let s = sequence(Dmd::Dlp9000, 5, 5);
        let places: Vec<_> = s.entries().iter().map(|e| (e.image, e.bit, e.depth)).collect();
        assert_eq!(places, [(0, 0, 5), (0, 5, 5), (0, 10, 5), (0, 15, 5), (1, 0, 5)]);
        let steps = s.upload(LedSetup::default(), NEW);
        assert_eq!(opcodes(&steps[9..13]), [0xf101, 0xf001, 0xf100, 0xf000]);
        let Step::Image { bytes, .. } = &steps[10] else { panic!("an image") };
        // Half of 2560 columns.
        assert_eq!(bytes[4..8], [0x00, 0x05, 0x40, 0x06]);
        let mut nine = SequenceBuilder::new(Dmd::Dlp6500);
        let plane = vec![0; Dmd::Dlp6500.raster().plane_bytes()];
        nine.push(&BitPattern::white(vec![&plane[..]; 9], 9000));
        let err = nine.finish(Repeat::Forever, PlaneOrder::default(), None).unwrap_err();
        assert_eq!(err.to_string(), "LUT entry 0: this DMD shows no 9-bit patterns");
    }

    #[test]
    fn exposures_change_without_images_and_bad_ones_leave_the_sequence_alone() {
        let mut s = sequence(Dmd::Dlp6500, 2, 1);
        s.retime(|e| (1000 + u32::from(e.index), 7)).unwrap();
        assert_eq!(opcodes(&s.update_table(NEW)), [0x1a24, 0x1a34, 0x1a34, 0x1a31]);
        let before = s.clone();
        assert_eq!(s.retime(|e| (if e.index == 1 { 104 } else { 105 }, 0)).unwrap_err().entry, 1);
        assert_eq!(s, before);
    }

    #[test]
    fn every_way_to_rest_stops_and_darkens_first() {
        for steps in [idle(DisplayMode::Video, LOCKING), idle(DisplayMode::OnTheFly, NEW), park(), standby()]
        {
            assert_eq!(opcodes(&steps[..2]), [0x1a24, 0x1a07]);
            assert_eq!(steps[1], Step::Write(Opcode::LED_ENABLE, vec![0]));
        }
        assert_eq!(
            opcodes(&idle(DisplayMode::Video, LOCKING)),
            [0x1a24, 0x1a07, 0x1a1b, 0x0609, 0x0609, 0x0201]
        );
        assert_eq!(opcodes(&idle(DisplayMode::OnTheFly, LOCKING)), [0x1a24, 0x1a07, 0x0201]);
        assert_eq!(leave_idle(Duration::from_secs(1))[0], Step::Pause(Duration::from_secs(2)));
        assert_eq!(opcodes(&leave_idle(Duration::from_secs(4))), [0x0201, 0x1a07]);
        assert_eq!(opcodes(&wake(LOCKING)), [0x0200, 3, 0x0609, 0x0609, 0x1a07]);
        assert_eq!(opcodes(&wake(NEW)), [0x0200, 3, 0x1a07]);
        assert!(
            Version::from_bytes([0, 0, 0, 5]).locks_blocks()
                && !Version::from_bytes([1, 0, 0, 5]).locks_blocks()
        );
        assert_eq!(Version::from_bytes([2, 1, 3, 4]), Version { major: 4, minor: 3, patch: 258 });
    }
}
