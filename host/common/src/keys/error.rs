//! What is wrong with a configuration, where it is written, and what to do about it.

use std::fmt;
use std::path::Path;
use std::sync::Arc;

/// Where a value was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// Not written: the default applies.
    Default,
    /// A place in a file. Line and column count from 1, the column in characters. Line 0 is the file as a whole.
    File {
        /// Name of the file as the user gave it.
        file: Arc<str>,
        /// Line.
        line: usize,
        /// Column.
        column: usize,
    },
    /// An environment variable `DPM_SET_...`, by its name.
    Variable(String),
    /// The flag `--set`, with its text.
    Flag(String),
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("(default)"),
            Self::File { file, line: 0, .. } => f.write_str(file),
            Self::File { file, line, column } => write!(f, "{file}:{line}:{column}"),
            Self::Variable(name) => write!(f, "environment variable {name}"),
            Self::Flag(text) => write!(f, "--set {text}"),
        }
    }
}

/// One mistake in a configuration.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{origin}: {}{problem}{}", key_prefix(.key), remedy_suffix(.remedy))]
pub struct ConfigError {
    /// Where it was written.
    pub origin: Origin,
    /// Dotted key, for example `projector.width`; empty if the mistake does not concern a single key.
    pub key: String,
    /// What is wrong, with the permitted range.
    pub problem: String,
    /// What to do; may be empty.
    pub remedy: String,
}

fn key_prefix(key: &str) -> String {
    if key.is_empty() {
        String::new()
    } else {
        format!("`{key}`: ")
    }
}

fn remedy_suffix(remedy: &str) -> String {
    if remedy.is_empty() {
        String::new()
    } else {
        format!("; {remedy}")
    }
}

/// Every mistake of one configuration, in the order in which the keys are read. Never empty.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigErrors(pub Vec<ConfigError>);

impl ConfigErrors {
    /// The single error for a file that cannot be read.
    pub fn unreadable(path: &Path, problem: String, remedy: &str) -> Self {
        Self(vec![ConfigError {
            origin: Origin::File { file: path.display().to_string().into(), line: 0, column: 0 },
            key: String::new(),
            problem,
            remedy: remedy.into(),
        }])
    }
}

impl fmt::Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, error) in self.0.iter().enumerate() {
            if i > 0 {
                writeln!(f)?;
            }
            write!(f, "{error}")?;
        }
        Ok(())
    }
}

impl std::error::Error for ConfigErrors {}
