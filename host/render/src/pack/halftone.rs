//! Code values into halftones, for frames that show each code value in several parts of a few bits.
//!
//! Displays that carry one bit a plane, and sequences with one exposure time for all planes, give no plane more light
//! than another: every plane is a part of one bit. A controller that shows several pictures of a few bits in a frame has
//! parts of as many bits. Grey is then the sum of the parts. `k` parts of `b` bits add up to `s = k (2^b - 1)`, so a mirror
//! has `s + 1` levels; what is lost by that is shared out over each block of 8 x 8 mirrors and over time:
//!
//! - The parts of a mirror of code value `c` add up to `floor(c s / 255)`, or to one more. The number of mirrors with one
//!   more is that which gives the block its mean; two frames, an even and an odd one, round it by different amounts. So the
//!   mean level of a block differs by at most `0.75 * 255 / (64 s)` in a frame and by at most `0.25 * 255 / (64 s)` over two
//!   frames: with 8 planes by 0.38 and 0.13 levels of 255. Three parts of eight bits are exact: each is the code value.
//! - Which mirrors have one more is decided by the remainder plus blue noise in space and time (\[Wolfe22\]), so what
//!   remains of the pattern has no low frequencies.
//! - The noise is fixed to a body that moves, so the values that a point of its surface meets follow one another in time.
//! - All parts of a mirror are the same number or one more. Which parts have one more follows one order for all mirrors, so
//!   the parts of a smaller sum are among those of a larger one. The order begins at another part in every cell of 4 x 4
//!   mirrors, so all parts of an even field give equal light.
//!
//! The order and the cells are there for bodies that move. Every part is then shown at its own instant, moved by whole
//! mirrors, so a surface point shows parts of its own mirror and of those beside it. Where these are in one cell, their
//! parts add up as if they were of one mirror; if each mirror began at a part of its own, the sum of such a mixture would be
//! a matter of chance. Cells that begin at the same part lie evenly among the others, so that no part shifts the centre of
//! what is seen. Where they begin is drawn within that, so that no speed makes an eye that rests see one part all the time.
//!
//! Where the highest bit of a code value is split into equal planes (`PlaneSchedule::split_rgb24`), each of these is a part of
//! one bit, and the bits below are shown once, as they are. What a sum has of whole parts goes to the equal planes by the same
//! order, which begins at the second of them in every cell and in every frame. Orders that differ from cell to cell would put the
//! light of one level at different instants, which an eye that rests sees as noise of a passing picture; orders that differ from
//! frame to frame would follow one another at a fraction of the frame rate, which eyes see sooner. Planes that follow a body are not taken from the
//! words of mirrors then, whose low bits would not add up with those of a mirror beside it: each takes the code value of the
//! body's place, and [`Halftone::cut`] gives it a level by noise that a whole cell of the body shares.
//!
//! Everything is integer arithmetic, so `shaders/glsl/halftone.comp` gives the same words.

use crate::blue_noise;
use dpm_device::planes::{Parts, PlaneSchedule, Raster};
use dpm_shaders::specialization as ids;

/// Mirrors in a row of a block.
const SIDE: usize = 8;
/// Mirrors in a row of a cell, in which all mirrors begin at the same part.
const CELL: u32 = 4;
/// What is added to the sum of a block's remainders before it is divided by 255, in even and in odd frames: a quarter
/// and three quarters.
const ROUNDING: [u32; 2] = [63, 191];

/// How the parts of a frame show grey.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Halftone {
    /// Parts of each channel, at least 2.
    pub parts: u32,
    /// Bits of a part. A channel has at most 8 in all its parts, or 24 if there is only white.
    pub depth: u32,
    /// Bits below the parts, which are shown once; see [`Parts::low`].
    pub low: u32,
    /// All planes are white. They show the green code value.
    pub white: bool,
}

