//! An order is kept whatever else fills the disk: a disk in memory whose operations fail.

use super::identity_tests::backend;
use super::*;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// A disk, shared by its clones.
#[derive(Clone, Debug, Default)]
pub(super) struct Disk(Arc<Mutex<Inner>>);

#[derive(Debug, Default)]
struct Inner {
    files: BTreeMap<String, Vec<u8>>,
    /// Operations so far.
    operations: usize,
    /// From this operation on, no byte is free.
    full_from: Option<usize>,
    /// This operation fails, and may leave a mixture where it writes over a file.
    fails: Option<usize>,
}

fn error(code: i32) -> FolderError {
    FolderError::Io { path: "/disk".into(), source: io::Error::from_raw_os_error(code) }
}

fn projector() -> Identity {
    Identity::of(&backend("{ kind = \"usb\", serial_number = \"A\" }"))
}

impl Disk {
    /// A start of the program on it.
    fn start(&self) -> (OrderFile, Option<FolderError>) {
        OrderFile::in_folder(Box::new(self.clone()), projector())
    }

    fn stands(&self) -> Option<Order> {
        standing_in_folder(self, &projector()).map(|stands| stands.order)
    }

    fn set(&self, change: impl FnOnce(&mut Inner)) {
        change(&mut self.0.lock().unwrap());
    }

    /// `work` is done on the files, unless this operation fails; it takes `more` bytes of the disk.
    fn operation(
        &self,
        more: impl FnOnce(&Inner) -> usize,
        work: impl FnOnce(&mut Inner, bool),
    ) -> Result<(), FolderError> {
        let mut inner = self.0.lock().unwrap();
        let number = inner.operations;
        inner.operations += 1;
        if inner.full_from.is_some_and(|from| number >= from) && more(&inner) > 0 {
            return Err(error(libc::ENOSPC));
        }
        let fails = inner.fails == Some(number);
        work(&mut inner, fails);
        if fails {
            Err(error(libc::EIO))
        } else {
            Ok(())
        }
    }
}

impl StateFolder for Disk {
    fn path(&self) -> &Path {
        Path::new("/disk")
    }

    fn names(&self) -> Result<Vec<String>, FolderError> {
        Ok(self.0.lock().unwrap().files.keys().cloned().collect())
    }

    fn read(&self, name: &str, most: u64) -> Result<Vec<u8>, FolderError> {
        let inner = self.0.lock().unwrap();
        let bytes = inner.files.get(name).ok_or_else(|| error(libc::ENOENT))?;
        if bytes.len() as u64 > most {
            Err(error(libc::EFBIG))
        } else {
            Ok(bytes.clone())
        }
    }

    fn replace(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        // The old content is given back only after the new one was written.
        self.operation(
            |_| bytes.len(),
            |inner, fails| {
                if !fails {
                    inner.files.insert(name.into(), bytes.into());
                }
            },
        )
    }

    fn overwrite(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        let length = self.read(name, u64::MAX)?.len();
        self.operation(
            |_| bytes.len().saturating_sub(length),
            |inner, fails| {
                let file = inner.files.get_mut(name).expect("it was read");
                let torn = if fails { bytes.len().min(100) } else { bytes.len() };
                file.resize(bytes.len(), 0);
                file[..torn].copy_from_slice(&bytes[..torn]);
            },
        )
    }

    fn rename(&self, from: &str, to: &str) -> Result<(), FolderError> {
        self.read(from, u64::MAX)?;
        self.operation(
            |_| 0,
            |inner, fails| {
                let file = inner.files.remove(from).expect("it was read");
                inner.files.insert(if fails { from } else { to }.into(), file);
            },
        )
    }

    fn remove(&self, name: &str) -> Result<(), FolderError> {
        self.operation(
            |_| 0,
            |inner, fails| {
                if !fails {
                    inner.files.remove(name);
                }
            },
        )
    }
}

/// Found in use, R4: the trial of the folder wrote an empty file, which a full disk takes.
#[test]
fn a_full_disk_is_refused_at_the_start() {
    let disk = Disk::default();
    disk.set(|disk| disk.full_from = Some(0));
    let (file, error) = disk.start();
    assert!(error.expect("refused").to_string().contains("No space left"));
    assert!(file.keep(Order::Safe, By::Key).is_err());
}

/// Wherever the disk fills up: either the start is refused, or every order after it is kept, lifted and kept again.
#[test]
fn a_disk_that_fills_up_after_the_start_keeps_every_order() {
    let (mut refused, mut kept) = (0, 0);
    for n in 0..40 {
        let disk = Disk::default();
        disk.set(|disk| disk.full_from = Some(n));
        let (file, error) = disk.start();
        if error.is_some() {
            refused += 1;
            continue;
        }
        for _ in 0..3 {
            for order in [Order::Black, Order::Safe] {
                file.keep(order, By::Key).unwrap_or_else(|e| panic!("full from {n}: {e}"));
                assert_eq!(disk.stands(), Some(order), "full from {n}");
            }
            file.forget().unwrap_or_else(|e| panic!("full from {n}: {e}"));
            assert_eq!(disk.stands(), None, "full from {n}");
        }
        kept += 1;
    }
    assert!(refused > 0 && kept > 20, "{refused} {kept}");
}

/// Whatever single operation fails: an order that was said to be kept stands, and one that stood is not forgotten for a
/// weaker one.
#[test]
fn a_write_that_fails_loses_no_order() {
    let count = {
        let disk = Disk::default();
        let (file, _) = disk.start();
        file.keep(Order::Black, By::Key).unwrap();
        file.keep(Order::Safe, By::Key).unwrap();
        file.forget().unwrap();
        let operations = disk.0.lock().unwrap().operations;
        operations
    };
    for n in 0..count {
        let disk = Disk::default();
        disk.set(|disk| disk.fails = Some(n));
        let (file, error) = disk.start();
        if error.is_some() {
            continue;
        }
        for order in [Order::Black, Order::Safe] {
            let before = disk.stands().map_or(0, Order::strength);
            let is_kept = file.keep(order, By::Key).is_ok();
            let after = disk.stands().map_or(0, Order::strength);
            assert!(after >= before && (!is_kept || after == order.strength()), "{n} {order:?}");
        }
        let is_lifted = file.forget().is_ok();
        assert!(disk.stands().is_none() || !is_lifted, "{n}");
    }
}
