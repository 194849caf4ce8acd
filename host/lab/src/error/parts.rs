//! What is measured of one method into a file, until its group is complete: a run that is stopped loses one method at most.

use super::plan::file_word;
use super::runs::ErrorRow;
use dpm_common::files::write_atomically;
use dpm_device::regular_file;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Where a method's part of a group lies.
#[derive(Clone, Debug)]
pub(super) struct GroupShare {
    path: PathBuf,
}

/// The file. Colours as bits: a probe that was never lit is NaN, which JSON does not know.
#[derive(Serialize, Deserialize)]
struct PartFile {
    row: ErrorRow,
    eye: Vec<[u32; 3]>,
}

/// Largest part that is read, bytes.
const MAX_PART_BYTES: u64 = 4 << 30;

impl GroupShare {
    /// That of method `name` in the group with this key.
    pub(super) fn new(cache: &Path, key: &str, name: &str) -> Self {
        Self { path: cache.join(format!("part-{key}-{}.json", file_word(name))) }
    }

    /// The row, and what the eye saw at each of `probes`. `None` when nothing is there that fits.
    pub(super) fn read(&self, probes: usize) -> Option<(ErrorRow, Vec<Vec3>)> {
        let kept: PartFile =
            serde_json::from_slice(&regular_file::read(&self.path, MAX_PART_BYTES).ok()?).ok()?;
        let eye: Vec<Vec3> = kept.eye.into_iter().map(|v| Vec3::from(v.map(f32::from_bits))).collect();
        (eye.len() == probes).then_some((kept.row, eye))
    }

    /// Keeps them.
    ///
    /// # Errors
    /// The file system's.
    pub(super) fn write(&self, (row, eye): &(ErrorRow, Vec<Vec3>)) -> io::Result<()> {
        let eye = eye.iter().map(|v| v.to_array().map(f32::to_bits)).collect();
        let bytes = serde_json::to_vec(&PartFile { row: row.clone(), eye })?;
        write_atomically(&self.path, |out| out.write_all(&bytes))
    }

    /// Removes the file. That it stays when this fails does no harm: its key fits nothing else.
    pub(super) fn remove(&self) {
        let _ = std::fs::remove_file(&self.path);
    }
}
