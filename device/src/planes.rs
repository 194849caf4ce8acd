//! Bit planes: the binary images that a DMD shows one after the other, and the order they come in.
//!
//! Layout of one plane, everywhere in this project: rows top to bottom, each row padded to whole bytes, **bit 7 of a byte is the
//! leftmost of its eight mirrors**; padding bits are 0.

/// Size of a projector's mirror array in pixels. Both sides are 1 to [`Raster::MAX_SIDE`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Raster {
    width: u32,
    height: u32,
}

impl Raster {
    /// Largest accepted side in pixels.
    pub const MAX_SIDE: u32 = 8192;

    /// `None` when a side is 0 or above [`Raster::MAX_SIDE`].
    pub const fn new(width: u32, height: u32) -> Option<Self> {
        if width == 0 || height == 0 || width > Self::MAX_SIDE || height > Self::MAX_SIDE {
            None
        } else {
            Some(Self { width, height })
        }
    }

    /// Pixels in a row.
    pub const fn width(self) -> u32 {
        self.width
    }

    /// Rows.
    pub const fn height(self) -> u32 {
        self.height
    }

    /// Number of pixels.
    pub const fn pixel_count(self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Bytes of one row of a plane.
    pub const fn row_bytes(self) -> usize {
        (self.width as usize).div_ceil(8)
    }

    /// Bytes of one plane.
    pub const fn plane_bytes(self) -> usize {
        self.row_bytes() * self.height as usize
    }
}

/// The LED that is lit while a plane is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Channel {
    /// Red LED.
    Red = 0,
    /// Green LED.
    Green = 1,
    /// Blue LED.
    Blue = 2,
    /// All LEDs together (monochrome rigs). Planes of this channel carry the bits of the green code value.
    White = 3,
}

/// One plane of a frame: which bit of which channel it shows. Its LED intensity is `2^bit / 255` of full, or its share of the
/// full light where the planes of a schedule share it ([`PlaneSchedule::filling`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaneSpec {
    /// LED lit.
    pub channel: Channel,
    /// Bit of the 8-bit code value, 0 = least significant.
    pub bit: u8,
}

impl PlaneSpec {
    /// The code of this plane's light on the wire: channel in bits 4..5, bit number in bits 0..2.
    pub const fn led_code(self) -> u8 {
        ((self.channel as u8) << 4) | self.bit
    }

    /// Inverse of [`PlaneSpec::led_code`]; `None` for a code that no plane has.
    pub const fn from_led_code(code: u8) -> Option<Self> {
        let channel = match code >> 4 {
            0 => Channel::Red,
            1 => Channel::Green,
            2 => Channel::Blue,
            3 => Channel::White,
            _ => return None,
        };
        let bit = code & 0x0f;
        if bit < 8 {
            Some(Self { channel, bit })
        } else {
            None
        }
    }
}

/// Most planes a frame may have.
pub const MAX_PLANES: usize = 32;

/// The planes of a frame in the order they are shown. The light of a plane goes by its bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaneSchedule {
    planes: [PlaneSpec; MAX_PLANES],
    len: u8,
    repeats: bool,
    fills: bool,
    exceeds: bool,
}

/// How a code value is shared out over a frame whose planes do not weigh as its bits do: each channel shows several parts, one
/// after the other, and every part is a number of a few bits. The light of a frame is the sum of the parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parts {
    /// Parts of a channel, at least 2.
    pub count: u8,
    /// Bits of a part, 1 to 8. A part of one bit is a plane, and all planes give equal light then.
    pub depth: u8,
    /// Planes below the parts, 0 to 7, each shown once, that weigh as the bits of a number do: the lowest plane counts 1, and a
    /// part of one bit `2^low`. 0 unless parts have one bit.
    pub low: u8,
    /// All planes are white, and show the green code value; else red, green and blue have as many parts each.
    pub white: bool,
}

impl Parts {
    /// The greatest sum of the parts of a channel: what a mirror adds up to that is on in all its planes.
    pub const fn most(self) -> u32 {
        ((self.count as u32 * ((1 << self.depth) - 1)) << self.low) + (1 << self.low) - 1
    }
}

impl PlaneSchedule {
    /// Planes in the order given; `None` if the list is empty, longer than [`MAX_PLANES`], or contains a (channel, bit)
    /// pair twice.
    pub fn new(planes: &[PlaneSpec]) -> Option<Self> {
        if planes.is_empty() || planes.len() > MAX_PLANES {
            return None;
        }
        for (i, p) in planes.iter().enumerate() {
            if p.bit > 7 || planes[..i].contains(p) {
                return None;
            }
        }
        let mut all = [PlaneSpec { channel: Channel::White, bit: 0 }; MAX_PLANES];
        all[..planes.len()].copy_from_slice(planes);
        Some(Self { planes: all, len: planes.len() as u8, repeats: false, fills: false, exceeds: false })
    }

