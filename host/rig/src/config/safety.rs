//! `[safety]` with its limits and interlock: what happens when something fails, how much light is permitted, and what else
//! must permit it.

use super::{Origin, PlaneWeights, ProjectorConfig, RigConfig, Wearable};
use dpm_common::keys::read::{Any, KeyReader, NotEmpty, Within};
use dpm_common::{kinds, section, words};
use dpm_device::link::{LightLimits, MAX_LIMIT_MS, MIN_LIMIT_MS};
use dpm_device::tty::ControlSignal;
use std::path::{Path, PathBuf};

const SHORTEST_S: f64 = MIN_LIMIT_MS as f64 / 1e3;
const LONGEST_S: f64 = MAX_LIMIT_MS as f64 / 1e3;

section! {
    /// What happens when something fails.
    pub struct SafetyConfig {
        /// The projector goes dark by itself if it receives nothing for this long, at least two frames. If left out,
        /// it is the longer of 50 ms and three frames.
        watchdog_ms: Option<u32> = None, "ms", Within(1, 10_000);
        /// Prediction extends a body's track for at most this long, from the tracker's newest sample to the middle of
        /// the light; then its light goes off. A frame that would be lit later than that plus one slot is not sent. A
        /// frame that is late or repeated goes dark at this age of its poses (docs/SAFETY.md). If left out, it follows
        /// the need of the frames, at least 20 ms. A value in the file is binding: a rig whose frames take longer stays
        /// dark and reports it.
        predict_ms: Option<u32> = None, "ms", Within(0, 1_000);
        /// Permitted general flashes of the whole picture per second; beyond this the projector rests in the dark for
        /// two seconds. WCAG 2.3.1 allows 3; 0 is off.
        flashes_per_second: u32 = 3, "1/s", Within(0, 1_000);
        /// If set, the start of a run also acknowledges latched faults of heat, lamp, emergency stop and flashes;
        /// otherwise the run refuses to start. Set it once, on the command line, when the cause is gone.
        acknowledge_faults: bool = false, "", Any;
        /// Whether a run makes light as soon as it can, or stays dark until somebody gives ARM, at every start of the
        /// program (docs/ORDERS.md).
        start: Restart = Restart::ByItself, "", Any;
        /// How much light is permitted; docs/SAFETY.md says what that does for people and what it does not.
        limits: LimitsConfig = LimitsConfig::default(), "", Any;
        /// Where no light may be, because somebody's eyes are there.
        eyes: EyesConfig = EyesConfig::default(), "", Any;
        /// What else must permit light.
        interlock: InterlockConfig = InterlockConfig::default(), "", Any;
    }
}

words! {
    /// Who lets light return.
    pub enum Restart {
        /// The program.
        ByItself = "by itself",
        /// A person, who gives ARM.
        ByHand = "by hand",
    }
}

section! {
    /// Limits on light. The host goes dark before a limit is exceeded, and the projector enforces the same limits by
    /// itself.
    pub struct LimitsConfig {
        /// Greatest mean level of the picture over `mean_window_s`, as a share of full white, at least 0.001; 0 is
        /// off. A picture that would exceed the limit is not dimmed: the light goes off for a window's length
        /// (docs/SAFETY.md).
        mean_level: f64 = 0.0, "", Within(0.0, 1.0);
        /// Length of every window over which the mean is taken.
        mean_window_s: f64 = 10.0, "s", Within(SHORTEST_S, LONGEST_S);
        /// Longest time of full white (a level of 0.95 or more), 0.5 to 3600; 0 is off. Afterwards the light goes
        /// off for the same time.
        full_white_s: f64 = 0.0, "s", Within(0.0, LONGEST_S);
        /// The `projector.weights` with which `mean_level` was measured. The level is made smaller for planes that give
        /// less light than binary ones; planes that give more are refused here.
        measured_with: PlaneWeights = PlaneWeights::Binary, "", Any;
    }
}

impl LimitsConfig {
    /// True if nothing is limited.
    pub fn is_off(&self) -> bool {
        self.mean_level <= 0.0 && self.full_white_s <= 0.0
    }

    /// The limits in the units of host and projector. Each value is in its range once the configuration is accepted.
    pub fn limits(&self, projector: &ProjectorConfig) -> LightLimits {
        // Rounded towards less light. No planes make a limit wider.
        let white = projector.white_of(self.measured_with).min(1.0);
        let mean_permille = (self.mean_level * white * 1000.0 + 1e-9).floor() as u16;
        LightLimits {
            mean_permille,
            window_ms: if mean_permille > 0 { (self.mean_window_s * 1000.0).round() as u32 } else { 0 },
            full_white_ms: (self.full_white_s * 1000.0).floor() as u32,
        }
    }
}

