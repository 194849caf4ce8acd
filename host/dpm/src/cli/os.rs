//! Access rights to files, as the kernel sees them rather than guessed from mode bits; and an end of the process that
//! waits for nothing.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

/// True when the process may read and write `path`.
pub(crate) fn may_read_and_write(path: &Path) -> bool {
    let Ok(path) = CString::new(path.as_os_str().as_bytes()) else { return false };
    // SAFETY: a NUL-terminated string that outlives the call.
    unsafe { libc::access(path.as_ptr(), libc::R_OK | libc::W_OK) == 0 }
}

/// Ends the process at once, without destructors, whatever its other threads do.
pub(super) fn leave(code: u8) -> ! {
    // SAFETY: _exit does not return and runs nothing of this process.
    unsafe { libc::_exit(i32::from(code)) }
}
