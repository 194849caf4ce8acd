//! Numbers of 0 to 1 as the 8 bits of a texture.

/// Rounds numbers to 8 bits, and notices those that a texture cannot hold.
#[derive(Debug, Default)]
pub struct Rounder {
    /// A number was none, or lay outside of 0 to 1.
    pub cut_off: bool,
}

impl Rounder {
    /// The nearest of the 256 values from 0 to 1. What lies beyond them is cut off, and what is no number becomes 0.
    pub fn byte(&mut self, number: f32) -> u8 {
        self.cut_off |= !(0.0..=1.0).contains(&number);
        // The conversion ends at 0 and 255, and makes 0 of what is no number.
        (number * 255.0 + 0.5) as u8
    }
}
