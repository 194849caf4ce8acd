//! Blocks of ETC2 and EAC, as the Khronos Data Format Specification describes them.
//!
//! Own code, since the crate `texture2ddecoder`, which decodes ETC2 alike, reads EAC of 11 bits in the wrong order.

use std::array;

use super::blocks::Square;
use super::numbers::raised;
use dpm_common::rounding::Rounder;

/// What the table of a half adds to its colour: the smaller and the greater step.
const STEPS: [[i32; 2]; 8] = [[2, 8], [5, 17], [9, 29], [13, 42], [18, 60], [24, 80], [33, 106], [47, 183]];

/// How far the colours of the modes T and H lie from those that are stored.
const DISTANCES: [i32; 8] = [3, 6, 11, 16, 23, 32, 41, 64];

/// What EAC adds to its base, in units of its factor.
const MODIFIERS: [[i32; 8]; 16] = [
    [-3, -6, -9, -15, 2, 5, 8, 14],
    [-3, -7, -10, -13, 2, 6, 9, 12],
    [-2, -5, -8, -13, 1, 4, 7, 12],
    [-2, -4, -6, -13, 1, 3, 5, 12],
    [-3, -6, -8, -12, 2, 5, 7, 11],
    [-3, -7, -9, -11, 2, 6, 8, 10],
    [-4, -7, -8, -11, 3, 6, 7, 10],
    [-3, -5, -8, -11, 2, 4, 7, 10],
    [-2, -6, -8, -10, 1, 5, 7, 9],
    [-2, -5, -8, -10, 1, 4, 7, 9],
    [-2, -4, -8, -10, 1, 3, 7, 9],
    [-2, -5, -7, -10, 1, 4, 6, 9],
    [-3, -4, -7, -10, 2, 3, 6, 9],
    [-1, -2, -3, -10, 0, 1, 2, 9],
    [-4, -6, -8, -9, 3, 5, 7, 8],
    [-3, -5, -7, -9, 2, 4, 6, 8],
];

/// A block of ETC2 without alpha.
pub(crate) fn rgb8(block: &[u8]) -> Square {
    Bits::of(block).colours(false)
}

/// A block of ETC2 whose texels are opaque or transparent.
pub(crate) fn rgb8a1(block: &[u8]) -> Square {
    Bits::of(block).colours(true)
}

/// A block of ETC2 with alpha in EAC before it.
pub(crate) fn rgba8(block: &[u8]) -> Square {
    let eac = Eac::of(block);
    let mut texels = Bits::of(&block[8..]).colours(false);
    for (texel, modifier) in texels.iter_mut().zip(eac.modifiers) {
        texel[3] = byte(eac.base + modifier * eac.factor);
    }
    texels
}

/// A block of EAC with red of 11 bits.
pub(crate) fn r11(block: &[u8], signed: bool, rounder: &mut Rounder) -> Square {
    Eac::of(block).numbers(signed).map(|red| [rounder.byte(red), 0, 0, 255])
}

/// A block of EAC with red and green of 11 bits.
pub(crate) fn rg11(block: &[u8], signed: bool, rounder: &mut Rounder) -> Square {
    let [red, green] = [Eac::of(block), Eac::of(&block[8..])].map(|eac| eac.numbers(signed));
    array::from_fn(|i| [rounder.byte(red[i]), rounder.byte(green[i]), 0, 255])
}

/// The nearest byte.
fn byte(number: i32) -> u8 {
    number.clamp(0, 255) as u8
}

/// The place of a texel in the stored order, which runs down the columns, for its place in a [`Square`].
fn stored_place(i: usize) -> usize {
    i % 4 * 4 + i / 4
}

/// The eight bytes of a block, the first on top. Numbers of bits are those of the specification.
#[derive(Clone, Copy)]
struct Bits(u64);

impl Bits {
    fn of(block: &[u8]) -> Self {
        Self(block[..8].iter().fold(0, |bits, byte| bits << 8 | u64::from(*byte)))
    }

    /// The `count` bits from bit `low` upwards.
    fn at(self, low: usize, count: usize) -> i32 {
        (self.0 >> low & ((1 << count) - 1)) as i32
    }

