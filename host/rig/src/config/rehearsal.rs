//! `[rehearsal]`: what `dpm rehearse` assumes of parts that nobody has measured yet.

use dpm_common::keys::read::{Any, Within};
use dpm_common::{section, words};

section! {
    /// What `dpm rehearse` assumes (docs/BUDGET.md). No other command reads it.
    pub struct RehearsalConfig {
        /// How bodies move.
        motion: RehearsedMotion = RehearsedMotion::Swing, "", Any;
        /// Speed of that motion.
        speed_m_s: f64 = 0.5, "m/s", Within(1e-3, 50.0);
        /// Its acceleration.
        acceleration_m_s2: f64 = 5.0, "m/s2", Within(1e-2, 1000.0);
        /// Standard deviation, along each axis, of a corner of a tag or of a marker in a camera's picture.
        corner_px: f64 = 0.1, "px", Within(0.0, 10.0);
        /// How far the camera's lens spreads the light of a point: standard deviation along each axis.
        softness_px: f64 = 0.5, "px", Within(0.0, 10.0);
        /// From the end of the exposure to the finished pose. If left out, the time between two samples of the tracker.
        delivery_us: Option<u32> = None, "us", Within(0, 1_000_000);
        /// Standard deviation of the position that another tracker than a camera reports, along each axis. The mock has its
        /// own key.
        noise_m: f64 = 1e-4, "m", Within(0.0, 1.0);
        /// The same of the rotation about each axis.
        noise_rad: f64 = 1e-3, "rad", Within(0.0, 1.0);
        /// Standard deviation of what is not known of the time from motion to light, after `dpm calibrate latency`.
        late_us: f64 = 500.0, "us", Within(0.0, 100_000.0);
        /// What the calibration of the camera leaves open: 99th percentile over its picture, as `dpm calibrate camera`
        /// predicts it.
        camera_px: f64 = 0.3, "px", Within(0.0, 100.0);
        /// What the calibration of the projector leaves open: 99th percentile over its raster, as `dpm calibrate projector`
        /// predicts it.
        projector_px: f64 = 0.5, "px", Within(0.0, 100.0);
        /// Standard deviation, along each axis, of the place of the mesh in the body that is tracked.
        body_m: f64 = 2e-4, "m", Within(0.0, 0.1);
    }
}

words! {
    /// Motions of a rehearsal, by a speed and an acceleration.
    pub enum RehearsedMotion {
        /// To and fro on a line like a pendulum, with this speed in the middle and this acceleration at the ends.
        Swing = "swing",
        /// A hand: five waves at once in all directions across the light, which together have the power of a swing's speed and
        /// acceleration. It repeats nothing, and exceeds both at times.
        Hand = "hand",
        /// A machine: straight stretches at this speed, and turns with this acceleration that begin and end at once.
        Turns = "turns",
    }
}
