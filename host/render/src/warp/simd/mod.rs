//! The warp by vectors, for x86-64: the bits of [`Drawn::word`], a block of eight or sixteen mirrors of a row at a time.
//!
//! A block is one of three kinds ([`rows::Around`]). Where nothing that moves is near, it stays as it was drawn. Where all that
//! is near is one mover, every lookup finds it, and what is left is interpolation (`pure`). Else all is done that the plain
//! twin does, for all mirrors of the block at once (`mixed`).
//!
//! What is done with registers stands in functions that are always inlined, and in no closure: a closure is a function of its own,
//! compiled for any CPU, and would call each instruction.
//!
//! No block gathers. Mirrors of a block that look in the same direction by as many whole pixels take neighbours from
//! neighbours, so that one load serves all of them, and mostly that is all there is.
#![allow(unsafe_code)]

mod lanes;
mod mixed;
mod pure;
mod rows;

use super::gather::{has_whole_codes, start_of, turn_of, Drawn};
use dpm_shaders::structs::{Mover, PlaneGroup, OWNER_STILL, WORD_ROUGH};
use lanes::{Avx2, Avx512, Lanes};
use rows::{Around, Rows, MOST_REACH, OWNER_AND_DEPTH, WORD};
use std::ops::Range;

/// Most numbers in a register.
const MOST_LANES: usize = 16;
/// Most movers in whose areas a block can lie; else the plain twin takes it.
const MOST_NEAR: usize = 4;

/// A group of planes.
#[derive(Clone, Copy)]
struct Group {
    mask: i32,
    instant: i32,
    /// The group shows whole codes, which may always be interpolated.
    whole: bool,
    /// What the frame adds to places that it takes in turn.
    turn: [i32; 2],
}

/// A body that moves.
#[derive(Clone, Copy)]
struct Body {
    mover: Mover,
    owner: u32,
    /// Points that move by more than this during the exposure, in 1/64 pixel, may come from rows that are not kept.
    limit: i32,
    /// Wherever it is looked for by `start_of`, the place is in rows that are kept.
    is_near: bool,
}

impl Body {
    /// True if all pixels within `reach` of a block of `count` pixels, and those to their right and below, lie in its area.
    #[inline(always)]
    fn holds(&self, [x, y]: [i32; 2], count: i32, reach: i32) -> bool {
        let Mover { lower, upper, .. } = &self.mover;
        x - reach >= lower[0]
            && x + count + reach < upper[0]
            && y - reach >= lower[1]
            && y + reach + 1 < upper[1]
    }

    /// Which columns its area has.
    #[inline(always)]
    fn columns<L: Lanes>(&self, l: L, x: L::V) -> L::M {
        let Mover { lower, upper, .. } = &self.mover;
        l.except(l.greater(l.splat(upper[0]), x), l.greater(l.splat(lower[0]), x))
    }

    /// Which rows its area has.
    #[inline(always)]
    fn rows<L: Lanes>(&self, l: L, y: L::V) -> L::M {
        let Mover { lower, upper, .. } = &self.mover;
        l.except(l.greater(l.splat(upper[1]), y), l.greater(l.splat(lower[1]), y))
    }

    /// Which pixels lie in its area.
    #[inline(always)]
    fn within<L: Lanes>(&self, l: L, x: L::V, y: L::V) -> L::M {
        l.both(self.columns(l, x), self.rows(l, y))
    }
}

/// A frame's warp, and the memory for it.
#[derive(Default)]
pub(super) struct Vectors {
    rows: Rows,
    groups: Vec<Group>,
    bodies: Vec<Body>,
    steps: pure::Steps,
}

impl Vectors {
    /// Warps with AVX2. False where there is none.
    pub(super) fn warp_avx2(&mut self, drawn: &Drawn<'_>, groups: &[PlaneGroup], words: &mut [u32]) -> bool {
        let Some(lanes) = Avx2::new() else { return false };
        if let Some(mut work) = self.prepare(drawn, groups) {
            // SAFETY: the CPU has AVX2, of which `lanes` is the proof.
            unsafe { run_avx2(lanes, &mut work, words) };
        }
        true
    }

    /// Warps with AVX-512. False where there is none.
    pub(super) fn warp_avx512(
        &mut self,
        drawn: &Drawn<'_>,
        groups: &[PlaneGroup],
        words: &mut [u32],
    ) -> bool {
        let Some(lanes) = Avx512::new() else { return false };
        if let Some(mut work) = self.prepare(drawn, groups) {
            // SAFETY: the CPU has AVX-512 F and BW, of which `lanes` is the proof.
            unsafe { run_avx512(lanes, &mut work, words) };
        }
        true
    }

