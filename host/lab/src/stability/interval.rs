//! Bounds of real numbers: arithmetic whose every result contains the exact one. The oracle of functions in f32, in units of
//! their last place.
//!
//! Every operation of f64 is rounded to the nearest (IEEE 754), so the exact result lies between the neighbours of what comes
//! out.

/// All numbers from `low` to `high`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Interval {
    low: f64,
    high: f64,
}

impl From<f32> for Interval {
    /// The number itself.
    fn from(exact: f32) -> Self {
        Self { low: exact.into(), high: exact.into() }
    }
}

impl Interval {
    /// Pi: the f64 below it, and the next one.
    pub(super) const PI: Self =
        Self { low: std::f64::consts::PI, high: f64::from_bits(std::f64::consts::PI.to_bits() + 1) };

    /// A number of f64 itself.
    pub(super) fn exactly(x: f64) -> Self {
        Self { low: x, high: x }
    }

    /// The neighbours of the least and of the greatest of some results.
    fn around(all: [f64; 4]) -> Self {
        let (low, high) =
            all.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(*x), h.max(*x)));
        Self { low: low.next_down(), high: high.next_up() }
    }

    /// Product.
    pub(super) fn times(self, o: Self) -> Self {
        Self::around([self.low * o.low, self.low * o.high, self.high * o.low, self.high * o.high])
    }

    /// Quotient by numbers above 0.
    pub(super) fn over(self, o: Self) -> Self {
        Self::around([self.low / o.low, self.low / o.high, self.high / o.low, self.high / o.high])
    }

    /// How far a number of f32 is from all that lie here, at least and at most, in units of the last place of the f32 that is
    /// nearest to the middle.
    pub(super) fn ulps_from(self, x: f32) -> [f64; 2] {
        let nearest = ((self.low + self.high) / 2.0) as f32;
        let place = f64::from(nearest.abs().max(f32::MIN_POSITIVE));
        let ulp = 2f64.powi(place.log2().floor() as i32 - 23);
        let x = f64::from(x);
        let least = (self.low - x).max(x - self.high).max(0.0);
        [least / ulp, (self.high - x).max(x - self.low) / ulp]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Results whose exact value is known are inside, and the bounds are a few neighbours wide.
    #[test]
    fn the_exact_result_is_inside() {
        let third = Interval::exactly(1.0).over(Interval::exactly(3.0));
        assert!(third.low * 3.0 <= 1.0 && third.high * 3.0 >= 1.0 && third.high - third.low < 3e-16);
        let one = third.times(Interval::exactly(3.0));
        assert!(one.low < 1.0 && one.high > 1.0 && one.high - one.low < 3e-15);
        let pi = Interval::exactly(1.0).times(Interval::PI);
        assert!(pi.low < std::f64::consts::PI && pi.high - pi.low < 3e-15);
    }

    /// A f32 next to the exact one is one unit off, and the nearest is half of one at most.
    #[test]
    fn units_of_the_last_place_are_counted() {
        for exact in [1.0f64 / 3.0, 1.5, 1e-20, 12345.678, 0.999_999_99] {
            let here = Interval::exactly(exact);
            let nearest = exact as f32;
            assert!(here.ulps_from(nearest)[1] <= 0.5 + 1e-9, "{exact}");
            let [least, most] = here.ulps_from(f32::from_bits(nearest.to_bits() + 2));
            assert!(least > 1.4 && most < 2.6, "{exact}: {least} to {most}");
        }
    }
}
