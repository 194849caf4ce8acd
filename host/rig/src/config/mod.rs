//! Reads a rig file, the environment and `--set` flags into a checked [`RigConfig`].
//!
//! Defaults < file < environment (`DPM_SET_PROJECTOR__WIDTH=640`) < `--set projector.width=640`. All mistakes are
//! reported at once, each with file, line and column. `docs/CONFIG.md` lists the keys; it is generated from their
//! declarations here.

mod calibration;
mod check;
mod check_projector;
mod method;
mod osc;
mod page;
mod prediction;
mod projector;
mod rehearsal;
mod run;
mod safety;
mod values;
mod wearable;
mod world;

#[cfg(test)]
mod tests;

use crate::gaze::GazeAim;
pub use crate::gaze::GazeConfig;
pub use crate::projectors::{LitTime, PlaneTiming, PlaneWeights, ProjectorBackend};
pub use crate::trackers::{PoseConfig, TrackerConfig, TrackerTransformConfig};
pub use calibration::CalibrationConfig;
pub(crate) use check::MAX_TRACKED;
pub(crate) use dpm_common::keys::read::KeyDoc;
pub(crate) use dpm_common::keys::source::VARIABLE_PREFIX;
pub use dpm_common::keys::{ConfigError, ConfigErrors, Origin};
pub use osc::{OscConfig, MOST_OSC_TOKEN};
pub use page::{PageConfig, DEFAULT_PAGE};
pub use projector::*;
pub use rehearsal::{RehearsalConfig, RehearsedMotion};
pub use run::*;
pub use safety::{
    EyesConfig, InterlockConfig, InterlockSignal, KeyInterlockConfig, LimitsConfig, LineInterlockConfig,
    NoInterlockConfig, ProcessInterlockConfig, Restart, SafetyConfig,
};
pub use values::{BitOrder, LiveSource, PerChannel, PictureSource, RenderScale};
pub use wearable::{Wearable, WearableConfig};
pub use world::*;

use crate::mock::MotionSpec;
use dpm_common::keys::read::{Any, ConfigValue, KeyReader};
use dpm_common::keys::rows::Section;
use dpm_common::keys::source;
use dpm_common::section;
use dpm_device::regular_file;
use std::path::Path;

/// Maximum size of a rig file in bytes.
pub const MAX_FILE_BYTES: u64 = 1 << 20;

/// The rig file that `dpm demo` runs.
pub const DEMO_RIG: &str = include_str!("demo.toml");

section! {
    /// A whole rig. Every value is in its range, and no two values contradict each other.
    pub struct RigConfig {
        /// The projector that emits the light.
        projector: ProjectorConfig = ProjectorConfig::default(), "", Any;
        /// Where poses come from.
        tracker: TrackerConfig = Default::default(), "", Any;
        /// The eye for which the picture is computed.
        observer: ObserverConfig = ObserverConfig::default(), "", Any;
        /// What is shown.
        scene: SceneConfig = SceneConfig::default(), "", Any;
        /// What `dpm calibrate` measured.
        calibration: CalibrationConfig = CalibrationConfig::default(), "", Any;
        /// How radiance is computed.
        render: RenderConfig = RenderConfig::default(), "", Any;
        /// From samples to the pose at the time of light.
        prediction: PredictionConfig = PredictionConfig::default(), "", Any;
        /// Pace and rights from the operating system.
        real_time: RealTimeConfig = RealTimeConfig::default(), "", Any;
        /// How long to run.
        run: RunConfig = RunConfig::default(), "", Any;
        /// Which files are written.
        output: OutputConfig = OutputConfig::default(), "", Any;
        /// What happens when something fails.
        safety: SafetyConfig = SafetyConfig::default(), "", Any;
        /// What a rehearsal assumes.
        rehearsal: RehearsalConfig = RehearsalConfig::default(), "", Any;
        /// What an operator sees in a browser.
        page: PageConfig = PageConfig::default(), "", Any;
        /// What other programs may change.
        osc: OscConfig = OscConfig::default(), "", Any;
    }
}

/// Settings from outside the file.
#[derive(Clone, Debug, Default)]
pub struct Overrides {
    /// Environment variables, name and value. Those without [`VARIABLE_PREFIX`] are ignored.
    pub variables: Vec<(String, String)>,
    /// Texts of the form `a.b=c`, in the order given. Later ones override earlier ones.
    pub flags: Vec<String>,
}