    /// What is known before the first row. `None`: nothing moves.
    fn prepare<'a>(&'a mut self, drawn: &'a Drawn<'a>, plain: &'a [PlaneGroup]) -> Option<Work<'a>> {
        let hull = |c: usize| {
            let lower = drawn.movers.iter().map(|m| m.lower[c]).min()?;
            let upper = drawn.movers.iter().map(|m| m.upper[c]).max()?;
            (lower < upper).then_some(lower..upper)
        };
        let (columns, rows) = (hull(0)?, hull(1)?);
        self.groups.clear();
        self.groups.extend(plain.iter().zip(0..).map(|(group, number)| Group {
            mask: group.mask as i32,
            instant: group.instant,
            whole: has_whole_codes(group.mask),
            turn: turn_of(drawn.before, number),
        }));
        let needed = drawn.movers.iter().map(|m| reach_of(m, plain)).max().unwrap_or(0);
        let reach = needed.clamp(1, i64::from(MOST_REACH)) as i32;
        self.bodies.clear();
        self.bodies.extend(drawn.movers.iter().zip(OWNER_STILL + 1..).map(|(mover, owner)| {
            // Two roundings may add one unit.
            let most = i64::from(64 * reach - 1) << 16;
            let limit = (most / span_of(mover, plain).max(1)).min(1 << 16) as i32;
            Body { mover: *mover, owner, limit, is_near: fastest(mover) <= limit }
        }));
        self.rows.begin(columns.clone(), rows.clone(), reach);
        self.steps.forget();
        let masks = plain.iter().fold(0, |masks, group| masks | group.mask) as i32;
        let Self { rows: kept, groups, bodies, steps } = self;
        Some(Work {
            rows: kept,
            steps,
            plan: Plan { drawn, plain, groups, bodies, masks },
            columns,
            lines: rows,
        })
    }
}

/// What all blocks of a frame have in common.
#[derive(Clone, Copy)]
struct Plan<'a> {
    drawn: &'a Drawn<'a>,
    plain: &'a [PlaneGroup],
    groups: &'a [Group],
    bodies: &'a [Body],
    /// All bits that groups show.
    masks: i32,
}

/// The longest time between the instant for which the body is drawn and that of a group, in 2^-16 of the exposure.
fn span_of(mover: &Mover, groups: &[PlaneGroup]) -> i64 {
    groups.iter().map(|g| (i64::from(g.instant) - i64::from(mover.instant)).abs()).max().unwrap_or(0)
}

/// The fastest motion along columns or rows that [`start_of`] tells anywhere in the area of a mover. It is affine, so that is
/// in a corner.
fn fastest(mover: &Mover) -> i32 {
    let corner = |i: usize| {
        let of = |c: usize| if i >> c & 1 == 0 { mover.lower[c] } else { mover.upper[c] - 1 };
        start_of(mover, [of(0), of(1)]).map(i32::abs).into_iter().max()
    };
    (0..4).filter_map(corner).max().unwrap_or(0)
}

/// Rows up and down in which a mover's points are looked up, and one more, since their own motion may differ a little.
fn reach_of(mover: &Mover, groups: &[PlaneGroup]) -> i64 {
    ((i64::from(fastest(mover)) * span_of(mover, groups)) >> 22) + 2
}

/// The rest of a frame's warp.
struct Work<'a> {
    rows: &'a mut Rows,
    steps: &'a mut pure::Steps,
    plan: Plan<'a>,
    columns: Range<i32>,
    lines: Range<i32>,
}

#[target_feature(enable = "avx2")]
fn run_avx2(lanes: Avx2, work: &mut Work<'_>, words: &mut [u32]) {
    run(lanes, work, words);
}

#[target_feature(enable = "avx512f,avx512bw")]
fn run_avx512(lanes: Avx512, work: &mut Work<'_>, words: &mut [u32]) {
    run(lanes, work, words);
}

#[inline(always)]
fn run<L: Lanes>(l: L, work: &mut Work<'_>, words: &mut [u32]) {
    let width = work.plan.drawn.raster.width() as usize;
    let first = work.columns.start & -(L::N as i32);
    for y in work.lines.clone() {
        work.rows.advance(work.plan.drawn, y);
        let row = &mut words[y as usize * width..][..width];
        let to_end = &mut row[first as usize..work.columns.end as usize];
        let (mut near, mut until) = (Near::default(), i32::MIN);
        let mut stretch = Stretch::NONE;
        for (block, x) in to_end.chunks_mut(L::N).zip((first..).step_by(L::N)) {
            if x >= until {
                (near, until) = Near::of(work.plan.bodies, [x, y], L::N as i32);
                stretch = Stretch::NONE;
            }
            if near.count > 0 {
                warp_block(l, work, &near, &mut stretch, [x, y], block);
            }
        }
    }
}

