//! Channels with fewer samples than the picture has texels, as luminance-chroma pictures have them. The crate `exr` refuses
//! such files, but its decompressors know of them: it is given a header without the subsampling, and the lines are shared out here.

use super::{failed, Layers};
use crate::SceneError;
use exr::block::chunk::CompressedBlock;
use exr::image::{AnyChannel, AnyChannels, Encoding, FlatSamples, Layer};
use exr::math::Vec2;
use exr::meta::attribute::{IntegerBounds, SampleType};
use exr::meta::header::Header;
use exr::prelude::{f16, Compression};
use std::io::Cursor;

/// Samples in a column and a row between two of a channel.
pub(super) type Sampling = [u32; 2];

/// The most that OpenEXR's own programs write is 2.
const COARSEST: u32 = 16;

/// Weights of OpenEXR for a texel between two samples, from the nearest on (its file ImfRgbaYca.cpp); the same to both sides.
const BETWEEN: [f32; 7] = [0.627_123, -0.186_077, 0.087_929, -0.043_159, 0.019_597, -0.007_540, 0.002_128];

/// The file with all channels sampled at every texel, and how they were: for each header its channels in their order. `None`: all
/// are sampled so, or the header cannot be followed, which the reader says.
pub(super) fn without_subsampling(bytes: &[u8]) -> Option<(Vec<u8>, Vec<Vec<Sampling>>)> {
    const MULTIPART: u8 = 0x10;
    let is_multipart = bytes.get(5)? & MULTIPART != 0;
    let mut at = 8usize;
    let mut whole = None;
    let mut all = vec![];
    let text = |at: &mut usize| {
        let length = bytes.get(*at..)?.iter().take(256).position(|b| *b == 0)?;
        let text = &bytes[*at..*at + length];
        *at += length + 1;
        Some(text)
    };
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    loop {
        let mut own = vec![];
        let begin = at;
        loop {
            let name = text(&mut at)?;
            if name.is_empty() {
                break;
            }
            let kind = text(&mut at)?;
            let size = word(at)? as usize;
            at += 4;
            if (name, kind) == (b"channels", b"chlist") {
                let mut channel = at;
                while !text(&mut channel)?.is_empty() {
                    // Kind of samples, whether it is linear, and the sampling.
                    let place = channel + 8;
                    let sampling = [word(place)?, word(place + 4)?];
                    if sampling != [1, 1] {
                        let whole = whole.get_or_insert_with(|| bytes.to_vec());
                        whole[place..place + 8].copy_from_slice(&[1, 0, 0, 0, 1, 0, 0, 0]);
                    }
                    own.push(sampling);
                    channel = place + 8;
                }
            }
            at = at.checked_add(size)?;
        }
        let is_last = !is_multipart || at == begin + 1;
        if !is_multipart || !is_last {
            all.push(own);
        }
        if is_last {
            return Some((whole?, all));
        }
    }
}

fn unsupported(what: &'static str) -> SceneError {
    SceneError::unsupported(what, "convert it to RGB")
}

