//! Texels as shaders read them.

use super::srgb::to_linear;

/// Linear RGBA, 16 bits each, red and blue in the low halves.
pub type LinearTexel = [u32; 2];

/// From the 8-bit texels of pictures to linear ones.
#[derive(Clone, Debug)]
pub struct ToLinear([u16; 256]);

impl ToLinear {
    /// For pictures whose colours are sRGB-encoded, or linear.
    pub fn new(srgb: bool) -> Self {
        Self(std::array::from_fn(|value| {
            let value = value as u8;
            if srgb {
                (to_linear(f32::from(value) / 255.0) * 65535.0).round() as u16
            } else {
                u16::from(value) * 257
            }
        }))
    }

    /// An RGBA texel. Alpha is linear in every picture.
    pub fn texel(&self, [r, g, b, a]: [u8; 4]) -> LinearTexel {
        let [r, g, b] = [r, g, b].map(|value| u32::from(self.0[usize::from(value)]));
        [r | (g << 16), b | ((u32::from(a) * 257) << 16)]
    }
}
