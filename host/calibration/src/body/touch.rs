//! Touched points of a mesh into its place in the body's frame, by the rotation of least squares (\[Kabsch76\]).

use crate::dense::svd;
use crate::trajectory::TimedPose;
use glam::{DAffine3, DMat3, DVec3};
use thiserror::Error;

/// A point of the mesh, and where the tip was when it touched it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Touch {
    /// In the mesh's frame, metres.
    pub mesh: DVec3,
    /// In the body's frame, metres.
    pub body: DVec3,
}

/// A tip that was held on one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Mean of the tip in the body's frame, metres.
    pub body: DVec3,
    /// Standard deviation of that mean along one axis, metres.
    pub sigma_m: f64,
}

/// Poses that are collected while the tip is on one point.
const FEWEST_POSES: usize = 10;
/// A tip that moves further than this while it is held, metres, is not held.
const HELD_M: f64 = 1e-3;

/// Averages the tip over pairs of the wand's and the body's pose at the same instants.
///
/// # Errors
/// [`TouchError::NotHeld`] for a tip that moved, or for too few poses.
pub fn tip_in_body(tip: DVec3, poses: &[(TimedPose, TimedPose)]) -> Result<Contact, TouchError> {
    let points: Vec<DVec3> = poses
        .iter()
        .map(|(wand, body)| body.rotation.conjugate() * (wand.place(tip) - body.position))
        .collect();
    let n = points.len() as f64;
    let mean = points.iter().sum::<DVec3>() / n;
    let half = points.len() / 2;
    let of = |part: &[DVec3]| part.iter().sum::<DVec3>() / part.len().max(1) as f64;
    let slid_m = (of(&points[..half]) - of(&points[half..])).length();
    if points.len() < FEWEST_POSES || slid_m.is_nan() || slid_m > HELD_M {
        return Err(TouchError::NotHeld { poses: points.len(), slid_mm: 1e3 * slid_m });
    }
    let squares: f64 = points.iter().map(|p| (*p - mean).length_squared()).sum();
    Ok(Contact { body: mean, sigma_m: (squares / (3.0 * (n - 1.0) * n)).sqrt() })
}

/// The place of a mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct TouchFit {
    /// Body from mesh; rigid.
    pub mesh_to_body: DAffine3,
    /// Root mean square distance of the touched points from the mesh's, metres.
    pub residual_m: f64,
    /// Distance of each.
    pub residuals_m: Vec<f64>,
    /// Covariance of a turn about `centre` (three numbers, radians) and of a shift (metres), in the body's frame.
    pub covariance: [DMat3; 2],
    /// Middle of the touched points in the body's frame.
    pub centre: DVec3,
}

impl TouchFit {
    /// Standard deviation of the place of a point of the mesh, metres, root of the sum over three axes.
    pub fn deviation_m(&self, mesh: DVec3) -> f64 {
        let lever = self.mesh_to_body.transform_point3(mesh) - self.centre;
        let by_turn = dpm_common::so3::hat(lever);
        let turned = by_turn * self.covariance[0] * by_turn.transpose();
        let total = turned + self.covariance[1];
        crate::pivot::trace(&total).sqrt()
    }
}

