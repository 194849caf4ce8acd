//! Calibrates a projector from pairs of world points and pixels, or reports why they do not determine one.
//!
//! Direct linear transform with normalised coordinates (\[Hartley97\]), split into intrinsics and pose, then
//! Levenberg-Marquardt on the reprojection error. With an inlier threshold, random samples of the pairs are tried first
//! (\[Fischler81\]) to exclude wrong pairs. Everything is computed in coordinates centred on the points and scaled to
//! their spread: metres and millimetres give the same pixels.

mod refine;

use crate::dense::{svd, Columns};
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DMat3, DVec2, DVec3};
use refine::{refine, LensFit, LensPrior, Pinhole};
use thiserror::Error;

/// A point of the world and the pixel position that lights it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Metres.
    pub world: DVec3,
    /// Pixels from the raster's upper left corner, y down.
    pub pixel: DVec2,
}

/// How to calibrate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationOptions {
    /// Pairs with an error of more than this many pixels are excluded as wrong; `None`: all pairs count as right.
    pub inlier_px: Option<f64>,
    /// Seed of the random samples.
    pub seed: u64,
}

impl Default for CalibrationOptions {
    fn default() -> Self {
        Self { inlier_px: None, seed: 1 }
    }
}

/// A projector and its accuracy.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// The result.
    pub camera: ProjectorCamera,
    /// Root mean square distance between given and computed pixels of the pairs used, pixels.
    pub rms_px: f64,
    /// The largest of them, pixels.
    pub max_px: f64,
    /// One standard deviation of the focal length as a share of it, from the residuals; 0 for exact data.
    pub focal_uncertainty: f64,
    /// Ratio of the largest to the smallest singular value that the points must determine; 1e1..1e3 is usual, infinite
    /// is degenerate.
    pub condition: f64,
    /// Which pairs were used.
    pub inliers: Vec<bool>,
    /// Warnings for the operator, one sentence each.
    pub warnings: Vec<String>,
}

/// Why the pairs do not determine a projector.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CalibrationError {
    /// Under six pairs.
    #[error("calibration: {0} pairs; at least 6 that do not lie in one plane are needed")]
    TooFew(usize),
    /// A coordinate is NaN or infinite.
    #[error("calibration: pair {0} is not finite; remove it")]
    NotFinite(usize),
    /// The points leave the projector undetermined.
    #[error("calibration: degenerate: {what} (rank {rank} of {needed}, condition {condition:.1e}); add points that spread in depth")]
    Degenerate {
        /// The reason, as text.
        what: &'static str,
        /// Independent directions found.
        rank: usize,
        /// Independent directions needed.
        needed: usize,
        /// Largest over smallest singular value.
        condition: f64,
    },
    /// The points come out behind the projector.
    #[error(
        "calibration: the points lie behind the projector: the pixels are mirrored, or x and y are exchanged"
    )]
    Mirrored,
    /// No sample of pairs agrees with enough others.
    #[error("calibration: only {inliers} of {pairs} pairs agree within {threshold_px} px; raise the threshold or measure again")]
    NoConsensus {
        /// Pairs that agree.
        inliers: usize,
        /// All pairs.
        pairs: usize,
        /// The threshold.
        threshold_px: f64,
    },
    /// The refinement did not converge.
    #[error("calibration: not converged after {iterations} steps (rms {rms_px:.3} px); the start or the pairs are wrong")]
    NotConverged {
        /// Steps made.
        iterations: usize,
        /// Error at that point.
        rms_px: f64,
    },
    /// The focal length is not determined by data of this quality.
    #[error("calibration: the focal length is uncertain by {0:.0} %: the points are too flat or too few for their noise")]
    Uncertain(f64),
}

/// Singular values below this fraction of the largest count as zero: coordinates are f32 or text with 7 digits at best.
const RANK_TOLERANCE: f64 = 1e-7;

/// A focal length less certain than this is refused.
const MOST_UNCERTAIN: f64 = 0.5;

