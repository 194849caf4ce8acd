//! Views of a flat printed board into the inside of a camera: focal lengths, centre and lens, and how far to trust them.
//!
//! Each view of a plane gives a homography, and each homography two equations for the focal length (\[Zhang00\]). From
//! there least squares over the inside, the pose of the board in each view, its bend, and the ratio of the printer's two
//! scales, with Huber's loss. Views that would give a wrong camera are refused by name ([`BoardRefusal`]).

mod fit;
mod refusal;
mod start;

#[cfg(test)]
mod tests;

pub use refusal::BoardRefusal;
pub(crate) use start::{off_plane_px, pose_of_plane};

use crate::model::{ProjectorModel, INTRINSICS, PARAMETERS};
use crate::projector::{predict, LightError, Priors};
use dpm_device::planes::Raster;
use fit::{BoardFit, BoardUnknowns};
use glam::{DMat3, DVec2, DVec3};

/// A point of the board in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardPoint {
    /// On the board, metres from its middle: x to the right and y up as printed.
    pub place: DVec2,
    /// Pixels from the picture's upper left corner, y down.
    pub pixel: DVec2,
    /// Expected deviation along each axis, pixels.
    pub sigma_px: f64,
}

/// What a picture shows of the board, which was held still.
pub type BoardView = Vec<BoardPoint>;

/// The inside of a camera, and how far to trust it.
#[derive(Clone, Debug)]
pub struct CameraFit {
    /// Focal lengths, centre and lens; it stands at the origin and looks along -Z with y up.
    pub model: ProjectorModel,
    /// Covariance of its numbers; those of the pose are 0.
    pub covariance: Vec<Vec<f64>>,
    /// By how many pixels it may show a direction wrong, over the whole picture.
    pub predicted: LightError,
    /// Root mean square residual along one axis, pixels.
    pub rms_px: f64,
    /// By how far the board bulges between its middle and its edge, metres.
    pub bend_m: f64,
    /// By how much the print is wider than high, as a share.
    pub stretch: f64,
    /// Views there were.
    pub views: usize,
    /// Those that did not fit the others, or showed too little, and were left out.
    pub left_out: Vec<usize>,
    /// The largest angle between two views of the board, rad.
    pub tilt: f64,
}

impl CameraFit {
    /// Standard deviations of the focal length across, and of the centre along each axis, pixels.
    pub fn deviations(&self) -> [f64; 3] {
        let sigma = |i: usize| self.covariance[i][i].max(0.0).sqrt();
        [self.model.focal.x * sigma(0), sigma(2), sigma(3)]
    }
}

/// What lenses of cameras are expected to have as k1, k2, p1, p2 and k3, give or take.
const LENS_SIGMAS: [f64; 5] = [0.5, 0.5, 3e-3, 3e-3, 0.1];
/// Views that are needed.
pub const LEAST_VIEWS: usize = 6;
/// Points that a view needs.
pub const LEAST_POINTS: usize = 12;
/// Least angle between two views, rad.
const LEAST_TILT: f64 = 0.35;
/// Share of the way from the middle of the picture to its corners that the points must reach.
const LEAST_REACH: f64 = 0.6;
/// A camera that is more uncertain than this is refused, pixels.
const MOST_UNCERTAIN_PX: f64 = 2.0;
/// Residuals beyond which points are none of this board, pixels.
const MOST_RMS_PX: f64 = 1.5;
/// Bulge beyond which a board is no plane, metres, and beyond which a print is stretched.
const MOST_BEND_M: f64 = 1.5e-3;
const MOST_STRETCH: f64 = 0.01;

/// Finds the inside of the camera that took the views.
///
/// # Errors
/// Each reason of [`BoardRefusal`].
pub fn solve(raster: Raster, views: &[BoardView]) -> Result<CameraFit, BoardRefusal> {
    check(raster, views)?;
    let no_board = BoardRefusal::NoBoard { rms_px: f64::INFINITY };
    let mut priors = Priors::many_points(raster);
    for (own, sigma) in priors.lens.iter_mut().zip(LENS_SIGMAS) {
        own[1] = sigma;
    }
    let mut used: Vec<usize> = (0..views.len()).filter(|v| views[*v].len() >= LEAST_POINTS).collect();
    let chosen = |used: &[usize]| used.iter().map(|v| views[*v].clone()).collect::<Vec<BoardView>>();
    let mut state = start::start(raster, &chosen(&used)).ok_or(no_board.clone())?;
    loop {
        let own = chosen(&used);
        let fitted = fit::fit(state, &own, &priors).ok_or(no_board.clone())?;
        let off = fitted.deviations(&own);
        let mut sorted = off.clone();
        sorted.sort_by(f64::total_cmp);
        // A view in which the board moved, or a part of it was covered: far above the usual.
        let most = 3.0 * sorted[sorted.len() / 2];
        let kept: Vec<usize> = (0..used.len()).filter(|i| off[*i] <= most).collect();
        if kept.len() == used.len() {
            let left_out = (0..views.len()).filter(|v| !used.contains(v)).collect();
            return judge(raster, &own, &fitted, left_out);
        }
        if kept.len() < LEAST_VIEWS {
            return Err(BoardRefusal::TooFew { have: kept.len(), need: LEAST_VIEWS });
        }
        state =
            BoardUnknowns { models: kept.iter().map(|i| fitted.state.models[*i]).collect(), ..fitted.state };
        used = kept.into_iter().map(|i| used[i]).collect();
    }
}

