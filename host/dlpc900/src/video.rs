//! Patterns cut out of a video signal: each frame of 24-bit pixels is 24 one-bit patterns, three 8-bit ones, or something in
//! between, shown one after the other while the next frame arrives.
//!
//! The order of the steps is the guide's, with what programs in the field have learned: black on the wire before
//! anything else, the whole input shown, some seconds between the lock and the switch to video patterns, LEDs last.
//! \[DLPU018 sections 2.3.3, 2.4.1 and 5.1\] None of it was tried on hardware by us.

use std::fmt;
use std::time::Duration;

use super::command::Opcode;
use super::lut::{led, validate, DisplayMode, Dmd, LutEntry, LutError, TableLimits};
use super::sequence::{stop, switch_mode, table, write, LedSetup, Step, Version, LEDS_OFF};
use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec};
use dpm_device::time::FrameRate;

/// What the patterns of a frame leave of it, microseconds. A sequence that has not ended when the next frame begins is
/// aborted.
pub const FRAME_REST_US: u32 = 250;
/// Longest time until the controller has locked to its video source.
const LOCK_WITHIN: Duration = Duration::from_secs(3);
/// From the lock to the switch to video patterns. The lock tells of edges only; a signal that still settles aborts the
/// sequence.
const DWELL: Duration = Duration::from_secs(3);
/// How long the switch to video patterns takes \[DLPU018 section 2.4.1\].
const SWITCH: Duration = Duration::from_millis(300);
/// The port of 24 parallel bits (0x1A00).
const PARALLEL_24: u8 = 0x08;

/// The video input for video-pattern mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Receiver {
    /// No receiver: the parallel port is fed directly.
    #[default]
    None = 0,
    /// HDMI.
    Hdmi = 1,
    /// DisplayPort.
    DisplayPort = 2,
}

/// How many pixels the receiver hands over at each clock (0x1A03).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum PixelPorts {
    /// One, at port 1.
    One = 0,
    /// Two, at both ports: a LightCrafter with 1920 x 1080 at 60 Hz.
    Both = 2,
}

/// Bits of a video pixel.
pub const PIXEL_BITS: u32 = 24;

/// How the 24 bits of a video pixel are cut into patterns of equally many bits, which are shown one after the other: bit 0 to 7
/// of green, of red, of blue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VideoBits(u8);

impl VideoBits {
    /// 24 patterns of one bit: the k-th is the k-th plane of a frame.
    pub const PLANES: Self = Self(1);
    /// Three patterns of eight bits.
    pub const BYTES: Self = Self(8);

    /// Patterns of `depth` bits, which must divide 24 and be at most 8.
    pub const fn new(depth: u8) -> Option<Self> {
        match depth {
            1..=4 | 6 | 8 => Some(Self(depth)),
            _ => None,
        }
    }

    /// Patterns of a frame.
    pub const fn patterns(self) -> u32 {
        PIXEL_BITS / self.0 as u32
    }

    /// Bits of a pattern.
    pub const fn depth(self) -> u8 {
        self.0
    }
}

/// An exposure that does not fit a video frame, or that the DMD cannot keep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BadExposure {
    /// What was asked for, microseconds.
    pub exposure_us: u32,
    /// The least for the depth, microseconds.
    pub least_us: u32,
    /// The most for the frame, microseconds.
    pub most_us: u32,
}

impl fmt::Display for BadExposure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { exposure_us, least_us, most_us } = *self;
        if least_us > most_us {
            write!(f, "a pattern needs {least_us} us, and a video frame has {most_us} us for each: lower the frame rate")
        } else {
            write!(f, "an exposure of {exposure_us} us is not within {least_us} to {most_us} us")
        }
    }
}

impl std::error::Error for BadExposure {}

/// What each of `patterns` patterns (not 0) of a frame of `frame_us` has for itself if all have the same, microseconds.
pub const fn share_us(frame_us: u32, patterns: u32) -> u32 {
    frame_us.saturating_sub(FRAME_REST_US) / patterns
}

/// How long each pattern of a frame is lit, microseconds: `wish_us`, or 155 / 171 of what the frame has for it, which is
/// 620 us for 24 patterns at 60 frames/s, as programs in the field use.
///
/// # Errors
/// The wish is shorter than the DMD takes to load a pattern, or its patterns do not fit a frame.
pub fn exposure_us(
    bits: VideoBits,
    dmd: Dmd,
    rate: FrameRate,
    wish_us: Option<u32>,
) -> Result<u32, BadExposure> {
    let frame_us = u32::try_from(rate.slot_len_ns(0) / 1000).unwrap_or(u32::MAX);
    let most_us = share_us(frame_us, bits.patterns());
    let least_us = dmd.min_exposure_us(bits.depth()).unwrap_or(1);
    let exposure_us = wish_us.unwrap_or_else(|| ((u64::from(most_us) * 155 / 171) as u32).max(least_us));
    if (least_us..=most_us).contains(&exposure_us) {
        Ok(exposure_us)
    } else {
        Err(BadExposure { exposure_us, least_us, most_us })
    }
}

