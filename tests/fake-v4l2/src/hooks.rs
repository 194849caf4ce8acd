//! The C library's names that a program calls: what concerns a fake camera is served here, everything else goes straight to the
//! kernel.
#![allow(unsafe_code)]

use std::collections::BTreeMap;
use std::ffi::{c_char, c_int, c_ulong, c_void, CStr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use crate::device::OpenFile;
use crate::layout::Record;
use crate::world::{at, lock};

/// The system calls themselves. Calling the C library here would come back to us.
pub(crate) mod raw {
    use std::ffi::{c_char, c_int, c_long, c_ulong, c_void, CString};
    use std::os::unix::ffi::OsStrExt;
    use std::path::Path;

    pub(crate) fn open(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
        // SAFETY: the kernel checks the path.
        unsafe { libc::syscall(libc::SYS_openat, libc::AT_FDCWD, path, flags, mode) as c_int }
    }

    pub(crate) fn close(fd: c_int) -> c_int {
        // SAFETY: closing a descriptor touches no memory of ours.
        unsafe { libc::syscall(libc::SYS_close, fd) as c_int }
    }

    pub(crate) fn ioctl(fd: c_int, request: c_ulong, argument: *mut c_void) -> c_int {
        // SAFETY: passed through as the caller gave it.
        unsafe { libc::syscall(libc::SYS_ioctl, fd, request, argument) as c_int }
    }

    pub(crate) fn mmap(
        at: *mut c_void,
        bytes: usize,
        protection: c_int,
        flags: c_int,
        fd: c_int,
        offset: i64,
    ) -> *mut c_void {
        // SAFETY: passed through as the caller gave it.
        let got: c_long = unsafe { libc::syscall(libc::SYS_mmap, at, bytes, protection, flags, fd, offset) };
        got as *mut c_void
    }

    /// A small file, empty if it cannot be read.
    pub(crate) fn read(path: &Path) -> String {
        let Ok(path) = CString::new(path.as_os_str().as_bytes()) else { return String::new() };
        let fd = open(path.as_ptr(), libc::O_RDONLY | libc::O_CLOEXEC, 0);
        if fd < 0 {
            return String::new();
        }
        let mut bytes = vec![0u8; 1 << 14];
        // SAFETY: the buffer is as long as said.
        let n = unsafe { libc::syscall(libc::SYS_read, fd, bytes.as_mut_ptr(), bytes.len()) };
        close(fd);
        bytes.truncate(usize::try_from(n).unwrap_or(0));
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

fn fail(errno: c_int) -> c_int {
    // SAFETY: the C library's errno of this thread.
    unsafe { *libc::__errno_location() = errno };
    -1
}

/// One flag per descriptor below this number, so that `close`, `ioctl` and `mmap` on anything else take no lock.
const MOST_FDS: usize = 1 << 16;
static OURS: [AtomicBool; MOST_FDS] = [const { AtomicBool::new(false) }; MOST_FDS];
static FILES: Mutex<BTreeMap<c_int, Arc<OpenFile>>> = Mutex::new(BTreeMap::new());

fn is_ours(fd: c_int) -> bool {
    usize::try_from(fd).ok().and_then(|i| OURS.get(i)).is_some_and(|f| f.load(Ordering::Acquire))
}

fn file_of(fd: c_int) -> Option<Arc<OpenFile>> {
    lock(&FILES).get(&fd).cloned()
}

fn open_any(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    if path.is_null() {
        return raw::open(path, flags, mode);
    }
    // SAFETY: a path is a C string.
    let Some(camera) = at(unsafe { CStr::from_ptr(path) }.to_bytes()) else {
        return raw::open(path, flags, mode);
    };
    match OpenFile::open(camera, flags) {
        Err(errno) => fail(errno),
        Ok((file, fd)) => {
            lock(&FILES).insert(fd, file);
            if let Some(flag) = usize::try_from(fd).ok().and_then(|i| OURS.get(i)) {
                flag.store(true, Ordering::Release);
            }
            fd
        }
    }
}

/// Names every function below, so that the linker keeps them in a test binary.
pub(crate) fn keep_linked() {
    let names: [*const (); 8] = [
        open as *const (),
        open64 as *const (),
        openat as *const (),
        openat64 as *const (),
        ioctl as *const (),
        mmap as *const (),
        mmap64 as *const (),
        close as *const (),
    ];
    std::hint::black_box(names);
}

/// `open(2)`. The third argument of the C function is variadic; on the targets this runs on it arrives like a plain one.
#[no_mangle]
pub(crate) extern "C" fn open(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    open_any(path, flags, mode)
}

/// `open64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn open64(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    open_any(path, flags, mode)
}

fn openat_any(folder: c_int, path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    // SAFETY: a path is a C string; its first byte is there, be it the zero.
    if !path.is_null() && unsafe { *path } == b'/' as c_char {
        return open_any(path, flags, mode);
    }
    // SAFETY: the kernel checks descriptor and path.
    unsafe { libc::syscall(libc::SYS_openat, folder, path, flags, mode) as c_int }
}

/// `openat(2)`; variadic like `open`.
#[no_mangle]
pub(crate) extern "C" fn openat(folder: c_int, path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    openat_any(folder, path, flags, mode)
}

/// `openat64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn openat64(folder: c_int, path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    openat_any(folder, path, flags, mode)
}

/// `ioctl(2)`; variadic like `open`.
#[no_mangle]
pub(crate) extern "C" fn ioctl(fd: c_int, request: c_ulong, argument: *mut c_void) -> c_int {
    if !is_ours(fd) {
        return raw::ioctl(fd, request, argument);
    }
    let Some(file) = file_of(fd) else { return fail(libc::EBADF) };
    let Some((number, bytes)) = crate::layout::request(request as u32) else { return fail(libc::ENOTTY) };
    // SAFETY: the number of the request says how large the struct is that the program passes.
    let mut record = unsafe { Record::new(argument, bytes as usize) };
    match file.request((number, bytes), &mut record) {
        Ok(()) => 0,
        Err(errno) => fail(errno),
    }
}

fn mmap_any(
    at: *mut c_void,
    bytes: usize,
    protection: c_int,
    flags: c_int,
    fd: c_int,
    offset: i64,
) -> *mut c_void {
    if !is_ours(fd) {
        return raw::mmap(at, bytes, protection, flags, fd, offset);
    }
    match file_of(fd).and_then(|file| file.memory(offset, bytes)) {
        Some(memory) => raw::mmap(at, bytes, protection, flags, memory, 0),
        None => {
            fail(libc::EINVAL);
            libc::MAP_FAILED
        }
    }
}

/// `mmap(2)`: a buffer of a camera is memory of its own.
#[no_mangle]
pub(crate) extern "C" fn mmap(
    at: *mut c_void,
    bytes: usize,
    protection: c_int,
    flags: c_int,
    fd: c_int,
    offset: i64,
) -> *mut c_void {
    mmap_any(at, bytes, protection, flags, fd, offset)
}

/// `mmap64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn mmap64(
    at: *mut c_void,
    bytes: usize,
    protection: c_int,
    flags: c_int,
    fd: c_int,
    offset: i64,
) -> *mut c_void {
    mmap_any(at, bytes, protection, flags, fd, offset)
}

/// `close(2)`.
#[no_mangle]
pub(crate) extern "C" fn close(fd: c_int) -> c_int {
    if is_ours(fd) {
        OURS[fd as usize].store(false, Ordering::Release);
        let file = lock(&FILES).remove(&fd);
        if let Some(file) = file {
            file.close();
        }
    }
    raw::close(fd)
}
