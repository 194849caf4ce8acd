//! Tracks: tells a projector that can move parts of a frame where its bodies are by what the tracker has said since the
//! frame was planned (docs/PROTOCOL.md, section 14).
//!
//! The link's part polls [`PlaneFollower::poll`]. It reads the newest tracks, which another thread publishes, and never waits;
//! nothing is allocated after the start.

use crate::pack::eye_mask::TILE;
use crate::plan::frame::FramePlan;
use crate::plan::link_time::LinkTime;
use crate::rig::{affine, Rig};
use crate::tracks::TrackSnapshot;
use dpm_device::link::{Area, HostLink, Region, Tracks, MAX_REGIONS};
use dpm_device::planes::Raster;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_device::transport::Transport;
use dpm_handoff::latest::Reader;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::Body;
use dpm_tracking::{Freshness, TrackState};
use glam::{DAffine3, DVec2, DVec3};
use std::sync::Arc;

/// Time from one TRACKS message to the next, nanoseconds: the age of the tracks in the light is at most this and the
/// medium's travel.
const EVERY_NS: i64 = 250_000;
/// How long before the slot of a frame its first tracks leave, nanoseconds.
const AHEAD_NS: i64 = 300_000;
/// For how long tracks hold, microseconds. The tracker's next samples come much sooner.
const LASTS_US: u32 = 5_000;
/// Spacing of the three instants through which a distance is drawn as a parabola, nanoseconds.
const SPACING_NS: i64 = 500_000;
/// Greatest shift, mirrors: no light is further from its body than this by more than a body can surprise.
const CLAMP: u8 = 8;
// The eye guard spares the next tile of mirrors and no more.
const _: () = assert!(CLAMP as usize <= TILE);
/// The least distance that moves anything, mirrors: below half a mirror no shift brings light nearer to its place.
const LEAST_GATE: f64 = 0.5;
/// Nor does a distance below so many standard deviations of it, which may be noise: light is never worse with tracks.
const GATE_SIGMAS: f64 = 2.0;
/// Points of a body at which the distance is taken.
const POINTS: usize = 8;
/// Sent frames that are remembered: more than a projector holds.
const REMEMBERED: usize = 8;

/// A body as far as its tracks need it, in the space of its mesh.
struct Shape {
    points: Vec<DVec3>,
    corners: [DVec3; 8],
}

impl Shape {
    /// The tracked body `tracked` of `rig`; `None` if no light falls on it.
    fn of(rig: &Rig, tracked: usize) -> Option<Self> {
        let carried = |b: &&Body| b.tracked == Some(tracked as u16) && b.projected;
        let (parts, rigid): (Vec<&Body>, Vec<&Body>) =
            rig.scene.bodies.iter().filter(carried).partition(|b| !b.is_whole());
        let of = |bodies: &[&Body]| bodies.iter().flat_map(|b| points_of(b)).collect::<Vec<DVec3>>();
        let (mut all, moving) = (of(&rigid), of(&parts));
        let first = *all.first().or(moving.first())?;
        let (lower, upper) = all
            .iter()
            .chain(&moving)
            .fold((first, first), |(lower, upper), p| (lower.min(*p), upper.max(*p)));
        let corners = corners_of(lower, upper);
        if all.is_empty() {
            // All surfaces move by themselves.
            all = moving;
        }
        let n = all.len().min(POINTS);
        Some(Self { points: (0..n).map(|i| all[i * all.len() / n]).collect(), corners })
    }
}

/// The vertices of a body in the space of its carrier; of a part that moves by itself the corners of the box around it,
/// wherever it goes, and of a mesh that deforms those of the box around all its shapes.
fn points_of(body: &Body) -> Vec<DVec3> {
    if let Some(deforms) = &body.deforms {
        let [lower, upper] = deforms.bounds().map(|corner| corner.as_dvec3());
        return corners_of(lower, upper).to_vec();
    }
    let vertices = body.mesh.positions.iter().map(|p| p.as_dvec3());
    let Some(motion) = &body.motion else { return vertices.collect() };
    let (lower, upper) = vertices
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lower, upper), p| (lower.min(p), upper.max(p)));
    let places = motion.instants().into_iter().map(|t| motion.at(t));
    places.flat_map(|place| corners_of(lower, upper).map(|corner| place.transform_point3(corner))).collect()
}

