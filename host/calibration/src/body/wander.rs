//! A tip that wandered over a surface into the place of the surface: every point is moved towards the plane of the
//! nearest triangle (\[Chen92\]), and the worst tenth is left out, since a tip leaves the surface now and then.

use super::nearest::TriangleTree;
use crate::dense::{solve_spd, svd};
use dpm_common::so3::so3_exp;
use glam::{DAffine3, DMat3, DVec3};
use thiserror::Error;

/// The place of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WanderFit {
    /// Body from mesh; rigid.
    pub mesh_to_body: DAffine3,
    /// Root mean square distance of the points used from the surface, metres.
    pub residual_m: f64,
    /// Points used.
    pub used: usize,
    /// Standard deviation of the place in the direction that the points determine least, metres.
    pub weakest_m: f64,
}

/// Why a wandering tip does not tell the place of a surface.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum WanderError {
    /// Too few points.
    #[error(
        "body: {0} points on the surface are too few, {FEWEST} are needed; move the tip over the whole body"
    )]
    TooFew(usize),
    /// A coordinate is NaN or infinite.
    #[error("body: point {0} is not finite")]
    NotFinite(usize),
    /// The mesh has no triangle.
    #[error("body: the mesh has no triangles")]
    NoSurface,
    /// The surface slides along itself.
    #[error("body: the surface that was touched looks like {shape}: its place is not determined in {free} of 6 directions; move the tip over other sides of the body too, or touch known points instead")]
    Undetermined {
        /// What such a surface is like.
        shape: &'static str,
        /// Directions that are free.
        free: usize,
    },
    /// The points do not lie on the surface.
    #[error("body: the points miss the surface by {residual_mm:.1} mm; touch four known points first for a start, and keep the tip on the body")]
    DoesNotFit {
        /// Root mean square, millimetres.
        residual_mm: f64,
    },
}

/// Fewest points.
const FEWEST: usize = 60;
/// Share of the points that is kept.
const KEPT: f64 = 0.9;
const MOST_RESIDUAL_M: f64 = 2e-3;
/// Least eigenvalue over the number of points, where a direction that all points see has 1.
const LEAST_SEEN: f64 = 2e-3;

/// Finds the place of `surface` from places of the tip in the body's frame. `tip_radius_m` is the radius of a round tip
/// whose middle is given; the tip is outside the surface. `start` is the place from touched points.
///
/// # Errors
/// Each reason of [`WanderError`].
pub fn wander(
    surface: &TriangleTree,
    points: &[DVec3],
    tip_radius_m: f64,
    start: &DAffine3,
) -> Result<WanderFit, WanderError> {
    if let Some(bad) = points.iter().position(|p| !p.is_finite()) {
        return Err(WanderError::NotFinite(bad));
    }
    if points.len() < FEWEST {
        return Err(WanderError::TooFew(points.len()));
    }
    if surface.is_empty() {
        return Err(WanderError::NoSurface);
    }
    let mut motion = start.inverse();
    let mut last = f64::INFINITY;
    for round in 0..60 {
        let step = RoundEquations::of(surface, points, tip_radius_m, &motion);
        if round == 0 || round % 10 == 9 {
            step.check_shape()?;
        }
        let Some(d) = solve_spd(&step.square, &step.right) else {
            return Err(WanderError::Undetermined { shape: "a plane or a sphere", free: 1 });
        };
        let turn = DMat3::from_quat(so3_exp(DVec3::new(d[0], d[1], d[2]) / step.size));
        let shift = DVec3::new(d[3], d[4], d[5]);
        let about = DAffine3::from_translation(step.centre + shift)
            * DAffine3::from_mat3(turn)
            * DAffine3::from_translation(-step.centre);
        motion = about * motion;
        let length = d.iter().map(|v| v * v).sum::<f64>().sqrt();
        if length < 1e-9 || (round > 20 && (last - step.rms).abs() < 1e-9) {
            break;
        }
        last = step.rms;
    }
    let step = RoundEquations::of(surface, points, tip_radius_m, &motion);
    step.check_shape()?;
    if step.rms > MOST_RESIDUAL_M {
        return Err(WanderError::DoesNotFit { residual_mm: 1e3 * step.rms });
    }
    let weakest = step.eigenvalues().last().copied().unwrap_or(0.0);
    Ok(WanderFit {
        mesh_to_body: rigid(&motion.inverse()),
        residual_m: step.rms,
        used: step.used,
        weakest_m: step.rms.max(2e-5) / weakest.sqrt(),
    })
}

