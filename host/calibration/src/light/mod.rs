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
    /// The text of a table for `projector.response` of a rig file: a line for each of 256 code values, with the light of
    /// the first three channels over full white, darkness included.
    pub fn response_table(&self) -> String {
        let line = |code: u32| {
            // The darkness of all channels is that of the picture: each bears its part.
            let black =
                |c: usize| self.channels.black * self.channels.intensity.get(c).copied().unwrap_or(0.0);
            let level = |c: usize| black(c) + self.channels.level(c, f64::from(code) / 255.0);
            format!("{:.6} {:.6} {:.6}\n", level(0), level(1), level(2))
        };
        (0..256).map(line).collect()
    }

    /// Light of one channel at a code of 0 to 1, without darkness, over full white in the middle of the raster.
    pub fn level(&self, channel: usize, code: f64, pixel: DVec2) -> f64 {
        self.flat.at(pixel) * self.channels.level(channel, code)
    }
}

#[cfg(test)]
mod tests;
