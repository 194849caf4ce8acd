//! Why a command failed: a kind that the caller can act on, its exit code, and a message for the operator.

use std::fmt;

/// What an operator can do about a failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailureKind {
    /// The command ran, but a condition that it checks does not hold.
    CheckFailed,
    /// A file, a flag or a setting is wrong.
    BadInput,
    /// A projector, tracker or the operating system refused.
    Device,
    /// There is no usable Vulkan device.
    NoGpu,
}

impl FailureKind {
    /// The process's exit code: 1 check failed, 2 usage or bad input, 3 device, 4 no GPU. (0 is success.)
    pub const fn exit_code(self) -> u8 {
        match self {
            Self::CheckFailed => 1,
            Self::BadInput => 2,
            Self::Device => 3,
            Self::NoGpu => 4,
        }
    }
}

/// Why a command did not do what it was asked to do.
#[derive(Debug)]
pub struct Failure {
    /// What can be done about it.
    pub kind: FailureKind,
    /// What failed, on which object, and the next step. May have several lines.
    pub message: String,
}

impl Failure {
    /// A failure of `kind`.
    pub fn new(kind: FailureKind, message: impl fmt::Display) -> Self {
        Self { kind, message: message.to_string() }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Failure {}

/// The result of a command that has something to report, whether or not it succeeded.
#[derive(Debug)]
pub struct Ended<T> {
    /// What the command found. It is printed in any case.
    pub report: T,
    /// Why the command fails nevertheless: a check that does not hold, or a file that could not be written.
    pub failure: Option<Failure>,
}

impl<T> Ended<T> {
    /// Adds `failure` to earlier ones. The first failure determines the kind; the messages of all are kept.
    pub(crate) fn fail(&mut self, failure: Failure) {
        match &mut self.failure {
            Some(first) => {
                first.message.push('\n');
                first.message += &failure.message;
            }
            none => *none = Some(failure),
        }
    }

    /// Returns the value of `result`. If it is a failure, adds it to the earlier ones and returns `None`.
    pub fn keep<R>(&mut self, result: Result<R, Failure>) -> Option<R> {
        result.map_err(|e| self.fail(e)).ok()
    }
}

impl<T> From<T> for Ended<T> {
    fn from(report: T) -> Self {
        Self { report, failure: None }
    }
}

impl From<dpm_device::tracker::record::RecordError> for Failure {
    fn from(e: dpm_device::tracker::record::RecordError) -> Self {
        use dpm_device::tracker::record::RecordError;
        use std::io::ErrorKind as K;
        let RecordError::Io { source, .. } = &e else { return Self::new(FailureKind::BadInput, e) };
        match source.kind() {
            K::AlreadyExists => Self::new(
                FailureKind::BadInput,
                format!("{e}; recordings are not overwritten: choose another name"),
            ),
            K::NotFound | K::PermissionDenied | K::IsADirectory | K::NotADirectory => Self::new(
                FailureKind::BadInput,
                format!("{e}; choose a folder that is there and may be written to"),
            ),
            _ => Self::new(FailureKind::Device, e),
        }
    }
}

impl From<dpm_common::keys::ConfigErrors> for Failure {
    fn from(errors: dpm_common::keys::ConfigErrors) -> Self {
        Self::new(FailureKind::BadInput, errors)
    }
}
