//! Pairs of a world point and the pixel that lights it into a projector: lens, pose, and how far to trust them.
//!
//! [`Session`] collects pairs one by one, says where the next one would help most, and solves: direct linear transform,
//! random samples against wrong pairs, then least squares over lens and pose with Huber's loss and with priors on what
//! a dozen pairs cannot determine. Data that would give a wrong projector are refused by name ([`PointsRefusal`]).

mod fit;
mod refusal;
mod solve;
mod uncertainty;

pub use dpm_calibration_file::LightError;
pub(crate) use fit::spread_of;
use fit::{fit, Fit};
pub use fit::{LensTerms, Priors};
pub use refusal::PointsRefusal;
pub(crate) use solve::{check_result, check_terms, look_for_motion, moved_px};
pub use solve::{relocate, solve, ProjectorFit};
pub(crate) use uncertainty::{percentile, predict_share, variance};
pub use uncertainty::{predict, Volume};

use crate::model::ProjectorModel;
use dpm_device::planes::Raster;
use glam::{DVec2, DVec3};

/// A point of the world and the pixel that lights it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// Metres.
    pub world: DVec3,
    /// Pixels from the raster's upper left corner, y down.
    pub pixel: DVec2,
    /// How fast the point moved, metres a second; zero for one that was held still. From it an offset in time is found.
    pub velocity: DVec3,
}

impl Sight {
    /// A point that was held still.
    pub fn at_rest(world: DVec3, pixel: DVec2) -> Self {
        Self { world, pixel, velocity: DVec3::ZERO }
    }
}

/// What is known of the place of the projector without any measurement. It catches a wrong unit and exchanged axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlaceHint {
    /// Distance from the projector's lens to the middle of the points by a tape measure, metres; right within 30 %.
    pub distance_m: Option<f64>,
    /// Direction of the world in which the upper edge of the picture lies, seen from its middle: +Y for a projector
    /// that stands upright, or hangs upside down, in a world whose Y is up. Right within 45 degrees, either way up.
    pub up: Option<DVec3>,
}

/// How to solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Expected deviation of an aimed point from its pixel along one axis, pixels.
    pub aim_px: f64,
    /// What is expected of the lens before any measurement.
    pub priors: Priors,
    /// What is known of the projector's place.
    pub known: PlaceHint,
    /// Seed of the random samples.
    pub seed: u64,
}

impl Options {
    /// For points that are aimed at by hand.
    pub fn by_hand(raster: Raster) -> Self {
        Self { aim_px: 0.3, priors: Priors::few_points(raster), known: PlaceHint::default(), seed: 1 }
    }
}

/// A calibration in progress.
#[derive(Clone, Debug)]
pub struct Session {
    raster: Raster,
    options: Options,
    volume: Volume,
    sights: Vec<Sight>,
}

/// Where the next point should be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suggestion {
    /// The cross to show.
    pub pixel: DVec2,
    /// Where the tip should be held, roughly; unknown until there is a first solution.
    pub world: Option<DVec3>,
    /// Predicted error there, pixels.
    pub predicted_px: Option<f64>,
}

/// Pixels of the first points, as shares of the raster: the corners in turn, at changing depth, and the middle.
const FIRST: [[f64; 2]; 8] =
    [[0.1, 0.1], [0.9, 0.9], [0.9, 0.1], [0.1, 0.9], [0.5, 0.5], [0.12, 0.5], [0.88, 0.5], [0.5, 0.12]];

impl Session {
    /// An empty session. `volume` is where light will be needed.
    pub fn new(raster: Raster, options: Options, volume: Volume) -> Self {
        Self { raster, options, volume, sights: Vec::new() }
    }

    /// Adds a point.
    pub fn add(&mut self, sight: Sight) {
        self.sights.push(sight);
    }

    /// The points so far, to be saved when the work is interrupted.
    pub fn sights(&self) -> &[Sight] {
        &self.sights
    }

    /// Takes a point away again.
    pub fn remove(&mut self, index: usize) {
        if index < self.sights.len() {
            self.sights.remove(index);
        }
    }

    /// Solves from all points so far.
    ///
    /// # Errors
    /// Each reason of [`PointsRefusal`].
    pub fn solve(&self) -> Result<ProjectorFit, PointsRefusal> {
        solve(self.raster, &self.sights, &self.options, &self.volume)
    }

    /// Where the next point helps most: where the predicted error is largest, or, before there is a solution, where
    /// none has been yet.
    pub fn next_point(&self) -> Suggestion {
        let size = DVec2::new(f64::from(self.raster.width()), f64::from(self.raster.height()));
        if let Ok(solved) = self.solve() {
            let at = solved.predicted.worst;
            if let Some(pixel) = solved.model.project(at) {
                return Suggestion { pixel, world: Some(at), predicted_px: Some(solved.predicted.worst_px) };
            }
        }
        let share = FIRST[self.sights.len() % FIRST.len()];
        Suggestion { pixel: DVec2::from_array(share) * size, world: None, predicted_px: None }
    }

    /// What the operator should do next, one sentence.
    pub fn advice(&self) -> String {
        match self.solve() {
            Ok(solved) => {
                let (p, at) = (&solved.predicted, solved.predicted.worst);
                format!(
                    "predicted error {:.2} px (99th percentile); it is largest, {:.2} px, at ({:.2}, {:.2}, {:.2}) m: aim there next",
                    p.p99_px, p.worst_px, at.x, at.y, at.z
                )
            }
            Err(why) => why.to_string(),
        }
    }
}

/// The middle of points.
pub(crate) fn middle(sights: &[Sight]) -> DVec3 {
    sights.iter().map(|s| s.world).sum::<DVec3>() / sights.len().max(1) as f64
}

/// Distances of the pixels from where a model puts them; infinite behind the projector.
pub(crate) fn misses(model: &ProjectorModel, offset_s: f64, sights: &[Sight]) -> Vec<f64> {
    let miss = |s: &Sight| {
        let pixel = model.project(s.world + s.velocity * offset_s);
        pixel.map_or(f64::INFINITY, |p| (p - s.pixel).length())
    };
    sights.iter().map(miss).collect()
}

#[cfg(test)]
mod tests;
