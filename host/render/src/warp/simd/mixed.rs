//! Blocks on silhouettes and at the borders of areas: all that the plain twin does, for all mirrors at once.

use super::lanes::Lanes;
use super::pure::turns;
use super::rows::{Rows, MOTION, OWNER_AND_DEPTH, WORD};
use super::{all_of, motions, offset, unmarked, Block, Body, Group, Offsets, Plan, MOST_LANES};
use dpm_shaders::structs::{Moved, OWNER_NONE, OWNER_STILL, WORD_ROUGH};

/// A block, and the pixels that it has itself.
#[derive(Clone, Copy)]
struct Own<'a, L: Lanes> {
    rows: &'a Rows,
    plan: &'a Plan<'a>,
    block: Block,
    x: L::V,
    y: L::V,
    word: L::V,
    motion: [L::V; 2],
    owner: L::V,
    depth: L::V,
    /// In the area of a mover.
    inside: L::M,
}

/// What mirrors show at an instant.
#[derive(Clone, Copy)]
struct Found<L: Lanes> {
    /// The owner of the nearest surface, `OWNER_NONE` where there is none.
    owner: L::V,
    depth: L::V,
    /// Where it is drawn, from the mirror on, in 1/64 pixel.
    at: [L::V; 2],
}

/// A pixel beside a place, where it is in the area of the mover.
#[derive(Clone, Copy)]
struct Neighbour<L: Lanes> {
    is_there: L::M,
    word: L::V,
    owner_and_depth: L::V,
}

/// The block's words.
#[inline(always)]
pub(super) fn warp<L: Lanes>(l: L, rows: &Rows, plan: &Plan<'_>, near: &[u8], block: Block) -> L::V {
    let owner_and_depth = rows.load(l, OWNER_AND_DEPTH, block.index);
    let (x, y) = (l.add(l.numbers(), l.splat(block.at[0])), l.splat(block.at[1]));
    let mut inside = l.greater(x, x);
    for &number in near {
        let body = &plan.bodies[usize::from(number)];
        inside = l.either(inside, body.within(l, x, y));
    }
    let own: Own<'_, L> = Own {
        rows,
        plan,
        block,
        x,
        y,
        word: rows.load(l, WORD, block.index),
        motion: motions(l, rows.load(l, MOTION, block.index)),
        owner: l.shr::<24>(owner_and_depth),
        depth: l.and(owner_and_depth, l.splat(0xff_ffff)),
        inside,
    };
    let mut word = unmarked(l, plan, own.word);
    for group in plan.groups {
        let mut found = own.still(l);
        for &number in near {
            let body = &plan.bodies[usize::from(number)];
            found = own.nearer(l, body, group, found);
        }
        let mut there = l.choose(l.equal(found.owner, l.splat(OWNER_STILL as i32)), own.word, l.splat(0));
        for &number in near {
            let body = &plan.bodies[usize::from(number)];
            let shown = l.equal(found.owner, l.splat(body.owner as i32));
            if l.bits(shown) != 0 {
                there = l.choose(shown, own.word_of(l, body, group, found.at, shown), there);
            }
        }
        there = own.uncovered(l, group, found, there);
        word = l.merge(l.splat(group.mask), there, word);
    }
    word
}

