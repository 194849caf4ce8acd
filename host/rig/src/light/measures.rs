//! Registration of the light of a run: how far it fell from the points that it belongs to.

use crate::frame::FrameTimeline;
use crate::light::record::FrameRecord;
use crate::light::registration::{PlaneLight, RegistrationMeter};
use crate::plan::light_centre::{instants_of_planes, lights_of_frame};
use crate::rig::Rig;
use crate::telemetry::report::{Percentiles, Report};
use dpm_device::link::Moves;
use dpm_device::projector::SlotMoves;
use glam::DVec3;
use hdrhistogram::Histogram;
use std::collections::VecDeque;
use std::sync::Arc;

/// Every so many frames are followed plane by plane.
const FOLLOWED_EVERY: u64 = 16;
/// Followed frames that may wait for what tracks made of them. It comes with the light of the next slot.
const MOST_WAITING: usize = 4;
/// Registration is counted in millionths of a pixel.
const PER_PIXEL: f64 = 1e6;

/// Distributions of the errors of registration over a run. They are known only where the tracker tells the truth.
pub(crate) struct RegistrationMeasures {
    rig: Arc<Rig>,
    meter: RegistrationMeter,
    /// Distance at the centre of the light.
    at_centre: Histogram<u64>,
    /// The same for frames that were lit in their own slot.
    in_time: Histogram<u64>,
    /// What an eye sees that follows a point, of some frames: how far the light lies from it, and how far it is spread.
    followed: [Histogram<u64>; 2],
    /// Tracks move the light of a projector in this process, which tells by how much. Then these frames wait for it.
    tracks: Option<VecDeque<FrameRecord>>,
    /// Per tracked body: the light of each plane of a frame.
    planes: Vec<Vec<PlaneLight>>,
    /// Per tracked body: the planes of a frame follow it.
    follows: Vec<bool>,
    /// Per plane: when the bodies are where it shows them, as a share of the exposure from the frame's instant.
    instants: Vec<f64>,
    /// The same if bodies had been drawn where they were measured, without prediction.
    unpredicted: Histogram<u64>,
}

impl RegistrationMeasures {
    /// For a run of `rig` that has not begun.
    pub(crate) fn new(rig: Arc<Rig>) -> Self {
        let is_mock = rig.config.projector.backend.is_mock();
        Self {
            tracks: (is_mock && rig.wants_tracks()).then(VecDeque::new),
            meter: RegistrationMeter::new(&rig),
            at_centre: histogram(),
            in_time: histogram(),
            followed: [histogram(), histogram()],
            planes: Vec::new(),
            follows: Vec::new(),
            instants: instants_of_planes(&rig),
            unpredicted: histogram(),
            rig,
        }
    }

    /// Per tracked body: the points at which registration is measured, in its own space, metres.
    pub(crate) fn points(&self) -> &[Vec<DVec3>] {
        self.meter.points()
    }

    /// Measures the light of a frame, which fell in its own slot or `late`. Where frames are `prepared`, bodies are lit
    /// whether or not the tracker sees them.
    pub(crate) fn lit(&mut self, record: &FrameRecord, late: bool, prepared: bool) {
        self.measure(record, late, prepared);
        match &mut self.tracks {
            _ if !is_followed(record.id.0) => {}
            None => self.follow(record, None),
            Some(waiting) => {
                if waiting.len() >= MOST_WAITING {
                    waiting.pop_front();
                }
                waiting.push_back(record.clone());
            }
        }
    }

    /// Tracks moved the light of a slot. A frame that waits for that is measured.
    pub(crate) fn moved(&mut self, moves: &SlotMoves) {
        let Some(waiting) = &mut self.tracks else { return };
        let of_slot = |record: &FrameRecord| {
            record.id.0 as u32 == moves.frame && record.timeline.lit_at == Some(moves.first_photon_at)
        };
        let Some(record) = waiting.iter().position(of_slot).and_then(|at| waiting.remove(at)) else { return };
        self.follow(&record, Some(moves));
    }

