//! What the solvers must find, drawn from a seed: the projector, the wand, the bodies, the delays and the light.

use crate::model::ProjectorModel;
use crate::projector::Volume;
use dpm_common::so3::so3_exp;
use dpm_device::planes::Raster;
use dpm_device::rng::{Draws, Sampler};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec2, DVec3};

/// Everything that is true of a rehearsed rig.
#[derive(Clone, Debug)]
pub(super) struct Truth {
    pub raster: Raster,
    pub projector: ProjectorModel,
    /// Where light is needed, and where the wand moves.
    pub volume: Volume,
    /// In the wand's body frame, metres.
    pub tip: DVec3,
    /// Body from mesh, of each body.
    pub mesh_to_body: Vec<DAffine3>,
    /// A pose is stamped this much after it was taken.
    pub latency_ns: f64,
    /// The sensor's clock against the host's.
    pub sensor_drift: f64,
    /// Reading of the sensor's clock at the host's zero, nanoseconds.
    pub sensor_offset_ns: i64,
    /// Exponent and toe of the response of each channel: `(1 - toe) code^exponent + toe code`.
    pub response: [[f64; 2]; 3],
    /// Brightness of each channel at code 1, in the middle of the raster; they add up to 1.
    pub intensity: [f64; 3],
    /// Brightness over the raster, 1 in its middle: second order in x and y from -1 to 1.
    pub flat: [f64; 5],
    /// Brightness at code 0 over that at code 1.
    pub black: f64,
    /// Ambient light over full light, without its flicker, and the flicker's part of it.
    pub ambient: [f64; 2],
}

impl Truth {
    pub(super) fn draw(seed: u64) -> Self {
        let mut s = Sampler::new(seed, 0x7247);
        let mut u = |low: f64, high: f64| low + (high - low) * s.uniform();
        let raster = Raster::new(1024, 768).expect("its sides are small");
        let volume = Volume { low: DVec3::new(-0.3, -0.225, -0.175), high: DVec3::new(0.3, 0.225, 0.175) };
        let from = DVec3::new(u(-0.5, 0.5), u(-0.2, 0.6), u(1.05, 1.4));
        let at = DVec3::new(u(-0.03, 0.03), u(-0.03, 0.03), 0.0);
        let camera = ProjectorCamera::look_at(raster, from, at, DVec3::Y, u(0.56, 0.64));
        let camera = camera.expect("it looks at another point than its own place");
        let lens = [u(-0.2, 0.15), u(-0.1, 0.1), u(-2e-3, 2e-3), u(-2e-3, 2e-3), u(-0.05, 0.05)];
        let mut projector = ProjectorModel::from_camera(&camera, lens, DVec3::ZERO);
        projector.centre += DVec2::new(u(-20.0, 20.0), u(-40.0, 40.0));
        projector.focal.y *= u(0.99, 1.01);
        let direction = DVec3::new(u(-1.0, 1.0), u(-1.0, 1.0), u(-1.0, 1.0)).normalize_or(DVec3::X);
        let tip = direction * u(0.08, 0.2);
        let mut turn = || so3_exp(DVec3::new(u(-1.5, 1.5), u(-1.5, 1.5), u(-1.5, 1.5)));
        let turns: Vec<DQuat> = (0..2).map(|_| turn()).collect();
        let mut shift = || DVec3::new(u(-0.05, 0.05), u(-0.05, 0.05), u(-0.05, 0.05));
        let mesh_to_body = turns.iter().map(|q| DAffine3::from_rotation_translation(*q, shift())).collect();
        let response = [0; 3].map(|_| [u(0.8, 2.4), u(0.0, 0.2)]);
        let raw = [u(0.7, 1.3), u(0.7, 1.3), u(0.7, 1.3)];
        let sum: f64 = raw.iter().sum();
        Self {
            raster,
            projector,
            volume,
            tip,
            mesh_to_body,
            latency_ns: u(0.0, 8e6),
            sensor_drift: u(-50e-6, 50e-6),
            sensor_offset_ns: u(-3e9, 3e9) as i64,
            response,
            intensity: raw.map(|i| i / sum),
            flat: [u(-0.1, 0.1), u(-0.1, 0.1), u(-0.2, 0.0), u(-0.05, 0.05), u(-0.2, 0.0)],
            black: u(5e-4, 5e-3),
            ambient: [u(0.02, 0.2), u(0.1, 0.6)],
        }
    }

