//! A sample's index and dimension into a number: Sobol points with Owen scrambling, in `u32` arithmetic that GLSL repeats bit for bit.
//!
//! Padding as in \[Burley20\]: dimensions come in groups of four; each group takes the first four Sobol dimensions at an index shuffled
//! by a seed of its own, and each dimension is scrambled by a seed of its own. So every group of four is a Sobol point set of every
//! aligned power-of-two block of indices, its first two dimensions a (0, 2)-sequence, and groups are independent of each other.
//! The sequence may be continued over frames: the error of the mean keeps falling faster than with fresh points every frame.

/// Dimensions that [`sobol`] knows.
pub(crate) const DIMENSIONS: usize = 16;

/// Direction numbers: bit `b` of the index adds (exclusive or) `DIRECTIONS[dimension][b]`. The first 4 rows are all that the shaders need.
pub(crate) const DIRECTIONS: [[u32; 32]; DIMENSIONS] = directions();

/// Initial direction numbers of dimensions 1 to 15, chosen by \[JoeKuo08\] for good projections on two dimensions (table 6.21201);
/// as many as the degree of the dimension's polynomial, the rest is zero.
const INITIAL: [[u32; 6]; DIMENSIONS - 1] = [
    [1, 0, 0, 0, 0, 0],
    [1, 3, 0, 0, 0, 0],
    [1, 3, 1, 0, 0, 0],
    [1, 1, 1, 0, 0, 0],
    [1, 1, 3, 3, 0, 0],
    [1, 3, 5, 13, 0, 0],
    [1, 1, 5, 5, 17, 0],
    [1, 1, 5, 5, 5, 0],
    [1, 1, 7, 11, 19, 0],
    [1, 1, 5, 1, 1, 0],
    [1, 1, 1, 3, 11, 0],
    [1, 3, 5, 5, 31, 0],
    [1, 3, 3, 9, 7, 49],
    [1, 1, 1, 15, 21, 21],
    [1, 3, 1, 13, 27, 49],
];

/// The degree of a polynomial over GF(2) given by its bits.
const fn degree(polynomial: u32) -> u32 {
    31 - polynomial.leading_zeros()
}

/// True when x generates all 2^d - 1 powers before it returns to 1, modulo `polynomial` of degree d.
const fn is_primitive(polynomial: u32) -> bool {
    let d = degree(polynomial);
    let order = (1u32 << d) - 1;
    let (mut power, mut k) = (1u32, 0);
    while k < order {
        power <<= 1;
        if power >> d == 1 {
            power ^= polynomial;
        }
        k += 1;
        if power == 1 {
            return k == order;
        }
    }
    false
}

/// The first primitive polynomials over GF(2), by degree and then by their bits.
const fn primitive_polynomials() -> [u32; DIMENSIONS - 1] {
    let mut out = [0; DIMENSIONS - 1];
    let (mut count, mut candidate) = (0, 3);
    while count < out.len() {
        if is_primitive(candidate) {
            out[count] = candidate;
            count += 1;
        }
        candidate += 2; // the constant term is 1
    }
    out
}

/// Runs the recurrence of \[BratleyFox88\] from the initial numbers.
const fn directions() -> [[u32; 32]; DIMENSIONS] {
    let polynomials = primitive_polynomials();
    let mut out = [[0; 32]; DIMENSIONS];
    let mut b = 0;
    while b < 32 {
        out[0][b] = 1 << (31 - b);
        b += 1;
    }
    let mut dimension = 1;
    while dimension < DIMENSIONS {
        let polynomial = polynomials[dimension - 1];
        let d = degree(polynomial) as usize;
        let mut v = [0u32; 32];
        let mut b = 0;
        while b < 32 {
            if b < d {
                v[b] = INITIAL[dimension - 1][b] << (31 - b);
            } else {
                v[b] = v[b - d] ^ (v[b - d] >> d);
                let mut k = 1;
                while k < d {
                    if polynomial >> (d - k) & 1 == 1 {
                        v[b] ^= v[b - k];
                    }
                    k += 1;
                }
            }
            b += 1;
        }
        out[dimension] = v;
        dimension += 1;
    }
    out
}

/// Sobol's point `index` in `dimension` (0 to 15) as a 32-bit fraction of 1. Dimension 0 is the radical inverse of van der Corput.
pub(crate) fn sobol(index: u32, dimension: usize) -> u32 {
    let bits = (0..32).filter(|b| index >> b & 1 == 1);
    bits.fold(0, |x, b| x ^ DIRECTIONS[dimension][b])
}