impl<L: Lanes> Own<'_, L> {
    /// What is there if nothing moves.
    #[inline(always)]
    fn still(&self, l: L) -> Found<L> {
        let (zero, still) = (l.splat(OWNER_NONE as i32), l.splat(OWNER_STILL as i32));
        let stands = l.equal(self.owner, still);
        Found {
            owner: l.choose(stands, still, zero),
            depth: l.choose(stands, self.depth, l.splat(i32::MAX)),
            at: [zero; 2],
        }
    }

    /// Which of `wanted` the pixels `off` beside them in the area of `body` are there, and their fields.
    #[inline(always)]
    fn look<const K: usize>(
        &self,
        l: L,
        body: &Body,
        fields: [usize; K],
        off: [L::V; 2],
        wanted: L::M,
    ) -> (L::M, [L::V; K]) {
        let within = body.within(l, l.add(self.x, off[0]), l.add(self.y, off[1]));
        let wanted = l.both(wanted, within);
        let mut out = [l.splat(0); K];
        let mut offsets = Offsets::of(l, off, l.bits(wanted));
        while let Some((first, off)) = offsets.next() {
            let at = [self.block.at[0] + off[0], self.block.at[1] + off[1]];
            if self.rows.keeps(off) {
                let same = offsets.alike(l, first);
                let index = self.rows.index(at);
                for (out, field) in out.iter_mut().zip(fields) {
                    *out = l.choose(same, self.rows.load(l, field, index), *out);
                }
            } else {
                let here = offsets.alone(l, first);
                let far = self.far([at[0] + first as i32, at[1]]);
                for (out, field) in out.iter_mut().zip(fields) {
                    *out = l.choose(here, l.splat(far[field] as i32), *out);
                }
            }
        }
        (wanted, out)
    }

    /// The pixels in the area of `body` between which places are, where they are `wanted`: left and right above, left and right
    /// below.
    #[inline(always)]
    fn look_at_four(&self, l: L, body: &Body, at: [L::V; 2], wanted: L::M) -> [Neighbour<L>; 4] {
        let (one, zero) = (l.splat(1), l.splat(0));
        let off = [l.sar::<6>(at[0]), l.sar::<6>(at[1])];
        let (left, above) = (l.add(self.x, off[0]), l.add(self.y, off[1]));
        let (right, below) = (l.add(left, one), l.add(above, one));
        let [left, right] = [body.columns(l, left), body.columns(l, right)];
        let [above, below] = [l.both(wanted, body.rows(l, above)), l.both(wanted, body.rows(l, below))];
        let is_there = [l.both(left, above), l.both(right, above), l.both(left, below), l.both(right, below)];
        let mut four = [Neighbour { is_there: is_there[0], word: zero, owner_and_depth: zero }; 4];
        for (neighbour, is_there) in four.iter_mut().zip(is_there) {
            neighbour.is_there = is_there;
        }
        let mut offsets = Offsets::of(l, off, l.bits(wanted));
        while let Some((first, off)) = offsets.next() {
            let at = [self.block.at[0] + off[0], self.block.at[1] + off[1]];
            if self.rows.keeps(off) {
                let same = offsets.alike(l, first);
                let (above, below) = (self.rows.index(at), self.rows.index([at[0], at[1] + 1]));
                for (neighbour, index) in four.iter_mut().zip([above, above + 1, below, below + 1]) {
                    neighbour.word = l.choose(same, self.rows.load(l, WORD, index), neighbour.word);
                    let owner_and_depth = self.rows.load(l, OWNER_AND_DEPTH, index);
                    neighbour.owner_and_depth = l.choose(same, owner_and_depth, neighbour.owner_and_depth);
                }
            } else {
                let here = offsets.alone(l, first);
                for (i, neighbour) in four.iter_mut().enumerate() {
                    if l.bits(neighbour.is_there) >> first & 1 == 1 {
                        let [word, _, owner_and_depth] =
                            self.far([at[0] + (first + i as u32 % 2) as i32, at[1] + i as i32 / 2]);
                        neighbour.word = l.choose(here, l.splat(word as i32), neighbour.word);
                        let owner_and_depth = l.splat(owner_and_depth as i32);
                        neighbour.owner_and_depth =
                            l.choose(here, owner_and_depth, neighbour.owner_and_depth);
                    }
                }
            }
        }
        four
    }

    /// The fields of a pixel of a row that is not kept.
    #[cold]
    fn far(&self, [x, y]: [i32; 2]) -> [u32; 3] {
        let drawn = self.plan.drawn;
        let Moved { word, motion, owner_and_depth } =
            drawn.pixels[y as usize * drawn.raster.width() as usize + x as usize];
        [word, motion, owner_and_depth]
    }

    /// `found`, and what of `body` is nearer.
    #[inline(always)]
    fn nearer(&self, l: L, body: &Body, group: &Group, found: Found<L>) -> Found<L> {
        let number = l.splat(body.owner as i32);
        let inside = body.within(l, self.x, self.y);
        let is_here = l.both(inside, l.equal(self.owner, number));
        let elsewhere = l.except(inside, is_here);
        let (mut near, mut motion) = (is_here, self.motion);
        if l.bits(elsewhere) != 0 {
            let at = offset(l, body, self.start_of(l, body), group.instant);
            let (there, [moves, of]) =
                self.look(l, body, [MOTION, OWNER_AND_DEPTH], nearest(l, at), elsewhere);
            let hit = l.both(there, l.equal(l.shr::<24>(of), number));
            let moves = motions(l, moves);
            motion = choose_two(l, hit, moves, motion);
            near = l.either(near, hit);
        }
        if l.bits(near) == 0 {
            return found;
        }
        let at = offset(l, body, motion, group.instant);
        let (there, [of]) = self.look(l, body, [OWNER_AND_DEPTH], nearest(l, at), near);
        let depth = l.and(of, l.splat(0xff_ffff));
        let wins = l.both(l.both(there, l.equal(l.shr::<24>(of), number)), l.greater(found.depth, depth));
        Found {
            owner: l.choose(wins, number, found.owner),
            depth: l.choose(wins, depth, found.depth),
            at: choose_two(l, wins, at, found.at),
        }
    }

    /// How a body moves at the mirrors, about.
    #[inline(always)]
    fn start_of(&self, l: L, body: &Body) -> [L::V; 2] {
        let mover = &body.mover;
        let x = l.sub(self.x, l.splat(mover.centre[0]));
        let y = l.sub(self.y, l.splat(mover.centre[1]));
        let mut starts = [x; 2];
        for (c, start) in starts.iter_mut().enumerate() {
            let along = l.mul(l.splat(mover.slope[2 * c]), x);
            let sum = l.add(along, l.mul(l.splat(mover.slope[2 * c + 1]), y));
            let sum = l.add(l.splat(mover.start[c]), l.sar::<12>(sum));
            *start = l.min(l.max(sum, l.splat(-32767)), l.splat(32767));
        }
        starts
    }

    /// The words of `body` at places, where they are `wanted`.
    #[inline(always)]
    fn word_of(&self, l: L, body: &Body, group: &Group, at: [L::V; 2], wanted: L::M) -> L::V {
        if !self.plan.drawn.are_codes {
            return self.look(l, body, [WORD], nearest(l, at), wanted).1[0];
        }
        let (zero, number) = (l.splat(0), l.splat(body.owner as i32));
        let part = [l.and(at[0], l.splat(63)), l.and(at[1], l.splat(63))];
        let rest = [l.sub(l.splat(64), part[0]), l.sub(l.splat(64), part[1])];
        let four = self.look_at_four(l, body, at, wanted);
        let (mut weights, mut any, mut sums) = (zero, zero, [zero; 3]);
        for (i, Neighbour { is_there, word, owner_and_depth }) in four.into_iter().enumerate() {
            let weight = l.pairs16(
                if i % 2 == 1 { part[0] } else { rest[0] },
                if i / 2 == 1 { part[1] } else { rest[1] },
            );
            let shows = l.both(is_there, l.equal(l.shr::<24>(owner_and_depth), number));
            let weight = l.choose(shows, weight, zero);
            weights = l.add(weights, weight);
            any = l.or(any, l.choose(l.greater(weight, zero), word, zero));
            let byte = l.splat(0xff);
            sums[0] = l.add(sums[0], l.pairs16(weight, l.and(word, byte)));
            sums[1] = l.add(sums[1], l.pairs16(weight, l.and(l.shr::<8>(word), byte)));
            sums[2] = l.add(sums[2], l.pairs16(weight, l.and(l.shr::<16>(word), byte)));
        }
        let code = mean(l, weights, sums);
        let rough = l.both(wanted, l.greater(zero, l.and(any, l.splat(WORD_ROUGH as i32))));
        if group.whole || l.bits(rough) == 0 {
            return code;
        }
        let turn = turns(body, group);
        let off = [l.add(at[0], l.splat(turn[0])), l.add(at[1], l.splat(turn[1]))];
        let off = [l.sar::<6>(off[0]), l.sar::<6>(off[1])];
        let (there, [word, of]) = self.look(l, body, [WORD, OWNER_AND_DEPTH], off, rough);
        let shows = l.both(there, l.equal(l.shr::<24>(of), number));
        let (_, [near]) = self.look(l, body, [WORD], nearest(l, at), l.except(rough, shows));
        l.choose(rough, l.choose(shows, word, near), code)
    }

    /// `there`, and what is seen where a body has left and nothing was found.
    #[inline(always)]
    fn uncovered(&self, l: L, group: &Group, found: Found<L>, mut there: L::V) -> L::V {
        let left = l.both(self.inside, l.greater(self.owner, l.splat(OWNER_STILL as i32)));
        let mut open = l.both(left, l.equal(found.owner, l.splat(OWNER_NONE as i32)));
        let mut owners = [0; MOST_LANES];
        while l.bits(open) != 0 {
            l.store(self.owner, &mut owners);
            let owner = owners[l.bits(open).trailing_zeros() as usize];
            let body = &self.plan.bodies[(owner - OWNER_STILL - 1) as usize];
            let of_body = l.both(open, l.equal(self.owner, l.splat(owner as i32)));
            let at = offset(l, body, self.motion, group.instant);
            let (is, [word, of]) = self.look(l, body, [WORD, OWNER_AND_DEPTH], nearest(l, at), of_body);
            let seen = l.both(is, l.greater(l.shr::<24>(of), l.splat(OWNER_NONE as i32)));
            there = l.choose(seen, word, there);
            open = l.except(open, of_body);
        }
        there
    }
}