const SAMPLE: usize = 7;
const SAMPLES: usize = 600;

/// Finds the projector that lights the given points by the given pixels.
pub fn calibrate(
    raster: Raster,
    pairs: &[Pair],
    options: &CalibrationOptions,
) -> Result<Calibration, CalibrationError> {
    if let Some(bad) = pairs.iter().position(|p| !(p.world.is_finite() && p.pixel.is_finite())) {
        return Err(CalibrationError::NotFinite(bad));
    }
    if pairs.len() < 6 {
        return Err(CalibrationError::TooFew(pairs.len()));
    }
    check_spread(pairs)?;
    let frame = Normalisation::of(pairs);
    let normal: Vec<Pair> = pairs.iter().map(|p| frame.apply(p)).collect();
    let inliers = match options.inlier_px {
        None => vec![true; pairs.len()],
        Some(px) => consensus(&normal, px * frame.pixel_scale, options.seed).map_err(|inliers| {
            CalibrationError::NoConsensus { inliers, pairs: pairs.len(), threshold_px: px }
        })?,
    };
    let used: Vec<Pair> = normal.iter().zip(&inliers).filter(|(_, i)| **i).map(|(p, _)| *p).collect();
    check_spread(&used)?;
    let (start, condition) = linear(&used)?;
    let refined = refine(start, &used, None);
    if refined.converged {
        return finish(raster, refined, &frame, &used, inliers, condition);
    }
    // Pixels that are good to one only may leave a valley of projectors, along which the focal length grows without end.
    let expected = frame.expected(raster, refined.rms);
    let refined = refine(start, &used, Some(&expected));
    let mut found = finish(raster, refined, &frame, &used, inliers, condition)?;
    found.warnings.push(NOT_BY_POINTS_ALONE.to_owned());
    Ok(found)
}

const NOT_BY_POINTS_ALONE: &str =
    "the points alone do not tell the lens: square pixels and an axis near the picture's middle were expected";

/// Refines a projector that is roughly known (a saved calibration, a data sheet) on new pairs.
pub fn recalibrate(start: &ProjectorCamera, pairs: &[Pair]) -> Result<Calibration, CalibrationError> {
    if let Some(bad) = pairs.iter().position(|p| !(p.world.is_finite() && p.pixel.is_finite())) {
        return Err(CalibrationError::NotFinite(bad));
    }
    if pairs.len() < 6 {
        return Err(CalibrationError::TooFew(pairs.len()));
    }
    check_spread(pairs)?;
    let frame = Normalisation::of(pairs);
    let normal: Vec<Pair> = pairs.iter().map(|p| frame.apply(p)).collect();
    let condition = linear(&normal)?.1;
    let refined = refine(frame.to_pinhole(start), &normal, None);
    finish(start.raster, refined, &frame, &normal, vec![true; pairs.len()], condition)
}

fn finish(
    raster: Raster,
    refined: LensFit,
    frame: &Normalisation,
    used: &[Pair],
    inliers: Vec<bool>,
    condition: f64,
) -> Result<Calibration, CalibrationError> {
    let rms_px = refined.rms / frame.pixel_scale;
    if !refined.converged {
        return Err(CalibrationError::NotConverged { iterations: refined.iterations, rms_px });
    }
    if used.iter().any(|p| refined.model.depth(p.world) <= 0.0) {
        return Err(CalibrationError::Mirrored);
    }
    if refined.focal_uncertainty.is_nan() || refined.focal_uncertainty > MOST_UNCERTAIN {
        return Err(CalibrationError::Uncertain(100.0 * refined.focal_uncertainty));
    }
    let camera = frame.to_camera(raster, &refined.model);
    let max = used.iter().map(|p| refined.model.residual(p).length()).fold(0.0, f64::max);
    let mut calibration = Calibration {
        camera,
        rms_px,
        max_px: max / frame.pixel_scale,
        focal_uncertainty: refined.focal_uncertainty,
        condition,
        inliers,
        warnings: Vec::new(),
    };
    calibration.judge();
    Ok(calibration)
}

