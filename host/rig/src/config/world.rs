//! `[tracker]`, `[observer]`, `[scene]` and `[prediction]`: what moves, who looks, and what is to be seen.

use crate::mock::{Motion, MotionSpec};
use dpm_common::keys::read::{Any, ConfigValue, NotEmpty, Reader, Within};
use dpm_common::keys::source::Node;
use dpm_common::{kinds, section, words};
use dpm_device::pose::Pose;
use std::path::PathBuf;

kinds! {
    /// Where poses come from.
    pub enum TrackerConfig {
        /// a tracker made of software in this process, fed by `scene.bodies[].motion`.
        Mock(MockTrackerConfig) = "mock",
        /// OptiTrack Motive or any other NatNet 3.0 to 4.2 server.
        Natnet(NatnetConfig) = "natnet",
        /// a VRPN server.
        Vrpn(VrpnConfig) = "vrpn",
        /// COBS packets with CRC on a serial port.
        Serial(SerialTrackerConfig) = "serial",
        /// a recording made by this program.
        Replay(ReplayConfig) = "replay",
    }
    default Mock
}

section! {
    /// The embedded mock tracker.
    pub struct MockTrackerConfig {
        /// Samples a second.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
        /// From mid-exposure to arrival at the host.
        latency_us: u32 = 2_000, "us", Within(0, 1_000_000);
        /// Longest extra delay of a sample, evenly distributed.
        jitter_us: u32 = 0, "us", Within(0, 1_000_000);
        /// Standard deviation of the reported position on each axis.
        noise_m: f64 = 0.0, "m", Within(0.0, 1.0);
        /// Standard deviation of the reported rotation about each axis.
        noise_rad: f64 = 0.0, "rad", Within(0.0, 1.0);
        /// Share of samples that never arrive.
        drop_out: f64 = 0.0, "", Within(0.0, 1.0);
        /// Faults to inject, in the mock's own notation; empty for none.
        faults: String = String::new(), "", Any;
        /// Seed of noise, jitter and drop-out.
        seed: u64 = 1, "", Any;
    }
}

section! {
    /// A NatNet server.
    pub struct NatnetConfig {
        /// Address of the server.
        server: String = "127.0.0.1".into(), "", NotEmpty;
        /// Address of the interface that hears it. Set it when the machine has several networks and no data arrive.
        local: String = "0.0.0.0".into(), "", NotEmpty;
        /// Multicast group; leave it out for unicast.
        multicast: Option<String> = None, "", NotEmpty;
        /// UDP port for commands.
        command_port: u16 = 1510, "", Within(1, u16::MAX);
        /// UDP port for frames.
        data_port: u16 = 1511, "", Within(1, u16::MAX);
        /// Frames a second that the server is set to; used for drop-out detection only.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
    }
}

section! {
    /// A VRPN server.
    pub struct VrpnConfig {
        /// `host` or `host:port`.
        server: String = "127.0.0.1:3883".into(), "", NotEmpty;
        /// Name of the tracker on the server.
        tracker: String = "Tracker0".into(), "", NotEmpty;
        /// Samples a second that the server is set to; used for drop-out detection only.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
    }
}

section! {
    /// A tracker on a serial port.
    pub struct SerialTrackerConfig {
        /// Device file of the port.
        port: String = "/dev/ttyACM0".into(), "", NotEmpty;
        /// Bits a second on the wire.
        baud: u32 = 921_600, "bit/s", Within(300, 20_000_000);
        /// Samples a second that the device is set to; used for drop-out detection only.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
    }
}

section! {
    /// A recorded run.
    pub struct ReplayConfig {
        /// The recording.
        file: PathBuf = PathBuf::new(), "", NotEmpty;
    }
}

impl TrackerConfig {
    /// Samples a second that are expected; `None` where only the recording knows.
    pub fn rate_hz(&self) -> Option<u32> {
        match self {
            Self::Mock(c) => Some(c.rate_hz),
            Self::Natnet(c) => Some(c.rate_hz),
            Self::Vrpn(c) => Some(c.rate_hz),
            Self::Serial(c) => Some(c.rate_hz),
            Self::Replay(_) => None,
        }
    }
}

section! {
    /// The eye for which the picture is right.
    pub struct ObserverConfig {
        /// Where the eye stands when no tracked body carries it.
        position: [f64; 3] = [0.25, 0.35, 1.0], "m", Within(-1e6, 1e6);
        /// Name of the tracked body that carries the eye, for example tracked glasses; one of `scene.bodies[].name`.
        body: Option<String> = None, "", NotEmpty;
        /// The eye in that body's space.
        eye_offset: [f64; 3] = [0.0, 0.0, 0.0], "m", Within(-10.0, 10.0);
        /// Where the eye looks.
        gaze: GazeConfig = GazeConfig::default(), "", Any;
        /// A gaze whose tracked body is no longer seen is held for so long where it was.
        gaze_hold_ms: u32 = 200, "ms", Within(0, 60_000);
        /// From then on the zones of full quality grow at this rate about it, until it is seen again.
        gaze_widen_deg_per_s: f64 = 60.0, "deg/s", Within(0.0, 1e4);
    }
}

kinds! {
    /// Where the eye looks.
    pub enum GazeConfig {
        /// at a fixed point of the world.
        Point(GazePointConfig) = "point",
        /// at the centre of a tracked body.
        Tracked(GazeTrackedConfig) = "tracked",
        /// along -Z of the body that carries the eye, or of the world.
        Straight(GazeStraightConfig) = "straight",
    }
    default Point
}

