//! A sweep of the wand in progress: samples and poses as they come, and what the hand should do next.

use super::{decode, solve, Block, Code, Decoded, Settings, Solution};
use crate::trajectory::{Stamped, Trajectory};
use glam::{DVec2, DVec3};

/// Samples and poses that are collected while the wand moves.
#[derive(Clone, Debug)]
pub struct Session {
    code: Code,
    settings: Settings,
    blocks: Vec<Block>,
    poses: Vec<Stamped>,
}

/// How much of the raster has been seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// Frames that were decoded.
    pub frames: usize,
    /// Share of the cells of a grid of 8 x 6 over the raster that were seen.
    pub share: f64,
    /// Middle of the cell that was seen least.
    pub emptiest: DVec2,
}

const CELLS: [usize; 2] = [8, 6];
/// Frames in a cell that count as seen.
const ENOUGH: usize = 20;

impl Session {
    /// An empty session.
    pub fn new(code: Code, settings: Settings) -> Self {
        Self { code, settings, blocks: Vec::new(), poses: Vec::new() }
    }

    /// Adds samples.
    pub fn add_samples(&mut self, block: Block) {
        self.blocks.push(block);
    }

    /// Adds a pose of the wand.
    pub fn add_pose(&mut self, pose: Stamped) {
        self.poses.push(pose);
    }

    /// Finds the frames in all samples so far; see [`decode()`].
    ///
    /// # Errors
    /// Each reason of [`super::DecodeError`].
    pub fn decode(&self, sensor_minus_host_ns: i64) -> Result<Decoded, super::DecodeError> {
        decode(&self.code, &self.settings.timing, &self.blocks, sensor_minus_host_ns)
    }

    /// Solves from decoded frames and all poses so far; see [`solve()`].
    ///
    /// # Errors
    /// Each reason of [`super::SensorError`].
    pub fn solve(&self, decoded: &Decoded) -> Result<Solution, super::SensorError> {
        solve(&self.code, decoded, &Trajectory::new(&self.poses), &self.settings)
    }

    /// How much of the raster the frames have seen.
    pub fn coverage(&self, decoded: &Decoded) -> Coverage {
        let size = DVec2::new(f64::from(self.code.raster().width()), f64::from(self.code.raster().height()));
        let cell = size / DVec2::new(CELLS[0] as f64, CELLS[1] as f64);
        let mut counts = vec![0usize; CELLS[0] * CELLS[1]];
        for frame in &decoded.frames {
            let at = super::start::pixel_of(&self.code, frame) / cell;
            let index = (at.y as usize).min(CELLS[1] - 1) * CELLS[0] + (at.x as usize).min(CELLS[0] - 1);
            counts[index] += 1;
        }
        let seen = counts.iter().filter(|c| **c >= ENOUGH).count();
        let least = counts.iter().enumerate().min_by_key(|(_, c)| **c).map_or(0, |(i, _)| i);
        let middle = DVec2::new((least % CELLS[0]) as f64 + 0.5, (least / CELLS[0]) as f64 + 0.5) * cell;
        Coverage { frames: decoded.frames.len(), share: seen as f64 / counts.len() as f64, emptiest: middle }
    }

    /// What the hand should do next, one sentence.
    pub fn advice(&self, decoded: &Decoded) -> String {
        let coverage = self.coverage(decoded);
        if coverage.share < 0.85 {
            let DVec2 { x, y } = coverage.emptiest;
            let share = 100.0 * coverage.share;
            return format!("{share:.0} % of the picture is seen; move the sensor to pixel ({x:.0}, {y:.0}), near and far");
        }
        match self.solve(decoded) {
            Ok(solution) => {
                let (p, DVec3 { x, y, z }) = (solution.predicted, solution.predicted.worst);
                format!(
                    "predicted error {:.2} px (99th percentile, without a bias of the tracker); it is largest, {:.2} px, \
                     at ({x:.2}, {y:.2}, {z:.2}) m: move there too, or stop",
                    p.p99_px, p.worst_px
                )
            }
            Err(why) => why.to_string(),
        }
    }
}