impl Calibration {
    fn judge(&mut self) {
        let c = &self.camera;
        let (w, h) = (f64::from(c.raster.width()), f64::from(c.raster.height()));
        let mut say = |condition: bool, text: String| {
            if condition {
                self.warnings.push(text);
            }
        };
        let fov = c.horizontal_fov().to_degrees();
        say(fov > 120.0, format!("horizontal field of view is {fov:.0} deg: no projector lens is so wide"));
        let aspect = c.fx / c.fy;
        say(!(0.8..1.25).contains(&aspect), format!("pixels come out {aspect:.2} times as wide as high"));
        let outside = c.cx < 0.0 || c.cy < 0.0 || c.cx > w || c.cy > h;
        say(
            outside,
            format!("the axis leaves outside the raster at ({:.0}, {:.0}) px: strong lens shift", c.cx, c.cy),
        );
        say(self.rms_px > 1.0, format!("reprojection error is {:.2} px rms: more than a pixel", self.rms_px));
        let u = 100.0 * self.focal_uncertainty;
        say(u > 5.0, format!("the focal length is uncertain by {u:.0} %: add points nearer and farther"));
    }

    /// The calibration as text for an operator, one fact a line.
    pub fn summary(&self) -> Vec<String> {
        let c = &self.camera;
        let (w, h) = (f64::from(c.raster.width()), f64::from(c.raster.height()));
        let p = c.position();
        let used = self.inliers.iter().filter(|i| **i).count();
        let mut lines = vec![
            format!(
                "reprojection error {:.3} px rms, {:.3} px at most, {used} of {} pairs",
                self.rms_px,
                self.max_px,
                self.inliers.len()
            ),
            format!("focal length {:.1} x {:.1} px (+- {:.2} %)", c.fx, c.fy, 100.0 * self.focal_uncertainty),
            format!(
                "field of view {:.1} x {:.1} deg, throw ratio {:.2}",
                c.horizontal_fov().to_degrees(),
                c.vertical_fov().to_degrees(),
                c.fx / w
            ),
            format!(
                "lens shift {:+.0} % of the width, {:+.0} % of the height",
                100.0 * (c.cx / w - 0.5),
                100.0 * (c.cy / h - 0.5)
            ),
            format!("projector at ({:.3}, {:.3}, {:.3}) m", p.x, p.y, p.z),
            format!("condition number {:.1e}", self.condition),
        ];
        lines.extend(self.warnings.iter().map(|w| format!("look: {w}")));
        lines
    }
}

/// Refuses world points in a plane, on a line or in one place, and pixels on a line or in one place.
fn check_spread(pairs: &[Pair]) -> Result<(), CalibrationError> {
    let spread = |columns: Columns| {
        let s = svd(columns).values;
        let tiny = s[0] * RANK_TOLERANCE;
        let rank = s.iter().filter(|v| **v > tiny && **v > 0.0).count();
        let last = s[s.len() - 1];
        (rank, if last > 0.0 { s[0] / last } else { f64::INFINITY })
    };
    let n = pairs.len().max(1) as f64;
    let centre = pairs.iter().map(|p| p.world).sum::<DVec3>() / n;
    let magnitude = pairs.iter().map(|p| p.world.abs().max_element()).fold(0.0, f64::max);
    // Differences below the rounding of the coordinates themselves count as zero.
    let clean = |d: f64| if d.abs() < 4.0 * f64::EPSILON * magnitude { 0.0 } else { d };
    let (rank, condition) =
        spread((0..3).map(|a| pairs.iter().map(|p| clean(p.world[a] - centre[a])).collect()).collect());
    if rank < 3 {
        let what =
            ["all points are one point", "all points lie on a line", "all points lie in a plane"][rank];
        return Err(CalibrationError::Degenerate { what, rank, needed: 3, condition });
    }
    let centre = pairs.iter().map(|p| p.pixel).sum::<DVec2>() / n;
    let (rank, condition) =
        spread((0..2).map(|a| pairs.iter().map(|p| p.pixel[a] - centre[a]).collect()).collect());
    if rank < 2 {
        let what = ["all pixels are one pixel", "all pixels lie on a line"][rank];
        return Err(CalibrationError::Degenerate { what, rank, needed: 2, condition });
    }
    Ok(())
}