/// Reads all layers of a file without subsampling, whose channels were sampled so. `limit` bounds the bytes of all samples.
pub(super) fn read_layers(
    bytes: &[u8],
    sampling: &[Vec<Sampling>],
) -> Result<Vec<Layer<AnyChannels<FlatSamples>>>, SceneError> {
    let reader = exr::block::read(Cursor::new(bytes), false).map_err(failed)?;
    let headers = reader.headers().to_vec();
    let mut layers: Vec<Vec<Coarse>> = vec![];
    for (header, sampling) in headers.iter().zip(sampling) {
        let is_plain = header.blocks == exr::meta::BlockDescription::ScanLines && !header.deep;
        let (width, height) = (header.layer_size.width(), header.layer_size.height());
        let position = header.own_attributes.layer_position;
        let divides = |[x, y]: &Sampling| {
            let fits = |side: usize, at: i32, step: u32| {
                (1..=COARSEST).contains(&step)
                    && side.is_multiple_of(step as usize)
                    && at.rem_euclid(step as i32) == 0
            };
            fits(width, position.x(), *x) && fits(height, position.y(), *y)
        };
        if !is_plain || sampling.len() != header.channels.list.len() || !sampling.iter().all(divides) {
            return Err(unsupported("OpenEXR with channels of fewer samples in tiles or out of step"));
        }
        layers.push(sampling.iter().map(|sampling| Coarse::new(*sampling, [width, height])).collect());
    }
    if layers.len() != headers.len() {
        return Err(SceneError::broken("image", "cannot be decoded: its headers contradict each other"));
    }
    for chunk in reader.all_chunks(false).map_err(failed)? {
        let chunk = chunk.map_err(failed)?;
        let (Some(header), Some(sampling)) =
            (headers.get(chunk.layer_index), sampling.get(chunk.layer_index))
        else {
            continue;
        };
        let CompressedBlock::ScanLine(block) = chunk.compressed_block else { continue };
        let first = i64::from(block.y_coordinate) - i64::from(header.own_attributes.layer_position.y());
        let height = header.layer_size.height();
        let Some(first) = usize::try_from(first).ok().filter(|y| *y < height) else {
            return Err(SceneError::broken("image", "cannot be decoded: it has rows outside of its window"));
        };
        let rows = header.compression.scan_lines_per_block().min(height - first);
        let data = decompressed(header, sampling, block.compressed_pixels_le, [first, rows])?;
        let mut rest = data.as_slice();
        for y in first..first + rows {
            for (channel, coarse) in header.channels.list.iter().zip(&mut layers[chunk.layer_index]) {
                coarse.take_row(y, channel.sample_type, &mut rest);
            }
        }
    }
    let layer = |(header, samples): (&Header, Vec<Coarse>)| {
        let list = header.channels.list.iter().zip(samples).map(|(about, coarse)| AnyChannel {
            name: about.name.clone(),
            sample_data: FlatSamples::F32(coarse.at_every_texel()),
            quantize_linearly: about.quantize_linearly,
            sampling: Vec2(1, 1),
        });
        Layer {
            channel_data: AnyChannels { list: list.collect() },
            attributes: header.own_attributes.clone(),
            size: header.layer_size,
            encoding: Encoding::UNCOMPRESSED,
        }
    };
    Ok(headers.iter().zip(layers).map(layer).collect())
}

/// The bytes of a block's rows: for each row the samples of each channel that has some in it.
fn decompressed(
    header: &Header,
    sampling: &[Sampling],
    compressed: Vec<u8>,
    [first, rows]: [usize; 2],
) -> Result<Vec<u8>, SceneError> {
    let width = header.layer_size.width();
    let size_of = |y: usize| -> usize {
        let of = |(channel, [across, down]): (&exr::meta::attribute::ChannelDescription, &Sampling)| {
            let is_there = y.is_multiple_of(*down as usize);
            usize::from(is_there) * (width / *across as usize) * channel.sample_type.bytes_per_sample()
        };
        header.channels.list.iter().zip(sampling).map(of).sum()
    };
    let size: usize = (first..first + rows).map(size_of).sum();
    if size == 0 {
        return Ok(vec![]);
    }
    let mut about = header.clone();
    let section = match header.compression {
        // These treat a block as bytes: as one row of as many.
        Compression::Uncompressed | Compression::RLE | Compression::ZIP1 | Compression::ZIP16 => {
            about.layer_size = Vec2(size, 1);
            about.channels.bytes_per_pixel = 1;
            IntegerBounds::from_dimensions(Vec2(size, 1))
        }
        Compression::B44 | Compression::B44A if compressed.len() != size => {
            return by_channel(header, sampling, &compressed, [first, rows]);
        }
        Compression::PIZ | Compression::PXR24 | Compression::B44 | Compression::B44A => {
            for (channel, [x, y]) in about.channels.list.iter_mut().zip(sampling) {
                channel.sampling = Vec2(*x as usize, *y as usize);
            }
            if !size.is_multiple_of(width * rows) {
                return Err(unsupported("OpenEXR with rows of unequal lengths"));
            }
            about.channels.bytes_per_pixel = size / (width * rows);
            let top = i32::try_from(first).unwrap_or(i32::MAX);
            IntegerBounds::new(Vec2(0, top), Vec2(width, rows))
        }
        _ => return Err(unsupported("OpenEXR with channels of fewer samples in this compression")),
    };
    let data = header.compression.decompress_image_section_from_le(&about, compressed, section, false);
    let data = data.map_err(failed)?;
    if data.len() == size {
        Ok(data)
    } else {
        Err(SceneError::broken("image", "cannot be decoded: a block has too few bytes"))
    }
}

