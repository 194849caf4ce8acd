//! The first directory of a TIFF or BigTIFF: which numbers stand behind each of its tags.

use std::collections::BTreeMap;

/// Pages beyond these are not counted.
const MOST_PAGES: u32 = 1000;

/// Where the numbers of a tag lie in the file.
#[derive(Clone, Copy)]
struct TagEntry {
    /// 1 to 18, as the format counts kinds of numbers.
    kind: u16,
    /// Of numbers.
    count: u64,
    /// Of the first one, in bytes from the start of the file.
    place: u64,
}

/// The first directory.
pub(super) struct Directory<'a> {
    bytes: &'a [u8],
    /// Numbers have their high byte first.
    pub is_big_endian: bool,
    entries: BTreeMap<u16, TagEntry>,
    /// Pictures of full size in the file, this one included.
    pub pages: u32,
}

/// Reads numbers of either byte order at any place.
#[derive(Clone, Copy)]
struct Numbers<'a> {
    bytes: &'a [u8],
    is_big_endian: bool,
}

impl<'a> Numbers<'a> {
    fn slice(self, place: u64, length: u64) -> Option<&'a [u8]> {
        let begin = usize::try_from(place).ok()?;
        self.bytes.get(begin..begin.checked_add(usize::try_from(length).ok()?)?)
    }

    fn number(self, place: u64, length: u64) -> Option<u64> {
        let add = |sum: u64, byte: &u8| sum << 8 | u64::from(*byte);
        let bytes = self.slice(place, length)?.iter();
        Some(if self.is_big_endian { bytes.fold(0, add) } else { bytes.rev().fold(0, add) })
    }

    /// The entries of a directory, and where the next one begins; `None` for the latter after the last one.
    fn directory(self, place: u64, is_large: bool) -> Option<(BTreeMap<u16, TagEntry>, Option<u64>)> {
        let (length, step, of_count, inline) = if is_large { (8, 20, 8, 8) } else { (2, 12, 4, 4) };
        let count = self.number(place, length)?;
        let first = place.checked_add(length)?;
        let end = count.checked_mul(step).and_then(|all| all.checked_add(first))?;
        let mut entries = BTreeMap::new();
        for i in 0..count {
            let at = first + step * i;
            // A directory that is cut off has the entries before its end.
            let Some((tag, kind)) = self.number(at, 2).zip(self.number(at + 2, 2)) else { break };
            let Some(count) = self.number(at + 4, of_count) else { break };
            let value = at + 4 + of_count;
            let fits = count.checked_mul(size_of(kind as u16)).is_some_and(|bytes| bytes <= inline);
            let Some(place) = (if fits { Some(value) } else { self.number(value, inline) }) else { break };
            entries.insert(tag as u16, TagEntry { kind: kind as u16, count, place });
        }
        let next = self.number(end, inline).filter(|next| *next != 0);
        Some((entries, next))
    }
}

/// Bytes of a number of a kind; 0 for kinds that no version of the format has.
fn size_of(kind: u16) -> u64 {
    match kind {
        1 | 2 | 6 | 7 => 1,
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 | 16 | 17 | 18 => 8,
        _ => 0,
    }
}

impl<'a> Directory<'a> {
    /// Reads the first directory.
    ///
    /// # Errors
    /// Bytes that are no TIFF, and a file that ends before its directory.
    pub(super) fn read(bytes: &'a [u8]) -> Result<Self, String> {
        let is_big_endian = bytes.starts_with(b"MM");
        let numbers = Numbers { bytes, is_big_endian };
        let cut_off = || "is a TIFF that is cut off before its directory".to_owned();
        let (is_large, place) = match numbers.number(2, 2) {
            Some(42) => (false, numbers.number(4, 4)),
            Some(43) => (true, numbers.number(8, 8)),
            _ => return Err("is no TIFF".to_owned()),
        };
        let (entries, mut next) = place.and_then(|at| numbers.directory(at, is_large)).ok_or_else(cut_off)?;
        let mut pages = 1;
        let mut steps = 0;
        while let Some((others, after)) = next.and_then(|at| numbers.directory(at, is_large)) {
            // A chain that runs in a circle is as long as any.
            steps += 1;
            if steps == MOST_PAGES {
                break;
            }
            let page = Self { bytes, is_big_endian, entries: others, pages: 0 };
            // Bit 0: the same picture with fewer texels; bit 2: a mask.
            pages += u32::from(page.number(254).unwrap_or(0) & 5 == 0);
            next = after;
        }
        Ok(Self { bytes, is_big_endian, entries, pages })
    }

    /// Whether a tag is there.
    pub(super) fn has(&self, tag: u16) -> bool {
        self.entries.contains_key(&tag)
    }

    /// The bytes of the file behind a place.
    pub(super) fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// The bytes of a tag, if all of them are there.
    pub(super) fn raw(&self, tag: u16) -> Option<&'a [u8]> {
        let entry = self.entries.get(&tag)?;
        let length = entry.count.checked_mul(size_of(entry.kind)).filter(|length| *length > 0)?;
        Numbers { bytes: self.bytes, is_big_endian: self.is_big_endian }.slice(entry.place, length)
    }

    /// A tag's whole numbers; `None` where it is absent, of another kind, or not all of them are there.
    pub(super) fn integers(&self, tag: u16) -> Option<Vec<u64>> {
        let kind = self.entries.get(&tag)?.kind;
        let raw = self.raw(tag)?;
        if !matches!(kind, 1 | 3 | 4 | 7 | 13 | 16) {
            return None;
        }
        let numbers = Numbers { bytes: raw, is_big_endian: self.is_big_endian };
        let size = size_of(kind);
        (0..raw.len() as u64 / size).map(|i| numbers.number(i * size, size)).collect()
    }

    /// The first of a tag's whole numbers.
    pub(super) fn number(&self, tag: u16) -> Option<u64> {
        self.integers(tag)?.first().copied()
    }

    /// A tag's fractions, or whole numbers.
    pub(super) fn fractions(&self, tag: u16) -> Option<Vec<f64>> {
        let kind = self.entries.get(&tag)?.kind;
        if kind != 5 {
            return Some(self.integers(tag)?.into_iter().map(|whole| whole as f64).collect());
        }
        let raw = self.raw(tag)?;
        let numbers = Numbers { bytes: raw, is_big_endian: self.is_big_endian };
        let at = |i: u64| Some(numbers.number(8 * i, 4)? as f64 / numbers.number(8 * i + 4, 4)? as f64);
        (0..raw.len() as u64 / 8).map(at).collect()
    }
}