/// The linear solution in normalised coordinates, and the condition number of the points.
fn linear(pairs: &[Pair]) -> Result<(Pinhole, f64), CalibrationError> {
    let mut a: Columns = vec![Vec::new(); 12];
    for p in pairs {
        for (i, x) in p.world.extend(1.0).to_array().into_iter().enumerate() {
            a[i].extend([x, 0.0]);
            a[4 + i].extend([0.0, x]);
            a[8 + i].extend([-p.pixel.x * x, -p.pixel.y * x]);
        }
    }
    let s = svd(a);
    // Twelve unknowns up to a scale: the last singular value is the misfit; the one before must not vanish.
    let rank = s.values.iter().filter(|v| **v > s.values[0] * RANK_TOLERANCE).count();
    let condition = if s.values[10] > 0.0 { s.values[0] / s.values[10] } else { f64::INFINITY };
    if rank < 11 {
        let what = "the points lie on a surface that many projectors share";
        return Err(CalibrationError::Degenerate { what, rank, needed: 11, condition });
    }
    let v = &s.vectors[11];
    let row = |i: usize| DVec3::new(v[4 * i], v[4 * i + 1], v[4 * i + 2]);
    let (m, t) = ([row(0), row(1), row(2)], DVec3::new(v[3], v[7], v[11]));
    let sign = if m[0].dot(m[1].cross(m[2])) < 0.0 { -1.0 } else { 1.0 };
    let (m, t) = (m.map(|r| r * sign), t * sign);
    let degenerate = CalibrationError::Degenerate {
        what: "the linear solution has no rotation",
        rank: 11,
        needed: 11,
        condition,
    };
    // M = K R with K upper triangular, from the last row up.
    let scale = m[2].length();
    let r2 = m[2].try_normalize().ok_or(degenerate.clone())?;
    let cy = m[1].dot(r2);
    let second = m[1] - r2 * cy;
    let fy = second.length();
    let r1 = second.try_normalize().ok_or(degenerate.clone())?;
    let cx = m[0].dot(r2);
    let skew = m[0].dot(r1);
    let first = m[0] - r2 * cx - r1 * skew;
    let fx = first.length();
    let r0 = first.try_normalize().ok_or(degenerate)?;
    let tz = t.z / scale;
    let ty = (t.y - cy * tz) / fy;
    let tx = (t.x - cx * tz - skew * ty) / fx;
    let model = Pinhole {
        rotation: DMat3::from_cols(r0, r1, r2).transpose(),
        translation: DVec3::new(tx, ty, tz),
        focal: DVec2::new(fx, fy) / scale,
        centre: DVec2::new(cx, cy) / scale,
    };
    let behind = pairs.iter().filter(|p| model.depth(p.world) <= 0.0).count();
    if 2 * behind > pairs.len() {
        return Err(CalibrationError::Mirrored);
    }
    Ok((model, condition))
}

