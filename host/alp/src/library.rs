//! The vendor's library, opened at run time: the only place that calls foreign code.

// A C library has no safe interface.
#![allow(unsafe_code)]

use std::ffi::c_void;
use std::path::{Path, PathBuf};

use super::abi::{RawProgress, OK};
use super::error::AlpError;

/// Names of the libraries, the newest first. The loader looks for them where the system keeps its libraries.
const NAMES: [&str; 6] =
    ["libalp51.so", "libalp50.so", "libalp44.so", "libalp43.so", "libalp42.so", "libalp41.so"];

/// Declares the functions of the library, and opens it.
macro_rules! functions {
    ($($field:ident = $name:literal: fn($($argument:ty),*);)*) => {
        struct Functions {
            $($field: unsafe extern "C" fn($($argument),*) -> i32,)*
        }

        impl Functions {
            fn of(library: &libloading::Library, path: &Path) -> Result<Self, AlpError> {
                Ok(Self {
                    $($field: {
                        // SAFETY: the types are those of the vendor's interface on Linux (32 bits for every integer); the pointers are kept
                        // beside the library, which is never closed before them.
                        let found = unsafe { library.get(concat!($name, "\0").as_bytes()) };
                        *found.map_err(|_| AlpError::Function { path: path.to_owned(), function: $name })?
                    },)*
                })
            }
        }
    };
}

functions! {
    dev_alloc = "AlpDevAlloc": fn(i32, i32, *mut u32);
    dev_halt = "AlpDevHalt": fn(u32);
    dev_free = "AlpDevFree": fn(u32);
    dev_control = "AlpDevControl": fn(u32, i32, i32);
    dev_inquire = "AlpDevInquire": fn(u32, i32, *mut i32);
    seq_alloc = "AlpSeqAlloc": fn(u32, i32, i32, *mut u32);
    seq_free = "AlpSeqFree": fn(u32, u32);
    seq_control = "AlpSeqControl": fn(u32, u32, i32, i32);
    seq_timing = "AlpSeqTiming": fn(u32, u32, i32, i32, i32, i32, i32);
    seq_inquire = "AlpSeqInquire": fn(u32, u32, i32, *mut i32);
    seq_put = "AlpSeqPut": fn(u32, u32, i32, i32, *const c_void);
    proj_start = "AlpProjStart": fn(u32, u32);
    proj_halt = "AlpProjHalt": fn(u32);
    proj_control = "AlpProjControl": fn(u32, i32, i32);
    proj_inquire = "AlpProjInquire": fn(u32, i32, *mut i32);
    proj_inquire_ex = "AlpProjInquireEx": fn(u32, i32, *mut c_void);
}

/// The open library. A failed call answers the vendor's code. One thread at a time calls it: nothing says that it bears more.
pub(super) struct Library {
    functions: Functions,
    path: PathBuf,
    // After the functions, which point into it.
    _library: libloading::Library,
}

/// `Ok` for the vendor's success.
fn done(code: i32) -> Result<(), i32> {
    if code == OK {
        Ok(())
    } else {
        Err(code)
    }
}

