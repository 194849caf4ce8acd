//! Every warp by vectors against the plain twin, bit for bit, on pictures drawn at random.

use super::*;
use dpm_device::planes::Raster;
use dpm_device::rng::Sampler;
use dpm_shaders::structs::{Moved, Mover, OWNER_NONE, OWNER_STILL, WORD_ROUGH};

/// Random numbers of a seed, as pictures need them.
struct Dice(Sampler);

impl Dice {
    fn of(seed: u64) -> Self {
        Self(Sampler::new(seed, 0))
    }

    fn next(&mut self) -> u64 {
        self.0.next_u64()
    }

    /// A number from `low` up to and without `high`.
    fn from(&mut self, low: i32, high: i32) -> i32 {
        low + (self.next() % (high - low) as u64) as i32
    }

    /// True once in so many times.
    fn once_in(&mut self, times: i32) -> bool {
        self.from(0, times) == 0
    }

    fn one_of<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.from(0, all.len() as i32) as usize]
    }
}

/// A frame that was drawn, and the groups of its planes.
struct Picture {
    raster: Raster,
    pixels: Vec<Moved>,
    movers: Vec<Mover>,
    groups: Vec<PlaneGroup>,
    are_codes: bool,
    before: u32,
}

/// Groups of single bits of all channels, of single planes, of whole codes (with a bit beside them that no code has), or of any bits.
fn groups(dice: &mut Dice) -> Vec<PlaneGroup> {
    let masks: Vec<u32> = match dice.from(0, 5) {
        0 | 1 => [4, 6, 7, 5, 3, 2, 1, 0].map(|bit| 0x01_0101 << bit).into(),
        2 => (0..24).map(|bit| 1 << bit).collect(),
        3 => vec![0xff, 0x8000_ff00, 0xff_0000],
        _ => (0..dice.from(0, 6)).map(|_| dice.next() as u32).collect(),
    };
    let first = dice.one_of(&[-65535, -40000, -20000, 0]);
    let step = dice.one_of(&[0, 500, 1700, 5000]);
    masks
        .into_iter()
        .zip(0..)
        .map(|(mask, i)| PlaneGroup { mask, instant: (first + step * i).min(65535) })
        .collect()
}

/// A mover whose area is a part of the raster or all of it.
fn mover(dice: &mut Dice, [width, height]: [i32; 2], fast: i32) -> Mover {
    let mut side = |size: i32| {
        let low = dice.from(0, size);
        if dice.once_in(3) {
            (0, size)
        } else {
            (low, dice.from(low, size) + 1)
        }
    };
    let (columns, rows) = (side(width), side(height));
    let steep = dice.one_of(&[0, 0, 700, 9000]);
    Mover {
        lower: [columns.0, rows.0],
        upper: [columns.1, rows.1],
        centre: [dice.from(0, width), dice.from(0, height)],
        start: [0, 1].map(|_| dice.from(-fast, fast + 1)),
        slope: [0; 4].map(|_| dice.from(-steep, steep + 1)),
        instant: dice.one_of(&[0, 0, 9000, -17000, 30000]),
        in_turn: [0, 1].map(|_| dice.from(0, 2) as u32),
        ..bytemuck::Zeroable::zeroed()
    }
}

/// What the pixels of a picture are like.
struct Look {
    /// Pixels of other owners, words that are no neighbours' and rough words are one in so many; 0: there are none.
    strangers: i32,
    noise: i32,
    rough: i32,
    /// Motions differ from those of the body by so much.
    trembles: i32,
    /// Movers fill their areas, or an ellipse in it.
    fills: bool,
}

fn look(dice: &mut Dice) -> Look {
    Look {
        strangers: dice.one_of(&[0, 0, 3, 40, 1000]),
        noise: dice.one_of(&[0, 1, 10]),
        rough: dice.one_of(&[0, 0, 2, 60]),
        trembles: dice.one_of(&[0, 0, 1, 5, 3000]),
        fills: dice.once_in(2),
    }
}

