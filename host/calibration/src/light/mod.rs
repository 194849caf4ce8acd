//! How bright a code value is at a pixel: response and brightness of each channel, darkness, ambient light, flat field.
//!
//! Light at a pixel is `flat(pixel) * (black + (1 - black) * sum of intensity * curve(code) over channels)`, over full
//! white in the middle of the raster at the same distance. [`steady()`] takes the flicker of lamps out of samples,
//! [`Session`] makes curves of readings at one place, [`flat_field`] a field of the brightness along a sweep.

mod flat;
mod response;
mod steady;

pub use flat::{flat_field, FlatError, FlatField};
pub use response::{Channels, LightError, Next, Session, CURVE_POINTS};
pub use steady::{steady, Steady, SteadyError};

use glam::DVec2;

/// The light of a projector.
#[derive(Clone, Debug, PartialEq)]
pub struct LightModel {
    /// Curves, brightness of the channels, darkness and ambient light.
    pub channels: Channels,
    /// Brightness over the raster.
    pub flat: FlatField,
}

impl LightModel {
    /// Light of one channel at a code of 0 to 1, without darkness, over full white in the middle of the raster.
    pub fn level(&self, channel: usize, code: f64, pixel: DVec2) -> f64 {
        self.flat.at(pixel) * self.channels.level(channel, code)
    }
}

#[cfg(test)]
mod tests;