/// Without what rounding adds over many steps.
fn rigid(m: &DAffine3) -> DAffine3 {
    let x = m.matrix3.x_axis.normalize();
    let y = (m.matrix3.y_axis - x * x.dot(m.matrix3.y_axis)).normalize();
    DAffine3::from_mat3_translation(DMat3::from_cols(x, y, x.cross(y)), m.translation)
}

/// The equations of one round.
struct RoundEquations {
    square: Vec<Vec<f64>>,
    right: Vec<f64>,
    /// Middle of the points, and their root mean square distance from it: turns are measured in metres at that lever.
    centre: DVec3,
    size: f64,
    rms: f64,
    used: usize,
    /// Eigenvalues of the normals' second moments, descending, over their number.
    normals: [f64; 3],
}

impl RoundEquations {
    fn of(surface: &TriangleTree, points: &[DVec3], radius: f64, motion: &DAffine3) -> Self {
        let placed: Vec<DVec3> = points.iter().map(|p| motion.transform_point3(*p)).collect();
        let mut pairs: Vec<(DVec3, DVec3, f64)> = placed
            .iter()
            .filter_map(|p| surface.nearest(*p).map(|n| (*p, n)))
            .map(|(p, n)| {
                // Away from the surface along its normal; at an edge along the way to the nearest point.
                let along = (p - n.point).dot(n.normal);
                let normal = if along.abs() > 0.5 * n.distance || n.distance < 1e-12 {
                    n.normal
                } else {
                    (p - n.point) / n.distance
                };
                (p, normal, (p - n.point).dot(normal) - radius)
            })
            .collect();
        pairs.sort_by(|a, b| a.2.abs().total_cmp(&b.2.abs()));
        pairs.truncate((KEPT * points.len() as f64) as usize);
        let n = pairs.len().max(1) as f64;
        let centre = pairs.iter().map(|p| p.0).sum::<DVec3>() / n;
        let size = (pairs.iter().map(|p| p.0.distance_squared(centre)).sum::<f64>() / n).sqrt().max(1e-9);
        let mut square = vec![vec![0.0; 6]; 6];
        let mut right = vec![0.0; 6];
        let (mut squares, mut moments) = (0.0, DMat3::ZERO);
        for (p, normal, off) in &pairs {
            let turn = (*p - centre).cross(*normal) / size;
            let row = [turn.x, turn.y, turn.z, normal.x, normal.y, normal.z];
            for (i, a) in row.iter().enumerate() {
                right[i] -= a * off;
                row.iter().enumerate().for_each(|(j, b)| square[i][j] += a * b);
            }
            squares += off * off;
            moments +=
                DMat3::from_cols(*normal * normal.x, *normal * normal.y, *normal * normal.z) * (1.0 / n);
        }
        let values = svd((0..3).map(|i| moments.col(i).to_array().to_vec()).collect()).values;
        Self {
            square,
            right,
            centre,
            size,
            rms: (squares / n).sqrt(),
            used: pairs.len(),
            normals: [values[0], values[1], values[2]],
        }
    }

    fn eigenvalues(&self) -> Vec<f64> {
        svd(self.square.clone()).values
    }

    fn check_shape(&self) -> Result<(), WanderError> {
        let n = self.used.max(1) as f64;
        let free = self.eigenvalues().iter().filter(|v| **v / n < LEAST_SEEN).count();
        let shape = match (free, self.normals) {
            (0, _) => return Ok(()),
            (_, [_, second, _]) if second < 1e-2 => "a plane",
            (3.., _) => "a sphere",
            (2, _) => "a cylinder",
            _ => "a body of revolution, or a profile that runs straight on",
        };
        Err(WanderError::Undetermined { shape, free })
    }
}