/// How long it is dark after each pattern that is lit for `exposure_us`, microseconds: an equal part of what the frame has left,
/// so that no gap is longer than [`FRAME_REST_US`] and this. One long gap flickers at the frame rate.
pub fn dark_us(bits: VideoBits, rate: FrameRate, exposure_us: u32) -> u32 {
    let frame_us = u32::try_from(rate.slot_len_ns(0) / 1000).unwrap_or(u32::MAX);
    share_us(frame_us, bits.patterns()).saturating_sub(exposure_us)
}

/// The LEDs of planes of a channel.
const fn led_of(channel: Channel) -> u8 {
    match channel {
        Channel::Red => led::RED,
        Channel::Green => led::GREEN,
        Channel::Blue => led::BLUE,
        Channel::White => led::WHITE,
    }
}

/// Patterns cut out of a 24-bit video signal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VideoPatterns {
    /// The DMD.
    pub dmd: Dmd,
    /// The video input.
    pub receiver: Receiver,
    /// How its pixels arrive; what the controller was set to before, if `None`.
    pub ports: Option<PixelPorts>,
    /// Frames per second of the video, at most 120.
    pub frame_hz: u32,
    /// The table; every entry's image is 0, its planes are those of the video frame.
    pub entries: Vec<LutEntry>,
    /// LEDs.
    pub leds: LedSetup,
}

impl VideoPatterns {
    /// The patterns of frames that a rig sends, whose 24 planes are those of `schedule`: each pattern shows as many planes as
    /// `bits` says, lowest bit first, is lit by the LED of their channel for `exposure_us`, and is dark for [`dark_us`] then.
    pub fn of_rig(
        dmd: Dmd,
        receiver: Receiver,
        rate: FrameRate,
        schedule: &PlaneSchedule,
        bits: VideoBits,
        exposure_us: u32,
    ) -> Self {
        let (depth, dark_us) = (bits.depth(), dark_us(bits, rate, exposure_us));
        let entry = |(i, planes): (usize, &[PlaneSpec])| LutEntry {
            leds: led_of(planes[0].channel),
            depth,
            dark_us,
            ..LutEntry::one_bit(i as u16, 0, i as u8 * depth, exposure_us)
        };
        let mut entries: Vec<_> = schedule.planes().chunks(depth.into()).enumerate().map(entry).collect();
        // Behind the last pattern it is dark in any case, and what the table leaves out is a reserve for early frames.
        entries.last_mut().into_iter().for_each(|last| last.dark_us = 0);
        // The table is checked against whole frames a second: rounded up, so that nothing is longer than the frame.
        let frame_hz = rate.num().div_ceil(rate.den());
        Self { dmd, receiver, ports: Some(PixelPorts::Both), frame_hz, entries, leds: LedSetup::default() }
    }

