//! Reads TIFF and BigTIFF of any depth, order, packing and kind of colours that cameras, scanners and painting programs write.
//!
//! The reader of the `tiff` crate knows fewer of them: no palettes, no 2 or 4 bits, no chroma of fewer texels, no tiles in
//! planes, no CIELab, no numbers with a sign, and it ends at the first damage. The decoders of what is packed are libraries.

mod chunk;
mod colour;
mod directory;
mod numbers;
#[cfg(test)]
mod tests;

use crate::jpeg_picture::JpegFrame;
use chunk::{Packing, Unpacking};
use colour::{Chroma, Colours};
use directory::Directory;
use numbers::{add_up, float_of_24, gather, Bits};

/// Bytes that may be unpacked in all, as a multiple of the largest piece: it bounds time.
const MOST_UNPACKED: u64 = 8;

/// What a number of a texel is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TexelKind {
    Unsigned,
    Signed,
    Float,
}

/// Whether a file says that it is a TIFF or a BigTIFF.
pub(crate) fn is_tiff(bytes: &[u8]) -> bool {
    [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|mark| bytes.starts_with(*mark))
}

/// A TIFF whose header is read.
pub(crate) struct Tiff<'a> {
    directory: Directory<'a>,
    /// As stored, before it is turned.
    width: u32,
    height: u32,
    /// Of each number of a texel.
    bits: Vec<u32>,
    kind: TexelKind,
    colours: Colours,
    /// The number that is alpha, and whether the colours are multiplied by it.
    alpha: Option<(usize, bool)>,
    packing: Packing,
    /// The picture is a whole JPEG file.
    is_file: bool,
    /// 1: none, 2: differences, 3: differences of the bytes of floats.
    predictor: u64,
    /// Each strip or tile has one number of the texels.
    is_planar: bool,
    /// Texels of a chroma across and down.
    subsampling: [u32; 2],
    /// Texels of a strip or tile across and down.
    chunk: [u32; 2],
    offsets: Vec<u64>,
    lengths: Vec<u64>,
    /// 1 to 8, as Exif counts.
    orientation: u64,
}

/// The colours that a directory names.
fn colours_of(directory: &Directory, samples: usize, bits: u32, packing: Packing) -> Result<Colours, String> {
    let named = directory.number(262).unwrap_or(match (packing, samples) {
        (Packing::Fax3 | Packing::Fax4, _) => 0,
        (_, 3..) => 2,
        _ => 1,
    });
    Ok(match named {
        0 => Colours::Darkness,
        1 | 4 => Colours::Grey,
        2 => Colours::Rgb,
        3 => Colours::Palette(palette(directory, bits)?),
        5 => Colours::Inks,
        6 => {
            let three =
                |tag: u16| Some(directory.fractions(tag)?.into_iter().map(|x| x as f32).collect::<Vec<_>>());
            let luma: Option<[f32; 3]> = three(529).and_then(|luma| luma.try_into().ok());
            // A JPEG has its own, which all programs take.
            let is_own = packing != Packing::Jpeg;
            let luma = luma.filter(|luma| is_own && luma.iter().all(|x| x.is_finite()) && luma[1] != 0.0);
            let range: Option<[f32; 6]> = three(532).and_then(|range| range.try_into().ok());
            let range = range.filter(|range| range.iter().all(|x| x.is_finite()));
            Colours::Chroma(Chroma {
                luma: luma.unwrap_or([0.299, 0.587, 0.114]),
                range: range.unwrap_or([0.0, 255.0, 128.0, 255.0, 128.0, 255.0]),
            })
        }
        8 => Colours::Lab { is_signed: true },
        9 => Colours::Lab { is_signed: false },
        other => {
            let name = match other {
                10 => "ITU's Lab",
                32_803 | 34_892 => "the numbers of a camera's sensor",
                32_844 | 32_845 => "logarithms of light",
                _ => "no colours of any version of the format",
            };
            return Err(format!(
                "is a TIFF of {name} (photometric interpretation {other}): save it as RGB, or as PNG"
            ));
        }
    })
}