impl Overrides {
    /// The process's environment together with `flags`.
    pub fn from_environment(flags: Vec<String>) -> Self {
        let mut variables: Vec<_> = std::env::vars_os()
            .filter_map(|(k, v)| Some((k.into_string().ok()?, v.to_string_lossy().into_owned())))
            .filter(|(k, _)| k.starts_with(VARIABLE_PREFIX))
            .collect();
        variables.sort();
        Self { variables, flags }
    }

    fn apply(&self, root: &mut source::SourceNode, errors: &mut Vec<ConfigError>) {
        for (name, value) in &self.variables {
            if let Some(path) = source::variable_path(name) {
                source::set(root, &path, value, &Origin::Variable(name.clone()), errors);
            }
        }
        for flag in &self.flags {
            let origin = Origin::Flag(flag.clone());
            match flag.split_once('=') {
                Some((key, value)) => {
                    let path: Vec<String> = key.trim().split('.').map(|p| p.trim().to_string()).collect();
                    source::set(root, &path, value.trim(), &origin, errors);
                }
                None => errors.push(ConfigError {
                    origin,
                    key: String::new(),
                    problem: "has no `=`".into(),
                    remedy: "write for example `render.spp=4`".into(),
                }),
            }
        }
    }
}

/// Minimum of the default watchdog, milliseconds.
const DEFAULT_WATCHDOG_MS: u32 = 50;
const DEFAULT_LIGHT_WINDOW_MS: f64 = 33.0;

/// The purpose for which a rig file is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Purpose {
    /// The mocks replace tracker and projector, whatever their kind; see [`RigConfig::simulate`].
    pub simulate: bool,
    /// Nothing runs, so the check does not ask for an end in `run.frames` or `run.seconds`.
    pub at_rest: bool,
    /// Only the projector is used; see [`RigConfig::keep_projector`].
    pub projector_only: bool,
    /// What is measured goes into the calibration file, which need not exist yet.
    pub calibrates: bool,
}

impl RigConfig {
    /// Length of a frame, milliseconds.
    pub fn frame_ms(&self) -> f64 {
        1e3 / self.projector.frame_rate.hz()
    }

    /// Silence after which the projector goes dark by itself, microseconds: the value of `safety.watchdog_ms`, or
    /// else 50 ms or three frames, whichever is longer.
    pub fn watchdog_us(&self) -> u32 {
        let three_frames = (3.0 * self.frame_ms()).ceil() as u32;
        let ms = self.safety.watchdog_ms.unwrap_or(DEFAULT_WATCHDOG_MS.max(three_frames));
        ms.saturating_mul(1000).min(dpm_device::link::MAX_WATCHDOG_US)
    }

    /// Time over which pictures integrate light, milliseconds: the value of `output.light_window_ms`, or else 33 ms
    /// or one frame, whichever is longer.
    pub fn light_window_ms(&self) -> f64 {
        self.output.light_window_ms.unwrap_or(DEFAULT_LIGHT_WINDOW_MS.max(self.frame_ms()))
    }

    /// Replaces a real tracker (or a recording) and a real projector by the mocks. The mock tracker has the sample
    /// rate of the real one, and moves bodies by `scene.bodies[].motion`, or by its defaults if that is left out. A gaze
    /// that a device would measure follows the axis of the glasses.
    pub fn simulate(&mut self) {
        if !self.tracker.is_mock() {
            self.tracker = crate::trackers::simulated(self.tracker.rate_hz());
        }
        if self.observer.gaze.aim() == GazeAim::Measured {
            self.observer.gaze = crate::gaze::straight();
        }
        if !self.projector.backend.is_mock() {
            self.projector.backend = Default::default();
        }
    }

