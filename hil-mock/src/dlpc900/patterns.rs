//! The pattern memory: computes from LUT definitions and uploaded images what the mirrors show.

use std::collections::BTreeMap;

use dpm_dlpc900::image::{extract_plane, ImageDecoder, ImageHeader, PlaneOrder, HEADER_BYTES};
use dpm_dlpc900::lut::{check_entry, step_us, validate, DisplayMode, Dmd, LutEntry, TableLimits, MAX_IMAGES};

/// An error code of the controller and the reason.
pub(super) type Refusal = (u8, String);

fn refuse<T>(code: u8, why: impl ToString) -> Result<T, Refusal> {
    Err((code, why.to_string()))
}

/// An image during its upload.
struct Loading {
    secondary: bool,
    index: u16,
    total: usize,
    received: usize,
    header: Vec<u8>,
    decoder: Option<ImageDecoder>,
    stored: bool,
}

/// LUT and image memory of one controller pair.
pub(super) struct Patterns {
    dmd: Dmd,
    order: PlaneOrder,
    staged: BTreeMap<u16, LutEntry>,
    effective: Vec<LutEntry>,
    shown_order: Vec<u16>,
    /// The u32 of the LUT configuration.
    pub repeat: u32,
    /// Pixels by (image, secondary).
    images: BTreeMap<(u16, bool), Vec<u8>>,
    loading: Option<Loading>,
    last_loaded: Option<u16>,
}

impl Patterns {
    pub(super) fn new(dmd: Dmd, order: PlaneOrder) -> Self {
        Self {
            dmd,
            order,
            staged: BTreeMap::new(),
            effective: Vec::new(),
            shown_order: Vec::new(),
            repeat: 0,
            images: BTreeMap::new(),
            loading: None,
            last_loaded: None,
        }
    }

    /// The table in the order shown.
    pub(super) fn table(&self) -> Vec<LutEntry> {
        self.shown_order.iter().filter_map(|i| self.effective.get(usize::from(*i))).copied().collect()
    }

    /// The table stops being effective (park, invert); definitions and images stay.
    pub(super) fn deactivate(&mut self) {
        self.effective.clear();
        self.shown_order.clear();
    }

    /// Clears everything (reset, mode switch).
    pub(super) fn clear(&mut self) {
        *self = Self::new(self.dmd, self.order);
    }

    /// 0x1A34.
    pub(super) fn define(&mut self, data: &[u8]) -> Result<(), Refusal> {
        let Some(bytes) = data.first_chunk::<12>().filter(|_| data.len() == 12) else {
            return refuse(6, format!("a LUT definition has 12 bytes, not {}", data.len()));
        };
        let e = LutEntry::decode(bytes);
        let place = usize::from(e.index);
        if place >= self.dmd.max_entries() {
            return refuse(15, format!("entry {place} of at most {}", self.dmd.max_entries()));
        }
        let limits = TableLimits { dmd: self.dmd, images: MAX_IMAGES, frame_us: None };
        if let Err(rule) = check_entry(place, &e, &limits) {
            return refuse(rule.error_code(), format!("LUT entry {place}: {rule}"));
        }
        self.staged.insert(e.index, e);
        Ok(())
    }

    /// 0x1A31: makes entries 0 to n - 1 effective.
    pub(super) fn configure(&mut self, data: &[u8], mode: DisplayMode) -> Result<(), Refusal> {
        let Some([n0, n1, repeat @ ..]) = data.first_chunk::<6>().filter(|_| data.len() == 6) else {
            return refuse(6, format!("a LUT configuration has 6 bytes, not {}", data.len()));
        };
        let n = u16::from_le_bytes([*n0, *n1]);
        if usize::from(n) > self.dmd.max_entries() {
            return refuse(15, format!("{n} entries of at most {}", self.dmd.max_entries()));
        }
        let mut table = Vec::new();
        for i in 0..n {
            match self.staged.get(&i) {
                Some(e) => table.push(*e),
                None => return refuse(16, format!("entry {i} was never defined")),
            }
        }
        let images = if mode == DisplayMode::VideoPattern { 1 } else { MAX_IMAGES };
        // Patterns that do not fit a frame are not refused: the sequencer aborts when it runs.
        let limits = TableLimits { dmd: self.dmd, images, frame_us: None };
        if let Err(e) = validate(&table, &limits) {
            return refuse(e.rule.error_code(), e);
        }
        let place = |t: &[LutEntry]| t.iter().map(|e| (e.depth, e.image, e.bit)).collect::<Vec<_>>();
        if place(&table) != place(&self.effective) {
            // Other entries, depths, images or bits: the earlier uploads no longer fit.
            self.images.clear();
            self.last_loaded = None;
        }
        self.shown_order = (0..n).collect();
        self.effective = table;
        self.repeat = u32::from_le_bytes(*repeat);
        Ok(())
    }

