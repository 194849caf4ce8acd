//! Errors of scenes, textures and skies. Their text tells the operator which object is affected and what to do.

use std::path::PathBuf;
use std::time::Duration;

/// Why a file was refused. The text names the object ("accessor 3", "material 1 'glass'") and, if there is one, the
/// remedy.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The system could not read it.
    #[error("cannot read the file: {0}")]
    Read(#[source] std::io::Error),
    /// Beyond a limit that guards memory and time.
    #[error("{what} comes to {found}, the limit is {limit}: {remedy}")]
    TooLarge {
        /// What was counted.
        what: String,
        /// The amount in the file.
        found: u64,
        /// The greatest accepted value.
        limit: u64,
        /// The remedy.
        remedy: &'static str,
    },
    /// It contradicts its own format.
    #[error("{object}: {problem}")]
    Broken {
        /// The affected part.
        object: String,
        /// The problem, and the remedy unless it is obvious.
        problem: String,
    },
    /// Well-formed, but requires something that this program does not support.
    #[error("{what} is not supported: {remedy}")]
    Unsupported {
        /// What the file needs.
        what: String,
        /// The remedy.
        remedy: String,
    },
    /// The rig file names a node that does not exist, or exists several times.
    #[error("{key}: {problem} (nodes with a name: {known})")]
    Node {
        /// The key of the rig file.
        key: String,
        /// The name and the problem.
        problem: String,
        /// Names to choose from.
        known: String,
    },
    /// The rig file names an animation that does not exist.
    #[error("scene.animation is '{name}', and the file has no animation of this name (it has: {known}). \"first\" plays the first one, \"none\" none")]
    Animation {
        /// The name.
        name: String,
        /// Names to choose from.
        known: String,
    },
    /// It took longer than [`super::Limits::time`].
    #[error("loading took longer than {0:?} and was stopped: simplify the file or raise the limit")]
    TimedOut(Duration),
    /// A defect of the loader, caught.
    #[error("the loader failed on this file, which is a defect of this program: {0}")]
    Internal(String),
    /// Any of the above, with the affected file.
    #[error("{}: {problem}", path.display())]
    InFile {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        #[source]
        problem: Box<SceneError>,
    },
}

impl SceneError {
    /// What to do about it, for whoever writes the rig file.
    pub fn remedy(&self) -> String {
        match self {
            Self::InFile { problem, .. } => problem.remedy(),
            Self::Read(_) => "correct scene.file: it is taken from the rig file's own folder".into(),
            Self::Node { key, .. } => {
                format!("write one of these names at {key} in the rig file, letter by letter, or name the node so in the file")
            }
            Self::Animation { .. } => "correct scene.animation in the rig file".into(),
            Self::Broken { .. } => {
                "correct this object in the program that wrote the file, or name another scene.file".into()
            }
            Self::TooLarge { .. } | Self::Unsupported { .. } | Self::TimedOut(_) => {
                "change the file so, or name another scene.file; docs/SCENES.md says what is read".into()
            }
            Self::Internal(_) => "please report it with the file; until then name another scene.file".into(),
        }
    }

    /// A contradiction inside the file.
    pub(crate) fn broken(object: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Broken { object: object.into(), problem: problem.into() }
    }

    /// Something that is not supported.
    pub(crate) fn unsupported(what: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Unsupported { what: what.into(), remedy: remedy.into() }
    }

    /// `Ok` while `found <= limit`.
    pub(crate) fn check_limit(what: &str, found: u64, limit: u64, remedy: &'static str) -> Result<(), Self> {
        if found <= limit {
            return Ok(());
        }
        Err(Self::TooLarge { what: what.into(), found, limit, remedy })
    }

    /// Adds the file's name.
    pub(crate) fn in_file(self, path: &std::path::Path) -> Self {
        Self::InFile { path: path.to_path_buf(), problem: Box::new(self) }
    }
}
