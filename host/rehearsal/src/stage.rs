//! One run of a rehearsal: the engine of every run, at virtual pace and without a renderer, over played parts; and where its
//! light fell on the true bodies.

use super::projector;
use super::tracker::{config_of, is_in_view, CameraPart, Player, TrackerPart};
use super::truth::RehearsalTruth;
use dpm_camera::{Markings, TagPlace};
use dpm_device::planes::Raster;
use dpm_mock::motion::Motion;
use dpm_rig::config::{Pace, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::light::registration::RegistrationMeter;
use dpm_rig::light::FrameRecord;
use dpm_rig::pipeline::{run_prepared, RunOptions};
use dpm_rig::rig::{affine, Rig};
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::trackers::{PoseOrigin, SampleErrors};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};
use std::sync::Arc;

/// Before this time a filter has not seen enough of the motion, nanoseconds.
pub(super) const SETTLE_NS: i64 = 2_000_000_000;
/// The raster of a run is this part of the projector's along each side: nothing of a run depends on it but its cost.
const COARSER: u32 = 16;
/// Frames a second at which light is measured at most.
const MEASURED_PER_S: f64 = 125.0;
/// Why registration cannot be measured in a run that lit nothing.
const LIT_NOTHING: &str = "the rehearsal lit nothing";

/// The parts of a rig in one run.
#[derive(Clone, Debug)]
pub(super) struct RehearsalCase {
    /// The rig's own configuration, with what is other in this run.
    pub config: RigConfig,
    /// Samples of the tracker a second.
    pub rate_hz: u32,
    /// Exposure of a picture of the camera, microseconds.
    pub exposure_us: u32,
    /// Nothing delays the light of the projector, beside its rate.
    pub is_prompt: bool,
    /// The camera's pictures are painted.
    pub paints: bool,
}

/// What is known of a rig, whatever its parts can do.
pub(super) struct RehearsalStage {
    /// The projector, as the rig has it, at its full raster.
    pub projector: ProjectorCamera,
    /// Camera and markings as the rig has them; `None` for a tracker without one.
    pub camera: Option<(ProjectorCamera, Vec<Markings>)>,
    /// Per tracked body: its pose at rest.
    pub rests: Vec<DAffine3>,
    /// Bodies that the tracker can see.
    pub seen: Vec<bool>,
    /// The middle of the bodies at rest.
    pub middle: DVec3,
    /// From the projector to it along its axis, metres.
    pub distance: f64,
    /// The same from the camera; that of the projector without one.
    pub camera_distance: f64,
    /// What the rig takes off every stamp, nanoseconds.
    pub corrected_ns: i64,
    /// Points of each body, in the space of its mesh, metres.
    pub points: Vec<Vec<DVec3>>,
    /// The rig of the last run, whose scene the next one uses.
    rig: Option<Rig>,
}

/// Where the light of a run fell.
#[derive(Clone, Debug, Default)]
pub(super) struct LightFall {
    /// Distances from points to their light, pixels and millimetres across the light.
    pub px: Vec<f64>,
    pub mm: Vec<f64>,
    /// The same, millimetres, if bodies had been drawn where they were measured.
    pub held_mm: Vec<f64>,
    /// From the newest exposure to the centre of the light, milliseconds.
    pub late_ms: Vec<f64>,
    /// Bodies in measured frames, and those of them that stayed dark.
    pub bodies: u64,
    pub dark: u64,
}

impl LightFall {
    pub(super) fn add(&mut self, other: Self) {
        self.px.extend(other.px);
        self.mm.extend(other.mm);
        self.held_mm.extend(other.held_mm);
        self.late_ms.extend(other.late_ms);
        self.bodies += other.bodies;
        self.dark += other.dark;
    }
}

fn refuse(told: impl Into<String>) -> Failure {
    Failure::new(FailureKind::BadInput, told.into())
}