/// The corners of a box.
fn corners_of(lower: DVec3, upper: DVec3) -> [DVec3; 8] {
    let end = |high: bool, a: f64, b: f64| if high { b } else { a };
    std::array::from_fn(|i| {
        DVec3::new(
            end(i & 1 != 0, lower.x, upper.x),
            end(i & 2 != 0, lower.y, upper.y),
            end(i & 4 != 0, lower.z, upper.z),
        )
    })
}

/// What a sent frame was drawn for.
struct FrameAim {
    frame: u32,
    due_at: HostTime,
    /// From then on there is no light of it.
    dark_from: DeviceTicks,
    /// The instant of `poses`, and those of `swept`.
    centre_at: HostTime,
    ends: [HostTime; 2],
    predict_ns: i64,
    camera: ProjectorCamera,
    poses: Vec<DAffine3>,
    swept: [Vec<DAffine3>; 2],
    mesh_to_body: Vec<DAffine3>,
    sigma_m: Vec<f64>,
    lost: Vec<bool>,
}

impl FrameAim {
    fn empty(rig: &Rig) -> Self {
        let bodies = rig.bodies.len();
        Self {
            frame: 0,
            due_at: HostTime(i64::MIN),
            dark_from: DeviceTicks(0),
            centre_at: HostTime(0),
            ends: [HostTime(0); 2],
            predict_ns: 0,
            camera: rig.camera,
            poses: Vec::with_capacity(bodies),
            swept: [(); 2].map(|()| Vec::with_capacity(bodies)),
            mesh_to_body: Vec::with_capacity(bodies),
            sigma_m: Vec::with_capacity(bodies),
            lost: Vec::with_capacity(bodies),
        }
    }

    fn take(&mut self, plan: &FramePlan) {
        (self.frame, self.due_at, self.dark_from) = (plan.id.0 as u32, plan.due_at, plan.dark_from);
        (self.centre_at, self.ends) = (plan.centre_at, plan.swept_at);
        (self.predict_ns, self.camera) = (plan.predict_ns, plan.camera);
        self.poses.clone_from(&plan.tracked_poses);
        self.swept.clone_from(&plan.swept_poses);
        self.mesh_to_body.clone_from(&plan.mesh_to_body);
        self.sigma_m.clone_from(&plan.sigma_m);
        self.lost.clone_from(&plan.lost);
    }

    /// World-from-mesh of `body` for which planes are drawn that are lit at `at`.
    fn pose_at(&self, body: usize, at: HostTime) -> DAffine3 {
        let pose = self.poses[body];
        let (Some(first), Some(last)) = (self.swept[0].get(body), self.swept[1].get(body)) else {
            return pose;
        };
        let exposure_ns = self.ends[1].ns_since(self.ends[0]).max(1);
        let share = at.ns_since(self.centre_at) as f64 / exposure_ns as f64;
        DAffine3 {
            matrix3: pose.matrix3 + (last.matrix3 - first.matrix3) * share,
            translation: pose.translation + (last.translation - first.translation) * share,
        }
    }
}

/// See the module's documentation.
pub(crate) struct PlaneFollower {
    raster: Raster,
    shapes: Vec<Option<Shape>>,
    light_delay_ns: i64,
    newest: Reader<TrackSnapshot>,
    drawn: [FrameAim; REMEMBERED],
    next: usize,
    due_at: HostTime,
    /// Regions of the message under construction with the distance of their bodies from the projector, nearest first.
    regions: [(f64, Region); MAX_REGIONS],
}

