//! Pictures into an animated file: GIF, PNG with animation, or WebM.
//!
//! GIF and PNG share one palette for the whole film, and both store only what changes. A pixel whose colour differs from the one that
//! is shown by less than the eye finds in noise stays, which is what makes a film of path-traced pictures small.

use crate::paint::Canvas;
use color_quant::NeuQuant;
use dpm_common::files::write_atomically;
use std::borrow::Cow;
use std::io::{self, Write};
use std::path::Path;

/// Colours of the palette; one more is the colour that stands for "unchanged".
const COLOURS: usize = 255;
/// Index that stands for "unchanged".
const UNCHANGED: u8 = 255;
/// About so many pixels teach the palette its colours.
const TAUGHT: usize = 1 << 18;
/// Greatest difference of a channel that is left unchanged, from the best film to the smallest.
const TOLERANCES: [u8; 5] = [4, 7, 11, 16, 24];
/// A film is made coarser until it has no more bytes than this: what a page may load without asking.
const LARGEST: usize = 2_950_000;

/// What an animated file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FilmFormat {
    /// GIF.
    Gif,
    /// PNG with animation.
    AnimatedPng,
    /// WebM with AV1, where the feature `webm` is built in.
    WebM,
}

impl FilmFormat {
    /// By the end of a file's name.
    pub(super) fn of(path: &Path) -> Option<Self> {
        let end = path.extension()?.to_str()?;
        match end.to_ascii_lowercase().as_str() {
            "gif" => Some(Self::Gif),
            "png" | "apng" => Some(Self::AnimatedPng),
            "webm" => Some(Self::WebM),
            _ => None,
        }
    }
}

/// A film in colours of a palette.
struct PaletteFilm {
    width: u16,
    height: u16,
    /// Red, green, blue of 256 colours.
    palette: Vec<u8>,
    /// Indices row by row; from the second picture on [`UNCHANGED`] is transparent.
    pictures: Vec<Vec<u8>>,
}

/// Writes `pictures`, all of one size and at least one, at `per_second`, as a film that runs for ever.
///
/// # Errors
/// The file cannot be written.
pub(super) fn write(path: &Path, format: FilmFormat, pictures: &[Canvas], per_second: u32) -> io::Result<()> {
    let film = encoded(format, pictures, per_second)?;
    write_atomically(path, |out| out.write_all(&film))
}

fn encoded(format: FilmFormat, pictures: &[Canvas], per_second: u32) -> io::Result<Vec<u8>> {
    let in_palette: fn(&PaletteFilm, u32) -> io::Result<Vec<u8>> = match format {
        FilmFormat::Gif => gif,
        FilmFormat::AnimatedPng => animated_png,
        FilmFormat::WebM => return video(pictures, per_second),
    };
    let palette = Palette::of(pictures);
    let mut film = Vec::new();
    for tolerance in TOLERANCES {
        let indexed = palette.index(pictures, tolerance);
        film = in_palette(&indexed, per_second)?;
        if film.len() <= LARGEST {
            break;
        }
    }
    Ok(film)
}

#[cfg(feature = "webm")]
fn video(pictures: &[Canvas], per_second: u32) -> io::Result<Vec<u8>> {
    super::webm::encoded(pictures, per_second, LARGEST)
}

#[cfg(not(feature = "webm"))]
fn video(_: &[Canvas], _: u32) -> io::Result<Vec<u8>> {
    Err(io::Error::other("this build has no encoder for WebM"))
}

struct Palette {
    colours: NeuQuant,
}

impl Palette {
    fn of(pictures: &[Canvas]) -> Self {
        let pixels: usize = pictures.iter().map(|p| p.width * p.height).sum();
        // A step that no row's length divides, so that columns are sampled alike.
        let step = (pixels / TAUGHT).max(1) | 1;
        let taught = pictures.iter().flat_map(|p| p.rgb.chunks_exact(3)).step_by(step);
        let rgba: Vec<u8> = taught.flat_map(|c| [c[0], c[1], c[2], 255]).collect();
        Self { colours: NeuQuant::new(1, COLOURS, &rgba) }
    }

    fn index(&self, pictures: &[Canvas], tolerance: u8) -> PaletteFilm {
        let (width, height) = (pictures[0].width, pictures[0].height);
        let mut palette = self.colours.color_map_rgb();
        palette.resize(3 * 256, 0);
        // Of a colour, to five bits a channel, the nearest of the palette is looked up once.
        let mut nearest = vec![None; 1 << 15];
        let mut shown: Vec<[u8; 3]> = Vec::new();
        let mut indexed = Vec::new();
        for picture in pictures {
            let is_first = shown.is_empty();
            shown.resize(width * height, [0; 3]);
            let pixels = picture.rgb.chunks_exact(3).zip(&mut shown).map(|(wanted, shown)| {
                let near = wanted.iter().zip(&*shown).all(|(a, b)| a.abs_diff(*b) <= tolerance);
                if near && !is_first {
                    return UNCHANGED;
                }
                let [r, g, b] = [wanted[0], wanted[1], wanted[2]];
                let key = usize::from(r >> 3) << 10 | usize::from(g >> 3) << 5 | usize::from(b >> 3);
                let index = *nearest[key].get_or_insert_with(|| {
                    let middle = |v: u8| v & 0xf8 | 4;
                    self.colours.index_of(&[middle(r), middle(g), middle(b), 255]) as u8
                });
                let colour = &palette[3 * usize::from(index)..][..3];
                let colour = [colour[0], colour[1], colour[2]];
                if !is_first && colour == *shown {
                    return UNCHANGED;
                }
                *shown = colour;
                index
            });
            indexed.push(pixels.collect());
        }
        PaletteFilm { width: width as u16, height: height as u16, palette, pictures: indexed }
    }
}