/// The list of colours of a picture that is places in it.
fn palette(directory: &Directory, bits: u32) -> Result<Vec<[f32; 3]>, String> {
    let codes = directory.integers(320).unwrap_or_default();
    let count = codes.len() / 3;
    if count == 0 || bits > 16 {
        return Err("is a TIFF of places in a list of colours, without the list: save it as RGB".into());
    }
    // Sixteen bits, of which the upper eight count; some programs fill the lower ones alone.
    let shift = if codes.iter().all(|code| *code < 256) { 0 } else { 8 };
    let at = |i: usize| (codes[i] >> shift).min(255) as f32 / 255.0;
    Ok((0..count).map(|i| [at(i), at(count + i), at(2 * count + i)]).collect())
}

/// The kind of a texel's numbers, and the bits of each.
fn numbers_of(directory: &Directory, samples: usize) -> Result<(TexelKind, Vec<u32>), String> {
    let of_kind = directory.integers(339).unwrap_or_default();
    let first = of_kind.first().copied().unwrap_or(1);
    let kind = match first {
        _ if of_kind.iter().any(|kind| *kind != first) => None,
        1 | 4 => Some(TexelKind::Unsigned),
        // Bytes with a sign are codes to all other programs.
        2 if directory.number(258) == Some(8) => Some(TexelKind::Unsigned),
        2 => Some(TexelKind::Signed),
        3 => Some(TexelKind::Float),
        _ => None,
    };
    let listed = directory.integers(258).unwrap_or_else(|| vec![1]);
    // One for all is written by some programs.
    let bits: Vec<u32> =
        (0..samples).map(|i| *listed.get(i).or(listed.first()).unwrap_or(&0) as u32).collect();
    let fits = |kind: TexelKind| match kind {
        TexelKind::Float => bits.iter().all(|b| matches!(b, 16 | 24 | 32 | 64) && *b == bits[0]),
        _ => bits.iter().all(|b| matches!(b, 1..=16 | 24 | 32 | 64)),
    };
    match kind {
        Some(kind) if fits(kind) => Ok((kind, bits)),
        _ => {
            let told = format!("is a TIFF whose numbers are of kind {of_kind:?} and {listed:?} bits");
            Err(format!("{told}: save it with 8 or 16 bits, or as PNG"))
        }
    }
}