impl PlaneFollower {
    /// Follows the bodies of `rig` by the tracks that arrive at `newest`.
    pub(crate) fn new(rig: &Arc<Rig>, newest: Reader<TrackSnapshot>) -> Self {
        Self {
            raster: rig.camera.raster,
            shapes: (0..rig.bodies.len()).map(|i| Shape::of(rig, i)).collect(),
            light_delay_ns: rig.config.projector.light_delay_ns(),
            newest,
            drawn: std::array::from_fn(|_| FrameAim::empty(rig)),
            next: 0,
            due_at: HostTime(i64::MAX),
            regions: [(0.0, Region::default()); MAX_REGIONS],
        }
    }

    /// When it wants to be polled; far in the future before the first frame was sent.
    pub(crate) fn due_at(&self) -> HostTime {
        self.due_at
    }

    /// The frame of `plan` was sent.
    pub(crate) fn sent(&mut self, plan: &FramePlan) {
        self.drawn[self.next].take(plan);
        self.next = (self.next + 1) % REMEMBERED;
        self.due_at = self.due_at.min(plan.due_at.plus_ns(-AHEAD_NS));
    }

    /// Sends the tracks that are due at `now`, if the projector follows tracks. `time` is the projector's clock.
    pub(crate) fn poll(
        &mut self,
        now: HostTime,
        time: &LinkTime,
        link: &mut HostLink,
        transport: &mut dyn Transport,
    ) {
        if now < self.due_at {
            return;
        }
        self.due_at = now.plus_ns(EVERY_NS);
        let Some(most) = link.greatest_shift() else { return };
        let soon = now.plus_ns(AHEAD_NS);
        let is_lit = |drawn: &&FrameAim| drawn.due_at <= now;
        let is_next = |drawn: &&FrameAim| drawn.due_at > now && drawn.due_at <= soon;
        let lit = self.drawn.iter().filter(is_lit).max_by_key(|drawn| drawn.due_at);
        let next = self.drawn.iter().filter(is_next).min_by_key(|drawn| drawn.due_at);
        let frames = [lit, next].map(|drawn| drawn.filter(|d| d.due_at.0 != i64::MIN));
        let snapshot = self.newest.latest().0;
        let ticks = time.ticks_of(now);
        for drawn in frames.into_iter().flatten() {
            if drawn.dark_from <= ticks {
                // After an order to go dark the last frame that was sent is an old one.
                continue;
            }
            let scene = FollowedScene {
                raster: self.raster,
                shapes: &self.shapes,
                light_delay_ns: self.light_delay_ns,
            };
            let tracks = scene.tracks(drawn, snapshot, now, time, most.min(CLAMP), &mut self.regions);
            // What does not get through now is followed by newer tracks.
            let _ = link.send_tracks(now, &tracks, transport);
        }
    }
}

/// What tracks are made of beside the frame and the newest samples.
struct FollowedScene<'a> {
    raster: Raster,
    shapes: &'a [Option<Shape>],
    light_delay_ns: i64,
}

