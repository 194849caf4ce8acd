//! Means and variances of Monte Carlo estimates.

/// Running mean and variance of the mean, per channel (\[Welford62\]).
#[derive(Clone, Copy, Debug, Default)]
pub struct Estimate {
    /// Values taken so far.
    pub count: f64,
    /// Their mean.
    pub mean: [f64; 3],
    squares: [f64; 3],
}

impl Estimate {
    /// Takes one more value.
    pub(crate) fn add(&mut self, value: [f64; 3]) {
        self.count += 1.0;
        for (c, v) in value.into_iter().enumerate() {
            let delta = v - self.mean[c];
            self.mean[c] += delta / self.count;
            self.squares[c] += delta * (v - self.mean[c]);
        }
    }

    /// Variance of the mean; infinite with fewer than two values.
    pub(crate) fn variance(&self, channel: usize) -> f64 {
        if self.count > 1.0 {
            self.squares[channel] / (self.count * (self.count - 1.0))
        } else {
            f64::INFINITY
        }
    }
}

/// Mean of pixel estimates and its standard error, one channel.
pub(crate) fn pooled<'a>(pixels: impl IntoIterator<Item = &'a Estimate>, channel: usize) -> (f64, f64) {
    let (mut n, mut sum, mut variance) = (0.0, 0.0, 0.0);
    for p in pixels {
        n += 1.0;
        sum += p.mean[channel];
        variance += p.variance(channel);
    }
    (sum / n, variance.sqrt() / n)
}
