//! Runs the program in a process of its own, for the tests of the command line.
#![allow(dead_code)]

use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Read};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::mpsc::{channel, Receiver};
use std::sync::Once;
use std::time::{Duration, Instant};

/// No Vulkan driver, whatever the machine has.
pub(crate) const NO_DRIVER: [(&str, &str); 2] =
    [("VK_ICD_FILENAMES", "/nonexistent.json"), ("VK_DRIVER_FILES", "/nonexistent.json")];

/// A folder of this test program for locks, sockets and standing orders of the programs that it starts.
pub(crate) fn own_folder(name: &str) -> PathBuf {
    static CLEARED: Once = Once::new();
    let own = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("dpm-{}", std::process::id()));
    // An earlier test had the same number, and what it ordered would stand.
    CLEARED.call_once(|| drop(std::fs::remove_dir_all(&own)));
    own.join(name)
}

/// The program with arguments, in an environment without our settings. It does not see what this machine's own rigs
/// keep.
pub(crate) fn command<S: AsRef<OsStr>>(args: &[S]) -> Command {
    command_of(env!("CARGO_BIN_EXE_dpm"), args)
}

/// The same after `preparation`, which are shell commands that set limits of the process.
pub(crate) fn command_after<S: AsRef<OsStr>>(preparation: &str, args: &[S]) -> Command {
    let line = format!("{preparation}; exec \"$0\" \"$@\"");
    let words = ["-c", &line, env!("CARGO_BIN_EXE_dpm")].map(OsStr::new);
    command_of("bash", &words.into_iter().chain(args.iter().map(AsRef::as_ref)).collect::<Vec<_>>())
}

/// The same with a copy of the program, or with another program that starts it.
pub(crate) fn command_of<S: AsRef<OsStr>>(program: impl AsRef<OsStr>, args: &[S]) -> Command {
    let mut command = Command::new(program);
    command.args(args).env_remove("NO_COLOR").stdin(Stdio::null());
    command.env("DPM_RUNTIME_DIR", own_folder("run")).env("DPM_STATE_DIR", own_folder("state"));
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("DPM_SET_") {
            command.env_remove(name);
        }
    }
    command
}

/// Runs the program to its end.
pub(crate) fn dpm(args: &[&str], variables: &[(&str, &str)]) -> Output {
    command(args).envs(variables.iter().copied()).output().expect("the program starts")
}

/// Its exit code.
pub(crate) fn code(output: &Output) -> i32 {
    output.status.code().expect("not ended by a signal")
}

/// Its standard output.
pub(crate) fn out(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Its standard error stream.
pub(crate) fn err(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A program that runs during the test; it is killed if the test ends early.
pub(crate) struct ChildProgram {
    child: Child,
    lines: Receiver<String>,
}

/// Starts the program and returns.
pub(crate) fn start<S: AsRef<OsStr>>(args: &[S]) -> ChildProgram {
    start_with(args, &[])
}

/// Starts the program with additional environment variables, and returns.
pub(crate) fn start_with<S: AsRef<OsStr>>(args: &[S], variables: &[(&str, &str)]) -> ChildProgram {
    let mut command = command(args);
    command.envs(variables.iter().copied()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("the program starts");
    let (sender, lines) = channel();
    let stderr = BufReader::new(child.stderr.take().expect("piped"));
    std::thread::spawn(move || {
        for line in stderr.lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    ChildProgram { child, lines }
}

impl ChildProgram {
    /// Process number.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Reads the standard error stream until a line is `wanted`.
    pub(crate) fn wait_for_line(&mut self, limit: Duration, wanted: impl Fn(&str) -> bool) {
        let (end, mut heard) = (Instant::now() + limit, Vec::new());
        loop {
            let left = end.saturating_duration_since(Instant::now());
            match self.lines.recv_timeout(left) {
                Ok(line) if wanted(&line) => return,
                Ok(line) => heard.push(line),
                Err(e) => panic!("no such line within {limit:?}: {e}; {heard:#?}"),
            }
        }
    }

    /// The lines of the standard error stream up to its end.
    pub(crate) fn rest_of_lines(&mut self, limit: Duration) -> Vec<String> {
        let end = Instant::now() + limit;
        let mut all = Vec::new();
        while let Ok(line) = self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
            all.push(line);
        }
        all
    }

    /// Sends a signal by its name.
    pub(crate) fn signal(&self, name: &str) {
        // The shell's built-in kill, because a minimal system has no program of that name.
        let status = Command::new("sh").args(["-c", &format!("kill -s {name} {}", self.id())]).status();
        assert!(status.expect("a shell starts").success());
    }

    /// Its end, if it has come.
    pub(crate) fn try_wait(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("our own child")
    }

    /// Waits for the end; returns status and standard output.
    pub(crate) fn finish(mut self) -> (ExitStatus, String) {
        let mut text = String::new();
        let mut stdout = self.child.stdout.take().expect("piped");
        stdout.read_to_string(&mut text).expect("UTF-8");
        (self.child.wait().expect("it ends"), text)
    }
}

impl Drop for ChildProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A folder that is deleted when the test is over.
pub(crate) struct TestFolder(PathBuf, String);

impl TestFolder {
    /// An empty folder.
    pub(crate) fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-cli-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).expect("the temporary folder can be written");
        let text = path.display().to_string();
        Self(path, text)
    }

    /// Its path, for an argument.
    pub(crate) fn text(&self) -> &str {
        &self.1
    }

    /// A path in it.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes a file; returns its path.
    pub(crate) fn write(&self, name: &str, text: &str) -> String {
        let path = self.path(name);
        std::fs::write(&path, text).expect("the temporary folder can be written");
        path.display().to_string()
    }
}

impl Drop for TestFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
