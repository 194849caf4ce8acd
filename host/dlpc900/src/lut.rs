//! The pattern table: encodes and decodes an entry of 12 bytes, and holds the DMDs' timing tables and the rules for
//! entries.
//!
//! The rules are defined only here. The driver checks a sequence before it sends anything, and names the entry and the
//! rule. The emulator answers with the controller's error code for the same rule.
//! \[DLPU018 tables 2-102, 2-103, section 2.4.4.3.5\]

use dpm_device::planes::Raster;

/// Bytes of an entry on the wire.
pub const ENTRY_BYTES: usize = 12;
/// Largest number that fits the 24-bit exposure and dark time, microseconds.
pub const MAX_TIME_US: u32 = 0xff_ffff;
/// Planes in one image.
pub const IMAGE_PLANES: usize = 24;
/// Images that the controller holds for patterns on the fly (indices 0 to 17).
pub const MAX_IMAGES: usize = 18;
/// Black that the controller appends to a pattern before a triggered one, microseconds.
pub const TRIGGER_BLACK_US: u32 = 105;

/// The mirror array behind the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Dmd {
    /// 1920 x 1080, LightCrafter 6500.
    Dlp6500,
    /// 2560 x 1600, LightCrafter 9000, two controllers.
    Dlp9000,
    /// 2716 x 1600, two controllers.
    Dlp670s,
    /// 2048 x 1200.
    Dlp500yx,
    /// 1024 x 768.
    Dlp5500,
}

impl Dmd {
    /// All DMDs.
    pub const ALL: [Self; 5] = [Self::Dlp6500, Self::Dlp9000, Self::Dlp670s, Self::Dlp500yx, Self::Dlp5500];

    /// From the first byte of the hardware reply (0x0206); `None` for 0, unknown, and numbers without a meaning.
    pub const fn from_hardware_id(id: u8) -> Option<Self> {
        match id {
            1 => Some(Self::Dlp6500),
            2 => Some(Self::Dlp9000),
            3 => Some(Self::Dlp670s),
            4 => Some(Self::Dlp500yx),
            5 => Some(Self::Dlp5500),
            _ => None,
        }
    }

    /// The first byte of the hardware reply.
    pub const fn hardware_id(self) -> u8 {
        match self {
            Self::Dlp6500 => 1,
            Self::Dlp9000 => 2,
            Self::Dlp670s => 3,
            Self::Dlp500yx => 4,
            Self::Dlp5500 => 5,
        }
    }