    /// Planes in the order given, of which several may have the same channel and bit: for codes that need planes of equal
    /// light. `None` as for [`PlaneSchedule::new`], or if a mirror that is on in every plane would send out more light
    /// than full white in one of the channels.
    pub fn with_repeats(planes: &[PlaneSpec]) -> Option<Self> {
        Self::repeating(planes).filter(|schedule| schedule.greatest_sum() <= 255)
    }

    /// Planes in the order given that share the full light of a frame among them: a mirror that is on in all of them is as
    /// bright as the projector can make it, whatever the sum of their bits. Displays and panels whose light source is not
    /// dimmed from plane to plane are of this kind. `None` as for [`PlaneSchedule::new`], or if the channels that are lit do not
    /// reach the same sum; white and coloured planes do not mix.
    pub fn filling(planes: &[PlaneSpec]) -> Option<Self> {
        Self::even(planes).map(|schedule| Self { fills: true, ..schedule })
    }

    /// Planes in the order given, each with the light of its bit, of which more than full white comes together: the sum of a
    /// lit channel is above 255, because a bit is shown several times. No plane is brighter than it is in another schedule.
    /// `None` as for [`PlaneSchedule::filling`], or if the sum is 255 or less.
    pub fn exceeding(planes: &[PlaneSpec]) -> Option<Self> {
        let schedule = Self::even(planes)?;
        (schedule.greatest_sum() > 255).then_some(Self { exceeds: true, ..schedule })
    }

    /// Planes whose lit channels all reach the same sum; white and coloured planes do not mix.
    fn even(planes: &[PlaneSpec]) -> Option<Self> {
        let schedule = Self::repeating(planes)?;
        let sums = [Channel::Red, Channel::Green, Channel::Blue].map(|channel| schedule.sum_of(channel));
        let whites = planes.iter().filter(|p| p.channel == Channel::White).count();
        let is_one_kind = whites == 0 || whites == planes.len();
        let is_even = sums.iter().all(|&sum| sum == 0 || sum == schedule.greatest_sum());
        (is_one_kind && is_even).then_some(schedule)
    }

    /// This schedule as one whose planes share the full light; itself if that is not possible. See [`PlaneSchedule::filling`].
    pub fn filled(self) -> Self {
        Self::filling(self.planes()).unwrap_or(self)
    }

    fn repeating(planes: &[PlaneSpec]) -> Option<Self> {
        if planes.is_empty() || planes.len() > MAX_PLANES || planes.iter().any(|p| p.bit > 7) {
            return None;
        }
        let mut all = [PlaneSpec { channel: Channel::White, bit: 0 }; MAX_PLANES];
        all[..planes.len()].copy_from_slice(planes);
        let repeats = planes.iter().enumerate().any(|(i, p)| planes[..i].contains(p));
        Some(Self { planes: all, len: planes.len() as u8, repeats, fills: false, exceeds: false })
    }

    /// Sum of `2^bit` over the planes that light `channel`.
    fn sum_of(&self, channel: Channel) -> u32 {
        let lights = |p: &&PlaneSpec| p.channel == channel || p.channel == Channel::White;
        self.planes().iter().filter(lights).map(|p| 1u32 << p.bit).sum()
    }

    fn greatest_sum(&self) -> u32 {
        [Channel::Red, Channel::Green, Channel::Blue].map(|c| self.sum_of(c)).into_iter().fold(0, u32::max)
    }

    /// `parts.count` parts of `parts.depth` bits for each channel, in the order in which a DLPC900 shows the bits of a pixel:
    /// part by part, in each green, red and blue, and of each number the lowest bit first. They share the full light of a
    /// frame. `None` if these are more planes than a frame may have, or a part has no bits or more than 8.
    pub fn of_parts(parts: Parts) -> Option<Self> {
        let channels: &[Channel] =
            if parts.white { &[Channel::White] } else { &[Channel::Green, Channel::Red, Channel::Blue] };
        let planes = usize::from(parts.count) * usize::from(parts.depth) * channels.len();
        if planes > MAX_PLANES || parts.depth > 8 {
            return None;
        }
        let mut all = [PlaneSpec { channel: Channel::White, bit: 0 }; MAX_PLANES];
        for (i, plane) in all[..planes].iter_mut().enumerate() {
            let (pattern, bit) = (i / usize::from(parts.depth), i % usize::from(parts.depth));
            *plane = PlaneSpec { channel: channels[pattern % channels.len()], bit: bit as u8 };
        }
        Self::filling(&all[..planes])
    }

