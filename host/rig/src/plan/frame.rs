//! The newest tracks and a slot into the plan of one frame: poses at the time of light, the eye, and when the light must be off.

use super::link_time::LinkTime;
use crate::frame::dark::DarkCause;
use crate::frame::job::{Fate, FrameJob};
use crate::frame::{FrameId, Stage};
use crate::rig::{affine, Rig};
use crate::tracks::TrackSnapshot;
use dpm_common::clock::Stopwatch;
use dpm_device::time::HostTime;
use dpm_tracking::{Freshness, TrackState};

/// What planning knows besides the newest tracks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlanInputs<'a> {
    /// The projector's slots.
    pub slots: &'a LinkTime,
    /// Number of the frame.
    pub id: u64,
    /// The slot that the frame is planned for.
    pub slot: u64,
    /// Slots until the next frame is expected: a renderer slower than its slots plans for every n-th.
    pub stride: u64,
    /// Longest time for which a body is carried on by prediction, nanoseconds (`safety.predict_ms`).
    pub predict_ns: i64,
    /// Age up to which the newest sample of a tracker that works may be when it is read, nanoseconds.
    pub fresh_ns: i64,
    /// Now.
    pub now: HostTime,
}

/// Fills a job: poses at the middle of the slot's exposure, eye, gaze, and the instant from which its light must be off. `snapshot` is the
/// newest there is.
pub(crate) fn plan(job: &mut FrameJob, rig: &Rig, snapshot: &TrackSnapshot, inputs: &PlanInputs<'_>) {
    let watch = Stopwatch::start();
    let FrameJob { note, memory } = job;
    let &PlanInputs { slots, id, slot, stride, predict_ns, .. } = inputs;
    note.id = FrameId(id);
    note.slot = slot;
    note.fate = Fate::UnderWay;
    note.target_at = slots.start(slot);
    note.dark_from = slots.dark_from(slot, stride, predict_ns);
    note.predict_ns = predict_ns;
    let due = slots.host_of_slot(slot);
    let middle = due.plus_ns(slots.host_of_slot(slot + 1).ns_since(due) / 2);
    let timeline = &mut note.timeline;
    *timeline = Default::default();
    timeline.due_at = due;
    let predict = rig.config.prediction.on;
    note.tracked_poses.clear();
    note.sampled_poses.clear();
    note.dark.clear();
    memory.lost.clear();
    note.seen.clear();
    // Of the bodies that are lit; of those that are dark only where none is lit.
    let mut oldest: [Option<(HostTime, HostTime)>; 2] = [None; 2];
    for (i, body) in rig.bodies.iter().enumerate() {
        let track = snapshot.tracks.get(i).copied().flatten();
        let (pose, sampled, dark) = match track {
            Some((state, received_at)) => {
                let state = TrackState { lost_after_ns: predict_ns, ..state };
                let sampled = state.predict(state.captured_at);
                let used = state.predict(middle);
                let dark = (used.freshness == Freshness::Lost).then(|| {
                    // The tracker does its part, but the light is further away than prediction may reach.
                    let speaks = inputs.now.ns_since(state.captured_at) <= inputs.fresh_ns;
                    if speaks {
                        DarkCause::BeyondHorizon
                    } else {
                        DarkCause::Silent
                    }
                });
                let oldest = &mut oldest[usize::from(dark.is_some())];
                if oldest.is_none_or(|(captured, _)| state.captured_at < captured) {
                    *oldest = Some((state.captured_at, received_at));
                }
                let pose = if predict { used.pose } else { sampled.pose };
                (affine(&pose), affine(&sampled.pose), dark)
            }
            // Never seen: nothing may be lit.
            None => (affine(&body.rest), affine(&body.rest), Some(DarkCause::NeverSeen)),
        };
        note.tracked_poses.push(pose);
        note.sampled_poses.push(sampled);
        note.dark.push(dark);
        memory.lost.push(dark.is_some());
        // Where the tracker saw it last is where the tracker says that it is, whether or not that is new enough for light.
        note.seen.push(track.is_some());
    }
    // What is dark has no age.
    note.oldest_captured_at = oldest[0].map(|(captured, _)| captured);
    let (captured_at, received_at) = oldest[0].or(oldest[1]).unwrap_or((due, due));
    timeline.captured_at = captured_at;
    timeline.received_at = received_at;
    rig.scene_poses(&note.tracked_poses, &mut memory.scene_poses);
    (note.eye, memory.gaze) = rig.observer.eye_and_gaze(&note.tracked_poses);
    memory.widen_deg = rig.observer.gaze_body().map_or(0.0, |body| {
        let track = snapshot.tracks.get(body).copied().flatten();
        let unseen_ns = track.map_or(i64::MAX, |(state, _)| middle.ns_since(state.captured_at));
        rig.observer.widening_deg(unseen_ns) as f32
    });
    timeline.wall_ns[Stage::Plan as usize] = watch.elapsed_ns();
}
