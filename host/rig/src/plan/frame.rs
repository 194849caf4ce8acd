//! Plans one frame from the newest tracks and a slot: poses at the time of light, the eye, and when the light must be
//! off.

use super::dark::DarkCause;
use super::eyes::{GuardedEyes, HeadWatch};
use super::light_centre::{light_centre_ns, planes_follow};
use super::link_time::LinkTime;
use crate::gaze::GazeSample;
use crate::parameters::applied::ParameterVersion;
use crate::rig::{affine, Rig};
use crate::tracks::TrackSnapshot;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_render::warp::Sweep;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_tracking::{Freshness, TrackState};
use glam::{DAffine3, DVec3};

/// Number of a frame since the start of the run. Never reused; the link carries the low 32 bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FrameId(pub u64);

/// What one frame shows, where, and for how long. [`FramePlan::fill`] makes it when the poses are latched. The
/// renderer draws it, the link sends its planes for its slot, and the collector compares the light with it.
#[derive(Clone, Debug)]
pub(crate) struct FramePlan {
    /// Which frame.
    pub id: FrameId,
    /// The projector's slot for this frame.
    pub slot: u64,
    /// Start of that slot on the host's clock.
    pub due_at: HostTime,
    /// Start of that slot on the projector's clock.
    pub target_at: DeviceTicks,
    /// From this instant of the projector's clock on, the frame must emit no light.
    pub dark_from: DeviceTicks,
    /// The longest time for which prediction may extend a body's track, nanoseconds.
    pub predict_ns: i64,
    /// The oldest mid-exposure among the newest samples of the lit bodies, or of all bodies if none is lit; `due_at`
    /// without any sample.
    pub captured_at: HostTime,
    /// When that sample reached the process.
    pub received_at: HostTime,
    /// At least one body is lit, so `captured_at` is the age of the light.
    pub is_lit: bool,
    /// Per tracked body: predicted world-from-mesh; behind them the same of what people wear.
    pub tracked_poses: Vec<DAffine3>,
    /// Per tracked body: world-from-mesh by the newest sample, without prediction.
    pub sampled_poses: Vec<DAffine3>,
    /// Per tracked body: whether the tracker has reported it since the run began.
    pub seen: Vec<bool>,
    /// Per tracked body: why it is dark; `None` if it is lit.
    pub dark: Vec<Option<DarkCause>>,
    /// Per tracked body: no light falls on it.
    pub lost: Vec<bool>,
    /// Per tracked body: predicted world-from-mesh at the first photon and at the last; empty if all planes show the
    /// bodies at one instant.
    pub swept_poses: [Vec<DAffine3>; 2],
    /// The instant of `tracked_poses` on the host's clock: the centre of the light.
    pub centre_at: HostTime,
    /// The instants of the first photon and of the last.
    pub swept_at: [HostTime; 2],
    /// Per tracked body: from the mesh's space to that of the body that the tracker reports.
    pub mesh_to_body: Vec<DAffine3>,
    /// Per tracked body: standard deviation of the predicted position along its worst axis, metres; 0 without a sample.
    pub sigma_m: Vec<f64>,
    /// Per body of the scene: world-from-body.
    pub scene_poses: Vec<DAffine3>,
    /// The same for `swept_poses`.
    pub swept_scene: [Vec<DAffine3>; 2],
    /// What must stay dark for the eyes of tracked people.
    pub eyes: GuardedEyes,
    /// The eye in world coordinates, metres.
    pub eye: DVec3,
    /// The gaze point in world coordinates, metres.
    pub gaze: DVec3,
    /// Degrees by which the zones around a gaze have grown that is no longer tracked.
    pub widen_deg: f32,
    /// Whether the gaze is measured; `None` if it should not be.
    pub is_gaze_measured: Option<bool>,
    /// Average samples per pixel, in thousandths.
    pub budget_milli: u64,
    /// The same at most, whatever the GPU's times allow.
    pub most_milli: u64,
    /// Which of the shares of the raster is traced, from 0 for the largest.
    pub rung: usize,
    /// Which version of the operator's parameters it uses.
    pub parameters: u64,
    /// Samples of a traced pixel, where neither the angle nor a budget decides them.
    pub samples: u32,
    /// By how much brighter than by the rig file its light is.
    pub brighter: f32,
    /// The projector for which it is drawn.
    pub camera: ProjectorCamera,
}