section! {
    /// Gaze at a fixed point.
    pub struct GazePointConfig {
        /// The point.
        point: [f64; 3] = [0.0, 0.1, 0.0], "m", Within(-1e6, 1e6);
    }
}

section! {
    /// Gaze that follows a body.
    pub struct GazeTrackedConfig {
        /// Name of the body; one of `scene.bodies[].name`.
        target: String = String::new(), "", NotEmpty;
    }
}

section! {
    /// Gaze straight ahead.
    pub struct GazeStraightConfig {}
}

section! {
    /// What is to be seen.
    pub struct SceneConfig {
        /// A glTF 2.0 file (`.glb` or `.gltf`); takes the place of `builtin`.
        file: Option<PathBuf> = None, "", NotEmpty;
        /// A scene that is made by the program itself.
        builtin: BuiltinScene = BuiltinScene::Demo, "", Any;
        /// Light from all around.
        environment: EnvironmentConfig = EnvironmentConfig::default(), "", Any;
        /// The rigid bodies that the tracker drives.
        bodies: Vec<BodyConfig> = Vec::new(), "", Any;
        /// Nodes that exist only in the virtual world (lamps, surroundings): reflections and shadows see them, the
        /// projector's light never falls on them.
        virtual_nodes: Vec<String> = Vec::new(), "", Any;
        /// Albedo of the real surfaces that the light falls on. Measure it; 0.8 is matt white paint.
        surface_albedo: f64 = 0.8, "", Within(0.01, 1.0);
        /// Radiance that the real surfaces already send to the eye because of light in the room; subtracted from the picture.
        ambient: [f64; 3] = [0.0, 0.0, 0.0], "scene units", Within(0.0, 1e6);
    }
}

words! {
    /// Scenes made by the program itself.
    pub enum BuiltinScene {
        /// Two moving objects.
        Demo = "demo",
    }
}

kinds! {
    /// Light from infinitely far away.
    pub enum EnvironmentConfig {
        /// what the built-in scene brings; for files, which bring none, a studio with soft boxes, or even light of 0.25 where the file
        /// has lamps or emissive surfaces.
        Auto(AutoEnvironmentConfig) = "auto",
        /// soft boxes in a dim room, 0.25 in the mean.
        Studio(StudioEnvironmentConfig) = "studio",
        /// the same radiance from everywhere.
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
    /// Soft boxes: key from the right in front (+X, +Y, +Z), fill from the left, rim from behind.
    pub struct StudioEnvironmentConfig {}
}

section! {
    /// Even light.
    pub struct ConstantEnvironmentConfig {
        /// Radiance, linear red, green, blue.
        radiance: [f64; 3] = [0.25, 0.25, 0.25], "scene units", Within(0.0, 1e6);
    }
}

section! {
    /// Light from a picture.
    pub struct ImageEnvironmentConfig {
        /// PFM or Radiance .hdr (linear), PNG or JPEG (sRGB).
        file: PathBuf = PathBuf::new(), "", NotEmpty;
        /// Turn about the world's Y axis, counter-clockwise from above.
        rotation_deg: f64 = 0.0, "deg", Within(-360.0, 360.0);
        /// Factor on the picture's values.
        scale: f64 = 1.0, "", Within(0.0, 1e6);
    }
}

section! {
    /// One rigid body.
    pub struct BodyConfig {
        /// Name under which the tracker reports it; required.
        name: String = String::new(), "", NotEmpty;
        /// Number under which the tracker reports it, where it gives no names.
        id: Option<i64> = None, "", Within(0, i64::from(i32::MAX));
        /// glTF node that it moves, with everything below; the body's name when left out.
        node: Option<String> = None, "", NotEmpty;
        /// How it moves when the tracker is the mock, for example `{ kind = "translate", speed_m_s = 1.0 }`; the kinds stand below.
        /// Left out, the first body goes to and fro at 1 m/s, the second turns in place and others stand still.
        motion: MotionValue = MotionValue::default(), "", Any;
    }
}

impl BodyConfig {
    /// The glTF node that the body moves.
    pub fn node_name(&self) -> &str {
        self.node.as_deref().unwrap_or(&self.name)
    }
}

/// The table that says how a body moves: a checked [`MotionSpec`]; `None` when the rig file says nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionValue(pub Option<toml::Table>);

impl ConfigValue for MotionValue {
    fn kind() -> String {
        "a table".into()
    }

    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
        // The message names the field in backquotes; the error then stands where that field is written.
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
        /// Off shows the newest sample as it is: to see what prediction is worth.
        on: bool = true, "", Any;
        /// Acceleration that bodies are expected to make: more follows quicker and lets more noise through.
        acceleration: f64 = 5.0, "m/s^2", Within(1e-3, 1e4);
        /// Angular acceleration that bodies are expected to make.
        angular_acceleration: f64 = 20.0, "rad/s^2", Within(1e-3, 1e5);
        /// Standard deviation of the tracker's position.
        noise_m: f64 = 1e-4, "m", Within(1e-9, 1.0);
        /// Standard deviation of the tracker's rotation.
        noise_rad: f64 = 1e-3, "rad", Within(1e-9, 1.0);
        /// A sample farther from its prediction than this many standard deviations is held back until others agree with it.
        gate_sigma: f64 = 6.0, "", Within(1.0, 100.0);
    }
}