    /// The name TI sells it under.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Dlp6500 => "DLP6500",
            Self::Dlp9000 => "DLP9000",
            Self::Dlp670s => "DLP670S",
            Self::Dlp500yx => "DLP500YX",
            Self::Dlp5500 => "DLP5500",
        }
    }

    /// Mirrors.
    pub const fn raster(self) -> Raster {
        let (w, h) = match self {
            Self::Dlp6500 => (1920, 1080),
            Self::Dlp9000 => (2560, 1600),
            Self::Dlp670s => (2716, 1600),
            Self::Dlp500yx => (2048, 1200),
            Self::Dlp5500 => (1024, 768),
        };
        match Raster::new(w, h) {
            Some(r) => r,
            None => panic!("every DMD has a size that a raster can have"),
        }
    }

    /// Whether a second controller drives the right half: images are then loaded in two halves.
    pub const fn has_two_controllers(self) -> bool {
        matches!(self, Self::Dlp9000 | Self::Dlp670s)
    }

    /// Shortest exposure of a pattern of `depth` bits with all blocks loaded, microseconds; `None` where no table is published.
    pub const fn min_exposure_us(self, depth: u8) -> Option<u32> {
        let table: [u32; 8] = match self {
            Self::Dlp6500 => [105, 304, 394, 823, 1215, 1487, 1998, 4046],
            Self::Dlp9000 => [105, 304, 380, 733, 1215, 1487, 1998, 4046],
            Self::Dlp670s => [100, 343, 438, 768, 1299, 1488, 2000, 4046],
            Self::Dlp500yx => [62, 184, 269, 458, 682, 807, 1083, 2263],
            Self::Dlp5500 => return None,
        };
        match (depth, self) {
            (1..=8, _) => Some(table[depth as usize - 1]),
            (10, Self::Dlp500yx) => Some(10_363),
            (12, Self::Dlp500yx) => Some(41_452),
            (14, Self::Dlp500yx) => Some(165_807),
            (16, Self::Dlp500yx) => Some(663_225),
            _ => None,
        }
    }

    /// Shortest exposure of a 1-bit pattern when `blocks` mirror blocks are loaded, microseconds; `None` for a number of blocks
    /// that this DMD's table does not have.
    pub fn block_exposure_us(self, blocks: usize) -> Option<u32> {
        let table: &[u32] = match self {
            Self::Dlp6500 => &[24, 45, 45, 45, 48, 54, 60, 66, 72, 78, 84, 90, 96, 101, 105],
            Self::Dlp9000 => &[24, 42, 42, 42, 45, 51, 56, 61, 67, 72, 77, 83, 88, 93, 99, 105],
            Self::Dlp670s => &[27, 27, 27, 33, 38, 38, 49, 55, 61, 66, 72, 77, 83, 89, 94, 100],
            Self::Dlp500yx => &[30, 30, 30, 30, 34, 38, 42, 46, 50, 54, 58, 62],
            Self::Dlp5500 => &[],
        };
        blocks.checked_sub(1).and_then(|i| table.get(i)).copied()
    }

    /// Most bit planes that all entries together may use.
    pub const fn max_planes(self) -> u32 {
        match self {
            Self::Dlp9000 => 480,
            Self::Dlp500yx => 800,
            Self::Dlp5500 => 1024,
            Self::Dlp6500 | Self::Dlp670s => 400,
        }
    }

    /// Most entries in the table.
    pub const fn max_entries(self) -> usize {
        match self {
            Self::Dlp5500 => 960,
            _ => 400,
        }
    }
}

/// What feeds the patterns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum DisplayMode {
    /// Ordinary video.
    Video = 0,
    /// Patterns stored in flash.
    PreStored = 1,
    /// Patterns cut out of each 24-bit video frame.
    VideoPattern = 2,
    /// Patterns uploaded over USB.
    OnTheFly = 3,
}

impl DisplayMode {
    /// From the mode byte.
    pub const fn from_byte(b: u8) -> Option<Self> {
        match b {
            0 => Some(Self::Video),
            1 => Some(Self::PreStored),
            2 => Some(Self::VideoPattern),
            3 => Some(Self::OnTheFly),
            _ => None,
        }
    }
}

/// LEDs as the entry's three bits: 1 red, 2 green, 4 blue.
pub mod led {
    /// Red.
    pub const RED: u8 = 1;
    /// Green.
    pub const GREEN: u8 = 2;
    /// Blue.
    pub const BLUE: u8 = 4;
    /// All.
    pub const WHITE: u8 = 7;
}

/// One pattern of a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LutEntry {
    /// Place in the table; entries are numbered from 0 without gaps.
    pub index: u16,
    /// Time lit, microseconds.
    pub exposure_us: u32,
    /// Time black afterwards, microseconds.
    pub dark_us: u32,
    /// Bits of the pattern, 1 to 8 (to 16 with firmware 6 and a DLP500YX).
    pub depth: u8,
    /// LEDs lit, see [`led`]; 0 is none.
    pub leds: u8,
    /// Mirrors go off after the exposure. Effective only for 1-bit patterns with an external trigger; others always go
    /// off.
    pub clear_after: bool,
    /// Starts only at a TRIG_IN1 edge.
    pub wait_trigger: bool,
    /// No pulse on TRIG_OUT2.
    pub no_trigger_out2: bool,
    /// Image that holds it.
    pub image: u16,
    /// Its lowest plane in that image, 0 to 23.
    pub bit: u8,
}

impl LutEntry {
    /// A 1-bit white pattern: plane `bit` of image `image`, lit for `exposure_us`.
    pub const fn one_bit(index: u16, image: u16, bit: u8, exposure_us: u32) -> Self {
        Self {
            index,
            exposure_us,
            dark_us: 0,
            depth: 1,
            leds: led::WHITE,
            clear_after: true,
            wait_trigger: false,
            no_trigger_out2: false,
            image,
            bit,
        }
    }

