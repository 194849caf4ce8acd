//! `[observer]`, `[scene]` and `[prediction]`: what moves, who looks, and what is shown.

use super::values::{Each, PerChannel, PictureSource};
use super::wearable::Wearable;
use crate::gaze::GazeConfig;
use crate::mock::{Motion, MotionSpec};
use crate::trackers::PoseConfig;
use dpm_common::keys::read::{Any, ConfigValue, KeyReader, NotEmpty, Within};
use dpm_common::keys::source::SourceNode;
use dpm_common::{kinds, section, words};
use dpm_device::pose::Pose;
use std::path::PathBuf;

section! {
    /// The eye for which the picture is computed.
    pub struct ObserverConfig {
        /// Position of the eye if it is not tracked, and until the tracker has seen it.
        position: [f64; 3] = [0.25, 0.35, 1.0], "m", Within(-1e6, 1e6);
        /// The rigid body that carries the eye, for example glasses, by its name in the tracker; no entry of
        /// `scene.bodies`. A table has more: `{ name = "glasses", id = 7 }` for a tracker that has numbers and no
        /// names, and `{ name = "glasses", motion = { kind = "sway", peak_rate_rad_s = 1, peak_acceleration_rad_s2 = 4
        /// } }` for the mock, with which it stands at `position` without a motion.
        tracked: Option<Wearable> = None, "", Any;
        /// The same by one of `scene.bodies[].name`, whose mesh is then never lit; `tracked` needs no mesh.
        body: Option<String> = None, "", NotEmpty;
        /// Position of the eye in that body's space.
        eye_offset: [f64; 3] = [0.0, 0.0, 0.0], "m", Within(-10.0, 10.0);
        /// Where the eye looks.
        gaze: GazeConfig = GazeConfig::default(), "", Any;
        /// A gaze whose tracked body is no longer seen, or that is no longer sure, stays for this long; a measured one
        /// then follows the axis of the glasses.
        gaze_hold_ms: u32 = 200, "ms", Within(0, 60_000);
        /// After that, the zones of full quality around the gaze grow at this rate until it is known
        /// again.
        gaze_widen_deg_per_s: f64 = 60.0, "deg/s", Within(0.0, 1e4);
    }
}

section! {
    /// What is shown.
    pub struct SceneConfig {
        /// A glTF 2.0 file (`.glb` or `.gltf`), or an OBJ, PLY or STL file; replaces `builtin`.
        file: Option<PathBuf> = None, "", NotEmpty;
        /// Length that a unit of `file` stands for. If left out, it is 1 for glTF, and guessed from the size for
        /// other formats.
        scale: Option<f64> = None, "m", Within(1e-9, 1e6);
        /// The axis of `file` that points up. If left out, it is `y` for glTF, OBJ and PLY, and `z` for STL.
        up: Option<FileAxis> = None, "", Any;
        /// Which animation of a glTF file plays, over and over: `first`, `none`, or its name (docs/SCENES.md). Its time
        /// is that of the light.
        animation: String = "first".into(), "", NotEmpty;
        /// How fast it plays; 1 is the file's own time.
        animation_speed: f64 = 1.0, "", Within(0.001, 1000.0);
        /// A scene that the program generates.
        builtin: BuiltinScene = BuiltinScene::Demo, "", Any;
        /// Light from the surroundings.
        environment: EnvironmentConfig = EnvironmentConfig::default(), "", Any;
        /// The rigid bodies that the tracker drives.
        bodies: Vec<BodyConfig> = Vec::new(), "", Any;
        /// Nodes that exist only in the virtual world. They appear in reflections and shadows, but the projector's
        /// light never falls on them.
        virtual_nodes: Vec<String> = Vec::new(), "", Any;
        /// Albedo of the real surfaces that the light falls on: one number, or one for each channel. Measure it; 0.8
        /// is matt white paint.
        surface_albedo: PerChannel = PerChannel([0.8; 3]), "", Each(0.01, 1.0);
        /// Radiance of the real surfaces because of the light in the room. It is subtracted from the picture.
        ambient: [f64; 3] = [0.0, 0.0, 0.0], "scene units", Within(0.0, 1e6);
    }
}

words! {
    /// An axis of a file.
    pub enum FileAxis {
        /// +X.
        X = "x",
        /// +Y.
        Y = "y",
        /// +Z.
        Z = "z",
    }
}

words! {
    /// Scenes that the program generates.
    pub enum BuiltinScene {
        /// Two moving objects.
        Demo = "demo",
    }
}

kinds! {
    /// Light from infinitely far away.
    pub enum EnvironmentConfig {
        /// the environment of the built-in scene. Files have no environment: they get a studio with soft boxes, or
        /// uniform light of 0.25 if they contain lamps or emissive surfaces.
        Auto(AutoEnvironmentConfig) = "auto",
        /// soft boxes in a dim room, 0.25 on average.
        Studio(StudioEnvironmentConfig) = "studio",
        /// the same radiance from all directions.
        Constant(ConstantEnvironmentConfig) = "constant",
        /// a latitude-longitude picture.
        Image(ImageEnvironmentConfig) = "image",
    }
    default Auto
}

section! {
    /// The scene's own light.
    pub struct AutoEnvironmentConfig {}
}

section! {
    /// Soft boxes: key light from the front right (+X, +Y, +Z), fill light from the left, rim light from behind.
    pub struct StudioEnvironmentConfig {}
}

section! {
    /// Uniform light.
    pub struct ConstantEnvironmentConfig {
        /// Radiance, linear red, green, blue.
        radiance: [f64; 3] = [0.25, 0.25, 0.25], "scene units", Within(0.0, 1e6);
    }
}

