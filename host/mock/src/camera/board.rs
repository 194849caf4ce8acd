//! A printed board in a hand: still at one drawn place after another, before a camera.

use super::{MarkedBody, MockCameraConfig, PrintedTag};
use crate::motion::{add, multiply, rotate, Motion, MotionError};
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_device::tag36h11::TagBoard;

/// How a board is held.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardHold {
    /// The board.
    pub board: TagBoard,
    /// By how far its left and right ends lie before its middle, metres: a sheet that bends.
    pub bend_m: f64,
    /// The largest angle between the board and the picture, rad.
    pub tilt: f64,
    /// Places, 1 to 1000; it stays at the last one.
    pub places: u32,
    /// Time at each place, and from one to the next, nanoseconds, above 0.
    pub rest_ns: i64,
    /// Seed of the places.
    pub seed: u64,
}

impl Default for BoardHold {
    /// 200 places, a second each.
    fn default() -> Self {
        let board = TagBoard::SMALL;
        Self { board, bend_m: 0.0, tilt: 0.7, places: 200, rest_ns: 1_000_000_000, seed: 1 }
    }
}

/// How often the pose of a place stands in the path, which goes through four poses at a time: on three of eight steps the board
/// moves.
const STEPS: usize = 8;

impl BoardHold {
    /// The board as a body before the camera.
    ///
    /// # Errors
    /// A pose is not rigid, which only numbers that are not finite make.
    pub fn body(&self, config: &MockCameraConfig) -> Result<MarkedBody, MotionError> {
        let places: Vec<Pose> = (0..self.places.clamp(1, 1000)).map(|k| self.place(config, k)).collect();
        let poses: Vec<Pose> = places.iter().flat_map(|p| [*p; STEPS]).collect();
        let motion = Motion::through(Pose::IDENTITY, &poses, self.rest_ns / STEPS as i64)?;
        Ok(MarkedBody { motion, tags: self.tags(), markers: vec![] })
    }

    /// Its tags, each flat where the sheet is.
    fn tags(&self) -> Vec<PrintedTag> {
        let half = 0.5 * self.board.size_m()[0];
        let tag = |(id, [x, y]): (u16, [f64; 2])| {
            let rise = self.bend_m * (x / half) * (x / half);
            // The slope of the parabola turns it about y.
            let turn = -0.5 * libm::atan(2.0 * self.bend_m * x / (half * half));
            let rotation_xyzw = [0.0, libm::sin(turn), 0.0, libm::cos(turn)];
            PrintedTag {
                id,
                side_m: self.board.side_m,
                place: Pose { position_m: [x, y, rise], rotation_xyzw },
            }
        };
        self.board.tags().map(tag).collect()
    }

    /// Where the board is held: at a drawn place of the picture, as large as the picture bears, and turned.
    fn place(&self, config: &MockCameraConfig, k: u32) -> Pose {
        let draws = Draws::new(self.seed).stream(0x626f_6172).stream(u64::from(k));
        let aside = |i: u64| 2.0 * draws.unit(i) - 1.0;
        let optics = &config.optics;
        let size = optics.size.map(f64::from);
        let share = 0.35 + 0.35 * draws.unit(0);
        let distance = optics.focal[0] * self.board.size_m()[0] / (share * size[0]);
        let across = |i: usize| 0.42 * aside(1 + i as u64) * size[i] / optics.focal[i] * distance;
        let about = |axis: [f64; 3], angle: f64| {
            let (s, c) = (libm::sin(0.5 * angle), libm::cos(0.5 * angle));
            [axis[0] * s, axis[1] * s, axis[2] * s, c]
        };
        let direction = std::f64::consts::TAU * draws.unit(3);
        let tilted =
            about([libm::cos(direction), libm::sin(direction), 0.0], self.tilt * (0.3 + 0.7 * draws.unit(4)));
        let turned = multiply(about([0.0, 0.0, 1.0], 0.6 * aside(5)), tilted);
        let eye = &config.pose;
        Pose {
            position_m: add(eye.position_m, rotate(eye.rotation_xyzw, [across(0), across(1), -distance])),
            rotation_xyzw: multiply(eye.rotation_xyzw, turned),
        }
    }
}
