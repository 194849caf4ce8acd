//! Values as planning uses them: computed beside the frame path, handed over whole, and used from one frame on.

use super::{Nudge, Values};
use crate::rig::Rig;
use dpm_calibration_file::moved;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};

/// One version of the parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterVersion {
    /// Its number; 0 is the rig file's.
    pub version: u64,
    /// By how much brighter than by the rig file light is; exactly 1 as long as the exposure is the rig file's.
    pub brighter: f32,
    /// Samples of a traced pixel, where neither the angle nor a budget decides them.
    pub samples: u32,
    /// Largest average of samples per pixel, in thousandths.
    pub most_milli: u64,
    /// The point that the observer looks at; `None`: as the rig says.
    pub gaze: Option<DVec3>,
    /// The projector, with its motion by hand.
    pub camera: ProjectorCamera,
    /// Per tracked body: body-from-mesh, with its motion by hand.
    pub mesh_to_body: Vec<DAffine3>,
}

impl ParameterVersion {
    /// `values` on `rig`. `middles` has the middle of every tracked body's mesh, in the mesh's space.
    pub fn new(version: u64, values: &Values, rig: &Rig, middles: &[DVec3]) -> Self {
        let mut camera = rig.camera;
        camera.world_from_projector = nudged(camera.world_from_projector, DVec3::ZERO, &values.projector);
        let place = |(i, body): (usize, &crate::rig::RigBody)| {
            let nudge = values.bodies.get(i).copied().unwrap_or_default();
            nudged(body.mesh_to_body, middles.get(i).copied().unwrap_or(DVec3::ZERO), &nudge)
        };
        let most = values.budget.min(f64::from(values.samples));
        Self {
            version,
            brighter: (values.exposure / rig.config.render.exposure) as f32,
            samples: values.samples,
            most_milli: ((most * 1e3).round() as u64).max(1),
            gaze: values.gaze.map(DVec3::from_array),
            camera,
            mesh_to_body: rig.bodies.iter().enumerate().map(place).collect(),
        }
    }
}

/// `start` with a motion by hand; the same bits without one.
fn nudged(start: DAffine3, centre: DVec3, nudge: &Nudge) -> DAffine3 {
    if *nudge == Nudge::default() {
        return start;
    }
    let by = DVec3::from_array(nudge.moved_mm) * 1e-3;
    moved(&start, centre, by, DVec3::from_array(nudge.turned_deg.map(f64::to_radians)))
}

/// The middle of every tracked body's mesh: of the box around its points, in the mesh's space, metres.
pub(crate) fn middles(rig: &Rig) -> Vec<DVec3> {
    (0..rig.bodies.len())
        .map(|i| {
            let all =
                rig.scene.bodies.iter().filter(|b| b.tracked.map(usize::from) == Some(i) && b.is_whole());
            let points = all.flat_map(|b| b.mesh.positions.iter().map(|p| p.as_dvec3()));
            let (low, high) = points
                .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
            if low.is_finite() && high.is_finite() {
                (low + high) * 0.5
            } else {
                DVec3::ZERO
            }
        })
        .collect()
}
