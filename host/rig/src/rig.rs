//! Builds the parts of a rig from a checked configuration: scene, projector, bodies with their motions, tracker.

pub mod plausible;

use crate::calibrated::{measured, measured_camera, told_of_measured};
use crate::camera_file::{calibrated_camera, CameraFileError};
use crate::config::{
    BodyConfig, BuiltinScene, EnvironmentConfig, FileAxis, LiveSource, PictureSource, RigConfig, Tracing,
    TracksUse, MAX_TRACKED,
};
use crate::drive::{albedo_of, drive, DriveError, MAX_PICTURE_BYTES};
use crate::gaze::GazeAim;
use crate::mock::{Motion, MotionError, MotionSpec};
use dpm_calibration_file::CalibrationFile;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::pose::Pose;
use dpm_device::regular_file;
use dpm_device::time::FrameRate;
use dpm_render::drive::Drive;
use dpm_scene::geometry::projector::{ProjectorCamera, ProjectorError};
use dpm_scene::{
    AnimationChoice, BodySelector, Environment, Limits, LivePictures, LoadOptions, Scene, SceneError,
    SceneFeatures, UpAxis,
};
use glam::{DAffine3, DQuat, DVec3, Vec3};
use std::sync::Arc;

/// Why a rig cannot be built from a configuration that passed its own checks.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The scene cannot be loaded.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The projector's pose or lens is invalid.
    #[error(transparent)]
    Projector(#[from] ProjectorError),
    /// A picture cannot be shown on a body.
    #[error("scene.bodies[].texture: body \"{name}\": {picture}: {message}")]
    Picture {
        /// The body's name.
        name: String,
        /// The picture.
        picture: PictureSource,
        /// What is wrong.
        message: String,
    },
    /// A body's motion is invalid.
    #[error("\"{name}\": motion: {source}")]
    Motion {
        /// The body's name.
        name: String,
        /// What is wrong.
        source: MotionError,
    },
    /// A body's motion table cannot be read.
    #[error("\"{name}\": motion: {message}")]
    MotionTable {
        /// The body's name.
        name: String,
        /// What is wrong.
        message: String,
    },
    /// The calibration file cannot be used.
    #[error(transparent)]
    Calibration(#[from] CameraFileError),
    /// A file that describes the projector's light cannot be used.
    #[error(transparent)]
    Drive(#[from] DriveError),
    /// No body has this name.
    #[error("{key}: no body is named \"{name}\"; bodies: {known}")]
    UnknownBody {
        /// Configuration key.
        key: &'static str,
        /// The name that was given.
        name: String,
        /// The names that exist.
        known: String,
    },
    /// This build cannot drive a part of this kind.
    #[error("{0}")]
    Unsupported(String),
}

impl RigError {
    /// The part of the rig that it is about, and what to do.
    pub fn part_and_remedy(&self) -> (&'static str, String) {
        match self {
            Self::Scene(e) => ("scene", e.remedy()),
            Self::Projector(_) => (
                "projector's view",
                "correct projector.position, projector.look_at, projector.up or projector.horizontal_fov_deg"
                    .into(),
            ),
            Self::Picture { .. } => ("pictures", "name another picture there, or leave the key out".into()),
            Self::Motion { name, .. } | Self::MotionTable { name, .. } => {
                ("motion", format!("correct the motion of {name:?} in the rig file, see docs/CONFIG.md"))
            }
            Self::Calibration(e) if e.key == "calibration.file" => {
                ("calibration", "measure again with `dpm calibrate`, or leave calibration.file out".into())
            }
            Self::Calibration(e) => ("calibration", format!("correct {} as it says", e.key)),
            Self::Drive(e) => {
                ("light", format!("correct {}, or measure it again with `dpm calibrate light`", e.key))
            }
            Self::UnknownBody { key, .. } => ("observer", format!("write one of these names at {key}")),
            Self::Unsupported(_) => ("rig", "choose another value there".into()),
        }
    }
}

/// One tracked body of the rig.
#[derive(Clone, Debug)]
pub struct RigBody {
    /// Name, as the tracker reports it.
    pub name: String,
    /// Number under which the tracker reports it, if the tracker has no names.
    pub id: Option<i64>,
    /// Pose of its mesh at rest.
    pub rest: Pose,
    /// From the mesh's space to that of the body that the tracker reports; the identity with the mock tracker, which
    /// reports the mesh.
    pub mesh_to_body: DAffine3,
    /// Its true motion, which is known only with the mock tracker.
    pub motion: Option<Motion>,
}

/// A head about which no light may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GuardedHead {
    /// Index of what is tracked of it, among [`Rig::tracked`].
    pub tracked: usize,
    /// Radius of the sphere about its origin, metres.
    pub radius_m: f64,
    /// For how long it may be lost before all light goes off, nanoseconds.
    pub lost_ns: i64,
}

/// Where the eye is and where it looks, computed from the poses of all that is tracked.
#[derive(Clone, Debug)]
pub struct Observer {
    position: DVec3,
    carrier: Option<usize>,
    eye_offset: DVec3,
    gaze: Gaze,
    gaze_hold_ns: i64,
    gaze_widen_deg_per_s: f64,
}

#[derive(Clone, Debug)]
enum Gaze {
    Point(DVec3),
    Body(usize),
    Straight,
    Measured,
}

impl Observer {
    /// The same eye, but looking at a fixed point of the world.
    pub fn looking_at(self, point: DVec3) -> Self {
        Self { gaze: Gaze::Point(point), ..self }
    }

    /// The tracked body on which the gaze depends; `None` if the gaze does not depend on a tracker.
    pub(crate) fn gaze_body(&self) -> Option<usize> {
        match self.gaze {
            Gaze::Point(_) => None,
            Gaze::Body(i) => Some(i),
            Gaze::Straight | Gaze::Measured => self.carrier,
        }
    }

    /// The body in whose frame a device measures the gaze; `None` if none does.
    pub(crate) fn measured_on(&self) -> Option<usize> {
        self.carrier.filter(|_| matches!(self.gaze, Gaze::Measured))
    }

    /// True for a gaze that was last known so long ago that it is not held any more.
    pub(crate) fn is_gaze_lost(&self, unseen_ns: i64) -> bool {
        unseen_ns > self.gaze_hold_ns
    }

    /// How far all zones around the gaze grow when the gaze's body was last seen `unseen_ns` ago, in degrees: 0 while
    /// the body is held, 180 at most.
    pub(crate) fn widening_deg(&self, unseen_ns: i64) -> f64 {
        let beyond_s = unseen_ns.saturating_sub(self.gaze_hold_ns).max(0) as f64 * 1e-9;
        (beyond_s * self.gaze_widen_deg_per_s).min(180.0)
    }

    /// The eye and the gaze point, in world coordinates. A gaze that is measured is straight ahead here: what is known without
    /// the device.
    pub fn eye_and_gaze(&self, world_from_body: &[DAffine3]) -> (DVec3, DVec3) {
        let carrier = self.carrier.and_then(|i| world_from_body.get(i));
        let eye = carrier.map_or(self.position, |m| m.transform_point3(self.eye_offset));
        let gaze = match self.gaze {
            Gaze::Point(p) => p,
            Gaze::Body(i) => world_from_body.get(i).map_or(eye - DVec3::Z, |m| m.translation),
            Gaze::Straight | Gaze::Measured => {
                eye + carrier.map_or(-DVec3::Z, |m| m.transform_vector3(-DVec3::Z))
            }
        };
        (eye, gaze)
    }
}

/// Everything that a run needs and that does not change during the run.
pub struct Rig {
    /// The configuration that the rig was built from.
    pub config: RigConfig,
    /// The scene to be shown.
    pub scene: Scene,
    /// The projector, at the raster that is traced and projected.
    pub camera: ProjectorCamera,
    /// The tracked bodies of the scene, in the order of the rig file.
    pub bodies: Vec<RigBody>,
    /// What people wear: tracked, and nothing that light falls on.
    pub worn: Vec<RigBody>,
    /// The heads that are guarded, the observer's first; empty if the guard is off.
    pub heads: Vec<GuardedHead>,
    /// The observer's eye.
    pub observer: Observer,
    /// The planes of a frame in the order in which they are shown.
    pub schedule: PlaneSchedule,
    /// From radiance to code values.
    pub drive: Drive,
    /// How much older the tracker's samples are than they say, if it was measured, nanoseconds. It takes the place of
    /// `tracker.latency_us`.
    pub latency_ns: Option<i64>,
    /// What is used of the calibration file, one sentence; `None` without such a file.
    pub calibration: Option<String>,
    /// How method "auto" was decided, one sentence; `None` where the rig file names the method, or before it is decided.
    pub method_choice: Option<String>,
}

/// A rigid transform from a pose.
pub fn affine(pose: &Pose) -> DAffine3 {
    DAffine3::from_rotation_translation(
        DQuat::from_array(pose.rotation_xyzw).normalize(),
        DVec3::from_array(pose.position_m),
    )
}

/// The pose of a rigid transform.
pub(crate) fn pose_of(m: &DAffine3) -> Pose {
    let (_, rotation, translation) = m.to_scale_rotation_translation();
    Pose { position_m: translation.to_array(), rotation_xyzw: rotation.normalize().to_array() }
}

impl Rig {
    /// Builds the parts. `raster` replaces the projector's raster (for software Vulkan); the field of view stays the
    /// same.
    ///
    /// # Errors
    /// A part cannot be built. The error names its key.
    pub fn build(config: &RigConfig, raster: Option<Raster>) -> Result<Self, RigError> {
        let mut scene = load_scene(config)?;
        // Light on what carries the eye would be light in the eyes of whoever wears it.
        let carrier = config.scene.bodies.iter().position(|b| config.observer.body.as_ref() == Some(&b.name));
        for body in
            scene.bodies.iter_mut().filter(|b| carrier.is_some() && b.tracked.map(usize::from) == carrier)
        {
            body.projected = false;
        }
        show_pictures(config, &mut scene)?;
        let features = SceneFeatures::of(&scene);
        let has_lights = features.lamp_triangles + features.punctual_lights > 0;
        let (fitted, told) =
            environment(config, has_lights, &mut scene.warnings)?.unwrap_or(scene.environment).fitted();
        scene.environment = fitted;
        scene.warnings.extend(told.map(|t| format!("scene.environment: {t}")));
        if config.render.tracing == Tracing::Query && scene.bodies.iter().any(|b| b.deforms.is_some()) {
            scene.warnings.push(
                "render.tracing = \"query\": the shaders walk all the same, because the trees that the GPU builds do not \
                 follow meshes that deform"
                    .into(),
            );
        }
        scene.warnings.extend(dark_glass(&scene, config.render.depth));
        Self::around(scene, config, raster)
    }

    /// The same scene with everything else as another configuration says.
    ///
    /// # Errors
    /// A part cannot be built. The error names its key.
    pub fn with_config(self, config: &RigConfig) -> Result<Self, RigError> {
        Self::around(self.scene, config, Some(self.camera.raster))
    }

    /// Builds the projector's camera of `config` and drops it: what a mistake in the scene must not hide.
    ///
    /// # Errors
    /// It cannot be built. The error names its key.
    pub fn check_camera(config: &RigConfig) -> Result<(), RigError> {
        let raster = config.projector.raster();
        match &measured(config)?.projector {
            Some(section) => measured_camera(section, config, raster).map(drop)?,
            None => camera(config, raster, &mut Vec::new()).map(drop)?,
        }
        Ok(())
    }

    fn around(mut scene: Scene, config: &RigConfig, raster: Option<Raster>) -> Result<Self, RigError> {
        let raster = raster.unwrap_or_else(|| config.projector.raster());
        let measured = measured(config)?;
        let camera = match &measured.projector {
            Some(section) => measured_camera(section, config, raster)?,
            None => camera(config, raster, &mut scene.warnings)?,
        };
        let mut bodies = rig_bodies(config, &scene)?;
        // The mock tracker reports the mesh itself.
        let mut placed = Vec::new();
        for body in bodies.iter_mut().filter(|b| b.motion.is_none()) {
            if let Some((name, section)) = measured.bodies.get_key_value(&body.name) {
                body.mesh_to_body = section.mesh_to_body.to_affine();
                placed.push(name.as_str());
            }
        }
        let worn = rig_worn(config)?;
        let (observer, heads) = (observer(config, &bodies, &worn)?, heads(config, &bodies, &worn)?);
        let drive = drive(config, &measured, &scene, raster)?;
        let latency_ns = measured.latency.as_ref().map(|l| (l.latency_us * 1e3).round() as i64);
        let calibration = told_of_measured(&measured, config, &placed);
        let schedule = config.projector.schedule();
        let config = config.clone();
        let mut rig = Self {
            config,
            scene,
            camera,
            bodies,
            worn,
            heads,
            observer,
            schedule,
            drive,
            latency_ns,
            calibration,
            method_choice: None,
        };
        // Those of a rig that was built before with the same scene may hold no more.
        rig.scene.warnings.retain(|told| !told.starts_with(plausible::MARK));
        let doubts = plausible::doubts(&rig);
        rig.scene.warnings.extend(doubts.iter().map(ToString::to_string));
        Ok(rig)
    }

    /// The projector of a rig alone, without scene and bodies: for light that nothing is traced for. It is measured only
    /// where heads are guarded, and there as far as it was.
    ///
    /// # Errors
    /// The projector's place or view makes no camera.
    pub fn of_projector(config: &RigConfig) -> Result<Self, RigError> {
        let mut config = config.clone();
        config.keep_projector();
        let raster = config.projector.raster();
        // The first calibration makes the file.
        let is_measured = config.calibration.file.as_ref().is_some_and(|file| file.exists());
        let measured = if is_measured { measured(&config)? } else { CalibrationFile::new() };
        let camera = match &measured.projector {
            Some(section) => measured_camera(section, &config, raster)?,
            None => camera(&config, raster, &mut Vec::new())?,
        };
        let worn = rig_worn(&config)?;
        Ok(Self {
            camera,
            observer: observer(&config, &[], &worn)?,
            heads: heads(&config, &[], &worn)?,
            scene: Scene::default(),
            bodies: Vec::new(),
            worn,
            schedule: config.projector.schedule(),
            drive: Drive::default(),
            latency_ns: measured.latency.as_ref().map(|l| (l.latency_us * 1e3).round() as i64),
            calibration: None,
            method_choice: None,
            config,
        })
    }

    /// All that the tracker is asked for, in the order of its indices: the bodies of the scene, and what people wear.
    pub fn tracked(&self) -> impl Iterator<Item = &RigBody> {
        self.bodies.iter().chain(&self.worn)
    }

    /// The number of [`Rig::tracked`], as far as they can be tracked.
    pub fn tracked_count(&self) -> usize {
        (self.bodies.len() + self.worn.len()).min(MAX_TRACKED)
    }

    /// Whether a head that is guarded is tracked under index `tracked`.
    pub(crate) fn guards(&self, tracked: usize) -> bool {
        self.heads.iter().any(|head| head.tracked == tracked)
    }

    /// Frames per second.
    pub fn rate(&self) -> FrameRate {
        self.config.projector.frame_rate
    }

    /// Albedo of the real surface of a body of the scene at texture coordinates of its mesh.
    pub fn albedo_at(&self, body: usize, uv: [f32; 2]) -> Vec3 {
        match self.drive.albedo_maps.get(body) {
            Some(Some(map)) => Vec3::from_array(map.at(uv)),
            _ => {
                let albedo = albedo_of(&self.config, self.scene.bodies.get(body).and_then(|b| b.tracked));
                Vec3::from_array(albedo.map(|a| a as f32))
            }
        }
    }

    /// The bodies that show what another program makes: their names, where it comes from, and the pictures.
    pub fn live_pictures(&self) -> impl Iterator<Item = (&str, &LiveSource, &Arc<LivePictures>)> {
        self.scene.live.iter().filter_map(|live| {
            let body = self.config.scene.bodies.get(usize::from(live.tracked))?;
            let Some(PictureSource::Live(source)) = &body.texture else { return None };
            Some((body.name.as_str(), source, &live.pictures))
        })
    }

    /// The true world-from-mesh transform of all that is tracked at an instant; `None` unless the tracker is the mock.
    pub fn true_poses(&self, t_ns: i64) -> Option<Vec<DAffine3>> {
        self.tracked().map(|b| b.motion.as_ref().map(|m| affine(&m.pose_at(t_ns)))).collect()
    }

    /// True if a projector that follows tracks is sent some. Where poses are not predicted there is nothing to correct, and
    /// on a serial line tracks would wait behind planes.
    pub(crate) fn wants_tracks(&self) -> bool {
        let config = &self.config;
        let carries = config.projector.backend.carries_tracks();
        config.projector.tracks == TracksUse::Auto && config.prediction.on && carries
    }

    /// Writes the pose of every body of the scene at `t_ns` on the host's clock to `out`: `tracked` for the tracked ones,
    /// the rest pose for those that never move, and for parts that move by themselves their place in their carrier at that
    /// time. Allocates nothing if `out` has enough capacity.
    pub fn scene_poses(&self, tracked: &[DAffine3], t_ns: i64, out: &mut Vec<DAffine3>) {
        out.clear();
        out.extend(self.scene.bodies.iter().map(|b| {
            let carrier = b.tracked.and_then(|i| tracked.get(usize::from(i))).copied();
            match (&b.motion, b.tracked) {
                (Some(motion), None) => motion.at(t_ns),
                (Some(motion), Some(_)) => {
                    carrier.map_or(b.world_from_body_rest, |carrier| carrier * motion.at(t_ns))
                }
                (None, _) => carrier.unwrap_or(b.world_from_body_rest),
            }
        }));
    }
}

fn load_scene(config: &RigConfig) -> Result<Scene, SceneError> {
    let c = &config.scene;
    let Some(file) = &c.file else {
        return Ok(match c.builtin {
            BuiltinScene::Demo => dpm_scene::builtin(),
        });
    };
    let options = LoadOptions {
        bodies: c
            .bodies
            .iter()
            .map(|b| BodySelector { name: b.name.clone(), node: b.node.clone(), projected: true })
            .collect(),
        virtual_nodes: c.virtual_nodes.clone(),
        scale: c.scale,
        up: c.up.map(|axis| match axis {
            FileAxis::X => UpAxis::X,
            FileAxis::Y => UpAxis::Y,
            FileAxis::Z => UpAxis::Z,
        }),
        animation: match c.animation.as_str() {
            "first" => AnimationChoice::First,
            "none" => AnimationChoice::Off,
            name => AnimationChoice::Named(name.to_owned()),
        },
        animation_speed: Some(c.animation_speed),
        ..LoadOptions::default()
    };
    dpm_scene::load(file, &options)
}

/// Rays of a path that see what lies behind a simple solid of glass with a reflection in it.
const DEPTH_FOR_GLASS: u32 = 6;

/// What to say of solids of glass whose paths end inside them.
fn dark_glass(scene: &Scene, depth: u32) -> Option<String> {
    let used = scene.used_materials();
    let mut glass =
        scene.materials.iter().zip(used).filter(|(m, used)| *used && m.transmission > 0.0 && !m.thin_walled);
    let (material, _) = glass.next().filter(|_| depth < DEPTH_FOR_GLASS)?;
    Some(format!(
        "material \"{}\" is solid glass: with render.depth = {depth} paths end inside it, and it is too dark; {DEPTH_FOR_GLASS} \
         to 12 show it",
        material.name
    ))
}

/// Shows the pictures that the rig file names on its bodies.
fn show_pictures(config: &RigConfig, scene: &mut Scene) -> Result<(), RigError> {
    let limits = Limits::default();
    for (index, body) in config.scene.bodies.iter().enumerate() {
        let Some(source) = &body.texture else { continue };
        let wrong =
            |message: String| RigError::Picture { name: body.name.clone(), picture: source.clone(), message };
        let shown = match source {
            PictureSource::File(file) => {
                let bytes = regular_file::read(file, MAX_PICTURE_BYTES).map_err(|e| wrong(e.to_string()))?;
                scene.show_picture(index as u16, bytes, &limits)
            }
            PictureSource::Live(_) => {
                scene.show_live(index as u16, Arc::new(LivePictures::new(body.texture_size)), &limits)
            }
        };
        shown.map_err(|e| wrong(e.to_string()))?;
    }
    Ok(())
}

/// Radiance of the uniform environment for scene files that contain lights; such files have no environment of their
/// own.
const FILE_SCENE_RADIANCE: f32 = 0.25;

/// The environment that the rig file asks for, for a scene with or without lights. `None` keeps the scene's own; the
/// built-in scene has one. Adds to `warnings` what was changed of a file.
fn environment(
    config: &RigConfig,
    has_lights: bool,
    warnings: &mut Vec<String>,
) -> Result<Option<Environment>, RigError> {
    let even = |[r, g, b]: [f64; 3]| Environment::Constant(Vec3::new(r as f32, g as f32, b as f32));
    Ok(match &config.scene.environment {
        EnvironmentConfig::Auto(_) if config.scene.file.is_none() => None,
        EnvironmentConfig::Auto(_) if !has_lights => Some(dpm_scene::studio()),
        EnvironmentConfig::Studio(_) => Some(dpm_scene::studio()),
        EnvironmentConfig::Auto(_) => Some(Environment::Constant(Vec3::splat(FILE_SCENE_RADIANCE))),
        EnvironmentConfig::Constant(c) => Some(even(c.radiance)),
        EnvironmentConfig::Image(c) => {
            let turn = c.rotation_deg.to_radians() as f32;
            let sky = dpm_scene::load_environment(&c.file, turn, c.scale as f32)?;
            warnings.extend(sky.warnings.iter().map(|told| format!("scene.environment: {told}")));
            Some(sky.environment)
        }
    })
}

/// The projector's camera at `raster`, from its calibration or from its position and direction. Adds to `warnings` what
/// was not read of the calibration.
fn camera(
    config: &RigConfig,
    raster: Raster,
    warnings: &mut Vec<String>,
) -> Result<ProjectorCamera, RigError> {
    let p = &config.projector;
    let Some(path) = &p.calibration else {
        return Ok(ProjectorCamera::look_at(
            raster,
            DVec3::from_array(p.position),
            DVec3::from_array(p.look_at),
            DVec3::from_array(p.up),
            p.horizontal_fov_deg.to_radians(),
        )?);
    };
    Ok(calibrated_camera(p, path, raster, warnings)?)
}

fn motion_spec(index: usize, body: &BodyConfig) -> Result<MotionSpec, RigError> {
    match &body.motion.0 {
        None => Ok(default_motion(index)),
        Some(table) => {
            read_motion(table).map_err(|message| RigError::MotionTable { name: body.name.clone(), message })
        }
    }
}

fn read_motion(table: &toml::Table) -> Result<MotionSpec, String> {
    toml::Value::Table(table.clone()).try_into().map_err(|e: toml::de::Error| e.message().to_owned())
}

/// The paper's experiment: the first body moves back and forth at 1 m/s, the second rotates in place, and the others
/// stand still.
fn default_motion(index: usize) -> MotionSpec {
    match index {
        0 => MotionSpec::paper_translation(),
        1 => MotionSpec::Rotate {
            axis: [0.0, 1.0, 0.0],
            rate_rad_s: std::f64::consts::PI,
            pivot_offset_m: [0.0; 3],
        },
        _ => MotionSpec::Still {},
    }
}

fn rig_bodies(config: &RigConfig, scene: &Scene) -> Result<Vec<RigBody>, RigError> {
    let named = &config.scene.bodies;
    let count = scene.bodies.iter().filter_map(|b| b.tracked).map(|i| usize::from(i) + 1).max().unwrap_or(0);
    let mock = config.tracker.is_mock();
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
                Some(
                    Motion::new(&spec, rest)
                        .map_err(|source| RigError::Motion { name: name.clone(), source })?,
                )
            } else {
                None
            };
            let mesh_to_body = match named.get(i) {
                Some(body) if !mock => body.mesh_to_body.to_affine().unwrap_or(DAffine3::IDENTITY),
                _ => DAffine3::IDENTITY,
            };
            Ok(RigBody { name, id: named.get(i).and_then(|b| b.id), rest, mesh_to_body, motion })
        })
        .collect()
}