    /// Brightness at a pixel over that in the middle of the raster.
    pub(super) fn flat(&self, pixel: DVec2) -> f64 {
        let size = DVec2::new(f64::from(self.raster.width()), f64::from(self.raster.height()));
        let p = 2.0 * pixel / size - 1.0;
        let [x, y, xx, xy, yy] = self.flat;
        1.0 + x * p.x + y * p.y + xx * p.x * p.x + xy * p.x * p.y + yy * p.y * p.y
    }

    /// Brightness of a channel over that at code 1.
    pub(super) fn response(&self, channel: usize, code: f64) -> f64 {
        let [exponent, toe] = self.response[channel];
        (1.0 - toe) * code.powf(exponent) + toe * code
    }
}

/// The hand that holds the wand: a closed form of time.
#[derive(Clone, Debug)]
pub(super) struct Hand {
    /// Amplitude (metres), frequency (radians a second) and phase of two waves along each axis.
    waves: [[[f64; 3]; 2]; 3],
    /// The same of the turn, radians.
    turns: [[f64; 3]; 3],
    rest: DQuat,
}

impl Hand {
    /// Moves the tip through the volume at 0.2 to 0.8 m/s.
    pub(super) fn sweeping(volume: &Volume, seed: u64) -> Self {
        let mut s = Sampler::new(seed, 0x4a2d);
        let mut u = |low: f64, high: f64| low + (high - low) * s.uniform();
        let half = 0.5 * (volume.high - volume.low);
        let tau = std::f64::consts::TAU;
        let waves = [0, 1, 2].map(|axis| {
            [[0.85, u(0.22, 0.36)], [0.4, u(0.45, 0.75)]].map(|[a, f]| [a * half[axis], tau * f, u(0.0, tau)])
        });
        let turns = [0; 3].map(|_| [u(0.35, 0.6), tau * u(0.2, 0.5), u(0.0, tau)]);
        Self { waves, turns, rest: so3_exp(DVec3::new(u(-1.0, 1.0), u(-1.0, 1.0), u(-1.0, 1.0))) }
    }

    /// Turns about a tip that stays in place.
    pub(super) fn pivoting(seed: u64) -> Self {
        let mut hand = Self::sweeping(&Volume { low: DVec3::ZERO, high: DVec3::ZERO }, seed);
        hand.turns.iter_mut().for_each(|t| t[0] = 0.55);
        hand
    }

    /// Where the tip is, and how the wand is turned, at a time in seconds.
    pub(super) fn at(&self, s: f64) -> (DVec3, DQuat) {
        let wave = |[a, f, p]: [f64; 3]| a * (f * s + p).sin();
        let place = DVec3::from_array(self.waves.map(|w| w.iter().map(|w| wave(*w)).sum()));
        (place, so3_exp(DVec3::from_array(self.turns.map(wave))) * self.rest)
    }
}

/// A bias of the tracker, metres: what no mean removes.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Bias {
    /// None.
    None,
    /// The reported place wanders around the true one over seconds; the number is its root mean square along an axis.
    Wandering(f64),
    /// The reported place is off by an amount that depends on the place; the number is as above.
    Fixed(f64),
}

impl Bias {
    /// The bias at a place and time.
    pub(super) fn at(self, place: DVec3, s: f64, seed: u64) -> DVec3 {
        let d = Draws::new(seed).stream(0xb1a5);
        let tau = std::f64::consts::TAU;
        let waves = |rms: f64, argument: &dyn Fn(u64) -> f64| {
            // Two waves of equal size along each axis.
            DVec3::from_array(std::array::from_fn(|axis| {
                (0..2).map(|k| rms * (argument(2 * axis as u64 + k)).sin()).sum()
            }))
        };
        match self {
            Self::None => DVec3::ZERO,
            Self::Wandering(rms) => waves(rms, &|i| tau * (s / (4.0 + 16.0 * d.unit(i)) + d.unit(100 + i))),
            Self::Fixed(rms) => waves(rms, &|i| {
                let direction = DVec3::from_array(d.normal3(200 + i)).normalize_or(DVec3::X);
                tau * (place.dot(direction) / (0.3 + 0.6 * d.unit(i)) + d.unit(100 + i))
            }),
        }
    }
}
