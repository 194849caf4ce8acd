//! Why points do not make a projector, and what the operator should do about it.

use crate::pinhole::CalibrationError;
use thiserror::Error;

/// Why points are refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum PointsRefusal {
    /// Too few points.
    #[error("projector: {have} points are too few, {need} are needed, at two distances at least")]
    TooFew {
        /// Points there are.
        have: usize,
        /// Points needed.
        need: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("projector: point {0} is not finite; remove it")]
    NotFinite(usize),
    /// A pixel lies far outside the raster.
    #[error(
        "projector: the pixel of point {0} lies outside the raster; remove it, or look at the raster's size"
    )]
    OutsideRaster(usize),
    /// The points lie in a plane, on a line or in one place.
    #[error("projector: the points lie in a plane, up to {off_plane_mm:.1} mm; lens and distance cannot be told apart: add points nearer to the projector and farther from it")]
    Planar {
        /// Root mean square distance from the plane, millimetres.
        off_plane_mm: f64,
    },
    /// All points are about as far from the projector.
    #[error("projector: all points lie at one depth: they differ by {share:.0} % of the distance, 10 % are needed and 25 % are good; add points nearer and farther")]
    OneDepth {
        /// Range of the depths over their mean, percent.
        share: f64,
    },
    /// Left and right, or up and down, are exchanged.
    #[error("projector: mirrored: the points fit only a projector that shows a mirror image; one axis of the world has the wrong sign (a left-handed tracker), or the picture is flipped for projection from behind: set that right in the tracker or in the projector's menu")]
    Mirrored,
    /// Points are given in another unit than metres.
    #[error("projector: wrong unit: the projector would be {distance_m:.4} m away, not about {expected_m} m: the points are {factor} times too large, {hint}; set the tracker's unit")]
    WrongUnit {
        /// Distance that the points give, metres.
        distance_m: f64,
        /// Distance that was told, or is usual, metres.
        expected_m: f64,
        /// The factor that explains it.
        factor: f64,
        /// What has that factor.
        hint: &'static str,
    },
    /// The distance is wrong by a factor that no unit explains.
    #[error("projector: the projector would be {distance_m:.3} m away, not about {expected_m} m; look at the tracker's scale and at the tape measure")]
    WrongDistance {
        /// Distance that the points give, metres.
        distance_m: f64,
        /// Distance that was told, metres.
        expected_m: f64,
    },
    /// The tracker's world has another axis up.
    #[error("projector: axes are exchanged: the picture's up points along {found} of the tracker's world, not along {expected}; the tracker is set to {found} up: set it to {expected} up, or give the tracker's transform")]
    AxesExchanged {
        /// The axis found.
        found: &'static str,
        /// The axis that was told.
        expected: &'static str,
    },
    /// The points were measured at other instants than they were lit, by more than any latency.
    #[error("projector: the points are late by {offset_ms:.1} ms: more than any latency; look at the clocks of tracker and host")]
    TimeShifted {
        /// Offset, milliseconds.
        offset_ms: f64,
    },
    /// Something moved between the points.
    #[error("projector: mixed data: points up to number {last_before} and those after it agree among themselves, but not with each other: tracker or projector moved by about {moved_mm:.0} mm and {turned_deg:.2} deg; begin again, or remove one of the groups")]
    Moved {
        /// The last point before the motion.
        last_before: usize,
        /// How far the projector seems to have moved, millimetres.
        moved_mm: f64,
        /// And turned, degrees.
        turned_deg: f64,
    },
    /// Too many points are wrong.
    #[error("projector: only {inliers} of {points} points agree with each other; look at the points, and measure again")]
    NoConsensus {
        /// Points that agree.
        inliers: usize,
        /// All points.
        points: usize,
    },
    /// The solution did not settle.
    #[error("projector: no solution settles (residual {rms_px:.2} px); measure again, with points spread over raster and depth")]
    NotConverged {
        /// Residual at the end, pixels.
        rms_px: f64,
    },
    /// The lens of the solution folds inside the raster.
    #[error("projector: the lens that fits cannot be inverted over the raster: points are missing near its border, or some are wrong; add points in the corners")]
    LensFolds,
    /// More of the lens was asked for than the data tell.
    #[error("projector: the points do not tell more of the lens than k1, k2, p1, p2, k3: further terms move the light by {moved_px:.3} px, and it is uncertain by {p99_px:.3} px; take --lens brown, or add points all over the picture, in its corners above all")]
    LensUndetermined {
        /// 99th percentile over the volume, pixels.
        moved_px: f64,
        /// What the light is uncertain by, pixels.
        p99_px: f64,
    },
    /// The light would be too uncertain.
    #[error("projector: the light would be uncertain by {p99_px:.1} px (99th percentile over the volume), at most {most_px} px are accepted; add points at ({x:.2}, {y:.2}, {z:.2}) m")]
    Uncertain {
        /// Predicted error, pixels.
        p99_px: f64,
        /// The bound.
        most_px: f64,
        /// Where it is largest, metres.
        x: f64,
        /// Where it is largest, metres.
        y: f64,
        /// Where it is largest, metres.
        z: f64,
    },
}

