//! Times of frames into the one that stands for them: a stall of the machine moves a mean, not a median.

/// Middle value, or the mean of the two in the middle; 0 of none.
pub(crate) fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => 0.0,
        n => 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]),
    }
}

/// Median of nanoseconds, as milliseconds; 0 of none.
pub(crate) fn median_ms(ns: impl IntoIterator<Item = u64>) -> f64 {
    1e-6 * median(ns.into_iter().map(|ns| ns as f64))
}

/// Where the middle half of the values lies: the quartiles, each the value whose rank is nearest; zeros of none.
pub(crate) fn quartiles(values: impl IntoIterator<Item = f64>) -> [f64; 2] {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1) as f64;
    [0.25, 0.75].map(|share| sorted.get((share * last).round() as usize).copied().unwrap_or(0.0))
}

/// Mean without the stalls of the machine: what takes more than three times the median is left out; 0 of none. Unlike a median it
/// tells the cost of frames that take turns between more and fewer samples.
pub(crate) fn steady_mean(values: &[f64]) -> f64 {
    let most = 3.0 * median(values.iter().copied());
    let steady: Vec<f64> = values.iter().copied().filter(|v| *v <= most).collect();
    steady.iter().sum::<f64>() / steady.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_of_an_even_count_is_the_mean_of_the_middle() {
        assert_eq!(median([4.0, 1.0, 9.0]), 4.0);
        assert_eq!(median([8.0, 1.0, 3.0, 4.0]), 3.5);
        assert_eq!(median([]), 0.0);
        assert_eq!(median_ms([3_000_000, 1_000_000, 2_000_000]), 2.0);
    }

    #[test]
    fn half_of_the_values_lies_between_the_quartiles() {
        assert_eq!(quartiles([5.0, 1.0, 2.0, 4.0, 3.0]), [2.0, 4.0]);
        assert_eq!(quartiles([7.0]), [7.0, 7.0]);
        assert_eq!(quartiles([]), [0.0, 0.0]);
        let of_100 = quartiles((0..100).map(f64::from));
        assert_eq!(of_100, [25.0, 74.0]);
    }

    #[test]
    fn a_steady_mean_follows_turns_and_leaves_out_stalls() {
        assert_eq!(steady_mean(&[1.0, 2.0, 1.0, 2.0]), 1.5);
        assert_eq!(steady_mean(&[1.0, 2.0, 1.0, 2.0, 500.0]), 1.5);
        assert_eq!(steady_mean(&[]), 0.0);
    }
}
