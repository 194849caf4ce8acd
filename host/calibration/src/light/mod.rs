//! How bright a code value is at a pixel: response and brightness of each channel, darkness, ambient light, flat field.
//!
//! Light at a pixel is `flat(pixel) * (black + (1 - black) * sum of intensity * curve(code) over channels)`, over full
//! white in the middle of the raster at the same distance. [`steady()`] takes the flicker of lamps out of samples,
//! [`ResponseSession`] makes curves of readings at one place, [`flat_field`] a field of the brightness along a sweep.

mod flat;
mod response;
mod steady;

pub use dpm_calibration_file::light::{Channels, FlatField, LightModel, CURVE_POINTS};
pub use flat::{flat_field, FlatError};
pub use response::{LightError, Next, ResponseSession};
pub use steady::{steady, Steady, SteadyError};

#[cfg(test)]
mod tests;
