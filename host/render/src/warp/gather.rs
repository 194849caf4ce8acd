//! The CPU twin of `shaders/glsl/warp.comp`.

use crate::pack::Halftone;
use dpm_device::planes::Raster;
use dpm_shaders::structs::{Moved, Mover, PlaneGroup, OWNER_NONE, OWNER_STILL, ROUGH_STEP, WORD_ROUGH};

/// A frame as it was drawn, and how its surfaces move.
#[derive(Clone, Copy, Debug)]
pub struct Drawn<'a> {
    /// Size of the picture.
    pub raster: Raster,
    /// What the pass `motion` tells of every pixel.
    pub pixels: &'a [Moved],
    /// The bodies that move.
    pub movers: &'a [Mover],
    /// The words are code values, and what lies between pixels is interpolated. Words of halftones are taken whole.
    pub are_codes: bool,
    /// How code values are cut into the levels of planes whose highest bit is split; else `None`.
    pub cut: Option<Halftone>,
    /// Frames that were drawn before: where code values are rough, each takes the pixels between which a place lies in turn.
    pub before: u32,
}

/// What a mirror shows at an instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct MirrorSource {
    /// The place in the picture that was drawn, in 1/64 pixel; a pixel's centre is a multiple of 64.
    at: [i32; 2],
    /// Who is there; `OWNER_NONE` for a hole, which takes whatever is near.
    owner: u32,
}

/// Motion of a pixel's surface on the raster during the exposure, to the right and down, in 1/64 pixel.
pub fn motion_of(moved: &Moved) -> [i32; 2] {
    [moved.motion as i16, (moved.motion >> 16) as i16].map(i32::from)
}

/// Who owns a pixel: `OWNER_NONE`, `OWNER_STILL`, or the number of a mover, from 1 on, plus `OWNER_STILL`.
pub fn owner_of(moved: &Moved) -> u32 {
    moved.owner_and_depth >> 24
}

/// Distance of a pixel's surface from the projector, in steps that grow with it.
fn depth_of(moved: &Moved) -> u32 {
    moved.owner_and_depth & 0xff_ffff
}

/// The place at which a point of `mover` is drawn that reaches the middle of `pixel` at `instant` and moves by `motion`
/// during the exposure, in 1/64 pixel.
fn source(mover: &Mover, pixel: [i32; 2], motion: [i32; 2], instant: i32) -> [i32; 2] {
    let moved_by = |c: usize, instant: i32| (motion[c] * instant + 32768) >> 16;
    [0, 1].map(|c| (pixel[c] << 6) - moved_by(c, instant) + moved_by(c, mover.instant))
}

/// The pixel in which a place is.
fn nearest(at: [i32; 2]) -> [i32; 2] {
    at.map(|c| (c + 32) >> 6)
}

/// The pixel of a place, counted from a centre.
fn from_centre(at: [i32; 2], centre: [i32; 2]) -> [i32; 2] {
    let pixel = nearest(at);
    [0, 1].map(|c| pixel[c] - centre[c])
}

/// True if the code values `here` are by more than half of [`ROUGH_STEP`] off the middle between those to the left and right, or
/// above and below, in any channel.
pub fn is_rough(here: u32, [left, right, above, below]: [u32; 4]) -> bool {
    let codes = |word: u32| [0, 8, 16].map(|shift| (word >> shift & 0xff) as i32);
    let bends = |a: u32, b: u32| {
        let (a, here, b) = (codes(a), codes(here), codes(b));
        (0..3).any(|c| (a[c] - 2 * here[c] + b[c]).unsigned_abs() > ROUGH_STEP)
    };
    bends(left, right) || bends(above, below)
}

/// What a frame adds to places of group `group` before their fraction is cut off, 0 to 63 in 1/64 pixel: multiples of the
/// golden ratio and of the root of 2, which take all values evenly over the frames.
fn turn_of(before: u32, group: u32) -> [i32; 2] {
    let of = |step: u32, apart: u32| before.wrapping_mul(step).wrapping_add(group.wrapping_mul(apart)) >> 26;
    [of(0x9E37_79B9, 0x61C8_8647), of(0x6A09_E667, 0x3C6E_F372)].map(|turn| turn as i32)
}

