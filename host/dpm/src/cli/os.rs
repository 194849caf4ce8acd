//! Access rights to files, as the kernel sees them rather than guessed from mode bits; free space; and an end of the
//! process that waits for nothing.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

/// True when the process may read and write `path`.
pub(crate) fn may_read_and_write(path: &Path) -> bool {
    let Ok(path) = CString::new(path.as_os_str().as_bytes()) else { return false };
    // SAFETY: a NUL-terminated string that outlives the call.
    unsafe { libc::access(path.as_ptr(), libc::R_OK | libc::W_OK) == 0 }
}

/// Bytes that the user of this process may still write to the file system of `path`; `None` where it does not say.
pub(crate) fn free_bytes(path: &Path) -> Option<u64> {
    let path = CString::new(path.as_os_str().as_bytes()).ok()?;
    let mut stat = std::mem::MaybeUninit::<libc::statvfs>::zeroed();
    // SAFETY: a NUL-terminated string and a place for the answer, both of which outlive the call.
    let told = unsafe { libc::statvfs(path.as_ptr(), stat.as_mut_ptr()) };
    // SAFETY: all of it was zeroed, and the call succeeded.
    let stat = (told == 0).then(|| unsafe { stat.assume_init() })?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Makes the system send SIGTERM to the process that `command` starts when the thread that starts it ends, however that
/// ends.
pub(super) fn end_with_this_thread(command: &mut Command) {
    // SAFETY: between fork and exec it makes one system call with plain numbers.
    unsafe {
        command.pre_exec(|| match libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGTERM) {
            0 => Ok(()),
            _ => Err(std::io::Error::last_os_error()),
        })
    };
}

/// Ends the process at once, without destructors, whatever its other threads do.
pub(super) fn leave(code: u8) -> ! {
    // SAFETY: _exit does not return and runs nothing of this process.
    unsafe { libc::_exit(i32::from(code)) }
}