/// The n-th picture stays for so many hundredths of a second, so that the film keeps its pace.
fn hundredths(n: usize, per_second: u32) -> u16 {
    let end = |n: usize| (n * 100 + per_second as usize / 2) / per_second as usize;
    (end(n + 1) - end(n)) as u16
}

fn gif(film: &PaletteFilm, per_second: u32) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder =
        gif::Encoder::new(&mut bytes, film.width, film.height, &film.palette).map_err(io::Error::other)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(io::Error::other)?;
    for (n, picture) in film.pictures.iter().enumerate() {
        let frame = gif::Frame {
            width: film.width,
            height: film.height,
            delay: hundredths(n, per_second),
            dispose: gif::DisposalMethod::Keep,
            transparent: (n > 0).then_some(UNCHANGED),
            buffer: Cow::Borrowed(picture),
            ..gif::Frame::default()
        };
        encoder.write_frame(&frame).map_err(io::Error::other)?;
    }
    drop(encoder);
    Ok(bytes)
}

fn animated_png(film: &PaletteFilm, per_second: u32) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, film.width.into(), film.height.into());
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_palette(film.palette.as_slice());
    let mut alpha = vec![255u8; 256];
    alpha[usize::from(UNCHANGED)] = 0;
    encoder.set_trns(alpha);
    encoder.set_compression(png::Compression::High);
    encoder.set_filter(png::Filter::NoFilter);
    encoder.set_animated(film.pictures.len() as u32, 0)?;
    encoder.set_frame_delay(1, per_second as u16)?;
    encoder.set_dispose_op(png::DisposeOp::None)?;
    encoder.set_blend_op(png::BlendOp::Over)?;
    let mut writer = encoder.write_header()?;
    for picture in &film.pictures {
        writer.write_image_data(picture)?;
    }
    writer.finish()?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::AnimationDecoder;

    /// A square that goes from left to right over a still gradient.
    fn film(count: usize) -> Vec<Canvas> {
        let picture = |n: usize| {
            let mut rgb = Vec::new();
            for y in 0..24usize {
                for x in 0..32usize {
                    let inside = x.abs_diff(n + 4) < 3 && y.abs_diff(12) < 3;
                    rgb.extend(if inside { [255, 64, 0] } else { [4 * x as u8, 4 * y as u8, 60] });
                }
            }
            Canvas { width: 32, height: 24, rgb }
        };
        (0..count).map(picture).collect()
    }

    /// No colour of `decoded` is far from the one it stands for.
    fn assert_near(decoded: &[u8], wanted: &Canvas) {
        for (i, (got, wanted)) in decoded.chunks_exact(4).zip(wanted.rgb.chunks_exact(3)).enumerate() {
            let apart = got.iter().zip(wanted).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(apart <= Some(20) && got[3] == 255, "pixel {i}: {got:?} for {wanted:?}");
        }
    }

    #[test]
    fn a_film_is_read_back_picture_by_picture_in_both_formats() {
        let film = film(12);
        for (name, format) in [("a.gif", FilmFormat::Gif), ("a.png", FilmFormat::AnimatedPng)] {
            assert_eq!(FilmFormat::of(Path::new(name)), Some(format));
            let bytes = io::Cursor::new(encoded(format, &film, 15).unwrap());
            let frames = match format {
                FilmFormat::Gif => image::codecs::gif::GifDecoder::new(bytes).unwrap().into_frames(),
                FilmFormat::AnimatedPng => {
                    image::codecs::png::PngDecoder::new(bytes).unwrap().apng().unwrap().into_frames()
                }
                FilmFormat::WebM => unreachable!("not in a palette"),
            };
            let frames = frames.collect_frames().unwrap();
            assert_eq!(frames.len(), film.len());
            for (frame, wanted) in frames.iter().zip(&film) {
                assert_near(frame.buffer().as_raw(), wanted);
            }
        }
    }

    #[test]
    fn what_does_not_change_is_not_stored() {
        let film = film(3);
        let indexed = Palette::of(&film).index(&film, TOLERANCES[0]);
        let changed = |n: usize| indexed.pictures[n].iter().filter(|i| **i != UNCHANGED).count();
        // The square leaves a column of five and takes another one.
        assert_eq!([changed(1), changed(2)], [10, 10]);
    }

    #[test]
    fn a_film_lasts_as_long_as_it_should() {
        let all: u32 = (0..120).map(|n| u32::from(hundredths(n, 15))).sum();
        assert_eq!(all, 800);
    }
}