/// Owen's nested uniform scrambling: whether a bit is flipped is decided by the bits above it and the seed, so every aligned
/// power-of-two interval is carried onto one of its size. A permutation of `u32` for every seed.
///
/// Works on the reversed bits with steps in which a bit can only reach higher ones, after \[LaineKarras11\]; the even constants come from
/// a search for the least avalanche bias.
pub(crate) fn owen_scramble(x: u32, seed: u32) -> u32 {
    let mut x = x.reverse_bits();
    x = x.wrapping_add(seed);
    x ^= x.wrapping_mul(0x641c_a70e);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x6f9e_06c2);
    x ^= x.wrapping_mul(0xb0cf_ba9c);
    x.reverse_bits()
}

/// Mixes two words into a seed in which every bit depends on all of theirs (rounds of multiplication and shift).
pub(crate) fn mix(seed: u32, value: u32) -> u32 {
    let mut x = seed ^ value.wrapping_mul(0x9e37_79b9).wrapping_add(0x7f4a_7c15);
    x = (x ^ (x >> 16)).wrapping_mul(0x85eb_ca6b);
    x = (x ^ (x >> 13)).wrapping_mul(0xc2b2_ae35);
    x = (x ^ (x >> 16)).wrapping_add(value);
    x = (x ^ (x >> 15)).wrapping_mul(0x2c1b_3c6d);
    x ^ (x >> 14)
}

/// Four dimensions of sample `index`: group 0 holds dimensions 0 to 3 of the integrand, group 1 the next four, and so on without end.
pub(crate) fn sample4(index: u32, group: u32, seed: u32) -> [u32; 4] {
    let key = mix(seed, group);
    // Indices below 2^16 share all higher bits, so leaving those out moves every point by the same scramble.
    let shuffled = owen_scramble(index, key) & 0xffff;
    [0, 1, 2, 3].map(|d| owen_scramble(sobol(shuffled, d), mix(key, d as u32 + 1)))
}