    /// 24 planes of equal white light, each at 8 / 255 of full: three quarters of full white if all are on.
    pub fn equal24() -> Self {
        Self::with_repeats(&[PlaneSpec { channel: Channel::White, bit: 3 }; 24]).expect("192 of 255")
    }

    /// 24 planes of equal light: red, green, blue eight times, each at 16 / 255 of full, which is 128 of 255 if all are on.
    pub fn equal_rgb24() -> Self {
        let channels = [Channel::Red, Channel::Green, Channel::Blue];
        let planes: [PlaneSpec; 24] =
            core::array::from_fn(|i| PlaneSpec { channel: channels[i % 3], bit: 4 });
        Self::with_repeats(&planes).expect("128 of 255 in each channel")
    }

    /// 8 white planes of equal light, each at 16 / 255 of full.
    pub fn equal_mono8() -> Self {
        Self::with_repeats(&[PlaneSpec { channel: Channel::White, bit: 4 }; 8]).expect("128 of 255")
    }

    /// The bits that each channel shows in turn where the highest one is split: three planes of bit 7 where others have one, and
    /// none of bits 0 and 1. Levels take the second of the three first, then the first, then the third. Of the orders that
    /// leave little modulation at the frame rate this one keeps the light of every level nearly at one instant, so that an eye
    /// that rests sees passing pictures with little error.
    const SPLIT: [u8; 8] = [4, 7, 5, 6, 2, 7, 7, 3];

    /// 24 planes whose highest bit is split, red, green and blue in turn: 508 of 255 if all are on. Levels go in steps of four.
    pub fn split_rgb24() -> Self {
        let channels = [Channel::Red, Channel::Green, Channel::Blue];
        let planes: [PlaneSpec; 24] =
            core::array::from_fn(|i| PlaneSpec { channel: channels[i % 3], bit: Self::SPLIT[i / 3] });
        Self::exceeding(&planes).expect("508 in each channel")
    }

    /// 8 white planes whose highest bit is split.
    pub fn split_mono8() -> Self {
        Self::exceeding(&Self::SPLIT.map(|bit| PlaneSpec { channel: Channel::White, bit }))
            .expect("508 of 255")
    }

    /// How code values are shared out over the planes, if these do not weigh as the bits of a code value do: every channel
    /// (one white, or red, green and blue alike) shows the same few bits several times, lowest first, or each of some bits
    /// once and the one above them several times, in any order. A white channel has at most 24 planes, a coloured one at
    /// most 8. `None` for other schedules.
    pub fn parts(&self) -> Option<Parts> {
        let white = self.planes().iter().all(|p| p.channel == Channel::White);
        let of =
            |channel| if white { Some(self.numbers_of(Channel::White)?) } else { self.numbers_of(channel) };
        let [red, green, blue] = [Channel::Red, Channel::Green, Channel::Blue].map(of);
        let first = red?;
        let [count, depth, low, _] = first;
        let planes = usize::from(count) * usize::from(depth) + usize::from(low);
        let all = if white { planes } else { 3 * planes };
        let is_alike = green == red && blue == red && all == self.len();
        let fits = planes <= if white { 24 } else { 8 };
        (is_alike && fits && count > 1).then_some(Parts { count, depth, low, white })
    }

    /// How often a channel shows how many bits, how many others it shows once below them, and the lowest of all; `None` if it
    /// shows no bits again and again, or not all of those below.
    fn numbers_of(&self, channel: Channel) -> Option<[u8; 4]> {
        let bits = || self.planes().iter().filter(|p| p.channel == channel).map(|p| p.bit);
        let (lowest, highest) = (bits().min()?, bits().max()?);
        let times = |bit: u8| bits().filter(|&b| b == bit).count() as u8;
        if highest > lowest && times(highest) > 1 && (lowest..highest).all(|bit| times(bit) == 1) {
            return Some([times(highest), 1, highest - lowest, lowest]);
        }
        let lowest = bits().next()?;
        let depth = bits().zip(lowest..).take_while(|(bit, rising)| bit == rising).count();
        let is_again = |(i, bit): (usize, u8)| usize::from(bit - lowest) == i % depth;
        let count = bits().count();
        let is_even =
            count % depth == 0 && bits().all(|bit| bit >= lowest) && bits().enumerate().all(is_again);
        is_even.then_some([(count / depth) as u8, depth as u8, 0, lowest])
    }

