//! Calibration files on the disk.

use super::{CalibrationFile, Wrong};
use dpm_common::files::{keep_old, write_atomically};
use dpm_device::regular_file;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Largest accepted file.
pub const MAX_BYTES: u64 = 4 << 20;

/// Why a file cannot be read or written.
#[derive(Debug, Error)]
pub enum FileError {
    /// Of the file system.
    #[error("calibration file {}: {source}", .path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// Not TOML, or with keys that are missing or unknown.
    #[error("calibration file {}: {message}", .path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The parser's words, with line and column.
        message: String,
    },
    /// A number that cannot be.
    #[error("calibration file {}: {wrong}; calibrate again, or correct it", .path.display())]
    Wrong {
        /// The file.
        path: PathBuf,
        /// Key and reason.
        wrong: Wrong,
    },
}

/// Reads a file.
///
/// # Errors
/// Each reason of [`FileError`].
pub fn load(path: &Path) -> Result<CalibrationFile, FileError> {
    let io = |source| FileError::Io { path: path.into(), source };
    let bytes = regular_file::read(path, MAX_BYTES).map_err(io)?;
    let text = String::from_utf8(bytes)
        .map_err(|e| io(io::Error::new(io::ErrorKind::InvalidData, e.to_string())))?;
    parse(&text, path)
}

/// Reads the text of a file; `path` is its name in messages.
///
/// # Errors
/// [`FileError::Syntax`] and [`FileError::Wrong`].
pub fn parse(text: &str, path: &Path) -> Result<CalibrationFile, FileError> {
    let file: CalibrationFile = toml::from_str(text)
        .map_err(|e| FileError::Syntax { path: path.into(), message: e.to_string().trim().to_owned() })?;
    file.check().map_err(|wrong| FileError::Wrong { path: path.into(), wrong })?;
    Ok(file)
}

/// Writes a file. One of that name is kept beside it as `NAME.1.old`, `NAME.2.old` and so on; its new name is returned.
///
/// # Errors
/// Each reason of [`FileError`]; the old file is then unchanged.
pub fn save(file: &CalibrationFile, path: &Path) -> Result<Option<PathBuf>, FileError> {
    let io = |source| FileError::Io { path: path.into(), source };
    file.check().map_err(|wrong| FileError::Wrong { path: path.into(), wrong })?;
    let text =
        toml::to_string(file).map_err(|e| FileError::Syntax { path: path.into(), message: e.to_string() })?;
    let kept = keep_old(path, MAX_BYTES).map_err(io)?;
    write_atomically(path, |w| {
        w.write_all(
            b"# Written by dpm calibrate. Lengths in metres, pixels from the raster's upper left corner.\n",
        )?;
        w.write_all(text.as_bytes())
    })
    .map_err(io)?;
    Ok(kept)
}