/// The same of a block of B44, which has one channel after the other. The crate takes the sides of its channels for longer than they
/// are, so each is given to it as a picture of its own.
fn by_channel(
    header: &Header,
    sampling: &[Sampling],
    compressed: &[u8],
    [first, rows]: [usize; 2],
) -> Result<Vec<u8>, SceneError> {
    let cut_off = || SceneError::broken("image", "cannot be decoded: a block is cut off");
    let mut rest = compressed;
    let mut channels = vec![];
    for (channel, [across, down]) in header.channels.list.iter().zip(sampling) {
        let columns = header.layer_size.width() / *across as usize;
        let own_rows = (first..first + rows).filter(|y| y.is_multiple_of(*down as usize)).count();
        let size = columns * own_rows * channel.sample_type.bytes_per_sample();
        let taken = match channel.sample_type {
            SampleType::F16 => b44_length(rest, columns.div_ceil(4) * own_rows.div_ceil(4)),
            _ => Some(size),
        };
        let part;
        (part, rest) = taken.and_then(|taken| rest.split_at_checked(taken)).ok_or_else(cut_off)?;
        let mut plain = part.to_vec();
        if channel.sample_type == SampleType::F16 && size > 0 {
            // Whole blocks: as raw samples they would be longer than in any packed form, which is how the crate tells these apart.
            let whole = Vec2(columns.next_multiple_of(4), own_rows.next_multiple_of(4));
            let mut about = header.clone();
            about.layer_size = whole;
            about.channels.list.retain(|other| other.name == channel.name);
            about.channels.list.truncate(1);
            about.channels.bytes_per_pixel = 2;
            let section = IntegerBounds::from_dimensions(whole);
            let decoded = header.compression.decompress_image_section_from_le(&about, plain, section, false);
            let decoded = decoded.map_err(failed)?;
            let rows = decoded.chunks_exact(2 * whole.width()).take(own_rows);
            plain = rows.flat_map(|row| &row[..2 * columns]).copied().collect();
        }
        if plain.len() != size {
            return Err(cut_off());
        }
        channels.push((plain, columns * channel.sample_type.bytes_per_sample(), *down as usize));
    }
    let mut places = vec![0usize; channels.len()];
    let mut out = Vec::with_capacity(channels.iter().map(|(plain, ..)| plain.len()).sum());
    for y in first..first + rows {
        for ((plain, row, down), at) in channels.iter().zip(&mut places) {
            if y.is_multiple_of(*down) {
                out.extend_from_slice(&plain[*at..*at + row]);
                *at += row;
            }
        }
    }
    Ok(out)
}

/// The bytes of so many blocks of 4 x 4 samples: flat ones have three, the others fourteen.
fn b44_length(bytes: &[u8], blocks: usize) -> Option<usize> {
    (0..blocks).try_fold(0, |at, _| Some(at + if *bytes.get(at + 2)? >= 13 << 2 { 3 } else { 14 }))
}