    /// The sum of `2^bit` over the planes of a channel that is as bright as this schedule makes it: 255, unless the planes share
    /// the full light among them or exceed it.
    pub fn white_weight(&self) -> u32 {
        if self.fills || self.exceeds {
            self.greatest_sum()
        } else {
            255
        }
    }

    /// The sum of `2^bit` that limits on light call full: the same light whether planes exceed it or not.
    pub fn limit_weight(&self) -> u32 {
        if self.exceeds {
            255
        } else {
            self.white_weight()
        }
    }

    /// Light of a channel as a code value, rounded, at most 255, where `sum` is the sum of `2^bit` over the planes in which a
    /// mirror is on.
    pub fn light_of(&self, sum: u32) -> u8 {
        let white = self.white_weight();
        ((sum.min(white) * 255 + white / 2) / white) as u8
    }

    /// Light of a channel when all planes are on, in units of which 255 is full light: 255 for binary planes of eight bits, and
    /// more only where planes exceed it.
    pub fn full_light(&self) -> u32 {
        match self.exceeds {
            true => self.greatest_sum(),
            false => self.light_of(self.greatest_sum()).into(),
        }
    }

    /// The planes of a channel give more than full light together; see [`PlaneSchedule::exceeding`].
    pub const fn exceeds(&self) -> bool {
        self.exceeds
    }

    /// The planes share the full light of a frame among them; see [`PlaneSchedule::filling`].
    pub const fn fills(&self) -> bool {
        self.fills
    }

    /// Two planes have the same channel and bit.
    pub const fn has_repeats(&self) -> bool {
        self.repeats
    }

    /// 24 planes: for each bit from 7 down to 0 red, green, blue. Interleaving the colours keeps the
    /// colour fields of a moving edge one plane slot (44 us) apart instead of a third of a frame.
    pub fn rgb24() -> Self {
        Self::rgb24_in(Self::DESCENDING).expect("24 distinct planes")
    }

    /// 8 planes of one white channel, bit 7 first.
    pub fn mono8() -> Self {
        Self::mono8_in(Self::DESCENDING).expect("8 distinct planes")
    }

    /// The bits of a code value from the most significant down.
    const DESCENDING: [u8; 8] = [7, 6, 5, 4, 3, 2, 1, 0];

    /// 24 planes: for each of `bits` in turn red, green, blue. `None` if a bit occurs twice or is above 7.
    pub fn rgb24_in(bits: [u8; 8]) -> Option<Self> {
        let channels = [Channel::Red, Channel::Green, Channel::Blue];
        let planes: [PlaneSpec; 24] =
            core::array::from_fn(|i| PlaneSpec { channel: channels[i % 3], bit: bits[i / 3] });
        Self::new(&planes)
    }

    /// 8 planes of one white channel that show `bits` in turn. `None` as for [`PlaneSchedule::rgb24_in`].
    pub fn mono8_in(bits: [u8; 8]) -> Option<Self> {
        Self::new(&bits.map(|bit| PlaneSpec { channel: Channel::White, bit }))
    }

    /// The planes in order.
    pub fn planes(&self) -> &[PlaneSpec] {
        &self.planes[..self.len as usize]
    }

    /// Number of planes.
    pub const fn len(&self) -> usize {
        self.len as usize
    }

    /// Never true: a schedule has at least one plane.
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parts(count: u8, depth: u8, white: bool) -> Parts {
        Parts { count, depth, low: 0, white }
    }