    /// Parts of one number, each by its lowest bit and its count, the uppermost first.
    fn joined(self, parts: &[(usize, usize)]) -> i32 {
        parts.iter().fold(0, |number, (low, count)| number << count | self.at(*low, *count))
    }

    /// The texels of ETC2. With `punched`, the bit that says 'differential' says instead that all texels are opaque.
    fn colours(self, punched: bool) -> Square {
        let bit = self.at(33, 1) == 1;
        let opaque = bit || !punched;
        if !bit && !punched {
            let first = [60, 52, 44].map(|low| widened(self.at(low, 4), 4));
            let second = [56, 48, 40].map(|low| widened(self.at(low, 4), 4));
            return self.halves([first, second], true);
        }
        let first = [59, 51, 43].map(|low| self.at(low, 5));
        // Three bits with a sign.
        let second = [56, 48, 40].map(|low| (self.at(low, 3) ^ 4) - 4);
        let second = array::from_fn(|k| first[k] + second[k]);
        // A sum that five bits do not hold stands for another mode: which channel it is says which.
        match second.iter().position(|sum| !(0..32).contains(sum)) {
            Some(0) => self.painted(self.palette_t(), opaque),
            Some(1) => self.painted(self.palette_h(), opaque),
            Some(_) => self.plane(),
            None => self.halves([first, second].map(|c| c.map(|five| widened(five, 5))), opaque),
        }
    }

    /// Two bits a texel, by its place in a [`Square`].
    fn index(self, i: usize) -> usize {
        let k = stored_place(i);
        self.joined(&[(16 + k, 1), (k, 1)]) as usize
    }

    /// Two halves of one colour each, beside or above each other, that texels make lighter or darker.
    fn halves(self, colours: [[i32; 3]; 2], opaque: bool) -> Square {
        let stacked = self.at(32, 1) == 1;
        let steps = [37, 34].map(|low| STEPS[self.at(low, 3) as usize]);
        array::from_fn(|i| {
            let half = usize::from(if stacked { i >= 8 } else { i % 4 >= 2 });
            let [small, great] = steps[half];
            let step = match (self.index(i), opaque) {
                (0, true) => small,
                (0, false) => 0,
                (1, _) => great,
                (2, true) => -small,
                (2, false) => return [0; 4],
                _ => -great,
            };
            shifted(colours[half], step)
        })
    }

    /// One of four colours for each texel. Where not all are opaque, the third is a hole.
    fn painted(self, palette: [[u8; 4]; 4], opaque: bool) -> Square {
        array::from_fn(|i| match self.index(i) {
            2 if !opaque => [0; 4],
            index => palette[index],
        })
    }

    /// Mode T: one colour by itself, and three in a line around another.
    fn palette_t(self) -> [[u8; 4]; 4] {
        let one = [self.joined(&[(59, 2), (56, 2)]), self.at(52, 4), self.at(48, 4)];
        let other = [44, 40, 36].map(|low| self.at(low, 4));
        let [one, other] = [one, other].map(|c| c.map(|four| widened(four, 4)));
        let far = DISTANCES[self.joined(&[(34, 2), (32, 1)]) as usize];
        [shifted(one, 0), shifted(other, far), shifted(other, 0), shifted(other, -far)]
    }

    /// Mode H: two in a line around each of two colours. The order of these two is one bit of the distance.
    fn palette_h(self) -> [[u8; 4]; 4] {
        let one = [self.at(59, 4), self.joined(&[(56, 3), (52, 1)]), self.joined(&[(51, 1), (47, 3)])];
        let other = [43, 39, 35].map(|low| self.at(low, 4));
        let order = usize::from(one >= other);
        let far = DISTANCES[(self.joined(&[(34, 1), (32, 1)]) as usize) << 1 | order];
        let [one, other] = [one, other].map(|c| c.map(|four| widened(four, 4)));
        [shifted(one, far), shifted(one, -far), shifted(other, far), shifted(other, -far)]
    }