    /// Forgets everything that says what light is drawn: scene, tracker, observer and the projector's calibration, so
    /// that none of them has to exist. Pictures, traces and the flight recorder of a run tell of those, so none is
    /// written. Where heads are guarded, what says where they are and where light falls stays.
    pub fn keep_projector(&mut self) {
        let (heads, old) = (self.guarded(), std::mem::take(&mut self.observer));
        let is_tracked = old.tracked.is_some() || old.body.is_some();
        let projector = &mut self.projector;
        if heads.is_empty() {
            self.tracker = Default::default();
            self.calibration = CalibrationConfig::default();
            (projector.calibration, projector.calibration_unit) = (None, None);
            (projector.calibration_camera, projector.calibration_region) = (None, None);
            projector.calibration_device = None;
        } else if is_tracked {
            self.observer.tracked = heads.first().cloned();
            (self.observer.position, self.observer.eye_offset) = (old.position, old.eye_offset);
        }
        self.scene = SceneConfig::default();
        self.safety.eyes.heads = heads;
        (projector.flat_field, projector.response) = (None, ResponseConfig::default());
        let output = &mut self.output;
        (output.images, output.trace, output.flight_recorder) = (false, false, false);
    }

    /// Takes the binary planes in place of "auto" where something speaks against split ones. What speaks against them is everything
    /// that was measured or set with other planes in mind, and a purpose that measures, or shows patterns for it.
    fn settle_weights(&mut self, purpose: Purpose) {
        let p = &self.projector;
        let is_measured = p.response != ResponseConfig::default()
            || p.flat_field.is_some()
            || self.calibration.file.is_some()
            || !self.safety.limits.is_off();
        let is_free = p.dims_planes() && p.plane_order == values::BitOrder::default() && !is_measured;
        if p.weights == PlaneWeights::Auto && (!is_free || purpose.projector_only || purpose.calibrates) {
            self.projector.weights = PlaneWeights::Binary;
        }
    }

    /// What people wear that is no body of the scene, each once: the observer first, then the heads of `safety.eyes`.
    pub fn worn(&self) -> Vec<&WearableConfig> {
        let mut worn: Vec<&WearableConfig> = Vec::new();
        for Wearable(one) in self.observer.tracked.iter().chain(&self.safety.eyes.heads) {
            let is_known = |name: &String| name == &one.name;
            let is_body = self.scene.bodies.iter().any(|b| is_known(&b.name));
            if !is_body && !worn.iter().any(|w| is_known(&w.name)) {
                worn.push(one);
            }
        }
        worn
    }

    /// The names of the heads about which no light may be, the observer's first; none if the guard is off.
    pub fn heads(&self) -> Vec<&str> {
        let eyes = &self.safety.eyes;
        let observer =
            self.observer.tracked.iter().map(|t| t.0.name.as_str()).chain(self.observer.body.as_deref());
        let mut heads: Vec<&str> = Vec::new();
        for name in observer.chain(eyes.heads.iter().map(|head| head.0.name.as_str())).filter(|_| eyes.guard)
        {
            if !heads.contains(&name) {
                heads.push(name);
            }
        }
        heads
    }

    /// What is tracked of the heads that are guarded, whether or not it is a body of the scene.
    fn guarded(&self) -> Vec<Wearable> {
        let worn = self.worn();
        let of = |name: &str| match worn.iter().find(|w| w.name == name) {
            Some(worn) => (*worn).clone(),
            None => {
                let body = self.scene.bodies.iter().find(|b| b.name == name).cloned().unwrap_or_default();
                let motion = body.motion;
                WearableConfig { name: name.to_owned(), id: body.id, motion, ..WearableConfig::default() }
            }
        };
        self.heads().into_iter().map(|name| Wearable(of(name))).collect()
    }

    /// Number of slots in `run.seconds`, at least one; 0 if there is no limit.
    pub fn slots_to_run(&self) -> u64 {
        if self.run.seconds > 0.0 {
            self.projector.frame_rate.slot_at_ns((self.run.seconds * 1e9) as i64).max(1)
        } else {
            0
        }
    }

    /// Reads a rig file of at most [`MAX_FILE_BYTES`].
    ///
    /// # Errors
    /// Every mistake at once: an unreadable file, syntax, unknown keys, wrong types, values out of range,
    /// contradictions, missing input files.
    pub fn load(path: &Path, overrides: &Overrides) -> Result<Self, ConfigErrors> {
        Self::load_for(path, overrides, Purpose::default())
    }