impl<'a> Tiff<'a> {
    /// Reads the directory of the first picture.
    ///
    /// # Errors
    /// What is not read, by its name, with what to give instead; and what contradicts itself.
    pub(crate) fn open(bytes: &'a [u8]) -> Result<Self, String> {
        let directory = Directory::read(bytes)?;
        let side = |tag: u16| directory.number(tag).and_then(|side| u32::try_from(side).ok());
        let (Some(width), Some(height)) = (side(256), side(257)) else {
            return Err("is a TIFF without the sides of its picture".into());
        };
        let named = directory.number(259).unwrap_or(1);
        // Before 1995 a whole JPEG file could stand in the place of strips.
        let has_file = |at: &u64| {
            let from = usize::try_from(*at).ok().and_then(|at| bytes.get(at..));
            // Of some files only the tables stand there, and the scan in the strips.
            let length = directory.number(514).and_then(|length| usize::try_from(length).ok());
            let file = from.map(|from| &from[..length.unwrap_or(from.len()).min(from.len())]);
            file.and_then(JpegFrame::of).is_some_and(|frame| frame.has_scan())
        };
        let file = directory.number(513).filter(|at| named == 6 && has_file(at));
        let packing = Packing::of(if file.is_some() { 7 } else { named })?;
        let listed = directory.integers(258).map_or(1, |bits| bits.len() as u64);
        let samples = directory.number(277).unwrap_or(listed) as usize;
        if !(1..=64).contains(&samples) {
            return Err(format!("is a TIFF of {samples} numbers for each texel: save it as RGB"));
        }
        let (kind, bits) = numbers_of(&directory, samples)?;
        let colours = match (file, samples) {
            // The marks of the JPEG say what its colours are.
            (Some(_), 3) => Colours::Rgb,
            _ => colours_of(&directory, samples, bits[0], packing)?,
        };
        let (wide, high) = (side(322), side(323));
        let chunk = match wide.zip(high) {
            _ if file.is_some() => [width, height],
            Some((wide, high)) => [wide, high],
            None => [width, side(278).unwrap_or(u32::MAX).clamp(1, height.max(1))],
        };
        let listed =
            |tags: [u16; 2]| tags.iter().find_map(|tag| directory.integers(*tag)).unwrap_or_default();
        let (offsets, lengths) = match file {
            Some(at) => (vec![at], vec![]),
            None => (listed([324, 273]), listed([325, 279])),
        };
        let is_chroma = matches!(colours, Colours::Chroma(_)) && !packing.is_picture();
        let subsampling = match directory.integers(530).as_deref() {
            _ if !is_chroma => [1, 1],
            Some([across @ 1..=4, down @ 1..=4]) => [*across as u32, *down as u32],
            Some(_) => return Err("is a TIFF whose chroma has no sides: save it as RGB".into()),
            None => [2, 2],
        };
        let tiff = Self {
            width,
            height,
            alpha: None,
            packing,
            is_file: file.is_some(),
            predictor: if packing.has_predictor() { directory.number(317).unwrap_or(1) } else { 1 },
            is_planar: directory.number(284) == Some(2) && samples > 1,
            subsampling,
            chunk,
            offsets,
            lengths,
            orientation: directory.number(274).unwrap_or(1),
            bits,
            kind,
            colours,
            directory,
        };
        tiff.checked()
    }

    /// What contradicts itself, and alpha.
    fn checked(mut self) -> Result<Self, String> {
        let (samples, needed) = (self.bits.len(), self.colours.samples());
        if samples < needed {
            return Err(format!(
                "is a TIFF of {samples} numbers for each texel, whose colours need {needed}"
            ));
        }
        if self.chunk.contains(&0) {
            return Err("is a TIFF whose tiles have no sides".into());
        }
        if self.bits.iter().any(|bits| *bits != self.bits[0]) && self.bits.iter().any(|bits| *bits > 8) {
            return Err(format!(
                "is a TIFF whose numbers have {:?} bits: save it with the same for all",
                self.bits
            ));
        }
        let is_odd_depth = self.bits.iter().any(|bits| !matches!(bits, 8 | 16 | 32 | 64));
        if self.packing.is_picture()
            && (self.bits.iter().any(|bits| *bits != 8) || self.kind != TexelKind::Unsigned)
        {
            return Err(
                "is a TIFF whose packing has 8 bits and whose numbers have others: save it as PNG".into()
            );
        }
        if matches!(self.packing, Packing::Fax3 | Packing::Fax4) && self.bits != [1] {
            return Err("is a TIFF packed as a fax of more than two colours: save it as PNG".into());
        }
        if self.packing == Packing::Fax3 && self.directory.number(292).unwrap_or(0) & 1 == 1 {
            return Err("is a TIFF packed as a fax whose lines build on one another (group 3): save it as group 4, or as PNG".into());
        }
        if self.subsampling != [1, 1] && (self.is_planar || self.bits[..] != [8; 3]) {
            return Err(
                "is a TIFF with chroma of fewer texels in planes or with alpha: save it as RGB".into()
            );
        }
        if matches!(self.colours, Colours::Lab { .. }) && self.bits.iter().any(|bits| *bits != 8) {
            return Err("is a TIFF of CIELab with other than 8 bits: save it as RGB".into());
        }
        let is_float = self.kind == TexelKind::Float;
        match self.predictor {
            1 => {}
            2 if !is_odd_depth
                && self.bits.iter().all(|bits| *bits == self.bits[0])
                && self.subsampling == [1, 1] => {}
            3 if is_float && self.bits[0] != 24 => {}
            other => {
                return Err(format!(
                    "is a TIFF with predictor {other} for numbers of {} bits: save it without",
                    self.bits[0]
                ))
            }
        }
        let extra = self.directory.integers(338).unwrap_or_default().first().copied();
        let is_plain = matches!(self.colours, Colours::Rgb | Colours::Grey | Colours::Darkness);
        self.alpha = match (extra, samples > needed) {
            (_, false) | (Some(0), _) => None,
            (Some(1), _) => Some((needed, true)),
            (Some(_), _) => Some((needed, false)),
            // One more number without a word is alpha in most programs.
            (None, true) => (samples == needed + 1 && is_plain).then_some((needed, false)),
        };
        Ok(self)
    }

