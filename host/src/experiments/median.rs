//! Times of frames into the one that stands for them: a stall of the machine moves a mean, not a median.

/// Middle value, or the mean of the two in the middle; 0 of none.
pub fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => 0.0,
        n => 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]),
    }
}

/// Median of nanoseconds, as milliseconds; 0 of none.
pub fn median_ms(ns: impl IntoIterator<Item = u64>) -> f64 {
    1e-6 * median(ns.into_iter().map(|ns| ns as f64))
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
}
