//! Where the light of each plane fell, tracks included: the frames' records joined with what the mock projector made of
//! their planes.

use super::registration::{shift_at, RegistrationMeter};
use super::FrameRecord;
use crate::plan::light_centre::{instants_of_planes, lights_of_frame};
use crate::rig::Rig;
use dpm_device::link::Moves;
use dpm_device::projector::SlotMoves;
use dpm_device::time::HostTime;
use std::sync::Arc;

/// The light of one plane at one point of a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanePoint {
    /// Distance from the point to the light that was drawn for it, pixels.
    pub off_px: f64,
    /// The same without tracks.
    pub drawn_off_px: f64,
    /// Light of a mirror that is on, in units of the lowest bit.
    pub light: f64,
    /// When the plane was half over.
    pub at: HostTime,
}

/// Measures the light of the planes of a rig whose tracker tells the truth.
pub struct PlaneMeter {
    rig: Arc<Rig>,
    meter: RegistrationMeter,
    instants: Vec<f64>,
}

impl PlaneMeter {
    /// For the bodies of `rig`.
    pub fn new(rig: Arc<Rig>) -> Self {
        Self { meter: RegistrationMeter::new(&rig), instants: instants_of_planes(&rig), rig }
    }

    /// Passes the light of every plane of a lit frame, at points of its lit bodies that lie on the raster, to `sink`.
    /// `moves`: what tracks made of the frame in the slot in which it was lit first; `None` without tracks. Planes that
    /// were cut off are left out. Nothing is passed on if the truth is not known.
    pub fn measure(&self, record: &FrameRecord, moves: Option<&SlotMoves>, sink: &mut dyn FnMut(PlanePoint)) {
        let (Some(lit_at), Some(last)) = (record.timeline.lit_at, record.timeline.last_photon_at) else {
            return;
        };
        let lights = lights_of_frame(&self.rig, last.ns_since(lit_at));
        for (k, (middle_ns, light)) in lights.enumerate() {
            let at = lit_at.plus_ns(middle_ns);
            let moved = moves.map_or(Some(&Moves::NONE), |slot| slot.planes().get(k));
            let (Some(truth), Some(moved)) = (self.rig.true_poses(at.0), moved) else { return };
            for (body, truth) in truth.iter().enumerate() {
                if record.dark.get(body).copied().flatten().is_some() {
                    continue;
                }
                let shown = record.pose_at(body, self.instant_of(record, body, k));
                for (drawn, right) in self.meter.placed(body, &shown, truth) {
                    let mirror = drawn.floor();
                    let (width, height) = (self.rig.camera.raster.width(), self.rig.camera.raster.height());
                    if mirror.min_element() < 0.0 || mirror.x >= width.into() || mirror.y >= height.into() {
                        continue;
                    }
                    let fell = drawn + shift_at(moved, drawn);
                    let (off_px, drawn_off_px) = ((fell - right).length(), (drawn - right).length());
                    sink(PlanePoint { off_px, drawn_off_px, light, at });
                }
            }
        }
    }

    /// The instant for which plane `k` shows a body, as a share of the exposure from the frame's own.
    fn instant_of(&self, record: &FrameRecord, body: usize, k: usize) -> f64 {
        let reach = self.instants.iter().fold(0.0f64, |reach, instant| reach.max(instant.abs()));
        let [first, last] = &record.swept_poses;
        let follows = first
            .get(body)
            .zip(last.get(body))
            .is_some_and(|(a, b)| self.meter.is_followed(body, a, b, reach));
        if follows {
            self.instants.get(k).copied().unwrap_or(0.0)
        } else {
            0.0
        }
    }
}