    /// Like [`RigConfig::load`], for a purpose.
    ///
    /// # Errors
    /// As [`RigConfig::load`].
    pub fn load_for(path: &Path, overrides: &Overrides, purpose: Purpose) -> Result<Self, ConfigErrors> {
        let unreadable = |e: std::io::Error| {
            // The most frequent mistake is a path from the manual that is used outside the top folder of the sources.
            let here = std::env::current_dir().ok().filter(|_| path.is_relative());
            let from =
                here.map_or(String::new(), |here| format!("it was looked for in {}; ", here.display()));
            let remedy =
                format!("{from}give the path of a rig file, for example rigs/demo.toml in dpm's sources");
            ConfigErrors::unreadable(path, format!("cannot read the rig file: {e}"), &remedy)
        };
        let text = match regular_file::read_text(path, MAX_FILE_BYTES) {
            Err(e) if e.kind() == std::io::ErrorKind::FileTooLarge => {
                let problem = format!("the rig file has more than {MAX_FILE_BYTES} bytes");
                return Err(ConfigErrors::unreadable(path, problem, "is it a scene? give that by --scene"));
            }
            read => read.map_err(unreadable)?,
        };
        let base = path.parent().unwrap_or(Path::new(""));
        Self::parse_for(&path.display().to_string(), &text, base, overrides, purpose)
    }

    /// The rig that `dpm demo` runs.
    ///
    /// # Errors
    /// All mistakes in `overrides` at once.
    pub fn demo(overrides: &Overrides) -> Result<Self, ConfigErrors> {
        Self::demo_for(overrides, Purpose::default())
    }

    /// Like [`RigConfig::demo`], for a purpose.
    ///
    /// # Errors
    /// As [`RigConfig::demo`].
    pub fn demo_for(overrides: &Overrides, purpose: Purpose) -> Result<Self, ConfigErrors> {
        Self::parse_for("rigs/demo.toml", DEMO_RIG, Path::new(""), overrides, purpose)
    }

    /// Reads a rig file's text. `name` is its name in messages; input files are relative to `base`.
    ///
    /// # Errors
    /// As [`RigConfig::load`].
    pub fn parse(name: &str, text: &str, base: &Path, overrides: &Overrides) -> Result<Self, ConfigErrors> {
        Self::parse_for(name, text, base, overrides, Purpose::default())
    }

    /// Like [`RigConfig::parse`], for a purpose.
    ///
    /// # Errors
    /// As [`RigConfig::load`].
    pub fn parse_for(
        name: &str,
        text: &str,
        base: &Path,
        overrides: &Overrides,
        purpose: Purpose,
    ) -> Result<Self, ConfigErrors> {
        let mut reader = KeyReader::default();
        let mut root = source::parse(name, text, &mut reader.errors);
        if !reader.errors.is_empty() {
            // A half-read file would only add false errors.
            return Err(ConfigErrors(reader.errors));
        }
        overrides.apply(&mut root, &mut reader.errors);
        let rig = <Self as ConfigValue>::read(&root, &mut reader, "");
        let mut rig = rig.unwrap_or_default();
        // A value that is wrong by itself would be reported again as a contradiction.
        if reader.errors.is_empty() {
            if purpose.simulate {
                // The keys of the replaced parts are not used, but must still make sense.
                if !rig.tracker.is_mock() {
                    rig.tracker.check(&mut reader);
                }
                rig.simulate();
            }
            if purpose.projector_only {
                rig.keep_projector();
            }
            rig.settle_weights(purpose);
            check::check(&rig, purpose, &mut reader);
            check::resolve_files(&mut rig, base, purpose, &mut reader);
        }
        if reader.errors.is_empty() {
            Ok(rig)
        } else {
            Err(ConfigErrors(reader.errors))
        }
    }

    /// Every key of the rig file, for the manual.
    pub fn key_docs() -> Vec<KeyDoc> {
        let mut out = Vec::new();
        Self::document("", &mut out);
        out
    }