    /// Measures, on the lit bodies, where the light of each point fell and where the point was at the centre of
    /// that light.
    fn measure(&mut self, record: &FrameRecord, late: bool, prepared: bool) {
        let Some(at) = record.timeline.centre_at else { return };
        let Some(truth) = self.rig.true_poses(at.0) else { return };
        let counted = |px: f64| (px * PER_PIXEL).round() as u64;
        for (i, truth) in truth.iter().enumerate().take(self.rig.bodies.len()) {
            if !prepared && record.dark.get(i).copied().flatten().is_some() {
                continue;
            }
            for px in self.meter.errors(i, &record.tracked_poses[i], truth) {
                self.at_centre.saturating_record(counted(px));
                if !late {
                    self.in_time.saturating_record(counted(px));
                }
            }
            for px in self.meter.errors(i, &record.sampled_poses[i], truth) {
                self.unpredicted.saturating_record(counted(px));
            }
        }
    }

    /// Measures where the light of each plane fell on the lit bodies, as seen by an eye that follows them. `moves`: what
    /// tracks made of the frame.
    fn follow(&mut self, record: &FrameRecord, moves: Option<&SlotMoves>) {
        let FrameTimeline { lit_at: Some(lit_at), last_photon_at: Some(last), .. } = record.timeline else {
            return;
        };
        for planes in &mut self.planes {
            planes.clear();
        }
        self.planes.resize_with(self.rig.bodies.len(), Vec::new);
        let reach = self.instants.iter().fold(0.0f64, |reach, instant| reach.max(instant.abs()));
        let follows = |i: usize| {
            let [first, last] = &record.swept_poses;
            first.get(i).zip(last.get(i)).is_some_and(|(a, b)| self.meter.is_followed(i, a, b, reach))
        };
        self.follows.clear();
        self.follows.extend((0..self.rig.bodies.len()).map(follows));
        let lights = lights_of_frame(&self.rig, last.ns_since(lit_at));
        for (k, ((middle_ns, light), instant)) in lights.zip(&self.instants).enumerate() {
            let moves = *moves.and_then(|slot| slot.planes().get(k)).unwrap_or(&Moves::NONE);
            let Some(poses) = self.rig.true_poses(lit_at.plus_ns(middle_ns).0) else { return };
            for (i, (planes, truth)) in self.planes.iter_mut().zip(poses).enumerate() {
                let instant = if self.follows[i] { *instant } else { 0.0 };
                planes.push(PlaneLight { shown: record.pose_at(i, instant), truth, light, moves });
            }
        }
        let counted = |px: f64| (px * PER_PIXEL).round() as u64;
        for (i, planes) in self.planes.iter().enumerate() {
            if record.dark.get(i).copied().flatten().is_some() {
                continue;
            }
            for seen in self.meter.followed(i, planes) {
                self.followed[0].saturating_record(counted(seen.offset_px));
                self.followed[1].saturating_record(counted(seen.smear_px));
            }
        }
    }

    /// Writes the measurements of the run into a report.
    pub(crate) fn fill(&self, report: &mut Report) {
        let spread = |h: &Histogram<u64>| Percentiles::of_histogram(h, PER_PIXEL);
        report.registration_error_px = spread(&self.at_centre);
        report.registration_error_in_time_px = spread(&self.in_time);
        [report.followed_offset_px, report.followed_smear_px] = self.followed.each_ref().map(spread);
        report.registration_error_unpredicted_px = spread(&self.unpredicted);
        report.pixel_mm = self.meter.pixel_mm(&self.rig);
        report.registration_error_at = report.registration_error_px.map(|_| "light centre");
        report.followed_light =
            report.followed_offset_px.map(|_| match (&self.tracks, self.rig.wants_tracks()) {
                (None, true) => "before tracks",
                _ => "as lit",
            });
    }
}

/// True if a frame is followed plane by plane. The low 32 bits of its number suffice.
pub(crate) fn is_followed(frame: u64) -> bool {
    frame.is_multiple_of(FOLLOWED_EVERY)
}

/// A distribution of what is never negative.
pub(super) fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, 1_000_000_000_000, 3).expect("bounds and digits are in range")
}
