//! Random numbers from seeds: the only source of randomness in pictures, mocks and experiments.
//!
//! [`Draws`] has no state. With a stateful generator the noise of sample 7 would depend on whether sample 6 was lost.
//! Here each draw is a pure function of (seed, stream, index), so switching on one fault leaves all other faults and
//! the noise unchanged. [`Sampler`] is a stream of numbers, for Monte Carlo integration.

/// A keyed source of draws. Copyable and without state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Draws {
    key: u64,
}

/// Finaliser of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): a bijection of `u64` that passes avalanche tests.
const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

impl Draws {
    /// Draws for `seed`; every seed, 0 included, is as good as another.
    pub const fn new(seed: u64) -> Self {
        Self { key: mix(seed.wrapping_add(GOLDEN)) }
    }

    /// Independent draws for one purpose, body or packet. `a.stream(1).stream(2)` differs from `a.stream(2).stream(1)`.
    pub const fn stream(self, id: u64) -> Self {
        Self { key: mix(self.key ^ mix(id.wrapping_mul(GOLDEN).wrapping_add(1))).wrapping_add(GOLDEN) }
    }

    /// 64 uniform bits for `index`.
    pub const fn bits(self, index: u64) -> u64 {
        mix(self.key.wrapping_add(index.wrapping_mul(GOLDEN)))
    }

    /// Uniform in `[0, 1)`.
    pub fn unit(self, index: u64) -> f64 {
        (self.bits(index) >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// True with probability `p` (0 never, 1 always).
    pub fn happens(self, index: u64, p: f64) -> bool {
        self.unit(index) < p
    }

    /// Standard normal by Box-Muller; uses indices `2 * index` and `2 * index + 1`.
    pub fn normal(self, index: u64) -> f64 {
        // 1 - u is in (0, 1], so the logarithm is finite; largest magnitude 8.6.
        let radius = (-2.0 * libm::log(1.0 - self.unit(2 * index))).sqrt();
        radius * libm::cos(core::f64::consts::TAU * self.unit(2 * index + 1))
    }

    /// Three independent standard normals; uses normals `3 * index` to `3 * index + 2`.
    pub fn normal3(self, index: u64) -> [f64; 3] {
        [self.normal(3 * index), self.normal(3 * index + 1), self.normal(3 * index + 2)]
    }
}

/// A stream of independent random numbers: xoshiro256++ of \[Blackman21\], seeded through splitmix64. It is not a
/// low-discrepancy sequence: the variance of a mean is sigma^2 / n.
#[derive(Clone, Debug)]
pub struct Sampler {
    state: [u64; 4],
}

impl Sampler {
    /// Stream `stream` of seed `seed`; different streams are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
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
    pub fn next_u64(&mut self) -> u64 {
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
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Two such numbers.
    pub fn uniform2(&mut self) -> [f64; 2] {
        [self.uniform(), self.uniform()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_the_draws() {
        let n = 200_000u64;
        let d = Draws::new(0).stream(3);
        let (mut sum, mut sum2, mut sum4, mut uniform, mut lag) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for i in 0..n {
            let x = d.normal(i);
            sum += x;
            sum2 += x * x;
            sum4 += x * x * x * x;
            uniform += d.unit(i);
            lag += x * d.normal(i + 1);
        }
        let n = n as f64;
        // Five standard errors of each estimator.
        assert!((sum / n).abs() < 5.0 / n.sqrt());
        assert!((sum2 / n - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
        assert!((sum4 / n - 3.0).abs() < 5.0 * (96.0 / n).sqrt());
        assert!((uniform / n - 0.5).abs() < 5.0 * (1.0 / (12.0 * n)).sqrt());
        assert!((lag / n).abs() < 5.0 / n.sqrt());
    }

    #[test]
    fn streams_differ_and_repeat() {
        let d = Draws::new(7);
        assert_eq!(d.stream(1).bits(5), Draws::new(7).stream(1).bits(5));
        assert_ne!(d.stream(1).bits(5), d.stream(2).bits(5));
        assert_ne!(d.stream(1).stream(2).bits(5), d.stream(2).stream(1).bits(5));
        assert_ne!(d.bits(5), Draws::new(8).bits(5));
        assert!((0..1000).all(|i| d.happens(i, 1.0) && !d.happens(i, 0.0)));
    }
}