    /// Texels across and down, as the picture is shown.
    pub(crate) fn sides(&self) -> [u32; 2] {
        if self.orientation >= 5 && self.orientation <= 8 {
            [self.height, self.width]
        } else {
            [self.width, self.height]
        }
    }

    /// Whether its numbers are floats, which are light by most programs, and not codes for a display.
    pub(crate) fn is_light(&self) -> bool {
        self.kind == TexelKind::Float
    }

    /// Numbers of a texel that are stored together.
    fn together(&self) -> usize {
        if self.is_planar {
            1
        } else {
            self.bits.len()
        }
    }

    /// Bytes of a row of a strip or tile, of the number `plane` if each has its own.
    fn row_bytes(&self, plane: usize) -> u64 {
        let bits: u64 = match self.is_planar {
            true => self.bits[plane].into(),
            false => self.bits.iter().map(|bits| u64::from(*bits)).sum(),
        };
        (u64::from(self.chunk[0]) * bits).div_ceil(8)
    }

    /// Strips or tiles across and down.
    fn chunks(&self) -> [u32; 2] {
        [self.width.div_ceil(self.chunk[0]), self.height.div_ceil(self.chunk[1])]
    }

    /// Bytes of the largest strip or tile.
    fn chunk_bytes(&self) -> u64 {
        let [across, down] = self.subsampling.map(u64::from);
        let [width, height] = self.chunk.map(u64::from);
        if [across, down] != [1, 1] {
            return (width.div_ceil(across) * height.div_ceil(down)).saturating_mul(across * down + 2);
        }
        let widest = (0..self.bits.len()).map(|plane| self.row_bytes(plane)).max().unwrap_or(0);
        widest.saturating_mul(height)
    }

    /// Gives every texel that is there, with its place in the picture as it is shown, to `put`: red, green, blue and alpha, codes
    /// as 0 to 1 of their range. `allowed` is the largest piece of memory in bytes. Returns what should be said of the picture.
    ///
    /// # Errors
    /// Strips or tiles that need more memory than that, and a picture of which nothing can be unpacked.
    pub(crate) fn read(
        &self,
        allowed: u64,
        mut put: impl FnMut([u32; 2], [f32; 4]),
    ) -> Result<Vec<String>, String> {
        let [across, down] = self.chunks();
        let planes = if self.is_planar { self.bits.len() } else { 1 };
        // Those that are neither colour nor alpha may be missing.
        let used = self.alpha.map_or(self.colours.samples(), |(at, _)| at + 1).min(planes);
        let count = u64::from(across) * u64::from(down);
        let all = self.chunk_bytes().saturating_mul(count).saturating_mul(planes as u64);
        if self.chunk_bytes() > allowed / 4 * 3 || all > MOST_UNPACKED.saturating_mul(allowed) {
            return Err(format!("unpacks to {all} bytes from so short a file: use a smaller picture"));
        }
        let unpacking = Unpacking {
            packing: self.packing,
            tables: self.directory.raw(347),
            is_file: self.is_file,
            allowed,
            is_reversed: self.directory.number(266) == Some(2),
            greatest: self.chunk.map(|side| side as usize),
        };
        // What lies behind the last place that is named is missing.
        let named = (self.offsets.len() as u64).saturating_sub((used as u64 - 1) * count).min(count);
        let mut found = 0;
        for index in 0..named {
            let origin = [
                (index % u64::from(across)) as u32 * self.chunk[0],
                (index / u64::from(across)) as u32 * self.chunk[1],
            ];
            let parts: Vec<_> = (0..used)
                .map(|plane| self.part(&unpacking, (plane as u64 * count + index) as usize, plane, origin[1]))
                .collect();
            found += self.texels(&parts, origin, &mut |place, texel| put(self.shown(place), texel));
        }
        self.told(found)
    }

