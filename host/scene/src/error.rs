//! What can be wrong with a scene, a texture or a sky, told so that the operator knows which object and what to do.

use std::path::PathBuf;
use std::time::Duration;

/// Why a file was not accepted. The text names the object ("accessor 3", "material 1 'glass'") and, where there is one, the remedy.
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
        /// How much the file asks for.
        found: u64,
        /// The greatest value taken.
        limit: u64,
        /// What to do.
        remedy: &'static str,
    },
    /// It contradicts its own format.
    #[error("{object}: {problem}")]
    Broken {
        /// Which part.
        object: String,
        /// What is wrong there, and the remedy if it is not plain.
        problem: String,
    },
    /// Well-formed, but asks for something this program does not do.
    #[error("{what} is not supported: {remedy}")]
    Unsupported {
        /// What the file needs.
        what: String,
        /// What to do.
        remedy: String,
    },
    /// The rig file names a node that is not there, or there several times.
    #[error("{problem} (nodes with a name: {known})")]
    Node {
        /// Which name, and what is wrong.
        problem: String,
        /// Names to choose from.
        known: String,
    },
    /// It took longer than [`super::Limits::time`].
    #[error("loading took longer than {0:?} and was stopped: simplify the file or raise the limit")]
    TimedOut(Duration),
    /// A defect of the loader, contained.
    #[error("the loader failed on this file, which is a defect of this program: {0}")]
    Internal(String),
    /// Any of the above, with the file it happened in.
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
    /// A contradiction inside the file.
    pub(crate) fn broken(object: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Broken { object: object.into(), problem: problem.into() }
    }

    /// Something that is not done here.
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
