//! The tracker of a rehearsal: the rates, delays and errors of the rig's own, over drawn motions.
//!
//! A camera is played by what it sees: the corners of its tags where the true camera has them, with noise, or real pictures
//! of the mock camera; the detector, the solver and the covariance are those of `tracker.kind = "camera"`. Every other tracker
//! is played by the mock, with its noise. Samples are functions of seed and number; polling only delivers them.

use super::truth::RehearsalTruth;
use dpm_camera::{
    sample_of, BodyFinder, FinderSetup, Markings, Picture, Sightings, SpotSighting, TagPlace, TagSighting,
};
use dpm_common::keys::rows::KeyValues;
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{SampleGate, Tracker, TrackerError, TrackerSample};
use dpm_mock::camera::{BrightMarker, CameraOptics, MarkedBody, MockCamera, MockCameraConfig, PrintedTag};
use dpm_mock::motion::Motion;
use dpm_mock::tracker::{MockTracker, MockTrackerConfig};
use dpm_rig::config::{TrackerConfig, TrackerTransformConfig};
use dpm_rig::trackers::{self, PoseOrigin, SampleErrors, SourceError, TrackerKeys, TrackerPlace};
use dpm_scene::geometry::lens::LensModel;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec2, DVec3};
use std::any::Any;
use std::collections::VecDeque;
use std::sync::Arc;

/// A tag that is seen at a flatter angle than this cosine is not found.
const FLATTEST: f64 = 0.2;
/// Nearer to the rim of a picture, pixels, a tag is not found.
const RIM_PX: f64 = 3.0;
/// What the detector says of a corner without noise, pixels.
const LEAST_SIGMA_PX: f64 = 0.01;

/// What a camera is believed to be, and what it is.
#[derive(Clone, Debug)]
pub(super) struct CameraPart {
    /// Pinhole, lens and place in the world, as the rig file has them.
    pub believed: ProjectorCamera,
    /// As they are.
    pub truth: ProjectorCamera,
    /// What it looks for on each body, in the space of the body's mesh.
    pub markings: Vec<Markings>,
    /// By how much these are really off, metres, in the same space.
    pub off: Vec<DVec3>,
    /// Noise of a corner along each axis, pixels.
    pub corner_px: f64,
    /// Of each picture, nanoseconds.
    pub exposure_ns: i64,
    /// How far its lens spreads the light of a point in them, pixels.
    pub softness_px: f64,
    /// The pictures are painted, and the detector looks at them.
    pub paints: bool,
}

/// What plays a tracker.
#[derive(Clone, Debug)]
pub(super) enum Player {
    Camera(Box<CameraPart>),
    /// With errors of its own, and its bodies off by so much, metres.
    Poses(SampleErrors, Vec<DVec3>),
}

/// A tracker as a rehearsal plays it: keys behind the row of the mock.
#[derive(Clone, Debug)]
pub(super) struct TrackerPart {
    /// The rig's own.
    pub of: TrackerConfig,
    pub player: Player,
    /// Samples a second.
    pub rate_hz: u32,
    /// From the end of an exposure to the sample, nanoseconds.
    pub delivery_ns: i64,
    /// By how much stamps are too late as the rig reads them, nanoseconds.
    pub late_ns: i64,
    /// What the rig takes off every stamp, nanoseconds.
    pub corrected_ns: i64,
    pub truth: RehearsalTruth,
}

/// `[tracker]` with these keys.
pub(super) fn config_of(keys: TrackerPart) -> TrackerConfig {
    let row = trackers::kinds().into_iter().find(|kind| kind.origin == PoseOrigin::Simulated);
    TrackerConfig::new(row.unwrap_or_else(|| keys.of.kind()), Arc::new(keys))
}

impl KeyValues for TrackerPart {
    fn as_any(&self) -> &dyn Any {
        self
    }

    /// Each run has one of its own.
    fn is_same(&self, other: &dyn Any) -> bool {
        other.downcast_ref::<Self>().is_some_and(|other| std::ptr::eq(self, other))
    }
}

