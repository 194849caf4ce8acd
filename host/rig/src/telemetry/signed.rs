//! A histogram of signed times. HdrHistogram cannot hold negative values, so there are two of them, and the sign is
//! kept.

use hdrhistogram::Histogram;

/// Three digits: values are resolved to 0.1 %.
const DIGITS: u8 = 3;

/// Nanoseconds: early values (negative) and late ones (zero and above).
#[derive(Clone, Debug)]
pub struct SignedHistogram {
    /// Magnitudes of the negative values.
    early: Histogram<u64>,
    /// Zero and positive values.
    late: Histogram<u64>,
    longest_ns: u64,
    saturated: u64,
}

impl SignedHistogram {
    /// Resolves values between `-longest_ns` and `longest_ns`. Values beyond count as the bound and are counted as
    /// saturated. A `longest_ns` below 2 is replaced by 2.
    pub(crate) fn new(longest_ns: u64) -> Self {
        let longest_ns = longest_ns.max(2);
        // The bounds of HdrHistogram begin at 1, which is its unit; a 0 is kept as 0.
        let half =
            || Histogram::new_with_bounds(1, longest_ns, DIGITS).expect("1 and at least 2 are in range");
        Self { early: half(), late: half(), longest_ns, saturated: 0 }
    }

    /// Records a value.
    pub(crate) fn record(&mut self, ns: i64) {
        let magnitude = ns.unsigned_abs();
        self.saturated += u64::from(magnitude > self.longest_ns);
        let half = if ns < 0 { &mut self.early } else { &mut self.late };
        half.saturating_record(magnitude.min(self.longest_ns));
    }

    /// Number of recorded values.
    pub(crate) fn len(&self) -> u64 {
        self.early.len() + self.late.len()
    }

    /// True before the first value.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of values below zero.
    pub(crate) fn negative(&self) -> u64 {
        self.early.len()
    }

    /// Number of values beyond the bound.
    pub(crate) fn saturated(&self) -> u64 {
        self.saturated
    }

    /// Forgets all values; allocates nothing.
    pub(crate) fn reset(&mut self) {
        self.early.reset();
        self.late.reset();
        self.saturated = 0;
    }

    /// The smallest value that at least the share `quantile` (0 to 1) of all values does not exceed, within 0.1 %; 0
    /// without values.
    pub fn value_at_quantile(&self, quantile: f64) -> i64 {
        let all = self.len();
        if all == 0 {
            return 0;
        }
        let rank = ((quantile.clamp(0.0, 1.0) * all as f64).ceil() as u64).clamp(1, all);
        let early = self.early.len();
        if rank <= early {
            // The smallest value is the one of the largest magnitude.
            -signed(at_rank(&self.early, early - rank + 1))
        } else {
            signed(at_rank(&self.late, rank - early))
        }
    }

    /// Arithmetic mean, within 0.1 %; 0 without values.
    pub(crate) fn mean(&self) -> f64 {
        let (early, late) = (self.early.len() as f64, self.late.len() as f64);
        if early + late == 0.0 {
            return 0.0;
        }
        (self.late.mean() * late - self.early.mean() * early) / (early + late)
    }

    /// The smallest value, within 0.1 %; 0 without values.
    pub(crate) fn min(&self) -> i64 {
        if self.early.is_empty() {
            signed(self.late.min())
        } else {
            -signed(self.early.max())
        }
    }

    /// The largest value, within 0.1 %; 0 without values.
    pub(crate) fn max(&self) -> i64 {
        if self.late.is_empty() {
            -signed(self.early.min())
        } else {
            signed(self.late.max())
        }
    }

    /// Magnitudes of the values below zero.
    pub fn early(&self) -> &Histogram<u64> {
        &self.early
    }

    /// Values that are zero or above.
    pub fn late(&self) -> &Histogram<u64> {
        &self.late
    }
}

/// The value of a rank from 1 to the number of values.
fn at_rank(histogram: &Histogram<u64>, rank: u64) -> u64 {
    // Half a rank less: the library rounds the share up to the next rank, and the division must not move it past a
    // rank.
    histogram.value_at_quantile((rank as f64 - 0.5) / histogram.len() as f64)
}

/// Magnitudes are bounded by the histogram's own range, which is below that of i64.
fn signed(magnitude: u64) -> i64 {
    i64::try_from(magnitude).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn no_value_is_zero_and_zero_is_kept() {
        let mut h = SignedHistogram::new(1_000);
        assert_eq!((h.len(), h.min(), h.max(), h.value_at_quantile(0.5)), (0, 0, 0, 0));
        h.record(0);
        assert_eq!((h.len(), h.negative(), h.value_at_quantile(1.0), h.mean()), (1, 0, 0, 0.0));
        h.record(-5_000);
        assert_eq!((h.negative(), h.saturated(), h.min(), h.max()), (1, 1, -1_000, 0));
        h.record(i64::MIN);
        h.record(i64::MAX);
        assert_eq!((h.min(), h.max(), h.saturated()), (-1_000, 1_000, 3));
        h.reset();
        assert!(h.is_empty());
    }

    proptest! {
        /// Quantiles, mean and extremes equal those of the sorted values, whatever their signs, within the
        /// histogram's resolution.
        #[test]
        fn it_tells_what_the_sorted_values_tell(
            mut values in prop::collection::vec(-2_000_000i64..2_000_000, 1..300),
            quantile in 0.0f64..=1.0,
        ) {
            let mut h = SignedHistogram::new(10_000_000_000);
            values.iter().for_each(|&v| h.record(v));
            values.sort_unstable();
            let close = |found: i64, exact: i64| (found - exact).abs() <= 1 + exact.abs() / 1000;
            let rank = ((quantile * values.len() as f64).ceil() as usize).clamp(1, values.len());
            let found = h.value_at_quantile(quantile);
            prop_assert!(close(found, values[rank - 1]), "{found} for {}", values[rank - 1]);
            prop_assert!(close(h.min(), values[0]) && close(h.max(), values[values.len() - 1]));
            let mean = values.iter().sum::<i64>() as f64 / values.len() as f64;
            let scale = values.iter().map(|v| v.abs()).sum::<i64>() as f64 / values.len() as f64;
            prop_assert!((h.mean() - mean).abs() <= 1.0 + scale * 2e-3);
            prop_assert_eq!(h.negative(), values.iter().filter(|v| **v < 0).count() as u64);
        }
    }
}