/// True if a group of planes shows all bits of each channel that it shows.
pub(super) fn has_whole_codes(mask: u32) -> bool {
    [0, 8, 16].iter().all(|shift| matches!(mask >> shift & 0xff, 0 | 0xff))
}

impl Drawn<'_> {
    /// The word of a mirror whose planes follow: its bits are those of `groups` at their instants, and the bits that no
    /// group shows are as they were drawn.
    ///
    /// # Panics
    /// When the pixel lies outside the raster, or `pixels` is shorter than it.
    pub fn word(&self, pixel: [i32; 2], groups: &[PlaneGroup]) -> u32 {
        let mut word = self.without_mark(self.at(pixel).word);
        for (group, number) in groups.iter().zip(0..) {
            let place = self.place_at(pixel, group.instant);
            let there = place.map_or(0, |place| self.word_at(place, group, number));
            word = (word & !group.mask) | (there & group.mask);
        }
        word
    }

    /// The pixel whose surface is at the mirror `pixel` at `instant`; `None`: nothing is there.
    pub fn source_at(&self, pixel: [i32; 2], instant: i32) -> Option<[i32; 2]> {
        self.place_at(pixel, instant).map(|place| nearest(place.at))
    }

    fn place_at(&self, pixel: [i32; 2], instant: i32) -> Option<MirrorSource> {
        let own = self.at(pixel);
        let owner = owner_of(own);
        let (mut closest, mut found) = (u32::MAX, None);
        if owner == OWNER_STILL {
            (closest, found) = (depth_of(own), Some(MirrorSource { at: pixel.map(|c| c << 6), owner }));
        }
        for (mover, number) in self.movers.iter().zip(OWNER_STILL + 1..) {
            if !within(mover, pixel) {
                continue;
            }
            let of_mover = |at| self.moved_at(mover, nearest(at)).filter(|m| owner_of(m) == number);
            // The point's motion is that of the point that is here now, or of what is about where it comes from.
            let here = (owner == number).then_some(own);
            let near = here.or_else(|| of_mover(source(mover, pixel, start_of(mover, pixel), instant)));
            let Some(near) = near else { continue };
            let at = source(mover, pixel, motion_of(near), instant);
            let Some(there) = of_mover(at) else { continue };
            if depth_of(there) < closest {
                (closest, found) = (depth_of(there), Some(MirrorSource { at, owner: number }));
            }
        }
        if found.is_some() || owner <= OWNER_STILL {
            return found;
        }
        // A body has left this mirror and uncovers what was hidden. What is seen behind its edge goes on here.
        let mover = self.mover_of(owner);
        let at = source(mover, pixel, motion_of(own), instant);
        let behind = self.moved_at(mover, nearest(at));
        behind.filter(|m| owner_of(m) != OWNER_NONE).map(|_| MirrorSource { at, owner: OWNER_NONE })
    }

    /// The word at a place for the planes of a group: that of its pixel, or code values between those of the pixels around it
    /// that show the same body.
    fn word_at(&self, MirrorSource { at, owner }: MirrorSource, group: &PlaneGroup, number: u32) -> u32 {
        if !self.are_codes || owner <= OWNER_STILL {
            return self.shown(self.at(nearest(at)).word, at, [0, 0]);
        }
        let mover = self.mover_of(owner);
        let shows = |pixel| self.moved_at(mover, pixel).filter(|m| owner_of(m) == owner);
        let part = at.map(|c| (c & 63) as u32);
        let (mut weights, mut words, mut sums) = (0, 0, [0; 3]);
        for step in [[0, 0], [1, 0], [0, 1], [1, 1]] {
            let [x, y] = [0, 1].map(|c| if step[c] == 1 { part[c] } else { 64 - part[c] });
            let there = shows([0, 1].map(|c| (at[c] >> 6) + step[c]));
            if let Some(there) = there.filter(|_| x * y > 0) {
                weights += x * y;
                words |= there.word;
                (0..3).for_each(|c| sums[c] += x * y * ((there.word >> (8 * c)) & 0xff));
            }
        }
        // Bits of different groups would be those of codes that the picture does not have, and their sum would be far off.
        if words & WORD_ROUGH != 0 && !has_whole_codes(group.mask) {
            let turn = turn_of(self.before, number);
            let step = [0, 1].map(|c| if mover.in_turn[c] == 1 { turn[c] } else { 32 });
            let there = shows([0, 1].map(|c| (at[c] + step[c]) >> 6));
            return self.shown(there.unwrap_or(self.at(nearest(at))).word, at, mover.centre);
        }
        // The nearest of the four shows the body, so the weights are positive.
        if let Some(halftone) = self.cut {
            return halftone.cut(sums, weights, from_centre(at, mover.centre), self.before);
        }
        let code = |c: usize| ((sums[c] + weights / 2) / weights) << (8 * c);
        code(0) | code(1) | code(2)
    }

    /// What is shown of a pixel's word at a place of a body with this centre.
    fn shown(&self, word: u32, at: [i32; 2], centre: [i32; 2]) -> u32 {
        let codes = [0, 8, 16].map(|shift| word >> shift & 0xff);
        self.cut.map_or(word, |halftone| halftone.cut(codes, 1, from_centre(at, centre), self.before))
    }

    /// A word without the mark of what is rough.
    fn without_mark(&self, word: u32) -> u32 {
        if self.are_codes {
            word & !WORD_ROUGH
        } else {
            word
        }
    }

    fn mover_of(&self, owner: u32) -> &Mover {
        &self.movers[(owner - OWNER_STILL - 1) as usize]
    }

    /// What is at a pixel in the area of `mover`; `None` outside of it.
    fn moved_at(&self, mover: &Mover, pixel: [i32; 2]) -> Option<&Moved> {
        within(mover, pixel).then(|| self.at(pixel))
    }

    fn at(&self, [x, y]: [i32; 2]) -> &Moved {
        &self.pixels[y as usize * self.raster.width() as usize + x as usize]
    }
}

