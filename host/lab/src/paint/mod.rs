//! Numbers per pixel into pictures with a legend beside them.

pub(crate) mod glyphs;

use self::glyphs::{for_each_dot, ADVANCE, LINE};
use dpm_common::files::write_atomically;
use dpm_device::planes::Raster;
use std::io::{self, Write};
use std::path::Path;

/// An RGB picture of 8 bits a channel, rows top to bottom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Canvas {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Red, green, blue, pixel by pixel.
    pub rgb: Vec<u8>,
}

/// Colour of pixels that have no value: not lit.
pub(crate) const NOTHING: [u8; 3] = [16, 16, 16];
/// Colour of values that are not finite. No colour map has it.
pub(crate) const NOT_FINITE: [u8; 3] = [255, 0, 255];

const PAPER: [u8; 3] = [250, 250, 250];
const INK: [u8; 3] = [20, 20, 20];
/// Pictures are enlarged by a whole factor until they have this many rows.
const LEAST_ROWS: usize = 480;
/// Pixels of a dot of text.
pub(crate) const DOT: usize = 3;
const LEGEND_COLUMNS: usize = 15 * ADVANCE * DOT + 2 * MARGIN;
const MARGIN: usize = 12;
const BAR: usize = 28;

/// How values become places on the colour bar.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scale {
    /// From zero to nearly the largest value.
    FromZero,
    /// From the smallest to the largest value.
    Span,
    /// Logarithm, from nearly the smallest positive to nearly the largest value.
    Log,
}

impl Canvas {
    /// Empty paper.
    pub(crate) fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgb: PAPER.repeat(width * height) }
    }

    fn put(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            self.rgb[(y * self.width + x) * 3..][..3].copy_from_slice(&colour);
        }
    }

    /// Fills a rectangle; what lies outside is cut off.
    pub(crate) fn block(&mut self, x: usize, y: usize, width: usize, height: usize, colour: [u8; 3]) {
        for j in y..y + height {
            for i in x..x + width {
                self.put(i, j, colour);
            }
        }
    }

    /// Writes text, three pixels a dot.
    pub(crate) fn text(&mut self, x: usize, y: usize, text: &str) {
        for_each_dot(text, |dx, dy| self.block(x + dx * DOT, y + dy * DOT, DOT, DOT, INK));
    }

    /// Writes text of `dot` pixels a dot at column and row, on a dark edge.
    pub(crate) fn write(&mut self, [x, y]: [usize; 2], dot: usize, text: &str, colour: [u8; 3]) {
        let edge = |at: usize, i: usize| (at + i * dot).saturating_sub(1);
        for_each_dot(text, |i, j| self.block(edge(x, i), edge(y, j), dot + 2, dot + 2, [0; 3]));
        for_each_dot(text, |i, j| self.block(x + i * dot, y + j * dot, dot, dot, colour));
    }

    /// Copies a picture in, every pixel as a square of `m`; what lies outside is cut off.
    pub(crate) fn paste(&mut self, x: usize, y: usize, m: usize, other: &Canvas) {
        for j in 0..other.height {
            for i in 0..other.width {
                self.block(x + i * m, y + j * m, m, m, other.at(i, j));
            }
        }
    }

    /// Writes a PNG, all of it or nothing.
    ///
    /// # Errors
    /// The file cannot be written; the message names it.
    pub fn save(&self, path: &Path) -> io::Result<()> {
        let mut bytes = io::Cursor::new(Vec::new());
        let (width, height) = (self.width as u32, self.height as u32);
        image::write_buffer_with_format(
            &mut bytes,
            &self.rgb,
            width,
            height,
            image::ExtendedColorType::Rgb8,
            image::ImageFormat::Png,
        )
        .map_err(|e| io::Error::other(format!("{}: {e}", path.display())))?;
        write_atomically(path, |out| out.write_all(bytes.get_ref()))
    }

    /// Reads a PNG. `None`: there is none that can be read.
    pub fn load(path: &Path) -> Option<Self> {
        let picture = image::open(path).ok()?.to_rgb8();
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        Some(Self { width, height, rgb: picture.into_raw() })
    }

    /// The colour of a pixel.
    pub(crate) fn at(&self, x: usize, y: usize) -> [u8; 3] {
        let i = (y * self.width + x) * 3;
        [self.rgb[i], self.rgb[i + 1], self.rgb[i + 2]]
    }
}

/// By what factor a raster is enlarged beside a legend.
pub(crate) fn magnification(raster: Raster) -> usize {
    LEAST_ROWS.div_ceil(raster.height() as usize).clamp(1, 32)
}