    /// Steps from any state to the loaded, stopped sequence, with the LEDs in the sequencer's hands.
    ///
    /// # Errors
    /// An entry that breaks a rule of the table.
    pub fn steps(&self, firmware: Version) -> Result<Vec<Step<'static>>, LutError> {
        let mut steps = self.dark_steps(firmware)?;
        steps.extend(self.light());
        Ok(steps)
    }

    /// The same with the LEDs off. The source is set before the mode, in video mode, and must be locked (about 300 ms)
    /// before the switch to video patterns: in any other order the controller never locks.
    ///
    /// # Errors
    /// An entry that breaks a rule of the table.
    pub fn dark_steps(&self, firmware: Version) -> Result<Vec<Step<'static>>, LutError> {
        let frame_us = Some(1_000_000 / u64::from(self.frame_hz.clamp(1, 120)));
        validate(&self.entries, &TableLimits { dmd: self.dmd, images: 1, frame_us })?;
        let mut steps = stop();
        steps.push(write(Opcode::LED_ENABLE, &[LEDS_OFF]));
        steps.push(write(Opcode::RECEIVER, &[self.receiver as u8]));
        steps.extend(self.ports.map(|ports| write(Opcode::PORT_CLOCK, &[ports as u8])));
        steps.push(write(Opcode::INPUT_SOURCE, &[PARALLEL_24]));
        steps.extend(self.whole_input());
        steps.extend(switch_mode(DisplayMode::Video, firmware));
        steps.push(Step::WaitLocked(LOCK_WITHIN));
        steps.push(Step::Pause(DWELL));
        steps.extend(switch_mode(DisplayMode::VideoPattern, firmware));
        steps.push(Step::Pause(SWITCH));
        steps.extend(table(&self.entries, 0));
        Ok(steps)
    }

    /// Shows the whole input: a crop that another program left would cut the picture. Two controllers do not know the
    /// command.
    fn whole_input(&self) -> Option<Step<'static>> {
        if self.dmd.has_two_controllers() {
            return None;
        }
        let raster = self.dmd.raster();
        let one = [0, 0, raster.width() as u16, raster.height() as u16];
        let data: Vec<u8> = one.iter().chain(&one).flat_map(|n| n.to_le_bytes()).collect();
        Some(write(Opcode::DISPLAY_RESOLUTION, &data))
    }

    /// Steps out of an abort, which the controller remembers: stopped, parked and unparked in the dark, the table again.
    pub fn again(&self) -> Vec<Step<'static>> {
        let mut steps = stop();
        steps.push(write(Opcode::LED_ENABLE, &[LEDS_OFF]));
        steps.extend([write(Opcode::DMD_PARK, &[1]), write(Opcode::DMD_PARK, &[0])]);
        steps.extend(table(&self.entries, 0));
        steps
    }

    /// The last step of a start: the sequencer lights the LEDs.
    pub fn light(&self) -> Vec<Step<'static>> {
        self.leds.steps()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Parts;

    const NEW: Version = Version { major: 6, minor: 0, patch: 1 };

    fn video(entries: Vec<LutEntry>, frame_hz: u32) -> VideoPatterns {
        let (receiver, leds) = (Receiver::Hdmi, LedSetup::default());
        VideoPatterns { dmd: Dmd::Dlp6500, receiver, ports: None, frame_hz, entries, leds }
    }

    fn opcodes(steps: &[Step<'_>]) -> Vec<u16> {
        steps.iter().filter_map(|s| if let Step::Write(o, _) = s { Some(o.0) } else { None }).collect()
    }

    #[test]
    fn video_patterns_wait_for_the_lock_between_source_and_mode() {
        let entries: Vec<_> = (0..24).map(|i| LutEntry::one_bit(i, 0, i as u8, 300)).collect();
        let mut v = video(entries, 120);
        let steps = v.steps(NEW).unwrap();
        assert_eq!(opcodes(&steps[..7]), [0x1a24, 0x1a07, 0x1a01, 0x1a00, 0x1000, 0x1a1b]);
        assert_eq!(
            steps[4],
            Step::Write(
                Opcode::DISPLAY_RESOLUTION,
                vec![0, 0, 0, 0, 0x80, 7, 0x38, 4, 0, 0, 0, 0, 0x80, 7, 0x38, 4]
            )
        );
        assert_eq!(steps[5], Step::Write(Opcode::DISPLAY_MODE, vec![0]));
        assert_eq!(steps[6..8], [Step::WaitLocked(LOCK_WITHIN), Step::Pause(DWELL)]);
        assert_eq!(steps[8], Step::Write(Opcode::DISPLAY_MODE, vec![2]));
        // The LEDs come last; the caller starts the sequence.
        assert_eq!(steps.last(), Some(&Step::Write(Opcode::LED_ENABLE, vec![8])));
        assert!(!steps.contains(&Step::Write(Opcode::START_STOP, vec![2])));
        assert!(!v.dark_steps(NEW).unwrap().contains(&Step::Write(Opcode::LED_ENABLE, vec![8])));
        v.ports = Some(PixelPorts::Both);
        assert_eq!(v.steps(NEW).unwrap()[3], Step::Write(Opcode::PORT_CLOCK, vec![2]));
        v.dmd = Dmd::Dlp9000;
        assert!(!opcodes(&v.steps(NEW).unwrap()).contains(&0x1000));
        v.entries[23].exposure_us = 1500;
        assert_eq!(v.steps(NEW).unwrap_err().to_string(),
            "LUT entry 23: patterns up to here take 8400 us, a video frame has 8333 us: expose shorter or lower the frame rate");
    }

    /// 620 us at 60 frames/s, and never more than 684.
    #[test]
    fn exposures_leave_a_rest_of_every_frame() {
        let rate = |n| FrameRate::new(n, 1).unwrap();
        let of = |bits, n, wish| exposure_us(bits, Dmd::Dlp6500, rate(n), wish);
        assert_eq!(of(VideoBits::PLANES, 60, None), Ok(620));
        assert_eq!(of(VideoBits::PLANES, 60, Some(684)), Ok(684));
        let refused = of(VideoBits::PLANES, 60, Some(685)).unwrap_err();
        assert_eq!(refused.to_string(), "an exposure of 685 us is not within 105 to 684 us");
        assert!(of(VideoBits::PLANES, 60, Some(104)).is_err());
        assert_eq!(of(VideoBits::BYTES, 60, None), Ok(4960));
        // At 80 frames/s the default would be too short for eight bits, and the least is taken.
        assert_eq!(of(VideoBits::BYTES, 80, None), Ok(4046));
        let refused = of(VideoBits::BYTES, 90, None).unwrap_err();
        assert!(refused.to_string().contains("lower the frame rate"), "{refused}");
        for n in 24..=120 {
            for bits in (1..=8).filter_map(VideoBits::new) {
                let Ok(us) = of(bits, n, None) else { continue };
                let lit = i64::from(us * bits.patterns());
                assert!((lit + i64::from(FRAME_REST_US)) * 1000 <= rate(n).slot_len_ns(0));
                let schedule = PlaneSchedule::equal_rgb24();
                let v = VideoPatterns::of_rig(Dmd::Dlp6500, Receiver::Hdmi, rate(n), &schedule, bits, us);
                assert!(v.steps(NEW).is_ok());
            }
        }
    }

    /// Every gap of a frame is as long as the others, but for the rest at its end, and a frame that comes half a percent early
    /// still finds the patterns over.
    #[test]
    fn gaps_are_shared_among_the_patterns() {
        let schedule = PlaneSchedule::equal_rgb24();
        for n in 24..=120 {
            let rate = FrameRate::new(n, 1).unwrap();
            for bits in (1..=8).filter_map(VideoBits::new) {
                let Ok(us) = exposure_us(bits, Dmd::Dlp6500, rate, None) else { continue };
                let v = VideoPatterns::of_rig(Dmd::Dlp6500, Receiver::Hdmi, rate, &schedule, bits, us);
                let (last, others) = v.entries.split_last().unwrap();
                let pitch_us = u32::try_from(rate.slot_len_ns(0) / 1000).unwrap() - FRAME_REST_US;
                assert!(others.iter().all(|e| e.exposure_us + e.dark_us == pitch_us / bits.patterns()));
                assert_eq!((last.exposure_us, last.dark_us), (us, 0));
                let whole_us: u32 = v.entries.iter().map(|e| e.exposure_us + e.dark_us).sum();
                assert!(f64::from(whole_us) < 0.995e6 / f64::from(n), "{n} Hz, {bits:?}: {whole_us} us");
            }
        }
    }

    #[test]
    fn each_pattern_is_lit_by_the_led_of_its_planes() {
        let rate = FrameRate::new(60, 1).unwrap();
        let of = |schedule: PlaneSchedule, bits, us| {
            VideoPatterns::of_rig(Dmd::Dlp6500, Receiver::Hdmi, rate, &schedule, bits, us).entries
        };
        let parts =
            |count, depth, white| PlaneSchedule::of_parts(Parts { count, depth, low: 0, white }).unwrap();
        let planes = of(PlaneSchedule::equal_rgb24(), VideoBits::PLANES, 620);
        let leds: Vec<u8> = planes[..4].iter().map(|e| e.leds).collect();
        assert_eq!(leds, [led::RED, led::GREEN, led::BLUE, led::RED]);
        assert!(planes.iter().enumerate().all(|(i, e)| (usize::from(e.bit), e.depth) == (i, 1)));
        let colours = of(parts(1, 8, false), VideoBits::BYTES, 4960);
        let places: Vec<_> = colours.iter().map(|e| (e.leds, e.bit, e.depth)).collect();
        assert_eq!(places, [(led::GREEN, 0, 8), (led::RED, 8, 8), (led::BLUE, 16, 8)]);
        let white = of(parts(4, 6, true), VideoBits::new(6).unwrap(), 3000);
        let places: Vec<_> = white.iter().map(|e| (e.leds, e.bit, e.depth)).collect();
        assert_eq!(places, [0, 6, 12, 18].map(|bit| (led::WHITE, bit, 6)));
        let two_poses = of(parts(2, 4, false), VideoBits::new(4).unwrap(), 2000);
        let leds: Vec<_> = two_poses.iter().map(|e| e.leds).collect();
        assert_eq!(leds, [led::GREEN, led::RED, led::BLUE, led::GREEN, led::RED, led::BLUE]);
        assert!(two_poses.iter().enumerate().all(|(i, e)| usize::from(e.bit) == 4 * i));
        assert_eq!([0, 5, 7, 9].map(VideoBits::new), [None; 4]);
    }
}