/// True in the area in which the light of `mover` can fall.
pub fn within(mover: &Mover, pixel: [i32; 2]) -> bool {
    (0..2).all(|c| pixel[c] >= mover.lower[c] && pixel[c] < mover.upper[c])
}

/// How the body moves at a pixel, about: all that is known where the pixel does not show it.
fn start_of(mover: &Mover, pixel: [i32; 2]) -> [i32; 2] {
    let [x, y] = [0, 1].map(|c| pixel[c] - mover.centre[c]);
    let of = |c: usize| {
        let slope = [mover.slope[2 * c], mover.slope[2 * c + 1]];
        (mover.start[c] + ((slope[0] * x + slope[1] * y) >> 12)).clamp(-32767, 32767)
    };
    [of(0), of(1)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whatever the fraction of a place, frames take the pixel behind it as often as it is near, to 2.1 frames over any 31 that
    /// an eye collects; and what they take along rows says nothing of columns.
    #[test]
    fn frames_take_pixels_in_turn_as_often_as_they_are_near() {
        for (group, begin) in [(0, 0), (3, 1000), (7, u32::MAX - 7)] {
            for part in [1, 13, 32, 50, 63] {
                let turns: Vec<[bool; 2]> = (0..31u32)
                    .map(|k| turn_of(begin.wrapping_add(k), group).map(|turn| part + turn >= 64))
                    .collect();
                for c in 0..2 {
                    let taken = turns.iter().filter(|t| t[c]).count() as f64;
                    assert!((taken - 31.0 * f64::from(part) / 64.0).abs() <= 2.1, "{group} {part}: {taken}");
                }
            }
        }
        let both = (0..4096).filter(|k| turn_of(*k, 2).iter().all(|turn| *turn >= 32)).count();
        assert!((both as f64 / 4096.0 - 0.25).abs() < 0.01, "{both}");
    }

    #[test]
    fn codes_are_rough_where_they_bend() {
        // A slope is not rough, however steep; a step is, in one channel and in one direction.
        let grey = |code: u32| code * 0x01_0101;
        assert!(!is_rough(grey(100), [grey(20), grey(180), grey(130), grey(70)]));
        assert!(!is_rough(grey(100), [grey(100), grey(148), grey(100), grey(100)]));
        assert!(is_rough(grey(100), [grey(100), grey(149), grey(100), grey(100)]));
        assert!(is_rough(grey(100), [grey(60), grey(140), grey(100), grey(100) - (49 << 16)]));
    }

    /// All pixels of a raster, row by row.
    fn places(raster: Raster) -> impl Iterator<Item = [i32; 2]> {
        let [width, height] = [raster.width(), raster.height()].map(|c| c as i32);
        (0..height).flat_map(move |y| (0..width).map(move |x| [x, y]))
    }

    /// A mover whose area is all of `raster`.
    fn mover_of_all(raster: Raster, start: [i32; 2], instant: i32) -> Mover {
        let upper = [raster.width(), raster.height()].map(|c| c as i32);
        Mover { upper, start, instant, ..bytemuck::Zeroable::zeroed() }
    }

    fn moved(word: u32, [x, y]: [i32; 2], owner: u32, depth: u32) -> Moved {
        Moved { word, motion: (x as u32 & 0xffff) | (y as u32) << 16, owner_and_depth: owner << 24 | depth }
    }

    const BODY: u32 = OWNER_STILL + 1;

    /// The picture of a body is a slope in every channel, and the body moves evenly by any fraction of a pixel along columns and
    /// rows. A mirror shows what the slope is at the place that is there by then: groups of whole codes to half a code and what
    /// rounding the place adds, groups of single bits the bits of the same codes.
    #[test]
    fn every_fraction_of_a_pixel_is_interpolated() {
        let raster = Raster::new(40, 24).unwrap();
        let slope = |[x, y]: [f64; 2]| [20.0 + 2.0 * x + y, 250.0 - 3.0 * x - 2.0 * y, 20.0 + 5.0 * y];
        let steepest = 5.0;
        for turn in 0..64 {
            let motion = [turn * 5 % 64 - 32, 3 * (turn - 32)];
            let codes = places(raster).map(|at| slope(at.map(f64::from)).map(|code| code as u32));
            let pixels: Vec<Moved> =
                codes.map(|[r, g, b]| moved(r | g << 8 | b << 16, motion, BODY, 0)).collect();
            for (drawn_at, apart) in [(0, 16000), (19000, -9000)] {
                let movers = [mover_of_all(raster, motion, drawn_at)];
                let drawn =
                    Drawn { raster, pixels: &pixels, movers: &movers, are_codes: true, cut: None, before: 0 };
                let groups: Vec<PlaneGroup> = (0..8)
                    .map(|bit| PlaneGroup { mask: 0x01_0101 << bit, instant: (bit - 4) * apart })
                    .collect();
                // No place is farther off than a pixel and a half.
                let inner = |[x, y]: &[i32; 2]| (3..37).contains(x) && (3..21).contains(y);
                for at in places(raster).filter(inner) {
                    let bits = drawn.word(at, &groups);
                    for group in &groups {
                        let whole = drawn.word(at, &[PlaneGroup { mask: 0xff_ffff, ..*group }]);
                        assert_eq!(bits & group.mask, whole & group.mask, "{motion:?} at {at:?}");
                        let share = f64::from(group.instant - drawn_at) / 65536.0;
                        let from = [0, 1].map(|c| f64::from(at[c]) - f64::from(motion[c]) / 64.0 * share);
                        for (code, wanted) in [whole, whole >> 8, whole >> 16].into_iter().zip(slope(from)) {
                            let off = (f64::from(code & 0xff) - wanted).abs();
                            assert!(off <= 0.5 + steepest / 64.0, "{motion:?} at {at:?}: off by {off}");
                        }
                    }
                }
            }
        }
    }

    /// The words of halftones are taken whole from the nearest pixel, with all their bits.
    #[test]
    fn halftones_are_not_interpolated() {
        let raster = Raster::new(16, 9).unwrap();
        let motion = [96, -40];
        let word = |[x, y]: [i32; 2]| ((16 * y + x + 1) as u32).wrapping_mul(2_654_435_761);
        let pixels: Vec<Moved> = places(raster).map(|at| moved(word(at), motion, BODY, 0)).collect();
        let movers = [mover_of_all(raster, motion, 0)];
        let drawn =
            Drawn { raster, pixels: &pixels, movers: &movers, are_codes: false, cut: None, before: 0 };
        let groups = [PlaneGroup { mask: 0xff_ffff, instant: 65535 }];
        // The place is 1.5 pixels to the left, which is nearest to the right one of two, and 0.6 pixels below.
        let from = word([8 - 1, 4 + 1]);
        assert_eq!(drawn.word([8, 4], &groups), from & 0xff_ffff | word([8, 4]) & 0xff00_0000);
    }

    /// A body that is fast comes from far away over what is farther, another body, a wall or nothing, and not over what is nearer.
    /// Where it has left mirrors, they show what is seen behind its edge.
    #[test]
    fn a_body_comes_from_far_away() {
        let raster = Raster::new(200, 70).unwrap();
        let is_in = |[x, y]: [i32; 2]| (0..200).contains(&x) && (0..70).contains(&y);
        let is_fast = |at: [i32; 2]| is_in(at) && (at[0] > 110 || at[1] > 40);
        for (fast, behind, is_nearer) in [
            ([-4096, 0], OWNER_STILL + 1, true),
            ([0, -2048], OWNER_STILL, true),
            ([-4096, 2048], OWNER_NONE, true),
            ([-4096, -2048], OWNER_STILL, false),
            ([4096, 2048], OWNER_STILL + 1, false),
        ] {
            let depth = if is_nearer { 5 } else { 2000 };
            let of = |at| match is_fast(at) {
                true => moved(0, fast, OWNER_STILL + 2, depth),
                false => moved(0, [0, 0], behind, 900),
            };
            let pixels: Vec<Moved> = places(raster).map(of).collect();
            let movers = [[0, 0], fast].map(|start| mover_of_all(raster, start, 0));
            let drawn =
                Drawn { raster, pixels: &pixels, movers: &movers, are_codes: true, cut: None, before: 0 };
            let shows = |at: [i32; 2]| is_in(at) && (is_fast(at) || behind != OWNER_NONE);
            // By a 32nd of the exposure the body has moved by one or two pixels.
            for instant in (-16..=16).map(|step| 2048 * step) {
                for at in places(raster) {
                    let from = [0, 1].map(|c| at[c] - ((fast[c] * instant) >> 22));
                    let comes = is_fast(from) && (is_nearer || behind == OWNER_NONE);
                    let source = if is_fast(at) || comes { from } else { at };
                    let wanted = shows(source).then_some(source);
                    assert_eq!(drawn.source_at(at, instant), wanted, "{fast:?}, {instant} at {at:?}");
                }
            }
        }
    }

    /// What a mover's slopes tell far from its middle is cut off at what a pixel can hold.
    #[test]
    fn a_body_is_looked_for_no_farther_than_pixels_can_tell() {
        let start = [32000, -32000];
        let mover = Mover {
            centre: [10, 5],
            start,
            slope: [131_072, 0, 0, -131_072],
            ..bytemuck::Zeroable::zeroed()
        };
        assert_eq!(start_of(&mover, [10, 5]), start);
        assert_eq!(start_of(&mover, [10 - 60, 5 - 3]), [32000 - 32 * 60, -32000 + 32 * 3]);
        assert_eq!(start_of(&mover, [10 + 23, 5 + 23]), [32000 + 32 * 23, -32000 - 32 * 23]);
        assert_eq!(start_of(&mover, [10 + 24, 5 + 24]), [32767, -32767]);
        assert_eq!(start_of(&mover, [10 - 2100, 5 - 2100]), [-32767, 32767]);
    }

    #[test]
    fn groups_of_all_bits_hold_whole_codes() {
        assert!(has_whole_codes(0xff_ffff) && has_whole_codes(0xff00) && has_whole_codes(0));
        assert!(!has_whole_codes(0x80_8080) && !has_whole_codes(0xff_0001));
    }
}
