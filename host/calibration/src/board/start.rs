//! Where least squares begin: a homography for each view, the focal length from all of them, then the poses.

use super::fit::BoardUnknowns;
use super::{size_of, BoardPoint, BoardView};
use crate::dense::svd;
use crate::model::{ProjectorModel, LENS};
use dpm_device::planes::Raster;
use glam::{DMat3, DVec2, DVec3};

/// Focal lengths that are tried, as shares of the picture's width, where the homographies give none.
const USUAL: [f64; 4] = [0.5, 0.8, 1.3, 2.5];

/// The start; `None` if a view is no picture of a plane, or nothing gives a focal length.
pub(super) fn start(raster: Raster, views: &[BoardView]) -> Option<BoardUnknowns> {
    let (centre, width) = (0.5 * size_of(raster), f64::from(raster.width()));
    let homographies: Option<Vec<DMat3>> = views.iter().map(|v| homography(v, centre, width)).collect();
    let homographies = homographies?;
    let focal = focal(&homographies).unwrap_or(0.0);
    let tried = std::iter::once(focal).chain(USUAL).filter(|f| (0.2..20.0).contains(f));
    let states = tried.filter_map(|f| {
        let models: Option<Vec<ProjectorModel>> =
            homographies.iter().map(|h| model(h, f, centre, width)).collect();
        let state = BoardUnknowns { models: models?, board: [0.0; 4], half: half_of(views) };
        let cost = state.cost(views);
        cost.is_finite().then_some((cost, state))
    });
    // The first one is that of the homographies, if there is one.
    let states: Vec<(f64, BoardUnknowns)> = states.collect();
    let best = states.iter().enumerate().min_by(|a, b| a.1 .0.total_cmp(&b.1 .0))?.0;
    states.into_iter().nth(best).map(|s| s.1)
}

/// A camera about a flat thing that it sees, or a projector about one that it lights: `focal` as a share of the width.
pub(crate) fn pose_of_plane(
    points: &[BoardPoint],
    focal: f64,
    centre: DVec2,
    width: f64,
) -> Option<ProjectorModel> {
    model(&homography(points, centre, width)?, focal, centre, width)
}

/// How far points lie from the picture of any plane, root mean square, pixels; `None` if they are no picture of anything.
pub(crate) fn off_plane_px(points: &[BoardPoint], centre: DVec2, width: f64) -> Option<f64> {
    let h = homography(points, centre, width)?;
    let off = |p: &BoardPoint| {
        let q = h * DVec3::new(p.place.x, -p.place.y, 1.0);
        (q.truncate() / q.z * width + centre - p.pixel).length_squared()
    };
    Some((points.iter().map(off).sum::<f64>() / points.len() as f64).sqrt())
}

/// Half the extent of the points on the board, metres.
fn half_of(views: &[BoardView]) -> f64 {
    views.iter().flatten().map(|p| p.place.length()).fold(1e-3, f64::max)
}

/// From the board, metres with y down, to pixels from the centre over the picture's width: least squares of the algebraic
/// distance, in coordinates of unit spread.
fn homography(view: &[BoardPoint], centre: DVec2, width: f64) -> Option<DMat3> {
    let n = view.len() as f64;
    let own = |p: DVec2| DVec2::new(p.x, -p.y);
    let middle = view.iter().map(|p| own(p.place)).sum::<DVec2>() / n;
    let spread = view.iter().map(|p| (own(p.place) - middle).length()).sum::<f64>() / n;
    if spread.is_nan() || spread <= 0.0 {
        return None;
    }
    let mut columns = vec![vec![0.0; 2 * view.len()]; 9];
    for (i, p) in view.iter().enumerate() {
        let (b, q) = ((own(p.place) - middle) / spread, (p.pixel - centre) / width);
        let place = [b.x, b.y, 1.0];
        for k in 0..3 {
            columns[k][2 * i] = place[k];
            columns[3 + k][2 * i + 1] = place[k];
            columns[6 + k][2 * i] = -q.x * place[k];
            columns[6 + k][2 * i + 1] = -q.y * place[k];
        }
    }
    let found = svd(columns);
    let h = found.vectors.last()?;
    let rows = DMat3::from_cols_slice(h).transpose();
    let back = DMat3::from_cols(
        DVec3::X / spread,
        DVec3::Y / spread,
        DVec3::new(-middle.x / spread, -middle.y / spread, 1.0),
    );
    let h = rows * back;
    // The board lies in front of the camera.
    let h = if h.z_axis.z < 0.0 { -h } else { h };
    (h.is_finite() && h.determinant().abs() > 0.0).then_some(h)
}

/// The focal length over the picture's width, with the centre in the middle and square pixels: columns of the homography
/// are across each other and equally long once it is divided out. `None` if no view is tilted.
fn focal(homographies: &[DMat3]) -> Option<f64> {
    let (mut upper, mut lower) = (0.0, 0.0);
    for h in homographies {
        let scale = h.x_axis.length() * h.y_axis.length();
        let (a, b) = (h.x_axis / scale.sqrt(), h.y_axis / scale.sqrt());
        for (flat, deep) in [
            (a.x * b.x + a.y * b.y, a.z * b.z),
            (a.x * a.x + a.y * a.y - b.x * b.x - b.y * b.y, a.z * a.z - b.z * b.z),
        ] {
            // flat / f^2 + deep = 0.
            upper -= flat * deep;
            lower += deep * deep;
        }
    }
    let squared = upper / lower;
    // flat = -f^2 deep, so f^2 is the slope of flat over -deep.
    (squared.is_finite() && squared > 0.0).then(|| squared.sqrt())
}

/// The camera about the board, whose axes are x to the right, y up and z towards the reader.
fn model(h: &DMat3, focal: f64, centre: DVec2, width: f64) -> Option<ProjectorModel> {
    let out = DMat3::from_diagonal(DVec3::new(1.0 / focal, 1.0 / focal, 1.0)) * *h;
    let scale = 0.5 * (out.x_axis.length() + out.y_axis.length());
    let (x, y) = (out.x_axis.try_normalize()?, out.y_axis.try_normalize()?);
    let (sum, difference) = ((x + y).try_normalize()?, (x - y).try_normalize()?);
    let (x, y) = ((sum + difference).normalize(), (sum - difference).normalize());
    // y of the homography runs down.
    let rotation = DMat3::from_cols(x, -y, -x.cross(y));
    Some(ProjectorModel {
        focal: DVec2::splat(focal * width),
        centre,
        lens: [0.0; LENS],
        rotation,
        translation: out.z_axis / scale,
        origin: DVec3::ZERO,
    })
}