/// Inputs of planning besides the newest tracks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlanInputs<'a> {
    /// The projector's slots.
    pub slots: &'a LinkTime,
    /// Number of the frame.
    pub id: u64,
    /// The slot that the frame is planned for.
    pub slot: u64,
    /// Slots until the next frame is expected; a renderer slower than its slots plans for every n-th slot.
    pub stride: u64,
    /// The longest time for which prediction may extend a body's track, nanoseconds (`safety.predict_ms`).
    pub predict_ns: i64,
    /// Maximum age of the newest sample of a working tracker when it is read, nanoseconds.
    pub fresh_ns: i64,
    /// Average samples per pixel, in thousandths.
    pub budget_milli: u64,
    /// Which of the shares of the raster is traced.
    pub rung: usize,
    /// What the operator may change while the run goes on.
    pub applied: &'a ParameterVersion,
    /// The newest gaze of a device.
    pub gaze: Option<GazeSample>,
    /// Now.
    pub now: HostTime,
}

impl FramePlan {
    /// An empty plan with room for the bodies of `rig`.
    pub(crate) fn empty(rig: &Rig) -> Self {
        let bodies = rig.bodies.len();
        Self {
            id: FrameId::default(),
            slot: 0,
            due_at: HostTime(0),
            target_at: DeviceTicks(0),
            dark_from: DeviceTicks(0),
            predict_ns: 0,
            captured_at: HostTime(0),
            received_at: HostTime(0),
            is_lit: false,
            tracked_poses: Vec::with_capacity(rig.tracked_count()),
            sampled_poses: Vec::with_capacity(bodies),
            seen: Vec::with_capacity(bodies),
            dark: Vec::with_capacity(bodies),
            lost: Vec::with_capacity(bodies),
            swept_poses: [(); 2].map(|()| Vec::with_capacity(bodies)),
            centre_at: HostTime(0),
            swept_at: [HostTime(0); 2],
            mesh_to_body: Vec::with_capacity(bodies),
            sigma_m: Vec::with_capacity(bodies),
            scene_poses: Vec::with_capacity(rig.scene.bodies.len()),
            swept_scene: [(); 2].map(|()| Vec::with_capacity(rig.scene.bodies.len())),
            eyes: GuardedEyes::empty(rig),
            eye: DVec3::ZERO,
            gaze: DVec3::ZERO,
            widen_deg: 0.0,
            is_gaze_measured: None,
            budget_milli: 0,
            most_milli: 0,
            rung: 0,
            parameters: 0,
            samples: rig.config.render.spp,
            brighter: 1.0,
            camera: rig.camera,
        }
    }

    /// Plans a frame: the poses at the centre of the slot's light, the eye, the gaze, and the instant from which
    /// its light must be off. `snapshot` is the newest one. Allocates nothing in the steady state.
    pub(crate) fn fill(&mut self, rig: &Rig, snapshot: &TrackSnapshot, inputs: &PlanInputs<'_>) {
        let &PlanInputs { slots, id, slot, stride, predict_ns, .. } = inputs;
        (self.id, self.slot) = (FrameId(id), slot);
        (self.predict_ns, self.budget_milli, self.rung) = (predict_ns, inputs.budget_milli, inputs.rung);
        self.take(inputs.applied);
        self.target_at = slots.start(slot);
        // Light falls later than the projector's clock says by this much.
        let late_ns = rig.config.projector.light_delay_ns();
        self.due_at = slots.host_of_slot(slot);
        let exposure_ns = slots.host_of_slot(slot + 1).ns_since(self.due_at);
        let centre = self.due_at.plus_ns(light_centre_ns(rig, exposure_ns) + late_ns);
        self.place_bodies(rig, snapshot, inputs, centre);
        self.dark_from = slots.dark_from(slot, stride, predict_ns - late_ns, self.oldest_captured_at());
        rig.scene_poses(&self.tracked_poses, centre.0, &mut self.scene_poses);
        let first = self.due_at.plus_ns(late_ns);
        (self.centre_at, self.swept_at) = (centre, [first, first.plus_ns(exposure_ns)]);
        self.sweep_bodies(rig, snapshot, inputs.applied);
        self.aim(rig, snapshot, inputs.gaze);
        if let Some(point) = inputs.applied.gaze {
            // A point that the operator names is never lost.
            (self.gaze, self.widen_deg, self.is_gaze_measured) = (point, 0.0, None);
        }
    }

