//! How bright a code value is at a pixel: response and brightness of each channel, darkness, ambient light, flat field.
//!
//! Light at a pixel is `flat(pixel) * (black + (1 - black) * sum of intensity * curve(code) over channels)`, over full
//! white in the middle of the raster at the same distance.

use dpm_device::planes::Raster;
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

/// Points of a curve, at equal distances of the code from 0 to 1.
pub const CURVE_POINTS: usize = 33;

/// Curves and brightness.
#[derive(Clone, Debug, PartialEq)]
pub struct Channels {
    /// For each channel, light over that at code 1, at codes from 0 to 1 in equal steps: 0 first, 1 last, never falling.
    pub curves: Vec<Vec<f64>>,
    /// Light of each channel at code 1 over that of all; they add up to 1.
    pub intensity: Vec<f64>,
    /// Light at code 0 over that of all channels at code 1.
    pub black: f64,
    /// Ambient light over that of all channels at code 1, at the place of the readings.
    pub ambient: f64,
    /// Largest standard deviation of a reading over full white.
    pub sigma: f64,
}

impl Channels {
    /// Light of a channel at a code of 0 to 1, without darkness, over that of all channels at code 1. Codes outside are
    /// taken as the nearest; a channel that is not there is dark.
    pub fn level(&self, channel: usize, code: f64) -> f64 {
        let (Some(curve), Some(intensity)) = (self.curves.get(channel), self.intensity.get(channel)) else {
            return 0.0;
        };
        let at = code.clamp(0.0, 1.0) * (curve.len().max(1) - 1) as f64;
        let low = at.floor() as usize;
        let value = |i: usize| curve.get(i).or(curve.last()).copied().unwrap_or(0.0);
        let share = at - low as f64;
        intensity * (1.0 - self.black) * ((1.0 - share) * value(low) + share * value(low + 1))
    }
}

/// Terms: 1, x, y, x^2, x y, y^2, with x and y from -1 to 1 over the raster.
pub const TERMS: usize = 6;
/// Brightness over the raster, 1 in its middle.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatField {
    /// The raster.
    pub raster: Raster,
    /// Of 1, x, y, x^2, x y, y^2, where x and y run from -1 to 1 over the raster. The first is 1.
    pub terms: [f64; TERMS],
    /// Brightness in the middle at one metre, in the sensor's unit.
    pub unit: f64,
    /// Largest standard deviation over the raster.
    pub sigma: f64,
}

impl FlatField {
    /// A field that is equally bright everywhere.
    pub fn even(raster: Raster) -> Self {
        Self { raster, terms: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], unit: 1.0, sigma: 0.0 }
    }

    /// Brightness at a pixel over that in the middle.
    pub fn at(&self, pixel: DVec2) -> f64 {
        let row = row(self.raster, pixel);
        row.iter().zip(&self.terms).map(|(a, b)| a * b).sum()
    }
}

/// The terms of a field at a pixel.
pub fn row(raster: Raster, pixel: DVec2) -> [f64; TERMS] {
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    let p = 2.0 * pixel / size - 1.0;
    [1.0, p.x, p.y, p.x * p.x, p.x * p.y, p.y * p.y]
}