/// What cannot be rehearsed.
fn check(config: &RigConfig) -> Result<(), Failure> {
    if config.projector.backend.kind().is_loaded() {
        return Err(refuse(format!(
            "a {} shows frames that are loaded before their time, and follows no tracker: there is nothing to rehearse",
            config.projector.backend.kind().name
        )));
    }
    if config.tracker.kind().origin == PoseOrigin::Recorded {
        return Err(refuse(
            "a recording has motions and errors of its own: rehearse the tracker that made it, or run the recording with \
             --simulate",
        ));
    }
    Ok(())
}

impl RehearsalStage {
    /// What is known of the rig of `config`.
    ///
    /// # Errors
    /// The rig cannot be built, a camera sees no body, or nothing of this kind can be rehearsed.
    pub(super) fn new(config: &RigConfig) -> Result<Self, Failure> {
        check(config)?;
        let config = quiet(config);
        let own = Rig::build(&config, None)?;
        let rests: Vec<DAffine3> = own.bodies.iter().map(|body| affine(&body.rest)).collect();
        let camera = camera_of(&own)?;
        let mean = rests.iter().map(|rest| rest.translation).sum::<DVec3>() / rests.len().max(1) as f64;
        let from = |eye: &ProjectorCamera| -eye.to_projector_space(mean).z;
        let distance = from(&own.camera);
        if distance.is_nan() || distance <= 0.0 {
            return Err(refuse("the bodies lie behind the projector: correct its place or its direction"));
        }
        let is_marked = |m: &Markings| !m.tags.is_empty() || m.markers.len() >= 4;
        let seen: Vec<bool> = match &camera {
            None => vec![true; rests.len()],
            Some((_, markings)) => markings.iter().take(rests.len()).map(is_marked).collect(),
        };
        if !seen.contains(&true) {
            return Err(refuse("no body has tags or markers: name them at tracker.tags"));
        }
        let written = config.tracker.frame().map_or(0, |(_, latency_us)| latency_us * 1000);
        let small = |side: u32| (side / COARSER).max(8);
        let raster = own.camera.raster;
        let coarse = Raster::new(small(raster.width()), small(raster.height()));
        let stage = Self {
            projector: own.camera,
            camera_distance: camera.as_ref().map_or(distance, |(eye, _)| from(eye)),
            rests,
            seen,
            distance,
            middle: mean,
            corrected_ns: if camera.is_some() { own.latency_ns.unwrap_or(written) } else { 0 },
            points: RegistrationMeter::new(&own).points().to_vec(),
            camera,
            rig: Some(Rig::build(&config, coarse)?),
        };
        stage.check_view(&own)?;
        Ok(stage)
    }

    /// Every body that carries tags must be in view at rest.
    fn check_view(&self, rig: &Rig) -> Result<(), Failure> {
        let Some((believed, markings)) = &self.camera else { return Ok(()) };
        let camera = CameraPart {
            believed: *believed,
            truth: *believed,
            markings: markings.clone(),
            off: vec![DVec3::ZERO; markings.len()],
            corner_px: 0.0,
            exposure_ns: 1,
            softness_px: 0.0,
            paints: false,
        };
        for (i, rest) in self.rests.iter().enumerate().filter(|(i, _)| self.seen[*i]) {
            if !is_in_view(&camera, i, rest) {
                return Err(refuse(format!(
                    "the camera does not see the tags of {:?} whole and from the front where the body rests, at ({:.2}, {:.2}, \
                     {:.2}) m: correct tracker.transform, or the places of its tags",
                    rig.bodies[i].name, rest.translation.x, rest.translation.y, rest.translation.z
                )));
            }
        }
        Ok(())
    }

    /// From the latch of a frame's poses to the centre of its light in `case`, nanoseconds.
    pub(super) fn latch_to_light_ns(&self, case: &RehearsalCase) -> i64 {
        let config = &case.config;
        let costs = &config.real_time.stage_costs_us;
        let backend = projector::played(&config.projector.backend, case.is_prompt);
        let frame_ns = config.projector.frame_rate.slot_len_ns(0);
        let delay_ns = i64::from(config.projector.latency_us) * 1000 + backend.light_delay_ns(frame_ns);
        (i64::from(costs.total()) + i64::from(costs.track)) * 1000 + delay_ns + frame_ns / 2
    }

