//! The processes of a soak: started, watched, asked and killed.

use crate::cable::Cable;
use crate::laws::{Held, Laws, GONE_WITHIN, LIGHT_WITHIN};
use crate::light::LightLog;
use hil_mock::monotonic::now_ns;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Time between two looks at the log of the light.
const STEP: Duration = Duration::from_millis(20);
/// Time between two looks at what the processes hold.
const LOOK: Duration = Duration::from_secs(1);
/// After a deed the rig settles before quiet time begins.
const SETTLED: Duration = Duration::from_secs(3);
/// The panel: small enough for software Vulkan.
const PANEL: [u32; 2] = [64, 48];

/// A process and what it held when it was first looked at in quiet time.
pub(crate) struct Process {
    program: &'static str,
    child: Child,
    first: Option<Held>,
    leaks: bool,
}

impl Process {
    fn start(program: &'static str, command: &mut Command) -> Result<Self, String> {
        let child = command.stdin(Stdio::null()).spawn();
        let child = child.map_err(|e| format!("cannot start {:?}: {e}", command.get_program()))?;
        Ok(Self { program, child, first: None, leaks: false })
    }

    /// Kills it, as a fault would.
    pub(crate) fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    fn look(&mut self, laws: &mut Laws) {
        let Some(held) = held(self.child.id()) else { return };
        let first = *self.first.get_or_insert(held);
        if !self.leaks {
            self.leaks = !laws.holds(self.program, first, held);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// What a process holds; `None` if it is gone.
fn held(pid: u32) -> Option<Held> {
    let folder = PathBuf::from(format!("/proc/{pid}"));
    let count = |name: &str| Some(std::fs::read_dir(folder.join(name)).ok()?.count() as u64);
    let status = std::fs::read_to_string(folder.join("status")).ok()?;
    let kib =
        status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?.split_whitespace().next()?.parse().ok()?;
    Some(Held { kib, descriptors: count("fd")?, threads: count("task")? })
}

/// What the reports of all runs say together.
#[derive(Default)]
pub(crate) struct Runs {
    pub(crate) reports: u64,
    pub(crate) frames_lit: u64,
    pub(crate) frames_dark: u64,
    pub(crate) frames_dropped: u64,
    pub(crate) slots: u64,
    pub(crate) missed: u64,
    pub(crate) by_cause: BTreeMap<String, u64>,
    pub(crate) flights: u64,
}

/// All processes.
pub(crate) struct Crew {
    out: PathBuf,
    programs: PathBuf,
    rig: PathBuf,
    command_port: u16,
    picture: PathBuf,
    log: LightLog,
    pub(crate) cable: Cable,
    pub(crate) tracker: Process,
    projector: Process,
    pub(crate) dpm: Process,
    runs: u64,
    /// Since when it is quiet, on the machine's clock.
    quiet_since: i64,
    settled_at: Instant,
    looked_at: Instant,
}

impl Crew {
    /// Starts them; their files go to `out`.
    pub(crate) fn start(out: &Path) -> Result<Self, String> {
        let own = std::env::current_exe().map_err(|e| e.to_string())?;
        let programs = own.parent().ok_or("this program lies nowhere")?.to_owned();
        let (picture, log) = (out.join("light.ppm"), out.join("light.log"));
        let mut command = Command::new(programs.join("hil-mock"));
        command.args([
            "serve",
            "projector",
            "--port",
            "pty",
            "--raster",
            &format!("{}x{}", PANEL[0], PANEL[1]),
        ]);
        command.arg("--light").arg(&picture).arg("--light-log").arg(&log).stdout(Stdio::piped());
        let mut projector = Process::start("projector", &mut command)?;
        let mut lines = BufReader::new(projector.child.stdout.take().ok_or("no output")?);
        let mut line = String::new();
        lines.read_line(&mut line).map_err(|e| e.to_string())?;
        let path = line.trim().rsplit(' ').next().unwrap_or_default().to_owned();
        let mut rest = file(&out.join("projector.txt"))?;
        std::thread::spawn(move || std::io::copy(&mut lines, &mut rest));
        let cable = Cable::new(out.join("projector-port"), &path)?;
        let command_port = std::net::UdpSocket::bind("127.0.0.1:0")
            .and_then(|socket| socket.local_addr())
            .map_err(|e| e.to_string())?
            .port();
        let rig = out.join("rig.toml");
        std::fs::write(&rig, rig_file(&cable.path, command_port)).map_err(|e| e.to_string())?;
        let tracker = tracker(&programs, command_port, out)?;
        let dpm = dpm(&programs, &rig, out, 0)?;
        let now = Instant::now();
        Ok(Self {
            out: out.to_owned(),
            programs,
            rig,
            command_port,
            picture,
            log: LightLog::new(log),
            cable,
            tracker,
            projector,
            dpm,
            runs: 1,
            quiet_since: i64::MAX,
            settled_at: now + SETTLED,
            looked_at: now,
        })
    }

    /// The tracker again, after it was killed.
    pub(crate) fn start_tracker(&mut self, laws: &mut Laws) {
        match tracker(&self.programs, self.command_port, &self.out) {
            Ok(started) => self.tracker = started,
            Err(e) => laws.give_up(e),
        }
    }

    /// The next run of dpm.
    pub(crate) fn start_dpm(&mut self, laws: &mut Laws) {
        match dpm(&self.programs, &self.rig, &self.out, self.runs) {
            Ok(started) => self.dpm = started,
            Err(e) => laws.give_up(e),
        }
        self.runs += 1;
    }

    /// True if every process runs.
    pub(crate) fn is_well(&mut self, laws: &mut Laws) -> bool {
        for process in [&mut self.dpm, &mut self.tracker, &mut self.projector] {
            if !process.is_running() {
                let program = process.program;
                laws.give_up(format!("{program} ended by itself; its output is in {}", self.out.display()));
                return false;
            }
        }
        true
    }

    /// Quiet time begins soon: a deed is over.
    pub(crate) fn settle(&mut self) {
        self.settled_at = Instant::now() + SETTLED;
        self.quiet_since = i64::MAX;
    }

    /// Watches for a moment in which nothing is done to the rig.
    pub(crate) fn watch_quietly(&mut self, laws: &mut Laws) {
        self.rest(STEP);
        let now = Instant::now();
        if now < self.settled_at {
            return;
        }
        if self.quiet_since == i64::MAX {
            self.quiet_since = now_ns();
        }
        let dark = self.log.longest_dark(self.quiet_since, now_ns());
        laws.dark(dark as f64 * 1e-6);
        if now.duration_since(self.looked_at) >= LOOK {
            self.looked_at = now;
            for process in [&mut self.dpm, &mut self.tracker, &mut self.projector] {
                process.look(laws);
            }
        }
    }

    /// Lets time pass.
    pub(crate) fn rest(&mut self, time: Duration) {
        let end = Instant::now() + time;
        loop {
            std::thread::sleep(STEP.min(end.saturating_duration_since(Instant::now())));
            self.log.read();
            if Instant::now() >= end {
                return;
            }
        }
    }

    /// Waits until `done`; the time it took, or `None` after `limit`.
    fn until(&mut self, limit: Duration, mut done: impl FnMut(&mut Self) -> bool) -> Option<Duration> {
        let begin = Instant::now();
        loop {
            self.log.read();
            if done(self) {
                return Some(begin.elapsed());
            }
            if begin.elapsed() >= limit {
                return None;
            }
            std::thread::sleep(STEP);
        }
    }

    /// Gives an order as an operator does.
    pub(crate) fn order(&mut self, word: &str, laws: &mut Laws) {
        let mut command = own(Command::new(self.programs.join("dpm")), &self.out);
        match command.arg(word).stdin(Stdio::null()).output() {
            Ok(output) if output.status.success() => {}
            Ok(output) => {
                let told = String::from_utf8_lossy(&output.stderr).into_owned();
                laws.found(format!("`dpm {word}` ended with {}: {}", output.status, told.trim()));
            }
            Err(e) => laws.give_up(format!("cannot start dpm: {e}")),
        }
    }

    /// It must be dark at most `within_ms` after `at_ns`.
    pub(crate) fn expect_dark(&mut self, laws: &mut Laws, at_ns: i64, within_ms: f64, cause: &str) {
        let limit = Duration::from_secs_f64(within_ms * 1e-3) + Duration::from_secs(5);
        if self.until(limit, |crew| crew.log.dark_since(at_ns).is_some()).is_none() {
            return laws.found(format!("still lit {limit:?} after {cause}"));
        }
        let ms = self.log.dark_since(at_ns).map_or(0.0, |dark| (dark - at_ns) as f64 * 1e-6);
        laws.took(&format!("dark after {cause}"), ms);
        if ms > within_ms {
            laws.found(format!("dark {ms:.0} ms after {cause}; {within_ms:.0} ms are allowed"));
        }
    }

    /// It must stay dark.
    pub(crate) fn stays_dark(&mut self, laws: &mut Laws, cause: &str, time: Duration) {
        let from = now_ns();
        self.rest(time);
        let lit = self.log.changes.iter().any(|c| c.is_lit && c.at_ns > from);
        if lit || self.log.now().is_some_and(|c| c.is_lit) {
            laws.found(format!("light in the dark after {cause}"));
        }
    }

    /// Light must be back.
    pub(crate) fn expect_light(&mut self, laws: &mut Laws, cause: &str) {
        match self.until(LIGHT_WITHIN, |crew| crew.log.now().is_some_and(|c| c.is_lit)) {
            Some(time) => laws.took(&format!("light after {cause}"), time.as_secs_f64() * 1e3),
            None => laws.give_up(format!("no light within {LIGHT_WITHIN:?} after {cause}")),
        }
        self.settle();
    }

    /// The projector must come into a state, with light.
    pub(crate) fn expect_state(&mut self, laws: &mut Laws, state: &str, cause: &str) {
        self.expect(laws, state, cause, |log| log.now().is_some_and(|c| c.is_lit && c.state == state));
    }

    /// What was on the mirrors must be held: light, or the dark of a machine that stood still just then.
    pub(crate) fn expect_held(&mut self, laws: &mut Laws, cause: &str) {
        self.expect(laws, "frozen", cause, LightLog::is_held);
    }

    fn expect(&mut self, laws: &mut Laws, state: &str, cause: &str, done: impl Fn(&LightLog) -> bool) {
        let limit = Duration::from_secs(5);
        match self.until(limit, |crew| done(&crew.log)) {
            Some(time) => laws.took(&format!("{state} after {cause}"), time.as_secs_f64() * 1e3),
            None => laws.found(format!("{cause}: {:?} and not {state} after {limit:?}", self.log.now())),
        }
    }

    /// The picture on the mirrors, which the projector writes once a second, must have light, or none.
    pub(crate) fn expect_picture(&mut self, laws: &mut Laws, lit: bool, cause: &str) {
        let limit = Duration::from_secs(15);
        let picture = self.picture.clone();
        let has_light = move || {
            // The header ends with the third line.
            let bytes = std::fs::read(&picture).unwrap_or_default();
            let mut ends = bytes.iter().enumerate().filter(|(_, b)| **b == b'\n').map(|(i, _)| i);
            ends.nth(2).is_some_and(|end| bytes[end + 1..].iter().any(|b| *b > 0))
        };
        let word = if lit { "a picture" } else { "no picture" };
        match self.until(limit, |_| has_light() == lit) {
            Some(time) => laws.took(&format!("{word} after {cause}"), time.as_secs_f64() * 1e3),
            None => laws.found(format!("not {word} {limit:?} after {cause}")),
        }
    }

    /// Asks dpm to end, as a service manager does.
    pub(crate) fn stop_dpm(&mut self, laws: &mut Laws, at_ns: i64) {
        // The shell's built-in kill, because a minimal system has no program of that name.
        let line = format!("kill -s TERM {}", self.dpm.child.id());
        let begin = Instant::now();
        if !Command::new("sh").args(["-c", &line]).status().is_ok_and(|s| s.success()) {
            laws.found("dpm cannot be asked to end".into());
        }
        self.expect_dark(laws, at_ns, crate::laws::ORDER_WITHIN_MS, "TERM");
        let gone = self.until(GONE_WITHIN, |crew| !crew.dpm.is_running());
        match (gone, self.dpm.child.try_wait()) {
            (Some(_), Ok(Some(status))) => {
                laws.took("gone after TERM", begin.elapsed().as_secs_f64() * 1e3);
                if !status.success() {
                    laws.found(format!("dpm ended with {status} after TERM"));
                }
            }
            _ => laws.found(format!("dpm is still there {GONE_WITHIN:?} after TERM")),
        }
        self.dpm.kill();
    }

    /// Ends everything and looks at what was told.
    pub(crate) fn end(&mut self, laws: &mut Laws) {
        self.stop_dpm(laws, now_ns());
        for run in 0..self.runs {
            let told = std::fs::read_to_string(self.out.join(format!("run-{run}.txt"))).unwrap_or_default();
            if let Some(line) = told.lines().find(|line| line.contains("panicked")) {
                laws.found(format!("run {run}: {line}"));
            }
        }
    }

    /// What the reports say. A run that was killed has none.
    pub(crate) fn runs(&self) -> Runs {
        let mut all = Runs::default();
        for run in 0..self.runs {
            let folder = self.out.join(format!("run-{run}"));
            let names = std::fs::read_dir(&folder).into_iter().flatten().flatten();
            let is_flight = |name: &std::ffi::OsString| name.to_string_lossy().starts_with("flight-");
            all.flights += names.filter(|entry| is_flight(&entry.file_name())).count() as u64;
            let Ok(text) = std::fs::read_to_string(folder.join("report.json")) else { continue };
            let Ok(report) = serde_json::from_str::<serde_json::Value>(&text) else { continue };
            let number = |key: &str| report[key].as_u64().unwrap_or(0);
            all.reports += 1;
            all.frames_lit += number("frames_lit");
            all.frames_dark += number("frames_dark");
            all.frames_dropped += number("frames_dropped");
            all.slots += number("slots");
            all.missed += number("missed_slots");
            for (cause, n) in report["missed_by_cause"].as_object().into_iter().flatten() {
                *all.by_cause.entry(cause.clone()).or_default() += n.as_u64().unwrap_or(0);
            }
        }
        all
    }
}

fn file(path: &Path) -> Result<File, String> {
    let opened = File::options().create(true).append(true).open(path);
    opened.map_err(|e| format!("cannot write {}: {e}", path.display()))
}

/// The soak's own folder of locks, sockets and standing orders: it neither sees nor disturbs other rigs.
fn own(mut command: Command, out: &Path) -> Command {
    command.env("DPM_RUNTIME_DIR", out.join("run")).env("DPM_STATE_DIR", out.join("state"));
    command
}

fn rig_file(port: &Path, command_port: u16) -> String {
    let [width, height] = PANEL;
    format!(
        "[projector]\nwidth = {width}\nheight = {height}\nframe_rate = 30\nplanes = 8\n\
         backend = {{ kind = \"serial\", port = {:?}, baud = 3000000 }}\n\
         [tracker]\nkind = \"natnet\"\nserver = \"127.0.0.1\"\nlocal = \"127.0.0.1\"\ncommand_port = {command_port}\n\
         [safety]\nwatchdog_ms = 500\n[output]\nflight_recorder = true\n\
         [[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n",
        port.display().to_string()
    )
}

fn tracker(programs: &Path, command_port: u16, out: &Path) -> Result<Process, String> {
    let mut command = Command::new(programs.join("hil-mock"));
    command.args(["serve", "natnet", "--unicast", "command", "--command-port", &command_port.to_string()]);
    command.args(["--body", "bunny@0,0.1,0=translate", "--body", "venus@0.1,0.1,-0.1=rotate"]);
    Process::start("tracker", command.stdout(file(&out.join("tracker.txt"))?))
}

fn dpm(programs: &Path, rig: &Path, out: &Path, run: u64) -> Result<Process, String> {
    let mut command = own(Command::new(programs.join("dpm")), out);
    command.arg("run").arg(rig).arg("--out").arg(out.join(format!("run-{run}")));
    let told = out.join(format!("run-{run}.txt"));
    Process::start("dpm", command.stdout(file(&told)?).stderr(file(&told)?))
}