section! {
    /// The eye guard: no light within a sphere about every tracked head, which is no safety device (docs/SAFETY.md).
    pub struct EyesConfig {
        /// Off lets light fall on tracked heads too. Without a tracked head it has nothing to guard.
        guard: bool = true, "", Any;
        /// Further tracked people, each by what is tracked of the head, for example `["visitor"]`: a name or a table as
        /// in `observer.tracked`, or one of `scene.bodies[].name`. The observer needs no entry.
        heads: Vec<Wearable> = Vec::new(), "", Any;
        /// Radius of the sphere about the observer's eye, or about the origin of another tracked head, before it grows
        /// (docs/SAFETY.md).
        radius: f64 = 0.15, "m", Within(0.01, 10.0);
        /// The sphere of a head that the tracker loses grows at 2 m/s for this long; then the rig is dark until the head
        /// is seen again.
        lost_ms: u32 = 500, "ms", Within(0, 60_000);
    }
}

kinds! {
    /// What else must permit light at every moment.
    pub enum InterlockConfig {
        /// nothing else: only the operator's orders decide.
        None(NoInterlockConfig) = "none",
        /// a process of this machine must be alive.
        Process(ProcessInterlockConfig) = "process",
        /// an input line of a serial port must be raised, or a file must hold "1".
        Line(LineInterlockConfig) = "line",
        /// a key of the terminal must be held down.
        Key(KeyInterlockConfig) = "key",
    }
    default None
}

section! {
    /// No interlock.
    pub struct NoInterlockConfig {}
}

section! {
    /// Light only while a process is alive. A stopped process or a zombie does not count. The process must belong to
    /// this user or to root.
    pub struct ProcessInterlockConfig {
        /// Name of the process, as `ps -o comm` shows it. Give this or `pid_file`.
        name: Option<String> = None, "", NotEmpty;
        /// File that contains the id of the process; an absolute path. Only the process that was alive when the
        /// file was first read counts, until the file is rewritten.
        pid_file: Option<PathBuf> = None, "", NotEmpty;
        /// Whether light returns when the process is back, or when somebody gives ARM after that.
        reset: Restart = Restart::ByItself, "", Any;
    }
}

section! {
    /// Light only while a contact is closed.
    pub struct LineInterlockConfig {
        /// Serial port whose `signal` is the contact. Its RTS and DTR are raised and can feed the contact. Give this
        /// or `file`.
        port: Option<String> = None, "", NotEmpty;
        /// Which input of the port.
        signal: InterlockSignal = InterlockSignal::Cts, "", Any;
        /// File whose content must be "1", for example the `value` of a GPIO line; an absolute path.
        file: Option<PathBuf> = None, "", NotEmpty;
        /// Whether light returns when the contact closes, or when somebody gives ARM after that.
        reset: Restart = Restart::ByItself, "", Any;
    }
}

impl InterlockConfig {
    /// Who lets light return after the interlock has opened. A key that is held down is by hand already.
    pub fn reset(&self) -> Restart {
        match self {
            Self::Process(process) => process.reset,
            Self::Line(line) => line.reset,
            Self::None(_) | Self::Key(_) => Restart::ByItself,
        }
    }
}

section! {
    /// Light only while a key is held down on the terminal from which `dpm run` was started. A terminal does not
    /// report the release of a key: the light goes off when the key has not repeated for `release_ms`, and comes on
    /// with its second repetition. This is for trying things out, not for protecting people.
    pub struct KeyInterlockConfig {
        /// The key: one printable ASCII character that gives no order (b, f, s and a do).
        key: String = " ".into(), "", NotEmpty;
        /// The key counts as released when it has not repeated for this long. It must be longer than the keyboard's
        /// repeat interval.
        release_ms: u32 = 100, "ms", Within(20, 1_000);
    }
}

words! {
    /// Control inputs of a serial port.
    pub enum InterlockSignal {
        /// Clear to send.
        Cts = "cts",
        /// Data set ready.
        Dsr = "dsr",
        /// Data carrier detect.
        Dcd = "dcd",
    }
}