impl Halftone {
    /// That of `schedule`; `None` if its planes weigh as the bits of a code value do.
    pub fn of(schedule: &PlaneSchedule) -> Option<Self> {
        let Parts { count, depth, low, white } = schedule.parts()?;
        Some(Self { parts: count.into(), depth: depth.into(), low: low.into(), white })
    }

    /// What the parts of a channel add up to at full light.
    pub const fn most(self) -> u32 {
        ((self.parts * ((1 << self.depth) - 1)) << self.low) + (1 << self.low) - 1
    }

    /// Each part holds a whole code value, so that its bits may be interpolated between pixels.
    pub(crate) const fn is_exact(self) -> bool {
        self.depth == 8
    }

    /// The highest bit is split. Planes that follow take code values then, and cut each into a level where the body is.
    pub fn is_cut(self) -> bool {
        self.low > 0
    }

    /// Specialization constants of the pass.
    pub fn constants(self) -> [(u32, u32); 4] {
        [
            (ids::HALFTONE_PARTS, self.parts),
            (ids::HALFTONE_DEPTH, self.depth),
            (ids::HALFTONE_LOW, self.low),
            (ids::HALFTONE_WHITE, self.white.into()),
        ]
    }

    /// Where each channel's bits begin in a word, and where its code value begins.
    fn channels(self) -> &'static [(u32, u32)] {
        if self.white {
            &[(0, 8)]
        } else {
            &[(0, 0), (8, 8), (16, 16)]
        }
    }

    /// The word of a mirror that shows a place of a body where red, green and blue have the code values `sums / weights`. The place
    /// is counted from the body's centre, in pixels. A channel's level is the one below its code value, or the one above where the
    /// noise of the place's cell in frame `frame` is less than what is left; so the levels of 256 frames or cells have the mean of
    /// the code value, to a 500th of a level. `weights` is 1 to 4096.
    pub(crate) fn cut(self, sums: [u32; 3], weights: u32, place: [i32; 2], frame: u32) -> u32 {
        let cell = place.map(|c| c >> 2);
        let bits = |sum: u32, channel: usize| {
            let noise = 2 * noise(cell, frame, channel) + 1;
            let level = (sum * self.most() + ((noise * weights * 255) >> 9)) / (255 * weights);
            spread(level, self, phase(place, frame, self))
        };
        match self.white {
            true => bits(sums[1], 0),
            false => (0..3).fold(0, |word, c| word | bits(sums[c], c) << (8 * c)),
        }
    }

    /// What the parts of red, green and blue of the word `word` add up to.
    pub(super) fn sums(self, word: u32) -> [u32; 3] {
        let bits = |at: u32, count: u32| word >> at & ((1 << count) - 1);
        let parts = |at: u32| (0..self.parts).map(|p| bits(at + p * self.depth, self.depth)).sum::<u32>();
        let sum = |at: u32| (parts(at + self.low) << self.low) + bits(at, self.low);
        match self.white {
            true => [sum(0); 3],
            false => [0, 8, 16].map(sum),
        }
    }
}

/// The blue noise of a place for a channel's remainders.
fn noise([x, y]: [i32; 2], frame: u32, channel: usize) -> u32 {
    let within = |place: i32| place.rem_euclid(blue_noise::SIZE as i32) as usize;
    // The mask has two channels; the third of a frame is the first, half a mask aside.
    let x = (within(x) + (channel >> 1) * (blue_noise::SIZE / 2)) % blue_noise::SIZE;
    let slice = frame as usize % blue_noise::FRAMES;
    let at = (slice * blue_noise::SIZE + within(y)) * blue_noise::SIZE + x;
    u32::from(blue_noise::MASK[2 * at + (channel & 1)])
}

