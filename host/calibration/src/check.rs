//! How far light lies from where it belongs, and whose fault that is.
//!
//! Two places are measured at each point of a body, both with the tip of the wand: the place of the light that was meant
//! for the point, and the point itself. Light that lands elsewhere than the rig's projector would put it is the
//! projector's fault. A point that is elsewhere than the rig has it is the body's fault. Their difference is the error of
//! the light.

use crate::body::TriangleTree;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DMat2, DVec2, DVec3};

/// A surface that is seen more obliquely than by this cosine has no points to be checked: light smears over it.
const FACING: f64 = 0.5;
/// Points nearer than this to the raster's edge, pixels, are not checked: a wrong rig would lose their light.
const MARGIN_PX: f64 = 16.0;
/// What lies nearer to a point than this share of its surface does not hide it.
const CLEAR: f64 = 0.01;
/// Fewest offsets of which the mean is told from the scatter.
const FEWEST: usize = 3;

/// A point of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshPoint {
    /// In the mesh's frame, metres.
    pub position: DVec3,
    /// Unit normal, outwards, in the mesh's frame.
    pub normal: DVec3,
}

/// Chooses up to `count` of `candidates`, each as far as possible from the others, that face the projector, lie on its
/// raster and are not hidden by `surface`.
pub fn spread(
    candidates: &[MeshPoint],
    surface: &TriangleTree,
    camera: &ProjectorCamera,
    world_from_mesh: &DAffine3,
    count: usize,
) -> Vec<MeshPoint> {
    let lens = world_from_mesh.inverse().transform_point3(camera.position());
    let size = DVec2::new(f64::from(camera.raster.width()), f64::from(camera.raster.height()));
    let is_lit = |p: &&MeshPoint| {
        let pixel = camera.project(world_from_mesh.transform_point3(p.position));
        let inside = pixel.is_some_and(|at| {
            at.cmpge(DVec2::splat(MARGIN_PX)).all() && at.cmple(size - DVec2::splat(MARGIN_PX)).all()
        });
        inside && (lens - p.position).normalize_or_zero().dot(p.normal) >= FACING
    };
    let mut left: Vec<MeshPoint> = candidates.iter().filter(is_lit).copied().collect();
    let middle = left.iter().map(|p| p.position).sum::<DVec3>() / left.len().max(1) as f64;
    let mut gaps: Vec<f64> = left.iter().map(|p| p.position.distance(middle)).collect();
    let clear_m = CLEAR * surface.extent_m();
    let mut chosen: Vec<MeshPoint> = Vec::new();
    while chosen.len() < count {
        let far = (0..left.len()).max_by(|a, b| gaps[*a].total_cmp(&gaps[*b]));
        let Some(far) = far.filter(|i| chosen.is_empty() || gaps[*i] > clear_m) else { break };
        let point = left.swap_remove(far);
        gaps.swap_remove(far);
        if surface.hides(lens, point.position, clear_m) {
            continue;
        }
        let is_first = chosen.is_empty();
        chosen.push(point);
        for (gap, other) in gaps.iter_mut().zip(&left) {
            let apart = other.position.distance(point.position);
            *gap = if is_first { apart } else { gap.min(apart) };
        }
    }
    chosen
}

/// What was measured at a point. Places are in the world, metres; positions on the raster are in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointReading {
    /// Where the rig has the point.
    pub point: DVec3,
    /// Unit normal of the surface there.
    pub normal: DVec3,
    /// Centre of the pixel that was lit.
    pub lit: DVec2,
    /// Where the tip was when it was in the middle of the light.
    pub in_light: DVec3,
    /// Where the tip was when it touched the point itself.
    pub touched: Option<DVec3>,
}

/// How far light is from where it belongs, pixels of the rig's projector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Offset {
    /// Of the light from where it was sent: the projector's part.
    pub projector: DVec2,
    /// Of the point from where the rig has it: the body's part; `None` if the point was not touched.
    pub body: Option<DVec2>,
    /// Of the light from the point: the difference; without a touched point the projector's part alone.
    pub light: DVec2,
    /// The same on the surface, metres.
    pub light_m: f64,
    /// Of the point from where the rig has it, in the world, metres.
    pub body_m: Option<DVec3>,
}