/// Why touched points are refused.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum TouchError {
    /// The tip was not held still, or not long enough.
    #[error("body: the tip moved by {slid_mm:.1} mm on the body within {poses} poses; hold it still on the point for half a second, {FEWEST_POSES} poses at least")]
    NotHeld {
        /// Poses there are.
        poses: usize,
        /// How far it moved, millimetres.
        slid_mm: f64,
    },
    /// Fewer than four.
    #[error("body: touched points: {0}; at least 4 are needed, far apart")]
    TooFew(usize),
    /// A coordinate is NaN or infinite.
    #[error("body: touched point {0} is not finite; remove it")]
    NotFinite(usize),
    /// The points lie on a line.
    #[error("body: the touched points lie on a line; touch one that is far from it")]
    Collinear,
    /// The points fit the mirror image of the mesh.
    #[error("body: mirrored: the touched points fit a mirror image of the mesh ({mirrored_mm:.1} mm, not {straight_mm:.1} mm); the mesh's or the tracker's axes are left-handed, or left and right points were exchanged")]
    Mirrored {
        /// Residual with a mirror, millimetres.
        mirrored_mm: f64,
        /// Residual without one, millimetres.
        straight_mm: f64,
    },
    /// The mesh has another size.
    #[error("body: wrong unit: the touched points are {scale:.4} times as far apart as those of the mesh; look at the unit of the mesh and of the tracker")]
    WrongScale {
        /// Size of the touched points over that of the mesh's.
        scale: f64,
    },
    /// One point does not fit the others.
    #[error("body: point {point} is off by {off_mm:.1} mm, the others fit; was another point touched? touch it again")]
    WrongPoint {
        /// Its number.
        point: usize,
        /// Its distance, millimetres.
        off_mm: f64,
    },
    /// Nothing fits.
    #[error("body: the touched points miss the mesh by {residual_mm:.1} mm; was the order of the points kept, is it this mesh?")]
    DoesNotFit {
        /// Root mean square, millimetres.
        residual_mm: f64,
    },
}

/// Touched points, one by one.
#[derive(Clone, Debug, Default)]
pub struct TouchSession {
    touches: Vec<Touch>,
    /// Corners of the mesh's box and such: points that could be touched.
    candidates: Vec<DVec3>,
}

impl TouchSession {
    /// A session that will suggest points among `candidates`, vertices of the mesh.
    pub fn new(candidates: Vec<DVec3>) -> Self {
        Self { touches: Vec::new(), candidates }
    }

    /// Adds a touched point.
    pub fn add(&mut self, touch: Touch) {
        self.touches.push(touch);
    }

    /// The point of the mesh that should be touched next: the candidate furthest from all that were. `None` without
    /// candidates.
    pub fn next_point(&self) -> Option<DVec3> {
        let n = self.candidates.len().max(1) as f64;
        let middle = self.candidates.iter().sum::<DVec3>() / n;
        let far = |c: &DVec3| {
            let nearest = self.touches.iter().map(|t| t.mesh.distance(*c)).fold(f64::INFINITY, f64::min);
            if nearest.is_finite() {
                nearest
            } else {
                c.distance(middle)
            }
        };
        self.candidates.iter().copied().max_by(|a, b| far(a).total_cmp(&far(b)))
    }

    /// Solves from all points so far.
    ///
    /// # Errors
    /// Each reason of [`TouchError`].
    pub fn solve(&self) -> Result<TouchFit, TouchError> {
        solve(&self.touches)
    }
}

/// A residual that no touching hand explains, metres.
const MOST_RESIDUAL_M: f64 = 3e-3;
/// Assumed deviation of a touch along one axis where the residuals say little, metres.
const TOUCH_M: f64 = 5e-5;

