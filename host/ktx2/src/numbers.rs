//! Numbers as KTX2 images store them, and how they become the 8 bits of a texture.

use half::f16;

/// How a channel is stored, always with its low byte first.
#[derive(Clone, Copy)]
pub(crate) enum Number {
    /// 8 bits for 0 to 1.
    Unorm8,
    /// 8 bits for -1 to 1.
    Snorm8,
    /// 16 bits for 0 to 1.
    Unorm16,
    /// 16 bits for -1 to 1.
    Snorm16,
    /// A floating-point number of 16 bits.
    Half,
    /// A floating-point number of 32 bits.
    Single,
}

impl Number {
    /// Bytes of a number.
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Unorm8 | Self::Snorm8 => 1,
            Self::Unorm16 | Self::Snorm16 | Self::Half => 2,
            Self::Single => 4,
        }
    }

    /// The number at the start of `stored`, which holds it whole. A texture holds 0 to 1.
    pub(crate) fn read(self, stored: &[u8]) -> f32 {
        let two = || [stored[0], stored[1]];
        match self {
            Self::Unorm8 => f32::from(stored[0]) / 255.0,
            Self::Snorm8 => raised(f32::from(stored[0] as i8) / 127.0),
            Self::Unorm16 => f32::from(u16::from_le_bytes(two())) / 65_535.0,
            Self::Snorm16 => raised(f32::from(i16::from_le_bytes(two())) / 32_767.0),
            Self::Half => f16::from_le_bytes(two()).to_f32(),
            Self::Single => f32::from_le_bytes([stored[0], stored[1], stored[2], stored[3]]),
        }
    }
}

/// A number of -1 to 1 as one of 0 to 1, which is how glTF stores directions.
///
/// Images with a sign hold directions: a colour has none. The least of their numbers stands for -1, as does the next.
pub(crate) fn raised(number: f32) -> f32 {
    number.max(-1.0) * 0.5 + 0.5
}

#[cfg(test)]
mod tests {
    use super::Number;
    use dpm_common::rounding::Rounder;

    #[test]
    fn every_number_of_eight_and_of_sixteen_bits_becomes_the_nearest_byte() {
        let mut rounder = Rounder::default();
        for stored in 0..=u8::MAX {
            assert_eq!(rounder.byte(Number::Unorm8.read(&[stored])), stored);
            // From -127 to 127 lie 254 steps; -128 is -127 again.
            let above = i32::from(stored as i8).max(-127) + 127;
            assert_eq!(i32::from(rounder.byte(Number::Snorm8.read(&[stored]))), (above * 255 + 127) / 254);
        }
        for stored in 0..=u16::MAX {
            let byte = rounder.byte(Number::Unorm16.read(&stored.to_le_bytes()));
            assert_eq!(u32::from(byte), (u32::from(stored) + 128) / 257, "{stored}");
            let above = i32::from(stored as i16).max(-32_767) + 32_767;
            let byte = rounder.byte(Number::Snorm16.read(&stored.to_le_bytes()));
            assert_eq!(i32::from(byte), (above * 255 + 32_767) / 65_534, "{stored}");
        }
        assert!(!rounder.cut_off);
    }

    #[test]
    fn numbers_beyond_a_texture_are_cut_off_and_noticed() {
        let cases = [
            (-0.0, 0, false),
            (0.5, 128, false),
            (1.0, 255, false),
            (1.001, 255, true),
            (-1e-6, 0, true),
            (f32::MAX, 255, true),
            (f32::INFINITY, 255, true),
            (f32::NEG_INFINITY, 0, true),
            (f32::NAN, 0, true),
        ];
        for (number, byte, cut_off) in cases {
            let mut rounder = Rounder::default();
            assert_eq!((rounder.byte(number), rounder.cut_off), (byte, cut_off), "{number}");
            let mut rounder = Rounder::default();
            assert_eq!(rounder.byte(Number::Single.read(&number.to_le_bytes())), byte, "{number}");
        }
        // 1, the number above it, and the greatest of all.
        for (bits, cut_off) in [(0x3c00_u16, false), (0x3c01, true), (0x7bff, true)] {
            let mut rounder = Rounder::default();
            assert_eq!(rounder.byte(Number::Half.read(&bits.to_le_bytes())), 255);
            assert_eq!(rounder.cut_off, cut_off);
        }
    }
}
