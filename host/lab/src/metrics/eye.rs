//! A sequence of lit frames into what an eye integrates from it: the mean of a 33 ms window, and a three-stage low-pass.
//!
//! Frames are light that stays constant from one instant to the next; both models are exact for that, whatever the durations.

use glam::Vec3;

use super::MetricError;

/// The window over which vision adds up light, nanoseconds.
pub const WINDOW_NS: i64 = 33_000_000;

/// Time constant of each of the three stages of [`LowPassEye`], nanoseconds.
pub const STAGE_NS: i64 = 6_000_000;

/// Mean light per pixel over one window of time.
#[derive(Clone, Debug)]
pub struct WindowEye {
    from_ns: i64,
    to_ns: i64,
    sum: Vec<[f64; 3]>,
    seen_ns: i64,
}

impl WindowEye {
    /// A window over `from_ns..to_ns` for pictures of `pixels` pixels.
    ///
    /// # Errors
    /// [`MetricError::Parameter`] when the window is empty.
    pub fn new(pixels: usize, from_ns: i64, to_ns: i64) -> Result<Self, MetricError> {
        if to_ns.checked_sub(from_ns).is_none_or(|length| length <= 0) {
            return Err(MetricError::Parameter("the window of time"));
        }
        Ok(Self { from_ns, to_ns, sum: vec![[0.0; 3]; pixels], seen_ns: 0 })
    }

    /// Adds light that lasted over `from_ns..to_ns`; only the part inside the window counts. Time without light is dark.
    ///
    /// # Panics
    /// When `frame` has another number of pixels than the window.
    pub fn add(&mut self, frame: &[Vec3], from_ns: i64, to_ns: i64) {
        assert_eq!(frame.len(), self.sum.len(), "the frame has another size than the window");
        let inside = to_ns.min(self.to_ns).saturating_sub(from_ns.max(self.from_ns));
        if inside <= 0 {
            return;
        }
        self.seen_ns += inside;
        for (s, c) in self.sum.iter_mut().zip(frame) {
            for (s, c) in s.iter_mut().zip(c.to_array()) {
                *s += inside as f64 * f64::from(c);
            }
        }
    }

    /// Mean over the window.
    pub fn mean(&self) -> Vec<Vec3> {
        let scale = 1.0 / (self.to_ns - self.from_ns) as f64;
        self.sum.iter().map(|s| Vec3::from(s.map(|x| (scale * x) as f32))).collect()
    }

    /// Share of the window in which any light was added, 0 to 1 when frames do not overlap.
    pub fn coverage(&self) -> f64 {
        self.seen_ns as f64 / (self.to_ns - self.from_ns) as f64
    }
}

/// Three equal first-order low-pass stages in a row, a common model of the retina's temporal response \[Watson86\].
#[derive(Clone, Debug)]
pub struct LowPassEye {
    stages: Vec<[Vec3; 3]>,
    stage_ns: f64,
}

impl LowPassEye {
    /// An eye that has seen darkness; `stage_ns`: time constant of each stage, [`STAGE_NS`] for a person.
    ///
    /// # Errors
    /// [`MetricError::Parameter`] when `stage_ns` is not above 0.
    pub fn new(pixels: usize, stage_ns: i64) -> Result<Self, MetricError> {
        if stage_ns <= 0 {
            return Err(MetricError::Parameter("the time constant"));
        }
        Ok(Self { stages: vec![[Vec3::ZERO; 3]; pixels], stage_ns: stage_ns as f64 })
    }

    /// Lets light fall on the eye for `duration_ns`; the response afterwards is exact, so a frame in two parts equals the frame whole.
    ///
    /// # Panics
    /// When `frame` has another number of pixels than the eye.
    pub fn see(&mut self, frame: &[Vec3], duration_ns: i64) {
        assert_eq!(frame.len(), self.stages.len(), "the frame has another size than the eye");
        let a = duration_ns.max(0) as f64 / self.stage_ns;
        let decay = (-a).exp() as f32;
        let (a1, a2) = (a as f32, (0.5 * a * a) as f32);
        for (stages, &u) in self.stages.iter_mut().zip(frame) {
            let [d1, d2, d3] = stages.map(|s| s - u);
            *stages = [u + decay * d1, u + decay * (d2 + a1 * d1), u + decay * (d3 + a1 * d2 + a2 * d1)];
        }
    }