/// Refuses what cannot be solved at all.
fn check(raster: Raster, views: &[BoardView]) -> Result<(), BoardRefusal> {
    let good = views.iter().filter(|v| v.len() >= LEAST_POINTS).count();
    if good < LEAST_VIEWS {
        return Err(BoardRefusal::TooFew { have: good, need: LEAST_VIEWS });
    }
    let finite = |p: &BoardPoint| p.place.is_finite() && p.pixel.is_finite() && p.sigma_px > 0.0;
    if let Some(view) = views.iter().position(|v| !v.iter().all(finite)) {
        return Err(BoardRefusal::NotFinite { view });
    }
    let half = 0.5 * size_of(raster);
    let reach = |p: &BoardPoint| (p.pixel - half).length() / half.length();
    let share = views.iter().flatten().map(reach).fold(0.0, f64::max);
    if share < LEAST_REACH {
        return Err(BoardRefusal::MiddleOnly { share: 100.0 * share, need: 100.0 * LEAST_REACH });
    }
    Ok(())
}

fn size_of(raster: Raster) -> DVec2 {
    DVec2::new(f64::from(raster.width()), f64::from(raster.height()))
}

/// Judges a fit.
fn judge(
    raster: Raster,
    views: &[BoardView],
    fitted: &BoardFit,
    left_out: Vec<usize>,
) -> Result<CameraFit, BoardRefusal> {
    let rms_px = fitted.rms_px(views);
    if rms_px.is_nan() || rms_px > MOST_RMS_PX {
        return Err(BoardRefusal::NoBoard { rms_px });
    }
    let tilt = fitted.state.tilt();
    if tilt < LEAST_TILT {
        return Err(BoardRefusal::OneTilt { degrees: tilt.to_degrees() });
    }
    if !fitted.converged {
        return Err(BoardRefusal::NoBoard { rms_px });
    }
    let (bend_m, bend_sigma) = fitted.bend();
    if bend_m > MOST_BEND_M && bend_m > 4.0 * bend_sigma {
        return Err(BoardRefusal::NotFlat { bend_mm: 1e3 * bend_m });
    }
    let (stretch, stretch_sigma) = fitted.stretch();
    if stretch.abs() > MOST_STRETCH && stretch.abs() > 4.0 * stretch_sigma {
        return Err(BoardRefusal::Stretched { percent: 100.0 * stretch });
    }
    let model = ProjectorModel {
        rotation: DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
        translation: DVec3::ZERO,
        origin: DVec3::ZERO,
        ..fitted.state.models[0]
    };
    let camera = model.camera(raster).map_err(|_| BoardRefusal::LensFolds)?;
    let mut covariance = vec![vec![0.0; PARAMETERS]; PARAMETERS];
    for (row, own) in covariance.iter_mut().zip(&fitted.covariance).take(INTRINSICS) {
        row[..INTRINSICS].copy_from_slice(&own[..INTRINSICS]);
    }
    const N: u32 = 24;
    let share = |i: u32| (f64::from(i) + 0.5) / f64::from(N);
    let pixels = (0..N * N).map(|i| DVec2::new(share(i % N), share(i / N)) * size_of(raster));
    let rays: Vec<DVec3> =
        pixels.filter_map(|p| camera.straight_of_pixel(p)).map(|s| DVec3::new(s.x, -s.y, -1.0)).collect();
    let predicted = predict(&model, &covariance, &rays);
    if predicted.p99_px.is_nan() || predicted.p99_px > MOST_UNCERTAIN_PX {
        return Err(BoardRefusal::Uncertain { p99_px: predicted.p99_px, most_px: MOST_UNCERTAIN_PX });
    }
    let views = views.len() + left_out.len();
    Ok(CameraFit { model, covariance, predicted, rms_px, bend_m, stretch, views, left_out, tilt })
}