impl FollowedScene<'_> {
    /// The tracks of a frame at `now`, with a region for each body on which light falls.
    fn tracks(
        &self,
        drawn: &FrameAim,
        snapshot: &TrackSnapshot,
        now: HostTime,
        time: &LinkTime,
        clamp: u8,
        regions: &mut [(f64, Region); MAX_REGIONS],
    ) -> Tracks {
        let mut count = 0;
        for (body, shape) in self.shapes.iter().enumerate() {
            let is_lost = drawn.lost.get(body).copied().unwrap_or(true);
            let track = snapshot.tracks.get(body).copied().flatten();
            let (Some(shape), Some((state, _)), false) = (shape, track, is_lost) else { continue };
            let state = TrackState { lost_after_ns: drawn.predict_ns, ..state };
            let Some(region) = self.region(drawn, body, shape, &state, now, clamp) else { continue };
            // Nearest first: where bodies overlap, the light of the nearer one moves with it.
            let at = regions[..count].partition_point(|(before, _)| *before <= region.0);
            if at < MAX_REGIONS {
                let end = (count + 1).min(MAX_REGIONS);
                regions[at..end].rotate_right(1);
                regions[at] = region;
                count = end;
            }
        }
        let mut tracks = Tracks::new(drawn.frame, 0, time.ticks_of(now), LASTS_US);
        for (_, region) in &regions[..count] {
            tracks.push(*region);
        }
        tracks
    }

    /// The region of a body from `now` on, and its distance from the projector; `None` if nothing of it can be told.
    fn region(
        &self,
        drawn: &FrameAim,
        body: usize,
        shape: &Shape,
        state: &TrackState,
        now: HostTime,
        clamp: u8,
    ) -> Option<(f64, Region)> {
        let begin = now.plus_ns(self.light_delay_ns);
        let late = [0, 1, 2].map(|k| state.predict(begin.plus_ns(k * SPACING_NS)));
        if late[2].freshness == Freshness::Lost {
            return None;
        }
        let made = [0, 1, 2].map(|k| drawn.pose_at(body, begin.plus_ns(k * SPACING_NS)));
        let newest = late.each_ref().map(|pose| affine(&pose.pose) * drawn.mesh_to_body[body]);
        let camera = &drawn.camera;
        let mean = |from: &DAffine3, to: &DAffine3| -> Option<DVec2> {
            let sum = shape.points.iter().try_fold(DVec2::ZERO, |sum, p| {
                let at = |pose: &DAffine3| camera.project(pose.transform_point3(*p));
                Some(sum + at(to)? - at(from)?)
            })?;
            Some(sum / shape.points.len() as f64)
        };
        let [d0, d1, d2] = [0, 1, 2].map(|k: usize| mean(&made[k], &newest[k]));
        let (d0, d1, d2) = (d0?, d1?, d2?);
        let ms = SPACING_NS as f64 * 1e-6;
        let centre = camera.to_projector_space(made[0].transform_point3(shape.points[0]));
        let depth = -centre.z;
        // Both poses rest on the same samples but for the newest, so their distance has less noise than two independent ones
        // would have.
        let (before, now) = (drawn.sigma_m[body], late[0].position_sigma_m);
        let noise = (before * before + now * now).sqrt() * camera.fx / depth;
        let fixed = |v: DVec2| Some([fixed(v.x)?, fixed(v.y)?]);
        Some((
            depth,
            Region {
                area: self.area(drawn, body, shape, clamp)?,
                clamp,
                gate: (LEAST_GATE.max(GATE_SIGMAS * noise) * 256.0).min(f64::from(u16::MAX)) as u16,
                offset: fixed(d0)?,
                velocity: fixed((4.0 * d1 - 3.0 * d0 - d2) / (2.0 * ms))?,
                half_acceleration: fixed((d0 - 2.0 * d1 + d2) / (2.0 * ms * ms))?,
                drawn: fixed(mean(&made[0], &made[2])? / (2.0 * ms))?,
            },
        ))
    }

    /// The mirrors on which the light of a body can fall while the frame is lit, whatever its shift; `None` if there are
    /// none, or if the body reaches behind the projector.
    fn area(&self, drawn: &FrameAim, body: usize, shape: &Shape, clamp: u8) -> Option<Area> {
        let mut bounds: Option<(DVec2, DVec2)> = None;
        for pose in drawn.ends.map(|end| drawn.pose_at(body, end)) {
            for corner in &shape.corners {
                let at = drawn.camera.project(pose.transform_point3(*corner))?;
                let (lower, upper) = bounds.unwrap_or((at, at));
                bounds = Some((lower.min(at), upper.max(at)));
            }
        }
        let (lower, upper) = bounds?;
        let margin = f64::from(clamp) + 1.0;
        let within = |v: f64, side: u32| v.clamp(0.0, f64::from(side)) as u16;
        let (width, height) = (self.raster.width(), self.raster.height());
        let (left, top) = (within(lower.x - margin, width), within(lower.y - margin, height));
        let (right, bottom) = (within(upper.x + margin + 1.0, width), within(upper.y + margin + 1.0, height));
        let area = Area { left, top, width: right.saturating_sub(left), height: bottom.saturating_sub(top) };
        area.fits(self.raster).then_some(area)
    }
}