fn pixel(dice: &mut Dice, at: [i32; 2], movers: &[Mover], look: &Look, are_codes: bool) -> Moved {
    let happens = |dice: &mut Dice, times: i32| times > 0 && dice.once_in(times);
    // What stands reaches to a slanting line.
    let mut owner = if at[0] + 2 * at[1] < 70 { OWNER_STILL } else { OWNER_NONE };
    for (mover, number) in movers.iter().zip(OWNER_STILL + 1..) {
        let from_middle = |c: usize| {
            let half = f64::from(mover.upper[c] - mover.lower[c]) / 2.0;
            (f64::from(at[c] - mover.lower[c]) + 0.5) / half - 1.0
        };
        let is_in = from_middle(0).hypot(from_middle(1)) < 0.8;
        if gather::within(mover, at) && (look.fills || is_in) {
            owner = number;
        }
    }
    if happens(dice, look.strangers) {
        owner = dice.from(0, movers.len() as i32 + 2) as u32;
    }
    let mut motion = [0; 2];
    if owner > OWNER_STILL {
        let mover = &movers[(owner - OWNER_STILL - 1) as usize];
        motion = gather::start_of(mover, at);
        motion = motion.map(|c| (c + dice.from(-look.trembles, look.trembles + 1)).clamp(-32767, 32767));
    }
    let smooth = (at[0] * 3 + at[1] * 5) as u32 & 0xff;
    let mut word = smooth | (255 - smooth) << 8 | (smooth / 2) << 16;
    if happens(dice, look.noise) {
        word = dice.next() as u32 & if are_codes { 0xff_ffff } else { u32::MAX };
    }
    if happens(dice, look.rough) {
        word |= WORD_ROUGH;
    }
    let depth = dice.one_of(&[0, 1, 1, 0xff_fffe, 0xff_ffff]);
    Moved { word, motion: motion_word(motion), owner_and_depth: owner << 24 | depth }
}

fn picture(seed: u64) -> Picture {
    let mut dice = Dice::of(seed);
    let width = dice.one_of(&[1, 7, 8, 15, 16, 17, 40, 64, 96, 131, 200]);
    let height = dice.one_of(&[1, 2, 9, 24, 47]);
    let raster = Raster::new(width as u32, height as u32).unwrap();
    // From none to more than a block takes at once.
    let count = dice.one_of(&[0, 1, 1, 1, 2, 2, 3, 7]);
    let fast = dice.one_of(&[0, 64, 130, 600, 2500]);
    let movers: Vec<Mover> = (0..count).map(|_| mover(&mut dice, [width, height], fast)).collect();
    let look = look(&mut dice);
    let are_codes = !dice.once_in(4);
    let places = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
    let pixels = places.map(|at| pixel(&mut dice, at, &movers, &look, are_codes)).collect();
    Picture { raster, pixels, movers, groups: groups(&mut dice), are_codes, before: dice.next() as u32 }
}

