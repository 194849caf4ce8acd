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

/// One plane of a frame: which bit of which channel it shows. Its LED intensity is `2^bit / 255` of full.
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

/// The planes of a frame in the order they are shown. All planes share one slot length; grey comes from LED intensity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaneSchedule {
    planes: [PlaneSpec; MAX_PLANES],
    len: u8,
    repeats: bool,
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
        Some(Self { planes: all, len: planes.len() as u8, repeats: false })
    }

    /// Planes in the order given, of which several may have the same channel and bit: for codes that need planes of equal
    /// light. `None` as for [`PlaneSchedule::new`], or if a mirror that is on in every plane would send out more light
    /// than full white in one of the channels.
    pub fn with_repeats(planes: &[PlaneSpec]) -> Option<Self> {
        if planes.is_empty() || planes.len() > MAX_PLANES || planes.iter().any(|p| p.bit > 7) {
            return None;
        }
        let light = |channel| {
            let lights = |p: &&PlaneSpec| p.channel == channel || p.channel == Channel::White;
            planes.iter().filter(lights).map(|p| 1u32 << p.bit).sum::<u32>()
        };
        if [Channel::Red, Channel::Green, Channel::Blue].into_iter().any(|channel| light(channel) > 255) {
            return None;
        }
        let mut all = [PlaneSpec { channel: Channel::White, bit: 0 }; MAX_PLANES];
        all[..planes.len()].copy_from_slice(planes);
        let repeats = planes.iter().enumerate().any(|(i, p)| planes[..i].contains(p));
        Some(Self { planes: all, len: planes.len() as u8, repeats })
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

    /// Number of planes of each channel, if they all give the same light and grey can come only from how many of them a
    /// mirror is on in: one white channel, or red, green and blue with at most 8 planes each. `None` for other schedules.
    pub fn equal_planes(&self) -> Option<u8> {
        let count = |channel| self.planes().iter().filter(|p| p.channel == channel).count();
        let (first, white) = (self.planes()[0], count(Channel::White));
        let each = if white > 0 { white } else { count(Channel::Red) };
        let is_even = if white > 0 {
            white == self.len() && white <= 24
        } else {
            each <= 8 && count(Channel::Green) == each && count(Channel::Blue) == each
        };
        let is_equal = self.planes().iter().all(|p| p.bit == first.bit);
        (each > 1 && is_even && is_equal).then_some(each as u8)
    }

    /// Light of a channel when all planes are on, as a code value: 255 for binary planes of eight bits.
    pub fn full_light(&self) -> u32 {
        let light = |channel| {
            let lights = |p: &&PlaneSpec| p.channel == channel || p.channel == Channel::White;
            self.planes().iter().filter(lights).map(|p| 1u32 << p.bit).sum::<u32>().min(255)
        };
        [Channel::Red, Channel::Green, Channel::Blue].into_iter().map(light).max().unwrap_or(0)
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
    pub const DESCENDING: [u8; 8] = [7, 6, 5, 4, 3, 2, 1, 0];

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