    /// 0x1A32: shows the effective entries in another order.
    pub(super) fn reorder(&mut self, data: &[u8]) -> Result<(), Refusal> {
        let Some(([n0, n1, repeat @ ..], list)) = data.split_first_chunk::<6>() else {
            return refuse(6, format!("a LUT reorder has at least 6 bytes, not {}", data.len()));
        };
        let n = usize::from(u16::from_le_bytes([*n0, *n1]));
        if list.len() != 2 * n || n == 0 {
            return refuse(6, format!("{n} entries announced, {} bytes of them sent", list.len()));
        }
        let order: Vec<_> = list.chunks_exact(2).map(|c| u16::from_le_bytes([c[0], c[1]])).collect();
        if let Some(bad) = order.iter().find(|i| usize::from(**i) >= self.effective.len()) {
            return refuse(15, format!("entry {bad} is not in the table of {}", self.effective.len()));
        }
        self.shown_order = order;
        self.repeat = u32::from_le_bytes(*repeat);
        Ok(())
    }

    fn half_width(&self) -> u32 {
        let w = self.dmd.raster().width();
        if self.dmd.has_two_controllers() {
            w / 2
        } else {
            w
        }
    }

    /// 0x1A2A / 0x1A2C. Returns a warning if the order is not that of the guide.
    pub(super) fn begin_image(&mut self, data: &[u8], secondary: bool) -> Result<Option<String>, Refusal> {
        let Some([i0, i1, total @ ..]) = data.first_chunk::<6>().filter(|_| data.len() == 6) else {
            return refuse(6, format!("an image load has 6 bytes, not {}", data.len()));
        };
        let (index, total) = (u16::from_le_bytes([*i0, *i1]), u32::from_le_bytes(*total) as usize);
        if usize::from(index) >= MAX_IMAGES {
            return refuse(17, format!("image {index} of at most {MAX_IMAGES}"));
        }
        if secondary && !self.dmd.has_two_controllers() {
            return refuse(4, format!("a {} has no second controller", self.dmd.name()));
        }
        if self.effective.is_empty() {
            return refuse(5, "images come after the LUT configuration");
        }
        // The worst encoding is two bytes a pixel longer than raw.
        let most = HEADER_BYTES + self.half_width() as usize * self.dmd.raster().height() as usize * 5;
        if total < HEADER_BYTES || total > most {
            return refuse(
                8,
                format!("an image of {total} bytes; between {HEADER_BYTES} and {most} make sense"),
            );
        }
        let last = self.effective.iter().map(|e| e.image).max().unwrap_or(0);
        let wrong = match self.last_loaded {
            None => index != last,
            Some(before) => index > before || before - index > 1,
        };
        let restart = index == last;
        let warning = (wrong && !restart).then(|| {
            format!(
                "image {index} after {:?}: images go from the last ({last}) to the first",
                self.last_loaded
            )
        });
        self.last_loaded = Some(index);
        self.images.remove(&(index, secondary));
        self.loading = Some(Loading {
            secondary,
            index,
            total,
            received: 0,
            header: Vec::new(),
            decoder: None,
            stored: false,
        });
        Ok(warning)
    }