    /// What a schedule was made of is found in it again, and schedules whose bits weigh as those of a code value have none.
    #[test]
    fn parts_are_found_again() {
        for (count, depth, white) in [
            (3, 8, true),
            (4, 6, true),
            (6, 4, true),
            (8, 3, true),
            (12, 2, true),
            (24, 1, true),
            (2, 4, false),
            (4, 2, false),
            (8, 1, false),
        ] {
            let made = parts(count, depth, white);
            let schedule = PlaneSchedule::of_parts(made).unwrap();
            assert_eq!(schedule.len(), 24);
            assert_eq!(schedule.parts(), Some(made));
            assert!(schedule.fills() && schedule.has_repeats());
            assert_eq!((schedule.white_weight(), schedule.full_light()), (made.most(), 255));
            // The light of a mirror that is on in the planes of a single part.
            let single = schedule.light_of((1 << depth) - 1);
            assert!((f64::from(single) - 255.0 / f64::from(count)).abs() <= 0.5, "{made:?}: {single}");
        }
        for (schedule, each, white) in [
            (PlaneSchedule::equal_rgb24(), 8, false),
            (PlaneSchedule::equal_mono8(), 8, true),
            (PlaneSchedule::equal24(), 24, true),
        ] {
            assert_eq!(schedule.parts(), Some(parts(each, 1, white)));
            assert_eq!(schedule.filled().parts(), schedule.parts());
            assert!(schedule.full_light() < 255 && schedule.filled().full_light() == 255);
        }
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), PlaneSchedule::mono8().filled()] {
            assert_eq!((schedule.parts(), schedule.white_weight()), (None, 255));
            assert!((0..256).all(|sum| u32::from(schedule.light_of(sum)) == sum));
        }
        let ascending = PlaneSchedule::of_parts(parts(1, 8, false)).unwrap();
        assert_eq!(
            (ascending.parts(), ascending.has_repeats(), ascending.white_weight()),
            (None, false, 255)
        );
    }

    /// Nearly twice the light of binary planes, none of them brighter than the brightest of those.
    #[test]
    fn a_split_highest_bit_gives_more_light() {
        for (schedule, white) in [(PlaneSchedule::split_rgb24(), false), (PlaneSchedule::split_mono8(), true)]
        {
            assert_eq!(schedule.parts(), Some(Parts { count: 3, depth: 1, low: 5, white }));
            assert!(schedule.exceeds() && schedule.has_repeats() && !schedule.fills());
            assert!(f64::from(schedule.full_light()) >= 1.9 * f64::from(PlaneSchedule::rgb24().full_light()));
            assert_eq!(schedule.white_weight(), schedule.parts().unwrap().most() << 2);
            assert_eq!([254, 508].map(|sum| schedule.light_of(sum)), [128, 255]);
            assert!(schedule.limit_weight() == 255 && schedule.planes().iter().all(|p| p.bit <= 7));
            assert_eq!(PlaneSchedule::with_repeats(schedule.planes()), None);
        }
        // No more than full light, uneven light, mixed light; a bit that is missing, and one twice, below those that repeat.
        let white = |bits: &[u8]| -> Option<PlaneSchedule> {
            let planes: std::vec::Vec<_> =
                bits.iter().map(|&bit| PlaneSpec { channel: Channel::White, bit }).collect();
            PlaneSchedule::exceeding(&planes)
        };
        assert_eq!(white(&[7, 6, 5, 4, 3, 2, 1, 0]), None);
        assert!(white(&[7, 7]).is_some_and(|s| s.parts() == Some(parts(2, 1, true))));
        assert_eq!([white(&[7, 5, 7]), white(&[7, 6, 6, 7])].map(|s| s.unwrap().parts()), [None, None]);
        let plane = |channel, bit| PlaneSpec { channel, bit };
        let uneven = [plane(Channel::Red, 7), plane(Channel::Red, 7), plane(Channel::Green, 7)];
        let mixed = [plane(Channel::White, 7), plane(Channel::White, 7), plane(Channel::Green, 7)];
        assert_eq!([&uneven, &mixed].map(|planes| PlaneSchedule::exceeding(planes)), [None, None]);
    }

    #[test]
    fn a_schedule_that_cannot_share_the_light_is_refused() {
        assert_eq!(PlaneSchedule::of_parts(parts(4, 8, false)), None);
        assert_eq!(PlaneSchedule::of_parts(parts(2, 9, true)), None);
        assert_eq!(PlaneSchedule::of_parts(parts(0, 8, true)), None);
        assert_eq!(PlaneSchedule::of_parts(parts(2, 0, true)), None);
        let plane = |channel, bit| PlaneSpec { channel, bit };
        let uneven = [plane(Channel::Red, 0), plane(Channel::Green, 1)];
        let mixed = [plane(Channel::White, 0), plane(Channel::Green, 0)];
        assert_eq!([&uneven, &mixed].map(|planes| PlaneSchedule::filling(planes)), [None, None]);
        // More than full white of a dimmed light source, and full light shared out.
        let thrice = [plane(Channel::White, 7); 3];
        assert_eq!(PlaneSchedule::with_repeats(&thrice), None);
        assert_eq!(PlaneSchedule::filling(&thrice).unwrap().light_of(128), 85);
        // A single colour may fill alone.
        assert!(PlaneSchedule::filling(&[plane(Channel::Blue, 3); 4]).is_some());
    }
}
