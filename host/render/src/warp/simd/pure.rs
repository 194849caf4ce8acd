//! Blocks near which there is one mover only: every lookup finds it, all four neighbours of a place count, and what is left is
//! interpolation.

use super::lanes::Lanes;
use super::rows::{Rows, MOTION, WORD};
use super::{all_of, motions, offset, unmarked, Block, Body, Group, Offsets, Plan, MOST_LANES};
use dpm_shaders::structs::WORD_ROUGH;

/// Bits of code values.
const CODE: i32 = 0xff_ffff;

/// A group of planes of a block whose pixels all move alike.
#[derive(Clone, Copy)]
struct Step {
    /// Whole pixels between a mirror and the place that it shows.
    off: [i32; 2],
    /// The weights of the left and the right neighbour, as bytes, twice.
    columns: i32,
    /// What part of a row the place lies below the neighbours, of 65536, or minus that above those of the next row; twice.
    rows: i32,
    is_lower: bool,
    /// Bits of the group in numbers of 16 bits, each of which holds 1/64 of a code.
    mask: u64,
}

/// The steps of the motion that was met last: neighbours mostly move alike.
#[derive(Default)]
pub(super) struct Steps {
    steps: Vec<Step>,
    of: Option<(u32, i32)>,
}

impl Steps {
    /// Another frame has other steps.
    pub(super) fn forget(&mut self) {
        self.of = None;
    }

    /// The steps of points of `body` that move by `motion`.
    fn find(&mut self, plan: &Plan<'_>, body: &Body, motion: i32) -> &[Step] {
        if self.of != Some((body.owner, motion)) {
            self.of = Some((body.owner, motion));
            self.steps.clear();
            let motion = [motion << 16 >> 16, motion >> 16];
            self.steps.extend(plan.groups.iter().map(|group| step(plan, body, motion, group)));
        }
        &self.steps
    }
}

fn step(plan: &Plan<'_>, body: &Body, motion: [i32; 2], group: &Group) -> Step {
    let moved_by = |c: usize, instant: i32| motion[c].wrapping_mul(instant).wrapping_add(32768) >> 16;
    let at = [0, 1].map(|c| moved_by(c, body.mover.instant) - moved_by(c, group.instant));
    if !plan.drawn.are_codes {
        let off = at.map(|c| (c + 32) >> 6);
        return Step { off, columns: 0, rows: 0, is_lower: false, mask: 0 };
    }
    let (off, part) = (at.map(|c| c >> 6), at.map(|c| c & 63));
    let is_lower = part[1] >= 32;
    let columns = ((64 - part[0]) | part[0] << 8) * 0x1_0001;
    let rows = (part[1] - if is_lower { 64 } else { 0 }) << 10;
    let rows = (rows & 0xffff) | rows << 16;
    let mask = [0, 8, 16].map(|shift| u64::from(group.mask as u32 >> shift & 0xff) << (2 * shift + 6));
    Step { off, columns, rows, is_lower, mask: mask[0] | mask[1] | mask[2] }
}

/// The block's words. `rough`: some of the words around are rough. `None`: some points move too fast.
#[inline(always)]
pub(super) fn warp<L: Lanes>(
    l: L,
    rows: &Rows,
    steps: &mut Steps,
    plan: &Plan<'_>,
    body: &Body,
    block: Block,
    rough: bool,
) -> Option<L::V> {
    let motion = rows.load(l, MOTION, block.index);
    let each = motions(l, motion);
    let fastest = l.max(l.abs(each[0]), l.abs(each[1]));
    if l.bits(l.greater(fastest, l.splat(body.limit))) != 0 {
        return None;
    }
    let mut first = [0; MOST_LANES];
    l.store(motion, &mut first);
    let first = first[0] as i32;
    let is_even = l.bits(l.equal(motion, l.splat(first))) == all_of::<L>();
    let own = unmarked(l, plan, rows.load(l, WORD, block.index));
    Some(match (plan.drawn.are_codes, is_even) {
        (true, true) if !rough => {
            let word = even_codes(l, rows, steps.find(plan, body, first), block);
            l.merge(l.splat(plan.masks), word, own)
        }
        (false, true) => even_words(l, rows, steps.find(plan, body, first), plan.groups, block, own),
        (true, _) => codes(l, rows, plan, body, block, each, own, rough),
        (false, false) => words(l, rows, plan, body, block, each, own),
    })
}