    /// The 12 bytes of command 0x1A34. Numbers beyond their fields are truncated: [`validate`] refuses them first.
    pub const fn encode(&self) -> [u8; ENTRY_BYTES] {
        let (i, e, d) =
            (self.index.to_le_bytes(), self.exposure_us.to_le_bytes(), self.dark_us.to_le_bytes());
        let depth = self.depth.saturating_sub(1);
        let options =
            self.clear_after as u8 | (depth & 7) << 1 | (self.leds & 7) << 4 | (self.wait_trigger as u8) << 7;
        let more = self.no_trigger_out2 as u8 | (depth >> 3 & 1) << 1;
        let place = (self.image & 0x7ff | (self.bit as u16) << 11).to_le_bytes();
        [i[0], i[1], e[0], e[1], e[2], options, d[0], d[1], d[2], more, place[0], place[1]]
    }

    /// Reads the 12 bytes of command 0x1A34; any bytes are a valid entry.
    pub const fn decode(b: &[u8; ENTRY_BYTES]) -> Self {
        let place = u16::from_le_bytes([b[10], b[11]]);
        Self {
            index: u16::from_le_bytes([b[0], b[1]]),
            exposure_us: u32::from_le_bytes([b[2], b[3], b[4], 0]),
            dark_us: u32::from_le_bytes([b[6], b[7], b[8], 0]),
            depth: 1 + (b[5] >> 1 & 7) + (b[9] >> 1 & 1) * 8,
            leds: b[5] >> 4 & 7,
            clear_after: b[5] & 1 != 0,
            wait_trigger: b[5] & 0x80 != 0,
            no_trigger_out2: b[9] & 1 != 0,
            image: place & 0x7ff,
            bit: (place >> 11) as u8,
        }
    }
}

/// A rule that a pattern table must keep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LutRule {
    /// The table has no entry.
    Empty,
    /// More entries than the controller holds.
    TooManyEntries {
        /// Entries given.
        entries: usize,
        /// Most it holds.
        most: usize,
    },
    /// Entries must be numbered 0, 1, 2, ...
    Index {
        /// The number found.
        found: u16,
    },
    /// Depth that this DMD does not support.
    Depth {
        /// The depth found.
        depth: u8,
    },
    /// Exposure below the load time of the depth.
    ExposureTooShort {
        /// The exposure found, microseconds.
        exposure_us: u32,
        /// The depth.
        depth: u8,
        /// The least, microseconds.
        least_us: u32,
    },
    /// Exposure or dark time above 24 bits, or a dark time that makes the sum too long.
    TimeTooLong {
        /// The time found, microseconds.
        time_us: u32,
    },
    /// The pattern reaches beyond plane 23 of its image.
    BitPosition {
        /// Lowest plane.
        bit: u8,
        /// Bits.
        depth: u8,
    },
    /// The image index is beyond those that exist.
    Image {
        /// The index found.
        image: u16,
        /// How many there are.
        images: usize,
    },
    /// All entries together need more planes than the memory holds.
    Memory {
        /// Planes up to and including this entry.
        planes: u32,
        /// Most it holds.
        most: u32,
    },
    /// In video-pattern mode the patterns must fit a video frame.
    FrameTooShort {
        /// Exposure and dark times up to and including this entry, microseconds.
        sum_us: u64,
        /// The frame, microseconds.
        frame_us: u64,
    },
}

impl LutRule {
    /// The controller's error code (0x0100) for a table that breaks the rule.
    pub const fn error_code(self) -> u8 {
        match self {
            Self::Empty | Self::TooManyEntries { .. } | Self::Memory { .. } => 15,
            Self::Index { .. } => 16,
            Self::Depth { .. } | Self::BitPosition { .. } => 10,
            Self::ExposureTooShort { .. } | Self::FrameTooShort { .. } => 14,
            Self::TimeTooLong { .. } => 12,
            Self::Image { .. } => 17,
        }
    }
}