    /// What should be said of a picture of which `found` texels are there.
    fn told(&self, found: u64) -> Result<Vec<String>, String> {
        let all = u64::from(self.width) * u64::from(self.height);
        if found == 0 {
            return Err("is a TIFF of which nothing can be unpacked: it is damaged, or packed as nobody else does; save it as PNG".into());
        }
        let mut told = vec![];
        if found < all {
            told.push(format!(
                "{} of its {all} texels are missing and black: the TIFF is damaged or cut off",
                all - found
            ));
        }
        if self.kind == TexelKind::Unsigned && self.directory.number(339) == Some(2) {
            told.push("its bytes have a sign, and are read as codes from 0 to 255".into());
        }
        if self.directory.pages > 1 {
            told.push(format!("the first of its {} pages is used", self.directory.pages));
        }
        Ok(told)
    }

    /// The unpacked bytes of a strip or tile, with numbers of several bytes in this machine's order.
    fn part(&self, unpacking: &Unpacking, index: usize, plane: usize, top: u32) -> Vec<u8> {
        let bytes = self.directory.bytes();
        let begin = usize::try_from(self.offsets[index]).unwrap_or(usize::MAX).min(bytes.len());
        // Some programs give no lengths, or none for a single strip.
        let length = self.lengths.get(index).copied().filter(|length| *length > 0).unwrap_or(u64::MAX);
        let end = begin.saturating_add(usize::try_from(length).unwrap_or(usize::MAX)).min(bytes.len());
        let is_tile = self.chunk[0] != self.width || self.directory.has(322);
        let rows = if is_tile { self.chunk[1] } else { self.chunk[1].min(self.height - top) };
        let sides = [self.chunk[0] as usize, rows as usize];
        let needed = match self.subsampling {
            [1, 1] => self.row_bytes(plane) as usize * rows as usize,
            [across, down] => {
                (self.chunk[0].div_ceil(across) * rows.div_ceil(down)) as usize * (across * down + 2) as usize
            }
        };
        let unpacked = unpacking.unpack(&bytes[begin..end], needed, sides, self.together());
        let mut part = unpacked.into_owned();
        let stride = self.row_bytes(plane) as usize;
        let step = if self.is_planar { 1 } else { self.bits.len() };
        if self.predictor == 3 {
            part.chunks_exact_mut(stride).for_each(|row| gather(row, self.bits[0] as usize / 8, step));
            return part;
        }
        let size = self.bits[plane] as usize / 8;
        let is_whole =
            self.bits.iter().all(|bits| matches!(bits, 16 | 24 | 32 | 64) && *bits == self.bits[0]);
        if is_whole && self.directory.is_big_endian == cfg!(target_endian = "little") {
            part.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
        if self.predictor == 2 {
            part.chunks_exact_mut(stride).for_each(|row| add_up(row, size.max(1), step));
        }
        part
    }

    /// Gives the texels of a strip or tile, from the unpacked bytes of each of its planes; returns how many there were.
    fn texels(
        &self,
        parts: &[Vec<u8>],
        [left, top]: [u32; 2],
        put: &mut impl FnMut([u32; 2], [f32; 4]),
    ) -> u64 {
        let (width, height) = (self.chunk[0].min(self.width - left), self.chunk[1].min(self.height - top));
        if self.subsampling != [1, 1] {
            return self.spread(&parts[0], [left, top], [width, height], put);
        }
        let strides: Vec<usize> = (0..parts.len()).map(|plane| self.row_bytes(plane) as usize).collect();
        let complete =
            parts.iter().zip(&strides).map(|(part, stride)| part.len() / stride).min().unwrap_or(0);
        let rows = height.min(complete as u32);
        let mut of = vec![0.0; self.bits.len()];
        for y in 0..rows {
            let mut readers: Vec<Bits> = parts
                .iter()
                .zip(&strides)
                .map(|(part, stride)| Bits { row: &part[y as usize * stride..][..*stride], at: 0 })
                .collect();
            for x in 0..width {
                let mut code = 0;
                for (i, number) in of.iter_mut().enumerate() {
                    let Some(reader) = readers.get_mut(if self.is_planar { i } else { 0 }) else { break };
                    let raw = reader.take(self.bits[i]);
                    if i == 0 {
                        code = raw;
                    }
                    *number = self.number(raw, self.bits[i]);
                }
                put([left + x, top + y], self.texel(&of, code));
            }
        }
        u64::from(rows) * u64::from(width)
    }

    /// The same for chroma of fewer texels: units of several luminances and one pair of differences.
    fn spread(
        &self,
        part: &[u8],
        [left, top]: [u32; 2],
        [width, height]: [u32; 2],
        put: &mut impl FnMut([u32; 2], [f32; 4]),
    ) -> u64 {
        let [across, down] = self.subsampling;
        let length = (across * down + 2) as usize;
        let of_row = self.chunk[0].div_ceil(across);
        let mut found = 0;
        for (i, unit) in part.chunks_exact(length).enumerate() {
            let origin = [i as u32 % of_row * across, i as u32 / of_row * down];
            for (j, luminance) in unit[..length - 2].iter().enumerate() {
                let (x, y) = (origin[0] + j as u32 % across, origin[1] + j as u32 / across);
                if x < width && y < height {
                    let of =
                        [*luminance, unit[length - 2], unit[length - 1]].map(|code| f32::from(code) / 255.0);
                    put([left + x, top + y], self.texel(&of, 0));
                    found += 1;
                }
            }
        }
        found
    }

    /// A number of a texel as a part of its range.
    fn number(&self, raw: u64, bits: u32) -> f32 {
        match self.kind {
            TexelKind::Unsigned => (raw as f64 / (u64::MAX >> (64 - bits)) as f64) as f32,
            TexelKind::Signed => {
                let signed = (raw << (64 - bits)) as i64 >> (64 - bits);
                // Of one bit, the greatest is 0.
                (signed as f64 / ((u64::MAX >> (65 - bits.max(2))) as f64)) as f32
            }
            TexelKind::Float => match bits {
                16 => half::f16::from_bits(raw as u16).to_f32(),
                24 => float_of_24(raw as u32),
                32 => f32::from_bits(raw as u32),
                _ => f64::from_bits(raw) as f32,
            },
        }
    }

    /// Red, green, blue and alpha of a texel's numbers.
    fn texel(&self, of: &[f32], code: u64) -> [f32; 4] {
        let [mut r, mut g, mut b] = self.colours.rgb(of, code as usize);
        let mut alpha = 1.0;
        if let Some((at, is_multiplied)) = self.alpha {
            alpha = of[at];
            if is_multiplied && alpha > 0.0 {
                [r, g, b] = [r, g, b].map(|x| if self.is_light() { x / alpha } else { (x / alpha).min(1.0) });
            }
        }
        [r, g, b, alpha]
    }

    /// The place of a stored texel in the picture as it is shown.
    fn shown(&self, [x, y]: [u32; 2]) -> [u32; 2] {
        let (right, low) = (self.width - 1 - x, self.height - 1 - y);
        match self.orientation {
            2 => [right, y],
            3 => [right, low],
            4 => [x, low],
            5 => [y, x],
            6 => [low, x],
            7 => [low, right],
            8 => [y, right],
            _ => [x, y],
        }
    }
}