impl TrackerKeys for TrackerPart {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    /// A camera's poses are in its own space, those of the mock in the world.
    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        match self.player {
            Player::Camera(_) => self.of.frame(),
            Player::Poses(..) => None,
        }
    }

    fn place(&self) -> String {
        "a rehearsal".into()
    }

    fn remedy(&self) -> &'static str {
        "are the tags of tracker.tags in the camera's picture?"
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let source: Box<dyn Source> = match &self.player {
            Player::Camera(camera) => Box::new(RehearsedCamera::new(self, camera, place.motions)?),
            Player::Poses(errors, off) => Box::new(Reports::new(self, errors, off, place.motions)?),
        };
        let gate = SampleGate::new(place.bodies.len());
        Ok(Box::new(PacedTracker { source, gate, next: 0, waiting: VecDeque::new(), made: Vec::new() }))
    }
}

impl TrackerPart {
    fn rate(&self) -> FrameRate {
        FrameRate::new(self.rate_hz.max(1), 1).expect("above 0")
    }

    fn stamp(&self, truly: HostTime) -> HostTime {
        truly.plus_ns(self.late_ns + self.corrected_ns)
    }
}

/// Samples by their number.
trait Source: Send {
    /// When the samples of number `k` arrive.
    fn arrives_at(&self, k: u64) -> HostTime;

    /// Adds the samples of number `k`.
    fn samples(&mut self, k: u64, out: &mut Vec<TrackerSample>);
}

/// Delivers samples when they are due.
struct PacedTracker {
    source: Box<dyn Source>,
    gate: SampleGate,
    next: u64,
    waiting: VecDeque<TrackerSample>,
    made: Vec<TrackerSample>,
}