/// What people wear, as it is tracked. The observer's is at rest where the eye is without it.
fn rig_worn(config: &RigConfig) -> Result<Vec<RigBody>, RigError> {
    let mock = config.tracker.is_mock();
    let observer = &config.observer;
    let eye = DVec3::from_array(observer.position) - DVec3::from_array(observer.eye_offset);
    let worn = config.worn();
    let made = worn.into_iter().map(|worn| {
        let is_observer = observer.tracked.as_ref().is_some_and(|tracked| tracked.0 == *worn);
        let place = if is_observer { eye.to_array() } else { [0.0; 3] };
        let rest = Pose { position_m: worn.position.unwrap_or(place), ..Pose::IDENTITY };
        let name = worn.name.clone();
        let motion = match &worn.motion.0 {
            _ if !mock => None,
            None => Some(MotionSpec::Still {}),
            Some(table) => Some(
                read_motion(table)
                    .map_err(|message| RigError::MotionTable { name: name.clone(), message })?,
            ),
        };
        let motion = motion.map(|spec| Motion::new(&spec, rest)).transpose();
        let motion = motion.map_err(|source| RigError::Motion { name: name.clone(), source })?;
        Ok(RigBody { name, id: worn.id, rest, mesh_to_body: DAffine3::IDENTITY, motion })
    });
    made.collect()
}