impl core::fmt::Display for LutRule {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Empty => write!(f, "a sequence needs at least one pattern"),
            Self::TooManyEntries { entries, most } => {
                write!(f, "{entries} entries, the controller holds {most}: split the sequence")
            }
            Self::Index { found } => write!(f, "it is numbered {found}; entries are numbered 0, 1, 2, ... without gaps"),
            Self::Depth { depth } => write!(f, "this DMD shows no {depth}-bit patterns"),
            Self::ExposureTooShort { exposure_us, depth, least_us } => write!(
                f,
                "exposure {exposure_us} us is below the {least_us} us that a {depth}-bit pattern takes to load: expose longer or use fewer bits"
            ),
            Self::TimeTooLong { time_us } => {
                write!(f, "a time of {time_us} us does not fit 24 bits (at most {MAX_TIME_US} us)")
            }
            Self::BitPosition { bit, depth } => write!(
                f,
                "{depth} bits from plane {bit} reach beyond plane 23: the lowest plane is at most {}",
                24u8.saturating_sub(*depth)
            ),
            Self::Image { image, images } => {
                write!(f, "image {image} does not exist: there are {images}, numbered from 0")
            }
            Self::Memory { planes, most } => {
                write!(f, "the sequence needs {planes} planes up to here, the memory holds {most}: split the sequence")
            }
            Self::FrameTooShort { sum_us, frame_us } => write!(
                f,
                "patterns up to here take {sum_us} us, a video frame has {frame_us} us: expose shorter or lower the frame rate"
            ),
        }
    }
}

/// A table entry that breaks a rule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LutError {
    /// Which entry, counted from 0.
    pub entry: usize,
    /// Which rule.
    pub rule: LutRule,
}

impl core::fmt::Display for LutError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "LUT entry {}: {}", self.entry, self.rule)
    }
}

impl core::error::Error for LutError {}

/// The limits for a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TableLimits {
    /// The DMD.
    pub dmd: Dmd,
    /// Images that the entries may name.
    pub images: usize,
    /// Length of a video frame in video-pattern mode, microseconds.
    pub frame_us: Option<u64>,
}

/// The rule that one entry breaks, if any; `place` is its position in the table.
pub fn check_entry(place: usize, e: &LutEntry, limits: &TableLimits) -> Result<(), LutRule> {
    if usize::from(e.index) != place {
        return Err(LutRule::Index { found: e.index });
    }
    let shows = matches!(e.depth, 1..=8) || limits.dmd.min_exposure_us(e.depth).is_some();
    if !shows {
        return Err(LutRule::Depth { depth: e.depth });
    }
    for time_us in [e.exposure_us, e.dark_us] {
        if time_us > MAX_TIME_US {
            return Err(LutRule::TimeTooLong { time_us });
        }
    }
    if let Some(least_us) = limits.dmd.min_exposure_us(e.depth) {
        if e.exposure_us < least_us {
            return Err(LutRule::ExposureTooShort { exposure_us: e.exposure_us, depth: e.depth, least_us });
        }
    } else if e.exposure_us == 0 {
        return Err(LutRule::ExposureTooShort { exposure_us: 0, depth: e.depth, least_us: 1 });
    }
    if u32::from(e.bit) + u32::from(e.depth) > IMAGE_PLANES as u32 {
        return Err(LutRule::BitPosition { bit: e.bit, depth: e.depth });
    }
    if usize::from(e.image) >= limits.images {
        return Err(LutRule::Image { image: e.image, images: limits.images });
    }
    Ok(())
}