    /// What reaches the brain now.
    pub fn response(&self) -> Vec<Vec3> {
        self.stages.iter().map(|s| s[2]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME_NS: i64 = 1_056_000;

    #[test]
    fn a_window_weighs_each_frame_by_its_time_inside() {
        let mut eye = WindowEye::new(1, 100, 200).unwrap();
        eye.add(&[Vec3::splat(4.0)], 50, 125); // 25 ns inside
        eye.add(&[Vec3::splat(8.0)], 150, 400); // 50 ns inside
        eye.add(&[Vec3::splat(1e9)], 0, 100);
        eye.add(&[Vec3::splat(1e9)], 200, 300);
        assert_eq!(eye.mean(), [Vec3::splat(5.0)]);
        assert_eq!(eye.coverage(), 0.75);
        assert!(WindowEye::new(1, 5, 5).is_err() && WindowEye::new(1, i64::MIN, i64::MAX).is_err());
    }

    #[test]
    fn averaging_n_noisy_frames_divides_the_variance_by_n() {
        let draws = dpm_device::rng::Draws::new(1);
        let (pixels, frames) = (4000, 31);
        let mut eye = WindowEye::new(pixels, 0, frames * FRAME_NS).unwrap();
        for f in 0..frames {
            let frame: Vec<Vec3> =
                (0..pixels).map(|p| Vec3::splat(draws.stream(f as u64).normal(p as u64) as f32)).collect();
            eye.add(&frame, f * FRAME_NS, (f + 1) * FRAME_NS);
        }
        let variance = eye.mean().iter().map(|v| f64::from(v.x).powi(2)).sum::<f64>() / pixels as f64;
        let expected = 1.0 / frames as f64;
        assert!(
            (variance / expected - 1.0).abs() < 5.0 * (2.0 / pixels as f64).sqrt(),
            "{variance} against {expected}"
        );
    }

    /// Response of three stages to a step, at `a` time constants after it.
    fn step_response(a: f64) -> f64 {
        1.0 - (-a).exp() * (1.0 + a + 0.5 * a * a)
    }

    #[test]
    fn a_step_gives_the_closed_form_however_it_is_cut() {
        for pieces in [1, 2, 7, 1000] {
            let mut eye = LowPassEye::new(1, STAGE_NS).unwrap();
            let total = 3 * STAGE_NS;
            for k in 0..pieces {
                eye.see(&[Vec3::ONE], total * (k + 1) / pieces - total * k / pieces);
            }
            assert!((f64::from(eye.response()[0].x) - step_response(3.0)).abs() < 2e-5, "{pieces} pieces");
        }
        let mut eye = LowPassEye::new(1, STAGE_NS).unwrap();
        eye.see(&[Vec3::ONE], 100 * STAGE_NS);
        assert_eq!(eye.response()[0], Vec3::ONE);
        eye.see(&[Vec3::splat(5.0)], 0);
        assert_eq!(eye.response()[0], Vec3::ONE);
        assert!(LowPassEye::new(1, 0).is_err());
    }

    #[test]
    fn a_flicker_is_damped_as_three_stages_do() {
        // 30 Hz cosine in steps short against it; gain (1 + (omega tau)^2)^(-3/2).
        let (hz, step_ns) = (30.0, 100_000i64);
        let omega = std::f64::consts::TAU * hz;
        let mut eye = LowPassEye::new(1, STAGE_NS).unwrap();
        let mut greatest = 0.0f32;
        for k in 0..6000 {
            let t = (k as f64 + 0.5) * step_ns as f64 * 1e-9;
            eye.see(&[Vec3::splat((omega * t).cos() as f32)], step_ns);
            if k > 3000 {
                greatest = greatest.max(eye.response()[0].x);
            }
        }
        let gain = (1.0 + (omega * STAGE_NS as f64 * 1e-9).powi(2)).powf(-1.5);
        assert!((f64::from(greatest) / gain - 1.0).abs() < 0.01, "{greatest} against {gain}");
    }
}
