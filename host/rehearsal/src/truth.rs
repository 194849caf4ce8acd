//! What is true in one run of a rehearsal, drawn from its seed: where camera and projector really are, by how much stamps
//! are late, where the meshes are in the bodies, and how bodies move.

use dpm_device::rng::Draws;
use dpm_mock::motion::MotionSpec;
use dpm_rig::config::{RehearsalConfig, RehearsedMotion};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec2, DVec3};

/// Points along each side of a raster at which an error of a calibration is measured.
const GRID: usize = 12;
/// Frequencies of the waves of a hand by that of the swing with the same speed and acceleration: their mean square is 1.
const WAVES: [f64; 5] = [0.34, 0.63, 0.93, 1.22, 1.46];
/// By how much of itself each frequency is drawn away from its place, at most.
const ASTRAY: f64 = 0.08;

/// The draws of a seed.
#[derive(Clone, Copy, Debug)]
pub(super) struct RehearsalTruth {
    draws: Draws,
}

impl RehearsalTruth {
    pub(super) fn new(seed: u64) -> Self {
        Self { draws: Draws::new(seed).stream(0x7265_6865) }
    }

    /// Draws for the noise of samples.
    pub(super) fn noise(self) -> Draws {
        self.draws.stream(1)
    }

    /// When the first sample is taken, nanoseconds; `period_ns`: time between two samples.
    pub(super) fn phase_ns(self, period_ns: i64) -> i64 {
        (self.draws.stream(2).unit(0) * period_ns as f64) as i64
    }

    /// By how much the stamps of samples are too late, nanoseconds.
    pub(super) fn late_ns(self, rehearsal: &RehearsalConfig) -> i64 {
        (self.draws.stream(3).normal(0) * rehearsal.late_us * 1e3) as i64
    }

    /// By how much body `body` is really off its place on what is tracked, metres.
    pub(super) fn off_body(self, body: usize, rehearsal: &RehearsalConfig) -> DVec3 {
        DVec3::from_array(self.draws.stream(4).normal3(body as u64)) * rehearsal.body_m
    }

    /// The true camera or projector, where the calibration `believed` is off by `px`: 99th percentile over its raster at
    /// `distance` metres. `which`: 0 for the camera, 1 for the projector.
    pub(super) fn eye(
        self,
        believed: &ProjectorCamera,
        px: f64,
        distance: f64,
        which: u64,
    ) -> ProjectorCamera {
        let draws = self.draws.stream(5).stream(which);
        // An error in a small step is in proportion to the step.
        let step = 1e-3;
        let off = p99_px(believed, &displaced(believed, step, distance, draws), distance);
        displaced(believed, step * px / off.max(1e-12), distance, draws)
    }

    /// How body `body` moves: across the light, of which `right` and `up` are axes of the world.
    pub(super) fn motion(
        self,
        body: usize,
        rehearsal: &RehearsalConfig,
        right: DVec3,
        up: DVec3,
    ) -> MotionSpec {
        let draws = self.draws.stream(6).stream(body as u64);
        let (speed, acceleration) = (rehearsal.speed_m_s, rehearsal.acceleration_m_s2);
        let towards = |turn: f64| {
            let (sin, cos) = (std::f64::consts::TAU * turn).sin_cos();
            (right * cos + up * sin).to_array()
        };
        match rehearsal.motion {
            RehearsedMotion::Swing => MotionSpec::Sinusoid {
                direction: towards(draws.unit(0)),
                peak_speed_m_s: speed,
                peak_acceleration_m_s2: acceleration,
            },
            RehearsedMotion::Hand => {
                let peak_speed_m_s = speed / (WAVES.len() as f64).sqrt();
                let wave = |(i, by): (usize, f64)| MotionSpec::Sinusoid {
                    direction: towards(draws.unit(10 + i as u64)),
                    peak_speed_m_s,
                    peak_acceleration_m_s2: peak_speed_m_s * acceleration / speed * by,
                };
                let astray =
                    |(i, by): (usize, &f64)| (i, by * (1.0 + ASTRAY * (2.0 * draws.unit(i as u64) - 1.0)));
                MotionSpec::Together { parts: WAVES.iter().enumerate().map(astray).map(wave).collect() }
            }
            // Between two turns lies as much time as in one.
            RehearsedMotion::Turns => MotionSpec::Translate {
                direction: towards(draws.unit(0)),
                speed_m_s: speed,
                amplitude_m: speed * speed / acceleration * (1.5 + 0.4 * draws.unit(1)),
                acceleration_m_s2: acceleration,
                rest_s: 0.0,
            },
        }
    }
}