/// Checks a whole table; the error names the first entry that breaks a rule.
pub fn validate(entries: &[LutEntry], limits: &TableLimits) -> Result<(), LutError> {
    let fail = |entry, rule| Err(LutError { entry, rule });
    if entries.is_empty() {
        return fail(0, LutRule::Empty);
    }
    let most = limits.dmd.max_entries();
    if entries.len() > most {
        return fail(most, LutRule::TooManyEntries { entries: entries.len(), most });
    }
    let (mut planes, mut sum_us) = (0u32, 0u64);
    for (place, e) in entries.iter().enumerate() {
        check_entry(place, e, limits).map_err(|rule| LutError { entry: place, rule })?;
        planes += u32::from(e.depth);
        if planes > limits.dmd.max_planes() {
            return fail(place, LutRule::Memory { planes, most: limits.dmd.max_planes() });
        }
        sum_us += u64::from(e.exposure_us) + u64::from(e.dark_us);
        if let Some(frame_us) = limits.frame_us {
            if sum_us > frame_us {
                return fail(place, LutRule::FrameTooShort { sum_us, frame_us });
            }
        }
    }
    Ok(())
}

/// Time from the start of entry `place` to the start of the next one, microseconds: exposure, dark time, and the black that the
/// controller appends before a triggered pattern.
pub fn step_us(entries: &[LutEntry], place: usize) -> u64 {
    let Some(e) = entries.get(place) else { return 0 };
    let next = &entries[(place + 1) % entries.len()];
    let black = if next.wait_trigger { TRIGGER_BLACK_US } else { 0 };
    u64::from(e.exposure_us) + u64::from(e.dark_us) + u64::from(black)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LIMITS: TableLimits = TableLimits { dmd: Dmd::Dlp6500, images: 2, frame_us: None };

    /// The two entries of TI's on-the-fly example (programmer's guide, revision J).
    #[test]
    fn golden_entries_of_the_guide() {
        let first = LutEntry { leds: led::RED, ..LutEntry::one_bit(0, 0, 0, 200) };
        assert_eq!(first.encode(), [0x00, 0x00, 0xc8, 0x00, 0x00, 0x11, 0, 0, 0, 0, 0, 0]);
        let second = LutEntry { leds: led::GREEN, depth: 2, ..LutEntry::one_bit(1, 0, 1, 400) };
        assert_eq!(second.encode(), [0x01, 0x00, 0x90, 0x01, 0x00, 0x23, 0, 0, 0, 0, 0x00, 0x08]);
        assert_eq!(validate(&[first, second], &LIMITS), Ok(()));
        let all = LutEntry {
            index: 0x0102,
            exposure_us: 0x03_0405,
            dark_us: 0x06_0708,
            depth: 16,
            leds: led::BLUE,
            clear_after: false,
            wait_trigger: true,
            no_trigger_out2: true,
            image: 0x0401,
            bit: 8,
        };
        assert_eq!(
            all.encode(),
            [0x02, 0x01, 0x05, 0x04, 0x03, 0xce, 0x08, 0x07, 0x06, 0x03, 0x01, 0x44],
            "1 100 111 0: trigger, blue, depth - 1 = 7 and 8 more by the extended bit"
        );
    }

    #[test]
    fn every_rule_is_named_with_its_entry() {
        let good: Vec<_> = (0..3).map(|i| LutEntry::one_bit(i, 0, i as u8, 105)).collect();
        type Spoil = fn(&mut LutEntry);
        let cases: [(Spoil, LutRule, u8); 8] = [
            (|e| e.index = 7, LutRule::Index { found: 7 }, 16),
            (|e| e.depth = 9, LutRule::Depth { depth: 9 }, 10),
            (
                |e| e.exposure_us = 104,
                LutRule::ExposureTooShort { exposure_us: 104, depth: 1, least_us: 105 },
                14,
            ),
            (
                |e| (e.depth, e.exposure_us) = (8, 4045),
                LutRule::ExposureTooShort { exposure_us: 4045, depth: 8, least_us: 4046 },
                14,
            ),
            (|e| e.dark_us = 1 << 24, LutRule::TimeTooLong { time_us: 1 << 24 }, 12),
            (|e| e.bit = 24, LutRule::BitPosition { bit: 24, depth: 1 }, 10),
            (|e| e.image = 2, LutRule::Image { image: 2, images: 2 }, 17),
            (
                |e| (e.bit, e.depth, e.exposure_us) = (23, 2, 9999),
                LutRule::BitPosition { bit: 23, depth: 2 },
                10,
            ),
        ];
        for (spoil, rule, code) in cases {
            let mut t = good.clone();
            spoil(&mut t[1]);
            assert_eq!(validate(&t, &LIMITS), Err(LutError { entry: 1, rule }));
            assert_eq!(rule.error_code(), code);
            assert!(LutError { entry: 1, rule }.to_string().starts_with("LUT entry 1: "));
        }
        assert_eq!(validate(&[], &LIMITS).unwrap_err().rule, LutRule::Empty);
        let many: Vec<_> = (0..401).map(|i| LutEntry::one_bit(i, 0, 0, 105)).collect();
        let rule = LutRule::TooManyEntries { entries: 401, most: 400 };
        assert_eq!(validate(&many, &LIMITS), Err(LutError { entry: 400, rule }));
        let deep: Vec<_> =
            (0..51).map(|i| LutEntry { depth: 8, ..LutEntry::one_bit(i, 0, 0, 5000) }).collect();
        let rule = LutRule::Memory { planes: 408, most: 400 };
        assert_eq!(validate(&deep, &LIMITS), Err(LutError { entry: 50, rule }));
        let video = TableLimits { frame_us: Some(8333), ..LIMITS };
        let long: Vec<_> = (0..24).map(|i| LutEntry::one_bit(i, 0, i as u8, 348)).collect();
        let rule = LutRule::FrameTooShort { sum_us: 8352, frame_us: 8333 };
        assert_eq!(validate(&long, &video), Err(LutError { entry: 23, rule }));
    }

    #[test]
    fn tables_grow_with_depth_and_blocks_and_agree_where_they_meet() {
        for dmd in Dmd::ALL {
            let exposures: Vec<_> = (1..=8).filter_map(|d| dmd.min_exposure_us(d)).collect();
            assert!(exposures.windows(2).all(|w| w[0] < w[1]), "{dmd:?}");
            let blocks: Vec<_> = (1..=20).map_while(|b| dmd.block_exposure_us(b)).collect();
            assert!(blocks.windows(2).all(|w| w[0] <= w[1]), "{dmd:?}");
            assert_eq!(
                blocks.last().copied(),
                dmd.min_exposure_us(1),
                "{dmd:?}: all blocks = no restriction"
            );
            assert_eq!(Dmd::from_hardware_id(dmd.hardware_id()), Some(dmd));
        }
        assert_eq!(Dmd::from_hardware_id(0), None);
        let mut t: Vec<_> = (0..2).map(|i| LutEntry::one_bit(i, 0, 0, 200)).collect();
        t[0].dark_us = 50;
        assert_eq!((step_us(&t, 0), step_us(&t, 1), step_us(&t, 2)), (250, 200, 0));
        t[1].wait_trigger = true;
        assert_eq!((step_us(&t, 0), step_us(&t, 1)), (355, 200));
    }

    proptest! {
        #[test]
        fn any_twelve_bytes_decode_and_encode_back(bytes: [u8; 12]) {
            let e = LutEntry::decode(&bytes);
            let again = e.encode();
            prop_assert_eq!(LutEntry::decode(&again), e);
            // Bits 2..7 of byte 9 are reserved and dropped; nothing else is.
            let mut masked = bytes;
            masked[9] &= 3;
            prop_assert_eq!(again, masked);
        }

        #[test]
        fn what_validates_survives_the_wire(
            entries in prop::collection::vec((105u32..1_000_000, 0u32..1000, 1u8..=8, 0u8..8, any::<bool>(), 0u16..2, 0u8..24), 1..40)
        ) {
            let table: Vec<_> = entries.iter().enumerate().map(|(i, e)| LutEntry {
                index: i as u16, exposure_us: e.0, dark_us: e.1, depth: e.2, leds: e.3, clear_after: true,
                wait_trigger: e.4, no_trigger_out2: !e.4, image: e.5, bit: e.6,
            }).collect();
            match validate(&table, &LIMITS) {
                Ok(()) => for e in &table { prop_assert_eq!(LutEntry::decode(&e.encode()), *e); },
                Err(err) => prop_assert!(err.entry < table.len() && err.rule.error_code() != 0),
            }
        }
    }
}