/// The samples of a channel.
struct Coarse {
    sampling: Sampling,
    /// Texels of the picture.
    size: [usize; 2],
    samples: Vec<f32>,
}

impl Coarse {
    fn new(sampling: Sampling, size: [usize; 2]) -> Self {
        let [columns, rows] = Self::sides(sampling, size);
        Self { sampling, size, samples: vec![0.0; columns * rows] }
    }

    fn sides(sampling: Sampling, size: [usize; 2]) -> [usize; 2] {
        [0, 1].map(|i| size[i] / sampling[i] as usize)
    }

    /// Takes the samples of row `y` of the picture off the front of `bytes`, if the channel has some there.
    fn take_row(&mut self, y: usize, kind: SampleType, bytes: &mut &[u8]) {
        let [columns, _] = Self::sides(self.sampling, self.size);
        let down = self.sampling[1] as usize;
        if !y.is_multiple_of(down) {
            return;
        }
        let row = &mut self.samples[y / down * columns..][..columns];
        let taken;
        (taken, *bytes) = bytes.split_at((columns * kind.bytes_per_sample()).min(bytes.len()));
        // The decompressors give the bytes in the order of the machine.
        match kind {
            SampleType::F16 => {
                let value = |b: &[u8]| f16::from_ne_bytes([b[0], b[1]]).to_f32();
                row.iter_mut().zip(taken.chunks_exact(2)).for_each(|(to, b)| *to = value(b));
            }
            SampleType::F32 => {
                let value = |b: &[u8]| f32::from_ne_bytes([b[0], b[1], b[2], b[3]]);
                row.iter_mut().zip(taken.chunks_exact(4)).for_each(|(to, b)| *to = value(b));
            }
            SampleType::U32 => {
                let value = |b: &[u8]| u32::from_ne_bytes([b[0], b[1], b[2], b[3]]) as f32;
                row.iter_mut().zip(taken.chunks_exact(4)).for_each(|(to, b)| *to = value(b));
            }
        }
    }

    /// A value for every texel.
    fn at_every_texel(self) -> Vec<f32> {
        let [columns, rows] = Self::sides(self.sampling, self.size);
        let [width, height] = self.size;
        if self.sampling == [1, 1] {
            return self.samples;
        }
        let across = (0..rows).flat_map(|y| {
            let row = &self.samples[y * columns..][..columns];
            (0..width).map(move |x| between(|i| row[i], columns, x, self.sampling[0] as usize))
        });
        let wide: Vec<f32> = across.collect();
        let at = |x: usize, y: usize| between(|i| wide[i * width + x], rows, y, self.sampling[1] as usize);
        (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| at(x, y)).collect()
    }
}

/// The value at `place` of the picture, by samples at every `step`-th place.
fn between(sample: impl Fn(usize) -> f32, count: usize, place: usize, step: usize) -> f32 {
    let (low, beyond) = (place / step, place % step);
    let last = count - 1;
    if beyond == 0 {
        return sample(low);
    }
    if step == 2 {
        let pair = |k: usize| sample(low.saturating_sub(k)) + sample((low + 1 + k).min(last));
        return BETWEEN.iter().enumerate().map(|(k, weight)| weight * pair(k)).sum();
    }
    let share = beyond as f32 / step as f32;
    sample(low) * (1.0 - share) + sample((low + 1).min(last)) * share
}

/// The names of channels with fewer samples, for a note.
pub(super) fn told(layers: &Layers, sampling: &[Vec<Sampling>]) -> String {
    let names = layers.iter().zip(sampling).flat_map(|(layer, sampling)| {
        let list = layer.channel_data.list.iter().zip(sampling);
        list.filter(|(_, s)| **s != [1, 1]).map(|(channel, _)| channel.name.to_string())
    });
    let names: Vec<String> = names.take(12).collect();
    format!("its channels {} have fewer samples than it has texels, and are interpolated", names.join(", "))
}
