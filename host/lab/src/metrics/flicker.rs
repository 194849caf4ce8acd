//! A sequence of pictures into the power with which their tiles change, by frequency, and from 1 to 60 Hz in one figure.

use super::MetricError;

/// The slowest change that counts as flicker, Hz.
pub(crate) const LOWEST_HZ: f64 = 1.0;

/// The end of the band that is summed up in one figure, Hz. Faster changes are seen too, but not where this program's methods make
/// most of theirs; [`super::sensitivity`] says how well.
pub(crate) const HIGHEST_HZ: f64 = 60.0;

/// A frequency, and the power that each tile has at it, row by row.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct SpectralLine {
    /// The frequency.
    pub hz: f64,
    /// Mean squares, in the square of the values' unit: half of the squared amplitude.
    pub power: Vec<f64>,
}

/// Means of square tiles over time.
#[derive(Clone, Debug)]
pub(crate) struct TileSeries {
    width: usize,
    height: usize,
    tile: usize,
    frame_period_s: f64,
    /// Frame after frame, the tiles row by row.
    means: Vec<f64>,
    frames: usize,
}

impl TileSeries {
    /// For pictures of `width` x `height` in tiles of `tile` pixels (those at the right and lower border may be smaller), a frame every
    /// `frame_period_ns`.
    ///
    /// # Errors
    /// [`MetricError::Parameter`] when a size or the period is 0.
    pub(crate) fn new(
        width: usize,
        height: usize,
        tile: usize,
        frame_period_ns: u64,
    ) -> Result<Self, MetricError> {
        if width == 0 || height == 0 || tile == 0 {
            return Err(MetricError::Parameter("a size"));
        }
        if frame_period_ns == 0 {
            return Err(MetricError::Parameter("the frame period"));
        }
        Ok(Self {
            width,
            height,
            tile,
            frame_period_s: frame_period_ns as f64 * 1e-9,
            means: vec![],
            frames: 0,
        })
    }

    /// Tiles in a row and rows of tiles.
    pub(crate) fn tiles(&self) -> (usize, usize) {
        (self.width.div_ceil(self.tile), self.height.div_ceil(self.tile))
    }

    /// Adds a frame of one value a pixel: luminance, or its difference from a reference when the scene itself changes.
    ///
    /// # Errors
    /// [`MetricError::PixelCount`].
    pub(crate) fn add(&mut self, values: &[f32]) -> Result<(), MetricError> {
        if values.len() != self.width * self.height {
            return Err(MetricError::PixelCount {
                width: self.width,
                height: self.height,
                found: values.len(),
            });
        }
        let (across, down) = self.tiles();
        for (ty, tx) in (0..down).flat_map(|ty| (0..across).map(move |tx| (ty, tx))) {
            let columns = tx * self.tile..((tx + 1) * self.tile).min(self.width);
            let rows = ty * self.tile..((ty + 1) * self.tile).min(self.height);
            let count = columns.len() * rows.len();
            let sum: f64 = rows
                .map(|y| values[y * self.width..][columns.clone()].iter().map(|&v| f64::from(v)).sum::<f64>())
                .sum();
            self.means.push(sum / count as f64);
        }
        self.frames += 1;
        Ok(())
    }

    /// Power of each tile between [`LOWEST_HZ`] and [`HIGHEST_HZ`], row by row: the mean square of that part of the tile's course, in the
    /// square of the values' unit. A sine of amplitude A at a frequency of the spectrum gives A^2 / 2; by Parseval's theorem all
    /// frequencies together give the variance. The spectrum is that of the whole sequence without a window, so its lines are
    /// `1 / duration` apart.
    ///
    /// # Errors
    /// [`MetricError::Parameter`] when the sequence is too short to hold a frequency of the band: 250 ms is a sensible least.
    pub(crate) fn power(&self) -> Result<Vec<f64>, MetricError> {
        let lines = self.lines(LOWEST_HZ, HIGHEST_HZ);
        let Some((first, others)) = lines.split_first() else {
            return Err(MetricError::Parameter(
                "the number of frames (no frequency from 1 to 60 Hz fits in)",
            ));
        };
        let mut power = first.power.clone();
        for line in others {
            power.iter_mut().zip(&line.power).for_each(|(sum, p)| *sum += p);
        }
        Ok(power)
    }