/// Blocks of a row around which the same is.
#[derive(Clone, Copy)]
struct Stretch {
    /// Blocks that begin from this column on are others.
    until: i32,
    kind: Kind,
}

#[derive(Clone, Copy)]
enum Kind {
    Still,
    /// All is of the mover with this number in the plan; some words may be rough.
    Pure(usize, bool),
    Mixed,
}

impl Stretch {
    const NONE: Self = Self { until: i32::MIN, kind: Kind::Mixed };

    /// The stretch that begins with a block of `count` pixels, near `bodies`.
    #[inline(always)]
    fn of(rows: &Rows, plan: &Plan<'_>, near: &[u8], at: [i32; 2], count: i32) -> Self {
        let bodies = || near.iter().map(|&number| &plan.bodies[usize::from(number)]);
        let all_near_but = |owner: u32| bodies().all(|body| body.is_near || body.owner == owner);
        let (around, until) = rows.around(at, count, rows.reach);
        let until = if until == i32::MAX { until } else { until.saturating_sub(count + rows.reach) };
        match around {
            Around::Still if all_near_but(0) => Self { until, kind: Kind::Still },
            Around::Mover { owner, rough } if all_near_but(owner) => {
                let number = (owner - OWNER_STILL - 1) as usize;
                match plan.bodies.get(number).filter(|body| body.holds(at, count, rows.reach)) {
                    Some(body) => {
                        let inside = body.mover.upper[0] - count - rows.reach;
                        Self { until: until.min(inside), kind: Kind::Pure(number, rough) }
                    }
                    None => Self::NONE,
                }
            }
            _ => Self::NONE,
        }
    }
}

/// The movers in whose areas a block has pixels.
#[derive(Default)]
struct Near {
    numbers: [u8; MOST_NEAR],
    count: usize,
}

impl Near {
    /// The movers near a block of `count` pixels, and the column up to which the same are near blocks that follow.
    fn of(bodies: &[Body], at: [i32; 2], count: i32) -> (Self, i32) {
        let (mut near, mut until) = (Self::default(), i32::MAX);
        for (number, Body { mover, .. }) in bodies.iter().enumerate() {
            let is_in_row = at[1] >= mover.lower[1] && at[1] < mover.upper[1];
            if !is_in_row || at[0] >= mover.upper[0] {
                continue;
            }
            if at[0] + count <= mover.lower[0] {
                until = until.min(mover.lower[0] - count + 1);
                continue;
            }
            until = until.min(mover.upper[0]);
            if near.count < MOST_NEAR {
                near.numbers[near.count] = number as u8;
            }
            near.count += 1;
        }
        (near, until)
    }
}

/// Warps the pixels of a block that lie in the area of a mover.
#[inline(always)]
fn warp_block<L: Lanes>(
    l: L,
    work: &mut Work<'_>,
    near: &Near,
    stretch: &mut Stretch,
    at: [i32; 2],
    words: &mut [u32],
) {
    let Work { rows, steps, plan, .. } = work;
    let Some(numbers) = near.numbers.get(..near.count) else {
        return plain_block(plan, at, words);
    };
    if at[0] >= stretch.until {
        *stretch = Stretch::of(rows, plan, numbers, at, L::N as i32);
    }
    let block = Block { at, index: rows.index(at) };
    let done = match stretch.kind {
        Kind::Still => Some(still_block(l, rows, plan, block)),
        Kind::Pure(number, rough) => pure::warp(l, rows, steps, plan, &plan.bodies[number], block, rough),
        Kind::Mixed => None,
    };
    let result = match done {
        Some(result) => result,
        None => mixed::warp(l, rows, plan, numbers, block),
    };
    store(l, plan.bodies, numbers, at, result, words);
}

/// Where a block is: its first pixel, and that pixel's index in the rows that are kept.
#[derive(Clone, Copy)]
struct Block {
    at: [i32; 2],
    index: usize,
}

/// Stores what lies in the area of a mover.
#[inline(always)]
fn store<L: Lanes>(l: L, all: &[Body], near: &[u8], at: [i32; 2], result: L::V, words: &mut [u32]) {
    let last = at[0] + L::N as i32 - 1;
    let holds = |number: &u8, x: i32| {
        let mover = &all[usize::from(*number)].mover;
        x >= mover.lower[0] && x < mover.upper[0]
    };
    if words.len() == L::N && near.iter().any(|number| holds(number, at[0]) && holds(number, last)) {
        return l.store(result, words);
    }
    let mut new = [0; MOST_LANES];
    l.store(result, &mut new);
    for ((word, new), x) in words.iter_mut().zip(new).zip(at[0]..) {
        if near.iter().any(|number| holds(number, x)) {
            *word = new;
        }
    }
}