/// The index of `name` among all that is tracked.
fn tracked_index(
    key: &'static str,
    name: &str,
    bodies: &[RigBody],
    worn: &[RigBody],
) -> Result<usize, RigError> {
    let all = || bodies.iter().chain(worn).map(|b| b.name.as_str());
    let unknown =
        || RigError::UnknownBody { key, name: name.to_owned(), known: all().collect::<Vec<_>>().join(", ") };
    all().position(|known| known == name).ok_or_else(unknown)
}

/// The heads that are guarded. The observer's sphere is about the eye however the head is turned, so it is larger by the
/// eye's distance from the origin of what is tracked.
fn heads(config: &RigConfig, bodies: &[RigBody], worn: &[RigBody]) -> Result<Vec<GuardedHead>, RigError> {
    let observer = &config.observer;
    let carrier = observer.tracked.as_ref().map(|t| &t.0.name).or(observer.body.as_ref());
    let offset_m = DVec3::from_array(observer.eye_offset).length();
    let head = |name: &str| {
        let tracked = tracked_index("safety.eyes.heads", name, bodies, worn)?;
        let of_eye_m = if carrier.is_some_and(|carrier| carrier == name) { offset_m } else { 0.0 };
        let of_mesh_m = bodies.get(tracked).map_or(0.0, |body| body.mesh_to_body.translation.length());
        Ok(GuardedHead {
            tracked,
            radius_m: config.safety.eyes.radius + of_eye_m + of_mesh_m,
            lost_ns: i64::from(config.safety.eyes.lost_ms) * 1_000_000,
        })
    };
    config.heads().into_iter().map(head).collect()
}

