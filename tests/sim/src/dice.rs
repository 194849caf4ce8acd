//! Draws in a row from a seed.

use dpm_device::rng::Draws;

/// A row of draws.
#[derive(Clone, Debug)]
pub struct Dice {
    draws: Draws,
    next: u64,
}

impl Dice {
    /// The row of `seed` for one purpose.
    pub fn new(seed: u64, purpose: u64) -> Self {
        Self { draws: Draws::new(seed).stream(purpose), next: 0 }
    }

    /// 64 uniform bits.
    pub fn bits(&mut self) -> u64 {
        self.next += 1;
        self.draws.bits(self.next)
    }

    /// Uniform in `[0, 1)`.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// True with probability `p`.
    pub fn happens(&mut self, p: f64) -> bool {
        p > 0.0 && self.unit() < p
    }

    /// Uniform from `low` to `high`.
    pub fn between(&mut self, low: i64, high: i64) -> i64 {
        low + (self.unit() * (high - low + 1) as f64) as i64
    }

    /// Between `low` and `high`, each decade equally likely.
    pub fn decades(&mut self, low: i64, high: i64) -> i64 {
        // A product of halves instead of a power: the same on every machine.
        let mut x = low.max(1);
        while x < high && self.happens(0.62) {
            x = x * self.between(1_200, 2_800) / 1_000 + 1;
        }
        x.min(high)
    }

    /// One of `all`.
    pub fn one_of<T: Copy>(&mut self, all: &[T]) -> T {
        all[(self.bits() % all.len() as u64) as usize]
    }
}