/// The part at which the order of parts begins at a place: the same in each cell. Of four neighbouring cells each begins in
/// another quarter of the parts, of 16 each in another sixteenth, and so on up to the 256 cells of 64 x 64 places. Which of the
/// four has which quarter is drawn, so that no pattern repeats along a line. Where the highest bit is split, the order is one.
fn phase([x, y]: [i32; 2], frame: u32, how: Halftone) -> u32 {
    if how.is_cut() {
        return 1;
    }
    let [mut x, mut y] = [x, y].map(|c| c.rem_euclid(blue_noise::SIZE as i32) as u32 / CELL);
    let mut rank = 0;
    for level in 0..4 {
        let quarter = ((x ^ y) & 1) << 1 | y & 1;
        (x, y) = (x >> 1, y >> 1);
        rank = rank << 2 | quarter ^ hash_u32(level << 16 | rank << 8 | y << 4 | x) & 3;
    }
    // Five has no divisor in common with any number of parts that there is.
    (rank * how.parts / 256 + 5 * (frame % how.parts)) % how.parts
}

/// `hash_u32` of `shaders/glsl/scene.glsl`.
fn hash_u32(x: u32) -> u32 {
    let x = (x ^ x >> 16).wrapping_mul(0x21f0_aaad);
    let x = (x ^ x >> 15).wrapping_mul(0x735a_2d97);
    x ^ x >> 15
}

/// The order in which parts take one more: as far as possible from those before, by the bits of their numbers in reverse.
fn order(parts: u32) -> impl Iterator<Item = u32> {
    let bits = u32::BITS - (parts - 1).leading_zeros();
    (0..1u32 << bits).map(move |i| i.reverse_bits() >> (u32::BITS - bits)).filter(move |&p| p < parts)
}

/// The bits of a mirror that add up to `sum`: those below the parts, and parts that are all the same number, or one more in some of
/// them, the first of the order that begins at part `phase`.
fn spread(sum: u32, how: Halftone, phase: u32) -> u32 {
    let Halftone { parts, depth, low, .. } = how;
    let (below, sum) = (sum & ((1 << low) - 1), sum >> low);
    let (each, more) = (sum / parts, sum % parts);
    let all = (0..parts).fold(0, |word, p| word | each << (p * depth));
    let all =
        order(parts).take(more as usize).fold(all, |word, p| word + (1 << ((p + phase) % parts * depth)));
    all << low | below
}

/// Code values `0x00BBGGRR` of frame number `frame`, row after row, into words in which each plane of a channel has a
/// bit, the lowest bit of the first part first; see the module. `words` are overwritten.
///
/// # Panics
/// When `codes` or `words` do not hold exactly one value per pixel of `raster`.
pub fn halftone(halftone: Halftone, raster: Raster, frame: u32, codes: &[u32], words: &mut [u32]) {
    halftone_of_bodies(halftone, raster, frame, codes, &|_| [0, 0], words);
}

/// The same with bodies that move. `anchor` gives for the number of a pixel the column and row of the point to which its noise
/// is fixed: the centre of the body that it shows, and `[0, 0]` where nothing moves.
///
/// # Panics
/// As [`halftone()`].
pub fn halftone_of_bodies(
    halftone: Halftone,
    raster: Raster,
    frame: u32,
    codes: &[u32],
    anchor: &dyn Fn(usize) -> [i32; 2],
    words: &mut [u32],
) {
    assert_eq!(
        (codes.len(), words.len()),
        (raster.pixel_count(), raster.pixel_count()),
        "pixels of {raster:?}"
    );
    words.fill(0);
    let (width, height) = (raster.width() as usize, raster.height() as usize);
    for (channel, &(bits_at, code_at)) in halftone.channels().iter().enumerate() {
        for y in (0..height).step_by(SIDE) {
            for x in (0..width).step_by(SIDE) {
                let block = HalftoneBlock { halftone, channel, at: [x, y], raster, frame, anchor };
                block.share_out(codes, code_at, words, bits_at);
            }
        }
    }
}

/// A channel of 8 x 8 mirrors; fewer at the right and lower edge.
struct HalftoneBlock<'a> {
    halftone: Halftone,
    channel: usize,
    at: [usize; 2],
    raster: Raster,
    frame: u32,
    anchor: &'a dyn Fn(usize) -> [i32; 2],
}