/// A number in 1/256, if it fits.
fn fixed(value: f64) -> Option<i16> {
    let scaled = (value * 256.0).round();
    (scaled.abs() <= f64::from(i16::MAX)).then_some(scaled as i16)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};

    /// A box of 12 cm, on which another one slides by 30 cm to the left and to the right, 12 cm above it.
    fn rig_with_a_slide() -> Rig {
        let folder = std::env::temp_dir().join(format!("dpm-follow-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let corner =
            |i: u32| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|high| if high == 1 { 0.06f32 } else { -0.06 });
        let mut bytes: Vec<u8> = (0..8).flat_map(corner).flat_map(f32::to_le_bytes).collect();
        let faces: [[u16; 4]; 6] =
            [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let indices = faces.iter().flat_map(|[a, b, c, d]| [*a, *b, *c, *a, *c, *d]);
        bytes.extend(indices.flat_map(u16::to_le_bytes));
        let keys = [0.0f32, 1.0, -0.3, 0.12, 0.0, 0.3, 0.12, 0.0];
        bytes.extend(keys.into_iter().flat_map(f32::to_le_bytes));
        std::fs::write(folder.join("slide.bin"), &bytes).unwrap();
        let view =
            |at: usize, length: usize| format!(r#"{{"buffer":0,"byteOffset":{at},"byteLength":{length}}}"#);
        let views = [view(0, 96), view(96, 72), view(168, 8), view(176, 24)].join(",");
        let accessor = |view: u32, component: u32, kind: &str, count: u32| {
            format!(r#"{{"bufferView":{view},"componentType":{component},"type":"{kind}","count":{count}}}"#)
        };
        let accessors = [
            accessor(0, 5126, "VEC3", 8),
            accessor(1, 5123, "SCALAR", 36),
            accessor(2, 5126, "SCALAR", 2),
            accessor(3, 5126, "VEC3", 2),
        ];
        let text = format!(
            r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],
            "nodes":[{{"name":"base","mesh":0,"children":[1]}},{{"name":"slide","mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
            "animations":[{{"channels":[{{"sampler":0,"target":{{"node":1,"path":"translation"}}}}],
            "samplers":[{{"input":2,"output":3}}]}}],
            "accessors":[{}],"bufferViews":[{views}],"buffers":[{{"byteLength":{},"uri":"slide.bin"}}]}}"#,
            accessors.join(","),
            bytes.len()
        );
        std::fs::write(folder.join("slide.gltf"), text).unwrap();
        let file = format!("scene.file={:?}", folder.join("slide.gltf").display().to_string());
        let flags = vec![file, "scene.bodies=[{ name = \"base\" }]".into()];
        let config =
            RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, None).unwrap_or_else(|e| panic!("{e}"));
        std::fs::remove_dir_all(&folder).unwrap();
        rig
    }

    /// The region holds a part wherever it goes; how far a body is from its light is taken where it does not move by itself.
    #[test]
    fn a_region_holds_the_parts_of_its_body() {
        let shape = Shape::of(&rig_with_a_slide(), 0).expect("light falls on it");
        let close = |a: f64, b: f64| (a - b).abs() < 1e-6;
        let ends = |c: usize| {
            let all = shape.corners.map(|corner| corner[c]);
            (
                all.iter().copied().fold(f64::INFINITY, f64::min),
                all.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            )
        };
        assert!(close(ends(0).0, -0.36) && close(ends(0).1, 0.36), "{:?}", ends(0));
        assert!(close(ends(1).0, -0.06) && close(ends(1).1, 0.18), "{:?}", ends(1));
        assert_eq!(shape.points.len(), POINTS);
        assert!(shape.points.iter().all(|p| p.abs().max_element() < 0.061), "{:?}", shape.points);
    }
}