/// Warps a picture by `warper` and compares each mirror.
fn check(warper: &mut Warper, picture: &Picture, name: &str) {
    let Picture { raster, pixels, movers, groups, are_codes, before } = picture;
    let drawn = Drawn { raster: *raster, pixels, movers, are_codes: *are_codes, before: *before };
    let former: Vec<u32> = (0..raster.pixel_count() as u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
    let mut words = former.clone();
    warper.warp(&drawn, groups, &mut words);
    for (i, (&word, &former)) in words.iter().zip(&former).enumerate() {
        let width = raster.width() as usize;
        let at = [(i % width) as i32, (i / width) as i32];
        let moves = movers.iter().any(|mover| within(mover, at));
        let expected = if moves { drawn.word(at, groups) } else { former };
        assert_eq!(word, expected, "{name}, {raster:?} at {at:?}: {word:08x} for {expected:08x}");
    }
}

#[test]
fn every_kernel_warps_as_the_plain_twin_does() {
    let count = if cfg!(miri) { 6 } else { 1500 };
    for &kernel in Kernel::available() {
        // One for all, as a rig has it: nothing of a former picture may be left.
        let mut warper = Warper::new(kernel);
        for seed in 0..count {
            check(&mut warper, &picture(seed), &format!("{kernel:?}, picture {seed}"));
        }
    }
}

/// A motion as pixels hold it.
fn motion_word(motion: [i32; 2]) -> u32 {
    (motion[0] as u32 & 0xffff) | (motion[1] as u32) << 16
}

/// Eight bits whose instants lie before and after the frame's.
fn eight_groups(apart: i32) -> Vec<PlaneGroup> {
    (0..8).map(|bit| PlaneGroup { mask: 0x01_0101 << bit, instant: (bit - 4) * apart }).collect()
}

/// A mover whose area is all of `raster`.
fn mover_of_all(raster: Raster, start: [i32; 2]) -> Mover {
    let upper = [raster.width(), raster.height()].map(|c| c as i32);
    Mover { upper, start, ..bytemuck::Zeroable::zeroed() }
}

/// One or two bodies that fill the raster and move evenly and alike, by any fraction of a pixel along columns and rows, and are drawn for
/// instants of their own. Frames with other instants follow one another.
#[test]
fn every_fraction_of_a_pixel_is_interpolated_alike() {
    let raster = Raster::new(140, 24).unwrap();
    for &kernel in Kernel::available() {
        let mut warper = Warper::new(kernel);
        for turn in 0..if cfg!(miri) { 1 } else { 64 } {
            let mut dice = Dice::of(turn);
            let start = [turn as i32 * 5 % 64 - 32, 3 * (turn as i32 - 32)];
            let of = |dice: &mut Dice| dice.next() as u32 & 0xff_ffff;
            let owner = |i: usize| OWNER_STILL + if turn % 2 == 0 || i % 140 < 70 { 1 } else { 2 };
            let motion = motion_word(start);
            let pixels: Vec<Moved> = (0..raster.pixel_count())
                .map(|i| Moved { word: of(&mut dice), motion, owner_and_depth: owner(i) << 24 })
                .collect();
            for apart in [16000, -9000] {
                let mover = |instant: i32| Mover { instant, ..mover_of_all(raster, start) };
                let (pixels, movers) = (pixels.clone(), vec![mover(0), mover(19000)]);
                let groups = eight_groups(apart);
                let picture = Picture { raster, pixels, movers, groups, are_codes: true, before: 0 };
                check(&mut warper, &picture, &format!("{kernel:?}, {start:?}, {apart}"));
            }
        }
    }
}

/// A wide body has an edge at each column, or is rough from there on: what is around its blocks is looked at for many of them at
/// once, and no longer holds there.
#[test]
fn what_is_around_blocks_ends_at_any_column() {
    let raster = Raster::new(160, 36).unwrap();
    for &kernel in Kernel::available() {
        let mut warper = Warper::new(kernel);
        for edge in 96..if cfg!(miri) { 98 } else { 130 } {
            for (motion, beyond) in [([-800, 30], 0), ([-330, -90], 1), ([300, 0], 2), ([-300, 100], 2)] {
                let mut dice = Dice::of(edge);
                let pixels = (0..raster.pixel_count() as u64).map(|i| {
                    let is_beyond = i % 160 >= edge;
                    let owner = if is_beyond && beyond < 2 { beyond } else { OWNER_STILL + 1 };
                    let mark = if is_beyond && beyond == 2 && i / 160 % 2 == 0 { WORD_ROUGH } else { 0 };
                    let word = dice.next() as u32 & 0xff_ffff | mark;
                    Moved { word, motion: motion_word(motion), owner_and_depth: owner << 24 }
                });
                let (pixels, movers) = (pixels.collect(), vec![mover_of_all(raster, motion)]);
                let groups = eight_groups(16000);
                let picture = Picture { raster, pixels, movers, groups, are_codes: true, before: 5 };
                check(&mut warper, &picture, &format!("{kernel:?}, edge {edge}, {motion:?}, {beyond}"));
            }
        }
    }
}

/// A body that is fast comes from farther than the rows and columns around a block tell of, over another body or a wall.
#[test]
fn a_body_comes_from_far_away() {
    let raster = Raster::new(200, 70).unwrap();
    for &kernel in Kernel::available() {
        let mut warper = Warper::new(kernel);
        for (fast, behind) in
            [[-4000, 0], [0, -3000], [-4000, 2500]].into_iter().zip([OWNER_STILL + 1, OWNER_STILL, 0])
        {
            let mut dice = Dice::of(7);
            let pixels = (0..raster.pixel_count() as i32).map(|i| {
                let is_fast = i % 200 > 110 || i / 200 > 40;
                let (owner, motion) = if is_fast { (OWNER_STILL + 2, fast) } else { (behind, [20, 10]) };
                let depth = if is_fast { 5 } else { 900 };
                let word = dice.next() as u32 & 0xff_ffff;
                Moved { word, motion: motion_word(motion), owner_and_depth: owner << 24 | depth }
            });
            let pixels = pixels.collect();
            let movers = [[20, 10], fast].map(|start| mover_of_all(raster, start)).into();
            let groups = eight_groups(16000);
            let picture = Picture { raster, pixels, movers, groups, are_codes: true, before: 5 };
            check(&mut warper, &picture, &format!("{kernel:?}, {fast:?}"));
        }
    }
}

/// What a mover's slopes tell far from its middle is cut off at what a pixel can hold.
#[test]
fn a_body_is_looked_for_no_farther_than_pixels_can_tell() {
    let raster = Raster::new(90, 20).unwrap();
    for &kernel in Kernel::available() {
        for [start, steep] in [[32000, 131_072], [-32000, -131_072]] {
            let mut dice = Dice::of(11);
            let pixels = (0..raster.pixel_count()).map(|_| {
                let owner = OWNER_STILL + dice.from(0, 2) as u32;
                let motion = motion_word([dice.from(-32767, 32768), dice.from(-3000, 3000)]);
                Moved {
                    word: dice.next() as u32 & 0xff_ffff,
                    motion,
                    owner_and_depth: owner << 24 | (9 - owner),
                }
            });
            let pixels = pixels.collect();
            let slope = [steep, 0, steep, steep];
            let movers = vec![Mover { slope, ..mover_of_all(raster, [start, start]) }];
            // What is cut off makes another pixel the nearest at the first of these instants.
            let groups = eight_groups(109);
            let picture = Picture { raster, pixels, movers, groups, are_codes: true, before: 5 };
            check(&mut Warper::new(kernel), &picture, &format!("{kernel:?}, {start}"));
        }
    }
}