    /// The spectrum of every tile from `lowest_hz` to `highest_hz`, as far as half of the frame rate: see [`Self::power`].
    pub(crate) fn lines(&self, lowest_hz: f64, highest_hz: f64) -> Vec<SpectralLine> {
        let n = self.frames;
        let hz = |k: usize| k as f64 / (n as f64 * self.frame_period_s);
        let band = (1..=n / 2).filter(|&k| (lowest_hz..=highest_hz).contains(&hz(k)));
        let (across, down) = self.tiles();
        let tiles = across * down;
        let mut lines = Vec::new();
        let (mut re, mut im) = (vec![0.0; tiles], vec![0.0; tiles]);
        for k in band {
            re.fill(0.0);
            im.fill(0.0);
            for (frame, means) in self.means.chunks_exact(tiles).enumerate() {
                // The phase is taken modulo n in integers, so that it stays exact in long sequences.
                let (sin, cos) = (std::f64::consts::TAU * ((k * frame) % n) as f64 / n as f64).sin_cos();
                for ((re, im), m) in re.iter_mut().zip(&mut im).zip(means) {
                    *re += m * cos;
                    *im -= m * sin;
                }
            }
            // The line at half the frame rate stands for itself, every other also for its negative frequency.
            let sides = if 2 * k == n { 1.0 } else { 2.0 };
            let of = |(re, im): (&f64, &f64)| sides * (re * re + im * im) / (n as f64 * n as f64);
            lines.push(SpectralLine { hz: hz(k), power: re.iter().zip(&im).map(of).collect() });
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 250 frames of 1 ms: lines 4 Hz apart.
    fn course(f: impl Fn(f64) -> f64) -> TileSeries {
        let mut series = TileSeries::new(3, 2, 2, 1_000_000).unwrap();
        for k in 0..250 {
            let v = f(k as f64 * 1e-3) as f32;
            series.add(&[v, v, 0.0, v, v, 0.0]).unwrap();
        }
        series
    }

    fn sine(hz: f64, t: f64) -> f64 {
        (std::f64::consts::TAU * hz * t).sin()
    }

    #[test]
    fn a_sine_in_the_band_gives_half_its_squared_amplitude() {
        for hz in [4.0, 20.0, 60.0] {
            let power = course(|t| 10.0 + 3.0 * sine(hz, t)).power().unwrap();
            assert!((power[0] - 4.5).abs() < 1e-4 && power[1].abs() < 1e-12, "{hz} Hz: {power:?}");
        }
    }

    #[test]
    fn steady_light_and_fast_flicker_are_not_seen() {
        assert!(course(|_| 7.0).power().unwrap()[0] < 1e-12);
        for hz in [64.0, 200.0, 500.0] {
            assert!(course(|t| sine(hz, t + 0.0005)).power().unwrap()[0] < 1e-9, "{hz} Hz");
        }
    }

    #[test]
    fn powers_add_and_the_whole_spectrum_is_the_variance() {
        let mixed = course(|t| sine(8.0, t) + 2.0 * sine(40.0, t) + sine(100.0, t)).power().unwrap();
        assert!((mixed[0] - 2.5).abs() < 1e-4);
        // At a frame rate of 120 Hz the band holds every line but the mean.
        let draws = dpm_device::rng::Draws::new(4);
        let mut series = TileSeries::new(1, 1, 1, 8_333_333).unwrap();
        let values: Vec<f64> = (0..120).map(|k| f64::from(draws.normal(k) as f32)).collect();
        values.iter().for_each(|&v| series.add(&[v as f32]).unwrap());
        let mean = values.iter().sum::<f64>() / 120.0;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 120.0;
        let power = series.power().unwrap()[0];
        // 8,333,333 ns puts the last line a hair above 60 Hz; its power is the alternating sum.
        let alternating =
            values.iter().enumerate().map(|(k, v)| if k % 2 == 0 { *v } else { -v }).sum::<f64>() / 120.0;
        assert!(
            (power + alternating.powi(2) - variance).abs() < 1e-9,
            "{power} and {alternating} against {variance}"
        );
    }

    #[test]
    fn tiles_at_the_border_are_means_of_what_is_there() {
        let mut series = TileSeries::new(3, 3, 2, 1_000_000).unwrap();
        series.add(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]).unwrap();
        assert_eq!(series.tiles(), (2, 2));
        assert_eq!(series.means, [3.0, 4.5, 7.5, 9.0]);
    }

    #[test]
    fn wrong_sizes_and_short_sequences_are_refused() {
        assert!(
            TileSeries::new(0, 1, 1, 1).is_err()
                && TileSeries::new(1, 1, 0, 1).is_err()
                && TileSeries::new(1, 1, 1, 0).is_err()
        );
        let mut series = TileSeries::new(2, 1, 1, 1_000_000).unwrap();
        assert!(series.add(&[1.0]).is_err() && series.power().is_err());
        (0..10).for_each(|_| series.add(&[1.0, 1.0]).unwrap());
        assert!(series.power().is_err(), "10 ms hold no line below 100 Hz");
    }
}
