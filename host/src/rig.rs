//! A checked configuration into the parts of a rig: scene, projector, bodies with their motions, tracker.

use crate::config::{BodyConfig, EnvironmentConfig, GazeConfig, RigConfig, TrackerConfig};
use crate::geometry::projector::{ProjectorCamera, ProjectorError};
use crate::scene::{self, BodySelector, Environment, LoadOptions, Scene, SceneError};
use dpm_device::planes::Raster;
use dpm_device::pose::Pose;
use dpm_device::time::FrameRate;
use dpm_device::tracker::{Tracker, TrackerError};
use glam::{DAffine3, DQuat, DVec3, Vec3};
use hil_mock::faults::{FaultError, FaultPlan};
use hil_mock::motion::{Motion, MotionError, MotionSpec};
use hil_mock::tracker::{MockTracker, MockTrackerConfig, MockTrackerError};

/// Why a rig cannot be built from a configuration that is valid by itself.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The projector's pose or lens.
    #[error(transparent)]
    Projector(#[from] ProjectorError),
    /// A body's motion.
    #[error("scene.bodies[{index}] \"{name}\": motion: {source}")]
    Motion {
        /// Index in the rig file.
        index: usize,
        /// Its name.
        name: String,
        /// What is wrong.
        source: MotionError,
    },
    /// A motion table that cannot be read.
    #[error("scene.bodies[{index}] \"{name}\": motion: {message}")]
    MotionTable {
        /// Index in the rig file.
        index: usize,
        /// Its name.
        name: String,
        /// What is wrong.
        message: String,
    },
    /// The mock tracker.
    #[error("tracker: {0}")]
    MockTracker(#[from] MockTrackerError),
    /// The mock tracker's faults.
    #[error("tracker.faults: {0}")]
    Faults(#[from] FaultError),
    /// The tracker.
    #[error("tracker: {0}")]
    Tracker(#[from] TrackerError),
    /// A name that no body has.
    #[error("{key}: no body is named \"{name}\"; bodies: {known}")]
    UnknownBody {
        /// Configuration key.
        key: &'static str,
        /// Name given.
        name: String,
        /// Names there are.
        known: String,
    },
    /// A kind of part that this build does not drive.
    #[error("{0}")]
    Unsupported(String),
}

/// One tracked body of the rig.
#[derive(Clone, Debug)]
pub struct RigBody {
    /// Name, as the tracker reports it.
    pub name: String,
    /// Pose at rest.
    pub rest: Pose,
    /// How it truly moves; known only when the tracker is the mock.
    pub motion: Option<Motion>,
}

/// Where the eye is and where it looks, given the poses of the tracked bodies.
#[derive(Clone, Debug)]
pub struct Observer {
    position: DVec3,
    carrier: Option<usize>,
    eye_offset: DVec3,
    gaze: Gaze,
}

#[derive(Clone, Debug)]
enum Gaze {
    Point(DVec3),
    Body(usize),
    Straight,
}

impl Observer {
    /// Eye and gaze point, world.
    pub fn eye_and_gaze(&self, world_from_body: &[DAffine3]) -> (DVec3, DVec3) {
        let carrier = self.carrier.and_then(|i| world_from_body.get(i));
        let eye = carrier.map_or(self.position, |m| m.transform_point3(self.eye_offset));
        let gaze = match self.gaze {
            Gaze::Point(p) => p,
            Gaze::Body(i) => world_from_body.get(i).map_or(eye - DVec3::Z, |m| m.translation),
            Gaze::Straight => eye + carrier.map_or(-DVec3::Z, |m| m.transform_vector3(-DVec3::Z)),
        };
        (eye, gaze)
    }
}

/// All that a run needs and that does not change while it runs.
pub struct Rig {
    /// The configuration it was built from.
    pub config: RigConfig,
    /// What is to be seen.
    pub scene: Scene,
    /// The projector at the raster that is traced and projected.
    pub camera: ProjectorCamera,
    /// Tracked bodies in the order of the rig file.
    pub bodies: Vec<RigBody>,
    /// The eye.
    pub observer: Observer,
}

/// A rigid transform from a pose.
pub fn affine(pose: &Pose) -> DAffine3 {
    DAffine3::from_rotation_translation(
        DQuat::from_array(pose.rotation_xyzw).normalize(),
        DVec3::from_array(pose.position_m),
    )
}

/// The pose of a rigid transform.
pub fn pose_of(m: &DAffine3) -> Pose {
    let (_, rotation, translation) = m.to_scale_rotation_translation();
    Pose { position_m: translation.to_array(), rotation_xyzw: rotation.normalize().to_array() }
}

impl Rig {
    /// Builds the parts. `raster` replaces the projector's (software Vulkan); the field of view stays.
    ///
    /// # Errors
    /// Whatever part cannot be built, with its key.
    pub fn build(config: &RigConfig, raster: Option<Raster>) -> Result<Self, RigError> {
        let mut scene = load_scene(config)?;
        scene.environment = environment(config)?.unwrap_or(scene.environment);
        let p = &config.projector;
        let raster = raster.unwrap_or_else(|| p.raster());
        let camera = ProjectorCamera::look_at(
            raster,
            DVec3::from_array(p.position),
            DVec3::from_array(p.look_at),
            DVec3::from_array(p.up),
            p.horizontal_fov_deg.to_radians(),
        )?;
        let bodies = rig_bodies(config, &scene)?;
        let observer = observer(config, &bodies)?;
        Ok(Self { config: config.clone(), scene, camera, bodies, observer })
    }

    /// Frames a second.
    pub fn rate(&self) -> FrameRate {
        self.config.projector.frame_rate
    }

    /// The tracker that the configuration asks for. Time 0 of the mock's motions is instant 0 of the host's clock.
    ///
    /// # Errors
    /// Its address or its numbers are wrong.
    pub fn tracker(&self) -> Result<Box<dyn Tracker>, RigError> {
        match &self.config.tracker {
            TrackerConfig::Mock(c) => {
                let mut text = c.faults.clone();
                if c.drop_out > 0.0 {
                    let separator = if text.trim().is_empty() { "" } else { "," };
                    text.push_str(&format!("{separator}loss={}", c.drop_out));
                }
                let faults: FaultPlan = text.parse()?;
                let config = MockTrackerConfig {
                    seed: c.seed,
                    rate: FrameRate::new(c.rate_hz, 1)
                        .expect("rate was checked when the configuration was read"),
                    position_noise_m: c.noise_m,
                    rotation_noise_rad: c.noise_rad,
                    latency_ns: i64::from(c.latency_us) * 1000,
                    latency_jitter_ns: i64::from(c.jitter_us) * 1000,
                    faults,
                    ..MockTrackerConfig::default()
                };
                let motions = self.bodies.iter().filter_map(|b| b.motion.clone()).collect();
                Ok(Box::new(MockTracker::new(config, motions)?))
            }
            other => {
                Err(RigError::Unsupported(format!("tracker.kind: {other:?} is not driven by `dpm run` yet")))
            }
        }
    }

    /// True world-from-body of every tracked body at an instant; `None` unless the tracker is the mock.
    pub fn true_poses(&self, t_ns: i64) -> Option<Vec<DAffine3>> {
        self.bodies.iter().map(|b| b.motion.as_ref().map(|m| affine(&m.pose_at(t_ns)))).collect()
    }

    /// Spreads poses of tracked bodies over the bodies of the scene; what is not tracked stays at rest. Allocates nothing when
    /// `out` has room.
    pub fn scene_poses(&self, tracked: &[DAffine3], out: &mut Vec<DAffine3>) {
        out.clear();
        out.extend(self.scene.bodies.iter().map(|b| {
            b.tracked.and_then(|i| tracked.get(usize::from(i))).copied().unwrap_or(b.world_from_body_rest)
        }));
    }

    /// `pi * exposure / (albedo * max_intensity)`.
    pub fn drive_gain(&self) -> f32 {
        let c = &self.config;
        (std::f64::consts::PI * c.render.exposure / (c.scene.surface_albedo * c.projector.max_intensity))
            as f32
    }
}

fn load_scene(config: &RigConfig) -> Result<Scene, SceneError> {
    let c = &config.scene;
    let Some(file) = &c.file else { return Ok(scene::builtin()) };
    let options = LoadOptions {
        bodies: c
            .bodies
            .iter()
            .map(|b| BodySelector { name: b.name.clone(), node: b.node.clone(), projected: true })
            .collect(),
        virtual_nodes: c.virtual_nodes.clone(),
        ..LoadOptions::default()
    };
    scene::load(file, &options)
}

/// The environment of the rig file; `None` keeps the scene's own (the built-in scene brings one).
fn environment(config: &RigConfig) -> Result<Option<Environment>, RigError> {
    match &config.scene.environment {
        EnvironmentConfig::Constant(c) => {
            let own = config.scene.file.is_none() && *c == Default::default();
            let radiance = Vec3::new(c.radiance[0] as f32, c.radiance[1] as f32, c.radiance[2] as f32);
            Ok((!own).then_some(Environment::Constant(radiance)))
        }
        EnvironmentConfig::Image(c) => {
            let rotation = (c.rotation_deg as f32).to_radians();
            Ok(Some(scene::load_environment(&c.file, rotation, c.scale as f32)?))
        }
    }
}

fn motion_spec(index: usize, body: &BodyConfig) -> Result<MotionSpec, RigError> {
    match &body.motion.0 {
        None => Ok(default_motion(index)),
        Some(table) => toml::Value::Table(table.clone()).try_into().map_err(|e: toml::de::Error| {
            RigError::MotionTable { index, name: body.name.clone(), message: e.message().to_owned() }
        }),
    }
}

/// The paper's experiment: the first body moves to and fro at 1 m/s, the second turns in place, others stand.
fn default_motion(index: usize) -> MotionSpec {
    match index {
        0 => MotionSpec::paper_translation(),
        1 => MotionSpec::Rotate {
            axis: [0.0, 1.0, 0.0],
            rate_rad_s: std::f64::consts::PI,
            pivot_offset_m: [0.0; 3],
        },
        _ => MotionSpec::Still,
    }
}

fn rig_bodies(config: &RigConfig, scene: &Scene) -> Result<Vec<RigBody>, RigError> {
    let named = &config.scene.bodies;
    let count = scene.bodies.iter().filter_map(|b| b.tracked).map(|i| usize::from(i) + 1).max().unwrap_or(0);
    let mock = matches!(config.tracker, TrackerConfig::Mock(_));
    (0..count.max(named.len()))
        .map(|i| {
            let first = scene.bodies.iter().find(|b| b.tracked == Some(i as u16));
            let rest = first.map_or(Pose::IDENTITY, |b| pose_of(&b.world_from_body_rest));
            let name = named
                .get(i)
                .map(|b| b.name.clone())
                .or_else(|| first.map(|b| b.name.clone()))
                .unwrap_or_default();
            let spec = match named.get(i) {
                Some(body) => motion_spec(i, body)?,
                None => default_motion(i),
            };
            let motion = if mock {
                Some(Motion::new(&spec, rest).map_err(|source| RigError::Motion {
                    index: i,
                    name: name.clone(),
                    source,
                })?)
            } else {
                None
            };
            Ok(RigBody { name, rest, motion })
        })
        .collect()
}

fn observer(config: &RigConfig, bodies: &[RigBody]) -> Result<Observer, RigError> {
    let find = |key: &'static str, name: &str| {
        bodies.iter().position(|b| b.name == name).ok_or_else(|| RigError::UnknownBody {
            key,
            name: name.to_owned(),
            known: bodies.iter().map(|b| b.name.as_str()).collect::<Vec<_>>().join(", "),
        })
    };
    let c = &config.observer;
    Ok(Observer {
        position: DVec3::from_array(c.position),
        carrier: c.body.as_deref().map(|n| find("observer.body", n)).transpose()?,
        eye_offset: DVec3::from_array(c.eye_offset),
        gaze: match &c.gaze {
            GazeConfig::Point(p) => Gaze::Point(DVec3::from_array(p.point)),
            GazeConfig::Tracked(t) => Gaze::Body(find("observer.gaze.target", &t.target)?),
            GazeConfig::Straight(_) => Gaze::Straight,
        },
    })
}