/// Code values of a block that moves evenly: the weights are those of all pixels, and groups whose places lie between the same
/// pixels share these.
#[inline(always)]
fn even_codes<L: Lanes>(l: L, rows: &Rows, steps: &[Step], block: Block) -> L::V {
    let mut upper = [l.splat(0); 2];
    let mut lower = upper;
    let mut codes = upper;
    let half = l.splat(0x20_0020);
    let mut off = None;
    for step in steps {
        if off != Some(step.off) {
            off = Some(step.off);
            let [a, b, c, d] = four(l, rows, [block.at[0] + step.off[0], block.at[1] + step.off[1]]);
            upper = [l.low8(a, b), l.high8(a, b)];
            lower = [l.low8(c, d), l.high8(c, d)];
        }
        let (columns, mask) = (l.splat(step.columns), l.splat_four16(step.mask));
        let below = l.splat(step.rows);
        for i in 0..2 {
            let mut code = l.pairs8(upper[i], columns);
            if step.rows != 0 {
                let next = l.pairs8(lower[i], columns);
                let nearer = if step.is_lower { next } else { code };
                code = l.add16(nearer, l.upper16(l.sub16(next, code), below));
            }
            codes[i] = l.merge(mask, l.add16(code, half), codes[i]);
        }
    }
    l.pack16(l.shr16::<6>(codes[0]), l.shr16::<6>(codes[1]))
}

/// The words of the block that begins at pixel [x, y], of that to the right of it, and of those below both.
#[inline(always)]
fn four<L: Lanes>(l: L, rows: &Rows, [x, y]: [i32; 2]) -> [L::V; 4] {
    let (upper, lower) = (rows.index([x, y]), rows.index([x, y + 1]));
    [
        rows.load(l, WORD, upper),
        rows.load(l, WORD, upper + 1),
        rows.load(l, WORD, lower),
        rows.load(l, WORD, lower + 1),
    ]
}

/// Words of a block that moves evenly, taken whole.
#[inline(always)]
fn even_words<L: Lanes>(
    l: L,
    rows: &Rows,
    steps: &[Step],
    groups: &[Group],
    block: Block,
    own: L::V,
) -> L::V {
    let mut word = own;
    for (step, group) in steps.iter().zip(groups) {
        let at = rows.index([block.at[0] + step.off[0], block.at[1] + step.off[1]]);
        word = l.merge(l.splat(group.mask), rows.load(l, WORD, at), word);
    }
    word
}

/// Whole pixels of places, and the parts that are left of them.
#[inline(always)]
fn parted<L: Lanes>(l: L, at: [L::V; 2]) -> (Offsets<L>, [L::V; 2]) {
    let whole = [l.sar::<6>(at[0]), l.sar::<6>(at[1])];
    (Offsets::of(l, whole, all_of::<L>()), [l.and(at[0], l.splat(63)), l.and(at[1], l.splat(63))])
}

/// Code values of any block.
#[inline(always)]
fn codes<L: Lanes>(
    l: L,
    rows: &Rows,
    plan: &Plan<'_>,
    body: &Body,
    block: Block,
    motion: [L::V; 2],
    own: L::V,
    rough: bool,
) -> L::V {
    let mut word = own;
    for group in plan.groups {
        let at = offset(l, body, motion, group.instant);
        let (mut offsets, part) = parted(l, at);
        let weights = Weights::of(l, part);
        let mut found = l.splat(0);
        while let Some((mirror, [right, down])) = offsets.next() {
            let four = four(l, rows, [block.at[0] + right, block.at[1] + down]);
            let mut code = l.and(weights.interpolate(l, four), l.splat(CODE));
            if rough && !group.whole {
                let one = one_of(l, four, part, turns(body, group));
                code = l.choose(is_rough(l, four, part), one, code);
            }
            found = l.choose(offsets.alike(l, mirror), code, found);
        }
        word = l.merge(l.splat(group.mask), found, word);
    }
    word
}

