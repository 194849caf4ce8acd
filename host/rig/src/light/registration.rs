//! Registration: the distance between where the light of a body's points fell and where the points were, in pixels of
//! the projector.

use crate::rig::{Rig, RigBody};
use dpm_device::link::Moves;
use dpm_render::warp::LEAST_MOTION_PX;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec2, DVec3};

/// Points on each body at which registration is measured.
const POINTS_PER_BODY: usize = 48;

/// Of the points, every so many are followed plane by plane.
const FOLLOWED_EVERY: usize = 8;

/// Where the light of a frame's planes fell, as an eye sees it that follows a point of the body. Pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LightPath {
    /// Distance from the point to the mean of the light.
    pub offset_px: f64,
    /// Root mean square distance of the light from its mean.
    pub smear_px: f64,
}

/// The light of one plane on one body.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlaneLight {
    /// world-from-body for which the plane was drawn.
    pub shown: DAffine3,
    /// world-from-body at the middle of the plane.
    pub truth: DAffine3,
    /// Light of a mirror that is on, in any unit.
    pub light: f64,
    /// How tracks moved the plane.
    pub moves: Moves,
}

/// By how much light that was drawn at a place of the picture was moved, pixels.
pub(super) fn shift_at(moves: &Moves, drawn: DVec2) -> DVec2 {
    let mirror = drawn.floor();
    let [dx, dy] = moves.of_mirror(mirror.x as i64, mirror.y as i64).map(f64::from);
    DVec2::new(dx, dy)
}

/// Points spread over the tracked bodies of a rig.
pub struct RegistrationMeter {
    camera: ProjectorCamera,
    /// Per tracked body: points in its own space, metres.
    points: Vec<Vec<DVec3>>,
}

impl RegistrationMeter {
    /// For the bodies of `rig` and its projector.
    pub fn new(rig: &Rig) -> Self {
        Self { camera: rig.camera, points: (0..rig.bodies.len()).map(|i| points_of(rig, i)).collect() }
    }

    /// Per tracked body: its points in its own space, metres.
    pub fn points(&self) -> &[Vec<DVec3>] {
        &self.points
    }

    /// How wide a pixel is at the bodies of `rig` at rest, on average, millimetres; `None` if no body is before the projector.
    pub(crate) fn pixel_mm(&self, rig: &Rig) -> Option<f64> {
        let at_rest = |body: &RigBody| DVec3::from_array(body.rest.position_m);
        // Light leaves against the third axis.
        let depths = rig.bodies.iter().map(|body| -self.camera.to_projector_space(at_rest(body)).z);
        let (sum, count) = depths.filter(|z| *z > 0.0).fold((0.0, 0u32), |(sum, n), z| (sum + z, n + 1));
        (count > 0).then(|| sum / f64::from(count) / self.camera.fx * 1e3)
    }

    /// For each point of the tracked body `body`: how far apart the world-from-body poses `used` and `truth` place it
    /// in the picture, pixels. Points that either pose places behind the projector are left out.
    pub fn errors<'a>(
        &'a self,
        body: usize,
        used: &'a DAffine3,
        truth: &'a DAffine3,
    ) -> impl Iterator<Item = f64> + 'a {
        self.placed(body, used, truth).map(|(used, truth)| (used - truth).length())
    }

    /// For each point of the tracked body `body`: where the world-from-body poses `used` and `truth` place it in the
    /// picture, pixels. Points that either pose places behind the projector are left out.
    pub(super) fn placed<'a>(
        &'a self,
        body: usize,
        used: &'a DAffine3,
        truth: &'a DAffine3,
    ) -> impl Iterator<Item = (DVec2, DVec2)> + 'a {
        let points = self.points.get(body).map_or(&[][..], Vec::as_slice);
        points.iter().filter_map(move |p| {
            let at = |m: &DAffine3| self.camera.project(m.transform_point3(*p));
            Some((at(used)?, at(truth)?))
        })
    }

    /// True if a point of the tracked body `body` moves so far from the world-from-body pose `first` to `last` that planes
    /// follow it, whose instants lie at most `reach` of that time from the frame's.
    pub(crate) fn is_followed(&self, body: usize, first: &DAffine3, last: &DAffine3, reach: f64) -> bool {
        let points = self.points.get(body).map_or(&[][..], Vec::as_slice);
        points.iter().step_by(FOLLOWED_EVERY).any(|p| {
            let at = |pose: &DAffine3| self.camera.project(pose.transform_point3(*p));
            at(first).zip(at(last)).is_some_and(|(a, b)| (b - a).length() * reach >= LEAST_MOTION_PX)
        })
    }

    /// For some points of the tracked body `body`: where the light of `planes` fell.
    pub(crate) fn followed<'a>(
        &'a self,
        body: usize,
        planes: &'a [PlaneLight],
    ) -> impl Iterator<Item = LightPath> + 'a {
        let points = self.points.get(body).map_or(&[][..], Vec::as_slice);
        points.iter().step_by(FOLLOWED_EVERY).filter_map(move |p| {
            let at = |pose: &DAffine3| self.camera.project(pose.transform_point3(*p));
            let (mut weights, mut sum, mut squares) = (0.0, DVec2::ZERO, 0.0);
            for plane in planes {
                let drawn = at(&plane.shown)?;
                let off = drawn + shift_at(&plane.moves, drawn) - at(&plane.truth)?;
                weights += plane.light;
                sum += off * plane.light;
                squares += off.length_squared() * plane.light;
            }
            let mean = sum / weights;
            let smear_px = (squares / weights - mean.length_squared()).max(0.0).sqrt();
            (weights > 0.0).then_some(LightPath { offset_px: mean.length(), smear_px })
        })
    }
}

/// Points spread over the vertices of a tracked body. Those of parts that move by themselves, and of meshes that
/// deform, are none of its points.
fn points_of(rig: &Rig, tracked: usize) -> Vec<DVec3> {
    let all: Vec<DVec3> = rig
        .scene
        .bodies
        .iter()
        .filter(|b| b.tracked == Some(tracked as u16) && b.projected && b.is_whole())
        .flat_map(|b| b.mesh.positions.iter().map(|p| p.as_dvec3()))
        .collect();
    let n = all.len().min(POINTS_PER_BODY);
    (0..n).map(|i| all[i * all.len() / n]).collect()
}