/// Numbers of `yes` where `m` is true, else those of `no`.
#[inline(always)]
fn choose_two<L: Lanes>(l: L, m: L::M, yes: [L::V; 2], no: [L::V; 2]) -> [L::V; 2] {
    [l.choose(m, yes[0], no[0]), l.choose(m, yes[1], no[1])]
}

/// The pixels in which places are.
#[inline(always)]
fn nearest<L: Lanes>(l: L, at: [L::V; 2]) -> [L::V; 2] {
    [l.sar::<6>(l.add(at[0], l.splat(32))), l.sar::<6>(l.add(at[1], l.splat(32)))]
}

/// Sums of codes by their weights. Where nothing counts the result means nothing.
#[inline(always)]
fn mean<L: Lanes>(l: L, weights: L::V, sums: [L::V; 3]) -> L::V {
    let half = l.shr::<1>(weights);
    let all = l.splat(4096);
    let is_full = l.bits(l.equal(weights, all)) == all_of::<L>();
    let divisor = l.max(weights, l.splat(1));
    let mut codes = sums;
    for code in &mut codes {
        let sum = l.add(*code, half);
        *code = if is_full { l.shr::<12>(sum) } else { l.quotient(sum, divisor) };
    }
    l.or(codes[0], l.or(l.shl::<8>(codes[1]), l.shl::<16>(codes[2])))
}