    /// From the middle of an exposure to the finished sample, nanoseconds.
    pub(super) fn delivery_ns(&self, case: &RehearsalCase) -> i64 {
        let [exposure, delivery] = delivery_of(case, self.camera.is_some());
        exposure / 2 + delivery
    }

    /// The noise of a tracker that reports poses.
    pub(super) fn errors(case: &RehearsalCase) -> SampleErrors {
        let rehearsal = &case.config.rehearsal;
        let written = SampleErrors {
            position_m: rehearsal.noise_m,
            rotation_rad: rehearsal.noise_rad,
            delivery_ns: 1_000_000_000 / i64::from(case.rate_hz.max(1)),
        };
        case.config.tracker.errors().unwrap_or(written)
    }

    /// Runs a case with the truth of `seed` for `seconds` after the filters have settled.
    ///
    /// # Errors
    /// The engine refuses the rig.
    pub(super) fn run(
        &mut self,
        case: &RehearsalCase,
        seed: u64,
        seconds: f64,
    ) -> Result<LightFall, Failure> {
        let truth = RehearsalTruth::new(seed);
        let rehearsal = case.config.rehearsal.clone();
        let mut config = quiet(&case.config);
        let player = self.player(case, truth);
        let [_, delivery_ns] = delivery_of(case, self.camera.is_some());
        let keys = TrackerPart {
            of: case.config.tracker.clone(),
            player,
            rate_hz: case.rate_hz,
            delivery_ns,
            late_ns: truth.late_ns(&rehearsal),
            corrected_ns: self.corrected_ns,
            truth,
        };
        let late_ns = keys.late_ns;
        config.tracker = config_of(keys);
        config.projector.backend = projector::played(&case.config.projector.backend, case.is_prompt);
        let Some(rig) = self.rig.take() else { return Err(refuse(LIT_NOTHING)) };
        let mut rig = rig.with_config(&config)?;
        let axes = &self.projector.world_from_projector.matrix3;
        for (i, body) in rig.bodies.iter_mut().enumerate() {
            let spec = truth.motion(i, &rehearsal, axes.x_axis, axes.y_axis);
            let wrong = |e| refuse(format!("{:?} cannot move as the rehearsal asks: {e}", body.name));
            body.motion = Some(Motion::new(&spec, body.rest).map_err(wrong)?);
        }
        let rig = Arc::new(rig);
        let rate = rig.rate();
        let frames = rate.slot_at_ns(SETTLE_NS + (seconds * 1e9) as i64);
        let options = RunOptions {
            frames,
            keep_records: frames as usize,
            verify: false,
            tells_slow: false,
            ..RunOptions::default()
        };
        let outcome = run_prepared(rig.clone(), options, &Arc::new(RunMonitor::default()))?;
        let every = (rate.hz() / MEASURED_PER_S).ceil().max(1.0) as u64;
        let delay_ns = config.projector.light_delay_ns();
        let eye = truth.eye(&self.projector, rehearsal.projector_px, self.distance, 1);
        let mut fallen = LightFall::default();
        for record in outcome.recent.iter().filter(|record| record.id.0.is_multiple_of(every)) {
            self.measure(&rig, record, &eye, [delay_ns, late_ns], &mut fallen);
        }
        drop(outcome);
        self.rig = Arc::try_unwrap(rig).ok();
        if fallen.mm.is_empty() {
            return Err(Failure::new(FailureKind::CheckFailed, LIT_NOTHING));
        }
        Ok(fallen)
    }

    fn player(&self, case: &RehearsalCase, truth: RehearsalTruth) -> Player {
        let rehearsal = &case.config.rehearsal;
        let off = |count: usize| (0..count).map(|body| truth.off_body(body, rehearsal)).collect();
        match &self.camera {
            None => Player::Poses(Self::errors(case), off(self.rests.len() + case.config.worn().len())),
            Some((believed, markings)) => Player::Camera(Box::new(CameraPart {
                believed: *believed,
                truth: truth.eye(believed, rehearsal.camera_px, self.camera_distance, 0),
                off: off(markings.len()),
                markings: markings.clone(),
                corner_px: rehearsal.corner_px,
                exposure_ns: delivery_of(case, true)[0],
                softness_px: rehearsal.softness_px,
                paints: case.paints,
            })),
        }
    }

