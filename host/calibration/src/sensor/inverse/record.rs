//! Samples on the host's clock, and their means over any stretch of time.

use super::super::lock::SampleBlock;

/// Samples are summed over so long, nanoseconds.
const BIN_NS: f64 = 50_000.0;
/// Longest recording, bins: an hour.
const MOST_BINS: f64 = 7.2e7;
/// A mean counts if this share of its time was sampled.
const LEAST_SAMPLED: f64 = 0.9;

/// A block of samples, and the sensor's clock less the host's when it came, nanoseconds.
pub type Mapped = (SampleBlock, i64);

/// Samples by time.
pub(super) struct Record {
    /// Begin of the first sample by the host's clock, nanoseconds.
    pub base_ns: i64,
    /// Sum of the levels before each bin, and their number.
    sums: Vec<(f64, f64)>,
    /// Usual number of samples of a bin.
    usual: f64,
}

impl Record {
    /// `None` if there are no samples, or if their stamps are more than an hour apart.
    pub(super) fn new(blocks: &[Mapped]) -> Option<Self> {
        let filled = || blocks.iter().filter(|(b, _)| !b.levels.is_empty() && b.interval_ns > 0.0);
        // A sample stands for the time around it.
        let start = |(block, offset): &Mapped| {
            block.start_ns.saturating_sub(*offset).saturating_sub((0.5 * block.interval_ns) as i64)
        };
        let base_ns = filled().map(start).min()?;
        let interval = filled().map(|(b, _)| b.interval_ns).fold(0.0, f64::max);
        let at = |block: &Mapped, i: usize| {
            (start(block).saturating_sub(base_ns) as f64 + (i as f64 + 0.5) * block.0.interval_ns) / BIN_NS
        };
        let last = filled().map(|b| at(b, b.0.levels.len() - 1)).fold(0.0, f64::max);
        if !(last < MOST_BINS && interval.is_finite()) {
            return None;
        }
        let mut sums = vec![(0.0, 0.0); last as usize + 2];
        for block in filled() {
            for (i, level) in block.0.levels.iter().enumerate() {
                let sum = &mut sums[at(block, i) as usize + 1];
                *sum = (sum.0 + f64::from(*level), sum.1 + 1.0);
            }
        }
        let mut before = (0.0, 0.0);
        for sum in &mut sums {
            before = (before.0 + sum.0, before.1 + sum.1);
            *sum = before;
        }
        Some(Self { base_ns, sums, usual: BIN_NS / interval })
    }

    /// Time from the first sample to the last, nanoseconds.
    pub(super) fn length_ns(&self) -> f64 {
        (self.sums.len() - 1) as f64 * BIN_NS
    }

    /// The mean level between two instants, nanoseconds after the first sample; `None` if it was not sampled whole.
    pub(super) fn mean(&self, from_ns: f64, until_ns: f64) -> Option<f64> {
        let (a, b) = (from_ns / BIN_NS, until_ns / BIN_NS);
        if !(a >= 0.0 && b > a && b < (self.sums.len() - 1) as f64) {
            return None;
        }
        // The instants that are looked for are finer than a bin.
        let until = |bin: f64| {
            let (low, high) = (self.sums[bin as usize], self.sums[bin as usize + 1]);
            let share = bin.fract();
            (low.0 + share * (high.0 - low.0), low.1 + share * (high.1 - low.1))
        };
        let (before, after) = (until(a), until(b));
        let count = after.1 - before.1;
        (count >= LEAST_SAMPLED * (b - a) * self.usual).then(|| (after.0 - before.0) / count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_is_that_of_the_samples_between_and_gaps_have_none() {
        let block = |start_ns: i64| {
            let levels = (0..250).map(|i| (start_ns / 10_000 + i) as f32).collect();
            (SampleBlock { start_ns: start_ns + 7_000_000_000, interval_ns: 1e4, levels }, 7_000_000_000)
        };
        // Samples that rise by one every 10 us; 2.5 ms are missing after 7.5 ms.
        let record = Record::new(&[0, 2_500_000, 5_000_000, 10_000_000].map(block)).unwrap();
        assert_eq!(record.base_ns, -5_000);
        // 100 to 399.
        assert!((record.mean(1e6, 4e6).unwrap() - 249.5).abs() < 1e-9);
        assert_eq!(record.mean(7e6, 9e6), None);
        assert!((record.mean(10e6, 11e6).unwrap() - 1049.5).abs() < 1e-9);
        // A tenth of a bin later, half a sample of 10 us more.
        assert!((record.mean(1.005e6, 4.005e6).unwrap() - 250.0).abs() < 1e-6);
        for (from, until) in [(-1e6, 1e6), (2e6, 2e6), (11e6, 20e6), (f64::NAN, 1e6)] {
            assert_eq!(record.mean(from, until), None);
        }
        assert!(Record::new(&[]).is_none());
        assert!(Record::new(&[block(0), block(7_200_000_000_000)]).is_none());
    }
}