impl Offset {
    /// From a measurement; `None` where a place is beside or behind the projector, or the surface is seen from its edge.
    pub fn of(camera: &ProjectorCamera, reading: &PointReading) -> Option<Self> {
        let meant = camera.project(reading.point)?;
        let projector = camera.project(reading.in_light)? - reading.lit;
        let body = match reading.touched {
            Some(at) => Some(camera.project(at)? - meant),
            None => None,
        };
        let light = projector - body.unwrap_or_default();
        let light_m = along_surface(camera, reading.point, reading.normal, light)?.length();
        Some(Self { projector, body, light, light_m, body_m: reading.touched.map(|at| at - reading.point) })
    }
}

/// The step along the surface at `point` with unit normal `normal` that moves the pixel by `offset`; `None` for a surface
/// that is seen from its edge.
pub fn along_surface(camera: &ProjectorCamera, point: DVec3, normal: DVec3, offset: DVec2) -> Option<DVec3> {
    let (one, two) = normal.try_normalize()?.any_orthonormal_pair();
    let [across, down] = camera.jacobian(point)?;
    let matrix = DMat2::from_cols(
        DVec2::new(across.dot(one), down.dot(one)),
        DVec2::new(across.dot(two), down.dot(two)),
    );
    let steep = matrix.determinant().abs() > 1e-6 * across.length() * down.length();
    let step = steep.then(|| matrix.inverse() * offset)?;
    Some(one * step.x + two * step.y)
}

/// Many offsets in a few numbers, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Offsets there are.
    pub count: usize,
    /// Their mean.
    pub mean: DVec2,
    /// Root mean square distance of one from the mean; 0 of a single one.
    pub scatter_px: f64,
    /// Median of their lengths.
    pub p50_px: f64,
    /// The largest length.
    pub largest_px: f64,
}

impl Summary {
    /// `None` of no offsets.
    pub fn of(offsets: &[DVec2]) -> Option<Self> {
        let n = offsets.len();
        let mut lengths: Vec<f64> = offsets.iter().map(|o| o.length()).collect();
        lengths.sort_by(f64::total_cmp);
        let mean = offsets.iter().sum::<DVec2>() / n.max(1) as f64;
        let squares: f64 = offsets.iter().map(|o| o.distance_squared(mean)).sum();
        Some(Self {
            count: n,
            mean,
            scatter_px: (squares / n.saturating_sub(1).max(1) as f64).sqrt(),
            p50_px: 0.5 * (lengths.get(n.checked_sub(1)? / 2)? + lengths.get(n / 2)?),
            largest_px: *lengths.last()?,
        })
    }

    /// Whether all are off by much the same: the mean is larger than the scatter. Two offsets do not tell.
    pub fn is_shift(&self) -> bool {
        self.count >= FEWEST && self.mean.length() > self.scatter_px
    }

    /// Root mean square length.
    fn rms(&self) -> f64 {
        let n = self.count as f64;
        (self.mean.length_squared() + self.scatter_px.powi(2) * (n - 1.0) / n).sqrt()
    }
}

/// All points of a check.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckSummary {
    /// Error of the light.
    pub light: Summary,
    /// The projector's part.
    pub projector: Summary,
    /// The body's part; `None` if no point was touched.
    pub body: Option<Summary>,
}

/// What should be measured again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Pose or lens of the projector.
    Projector,
    /// The place of the mesh in the body.
    Body,
}

impl CheckSummary {
    /// `None` of no points.
    pub fn of(offsets: &[Offset]) -> Option<Self> {
        let all = |part: &dyn Fn(&Offset) -> Option<DVec2>| {
            Summary::of(&offsets.iter().filter_map(part).collect::<Vec<_>>())
        };
        Some(Self {
            light: all(&|o| Some(o.light))?,
            projector: all(&|o| Some(o.projector))?,
            body: all(&|o| o.body),
        })
    }

    /// Whose part is the larger one, with that part; `None` if no error of the light is larger than `limit_px`.
    pub fn fault(&self, limit_px: f64) -> Option<(Fault, Summary)> {
        if self.light.largest_px <= limit_px {
            return None;
        }
        let body = self.body.filter(|b| b.rms() > self.projector.rms());
        Some(body.map_or((Fault::Projector, self.projector), |b| (Fault::Body, b)))
    }
}

#[cfg(test)]
mod tests;