    /// Where the eye is and looks. A measured gaze is a point of the world: where the glasses were when the eyes were seen,
    /// so that a head which turns while the eyes rest on something leaves it there.
    fn aim(&mut self, rig: &Rig, snapshot: &TrackSnapshot, sample: Option<GazeSample>) {
        let observer = &rig.observer;
        (self.eye, self.gaze) = observer.eye_and_gaze(&self.tracked_poses);
        let track = |body: usize| snapshot.tracks.get(body).copied().flatten();
        let since_ns = |at: Option<HostTime>| at.map_or(i64::MAX, |at| self.centre_at.ns_since(at));
        let mut unseen_ns =
            observer.gaze_body().map_or(0, |body| since_ns(track(body).map(|(state, _)| state.captured_at)));
        self.is_gaze_measured = observer.measured_on().map(|body| {
            let unmeasured_ns = since_ns(sample.map(|sample| sample.at));
            unseen_ns = unseen_ns.max(unmeasured_ns);
            let known = sample.zip(track(body)).filter(|_| !observer.is_gaze_lost(unmeasured_ns));
            let Some((sample, (state, _))) = known else { return false };
            let body_from_mesh = self.mesh_to_body.get(body).copied().unwrap_or(DAffine3::IDENTITY);
            let world_from_mesh = affine(&state.predict(sample.at).pose) * body_from_mesh;
            self.gaze = world_from_mesh.transform_point3(sample.point_m);
            true
        });
        self.widen_deg = observer.widening_deg(unseen_ns) as f32;
    }

    /// Spares the heads of `rig`, as `watch` knows them by `snapshot`. While one is lost, no body is lit.
    pub(crate) fn spare(
        &mut self,
        watch: &mut HeadWatch,
        rig: &Rig,
        snapshot: &TrackSnapshot,
        inputs: &PlanInputs<'_>,
    ) {
        let late_ns = rig.config.projector.light_delay_ns();
        let end = inputs.slots.host_of(self.dark_from).plus_ns(late_ns + inputs.slots.bound_ns);
        let light = [self.due_at.plus_ns(late_ns - inputs.slots.bound_ns), end];
        watch.guard(&rig.heads, snapshot, inputs.now, light, &mut self.eyes);
        if self.eyes.lost.is_some() {
            self.dark.iter_mut().for_each(|dark| *dark = dark.or(Some(DarkCause::HeadLost)));
            self.lost.fill(true);
            self.is_lit = false;
        }
    }

    /// Takes what the operator may change. Copies numbers, and allocates nothing.
    fn take(&mut self, applied: &ParameterVersion) {
        (self.parameters, self.most_milli) = (applied.version, applied.most_milli);
        (self.samples, self.brighter, self.camera) = (applied.samples, applied.brighter, applied.camera);
    }

