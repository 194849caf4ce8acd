//! Quantiles of values.

/// Quantiles of an error.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[allow(missing_docs)] // named after what they are
pub struct Quantiles {
    pub p50: f64,
    pub p99: f64,
    pub max: f64,
    pub rms: f64,
}

impl Quantiles {
    /// Of `values`, in any order; all 0 if there are none.
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let n = values.len();
        if n == 0 {
            return Self::default();
        }
        let at = |q: f64| values[((n as f64 * q).ceil() as usize).clamp(1, n) - 1];
        let rms = (values.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt();
        Self { p50: at(0.5), p99: at(0.99), max: values[n - 1], rms }
    }
}