    /// The manual `docs/CONFIG.md`: each table once, in the order in which their first keys are declared.
    pub fn manual() -> String {
        let cell = |text: &str| text.replace('|', "\\|");
        let mut tables: Vec<(String, String)> = Vec::new();
        for key in Self::key_docs() {
            let (table, name) = key.key.rsplit_once('.').unwrap_or(("", &key.key));
            let kind = key.kind.strip_prefix("a ").or(key.kind.strip_prefix("an ")).unwrap_or(&key.kind);
            let allowed = [key.range.as_str(), key.unit].join(" ");
            let value = match allowed.trim() {
                "" => cell(kind),
                allowed => cell(&format!("{kind}, {allowed}")),
            };
            let row = format!("| `{name}` | `{}` | {value} | {} |\n", cell(&key.default), cell(&key.doc));
            match tables.iter().position(|(other, _)| other == table) {
                Some(at) => tables[at].1 += &row,
                None => tables.push((table.to_string(), row)),
            }
        }
        let mut out = String::from(MANUAL_HEAD);
        for (table, rows) in &tables {
            let alike = |(other, its): &&(String, String)| its == rows && is_variant(other, table);
            let variants: Vec<&str> = tables.iter().filter(alike).map(|(other, _)| other.as_str()).collect();
            // Kinds with the same keys in a table share its section.
            if variants.first() != Some(&table.as_str()) {
                continue;
            }
            out += &format!(
                "\n## {}\n\n| key | default | value | what it does |\n|---|---|---|---|\n{rows}",
                heading(&variants)
            );
            if table == "scene.bodies[]" {
                out += &motions();
            }
        }
        out
    }
}

const MANUAL_HEAD: &str = "# The rig file

This page is generated from the declarations in `host/rig/src/config/` and beside it. To renew it, run
`DPM_UPDATE_MANUAL=1 cargo test -p dpm-tests --test laws the_manual`.

A rig file is TOML. Keys that it leaves out have their defaults. Environment variables override the file
(`DPM_SET_PROJECTOR__WIDTH=640` sets `projector.width`; two underscores separate the levels). The flag
`--set projector.width=640` overrides both and may be given several times; a number is an index into a list
(`--set scene.bodies.0.node=Hare`). All mistakes in a file are reported at once, each with line and column. Paths in a
rig file are relative to its folder.
";

/// The manual's table of the possible contents of `scene.bodies[].motion`.
fn motions() -> String {
    let mut out =
        "\n## `motion` of `[[scene.bodies]]`\n\n| `kind` | key | type | what it does |\n|---|---|---|---|\n"
            .to_string();
    let text = |lines: &[&str]| lines.iter().map(|l| l.trim()).collect::<Vec<_>>().join(" ");
    for kind in MotionSpec::KINDS {
        out += &format!("| `{}` | | | {} |\n", kind.name, text(kind.doc));
        for (key, ty, doc) in kind.keys {
            let ty = match *ty {
                "f64" => f64::kind(),
                "[f64; 3]" => <[f64; 3]>::kind(),
                _ => "a list of motions".to_string(),
            };
            out += &format!("| | `{key}` | {ty} | {} |\n", text(doc));
        }
    }
    out
}

/// `tracker(vrpn).transform` as the table, its kind, and what lies within it.
fn of_kind(table: &str) -> Option<(&str, &str, &str)> {
    let (before, rest) = table.split_once('(')?;
    let (kind, within) = rest.split_once(')')?;
    Some((before, kind, within))
}

/// Whether two names stand for one table, of whatever kinds.
fn is_variant(one: &str, other: &str) -> bool {
    let table = |name| of_kind(name).map(|(before, _, within)| (before, within));
    one == other || table(one).is_some_and(|one| table(other) == Some(one))
}

/// Formats `projector.backend(usb)` as `[projector.backend]` with `kind = "usb"`, a table within it likewise, several
/// kinds one after the other, and `scene.bodies[]` as `[[scene.bodies]]`.
fn heading(variants: &[&str]) -> String {
    let kinds: Vec<_> = variants.iter().filter_map(|table| of_kind(table)).collect();
    let Some((table, kind, within)) = kinds.first() else {
        let table = variants.first().copied().unwrap_or_default();
        return match table.strip_suffix("[]") {
            Some(list) => format!("`[[{list}]]`"),
            None => format!("`[{table}]`"),
        };
    };
    let others: String = kinds.iter().skip(1).map(|(_, kind, _)| format!(", `\"{kind}\"`")).collect();
    format!("`[{table}{within}]` with `kind = \"{kind}\"`{others}")
}