/// Words of any block, taken whole.
#[inline(always)]
fn words<L: Lanes>(
    l: L,
    rows: &Rows,
    plan: &Plan<'_>,
    body: &Body,
    block: Block,
    motion: [L::V; 2],
    own: L::V,
) -> L::V {
    let mut word = own;
    for group in plan.groups {
        let [x, y] = offset(l, body, motion, group.instant);
        let (mut offsets, _) = parted(l, [l.add(x, l.splat(32)), l.add(y, l.splat(32))]);
        let mut found = l.splat(0);
        while let Some((mirror, [right, down])) = offsets.next() {
            let there = rows.load(l, WORD, rows.index([block.at[0] + right, block.at[1] + down]));
            found = l.choose(offsets.alike(l, mirror), there, found);
        }
        word = l.merge(l.splat(group.mask), found, word);
    }
    word
}

/// How much each neighbour of places counts.
struct Weights<L: Lanes> {
    /// For the pixels of the lower and of the upper half of each 16 bytes: bytes for the left and right neighbour.
    columns: [L::V; 2],
    /// Twice the part of a row, of 65536.
    rows: [L::V; 2],
}

impl<L: Lanes> Weights<L> {
    #[inline(always)]
    fn of(l: L, part: [L::V; 2]) -> Self {
        let columns = l.or(l.sub(l.splat(64), part[0]), l.shl::<8>(part[0]));
        let rows = l.shl::<9>(part[1]);
        Self {
            columns: [l.spread::<0>(columns), l.spread::<1>(columns)],
            rows: [l.spread::<0>(rows), l.spread::<1>(rows)],
        }
    }

    /// The codes between four words: left and right above, left and right below. A sum of two rows is that of the upper one
    /// and a part of their difference, and a floor of that part is as good as the part, since the rest are whole numbers.
    #[inline(always)]
    fn interpolate(&self, l: L, [a, b, c, d]: [L::V; 4]) -> L::V {
        let upper = [l.low8(a, b), l.high8(a, b)];
        let lower = [l.low8(c, d), l.high8(c, d)];
        let mut codes = upper;
        for i in 0..2 {
            let (above, below) = (l.pairs8(upper[i], self.columns[i]), l.pairs8(lower[i], self.columns[i]));
            let apart = l.sub16(below, above);
            let code = l.add16(above, l.upper16(l.add16(apart, apart), self.rows[i]));
            codes[i] = l.shr16::<6>(l.add16(code, l.splat(0x20_0020)));
        }
        l.pack16(codes[0], codes[1])
    }
}

/// What is added to places before they are cut off where codes are rough.
#[inline(always)]
pub(super) fn turns(body: &Body, group: &Group) -> [i32; 2] {
    [0, 1].map(|c| if body.mover.in_turn[c] == 1 { group.turn[c] } else { 32 })
}

/// The word of the neighbour that a place reaches by `turn`.
#[inline(always)]
fn one_of<L: Lanes>(l: L, [a, b, c, d]: [L::V; 4], part: [L::V; 2], turn: [i32; 2]) -> L::V {
    let right = l.greater(l.add(part[0], l.splat(turn[0])), l.splat(63));
    let down = l.greater(l.add(part[1], l.splat(turn[1])), l.splat(63));
    l.choose(down, l.choose(right, d, c), l.choose(right, b, a))
}

/// True where a neighbour that counts is rough.
#[inline(always)]
fn is_rough<L: Lanes>(l: L, [a, b, c, d]: [L::V; 4], part: [L::V; 2]) -> L::M {
    let zero = l.splat(0);
    let (right, down) = (l.greater(part[0], zero), l.greater(part[1], zero));
    let lower = l.or(c, l.choose(right, d, zero));
    let any = l.or(l.or(a, l.choose(right, b, zero)), l.choose(down, lower, zero));
    l.greater(zero, l.and(any, l.splat(WORD_ROUGH as i32)))
}
