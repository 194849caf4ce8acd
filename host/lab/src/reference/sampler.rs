//! A seed into uniform random numbers: xoshiro256++ of \[Blackman21\], seeded through splitmix64.
//!
//! Independent numbers, not a low-discrepancy sequence: the tests rely on the variance of a mean being sigma^2 / n.

/// A stream of random numbers.
#[derive(Clone, Debug)]
pub(crate) struct Sampler {
    state: [u64; 4],
}

impl Sampler {
    /// Stream `stream` of seed `seed`; different streams are independent.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        let mut x = seed ^ stream.wrapping_mul(0xD134_2543_DE82_EF95).rotate_left(17);
        let mut state = [0; 4];
        for s in &mut state {
            x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = x;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            *s = z ^ (z >> 31);
        }
        Self { state }
    }

    /// The next 64 random bits.
    pub(crate) fn next_u64(&mut self) -> u64 {
        let s = &mut self.state;
        let result = s[0].wrapping_add(s[3]).rotate_left(23).wrapping_add(s[0]);
        let t = s[1] << 17;
        s[2] ^= s[0];
        s[3] ^= s[1];
        s[1] ^= s[2];
        s[0] ^= s[3];
        s[2] ^= t;
        s[3] = s[3].rotate_left(45);
        result
    }

    /// Uniform in 0..1, 1 excluded, 53 bits.
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Two of them.
    pub(crate) fn uniform2(&mut self) -> [f64; 2] {
        [self.uniform(), self.uniform()]
    }
}