/// The picture, enlarged, with room for the legend to its right; and where that room begins.
fn with_legend(raster: Raster, title: &str, colour: impl Fn(usize) -> [u8; 3]) -> (Canvas, usize, usize) {
    let m = magnification(raster);
    let (w, h) = (raster.width() as usize, raster.height() as usize);
    let mut canvas = Canvas::new(w * m + LEGEND_COLUMNS, (h * m).max(LEAST_ROWS));
    for y in 0..h {
        for x in 0..w {
            canvas.block(x * m, y * m, m, m, colour(y * w + x));
        }
    }
    let left = w * m + MARGIN;
    canvas.text(left, MARGIN, title);
    (canvas, left, MARGIN + (title.lines().count() + 1) * LINE * DOT)
}

/// A number in at most six characters: three significant digits.
fn short(v: f32) -> String {
    let magnitude = v.abs();
    if v == 0.0 {
        "0".into()
    } else if !(0.001..100_000.0).contains(&magnitude) {
        format!("{v:.1e}")
    } else {
        let digits = (2.0 - magnitude.log10().floor()).clamp(0.0, 5.0) as usize;
        let text = format!("{v:.digits$}");
        if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.').into()
        } else {
            text
        }
    }
}

/// Dark violet over green to yellow, by five points of the colour map viridis (van der Walt and Smith 2015): lightness grows evenly.
fn heat(t: f32) -> [u8; 3] {
    const POINTS: [[f32; 3]; 5] = [
        [68.0, 1.0, 84.0],
        [59.0, 82.0, 139.0],
        [33.0, 145.0, 140.0],
        [94.0, 201.0, 98.0],
        [253.0, 231.0, 37.0],
    ];
    let at = t.clamp(0.0, 1.0) * 4.0;
    let i = (at as usize).min(3);
    let f = at - i as f32;
    std::array::from_fn(|c| (POINTS[i][c] + (POINTS[i + 1][c] - POINTS[i][c]) * f + 0.5) as u8)
}

/// Ends of the colour bar for `values`, and whether the upper one is below the largest value.
fn range(values: &[Option<f32>], scale: Scale) -> (f32, f32) {
    let mut sorted: Vec<f32> = values
        .iter()
        .flatten()
        .copied()
        .filter(|v| v.is_finite() && (scale != Scale::Log || *v > 0.0))
        .collect();
    if sorted.is_empty() {
        return if scale == Scale::Log { (0.1, 1.0) } else { (0.0, 1.0) };
    }
    sorted.sort_by(f32::total_cmp);
    let last = sorted.len() - 1;
    // A few outliers must not darken all the rest.
    let (low, high) = (sorted[last / 100], sorted[last - last / 200]);
    match scale {
        Scale::FromZero => (low.min(0.0), if high > low.min(0.0) { high } else { low.min(0.0) + 1.0 }),
        Scale::Span => (sorted[0], if sorted[last] > sorted[0] { sorted[last] } else { sorted[0] + 1.0 }),
        Scale::Log => (low, if high > low { high } else { low * 10.0 }),
    }
}

/// A quantity in colours with its bar. `None`: no value there.
pub(crate) fn quantity(raster: Raster, values: &[Option<f32>], scale: Scale, title: &str) -> Canvas {
    let (low, high) = range(values, scale);
    let place = |v: f32| match scale {
        Scale::Log => (v.max(low) / low).ln() / (high / low).ln(),
        _ => (v - low) / (high - low),
    };
    let (mut canvas, left, top) = with_legend(raster, title, |i| match values[i] {
        None => NOTHING,
        Some(v) if v.is_finite() => heat(place(v)),
        Some(_) => NOT_FINITE,
    });
    let bottom = canvas.height - MARGIN - LINE * DOT;
    let rows = bottom - top;
    for y in 0..rows {
        canvas.block(left, top + y, BAR, 1, heat(1.0 - y as f32 / (rows - 1) as f32));
    }
    for tick in 0..=4usize {
        let t = tick as f32 / 4.0;
        let v = if scale == Scale::Log { low * (high / low).powf(t) } else { low + (high - low) * t };
        let y = bottom - 1 - ((rows - 1) as f32 * t) as usize;
        canvas.block(left + BAR, y, 6, 2, INK);
        canvas.text(left + BAR + 10, y.saturating_sub(2 * DOT), &short(v));
    }
    canvas
}

/// Kinds in colours with their names.
pub(crate) fn kinds(
    raster: Raster,
    values: &[Option<usize>],
    names: &[(&str, [u8; 3])],
    title: &str,
) -> Canvas {
    let (mut canvas, left, top) = with_legend(raster, title, |i| {
        values[i].map_or(NOTHING, |k| names.get(k).map_or(NOT_FINITE, |n| n.1))
    });
    for (k, (name, colour)) in names.iter().enumerate() {
        let y = top + k * 36;
        canvas.block(left, y, BAR, BAR, *colour);
        canvas.text(left + BAR + 10, y + 7, name);
    }
    canvas
}

