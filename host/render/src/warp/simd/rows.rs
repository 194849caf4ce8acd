//! The rows around the one that is warped, apart by field, and what is known of them without a look at each pixel.

use super::super::gather::Drawn;
use super::lanes::Lanes;
use dpm_shaders::structs::{OWNER_STILL, WORD_ROUGH};
use std::ops::Range;

/// Fields of a pixel.
pub(super) const WORD: usize = 0;
pub(super) const MOTION: usize = 1;
pub(super) const OWNER_AND_DEPTH: usize = 2;

/// Pixels of a row that are looked at together.
const CELL: usize = 8;
/// Columns on either side of those that are kept, so that any place near them can be loaded.
const PAD: i32 = 32;
/// Most rows up or down in which places are looked up fast.
pub(super) const MOST_REACH: i32 = 14;

/// Nothing is known of who owns the pixels.
const MIXED: u32 = u32::MAX;

/// The last rows of a column of cells.
#[derive(Clone, Copy)]
struct Cell {
    /// Who owns all pixels since the row `since`: a mover's number, 0 for none that moves, or `MIXED`.
    owner: u32,
    since: i32,
    /// The last row in which a pixel is rough.
    rough: i32,
}

/// What is around a block.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Around {
    /// Nothing that moves.
    Still,
    /// One mover only.
    Mover { owner: u32, rough: bool },
    /// Several, or nothing is known.
    Mixed,
}

/// A ring of rows. Filling it allocates only if it is larger than ever before.
#[derive(Default)]
pub(super) struct Rows {
    fields: [Vec<u32>; 3],
    cells: Vec<Cell>,
    /// Columns and rows of the picture that can be asked for.
    columns: Range<i32>,
    rows: Range<i32>,
    stride: usize,
    /// Rows that are kept, a power of two.
    kept: usize,
    /// Rows up and down that are kept beside the one that is warped, and one more below.
    pub(super) reach: i32,
    /// The first row that is not there yet.
    next: i32,
}

impl Rows {
    /// Begins with a picture of which `columns` and `rows` are looked up, `reach` rows around each.
    pub(super) fn begin(&mut self, columns: Range<i32>, rows: Range<i32>, reach: i32) {
        let first = columns.start & !15;
        let width = (columns.end - first + 15) & !15;
        self.stride = (width + 2 * PAD) as usize;
        self.kept = (2 * reach + 2).max(1).cast_unsigned().next_power_of_two() as usize;
        for field in &mut self.fields {
            field.resize(self.stride * self.kept, 0);
        }
        self.cells.clear();
        self.cells.resize(width as usize / CELL, Cell { owner: MIXED, since: rows.start, rough: i32::MIN });
        (self.columns, self.next, self.reach) = (first..columns.end, rows.start, reach);
        self.rows = rows;
    }

    /// Takes the rows that the warp of row `y` looks at.
    #[inline(always)]
    pub(super) fn advance(&mut self, drawn: &Drawn<'_>, y: i32) {
        while self.next < (y + self.reach + 2).min(self.rows.end) {
            self.take(drawn, self.next);
            self.next += 1;
        }
    }

    #[inline(always)]
    fn take(&mut self, drawn: &Drawn<'_>, y: i32) {
        let row = y as usize * drawn.raster.width() as usize;
        let pixels = &drawn.pixels[row + self.columns.start as usize..row + self.columns.end as usize];
        let at = self.slot(y) + PAD as usize;
        let [words, motions, owners] = &mut self.fields;
        let kept = at..at + pixels.len();
        let (words, motions, owners) =
            (&mut words[kept.clone()], &mut motions[kept.clone()], &mut owners[kept]);
        for (((pixel, word), motion), owner) in pixels.iter().zip(words).zip(motions).zip(owners) {
            (*word, *motion, *owner) = (pixel.word, pixel.motion, pixel.owner_and_depth);
        }
        let (words, owners) =
            (&self.fields[WORD][at..][..pixels.len()], &self.fields[OWNER_AND_DEPTH][at..][..pixels.len()]);
        for ((cell, words), owners) in self.cells.iter_mut().zip(words.chunks(CELL)).zip(owners.chunks(CELL))
        {
            let (least, most, all) = summary(words, owners);
            let owner = match (least >> 24, most >> 24) {
                (_, most) if most <= OWNER_STILL => 0,
                (least, most) if least == most => most,
                _ => MIXED,
            };
            if owner != cell.owner {
                (cell.owner, cell.since) = (owner, y);
            }
            if all & WORD_ROUGH != 0 {
                cell.rough = y;
            }
        }
    }