    /// Mode planar: a colour at the first texel, and those that would follow the last of its row and of its column.
    fn plane(self) -> Square {
        let origin = [
            widened(self.at(57, 6), 6),
            widened(self.joined(&[(56, 1), (49, 6)]), 7),
            widened(self.joined(&[(48, 1), (43, 2), (39, 3)]), 6),
        ];
        let across = [
            widened(self.joined(&[(34, 5), (32, 1)]), 6),
            widened(self.at(25, 7), 7),
            widened(self.at(19, 6), 6),
        ];
        let down = [widened(self.at(13, 6), 6), widened(self.at(6, 7), 7), widened(self.at(0, 6), 6)];
        array::from_fn(|i| {
            let (x, y) = (i as i32 % 4, i as i32 / 4);
            let [r, g, b] = array::from_fn(|k| {
                let from = origin[k];
                byte((x * (across[k] - from) + y * (down[k] - from) + 4 * from + 2) >> 2)
            });
            [r, g, b, 255]
        })
    }
}

/// A number of `count` bits as one of 8: its uppermost bits follow it.
fn widened(number: i32, count: usize) -> i32 {
    number << (8 - count) | number >> (2 * count - 8)
}

/// An opaque colour that is made lighter or darker.
fn shifted(colour: [i32; 3], step: i32) -> [u8; 4] {
    let [r, g, b] = colour.map(|channel| byte(channel + step));
    [r, g, b, 255]
}

/// One channel of a block in EAC.
struct Eac {
    base: i32,
    factor: i32,
    /// By the place in a [`Square`].
    modifiers: [i32; 16],
}

impl Eac {
    fn of(block: &[u8]) -> Self {
        let bits = Bits::of(block);
        let row = MODIFIERS[bits.at(48, 4) as usize];
        let modifiers = array::from_fn(|i| row[bits.at(45 - 3 * stored_place(i), 3) as usize]);
        Self { base: bits.at(56, 8), factor: bits.at(52, 4), modifiers }
    }

