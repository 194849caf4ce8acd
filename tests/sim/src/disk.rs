//! The disk that keeps standing orders: in memory, with faults.

use crate::cable::lock;
use crate::calls::Calls;
use dpm_common::folder::FolderError;
use dpm_rig::standing::StateFolder;
use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Content and faults of the disk.
#[derive(Debug, Default)]
pub struct Disk {
    files: BTreeMap<String, Vec<u8>>,
    /// Writing fails: the disk was mounted read-only.
    pub refuses: bool,
    /// Nothing that takes more bytes is written: the disk is full.
    pub is_full: bool,
    /// An order was refused because the disk is full.
    pub lost_order: bool,
    /// Calls to it.
    pub calls: Calls,
    /// How often the disk refused something, or was slow, but for single calls.
    pub met: u64,
    /// How much longer a write takes, nanoseconds.
    pub late_ns: i64,
}

impl Disk {
    /// A call: true if it is to fail.
    fn refuses(&mut self) -> bool {
        self.calls.fails() || self.refuses
    }

    /// The power fails while `name` is written: old or new content remains, never half of it; with `torn` a stray file
    /// of the writer remains too.
    pub fn tear(&mut self) {
        self.files.insert(".new-1-1".into(), b"{\"vers".to_vec());
    }
}

/// A folder of the disk.
#[derive(Clone, Debug)]
pub struct SimFolder(pub Arc<Mutex<Disk>>);

const PATH: &str = "/simulated/state";

fn refused(name: &str) -> FolderError {
    FolderError::Io { path: Path::new(PATH).join(name), source: io::Error::other("no space left on device") }
}

fn missing(name: &str) -> FolderError {
    FolderError::Io { path: Path::new(PATH).join(name), source: io::ErrorKind::NotFound.into() }
}

impl StateFolder for SimFolder {
    fn path(&self) -> &Path {
        Path::new(PATH)
    }

    fn names(&self) -> Result<Vec<String>, FolderError> {
        Ok(lock(&self.0).files.keys().cloned().collect())
    }

    fn read(&self, name: &str, most: u64) -> Result<Vec<u8>, FolderError> {
        let disk = lock(&self.0);
        let bytes = disk.files.get(name).filter(|bytes| bytes.len() as u64 <= most);
        bytes.cloned().ok_or_else(|| refused(name))
    }

    fn replace(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        let mut disk = lock(&self.0);
        disk.met += u64::from(disk.late_ns > 0);
        let refuses = disk.refuses();
        if refuses || disk.is_full {
            disk.met += 1;
            disk.lost_order |= !refuses && name.ends_with(".order");
            return Err(refused(name));
        }
        disk.files.insert(name.into(), bytes.into());
        Ok(())
    }

    fn overwrite(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        let mut disk = lock(&self.0);
        let (refuses, is_full) = (disk.refuses(), disk.is_full);
        disk.met += u64::from(refuses || is_full || disk.late_ns > 0);
        let file = disk.files.get_mut(name).ok_or_else(|| missing(name))?;
        if refuses || is_full && bytes.len() > file.len() {
            return Err(refused(name));
        }
        *file = bytes.into();
        Ok(())
    }

    fn rename(&self, from: &str, to: &str) -> Result<(), FolderError> {
        let mut disk = lock(&self.0);
        if disk.refuses() {
            disk.met += 1;
            return Err(refused(from));
        }
        let file = disk.files.remove(from).ok_or_else(|| missing(from))?;
        disk.files.insert(to.into(), file);
        Ok(())
    }

    fn remove(&self, name: &str) -> Result<(), FolderError> {
        let mut disk = lock(&self.0);
        if disk.refuses() {
            disk.met += 1;
            return Err(refused(name));
        }
        disk.files.remove(name);
        Ok(())
    }
}
