//! Text into pixels: three by five dots a character, for the legends of pictures.

/// Columns and rows of a character.
const SIZE: [usize; 2] = [3, 5];
/// From one character to the next, dots.
pub(crate) const ADVANCE: usize = SIZE[0] + 1;
/// From one line to the next, dots.
pub(crate) const LINE: usize = SIZE[1] + 2;

/// Five rows of three dots, the first row in the highest bits; small letters look like capitals, what is not here like a space.
fn dots(c: char) -> u16 {
    match c.to_ascii_uppercase() {
        '0' => 0b111_101_101_101_111,
        '1' => 0b010_110_010_010_111,
        '2' => 0b111_001_111_100_111,
        '3' => 0b111_001_111_001_111,
        '4' => 0b101_101_111_001_001,
        '5' => 0b111_100_111_001_111,
        '6' => 0b111_100_111_101_111,
        '7' => 0b111_001_001_010_010,
        '8' => 0b111_101_111_101_111,
        '9' => 0b111_101_111_001_111,
        'A' => 0b010_101_111_101_101,
        'B' => 0b110_101_110_101_110,
        'C' => 0b011_100_100_100_011,
        'D' => 0b110_101_101_101_110,
        'E' => 0b111_100_110_100_111,
        'F' => 0b111_100_110_100_100,
        'G' => 0b011_100_101_101_011,
        'H' => 0b101_101_111_101_101,
        'I' => 0b111_010_010_010_111,
        'J' => 0b001_001_001_101_010,
        'K' => 0b101_101_110_101_101,
        'L' => 0b100_100_100_100_111,
        'M' => 0b101_111_111_101_101,
        'N' => 0b110_101_101_101_101,
        'O' => 0b010_101_101_101_010,
        'P' => 0b110_101_110_100_100,
        'Q' => 0b010_101_101_111_011,
        'R' => 0b110_101_110_101_101,
        'S' => 0b011_100_010_001_110,
        'T' => 0b111_010_010_010_010,
        'U' => 0b101_101_101_101_111,
        'V' => 0b101_101_101_101_010,
        'W' => 0b101_101_111_111_101,
        'X' => 0b101_101_010_101_101,
        'Y' => 0b101_101_010_010_010,
        'Z' => 0b111_001_010_100_111,
        '.' => 0b000_000_000_000_010,
        ',' => 0b000_000_000_010_100,
        '-' => 0b000_000_111_000_000,
        '+' => 0b000_010_111_010_000,
        '=' => 0b000_111_000_111_000,
        '/' => 0b001_001_010_100_100,
        '(' => 0b010_100_100_100_010,
        ')' => 0b010_001_001_001_010,
        ':' => 0b000_010_000_010_000,
        _ => 0,
    }
}

/// Calls `dot` with column and row of every dot of `text` that is set; lines end at `\n`.
pub(crate) fn for_each_dot(text: &str, mut dot: impl FnMut(usize, usize)) {
    for (row, line) in text.lines().enumerate() {
        for (column, c) in line.chars().enumerate() {
            let bits = dots(c);
            for y in 0..SIZE[1] {
                for x in 0..SIZE[0] {
                    if bits >> (14 - (y * SIZE[0] + x)) & 1 == 1 {
                        dot(column * ADVANCE + x, row * LINE + y);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_characters_look_alike() {
        let all: Vec<char> = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ.,-+=/():".chars().collect();
        for (i, &a) in all.iter().enumerate() {
            assert_ne!(dots(a), 0, "{a}");
            for &b in &all[i + 1..] {
                assert_ne!(dots(a), dots(b), "{a} {b}");
            }
        }
    }

    #[test]
    fn an_l_stands_where_it_belongs() {
        let mut set = Vec::new();
        for_each_dot("\n L", |x, y| set.push((x, y)));
        let (x, y) = (ADVANCE, LINE);
        assert_eq!(
            set,
            [(x, y), (x, y + 1), (x, y + 2), (x, y + 3), (x, y + 4), (x + 1, y + 4), (x + 2, y + 4)]
        );
    }
}