    /// What is around `count` pixels of row `y`, from column `x` on, `wide` pixels to the left and right; and up to which column
    /// the same is around all that follow.
    #[inline(always)]
    pub(super) fn around(&self, [x, y]: [i32; 2], count: i32, wide: i32) -> (Around, i32) {
        let first = (x - wide).max(self.columns.start) - self.columns.start;
        let last = (x + count + wide).min(self.columns.end - 1) - self.columns.start;
        let (first, last) = (first as usize / CELL, last as usize / CELL);
        let top = (y - self.reach).max(self.rows.start);
        let Cell { owner, rough, .. } = self.cells[first];
        let is_alike = |cell: &Cell| {
            cell.owner == owner
                && owner != MIXED
                && cell.since <= top
                && (cell.rough >= top) == (rough >= top)
        };
        if self.cells[first..=last].iter().all(is_alike) {
            let more = self.cells[last..].iter().take_while(|cell| is_alike(cell)).count();
            let until = ((last + more) * CELL) as i32 + self.columns.start;
            let until = if until >= self.columns.end { i32::MAX } else { until };
            let around =
                if owner == 0 { Around::Still } else { Around::Mover { owner, rough: rough >= top } };
            return (around, until);
        }
        let cells = &self.cells[first..=last];
        let around = match cells.iter().all(|cell| cell.owner == owner && cell.since <= top) {
            true if owner == 0 => Around::Still,
            true if owner != MIXED => Around::Mover { owner, rough: true },
            _ => Around::Mixed,
        };
        (around, i32::MIN)
    }

    /// Where row `y` begins in each field.
    #[inline(always)]
    fn slot(&self, y: i32) -> usize {
        (y as usize & (self.kept - 1)) * self.stride
    }

    /// True if the places `off` beside a block are kept, and those to their right and below.
    #[inline(always)]
    pub(super) fn keeps(&self, off: [i32; 2]) -> bool {
        (-PAD..PAD).contains(&off[0]) && (-self.reach..=self.reach).contains(&off[1])
    }

    /// Where pixel [x, y] is in the fields.
    #[inline(always)]
    pub(super) fn index(&self, [x, y]: [i32; 2]) -> usize {
        self.slot(y) + (PAD + x - self.columns.start) as usize
    }

    #[inline(always)]
    pub(super) fn load<L: Lanes>(&self, l: L, field: usize, at: usize) -> L::V {
        l.load(&self.fields[field][at..])
    }
}

/// The least and the greatest of `owners`, and the bits that are in any of `words`.
#[inline(always)]
fn summary(words: &[u32], owners: &[u32]) -> (u32, u32, u32) {
    let mut found = (u32::MAX, 0, 0);
    // A whole cell is of known length, and a few instructions.
    if let (Ok(words), Ok(owners)) = (<&[u32; CELL]>::try_from(words), <&[u32; CELL]>::try_from(owners)) {
        for i in 0..CELL {
            found = (found.0.min(owners[i]), found.1.max(owners[i]), found.2 | words[i]);
        }
        return found;
    }
    for (word, owner) in words.iter().zip(owners) {
        found = (found.0.min(*owner), found.1.max(*owner), found.2 | word);
    }
    found
}