    /// For every tracked body: where it will be at `centre`, and whether light may fall on it there.
    fn place_bodies(
        &mut self,
        rig: &Rig,
        snapshot: &TrackSnapshot,
        inputs: &PlanInputs<'_>,
        centre: HostTime,
    ) {
        self.tracked_poses.clear();
        self.sampled_poses.clear();
        self.seen.clear();
        self.dark.clear();
        self.lost.clear();
        self.mesh_to_body.clear();
        self.sigma_m.clear();
        // The oldest among the lit bodies; the oldest among the dark ones is used only if none is lit.
        let mut oldest: [Option<(HostTime, HostTime)>; 2] = [None; 2];
        for (i, body) in rig.bodies.iter().enumerate() {
            let track = snapshot.tracks.get(i).copied().flatten();
            let mesh_to_body = inputs.applied.mesh_to_body[i];
            let (pose, sampled, sigma_m, dark) = match track {
                Some((state, received_at)) => {
                    let state = TrackState { lost_after_ns: inputs.predict_ns, ..state };
                    let sampled = state.predict(state.captured_at);
                    let used = state.predict(centre);
                    let dark = (used.freshness == Freshness::Lost).then(|| {
                        // The tracker works, but the light is further away than prediction may reach.
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
                    let pose = if rig.config.prediction.on { used.pose } else { sampled.pose };
                    let (pose, sampled) =
                        (affine(&pose) * mesh_to_body, affine(&sampled.pose) * mesh_to_body);
                    (pose, sampled, used.position_sigma_m, dark)
                }
                // Where the body is is not known, so nothing may be lit.
                None => {
                    let cause = if snapshot.ever_seen[i] { DarkCause::Silent } else { DarkCause::NeverSeen };
                    (affine(&body.rest), affine(&body.rest), 0.0, Some(cause))
                }
            };
            self.tracked_poses.push(pose);
            self.sampled_poses.push(sampled);
            self.dark.push(dark);
            self.lost.push(dark.is_some());
            self.mesh_to_body.push(mesh_to_body);
            self.sigma_m.push(sigma_m);
            // A seen body has a known pose, whether or not its sample is new enough for light.
            self.seen.push(track.is_some());
        }
        for (i, worn) in rig.tracked().enumerate().skip(rig.bodies.len()) {
            // Who looks is no light, so what is known of it is used however old it is.
            let track = snapshot.tracks.get(i).copied().flatten();
            let at = |state: &TrackState| if rig.config.prediction.on { centre } else { state.captured_at };
            self.tracked_poses
                .push(affine(&track.map_or(worn.rest, |(state, _)| state.predict(at(&state)).pose)));
        }
        self.is_lit = oldest[0].is_some();
        (self.captured_at, self.received_at) = oldest[0].or(oldest[1]).unwrap_or((self.due_at, self.due_at));
    }

    /// For every body: where it will be at the instants `swept_at`. Bodies whose poses are not predicted stand still.
    fn sweep_bodies(&mut self, rig: &Rig, snapshot: &TrackSnapshot, applied: &ParameterVersion) {
        for (swept, scene) in self.swept_poses.iter_mut().zip(&mut self.swept_scene) {
            swept.clear();
            scene.clear();
        }
        if !planes_follow(rig) || !rig.config.prediction.on {
            return;
        }
        for (end, (swept, scene)) in
            self.swept_at.into_iter().zip(self.swept_poses.iter_mut().zip(&mut self.swept_scene))
        {
            for (i, body) in rig.bodies.iter().enumerate() {
                let track = snapshot.tracks.get(i).copied().flatten();
                swept.push(match track {
                    Some((state, _)) => {
                        let state = TrackState { lost_after_ns: self.predict_ns, ..state };
                        affine(&state.predict(end).pose) * applied.mesh_to_body[i]
                    }
                    None => affine(&body.rest),
                });
            }
            rig.scene_poses(swept, end.0, scene);
        }
    }

    /// How the bodies of the scene move while the planes are lit; `None` if all planes show them at one instant.
    pub(crate) fn sweep(&self) -> Option<Sweep<'_>> {
        let [first, last] = &self.swept_scene;
        (!first.is_empty()).then_some(Sweep { first, last })
    }

    /// The capture time of the newest sample, oldest among the lit bodies; `None` when all bodies are dark, because a
    /// dark body has no age of light.
    pub(crate) fn oldest_captured_at(&self) -> Option<HostTime> {
        self.is_lit.then_some(self.captured_at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use crate::tracks::{open_for, TrackingStage};
    use dpm_device::planes::Raster;
    use dpm_handoff::latest::latest;
    use std::sync::Arc;

    const MS: i64 = 1_000_000;

    /// A rig whose observer wears glasses that turn, with its tracks at 500 ms, and a plan for light 15 ms later.
    fn plan() -> (Rig, TrackSnapshot, FramePlan) {
        let flags = [
            "observer.tracked={name=\"glasses\",motion={kind=\"rotate\",axis=[0,1,0],rate_rad_s=2.0}}",
            "observer.gaze={kind=\"pupil\"}",
            "observer.gaze_hold_ms=100",
            "observer.gaze_widen_deg_per_s=60.0",
            "real_time.pace=\"real\"",
        ];
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let config =
            RigConfig::demo(&Overrides { flags, ..Default::default() }).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(8, 8)).unwrap_or_else(|e| panic!("{e}"));
        let tracker = open_for(&rig, Arc::new(|| HostTime(0)), HostTime(0)).unwrap_or_else(|e| panic!("{e}"));
        let mut stage = TrackingStage::new(&rig, tracker);
        let (mut publisher, mut reader) = latest(TrackSnapshot::empty(rig.tracked_count()));
        for step in 0..=500 {
            stage.step(HostTime(step * MS), &mut publisher).expect("the mock");
        }
        let mut plan = FramePlan::empty(&rig);
        plan.centre_at = HostTime(515 * MS);
        plan.tracked_poses = rig.true_poses(plan.centre_at.0).expect("the mock");
        let snapshot = reader.latest().0.clone();
        (rig, snapshot, plan)
    }

    /// The point is fixed in the world where the glasses were when the eyes were seen; it is held, and then follows their axis
    /// with zones that grow. What the operator names and what was never seen need no sample.
    #[test]
    fn a_measured_gaze_is_a_point_of_the_world_until_it_is_lost() {
        let (rig, snapshot, mut plan) = plan();
        let point_m = DVec3::new(0.2, -0.1, -0.7);
        let glasses = |t_ns: i64| rig.true_poses(t_ns).expect("the mock")[rig.bodies.len()];
        let mut at = |ms: i64| {
            let sample = GazeSample { at: HostTime(ms * MS), received_at: HostTime(500 * MS), point_m };
            plan.aim(&rig, &snapshot, Some(sample));
            (plan.gaze, plan.eye, plan.widen_deg, plan.is_gaze_measured)
        };
        let off_deg = |eye: DVec3, a: DVec3, b: DVec3| (a - eye).angle_between(b - eye).to_degrees();
        for ms in [495, 470, 420] {
            let (gaze, eye, widen, measured) = at(ms);
            let truth = glasses(ms * MS).transform_point3(point_m);
            let off = off_deg(eye, gaze, truth);
            // By the pose of the light it would be off by as much as the head has turned since.
            let late = off_deg(eye, glasses(515 * MS).transform_point3(point_m), truth);
            assert!(off < 0.15 && late > 1.8, "{ms}: {off} and {late} degrees");
            assert_eq!((widen, measured), (0.0, Some(true)));
        }
        let axis = glasses(515 * MS).transform_vector3(-DVec3::Z);
        let (gaze, eye, widen, measured) = at(365);
        assert!((gaze - eye - axis).length() < 1e-9, "after 150 ms: the axis");
        assert!((f64::from(widen) - 60.0 * 0.05).abs() < 1e-3 && measured == Some(false), "{widen}");
        plan.aim(&rig, &snapshot, None);
        assert_eq!((plan.widen_deg, plan.is_gaze_measured), (180.0, Some(false)));
    }
}
