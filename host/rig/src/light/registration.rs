//! Registration: the distance between where the light of a body's points fell and where the points were, in pixels of
//! the projector.

use crate::rig::Rig;
use dpm_device::time::HostTime;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};

/// Points on each body at which registration is measured.
const POINTS_PER_BODY: usize = 48;

/// The instant at which registration of a frame is measured: the middle of its exposure, between its first and its
/// last photon.
pub fn measured_at(first_photon_at: HostTime, last_photon_at: HostTime) -> HostTime {
    first_photon_at.plus_ns(last_photon_at.ns_since(first_photon_at) / 2)
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
    pub(crate) fn points(&self) -> &[Vec<DVec3>] {
        &self.points
    }

    /// For each point of the tracked body `body`: how far apart the world-from-body poses `used` and `truth` place it
    /// in the picture, pixels. Points that either pose places behind the projector are left out.
    pub fn errors<'a>(
        &'a self,
        body: usize,
        used: &'a DAffine3,
        truth: &'a DAffine3,
    ) -> impl Iterator<Item = f64> + 'a {
        let points = self.points.get(body).map_or(&[][..], Vec::as_slice);
        points.iter().filter_map(move |p| {
            let at = |m: &DAffine3| self.camera.project(m.transform_point3(*p));
            Some((at(used)? - at(truth)?).length())
        })
    }
}

/// Points spread over the vertices of a tracked body.
fn points_of(rig: &Rig, tracked: usize) -> Vec<DVec3> {
    let all: Vec<DVec3> = rig
        .scene
        .bodies
        .iter()
        .filter(|b| b.tracked == Some(tracked as u16) && b.projected)
        .flat_map(|b| b.mesh.positions.iter().map(|p| p.as_dvec3()))
        .collect();
    let n = all.len().min(POINTS_PER_BODY);
    (0..n).map(|i| all[i * all.len() / n]).collect()
}
