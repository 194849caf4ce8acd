//! A grey picture into dark and bright, by the light around each pixel.
//!
//! Tiles of 4 x 4 pixels keep their darkest and brightest value; a pixel is dark if it lies below the middle of the
//! range of the tile and its eight neighbours (\[Wang16\]). Where that range is small there is no edge, and nothing
//! is dark: the inside of a large dark region is open, which its outline does not feel.

use crate::image::GreyImage;

const TILE: usize = 4;

/// Grey levels between dark and bright around a pixel below which there is no edge.
pub(crate) const LEAST_CONTRAST: u8 = 24;

/// The memory of the threshold, kept from picture to picture.
#[derive(Debug, Default)]
pub(crate) struct Binary {
    /// One byte a pixel: 0 bright or undecided, 1 dark. The outermost pixels are 0.
    pub dark: Vec<u8>,
    low: Vec<u8>,
    high: Vec<u8>,
    wide_low: Vec<u8>,
    wide_high: Vec<u8>,
    line_low: Vec<u8>,
    line_high: Vec<u8>,
    threshold: Vec<u8>,
}

impl Binary {
    /// Columns and rows of tiles.
    fn tiles(image: &GreyImage<'_>) -> (usize, usize) {
        (image.width() / TILE, image.height() / TILE)
    }

    /// The brightest value of each tile, which [`Self::extremes`] has left; `columns` of them a row.
    pub(crate) fn brightest(&self, image: &GreyImage<'_>) -> (usize, &[u8]) {
        let (columns, rows) = Self::tiles(image);
        (columns, &self.high[..columns * rows])
    }

    /// Pixels along a side of a tile.
    pub(crate) const TILE: usize = TILE;

    /// Fills [`Self::dark`].
    pub(crate) fn fill(&mut self, image: &GreyImage<'_>) {
        self.extremes(image);
        let (columns, rows) = Self::tiles(image);
        widen(&self.low, &mut self.wide_low, &mut self.line_low, columns, u8::min);
        widen(&self.high, &mut self.wide_high, &mut self.line_high, columns, u8::max);
        let width = image.width();
        self.dark.resize(image.pixels().len(), 0);
        self.threshold.resize(width, 0);
        for y in 0..image.height() {
            let row = (y / TILE).min(rows - 1);
            if y % TILE == 0 {
                self.thresholds_of(row, columns);
            }
            let dark = &mut self.dark[y * width..(y + 1) * width];
            if y == 0 || y + 1 == image.height() {
                dark.fill(0);
                continue;
            }
            for ((d, v), t) in dark.iter_mut().zip(image.row(y)).zip(&self.threshold) {
                *d = u8::from(v < t);
            }
            dark[0] = 0;
            dark[width - 1] = 0;
        }
    }

    /// Darkest and brightest of each tile; what is left of a tile at the right and lower edge belongs to none.
    pub(crate) fn extremes(&mut self, image: &GreyImage<'_>) {
        let (columns, rows) = Self::tiles(image);
        let width = columns * TILE;
        for tiles in [&mut self.low, &mut self.high, &mut self.wide_low, &mut self.wide_high] {
            tiles.resize(columns * rows, 0);
        }
        self.line_low.resize(width, 0);
        self.line_high.resize(width, 0);
        for row in 0..rows {
            let (low, high) = (&mut self.line_low[..width], &mut self.line_high[..width]);
            low.copy_from_slice(&image.row(row * TILE)[..width]);
            high.copy_from_slice(low);
            for y in 1..TILE {
                let line = &image.row(row * TILE + y)[..width];
                low.iter_mut().zip(line).for_each(|(a, b)| *a = (*a).min(*b));
                high.iter_mut().zip(line).for_each(|(a, b)| *a = (*a).max(*b));
            }
            let out = &mut self.low[row * columns..(row + 1) * columns];
            for (o, v) in out.iter_mut().zip(low.chunks_exact(TILE)) {
                *o = v[0].min(v[1]).min(v[2].min(v[3]));
            }
            let out = &mut self.high[row * columns..(row + 1) * columns];
            for (o, v) in out.iter_mut().zip(high.chunks_exact(TILE)) {
                *o = v[0].max(v[1]).max(v[2].max(v[3]));
            }
        }
    }

    /// The thresholds of a row of tiles, one a pixel; 0 where there is no edge.
    fn thresholds_of(&mut self, row: usize, columns: usize) {
        let tiles = row * columns..(row + 1) * columns;
        let (low, high) = (&self.wide_low[tiles.clone()], &self.wide_high[tiles]);
        let mut last = 0;
        let mut chunks = self.threshold.chunks_exact_mut(TILE);
        for ((chunk, low), high) in chunks.by_ref().zip(low).zip(high) {
            let range = high - low;
            last = if range < LEAST_CONTRAST { 0 } else { low + range.div_ceil(2) };
            chunk.fill(last);
        }
        chunks.into_remainder().fill(last);
    }
}

/// The extreme of each tile and its eight neighbours.
fn widen(from: &[u8], to: &mut [u8], line: &mut [u8], columns: usize, extreme: impl Fn(u8, u8) -> u8 + Copy) {
    let rows = from.len() / columns;
    let row = |y: usize| &from[y * columns..(y + 1) * columns];
    let line = &mut line[..columns];
    for y in 0..rows {
        line.copy_from_slice(row(y));
        for near in [y.saturating_sub(1), (y + 1).min(rows - 1)] {
            line.iter_mut().zip(row(near)).for_each(|(a, b)| *a = extreme(*a, *b));
        }
        let out = &mut to[y * columns..(y + 1) * columns];
        out.copy_from_slice(line);
        out[1..].iter_mut().zip(&line[..columns - 1]).for_each(|(a, b)| *a = extreme(*a, *b));
        out[..columns - 1].iter_mut().zip(&line[1..]).for_each(|(a, b)| *a = extreme(*a, *b));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dark_square_in_uneven_light_is_dark_and_flat_light_is_not() {
        let (w, h) = (67, 45);
        let mut pixels = vec![0u8; w * h];
        for y in 0..h {
            for x in 0..w {
                let light = 60 + 2 * x;
                let inside = (20..40).contains(&x) && (12..30).contains(&y);
                pixels[y * w + x] = if inside { light / 3 } else { light } as u8;
            }
        }
        let mut binary = Binary::default();
        binary.fill(&GreyImage::new(w, h, &pixels).unwrap());
        for y in 0..h {
            for x in 0..w {
                let near = |p: usize, a: usize, b: usize| p + 3 >= a && p < b + 3;
                let inside = (20..40).contains(&x) && (12..30).contains(&y);
                let deep = (23..37).contains(&x) && (15..27).contains(&y);
                if near(x, 20, 40) && near(y, 12, 30) && !deep {
                    assert_eq!(binary.dark[y * w + x] == 1, inside, "{x} {y}");
                }
            }
        }
        assert!((0..w).all(|x| binary.dark[x] == 0 && binary.dark[(h - 1) * w + x] == 0));
        binary.fill(&GreyImage::new(w, h, &vec![77; w * h]).unwrap());
        assert!(binary.dark.iter().all(|d| *d == 0));
    }
}
