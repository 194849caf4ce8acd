//! An 8-bit grey picture, and its values between pixels.

use glam::DVec2;

/// A grey picture: `width * height` bytes, rows from above. Pixel `(i, j)` covers `i..i+1` by `j..j+1`, as a raster's.
#[derive(Clone, Copy, Debug)]
pub struct GreyImage<'a> {
    width: usize,
    height: usize,
    pixels: &'a [u8],
}

/// Pixels a side that a picture has at least.
pub const LEAST_SIDE: usize = 16;
/// Pixels a side that a picture has at most.
pub const MOST_SIDE: usize = 8192;

impl<'a> GreyImage<'a> {
    /// A picture of these pixels; `None` if their number is not `width * height`, or a side is outside [`LEAST_SIDE`] to
    /// [`MOST_SIDE`].
    pub fn new(width: usize, height: usize, pixels: &'a [u8]) -> Option<Self> {
        let sides = [width, height].iter().all(|s| (LEAST_SIDE..=MOST_SIDE).contains(s));
        (sides && pixels.len() == width * height).then_some(Self { width, height, pixels })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels.
    pub fn pixels(&self) -> &'a [u8] {
        self.pixels
    }

    /// The pixels of a row.
    pub(crate) fn row(&self, y: usize) -> &'a [u8] {
        &self.pixels[y * self.width..(y + 1) * self.width]
    }

    /// The value at a position, between the centres of four pixels; `None` outside the centres of the outermost pixels.
    pub(crate) fn at(&self, p: DVec2) -> Option<f64> {
        let (x, y) = (p.x - 0.5, p.y - 0.5);
        // False for NaN.
        if !(x >= 0.0 && y >= 0.0 && x < (self.width - 1) as f64 && y < (self.height - 1) as f64) {
            return None;
        }
        let (i, j) = (x as usize, y as usize);
        let (u, v) = (x - i as f64, y - j as f64);
        let first = j * self.width + i;
        let [a, b] = [self.pixels[first], self.pixels[first + 1]].map(f64::from);
        let [c, d] = [self.pixels[first + self.width], self.pixels[first + self.width + 1]].map(f64::from);
        let (upper, lower) = (a + u * (b - a), c + u * (d - c));
        Some(upper + v * (lower - upper))
    }
}