/// The block by the plain twin.
#[cold]
fn plain_block(plan: &Plan<'_>, [x, y]: [i32; 2], words: &mut [u32]) {
    for (word, x) in words.iter_mut().zip(x..) {
        if plan.drawn.movers.iter().any(|mover| super::gather::within(mover, [x, y])) {
            *word = plan.drawn.word([x, y], plan.plain);
        }
    }
}

/// Words as they were drawn, without the marks of what is rough.
#[inline(always)]
fn unmarked<L: Lanes>(l: L, plan: &Plan<'_>, word: L::V) -> L::V {
    if plan.drawn.are_codes {
        l.and(word, l.splat(!(WORD_ROUGH as i32)))
    } else {
        word
    }
}

/// A block near which nothing moves: what stands shows its own bits, and nothing shows none.
#[inline(always)]
fn still_block<L: Lanes>(l: L, rows: &Rows, plan: &Plan<'_>, block: Block) -> L::V {
    let word = rows.load(l, WORD, block.index);
    let owner = l.shr::<24>(rows.load(l, OWNER_AND_DEPTH, block.index));
    let shown = l.choose(l.equal(owner, l.splat(OWNER_STILL as i32)), word, l.splat(0));
    l.merge(l.splat(plan.masks), shown, unmarked(l, plan, word))
}

/// How far points have moved at an instant that move by `motion` during the exposure, in 1/64 pixel.
#[inline(always)]
fn moved_by<L: Lanes>(l: L, motion: L::V, instant: i32) -> L::V {
    l.sar::<16>(l.add(l.mul(motion, l.splat(instant)), l.splat(32768)))
}

/// How far from their mirrors points are drawn that reach them at `instant`, in 1/64 pixel.
#[inline(always)]
fn offset<L: Lanes>(l: L, body: &Body, motion: [L::V; 2], instant: i32) -> [L::V; 2] {
    let [x, y] = motion;
    let drawn = [moved_by(l, x, body.mover.instant), moved_by(l, y, body.mover.instant)];
    [l.sub(drawn[0], moved_by(l, x, instant)), l.sub(drawn[1], moved_by(l, y, instant))]
}

/// The motions of pixels, to the right and down.
#[inline(always)]
fn motions<L: Lanes>(l: L, motion: L::V) -> [L::V; 2] {
    [l.sar::<16>(l.shl::<16>(motion)), l.sar::<16>(motion)]
}

/// Bits of all mirrors of a block.
const fn all_of<L: Lanes>() -> u32 {
    u32::MAX >> (32 - L::N)
}

/// By how many whole pixels the places that mirrors of a block show are off. Those of mirrors that are off by as many are
/// neighbours like the mirrors, so that one load serves all of them.
struct Offsets<L: Lanes> {
    /// One number for both directions: rows in the upper half, columns in the lower.
    keys: L::V,
    list: [u32; MOST_LANES],
    /// Bits of the mirrors that are not served yet.
    left: u32,
}

impl<L: Lanes> Offsets<L> {
    /// Those of `mirrors`, given as bits, whose places are off by `whole` pixels.
    #[inline(always)]
    fn of(l: L, whole: [L::V; 2], mirrors: u32) -> Self {
        let keys = l.or(l.shl::<16>(whole[1]), l.and(whole[0], l.splat(0xffff)));
        let mut list = [0; MOST_LANES];
        l.store(keys, &mut list);
        Self { keys, list, left: mirrors }
    }

    /// A mirror that is not served yet, and by how many columns and rows its place is off.
    #[inline(always)]
    fn next(&self) -> Option<(u32, [i32; 2])> {
        if self.left == 0 {
            return None;
        }
        let mirror = self.left.trailing_zeros();
        let key = self.list[mirror as usize] as i32;
        Some((mirror, [key << 16 >> 16, key >> 16]))
    }

    /// All mirrors whose places are off by as much as that of `mirror`. They are served now.
    #[inline(always)]
    fn alike(&mut self, l: L, mirror: u32) -> L::M {
        let same = l.equal(self.keys, l.splat(self.list[mirror as usize] as i32));
        self.left &= !l.bits(same);
        same
    }

    /// This mirror alone, which is the one of [`Offsets::next`]. It is served now.
    #[inline(always)]
    fn alone(&mut self, l: L, mirror: u32) -> L::M {
        self.left &= self.left - 1;
        l.equal(l.numbers(), l.splat(mirror as i32))
    }
}