    /// 0x1A2B / 0x1A2D.
    pub(super) fn image_data(&mut self, data: &[u8], secondary: bool) -> Result<(), Refusal> {
        let Some(([c0, c1], bytes)) = data.split_first_chunk::<2>() else {
            return refuse(6, "image data start with a count");
        };
        let count = usize::from(u16::from_le_bytes([*c0, *c1]));
        if count > bytes.len() || count > 504 {
            return refuse(6, format!("{count} bytes announced, {} sent", bytes.len()));
        }
        let bytes = &bytes[..count];
        let width = self.half_width();
        let height = self.dmd.raster().height();
        // Programs send an empty last command if their image is a multiple of 504 bytes.
        let Some(l) = self.loading.as_mut().filter(|l| l.secondary == secondary) else {
            return if count == 0 { Ok(()) } else { refuse(5, "image data without an image load") };
        };
        if l.received + count > l.total {
            self.loading = None;
            return refuse(6, "more image bytes than announced");
        }
        l.received += count;
        let mut rest = bytes;
        let outcome = loop {
            if let Some(d) = &mut l.decoder {
                break d.push(rest);
            }
            let missing = HEADER_BYTES - l.header.len();
            let (head, tail) = rest.split_at(missing.min(rest.len()));
            l.header.extend_from_slice(head);
            rest = tail;
            let Some(header) = l.header.first_chunk::<HEADER_BYTES>() else { break Ok(()) };
            match ImageHeader::decode(header).and_then(|h| ImageDecoder::new(&h, width, height)) {
                Ok(d) => l.decoder = Some(d),
                Err(e) => break Err(e),
            }
        };
        if let Err(e) = outcome {
            let index = l.index;
            self.loading = None;
            return refuse(9, format!("image {index}: {e}"));
        }
        let index = l.index;
        if let Some(d) = l.decoder.as_ref().filter(|d| d.is_complete() && !l.stored) {
            // Bytes after the end of the image are padding.
            self.images.insert((index, secondary), d.pixels().to_vec());
            l.stored = true;
        }
        if l.received == l.total {
            let done = self.loading.take().filter(|l| !l.stored).map(|l| l.decoder);
            match done {
                None => {}
                Some(None) => return refuse(9, format!("image {index}: no header")),
                Some(Some(d)) => match d.finish() {
                    Ok(pixels) => drop(self.images.insert((index, secondary), pixels)),
                    Err(e) => return refuse(9, format!("image {index}: {e}")),
                },
            }
        }
        Ok(())
    }

    /// The first image that the table names and that is missing, if any.
    pub(super) fn missing_image(&self) -> Option<u16> {
        let there = |i: u16| {
            self.images.contains_key(&(i, false))
                && (!self.dmd.has_two_controllers() || self.images.contains_key(&(i, true)))
        };
        self.effective.iter().map(|e| e.image).find(|i| !there(*i))
    }

    /// Plane `bit` of pattern `place` (0 = its least significant bit) in the project's plane layout; `None` if there is
    /// none.
    pub(super) fn plane(&self, place: usize, bit: u8) -> Option<Vec<u8>> {
        let e = *self.table().get(place)?;
        if bit >= e.depth {
            return None;
        }
        let raster = self.dmd.raster();
        let mut out = vec![0; raster.plane_bytes()];
        let plane = usize::from(e.bit + bit);
        let (half, width) = (self.half_width() as usize, raster.width() as usize);
        extract_plane(self.images.get(&(e.image, false))?, plane, self.order, raster, 0..half, &mut out);
        if half < width {
            extract_plane(
                self.images.get(&(e.image, true))?,
                plane,
                self.order,
                raster,
                half..width,
                &mut out,
            );
        }
        Some(out)
    }

    /// Number of patterns shown before the sequence ends; `None` if it never ends.
    pub(super) fn patterns_to_show(&self, counts_patterns: bool) -> Option<u64> {
        match u64::from(self.repeat) {
            0 => None,
            n if counts_patterns => Some(n),
            n => Some(n * self.shown_order.len() as u64),
        }
    }

    /// The pattern lit `elapsed_us` after the start, or `None` if it is dark or over; and whether it is over.
    pub(super) fn showing(&self, elapsed_us: u64, counts_patterns: bool) -> (Option<usize>, bool) {
        let table = self.table();
        let cycle: u64 = (0..table.len()).map(|i| step_us(&table, i)).sum();
        if cycle == 0 {
            return (None, true);
        }
        let (passes, mut left) = (elapsed_us / cycle, elapsed_us % cycle);
        let most = self.patterns_to_show(counts_patterns);
        for (i, e) in table.iter().enumerate() {
            let step = step_us(&table, i);
            if left < step {
                let over = most.is_some_and(|m| passes * table.len() as u64 + i as u64 >= m);
                let lit = left < u64::from(e.exposure_us);
                return ((lit && !over).then_some(i), over);
            }
            left -= step;
        }
        (None, false)
    }

    /// Time of the whole table, microseconds.
    pub(super) fn table_us(&self) -> u64 {
        self.effective.iter().map(|e| u64::from(e.exposure_us) + u64::from(e.dark_us)).sum()
    }
}