    /// Measures a frame: where its light fell through the true projector, and where the true bodies were.
    fn measure(
        &self,
        rig: &Rig,
        record: &FrameRecord,
        eye: &ProjectorCamera,
        [delay_ns, late_ns]: [i64; 2],
        fallen: &mut LightFall,
    ) {
        let Some(at) = record.timeline.centre_at.map(|at| at.plus_ns(delay_ns)) else { return };
        let Some(poses) = rig.true_poses(at.0).filter(|_| at.0 >= SETTLE_NS) else { return };
        for (i, truth) in poses.iter().enumerate().take(self.rests.len()).filter(|(i, _)| self.seen[*i]) {
            fallen.bodies += 1;
            if record.dark.get(i).copied().flatten().is_some() {
                fallen.dark += 1;
                continue;
            }
            for p in &self.points[i] {
                let place = truth.transform_point3(*p);
                let Some(is) = eye.project(place) else { continue };
                let mm = -1e3 * eye.to_projector_space(place).z / eye.fx;
                let lit = |pose: &DAffine3| self.projector.project(pose.transform_point3(*p));
                if let Some(lit) = lit(&record.tracked_poses[i]) {
                    fallen.px.push((lit - is).length());
                    fallen.mm.push((lit - is).length() * mm);
                }
                fallen.held_mm.extend(lit(&record.sampled_poses[i]).map(|lit| (lit - is).length() * mm));
            }
        }
        let captured = record.timeline.captured_at.plus_ns(-late_ns);
        fallen.late_ms.push(at.ns_since(captured) as f64 * 1e-6);
    }
}

/// Exposure, and the time from its end to the sample, nanoseconds.
fn delivery_of(case: &RehearsalCase, is_camera: bool) -> [i64; 2] {
    let rehearsal = &case.config.rehearsal;
    let written = rehearsal.delivery_us.map(|us| i64::from(us) * 1000);
    if is_camera {
        let period_ns = 1_000_000_000 / i64::from(case.rate_hz.max(1));
        [i64::from(case.exposure_us) * 1000, written.unwrap_or(period_ns)]
    } else {
        let errors = case.config.tracker.errors();
        [0, errors.map(|e| e.delivery_ns).or(written).unwrap_or(RehearsalStage::errors(case).delivery_ns)]
    }
}

/// A configuration that writes nothing, guards nobody and plays no pictures.
fn quiet(config: &RigConfig) -> RigConfig {
    let mut config = config.clone();
    config.real_time.pace = Pace::Virtual;
    config.safety.eyes.guard = false;
    let output = &mut config.output;
    (output.images, output.trace, output.flight_recorder) = (false, false, false);
    config.scene.bodies.iter_mut().for_each(|body| body.texture = None);
    config
}

/// The camera of a rig's tracker, and what it looks for on all that is tracked, in the space of the meshes.
fn camera_of(rig: &Rig) -> Result<Option<(ProjectorCamera, Vec<Markings>)>, Failure> {
    let Some(eye) = rig.config.tracker.eye() else { return Ok(None) };
    let of_mesh = |body: &dpm_rig::rig::RigBody| {
        let marks = rig.config.tracker.seen_of(&body.name).unwrap_or_default();
        let mesh = body.mesh_to_body.inverse();
        let tags = marks.tags.iter().map(|t| TagPlace { body_from_tag: mesh * t.body_from_tag, ..*t });
        let markers = marks.markers.iter().map(|m| mesh.transform_point3(*m));
        Markings { tags: tags.collect(), markers: markers.collect() }
    };
    Ok(Some((eye?, rig.tracked().map(of_mesh).collect())))
}