impl Tracker for PacedTracker {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let Self { source, gate, next, waiting, made } = self;
        let mut count = 0;
        while source.arrives_at(*next) <= now {
            made.clear();
            source.samples(*next, made);
            waiting.extend(made.drain(..).map(|s| TrackerSample { sequence: *next as u32, ..s }));
            *next += 1;
        }
        while let Some(sample) = waiting.pop_front() {
            if let Some(sample) = gate.admit(&sample) {
                sink(&sample);
                count += 1;
            }
        }
        Ok(count)
    }

    fn name(&self) -> &str {
        "rehearsed"
    }

    fn status(&self) -> String {
        self.gate.counters().to_string()
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

/// A tracker that reports poses.
struct Reports {
    keys: TrackerPart,
    tracker: MockTracker,
    off: Vec<DVec3>,
    rate: FrameRate,
    phase_ns: i64,
}

impl Reports {
    fn new(
        keys: &TrackerPart,
        errors: &SampleErrors,
        off: &[DVec3],
        motions: Vec<Motion>,
    ) -> Result<Self, SourceError> {
        let rate = keys.rate();
        let phase_ns = keys.truth.phase_ns(rate.slot_len_ns(0));
        let config = MockTrackerConfig {
            seed: keys.truth.noise().bits(0),
            rate,
            phase_ns,
            position_noise_m: errors.position_m,
            rotation_noise_rad: errors.rotation_rad,
            ..MockTrackerConfig::default()
        };
        let tracker = MockTracker::new(config, motions).map_err(|e| SourceError::of_key("tracker", e))?;
        Ok(Self { keys: keys.clone(), tracker, off: off.to_vec(), rate, phase_ns })
    }
}

impl Source for Reports {
    fn arrives_at(&self, k: u64) -> HostTime {
        HostTime(self.rate.slot_start_ns(k) + self.phase_ns + self.keys.delivery_ns)
    }

    fn samples(&mut self, k: u64, out: &mut Vec<TrackerSample>) {
        let source = self.tracker.source();
        for body in 0..source.body_count() {
            let Some(mut sample) = source.sample(dpm_device::tracker::BodyIndex(body as u16), k) else {
                continue;
            };
            let turn = DQuat::from_array(sample.pose.rotation_xyzw);
            let off = self.off.get(body).copied().unwrap_or_default();
            let place = DVec3::from_array(sample.pose.position_m) + turn * off;
            sample.pose.position_m = place.to_array();
            sample.captured_at = self.keys.stamp(sample.captured_at);
            out.push(TrackerSample { received_at: self.arrives_at(k), ..sample });
        }
    }
}

/// A camera.
struct RehearsedCamera {
    keys: TrackerPart,
    camera: CameraPart,
    motions: Vec<Motion>,
    finder: BodyFinder,
    rate: FrameRate,
    phase_ns: i64,
    draws: Draws,
    /// `None` where corners are drawn.
    painter: Option<(MockCamera, Picture)>,
    tags: Vec<TagSighting>,
    spots: Vec<SpotSighting>,
}

impl RehearsedCamera {
    fn new(keys: &TrackerPart, camera: &CameraPart, motions: Vec<Motion>) -> Result<Self, SourceError> {
        let setup = FinderSetup {
            camera: camera.believed,
            bodies: camera.markings.clone(),
            // Of the mock's own markers.
            marker_level: 100,
        };
        let rate = keys.rate();
        let painter = if camera.paints {
            let painter = MockCamera::new(mock_config(keys, camera)?, marked(camera, &motions));
            Some((painter.map_err(|e| SourceError::of_key("tracker", e))?, Picture::default()))
        } else {
            None
        };
        Ok(Self {
            finder: BodyFinder::new(setup),
            rate,
            // The mock camera has none.
            phase_ns: if camera.paints { 0 } else { keys.truth.phase_ns(rate.slot_len_ns(0)) },
            draws: keys.truth.noise(),
            keys: keys.clone(),
            camera: camera.clone(),
            motions,
            painter,
            tags: Vec::new(),
            spots: Vec::new(),
        })
    }

    fn begin_ns(&self, k: u64) -> i64 {
        self.rate.slot_start_ns(k) + self.phase_ns
    }

    /// Where the true camera has a point of body `body`, with noise; `number`: of the draw.
    fn seen(&self, place: DVec3, draws: Draws, number: u64) -> Option<DVec2> {
        let pixel = self.camera.truth.project(place)?;
        let noise = DVec2::new(draws.normal(2 * number), draws.normal(2 * number + 1));
        let seen = pixel + noise * self.camera.corner_px;
        let [w, h] = [self.camera.truth.raster.width(), self.camera.truth.raster.height()].map(f64::from);
        let inside = (RIM_PX..w - RIM_PX).contains(&seen.x) && (RIM_PX..h - RIM_PX).contains(&seen.y);
        inside.then_some(seen)
    }

    /// Draws what the camera sees at an instant.
    fn draw(&mut self, k: u64, t_ns: i64) {
        let (mut tags, mut spots) = (std::mem::take(&mut self.tags), std::mem::take(&mut self.spots));
        tags.clear();
        spots.clear();
        let sigma_px = self.camera.corner_px.max(LEAST_SIGMA_PX);
        let draws = self.draws.stream(k);
        for (i, (body, motion)) in self.camera.markings.iter().zip(&self.motions).enumerate() {
            let world = affine(&motion.pose_at(t_ns)) * DAffine3::from_translation(self.camera.off[i]);
            let draws = draws.stream(i as u64);
            for (n, tag) in body.tags.iter().enumerate() {
                let corners = tag.corners().map(|c| world.transform_point3(c));
                if !is_faced(&self.camera.truth, &world, tag) {
                    continue;
                }
                let at = |c: usize| self.seen(corners[c], draws, (4 * n + c) as u64);
                if let [Some(a), Some(b), Some(c), Some(d)] = [0, 1, 2, 3].map(at) {
                    let corners = [a, b, c, d];
                    tags.push(TagSighting { id: tag.id, corners, sigma_px: [sigma_px; 4], wrong_cells: 0 });
                }
            }
            for (n, marker) in body.markers.iter().enumerate() {
                let seen = self.seen(world.transform_point3(*marker), draws.stream(1), n as u64);
                spots.extend(seen.map(|centre| SpotSighting { centre, sigma_px, weight: 1000.0 }));
            }
        }
        (self.tags, self.spots) = (tags, spots);
    }
}

impl Source for RehearsedCamera {
    fn arrives_at(&self, k: u64) -> HostTime {
        HostTime(self.begin_ns(k) + self.camera.exposure_ns + self.keys.delivery_ns)
    }

    fn samples(&mut self, k: u64, out: &mut Vec<TrackerSample>) {
        let middle = HostTime(self.begin_ns(k) + self.camera.exposure_ns / 2);
        let found = match &mut self.painter {
            None => {
                self.draw(k, middle.0);
                let seen = Sightings { tags: &self.tags, spots: &self.spots, row_s: 0.0, row: 0.0 };
                self.finder.find(&seen, middle)
            }
            Some((painter, picture)) => {
                let Some(exposure) = painter.exposure(k) else { return };
                painter.paint(&exposure, &mut picture.pixels);
                let [width, height] = painter.config().optics.size.map(|side| side as usize);
                (picture.width, picture.height, picture.number) = (width, height, k as u32);
                picture.begin = HostTime(exposure.begin_ns);
                picture.exposure_ns = self.camera.exposure_ns;
                // Its size is that of the raster, and its bytes are whole.
                self.finder.look(picture).map_or_else(|_| Vec::new(), |(_, found)| found)
            }
        };
        for (body, found) in found.into_iter().enumerate() {
            let marks = &self.finder.bodies()[body];
            if !marks.tags.is_empty() || !marks.markers.is_empty() {
                let sample = sample_of(body, self.keys.stamp(middle), found.as_ref());
                out.push(TrackerSample { received_at: self.arrives_at(k), ..sample });
            }
        }
    }
}

/// Whether a tag shows its front to a camera.
fn is_faced(camera: &ProjectorCamera, world: &DAffine3, tag: &TagPlace) -> bool {
    let place = *world * tag.body_from_tag;
    let to_camera = (camera.position() - place.translation).normalize_or_zero();
    to_camera.dot(place.matrix3.z_axis) > FLATTEST
}

/// Whether all of a body's tags or markers that face the camera lie in its picture, at a pose of the body's mesh.
pub(super) fn is_in_view(camera: &CameraPart, body: usize, world: &DAffine3) -> bool {
    let Some(marks) = camera.markings.get(body) else { return false };
    let [w, h] = [camera.believed.raster.width(), camera.believed.raster.height()].map(f64::from);
    let inside = |p: DVec3| {
        let pixel = camera.believed.project(world.transform_point3(p));
        pixel.is_some_and(|p| (RIM_PX..w - RIM_PX).contains(&p.x) && (RIM_PX..h - RIM_PX).contains(&p.y))
    };
    let tags = marks.tags.iter().filter(|tag| is_faced(&camera.believed, world, tag));
    let tags = tags.filter(|tag| tag.corners().into_iter().all(inside)).count();
    tags > 0 || marks.markers.iter().filter(|m| inside(**m)).count() >= 4
}

fn affine(pose: &Pose) -> DAffine3 {
    let rotation = DQuat::from_array(pose.rotation_xyzw);
    DAffine3::from_rotation_translation(rotation, DVec3::from_array(pose.position_m))
}

fn pose(of: &DAffine3) -> Pose {
    let rotation = DQuat::from_mat3(&of.matrix3).normalize();
    Pose { position_m: of.translation.to_array(), rotation_xyzw: rotation.to_array() }
}

/// The lens of the mock camera; `None` for one that it does not have.
pub(super) fn optics(camera: &ProjectorCamera) -> Option<CameraOptics> {
    let lens = match camera.lens.model() {
        LensModel::Pinhole => [0.0; 5],
        LensModel::Brown(k) if k[5..].iter().all(|k| *k == 0.0) => [k[0], k[1], k[2], k[3], k[4]],
        _ => return None,
    };
    let size = [camera.raster.width(), camera.raster.height()];
    Some(CameraOptics { size, focal: [camera.fx, camera.fy], centre: [camera.cx, camera.cy], lens })
}

fn mock_config(keys: &TrackerPart, camera: &CameraPart) -> Result<MockCameraConfig, SourceError> {
    let no_lens = || SourceError::of_key("tracker.calibration", "the mock camera has no such lens");
    Ok(MockCameraConfig {
        optics: optics(&camera.truth).ok_or_else(no_lens)?,
        pose: pose(&camera.truth.world_from_projector),
        rate: keys.rate(),
        exposure_ns: camera.exposure_ns,
        softness_px: camera.softness_px,
        latency_ns: keys.delivery_ns,
        seed: keys.truth.noise().bits(1),
        ..MockCameraConfig::default()
    })
}

/// The bodies as the mock camera paints them.
fn marked(camera: &CameraPart, motions: &[Motion]) -> Vec<MarkedBody> {
    let bodies = camera.markings.iter().zip(motions).zip(&camera.off);
    let body = |((marks, motion), off): ((&Markings, &Motion), &DVec3)| {
        let off = DAffine3::from_translation(*off);
        let tag =
            |t: &TagPlace| PrintedTag { id: t.id, side_m: t.side, place: pose(&(off * t.body_from_tag)) };
        let ball =
            |m: &DVec3| BrightMarker { middle_m: off.transform_point3(*m).to_array(), radius_m: 0.006 };
        MarkedBody {
            motion: motion.clone(),
            tags: marks.tags.iter().map(tag).collect(),
            markers: marks.markers.iter().map(ball).collect(),
        }
    };
    bodies.map(body).collect()
}
