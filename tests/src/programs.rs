//! Programs of this workspace that a test runs, and the folder in which it runs them.

use std::fs::Permissions;
use std::io::{Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command};
use std::sync::mpsc::{channel, Receiver};
use std::time::{Duration, Instant};

/// A program of this workspace that the build of all tests has made.
///
/// # Panics
/// It was not made.
pub fn program(name: &str) -> PathBuf {
    let here = std::env::current_exe().expect("a test knows where it lies");
    let path = here.parent().and_then(Path::parent).expect("target/PROFILE/deps").join(name);
    assert!(path.exists(), "{} is missing: cargo build -p dpm -p hil-mock", path.display());
    path
}

/// A folder that is removed afterwards, with what a rig keeps outside its own files in it.
pub struct RunFolder(PathBuf);

impl RunFolder {
    /// An empty folder; `name` tells it from those of other tests.
    ///
    /// # Panics
    /// The folder of temporary files cannot be written.
    pub fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        for part in ["run", "state"] {
            std::fs::create_dir_all(path.join(part)).expect("a folder of the test's own");
            std::fs::set_permissions(path.join(part), Permissions::from_mode(0o700)).expect("the same");
        }
        Self(path)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// A command that runs here, with sockets and standing orders of its own.
    pub fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new(program);
        command
            .current_dir(&self.0)
            .env("DPM_RUNTIME_DIR", self.0.join("run"))
            .env("DPM_STATE_DIR", self.0.join("state"));
        command
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A program that one talks with, killed with this.
pub struct Talk {
    child: Child,
    input: ChildStdin,
    heard: Receiver<Vec<u8>>,
    text: String,
    /// What was read by [`Talk::until`] so far.
    read: usize,
}

/// Longer than any answer takes on a machine with other work.
const PATIENCE: Duration = Duration::from_secs(120);

impl Talk {
    /// Talks with a child whose standard input is a pipe; what it says is read where it goes to a pipe.
    ///
    /// # Panics
    /// Its standard input is none.
    pub fn with(mut child: Child) -> Self {
        let input = child.stdin.take().expect("a program that runs");
        let (send, heard) = channel();
        let outputs: [Option<Box<dyn Read + Send>>; 2] = [
            child.stdout.take().map(|o| Box::new(o) as Box<dyn Read + Send>),
            child.stderr.take().map(|e| Box::new(e) as Box<dyn Read + Send>),
        ];
        for mut output in outputs.into_iter().flatten() {
            let send = send.clone();
            std::thread::spawn(move || {
                let mut bytes = [0; 4096];
                while let Ok(n @ 1..) = output.read(&mut bytes) {
                    if send.send(bytes[..n].to_vec()).is_err() {
                        return;
                    }
                }
            });
        }
        Self { child, input, heard, text: String::new(), read: 0 }
    }

    /// Reads on until `words` come; gives what came before them.
    ///
    /// # Panics
    /// They do not come within [`PATIENCE`]; so do the others.
    pub fn until(&mut self, words: &str) -> String {
        self.until_one(&[words]).1
    }

    /// Reads on until one of several comes; gives its number and what came before it.
    ///
    /// # Panics
    /// None comes.
    pub fn until_one(&mut self, words: &[&str]) -> (usize, String) {
        let begin = Instant::now();
        loop {
            let fresh = &self.text[self.read..];
            let found = words.iter().enumerate().filter_map(|(i, w)| Some((fresh.find(w)?, i))).min();
            if let Some((at, which)) = found {
                let before = fresh[..at].to_owned();
                self.read += at + words[which].len();
                return (which, before);
            }
            let left = PATIENCE.saturating_sub(begin.elapsed());
            match self.heard.recv_timeout(left) {
                Ok(bytes) => self.text += &String::from_utf8_lossy(&bytes),
                Err(why) => panic!("none of {words:?} came ({why}):\n{}", self.text),
            }
        }
    }

    /// Types a line.
    ///
    /// # Panics
    /// The program has ended.
    pub fn say(&mut self, line: &str) {
        self.input.write_all(format!("{line}\n").as_bytes()).expect("a program that runs");
        self.input.flush().expect("a program that runs");
    }

    /// Waits for the end: the exit code and all that was said.
    ///
    /// # Panics
    /// The operating system has lost the child.
    pub fn end(mut self) -> (Option<i32>, String) {
        while let Ok(bytes) = self.heard.recv_timeout(PATIENCE) {
            self.text += &String::from_utf8_lossy(&bytes);
        }
        let code = self.child.wait().expect("a program that runs").code();
        (code, std::mem::take(&mut self.text))
    }
}

impl Drop for Talk {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