impl InterlockSignal {
    /// The line in the port's own type.
    pub const fn line(self) -> ControlSignal {
        match self {
            Self::Cts => ControlSignal::Cts,
            Self::Dsr => ControlSignal::Dsr,
            Self::Dcd => ControlSignal::Dcd,
        }
    }
}

/// Checks for contradictions in `[safety]` and with other sections.
pub(super) fn check(rig: &RigConfig, reader: &mut KeyReader) {
    let mut refuse = |key: &str, problem: &str, remedy: &str| {
        let origin: Origin = reader.origin_of(key);
        reader.refuse(&origin, key, problem.to_owned(), remedy.to_owned());
    };
    check_limits(rig, &mut refuse);
    check_interlock(rig, &mut refuse);
}

/// Refuses a key, for what is wrong with it, with what to do.
type Refuse<'a> = dyn FnMut(&str, &str, &str) + 'a;

fn check_limits(rig: &RigConfig, refuse: &mut Refuse) {
    let limits = &rig.safety.limits;
    let white = rig.projector.white_of(limits.measured_with);
    if limits.mean_level > 0.0 && limits.mean_level * white < 0.001 {
        refuse("safety.limits.mean_level", "is below a thousandth of full white", "write 0 to switch it off");
    }
    let measured_with = "safety.limits.measured_with";
    if white > 1.0 {
        let problem = format!("names planes whose white is {white:.2} times the full white that limits count in, so every limit would be that much wider");
        let remedy = "remove the key, and write mean_level as a share of the full white of binary planes";
        refuse(measured_with, &problem, remedy);
    } else if white < 1.0 && limits.full_white_s > 0.0 {
        let problem = format!("names planes whose white is a level of {white:.2}, and full_white_s counts levels of 0.95 and more");
        refuse(measured_with, &problem, "limit the light of such planes by mean_level alone");
    } else if limits.is_off() && limits.measured_with != PlaneWeights::Binary {
        refuse(measured_with, "says how limits were measured, but there are none", "remove it");
    }
    if limits.full_white_s > 0.0 && limits.full_white_s < SHORTEST_S {
        let remedy = "at least 0.5 s, or 0 to switch it off";
        refuse("safety.limits.full_white_s", "is too short to be distinguished from a flash", remedy);
    }
    if !limits.is_off() && rig.projector.backend.kind().is_loaded() {
        let key =
            if limits.mean_level > 0.0 { "safety.limits.mean_level" } else { "safety.limits.full_white_s" };
        refuse(
            key,
            &format!(
                "cannot be kept on a {}: its light comes from its own memory or a video input, which this program does not count",
                rig.projector.backend.kind().name
            ),
            "limit its light by the LED currents, or remove the key",
        );
    }
}

fn check_interlock(rig: &RigConfig, refuse: &mut Refuse) {
    let one_of = |a: bool, b: bool| a != b;
    let is_relative = |path: &Option<PathBuf>| path.as_deref().is_some_and(Path::is_relative);
    match &rig.safety.interlock {
        InterlockConfig::None(_) => {}
        InterlockConfig::Process(p) => {
            if !one_of(p.name.is_some(), p.pid_file.is_some()) {
                refuse(
                    "safety.interlock.kind",
                    "names no process, or two",
                    "give either `name` or `pid_file`",
                );
            }
            if is_relative(&p.pid_file) {
                refuse("safety.interlock.pid_file", "is a relative path", "write an absolute path");
            }
        }
        InterlockConfig::Line(l) => {
            if !one_of(l.port.is_some(), l.file.is_some()) {
                refuse("safety.interlock.kind", "names no line, or two", "give either `port` or `file`");
            }
            if is_relative(&l.file) {
                refuse("safety.interlock.file", "is a relative path", "write an absolute path");
            }
            if let (Some(ours), Some(port)) = (&l.port, rig.projector.backend.port()) {
                let device = |path: &str| std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
                if device(ours) == device(port) {
                    let remedy = "a port can be opened once; use another";
                    refuse("safety.interlock.port", "is the projector's own port", remedy);
                }
            }
        }
        InterlockConfig::Key(k) => {
            let bytes = k.key.as_bytes();
            let usable = bytes.len() == 1 && (bytes[0] == b' ' || bytes[0].is_ascii_graphic());
            if !usable {
                refuse("safety.interlock.key", "is not one printable ASCII character", "for example \" \"");
            } else if crate::order::Order::from_key(bytes[0]).is_some() {
                refuse(
                    "safety.interlock.key",
                    "is a key that gives an order",
                    "take another, for example \" \"",
                );
            }
        }
    }
}