impl Library {
    /// Opens the library at `path`, or the newest one that the system has.
    pub(super) fn open(path: Option<&Path>) -> Result<Self, AlpError> {
        let Some(path) = path else {
            let mut last = None;
            for name in NAMES {
                match Self::open(Some(Path::new(name))) {
                    Err(AlpError::Library { path, reason }) => last = last.or(Some((path, reason))),
                    opened => return opened,
                }
            }
            let (path, reason) = last.expect("there are names");
            return Err(AlpError::Library { path, reason });
        };
        // SAFETY: opening runs what the library does when it is loaded. The user has chosen to install and to name it.
        let library = unsafe { libloading::Library::new(path) }
            .map_err(|e| AlpError::Library { path: path.to_owned(), reason: e.to_string() })?;
        let functions = Functions::of(&library, path)?;
        Ok(Self { functions, path: path.to_owned(), _library: library })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn dev_alloc(&self, number: i32) -> Result<u32, i32> {
        let mut id = u32::MAX;
        // SAFETY: the pointer is to a local of the type that the call fills.
        done(unsafe { (self.functions.dev_alloc)(number, 0, &mut id) })?;
        Ok(id)
    }

    pub(super) fn dev_halt(&self, id: u32) -> Result<(), i32> {
        // SAFETY: integers only; a wrong identifier is answered with a code.
        done(unsafe { (self.functions.dev_halt)(id) })
    }

    pub(super) fn dev_free(&self, id: u32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.dev_free)(id) })
    }

    pub(super) fn dev_control(&self, id: u32, what: i32, value: i32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.dev_control)(id, what, value) })
    }

    pub(super) fn dev_inquire(&self, id: u32, what: i32) -> Result<i32, i32> {
        let mut value = 0;
        // SAFETY: the pointer is to a local of the type that the call fills.
        done(unsafe { (self.functions.dev_inquire)(id, what, &mut value) })?;
        Ok(value)
    }

    pub(super) fn seq_alloc(&self, id: u32, pictures: i32) -> Result<u32, i32> {
        let mut sequence = u32::MAX;
        // SAFETY: the pointer is to a local of the type that the call fills.
        done(unsafe { (self.functions.seq_alloc)(id, 1, pictures, &mut sequence) })?;
        Ok(sequence)
    }

    pub(super) fn seq_free(&self, id: u32, sequence: u32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.seq_free)(id, sequence) })
    }

    pub(super) fn seq_control(&self, id: u32, sequence: u32, what: i32, value: i32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.seq_control)(id, sequence, what, value) })
    }

    /// Illuminate time, delays and pulse are the device's defaults.
    pub(super) fn seq_timing(&self, id: u32, sequence: u32, picture_us: i32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.seq_timing)(id, sequence, 0, picture_us, 0, 0, 0) })
    }

    pub(super) fn seq_inquire(&self, id: u32, sequence: u32, what: i32) -> Result<i32, i32> {
        let mut value = 0;
        // SAFETY: the pointer is to a local of the type that the call fills.
        done(unsafe { (self.functions.seq_inquire)(id, sequence, what, &mut value) })?;
        Ok(value)
    }

    /// Writes `pictures` pictures from number `first` on. The sequence's format must be packed binary.
    ///
    /// # Panics
    /// When `bytes` are not whole pictures of `plane_bytes`.
    pub(super) fn seq_put(
        &self,
        id: u32,
        sequence: u32,
        first: i32,
        plane_bytes: usize,
        bytes: &[u8],
    ) -> Result<(), i32> {
        assert!(plane_bytes > 0 && bytes.len().is_multiple_of(plane_bytes), "whole pictures");
        let pictures = (bytes.len() / plane_bytes) as i32;
        // SAFETY: the library reads `pictures` pictures of the panel's size in the packed format, which `Alp` sets before it puts and of
        // which `plane_bytes` is the size; it keeps no pointer after the call.
        done(unsafe { (self.functions.seq_put)(id, sequence, first, pictures, bytes.as_ptr().cast()) })
    }

    pub(super) fn proj_start(&self, id: u32, sequence: u32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.proj_start)(id, sequence) })
    }

    pub(super) fn proj_halt(&self, id: u32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.proj_halt)(id) })
    }

    pub(super) fn proj_control(&self, id: u32, what: i32, value: i32) -> Result<(), i32> {
        // SAFETY: as for `dev_halt`.
        done(unsafe { (self.functions.proj_control)(id, what, value) })
    }

    pub(super) fn proj_inquire(&self, id: u32, what: i32) -> Result<i32, i32> {
        let mut value = 0;
        // SAFETY: the pointer is to a local of the type that the call fills.
        done(unsafe { (self.functions.proj_inquire)(id, what, &mut value) })?;
        Ok(value)
    }

    pub(super) fn proj_progress(&self, id: u32, what: i32) -> Result<RawProgress, i32> {
        let mut progress = RawProgress::default();
        let to = std::ptr::from_mut(&mut progress).cast();
        // SAFETY: the pointer is to a local of the struct that the call fills, without padding as the interface demands.
        done(unsafe { (self.functions.proj_inquire_ex)(id, what, to) })?;
        Ok(progress)
    }
}