/// A 32-bit fraction as a float in [0, 1): the upper 24 bits, so that it never rounds up to 1.
pub(crate) fn to_unit(x: u32) -> f32 {
    (x >> 8) as f32 * (1.0 / 16_777_216.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shaders_have_the_same_direction_numbers() {
        assert_eq!(dpm_shaders::generate::sobol_rows(), [1, 2, 3].map(|d| DIRECTIONS[d]));
    }

    #[test]
    fn polynomials_are_the_known_primitive_ones() {
        assert_eq!(primitive_polynomials(), [3, 7, 11, 13, 19, 25, 37, 41, 47, 55, 59, 61, 67, 91, 97]);
        // x^4 + x^3 + x^2 + x + 1 has no factor, but order 5.
        assert!(!is_primitive(0b11111));
    }

    #[test]
    fn initial_numbers_are_odd_and_small_enough_and_matrices_regular() {
        for (k, (row, polynomial)) in INITIAL.iter().zip(primitive_polynomials()).enumerate() {
            for (i, &m) in row.iter().enumerate() {
                let used = i < degree(polynomial) as usize;
                assert!(if used { m % 2 == 1 && m < 2 << i } else { m == 0 }, "dimension {}", k + 1);
            }
        }
        for (d, row) in DIRECTIONS.iter().enumerate() {
            // Upper triangular with ones on the diagonal: every dimension alone is a (0, 1)-sequence.
            assert!(
                row.iter().enumerate().all(|(b, v)| v.trailing_zeros() as usize == 31 - b),
                "dimension {d}"
            );
        }
    }

    #[test]
    fn first_points_are_those_of_the_literature() {
        // The first eight points in three dimensions, times 8, in the order of the index (not of the Gray code).
        let expected =
            [[0, 0, 0], [4, 4, 4], [2, 6, 6], [6, 2, 2], [1, 5, 3], [5, 1, 7], [3, 3, 5], [7, 7, 1]];
        for (i, point) in expected.iter().enumerate() {
            assert_eq!([0, 1, 2].map(|d| sobol(i as u32, d) >> 29), *point, "index {i}");
        }
    }

    /// Every box of area 2^-m with sides 2^-k and 2^-(m-k) holds one of the 2^m points.
    fn assert_net(points: &[[u32; 2]], what: &str) {
        let m = points.len().ilog2();
        for k in 0..=m {
            let mut hit = vec![false; points.len()];
            for [x, y] in points {
                let cell = |v: u32, bits: u32| if bits == 0 { 0 } else { (v >> (32 - bits)) as usize };
                let i = (cell(*x, k) << (m - k)) | cell(*y, m - k);
                assert!(
                    !std::mem::replace(&mut hit[i], true),
                    "{what}: two points in one box of 2^-{k} x 2^-{}",
                    m - k
                );
            }
        }
    }

    #[test]
    fn the_first_two_dimensions_are_a_net_in_every_aligned_block() {
        for m in 0..9u32 {
            for block in [0u32, 1, 2, 5, 1000] {
                let plain: Vec<_> = (0..1 << m).map(|i| [0, 1].map(|d| sobol((block << m) + i, d))).collect();
                assert_net(&plain, "plain");
                for (group, seed) in [(0, 0), (1, 1), (7, 0xdead_beef)] {
                    let scrambled =
                        (0..1 << m).map(|i| sample4((block << m) + i, group, seed)).map(|p| [p[0], p[1]]);
                    assert_net(&scrambled.collect::<Vec<_>>(), "scrambled");
                }
            }
        }
    }

    #[test]
    fn scrambling_keeps_prefixes_together_and_is_a_permutation() {
        for seed in [0u32, 1, 0xffff_ffff, 0x1234_5678] {
            for (a, b) in (0..2000u32).map(|i| (mix(i, 1), mix(i, 2))) {
                let common = (a ^ b).leading_zeros();
                let after = (owen_scramble(a, seed) ^ owen_scramble(b, seed)).leading_zeros();
                assert_eq!(common, after, "two numbers part at the same bit before and after");
            }
        }
    }

    #[test]
    fn each_bit_is_flipped_by_half_the_seeds_and_by_half_the_bits_above() {
        let n = 4000;
        let mut by_seed = [0i32; 32];
        let mut by_bit = [[0i32; 32]; 32];
        for k in 0..n {
            let (x, seed) = (mix(k, 3), mix(k, 4));
            let y = owen_scramble(x, seed);
            for bit in 0..32 {
                by_seed[bit] += ((x ^ y) >> bit & 1) as i32;
                let changed = y ^ owen_scramble(x ^ (1 << bit), seed);
                (0..bit).for_each(|lower| by_bit[bit][lower] += (changed >> lower & 1) as i32);
            }
        }
        let bias = |count: i32| (f64::from(count) / f64::from(n) - 0.5).abs();
        assert!(by_seed.iter().all(|&c| bias(c) < 0.04), "{by_seed:?}");
        let mean = (0..32).flat_map(|b| by_bit[b][..b].iter()).map(|&c| bias(c)).sum::<f64>() / 496.0;
        assert!(mean < 0.02, "mean avalanche bias {mean}");
    }

    #[test]
    fn the_mean_over_seeds_is_uniform_and_groups_do_not_correlate() {
        let n = 20_000u32;
        let (mut sum, mut square, mut product) = (0.0, 0.0, 0.0);
        for seed in 0..n {
            let a = f64::from(to_unit(sample4(5, 0, seed)[2]));
            let b = f64::from(to_unit(sample4(5, 1, seed)[2]));
            sum += a;
            square += (a - 0.5).powi(2);
            product += (a - 0.5) * (b - 0.5);
        }
        let n = f64::from(n);
        assert!((sum / n - 0.5).abs() < 5.0 / (12.0 * n).sqrt());
        assert!((square / n - 1.0 / 12.0).abs() < 5.0 / (180.0 * n).sqrt());
        assert!((product / n).abs() < 5.0 / (12.0 * n.sqrt()));
    }

    #[test]
    fn error_of_a_smooth_integral_falls_much_faster_than_random() {
        // The integral of prod (1 + (x_d - 1/2)) over four dimensions is 1; its standard deviation is sqrt((13/12)^4 - 1).
        let n = 1024;
        let runs = 32;
        let error = |seed: u32| {
            let value =
                |i: u32| sample4(i, 3, seed).map(|x| 0.5 + f64::from(to_unit(x))).iter().product::<f64>();
            (0..n).map(value).sum::<f64>() / f64::from(n) - 1.0
        };
        let rms = ((0..runs).map(|s| error(mix(s, 9)).powi(2)).sum::<f64>() / f64::from(runs)).sqrt();
        let random = ((13f64 / 12.0).powi(4) - 1.0).sqrt() / f64::from(n).sqrt();
        assert!(rms < random / 20.0, "{rms} against {random} for random points");
    }

    #[test]
    fn one_is_never_reached() {
        assert!(to_unit(u32::MAX) < 1.0 && to_unit(0) == 0.0);
    }
}
