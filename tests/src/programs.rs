//! Programs of this workspace that a test runs, and the folder in which it runs them.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

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