    /// Numbers of 11 bits as fractions of 1; those with a sign as 0 to 1 for -1 to 1.
    fn numbers(&self, signed: bool) -> [f32; 16] {
        // Factor 0 stands for an eighth.
        let factor = (8 * self.factor).max(1);
        self.modifiers.map(|modifier| {
            if signed {
                let base = i32::from(self.base as u8 as i8).max(-127);
                let number = (8 * base + modifier * factor).clamp(-1023, 1023);
                return raised(number as f32 / 1023.0);
            }
            (8 * self.base + 4 + modifier * factor).clamp(0, 2047) as f32 / 2047.0
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{r11, rg11, rgb8, rgb8a1, rgba8, Rounder, Square};

    /// The bytes of a block with numbers at bits of the specification: the lowest bit, the count, the number.
    fn block(parts: &[(u32, u32, u64)]) -> [u8; 8] {
        let mut bits = 0;
        for (low, count, number) in parts {
            assert!(*number < 1 << count && low + count <= 64, "{number} in {count} bits at {low}");
            assert_eq!(bits & ((1 << count) - 1) << low, 0, "bits at {low} are taken");
            bits |= number << low;
        }
        u64::to_be_bytes(bits)
    }

    /// Indices 0, 1, 2 and 3 from the top of each column to its bottom.
    const ROWS: [(u32, u32, u64); 2] = [(16, 16, 0xcccc), (0, 16, 0xaaaa)];

    /// A block whose rows are of one colour each.
    fn rows(colours: [[u8; 4]; 4]) -> Square {
        std::array::from_fn(|i| colours[i / 4])
    }

    fn solid(colours: [[u8; 3]; 4]) -> [[u8; 4]; 4] {
        colours.map(|[r, g, b]| [r, g, b, 255])
    }

    const HOLE: [u8; 4] = [0; 4];

    #[test]
    fn individual_halves_stand_beside_each_other_or_lie_above_each_other() {
        let colours = [(60, 4, 3), (52, 4, 10), (44, 4, 15), (56, 4, 0), (48, 4, 5), (40, 4, 9)];
        let tables = [(37, 3, 0), (34, 3, 7)];
        let first = solid([[53, 172, 255], [59, 178, 255], [49, 168, 253], [43, 162, 247]]);
        let second = solid([[47, 132, 200], [183, 255, 255], [0, 38, 106], [0, 0, 0]]);
        let beside = block(&[&colours[..], &tables, &ROWS].concat());
        let expected: Square = std::array::from_fn(|i| if i % 4 < 2 { first[i / 4] } else { second[i / 4] });
        assert_eq!(rgb8(&beside), expected);
        let stacked = block(&[&colours[..], &tables, &ROWS, &[(32, 1, 1)]].concat());
        assert_eq!(rgb8(&stacked), rows([first[0], first[1], second[2], second[3]]));
    }

    #[test]
    fn differential_halves_add_a_number_with_a_sign() {
        // 4 - 4, 31 + 0, 16 + 3 of 31.
        let colours = [(59, 5, 4), (56, 3, 4), (51, 5, 31), (48, 3, 0), (43, 5, 16), (40, 3, 3)];
        let rest = [(37, 3, 1), (34, 3, 2), (33, 1, 1), (32, 1, 1)];
        let bytes = block(&[&colours[..], &rest, &ROWS].concat());
        let expected = solid([[38, 255, 137], [50, 255, 149], [0, 246, 147], [0, 226, 127]]);
        assert_eq!(rgb8(&bytes), rows(expected));
        assert_eq!(rgb8a1(&bytes), rows(expected));
        // Without the bit, the small step is none, and the third index a hole.
        let punched = block(&[&colours[..], &rest[..2], &rest[3..], &ROWS].concat());
        let expected = [[33, 255, 132, 255], [50, 255, 149, 255], HOLE, [0, 226, 127, 255]];
        assert_eq!(rgb8a1(&punched), rows(expected));
    }

    #[test]
    fn mode_t_has_a_colour_and_three_in_a_line() {
        let rest = [(52, 4, 3), (48, 4, 12), (44, 4, 1), (40, 4, 8), (36, 4, 15), (34, 2, 2), (32, 1, 1)];
        // Red 9, whose sum is below 0, and 15, whose sum is above 31.
        let below = [(59, 2, 2), (58, 1, 1), (56, 2, 1)];
        let above = [(61, 3, 7), (59, 2, 3), (56, 2, 3)];
        for (red, parts) in [(153, below), (255, above)] {
            let line = solid([[red, 51, 204], [49, 168, 255], [17, 136, 255], [0, 104, 223]]);
            let opaque = block(&[&parts[..], &rest, &ROWS, &[(33, 1, 1)]].concat());
            assert_eq!(rgb8(&opaque), rows(line));
            assert_eq!(rgb8a1(&opaque), rows(line));
            let punched = block(&[&parts[..], &rest, &ROWS].concat());
            assert_eq!(rgb8a1(&punched), rows([line[0], line[1], HOLE, line[3]]));
        }
    }

    #[test]
    fn mode_h_has_two_colours_each_way_and_their_order_counts() {
        // (5, 9, 6) and (12, 2, 7): the sum of green is 30 + 3.
        let parts = [(59, 4, 5), (56, 3, 4), (53, 3, 7), (52, 1, 1), (51, 1, 0), (47, 3, 6)];
        let rest = [(43, 4, 12), (39, 4, 2), (35, 4, 7), (34, 1, 1), (32, 1, 0)];
        let line = solid([[108, 176, 125], [62, 130, 79], [227, 57, 142], [181, 11, 96]]);
        let opaque = block(&[&parts[..], &rest, &ROWS, &[(33, 1, 1)]].concat());
        assert_eq!(rgb8(&opaque), rows(line));
        let punched = block(&[&parts[..], &rest, &ROWS].concat());
        assert_eq!(rgb8a1(&punched), rows([line[0], line[1], HOLE, line[3]]));
        // The same the other way round: the sum of green is 0 - 1, and the distance the next one.
        let parts = [(59, 4, 12), (56, 3, 1), (52, 1, 0), (51, 1, 0), (50, 1, 1), (47, 3, 7)];
        let rest = [(43, 4, 5), (39, 4, 9), (35, 4, 6), (34, 1, 1), (32, 1, 0), (33, 1, 1)];
        let line = solid([[236, 66, 151], [172, 2, 87], [117, 185, 134], [53, 121, 70]]);
        assert_eq!(rgb8(&block(&[&parts[..], &rest, &ROWS].concat())), rows(line));
    }

    #[test]
    fn mode_planar_goes_evenly_from_three_corners() {
        // Red 10, 40 and 5, green 20, 100 and 50, blue 30, 60 and 63: the sum of blue is 31 + 3.
        let origin = [(63, 1, 1), (57, 6, 10), (56, 1, 0), (49, 6, 20), (48, 1, 0), (43, 2, 3), (39, 3, 6)];
        let across = [(45, 3, 7), (34, 5, 20), (32, 1, 0), (25, 7, 100), (19, 6, 60)];
        let down = [(13, 6, 5), (6, 7, 50), (0, 6, 63)];
        let parts = [&origin[..], &across, &down].concat();
        let with_bit = block(&[&parts[..], &[(33, 1, 1)]].concat());
        let texels = rgb8(&with_bit);
        let corners = [texels[0], texels[3], texels[12], texels[15]];
        assert_eq!(corners, solid([[40, 40, 121], [132, 161, 213], [25, 85, 222], [117, 206, 255]]));
        // 40 + 122 / 4 + 2 (20 - 40) / 4, and so on.
        assert_eq!(texels[9], [61, 110, 219, 255]);
        // This mode has no holes.
        assert_eq!(rgb8a1(&with_bit), texels);
        assert_eq!(rgb8a1(&block(&parts)), texels);
    }

    /// A block of EAC whose texels have the indices 0 to 7 down the columns, twice.
    fn eac(base: u64, factor: u64, table: u64) -> [u8; 8] {
        let bits = (0..16).fold(0, |bits, k| (bits << 3) | (k % 8));
        block(&[(56, 8, base), (52, 4, factor), (48, 4, table), (0, 48, bits)])
    }

    /// What the modifiers of a row make, each at its place in a block.
    fn placed(row: [i32; 8], of: impl Fn(i32) -> i32) -> [u8; 16] {
        std::array::from_fn(|i| of(row[(i % 4 * 4 + i / 4) % 8]) as u8)
    }

    const ROW_0: [i32; 8] = [-3, -6, -9, -15, 2, 5, 8, 14];
    const ROW_13: [i32; 8] = [-1, -2, -3, -10, 0, 1, 2, 9];

    #[test]
    fn alpha_stands_before_the_colours() {
        let colours = block(&[(60, 4, 3), (56, 4, 3), (52, 4, 10), (48, 4, 10)]);
        for (base, factor, table, row) in
            [(100, 3, 13, ROW_13), (100, 0, 13, ROW_13), (30, 15, 0, ROW_0), (200, 15, 0, ROW_0)]
        {
            let bytes = [eac(base, factor, table), colours].concat();
            let expected = placed(row, |m| (base as i32 + m * factor as i32).clamp(0, 255));
            assert_eq!(rgba8(&bytes).map(|t| t[3]), expected);
            assert_eq!(rgba8(&bytes).map(|t| [t[0], t[1], t[2], 255]), rgb8(&colours));
        }
    }

    #[test]
    fn eleven_bits_become_the_nearest_eight() {
        for (base, factor, table, row) in [
            (100, 3, 13, ROW_13),
            (100, 0, 0, ROW_0),
            (250, 15, 0, ROW_0),
            (5, 15, 0, ROW_0),
            (128, 15, 0, ROW_0),
            (129, 1, 13, ROW_13),
        ] {
            let step = (8 * factor as i32).max(1);
            let unsigned = placed(row, |m| {
                let number = (8 * base as i32 + 4 + m * step).clamp(0, 2047);
                (number * 510 + 2047) / 4094
            });
            let signed = placed(row, |m| {
                let base = (base as i32 + 128) % 256 - 128;
                let number = (8 * base.max(-127) + m * step).clamp(-1023, 1023);
                ((number + 1023) * 255 + 1023) / 2046
            });
            let bytes = eac(base, factor, table);
            let mut rounder = Rounder::default();
            for (signed, expected) in [(false, unsigned), (true, signed)] {
                assert_eq!(r11(&bytes, signed, &mut rounder), expected.map(|r| [r, 0, 0, 255]), "{base}");
                // Two channels are two blocks.
                let other = eac(7, 2, 4);
                let green = r11(&other, signed, &mut rounder).map(|t| t[0]);
                let both = rg11(&[bytes, other].concat(), signed, &mut rounder);
                assert_eq!(both, std::array::from_fn(|i| [expected[i], green[i], 0, 255]), "{base}");
            }
            assert!(!rounder.cut_off);
        }
    }
}