/// Finds the rigid motion that takes the mesh's points onto the touched ones.
pub(super) fn solve(touches: &[Touch]) -> Result<TouchFit, TouchError> {
    if let Some(bad) = touches.iter().position(|t| !(t.mesh.is_finite() && t.body.is_finite())) {
        return Err(TouchError::NotFinite(bad));
    }
    if touches.len() < 4 {
        return Err(TouchError::TooFew(touches.len()));
    }
    let n = touches.len() as f64;
    let (mesh, body) = middles(touches);
    let spread = |f: &dyn Fn(&Touch) -> DVec3| {
        let columns = (0..3).map(|a| touches.iter().map(|t| f(t)[a]).collect()).collect();
        svd(columns).values
    };
    let (of_mesh, of_body) = (spread(&|t| t.mesh - mesh), spread(&|t| t.body - body));
    if of_mesh[1] < 0.05 * of_mesh[0] || of_body[1] < 0.05 * of_body[0] || of_mesh[0] <= 0.0 {
        return Err(TouchError::Collinear);
    }
    let size = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let scale = size(&of_body) / size(&of_mesh);
    let straight = align(touches, false);
    let rms = |m: &DAffine3| (distances(m, touches).iter().map(|d| d * d).sum::<f64>() / n).sqrt();
    let residual_m = rms(&straight);
    if !(0.9..1.1).contains(&scale) {
        return Err(TouchError::WrongScale { scale });
    }
    if residual_m > MOST_RESIDUAL_M {
        let mirrored = rms(&align(touches, true));
        if mirrored < 0.3 * residual_m && mirrored < MOST_RESIDUAL_M {
            return Err(TouchError::Mirrored { mirrored_mm: 1e3 * mirrored, straight_mm: 1e3 * residual_m });
        }
        return Err(wrong_point(touches).unwrap_or(TouchError::DoesNotFit { residual_mm: 1e3 * residual_m }));
    }
    // Few residuals say little: what is usual counts as two more points. Six numbers were fitted.
    let squares = n * residual_m.powi(2) + 6.0 * TOUCH_M.powi(2);
    let variance = squares / (3.0 * n - 6.0 + 6.0);
    let variance = variance.max(n * residual_m.powi(2) / (3.0 * n - 6.0));
    let mut inertia = DMat3::ZERO;
    for t in touches {
        let lever = dpm_common::so3::hat(straight.transform_vector3(t.mesh - mesh));
        inertia += lever.transpose() * lever;
    }
    Ok(TouchFit {
        mesh_to_body: straight,
        residual_m,
        residuals_m: distances(&straight, touches),
        covariance: [inertia.inverse() * variance, DMat3::IDENTITY * (variance / n)],
        centre: body,
    })
}

/// The point without which the others fit.
fn wrong_point(touches: &[Touch]) -> Option<TouchError> {
    let found = (0..touches.len()).filter(|_| touches.len() >= 5).map(|point| {
        let others: Vec<Touch> =
            touches.iter().enumerate().filter(|(i, _)| *i != point).map(|(_, t)| *t).collect();
        let motion = align(&others, false);
        let worst = distances(&motion, &others).into_iter().fold(0.0, f64::max);
        (worst, point, distances(&motion, touches)[point])
    });
    let (worst, point, off) = found.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (worst < MOST_RESIDUAL_M).then_some(TouchError::WrongPoint { point, off_mm: 1e3 * off })
}

fn middles(touches: &[Touch]) -> (DVec3, DVec3) {
    let n = touches.len() as f64;
    (touches.iter().map(|t| t.mesh).sum::<DVec3>() / n, touches.iter().map(|t| t.body).sum::<DVec3>() / n)
}

fn distances(motion: &DAffine3, touches: &[Touch]) -> Vec<f64> {
    touches.iter().map(|t| motion.transform_point3(t.mesh).distance(t.body)).collect()
}

/// The rotation and shift of least squares; with `mirror`, the best among those that mirror.
fn align(touches: &[Touch], mirror: bool) -> DAffine3 {
    let (mesh, body) = middles(touches);
    let mut product = DMat3::ZERO;
    for t in touches {
        let (m, b) = (t.mesh - mesh, t.body - body);
        product += DMat3::from_cols(b * m.x, b * m.y, b * m.z);
    }
    let s = svd((0..3).map(|i| product.col(i).to_array().to_vec()).collect());
    let v = |i: usize| DVec3::new(s.vectors[i][0], s.vectors[i][1], s.vectors[i][2]);
    let (v0, v1) = (v(0), v(1));
    let u0 = (product * v0).normalize_or(DVec3::X);
    let u1 = (product * v1 - u0 * u0.dot(product * v1)).normalize_or(u0.any_orthonormal_vector());
    // The third pair completes both to right-handed triples, so the rotation is proper.
    let sign = if mirror { -1.0 } else { 1.0 };
    let from = DMat3::from_cols(v0, v1, v0.cross(v1));
    let to = DMat3::from_cols(u0, u1, u0.cross(u1) * sign);
    let rotation = to * from.transpose();
    DAffine3::from_mat3_translation(rotation, body - rotation * mesh)
}