impl HalftoneBlock<'_> {
    fn share_out(&self, codes: &[u32], code_at: u32, words: &mut [u32], bits_at: u32) {
        let width = self.raster.width() as usize;
        let [right, lower] = [width, self.raster.height() as usize];
        let mut keys = [0u16; SIDE * SIDE];
        let mut sum = 0;
        let pixels = || {
            (0..SIDE * SIDE)
                .map(|i| (i, self.at[0] + i % SIDE, self.at[1] + i / SIDE))
                .filter(|&(_, x, y)| x < right && y < lower)
        };
        let code = |x: usize, y: usize| codes[y * width + x] >> code_at & 0xff;
        let place = |x: usize, y: usize| {
            let [column, row] = (self.anchor)(y * width + x);
            [x as i32 - column, y as i32 - row]
        };
        for (i, x, y) in pixels() {
            let rest = code(x, y) * self.halftone.most() % 255;
            sum += rest;
            if rest > 0 {
                // Unique, and above 0: the number of the mirror decides between equals.
                keys[i] = ((rest + noise(place(x, y), self.frame, self.channel)) << 6 | i as u32) as u16;
            }
        }
        let extra = (sum + ROUNDING[self.frame as usize & 1]) / 255;
        for (i, x, y) in pixels() {
            let before = keys.iter().filter(|&&key| key > keys[i]).count() as u32;
            let sum = code(x, y) * self.halftone.most() / 255 + u32::from(keys[i] > 0 && before < extra);
            let phase = phase(place(x, y), self.frame, self.halftone);
            words[y * width + x] |= spread(sum, self.halftone, phase) << bits_at;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{pack, BitPlaneFrame, Kernel, Shown};
    use super::*;
    use dpm_device::planes::Channel;
    use proptest::prelude::*;

    /// The words of an even field.
    fn even(schedule: &PlaneSchedule, raster: Raster, number: u32, code: u32) -> Vec<u32> {
        let mut words = vec![u32::MAX; raster.pixel_count()];
        halftone(
            Halftone::of(schedule).unwrap(),
            raster,
            number,
            &vec![code; raster.pixel_count()],
            &mut words,
        );
        words
    }

    fn of_parts(count: u8, depth: u8, white: bool) -> PlaneSchedule {
        PlaneSchedule::of_parts(Parts { count, depth, low: 0, white }).unwrap()
    }

    fn schedules() -> [PlaneSchedule; 10] {
        [
            PlaneSchedule::equal_rgb24(),
            PlaneSchedule::equal_mono8(),
            PlaneSchedule::equal24(),
            of_parts(3, 8, true),
            of_parts(4, 6, true),
            of_parts(6, 4, true),
            of_parts(8, 3, true),
            of_parts(12, 2, true),
            of_parts(2, 4, false),
            of_parts(4, 2, false),
        ]
    }

    #[test]
    fn only_planes_that_do_not_weigh_as_bits_are_halftoned() {
        assert_eq!([PlaneSchedule::rgb24(), PlaneSchedule::mono8()].map(|s| Halftone::of(&s)), [None, None]);
        let halftones = schedules().map(|s| Halftone::of(&s).map(|h| (h.parts, h.depth, h.white)));
        assert_eq!(halftones[..3], [Some((8, 1, false)), Some((8, 1, true)), Some((24, 1, true))]);
        assert_eq!(halftones[3..6], [Some((3, 8, true)), Some((4, 6, true)), Some((6, 4, true))]);
        assert_eq!(halftones.map(|h| h.unwrap().0 * h.unwrap().1 <= 24), [true; 10]);
    }

    /// Three parts of eight bits are the code value three times, whatever the noise.
    #[test]
    fn parts_of_eight_bits_are_the_code_value() {
        let schedule = of_parts(3, 8, true);
        for code in 0..256u32 {
            let words = even(&schedule, Raster::new(9, 5).unwrap(), code, code << 8);
            assert!(words.iter().all(|&word| word == code * 0x01_0101), "{code}");
        }
    }

    /// Dark stays dark and full stays full, whatever the noise; and between them every part has its share: an even
    /// field is equally bright in all of them, to a tenth of its light.
    #[test]
    fn every_part_of_an_even_field_gives_the_same_light() {
        let raster = Raster::new(64, 64).unwrap();
        for schedule in schedules() {
            for (code, share) in
                [(0, 0.0), (0xff_ffff, 1.0), (0x80_8080, 128.0 / 255.0), (0x21_2121, 33.0 / 255.0)]
            {
                let words = even(&schedule, raster, 7, code);
                let mut frame = BitPlaneFrame::new(raster, schedule);
                pack(Kernel::best(), &words, &mut frame);
                let depth = usize::from(schedule.parts().unwrap().depth);
                for part in 0..schedule.len() / depth {
                    let on = |bit: usize| {
                        let ones = frame.plane(part * depth + bit).iter().map(|byte| byte.count_ones());
                        ones.sum::<u32>() << bit
                    };
                    let sum: u32 = (0..depth).map(on).sum();
                    let is = f64::from(sum) / (raster.pixel_count() * ((1 << depth) - 1)) as f64;
                    assert!(
                        (is - share).abs() <= 0.1 * share.min(1.0 - share),
                        "part {part} of {:?}: {is} of {share}",
                        schedule.parts()
                    );
                }
            }
        }
    }

    /// Mirrors of one cell whose sums differ by one differ in one part, so what a moving eye takes from either adds up.
    #[test]
    fn parts_of_a_smaller_sum_are_among_those_of_a_larger_one() {
        for parts in [2, 3, 4, 6, 8, 12, 24] {
            let mut all: Vec<u32> = order(parts).collect();
            all.sort_unstable();
            assert_eq!(all, (0..parts).collect::<Vec<_>>());
            for phase in 0..parts {
                let how = Halftone { parts, depth: 1, low: 0, white: true };
                let words: Vec<u32> = (0..=parts).map(|sum| spread(sum, how, phase)).collect();
                assert!(words.iter().zip(0..).all(|(word, sum)| word.count_ones() == sum), "{words:x?}");
                assert!(words.windows(2).all(|w| w[0] & w[1] == w[0]), "{words:x?}");
            }
        }
    }

    /// Cells that begin at the same part lie evenly: no part of a grey card has its centre far from that of the card.
    /// Beginnings that are drawn at random fail this.
    #[test]
    fn no_part_shifts_the_centre_of_what_is_seen() {
        let raster = Raster::new(320, 240).unwrap();
        let how = Halftone::of(&PlaneSchedule::equal_mono8()).unwrap();
        let ([left, top], [width, height]) = ([41, 63], [200, 100]);
        let inside = |i: usize| {
            let [x, y] = [i % 320, i / 320];
            (left..left + width).contains(&x) && (top..top + height).contains(&y)
        };
        let (mut squares, mut count) = (0.0, 0.0);
        for (code, frame) in [(100, 0), (40, 1), (150, 2), (200, 5)] {
            let codes: Vec<u32> =
                (0..raster.pixel_count()).map(|i| if inside(i) { code << 8 } else { 0 }).collect();
            let mut words = vec![0; codes.len()];
            halftone_of_bodies(how, raster, frame, &codes, &|_| [17, -5], &mut words);
            for part in 0..8 {
                let lit: Vec<usize> = (0..words.len()).filter(|&i| words[i] >> part & 1 == 1).collect();
                let mean = |of: fn(usize) -> usize| {
                    lit.iter().map(|&i| of(i) as f64 + 0.5).sum::<f64>() / lit.len() as f64
                };
                let off = [
                    mean(|i| i % 320) - (left as f64 + width as f64 / 2.0),
                    mean(|i| i / 320) - (top as f64 + height as f64 / 2.0),
                ];
                squares += off[0] * off[0] + off[1] * off[1];
                count += 1.0;
            }
        }
        let off = f64::sqrt(squares / count);
        println!("a part of a grey card of 200 x 100 mirrors is {off:.2} px aside, root mean square");
        assert!(off < 0.9, "{off}");
    }

    /// What is left of the pattern has no low frequencies: sums over 16 x 16 mirrors of an even field differ from one
    /// another by no more than the rounding of their four blocks, where mirrors that draw independently would differ by
    /// dozens.
    #[test]
    fn an_even_field_is_even() {
        let raster = Raster::new(64, 64).unwrap();
        for (code, number) in (1..255).step_by(11).zip(0..) {
            let words = even(&PlaneSchedule::equal_mono8(), raster, number, code << 8);
            let sum = |x: usize, y: usize| {
                (0..256).map(|i| words[(y + i / 16) * 64 + x + i % 16].count_ones()).sum::<u32>()
            };
            let sums: Vec<u32> = (0..16).map(|i| sum(i % 4 * 16, i / 4 * 16)).collect();
            assert!(sums.iter().max().unwrap() - sums.iter().min().unwrap() <= 4, "{code}: {sums:?}");
        }
    }

    /// Words of frame `number` of an even field that shows a body which has moved `by` pixels, with its noise fixed to it.
    fn moved(schedule: &PlaneSchedule, raster: Raster, number: u32, code: u32, by: [i32; 2]) -> Vec<u32> {
        let mut words = vec![0; raster.pixel_count()];
        let how = Halftone::of(schedule).unwrap();
        let codes = vec![code; raster.pixel_count()];
        halftone_of_bodies(how, raster, number, &codes, &|_| by, &mut words);
        words
    }

    /// The pattern goes with the body: bit for bit where the body moves by whole blocks, to any side.
    #[test]
    fn noise_goes_with_the_body() {
        let raster = Raster::new(64, 48).unwrap();
        let schedule = PlaneSchedule::equal_rgb24();
        let still = even(&schedule, raster, 5, 0x33_6690);
        for by in [[8, 0], [-16, 8], [24, -40]] {
            let words = moved(&schedule, raster, 5, 0x33_6690, by);
            for (y, x) in (0..48).flat_map(|y| (0..64).map(move |x| (y, x))) {
                // The noise repeats every 64 places.
                let from = [x - by[0], y - by[1]];
                if (0..64).contains(&from[0]) && (0..48).contains(&from[1]) {
                    assert_eq!(words[(y * 64 + x) as usize], still[(from[1] * 64 + from[0]) as usize]);
                }
            }
        }
    }

    /// An eye that follows a body sees less of the pattern if its noise goes with the body: over four frames the levels of a
    /// surface point are spread by two fifths less, and as much as at rest.
    #[test]
    fn an_eye_that_follows_sees_less_of_the_pattern() {
        let raster = Raster::new(64, 64).unwrap();
        let schedule = PlaneSchedule::equal_mono8();
        let how = Halftone::of(&schedule).unwrap();
        // Root mean square of what the mean of four frames differs by from the code value, in levels of the halftone.
        let residue = |goes: bool, speed: [i32; 2]| {
            let (mut squares, mut points) = (0.0, 0);
            for (code, first) in (3..255u32).step_by(28).zip((0..).step_by(4)) {
                let frames: Vec<Vec<u32>> = (0..4)
                    .map(|i| {
                        let by = speed.map(|v| v * i);
                        moved(&schedule, raster, first + i as u32, code << 8, if goes { by } else { [0, 0] })
                    })
                    .collect();
                let wanted = f64::from(code * how.most()) / 255.0;
                for (y, x) in (0..64).flat_map(|y| (0..64).map(move |x| (y, x))) {
                    // A point that stays in the picture, at its place in each frame.
                    let places = [0, 1, 2, 3].map(|i| [x + speed[0] * i, y + speed[1] * i]);
                    if places.iter().all(|p| p.iter().all(|c| (0..64).contains(c))) {
                        let of = |(p, words): (&[i32; 2], &Vec<u32>)| {
                            how.sums(words[(p[1] * 64 + p[0]) as usize])[0]
                        };
                        let mean = f64::from(places.iter().zip(&frames).map(of).sum::<u32>()) / 4.0;
                        squares += (mean - wanted) * (mean - wanted);
                        points += 1;
                    }
                }
            }
            (squares / f64::from(points)).sqrt()
        };
        let still = residue(true, [0, 0]);
        for speed in [[5, 0], [11, 3], [-7, 6]] {
            let [fixed, going] = [false, true].map(|goes| residue(goes, speed));
            println!("{speed:?} px a frame: {fixed:.3} levels with noise on the raster, {going:.3} with the body, {still:.3} at rest");
            assert!(going < 0.7 * fixed && going < 1.1 * still, "{speed:?}: {fixed}, {going}, {still}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// The law of the module, for any picture: each mirror has one of its two nearest levels, each block its mean.
        #[test]
        fn every_block_keeps_its_mean(width in 1u32..40, height in 1u32..20, seed in any::<u64>(), number in 0u32..1_000_000, kind in 0usize..10) {
            let raster = Raster::new(width, height).unwrap();
            let schedule = schedules()[kind];
            let how = Halftone::of(&schedule).unwrap();
            let mut state = seed;
            let codes: Vec<u32> = (0..raster.pixel_count()).map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 40) as u32
            }).collect();
            let frames = [number & !1, number | 1].map(|number| {
                let mut words = vec![0; codes.len()];
                halftone(how, raster, number, &codes, &mut words);
                words
            });
            let level = |word: u32, channel: usize| how.sums(word)[channel];
            for (channel, &(_, code_at)) in how.channels().iter().enumerate() {
                let wanted = |i: usize| (codes[i] >> code_at & 0xff) * how.most();
                for words in &frames {
                    for (i, word) in words.iter().enumerate() {
                        let (is, low) = (level(*word, channel), wanted(i) / 255);
                        prop_assert!(is == low || is == low + 1 && wanted(i) % 255 != 0, "{is} for {}", wanted(i));
                    }
                }
                for (by, bx) in (0..height.div_ceil(8)).flat_map(|by| (0..width.div_ceil(8)).map(move |bx| (by, bx))) {
                    let pixels: Vec<usize> = (0..64).map(|k| (bx * 8 + k % 8, by * 8 + k / 8))
                        .filter(|&(x, y)| x < width && y < height)
                        .map(|(x, y)| (y * width + x) as usize).collect();
                    let exact = pixels.iter().map(|&i| f64::from(wanted(i)) / 255.0).sum::<f64>();
                    let is = frames.each_ref().map(|words| pixels.iter().map(|&i| f64::from(level(words[i], channel))).sum::<f64>());
                    for is in is {
                        prop_assert!((is - exact).abs() <= 0.75, "{is} of {exact} in a frame");
                    }
                    prop_assert!((is[0] + is[1] - 2.0 * exact).abs() <= 0.5, "{is:?} of {exact} in two frames");
                }
            }
        }

        /// What the recorder takes for the light of a word is what the planes give.
        #[test]
        fn light_of_a_word_is_that_of_its_planes(word in any::<u32>(), kind in 0usize..10) {
            let schedule = schedules()[kind];
            let raster = Raster::new(1, 1).unwrap();
            let mut frame = BitPlaneFrame::new(raster, schedule);
            pack(Kernel::Scalar, &[word], &mut frame);
            let mut light = [0u32; 3];
            for (i, plane) in schedule.planes().iter().enumerate() {
                let on = u32::from(frame.plane(i)[0] >> 7) << plane.bit;
                match plane.channel {
                    Channel::White => light.iter_mut().for_each(|l| *l += on),
                    channel => light[channel as usize] += on,
                }
            }
            let told = Shown::by(&schedule).light(word);
            prop_assert_eq!([0, 8, 16].map(|at| told >> at & 0xff), light.map(|sum| u32::from(schedule.light_of(sum))));
        }
    }
}