impl From<CalibrationError> for PointsRefusal {
    fn from(e: CalibrationError) -> Self {
        match e {
            CalibrationError::TooFew(have) => Self::TooFew { have, need: 6 },
            CalibrationError::NotFinite(i) => Self::NotFinite(i),
            CalibrationError::Degenerate { .. } => Self::Planar { off_plane_mm: 0.0 },
            CalibrationError::Mirrored => Self::Mirrored,
            CalibrationError::NoConsensus { inliers, pairs, .. } => {
                Self::NoConsensus { inliers, points: pairs }
            }
            CalibrationError::NotConverged { rms_px, .. } => Self::NotConverged { rms_px },
            CalibrationError::Uncertain(_) => Self::Planar { off_plane_mm: 0.0 },
        }
    }
}

/// Factors by which points are too large when their unit was mistaken for the metre.
const UNITS: [(f64, &str); 8] = [
    (1000.0, "as millimetres read as metres are"),
    (100.0, "as centimetres read as metres are"),
    (39.37, "as inches read as metres are"),
    (25.4, "as millimetres that were taken for inches are"),
    (0.001, "as metres read as millimetres are"),
    (0.01, "as metres read as centimetres are"),
    (0.0254, "as metres read as inches are"),
    (1.0 / 25.4, "as inches that were taken for millimetres are"),
];

/// Distances of a projector to what it lights that occur at all, metres.
const USUAL_M: [f64; 2] = [0.15, 30.0];

/// Judges the distance of the projector from the points.
pub(super) fn check_distance(distance_m: f64, told_m: Option<f64>) -> Result<(), PointsRefusal> {
    let nearest = |expected: f64| {
        let off = |f: f64| (distance_m / expected / f).ln().abs();
        UNITS.into_iter().min_by(|a, b| off(a.0).total_cmp(&off(b.0))).map(|u| (u, off(u.0)))
    };
    match told_m {
        Some(expected_m) if (distance_m / expected_m).ln().abs() > 0.5 => match nearest(expected_m) {
            Some(((factor, hint), off)) if off < 0.35 => {
                Err(PointsRefusal::WrongUnit { distance_m, expected_m, factor, hint })
            }
            _ => Err(PointsRefusal::WrongDistance { distance_m, expected_m }),
        },
        None if !(USUAL_M[0]..=USUAL_M[1]).contains(&distance_m) => {
            let expected_m = 1.5;
            let ((factor, hint), _) = nearest(expected_m).unwrap_or((UNITS[0], 0.0));
            Err(PointsRefusal::WrongUnit { distance_m, expected_m, factor, hint })
        }
        _ => Ok(()),
    }
}

/// Judges which way up the picture is.
pub(super) fn check_up(found: glam::DVec3, told: Option<glam::DVec3>) -> Result<(), PointsRefusal> {
    let name = |v: glam::DVec3| ["X", "Y", "Z"][v.abs().max_position()];
    match told.and_then(|t| t.try_normalize()) {
        Some(told)
            if found.dot(told).abs() < std::f64::consts::FRAC_1_SQRT_2 && name(found) != name(told) =>
        {
            Err(PointsRefusal::AxesExchanged { found: name(found), expected: name(told) })
        }
        _ => Ok(()),
    }
}
