//! Texels that a KTX2 image stores one after the other, channel by channel.

use ktx2::Format;

use super::numbers::Number;
use super::{Ktx2Error, LevelContent};
use dpm_common::rounding::Rounder;

/// What a texel consists of.
pub(crate) struct TexelLayout {
    /// How each of its channels is stored.
    number: Number,
    /// Channels, 1 to 4, beginning with red.
    pub channels: usize,
    /// Blue comes first and red third.
    swapped: bool,
}

impl TexelLayout {
    /// The layout of a format whose channels are numbers of the same kind, and stand for fractions of 1.
    pub(crate) fn of(format: Format) -> Option<Self> {
        use Number::{Half, Single, Snorm16, Snorm8, Unorm16, Unorm8};
        let (number, channels) = match format {
            Format::R8_UNORM | Format::R8_SRGB => (Unorm8, 1),
            Format::R8G8_UNORM | Format::R8G8_SRGB => (Unorm8, 2),
            Format::R8G8B8_UNORM | Format::R8G8B8_SRGB => (Unorm8, 3),
            Format::B8G8R8_UNORM | Format::B8G8R8_SRGB => (Unorm8, 3),
            Format::R8G8B8A8_UNORM | Format::R8G8B8A8_SRGB => (Unorm8, 4),
            Format::B8G8R8A8_UNORM | Format::B8G8R8A8_SRGB => (Unorm8, 4),
            Format::R8_SNORM => (Snorm8, 1),
            Format::R8G8_SNORM => (Snorm8, 2),
            Format::R8G8B8_SNORM | Format::B8G8R8_SNORM => (Snorm8, 3),
            Format::R8G8B8A8_SNORM | Format::B8G8R8A8_SNORM => (Snorm8, 4),
            Format::R16_UNORM => (Unorm16, 1),
            Format::R16G16_UNORM => (Unorm16, 2),
            Format::R16G16B16_UNORM => (Unorm16, 3),
            Format::R16G16B16A16_UNORM => (Unorm16, 4),
            Format::R16_SNORM => (Snorm16, 1),
            Format::R16G16_SNORM => (Snorm16, 2),
            Format::R16G16B16_SNORM => (Snorm16, 3),
            Format::R16G16B16A16_SNORM => (Snorm16, 4),
            Format::R16_SFLOAT => (Half, 1),
            Format::R16G16_SFLOAT => (Half, 2),
            Format::R16G16B16_SFLOAT => (Half, 3),
            Format::R16G16B16A16_SFLOAT => (Half, 4),
            Format::R32_SFLOAT => (Single, 1),
            Format::R32G32_SFLOAT => (Single, 2),
            Format::R32G32B32_SFLOAT => (Single, 3),
            Format::R32G32B32A32_SFLOAT => (Single, 4),
            _ => return None,
        };
        let swapped = (Format::B8G8R8_UNORM..=Format::B8G8R8_SRGB).contains(&format)
            || (Format::B8G8R8A8_UNORM..=Format::B8G8R8A8_SRGB).contains(&format);
        Some(Self { number, channels, swapped })
    }

    /// Every texel, row by row from the top. A channel that is not stored is 0, and alpha is 1.
    pub(crate) fn texels(
        &self,
        content: &LevelContent,
        rounder: &mut Rounder,
    ) -> Result<Vec<[u8; 4]>, Ktx2Error> {
        let bytes = self.number.bytes();
        let stored = content.bytes(content.size.texels() * self.channels * bytes)?;
        let texel = |stored: &[u8]| {
            let mut texel = [0, 0, 0, 255];
            for (channel, stored) in texel.iter_mut().zip(stored.chunks_exact(bytes)) {
                *channel = rounder.byte(self.number.read(stored));
            }
            if self.swapped {
                texel.swap(0, 2);
            }
            texel
        };
        Ok(stored.chunks_exact(self.channels * bytes).map(texel).collect())
    }
}