fn observer(config: &RigConfig, bodies: &[RigBody], worn: &[RigBody]) -> Result<Observer, RigError> {
    let find = |key: &'static str, name: &str| tracked_index(key, name, bodies, worn);
    let c = &config.observer;
    let carrier = match (&c.tracked, &c.body) {
        (Some(tracked), _) => Some(find("observer.tracked", &tracked.0.name)?),
        (None, Some(body)) => Some(find("observer.body", body)?),
        (None, None) => None,
    };
    Ok(Observer {
        position: DVec3::from_array(c.position),
        carrier,
        eye_offset: DVec3::from_array(c.eye_offset),
        gaze: match c.gaze.aim() {
            GazeAim::Point(point) => Gaze::Point(point),
            GazeAim::Body(key, name) => Gaze::Body(find(key, &name)?),
            GazeAim::Ahead => Gaze::Straight,
            GazeAim::Measured => Gaze::Measured,
        },
        gaze_hold_ns: i64::from(c.gaze_hold_ms) * 1_000_000,
        gaze_widen_deg_per_s: c.gaze_widen_deg_per_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Overrides;

    fn observer(settings: &[&str]) -> Observer {
        let flags = settings.iter().map(|s| (*s).to_owned()).collect();
        let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap();
        Rig::build(&config, Raster::new(8, 8)).unwrap().observer
    }

    /// Only the body that the rig file names shows its picture; what is wrong with it is told with body and file.
    #[test]
    fn a_picture_is_shown_on_its_body_and_named_where_it_is_wrong() {
        let file = std::env::temp_dir().join(format!("dpm-texture-{}.png", std::process::id()));
        let flags = vec![format!("scene.bodies.1.texture=\"{}\"", file.display())];
        let demo = || RigConfig::demo(&Overrides { variables: vec![], flags: flags.clone() });
        let missing = demo().err().unwrap().to_string();
        assert!(missing.contains("scene.bodies.1.texture"), "{missing}");
        std::fs::write(&file, b"no picture").unwrap();
        let config = demo().unwrap();
        let build = || Rig::build(&config, Raster::new(8, 8));
        let told = build().err().unwrap().to_string();
        assert!(told.contains("body \"venus\"") && told.contains(&*file.to_string_lossy()), "{told}");
        image::RgbImage::from_pixel(3, 2, image::Rgb([7, 8, 9])).save(&file).unwrap();
        let scene = build().unwrap().scene;
        let picture = scene.textures.len() as u32 - 1;
        let shows = |name: &str| {
            let body = scene.bodies.iter().find(|b| b.name == name).unwrap();
            let of = |m: &u32| scene.materials[*m as usize].base_color_texture.map(|t| t.texture);
            body.mesh.materials.iter().all(|m| of(m) == Some(picture))
        };
        assert_eq!(
            (scene.textures[picture as usize].width, shows("venus"), shows("bunny")),
            (3, true, false)
        );
        std::fs::remove_file(&file).unwrap();
    }

    /// Paths that end inside a solid of glass leave it dark, which is told; those of a thin pane leave it at once.
    #[test]
    fn glass_that_is_too_deep_for_its_paths_is_told() {
        let file = std::env::temp_dir().join(format!("dpm-glass-{}.gltf", std::process::id()));
        let told = |extensions: &str, depth: u32| {
            let text = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"name":"pane"}],
                "meshes":[{"primitives":[{"attributes":{"POSITION":0},"material":0}]}],
                "buffers":[{"byteLength":36,"uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}],
                "bufferViews":[{"buffer":0,"byteLength":36}],
                "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}],
                "materials":[{"name":"flint","extensions":{EXTENSIONS}}]}"#;
            std::fs::write(&file, text.replace("EXTENSIONS", extensions)).unwrap();
            let flags = vec![
                format!("scene.file=\"{}\"", file.display()),
                "scene.bodies=[{ name = \"pane\" }]".to_owned(),
                format!("render.depth={depth}"),
            ];
            let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap();
            let warnings = Rig::build(&config, Raster::new(8, 8)).unwrap().scene.warnings;
            warnings.into_iter().find(|told| told.contains("is solid glass"))
        };
        let thin = r#""KHR_materials_transmission":{"transmissionFactor":1}"#;
        let solid = format!(r#"{thin},"KHR_materials_volume":{{"thicknessFactor":0.1}}"#);
        let deep = told(&solid, 3).expect("too few rays");
        assert!(deep.contains("material \"flint\"") && deep.contains("render.depth = 3"), "{deep}");
        assert_eq!((told(&solid, 6), told(thin, 1)), (None, None));
        std::fs::remove_file(&file).unwrap();
    }

    #[test]
    fn a_gaze_that_is_lost_is_held_and_then_its_zones_grow() {
        let o = observer(&["observer.gaze={kind=\"tracked\",target=\"venus\"}", "observer.gaze_hold_ms=100"]);
        assert_eq!(o.gaze_body(), Some(1));
        let after = |ms: i64| o.widening_deg(ms * 1_000_000);
        // 60 degrees per second, starting at 100 ms.
        assert_eq!([after(-5), after(0), after(100), after(600)], [0.0, 0.0, 0.0, 30.0]);
        assert_eq!(o.widening_deg(i64::MAX), 180.0);
    }

    /// Who looks needs no mesh, and what carries the eye is never lit: neither glasses that are no body, nor a body.
    #[test]
    fn a_tracked_observer_is_no_surface() {
        let build = |settings: &[&str]| {
            let flags = settings.iter().map(|s| (*s).to_owned()).collect();
            let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap();
            Rig::build(&config, Raster::new(8, 8)).unwrap()
        };
        let plain = build(&[]);
        let sway = "motion={kind=\"sway\",peak_rate_rad_s=1,peak_acceleration_rad_s2=4}";
        let tracked = format!("observer.tracked={{name=\"glasses\",{sway}}}");
        let straight = "observer.gaze={kind=\"straight\"}";
        let rig = build(&[&tracked, straight, "observer.eye_offset=[0, 0.03, 0]"]);
        assert_eq!((rig.bodies.len(), rig.tracked_count()), (2, 3));
        assert_eq!(rig.scene.bodies.len(), plain.scene.bodies.len());
        // At the middle of its sway the eye is where it is without a tracker, and it turns with the glasses later.
        let at = |ms: i64| rig.observer.eye_and_gaze(&rig.true_poses(ms * 1_000_000).unwrap());
        let (eye, gaze) = at(0);
        let position = DVec3::from_array(rig.config.observer.position);
        assert!(
            (eye - position).length() < 1e-12 && (gaze - eye + DVec3::Z).length() < 1e-12,
            "{eye} {gaze}"
        );
        assert!((at(100).1 - at(100).0 + DVec3::Z).length() > 0.05);
        assert_eq!(rig.heads, [GuardedHead { tracked: 2, radius_m: 0.15 + 0.03, lost_ns: 500_000_000 }]);
        assert_eq!(build(&[&tracked, "safety.eyes.guard=false"]).heads, []);
        // A body of the scene that carries the eye is one of those that are tracked, and no light falls on it.
        let file = std::env::temp_dir().join(format!("dpm-glasses-{}.obj", std::process::id()));
        std::fs::write(&file, "v 0 0 0\nv 1 0 0\nv 0 1 0\no glasses\nf 1 2 3\no box\nf 1 2 3\n").unwrap();
        let scene = format!("scene.file=\"{}\"", file.display());
        let old =
            build(&[&scene, "scene.bodies=[{name=\"glasses\"},{name=\"box\"}]", "observer.body=\"glasses\""]);
        let lit = |name: &str| old.scene.bodies.iter().find(|b| b.name == name).unwrap().projected;
        assert_eq!((lit("glasses"), lit("box"), old.tracked_count(), old.heads.len()), (false, true, 2, 1));
        std::fs::remove_file(&file).unwrap();
    }

    /// The projector alone, for patterns, still knows where heads are and where its light goes.
    #[test]
    fn a_rig_without_scene_keeps_its_heads() {
        let flags = [
            "observer.body=\"bunny\"",
            "observer.eye_offset=[0, 0.05, 0]",
            "safety.eyes.heads=[\"bunny\", {name=\"visitor\", id=7, position=[0, 1, 0]}]",
            "tracker.rate_hz=120",
        ];
        let flags = flags.map(str::to_owned).to_vec();
        let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap();
        let rig = Rig::of_projector(&config).unwrap();
        let names: Vec<_> = rig.tracked().map(|b| (b.name.as_str(), b.id)).collect();
        assert_eq!(names, [("bunny", None), ("visitor", Some(7))]);
        let radii: Vec<_> = rig.heads.iter().map(|head| (head.tracked, head.radius_m)).collect();
        assert_eq!(radii, [(0, 0.15 + 0.05), (1, 0.15)]);
        assert_eq!((rig.bodies.len(), rig.config.tracker.rate_hz()), (0, Some(120)));
        let again = Rig::of_projector(&rig.config).unwrap();
        assert_eq!((&again.heads, again.tracked_count()), (&rig.heads, 2), "once more gives the same");
    }

    #[test]
    fn a_gaze_that_no_tracker_tells_is_never_lost() {
        assert_eq!(observer(&[]).gaze_body(), None);
        assert_eq!(observer(&["observer.gaze={kind=\"straight\"}"]).gaze_body(), None);
        let carried = observer(&["observer.gaze={kind=\"straight\"}", "observer.body=\"bunny\""]);
        assert_eq!(carried.gaze_body(), Some(0));
    }
}