/// `believed` with every number off by a normal deviate that moves the picture by about `step` pixels at its rim.
fn displaced(believed: &ProjectorCamera, step: f64, distance: f64, draws: Draws) -> ProjectorCamera {
    let n = |i: u64| draws.normal(i) * step;
    let half = 0.5 * f64::from(believed.raster.width());
    let f = believed.fx;
    let turn = DVec3::new(n(4) / f, n(5) / f, n(6) / half);
    let shift = DVec3::new(n(7), n(8), n(9) * f / half) * (distance / f);
    let moved = DAffine3::from_rotation_translation(DQuat::from_scaled_axis(turn), shift);
    ProjectorCamera {
        fx: believed.fx * (1.0 + n(0) / half),
        fy: believed.fy * (1.0 + n(1) / half),
        cx: believed.cx + n(2),
        cy: believed.cy + n(3),
        world_from_projector: believed.world_from_projector * moved,
        ..*believed
    }
}

/// How far apart two cameras put the places that the first one sees at a distance, pixels: 99th percentile over its raster.
pub(super) fn p99_px(believed: &ProjectorCamera, truth: &ProjectorCamera, distance: f64) -> f64 {
    let [w, h] = [believed.raster.width(), believed.raster.height()].map(f64::from);
    let at = |i: usize, side: f64| (i as f64 + 0.5) / GRID as f64 * side;
    let pixels = (0..GRID * GRID).map(|i| DVec2::new(at(i % GRID, w), at(i / GRID, h)));
    let off = pixels.filter_map(|pixel| {
        let ray = believed.ray(pixel);
        Some((truth.project(ray.origin + ray.direction * distance)? - pixel).length())
    });
    dpm_common::quantiles::Quantiles::of(off.collect()).p99
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;

    fn camera() -> ProjectorCamera {
        let raster = Raster::new(1280, 800).unwrap();
        let from = DVec3::new(0.2, 0.3, 1.2);
        ProjectorCamera::look_at(raster, from, DVec3::ZERO, DVec3::Y, 1.0).unwrap()
    }

    /// A drawn truth is off by what was asked for, each seed in its own way.
    #[test]
    fn calibrations_are_off_by_what_they_predict() {
        let believed = camera();
        for seed in 0..20 {
            for px in [0.0, 0.1, 3.0] {
                let truth = RehearsalTruth::new(seed).eye(&believed, px, 1.2, 0);
                let off = p99_px(&believed, &truth, 1.2);
                assert!((off - px).abs() <= 0.05 * px + 1e-9, "seed {seed}: {off} for {px}");
            }
        }
        let [a, b] = [0, 1].map(|seed| RehearsalTruth::new(seed).eye(&believed, 1.0, 1.2, 0));
        assert!(a != b);
    }

    /// Speed and acceleration of each motion are those asked for.
    #[test]
    fn motions_have_the_speed_and_the_acceleration_asked_for() {
        use dpm_device::pose::Pose;
        use dpm_mock::motion::Motion;
        for motion in [RehearsedMotion::Swing, RehearsedMotion::Hand, RehearsedMotion::Turns] {
            let rehearsal = RehearsalConfig { motion, ..RehearsalConfig::default() };
            for seed in 0..4 {
                let spec = RehearsalTruth::new(seed).motion(0, &rehearsal, DVec3::X, DVec3::Y);
                let motion = Motion::new(&spec, Pose::IDENTITY).unwrap();
                let place = |i: i64| DVec3::from_array(motion.pose_at(i * 1_000_000).position_m);
                let (mut speed, mut turning, n) = (0.0, 0.0, 60_000);
                for i in 1..n {
                    speed += ((place(i + 1) - place(i - 1)) * 500.0).length_squared();
                    turning += ((place(i + 1) + place(i - 1) - 2.0 * place(i)) * 1e6).length_squared();
                }
                let [speed, turning] = [speed, turning].map(|sum: f64| (sum / n as f64).sqrt());
                let swing = [0.5, 5.0].map(|peak: f64| peak / 2f64.sqrt());
                if rehearsal.motion == RehearsedMotion::Turns {
                    assert!(
                        speed > 0.35 && speed < 0.5 && turning > 2.0 && turning < 5.0,
                        "{speed}, {turning}"
                    );
                } else {
                    assert!((speed / swing[0] - 1.0).abs() < 0.1, "{:?} {seed}: {speed}", rehearsal.motion);
                    assert!(
                        (turning / swing[1] - 1.0).abs() < 0.15,
                        "{:?} {seed}: {turning}",
                        rehearsal.motion
                    );
                }
            }
        }
    }
}
