//! A distribution as counts up to fixed bounds. The bounds never change, so two of them can be subtracted: the
//! difference is what happened in between.

use super::signed::SignedHistogram;
use hdrhistogram::Histogram;

/// Number of bounds.
pub const BOUNDS: usize = 33;

/// The upper bounds, nanoseconds: four in every octave from 1/4 ms to 32 ms; below and above that they are wider.
pub const UPPER_NS: [i64; BOUNDS] = bounds();

const fn bounds() -> [i64; BOUNDS] {
    let mut all = [0; BOUNDS];
    let mut k = 2;
    // 0, 125 us, then quarters of every octave to 32 ms.
    all[1] = 125_000;
    let mut octave = 250_000;
    while k < 30 {
        let mut quarter = 0;
        while quarter < 4 {
            all[k] = octave + octave / 4 * quarter;
            k += 1;
            quarter += 1;
        }
        octave *= 2;
    }
    all[30] = 32_000_000;
    all[31] = 128_000_000;
    all[32] = 1_000_000_000;
    all
}

/// How many values lie at or below each bound.
#[derive(Clone, Debug, PartialEq)]
pub struct Steps {
    /// Number of values at or below each of [`UPPER_NS`], which therefore never falls from one to the next.
    pub up_to: [u64; BOUNDS],
    /// Number of all values.
    pub count: u64,
    /// Sum of all values, nanoseconds, within 0.1 %.
    pub sum_ns: f64,
}

impl Steps {
    /// Counts the values of `histogram`. A value within 0.1 % of a bound may count on either side of it.
    pub(crate) fn of(histogram: &SignedHistogram) -> Self {
        let mut up_to = [0; BOUNDS];
        let late = histogram.late();
        let mut below = histogram.early().len();
        let mut from = 0;
        for (upper, total) in UPPER_NS.iter().zip(&mut up_to) {
            below += between(late, from, *upper as u64);
            *total = below;
            from = *upper as u64 + 1;
        }
        let count = histogram.len();
        // Buckets that straddle a bound are counted with the lower one, so no total exceeds the number of values.
        up_to.iter_mut().for_each(|total| *total = (*total).min(count));
        Self { up_to, count, sum_ns: histogram.mean() * count as f64 }
    }
}

/// Values from `low` to `high`, both included, where every bucket of the histogram counts once.
fn between(histogram: &Histogram<u64>, low: u64, high: u64) -> u64 {
    // A bucket that begins below `low` was counted with the bound before.
    let low = if low == 0 { 0 } else { histogram.next_non_equivalent(low - 1) };
    if low > high {
        0
    } else {
        histogram.count_between(low, high)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn bounds_rise() {
        assert!(UPPER_NS.windows(2).all(|w| w[0] < w[1]), "{UPPER_NS:?}");
    }

    proptest! {
        /// Counts never fall, end at the number of values, and equal those of the values themselves within the
        /// histogram's resolution.
        #[test]
        fn counts_are_those_of_the_values(
            values in prop::collection::vec(-2_000_000i64..2_000_000_000, 0..300),
        ) {
            let mut h = SignedHistogram::new(10_000_000_000);
            values.iter().for_each(|&v| h.record(v));
            let steps = Steps::of(&h);
            prop_assert_eq!(steps.count, values.len() as u64);
            prop_assert!(steps.up_to.windows(2).all(|w| w[0] <= w[1]));
            for (upper, counted) in UPPER_NS.into_iter().zip(steps.up_to) {
                let slack = 1 + upper / 500;
                let at_most = |bound: i64| values.iter().filter(|v| **v <= bound).count() as u64;
                prop_assert!(at_most(upper - slack) <= counted && counted <= at_most(upper + slack));
            }
        }
    }
}
