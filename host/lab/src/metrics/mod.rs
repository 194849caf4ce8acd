//! Two sequences of light into how different they are to a camera and to an eye.
//!
//! Pictures of what an eye sees are compared ([`error`], [`flip`]), and tiles are watched over time ([`flicker`]). What people
//! notice of light that changes in time is in [`sensitivity`]; [`jod`] is the quality of a video beside another; [`modulation`] is how much the light of a schedule changes.
//! Judging single frames would be wrong: at 947 fps the eye never sees one.

pub(crate) mod error;
pub(crate) mod flicker;
pub(crate) mod flip;
pub(crate) mod jod;
pub(crate) mod modulation;
pub(crate) mod sensitivity;

use glam::Vec3;

/// What a viewer takes for white: the brightest channel that all but a hundredth of the finite colours stay below; at least 1e-6.
pub(crate) fn white_of(colours: &[Vec3]) -> f32 {
    let mut all: Vec<f32> = colours.iter().filter(|v| v.is_finite()).map(|v| v.max_element()).collect();
    all.sort_by(f32::total_cmp);
    all.get(all.len() * 99 / 100).copied().unwrap_or(1.0).max(1e-6)
}

/// A picture in linear Rec. 709, rows from the top.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LinearImage<'a> {
    width: usize,
    height: usize,
    pixels: &'a [Vec3],
}

/// Why two pictures, or a picture and its weights, cannot be compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MetricError {
    /// Not `width * height` pixels, or none at all.
    #[error("{found} pixels cannot make a picture of {width} x {height}")]
    PixelCount {
        /// Pixels in a row.
        width: usize,
        /// Rows.
        height: usize,
        /// Pixels given.
        found: usize,
    },
    /// Two things that must be of one size are not.
    #[error("a picture of {0:?} pixels cannot be compared with one of {1:?}: render both at one size")]
    SizesDiffer((usize, usize), (usize, usize)),
    /// A weight is negative or not finite, all are zero, or their number is not that of the pixels.
    #[error("weights must be one for each pixel, finite, not negative and not all zero")]
    Weights,
    /// A parameter is outside its range.
    #[error("{0} is outside its range")]
    Parameter(&'static str),
}

impl<'a> LinearImage<'a> {
    /// Takes `width * height` pixels, at least one.
    ///
    /// # Errors
    /// [`MetricError::PixelCount`].
    pub(crate) fn new(width: usize, height: usize, pixels: &'a [Vec3]) -> Result<Self, MetricError> {
        if pixels.is_empty() || width.checked_mul(height) != Some(pixels.len()) {
            return Err(MetricError::PixelCount { width, height, found: pixels.len() });
        }
        Ok(Self { width, height, pixels })
    }

    /// Width and height.
    pub(crate) fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// All pixels.
    pub(crate) fn pixels(&self) -> &'a [Vec3] {
        self.pixels
    }

    fn check_same_size(&self, other: &LinearImage) -> Result<(), MetricError> {
        if self.size() == other.size() {
            return Ok(());
        }
        Err(MetricError::SizesDiffer(self.size(), other.size()))
    }
}

/// Luminance of linear Rec. 709 colour.
pub(crate) fn luminance(c: Vec3) -> f32 {
    c.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}