/// Hue by direction (right is red, then yellow, green, cyan, blue against the clock), brightness by length up to 1.
fn wheel(x: f32, y: f32) -> [u8; 3] {
    let hue = y.atan2(x).rem_euclid(std::f32::consts::TAU) / std::f32::consts::TAU * 6.0;
    let length = x.hypot(y).min(1.0);
    let channel = |shift: f32| {
        let k = (hue + shift).rem_euclid(6.0);
        let full = 1.0 - (k.min(4.0 - k)).clamp(0.0, 1.0);
        (255.0 * full * length + 0.5) as u8
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

/// Vectors (x to the right, y **down** as the raster's rows) as directions and lengths, with a disc that tells both.
pub(crate) fn directions(raster: Raster, values: &[Option<[f32; 2]>], title: &str) -> Canvas {
    let lengths: Vec<Option<f32>> = values.iter().map(|v| v.map(|[x, y]| x.hypot(y))).collect();
    let (_, longest) = range(&lengths, Scale::FromZero);
    let (mut canvas, left, top) = with_legend(raster, title, |i| match values[i] {
        None => NOTHING,
        Some([x, y]) if x.is_finite() && y.is_finite() => wheel(x / longest, -y / longest),
        Some(_) => NOT_FINITE,
    });
    let radius = 60i32;
    for y in -radius..=radius {
        for x in -radius..=radius {
            let (fx, fy) = (x as f32 / radius as f32, y as f32 / radius as f32);
            if fx.hypot(fy) <= 1.0 {
                canvas.put(left + (x + radius) as usize, top + (y + radius) as usize, wheel(fx, -fy));
            }
        }
    }
    canvas.text(left, top + 2 * radius as usize + 12, &format!("edge = {}", short(longest)));
    canvas
}

/// Colours 0..1 as they are, without a legend and not enlarged.
pub(crate) fn colours(raster: Raster, values: &[Option<[f32; 3]>]) -> Canvas {
    let rgb = values
        .iter()
        .flat_map(|v| match v {
            None => NOTHING,
            Some(v) if v.iter().all(|c| c.is_finite()) => v.map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8),
            Some(_) => NOT_FINITE,
        })
        .collect();
    Canvas { width: raster.width() as usize, height: raster.height() as usize, rgb }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        for (v, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.0762, "0.0762"),
            (100.0, "100"),
            (12.345, "12.3"),
            (2e-7, "2.0e-7"),
            (-3.5, "-3.5"),
            (1056.2, "1056"),
        ] {
            assert_eq!(short(v), text);
        }
    }

    #[test]
    fn wheel_follows_its_description() {
        assert_eq!(wheel(1.0, 0.0), [255, 0, 0]);
        assert_eq!(wheel(0.0, 0.0), [0, 0, 0]);
        let third = std::f32::consts::TAU / 3.0;
        assert_eq!(wheel(third.cos(), third.sin()), [0, 255, 0]);
        assert_eq!(wheel((2.0 * third).cos(), (2.0 * third).sin()), [0, 0, 255]);
        assert_eq!(wheel(-0.5, 0.0), [0, 128, 128]);
    }

    #[test]
    fn a_quantity_is_enlarged_and_its_ends_have_the_ends_of_the_bar() {
        let raster = Raster::new(3, 2).unwrap();
        let values = [Some(0.0), Some(5.0), Some(10.0), None, Some(f32::NAN), Some(10.0)];
        let canvas = quantity(raster, &values, Scale::Span, "x");
        let m = magnification(raster);
        assert_eq!((m, canvas.width, canvas.height), (32, 96 + LEGEND_COLUMNS, 480));
        let centre = |x: usize, y: usize| canvas.at(x * m + m / 2, y * m + m / 2);
        assert_eq!(centre(0, 0), [68, 1, 84]);
        assert_eq!(centre(1, 0), [33, 145, 140]);
        assert_eq!(centre(2, 0), [253, 231, 37]);
        assert_eq!(centre(0, 1), NOTHING);
        assert_eq!(centre(1, 1), NOT_FINITE);
        // Nothing known, or one value only: still a picture.
        for values in [[None; 6], [Some(3.0); 6], [Some(f32::INFINITY); 6], [Some(-1.0); 6]] {
            for scale in [Scale::FromZero, Scale::Span, Scale::Log] {
                assert_eq!(quantity(raster, &values, scale, "x").rgb.len(), canvas.rgb.len());
            }
        }
    }
}