section! {
    /// Light from a picture.
    pub struct ImageEnvironmentConfig {
        /// PFM, Radiance .hdr or OpenEXR (linear), PNG or JPEG (sRGB).
        file: PathBuf = PathBuf::new(), "", NotEmpty;
        /// Rotation about the world's Y axis, counter-clockwise from above.
        rotation_deg: f64 = 0.0, "deg", Within(-360.0, 360.0);
        /// Factor for the picture's values.
        scale: f64 = 1.0, "", Within(0.0, 1e6);
    }
}

section! {
    /// One rigid body.
    pub struct BodyConfig {
        /// Name under which the tracker reports it; required.
        name: String = String::new(), "", NotEmpty;
        /// Number under which the tracker reports it, if the tracker has no names.
        id: Option<i64> = None, "", Within(0, i64::from(i32::MAX));
        /// glTF node that it moves, together with everything below; the body's name if left out.
        node: Option<String> = None, "", NotEmpty;
        /// Where its mesh is in the space of the body that the tracker reports: mesh-to-body. A real tracker's pivot and
        /// axes are seldom those of the glTF node. `dpm calibrate body` measures it. The mock tracker reports the mesh
        /// itself and ignores it.
        mesh_to_body: PoseConfig = PoseConfig::default(), "", Any;
        /// A picture in the place of its file's colours: PNG, JPEG or KTX2, or an animated PNG, which plays over and
        /// over. `pipe:` with the path of a named pipe, or `pipewire:` with the name or number of a node, shows what
        /// another program makes while the rig runs (docs/SCENES.md).
        texture: Option<PictureSource> = None, "", Any;
        /// Columns and rows that pictures of another program have on the body. Others are fitted to it.
        texture_size: [u32; 2] = [512, 512], "texels", Within(1, 4096);
        /// Albedo of its real surface, if it differs from `scene.surface_albedo`: one number, or one for each channel.
        /// It is a factor of an `albedo_map`, 1 if left out.
        albedo: Option<PerChannel> = None, "", Each(0.01, 1.0);
        /// A picture of the albedo of its real surface, for example of what is printed on it: PNG with 8 or 16 bits, or
        /// PFM. Values below 0.01 count as 0.01. All pictures of a rig together may have 8388608 pixels.
        albedo_map: Option<PathBuf> = None, "", NotEmpty;
        /// What the numbers of a PNG in `albedo_map` mean; those of a PFM are linear.
        albedo_map_encoding: AlbedoEncoding = AlbedoEncoding::Srgb, "", Any;
        /// How it moves if the tracker is the mock, for example `{ kind = "translate", speed_m_s = 1.0 }` (below). If
        /// left out, the first body moves to and fro, the second rotates in place, and the others stand still.
        motion: MotionValue = MotionValue::default(), "", Any;
    }
}

words! {
    /// Encodings of a picture of albedo.
    pub enum AlbedoEncoding {
        /// The curve of sRGB, as of pictures for screens and of the base colours of glTF.
        Srgb = "srgb",
        /// In proportion to the reflected light; full values are albedo 1.
        Linear = "linear",
    }
}

impl BodyConfig {
    /// The glTF node that the body moves.
    pub fn node_name(&self) -> &str {
        self.node.as_deref().unwrap_or(&self.name)
    }
}

/// The table that says how a body moves: a checked [`MotionSpec`]; `None` if the rig file has none.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionValue(pub Option<toml::Table>);

impl MotionValue {
    /// The body does not move.
    pub fn still() -> Self {
        Self(Some(toml::Table::from_iter([("kind".to_owned(), "still".into())])))
    }
}

impl ConfigValue for MotionValue {
    fn kind() -> String {
        "a table".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let entries = reader.table(node, key)?;
        let Some(toml::Value::Table(table)) = node.to_toml() else {
            reader.refuse(&node.origin, key, "holds a date or an integer beyond 64 bits", "");
            return None;
        };
        let problem = match toml::Value::Table(table.clone()).try_into::<MotionSpec>() {
            Ok(spec) => match Motion::new(&spec, Pose::IDENTITY) {
                Ok(_) => return Some(Self(Some(table))),
                Err(e) => e.to_string(),
            },
            Err(e) => e.message().replace('\n', ", "),
        };
        // The message names the field in backquotes. The error is then reported where that field is written.
        let field = problem.split('`').skip(1).step_by(2).find_map(|name| Some((name, entries.get(name)?)));
        let (origin, key) = match field {
            Some((name, entry)) => (&entry.key_origin, format!("{key}.{name}")),
            None => (&node.origin, key.to_string()),
        };
        reader.refuse(origin, &key, problem, "");
        None
    }

    fn show(&self) -> String {
        "none".into()
    }
}

section! {
    /// From samples to the pose at the time of light.
    pub struct PredictionConfig {
        /// Off shows the newest sample without prediction, for comparison.
        on: bool = true, "", Any;
        /// Expected acceleration of the bodies, until the filters have learned it from their samples.
        acceleration: f64 = 5.0, "m/s^2", Within(1e-3, 1e4);
        /// Expected angular acceleration of the bodies, until it is learned.
        angular_acceleration: f64 = 20.0, "rad/s^2", Within(1e-3, 1e5);
        /// Standard deviation of the tracker's position.
        noise_m: f64 = 1e-4, "m", Within(1e-9, 1.0);
        /// Standard deviation of the tracker's rotation.
        noise_rad: f64 = 1e-3, "rad", Within(1e-9, 1.0);
        /// A sample that deviates by more standard deviations from its prediction is held back until other samples
        /// confirm it.
        gate_sigma: f64 = 6.0, "", Within(1.0, 100.0);
    }
}