/// The largest set of pairs that one projector explains; if that is too small, the number of pairs found.
fn consensus(pairs: &[Pair], threshold: f64, seed: u64) -> Result<Vec<bool>, usize> {
    let agree = |m: &Pinhole, factor: f64| -> Vec<bool> {
        (pairs.iter())
            .map(|p| m.depth(p.world) > 0.0 && m.residual(p).length() <= threshold * factor)
            .collect()
    };
    let count = |set: &[bool]| set.iter().filter(|i| **i).count();
    let mut random = dpm_device::rng::Sampler::new(seed, 0);
    let mut best = vec![false; pairs.len()];
    let mut index: Vec<usize> = (0..pairs.len()).collect();
    for _ in 0..SAMPLES {
        let take = SAMPLE.min(pairs.len());
        for i in 0..take {
            let j = i + (random.uniform() * (pairs.len() - i) as f64) as usize;
            index.swap(i, j);
        }
        let sample: Vec<Pair> = index[..take].iter().map(|i| pairs[*i]).collect();
        let Ok((mut model, _)) = linear(&sample) else { continue };
        // Few points extrapolate badly: use a wider threshold first, then narrow it with the projector of the larger
        // set.
        for factor in [4.0, 2.0, 1.0] {
            let set = agree(&model, factor);
            let chosen: Vec<Pair> = pairs.iter().zip(&set).filter(|(_, i)| **i).map(|(p, _)| *p).collect();
            if chosen.len() < SAMPLE {
                break;
            }
            match linear(&chosen) {
                Ok((better, _)) => model = better,
                Err(_) => break,
            }
        }
        let set = agree(&model, 1.0);
        if count(&set) > count(&best) {
            best = set;
            if 10 * count(&best) > 9 * pairs.len() {
                break;
            }
        }
    }
    // Half the pairs must agree; otherwise the set could have formed by chance.
    if count(&best) < SAMPLE.max(pairs.len() / 2) {
        Err(count(&best))
    } else {
        Ok(best)
    }
}

/// Similarities that centre points and pixels and scale their spread to 1.
struct Normalisation {
    world_centre: DVec3,
    world_scale: f64,
    pixel_centre: DVec2,
    pixel_scale: f64,
}

/// Projector space of this project (looking along -Z, y up) from that of the equations (looking along +Z, y down).
const FLIP: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

impl Normalisation {
    fn of(pairs: &[Pair]) -> Self {
        let n = pairs.len() as f64;
        let world_centre = pairs.iter().map(|p| p.world).sum::<DVec3>() / n;
        let pixel_centre = pairs.iter().map(|p| p.pixel).sum::<DVec2>() / n;
        let world = (pairs.iter().map(|p| (p.world - world_centre).length_squared()).sum::<f64>() / n).sqrt();
        let pixel = (pairs.iter().map(|p| (p.pixel - pixel_centre).length_squared()).sum::<f64>() / n).sqrt();
        Self { world_centre, world_scale: 1.0 / world, pixel_centre, pixel_scale: 1.0 / pixel }
    }

    fn apply(&self, p: &Pair) -> Pair {
        Pair {
            world: (p.world - self.world_centre) * self.world_scale,
            pixel: (p.pixel - self.pixel_centre) * self.pixel_scale,
        }
    }

    /// What is expected of the projector of a raster, for pairs that are off by `sigma`.
    fn expected(&self, raster: Raster, sigma: f64) -> LensPrior {
        let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
        let centre = (0.5 * size - self.pixel_centre) * self.pixel_scale;
        LensPrior { centre, size: size * self.pixel_scale, sigma }
    }

    fn to_camera(&self, raster: Raster, m: &Pinhole) -> ProjectorCamera {
        let world_from_projector = m.rotation.transpose() * FLIP;
        let position = -(m.rotation.transpose() * m.translation) / self.world_scale + self.world_centre;
        ProjectorCamera {
            raster,
            world_from_projector: glam::DAffine3::from_mat3_translation(world_from_projector, position),
            fx: m.focal.x / self.pixel_scale,
            fy: m.focal.y / self.pixel_scale,
            cx: m.centre.x / self.pixel_scale + self.pixel_centre.x,
            cy: m.centre.y / self.pixel_scale + self.pixel_centre.y,
            lens: Lens::default(),
        }
    }

    fn to_pinhole(&self, c: &ProjectorCamera) -> Pinhole {
        let rotation = FLIP * c.world_from_projector.matrix3.transpose();
        let position = (c.position() - self.world_centre) * self.world_scale;
        Pinhole {
            rotation,
            translation: -(rotation * position),
            focal: DVec2::new(c.fx, c.fy) * self.pixel_scale,
            centre: (DVec2::new(c.cx, c.cy) - self.pixel_centre) * self.pixel_scale,
        }
    }
}
