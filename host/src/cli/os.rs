//! Questions to the operating system that need the C library: rights that are tried, not guessed.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::io;
use std::path::Path;

/// Tries to give a thread SCHED_FIFO priority 1. The thread ends at once, so nothing keeps the priority.
///
/// # Errors
/// What the kernel says, usually `EPERM`.
pub fn try_real_time() -> io::Result<()> {
    let attempt = std::thread::spawn(|| {
        // SAFETY: the parameter is a valid sched_param; pid 0 is the calling thread alone.
        let result = unsafe {
            let mut parameter: libc::sched_param = std::mem::zeroed();
            parameter.sched_priority = 1;
            libc::sched_setscheduler(0, libc::SCHED_FIFO, &parameter)
        };
        if result == 0 {
            Ok(())
        } else {
            Err(io::Error::last_os_error())
        }
    });
    attempt.join().unwrap_or_else(|_| Err(io::Error::other("the thread that tried it panicked")))
}

/// Tries to lock `bytes` of fresh memory, and unlocks them again.
///
/// # Errors
/// What the kernel says, usually `ENOMEM` or `EPERM` when beyond the limit.
pub fn try_lock_memory(bytes: usize) -> io::Result<()> {
    let memory = vec![0u8; bytes];
    // SAFETY: the range is exactly the vector's memory, which lives until after munlock; locking changes no contents.
    let result = unsafe { libc::mlock(memory.as_ptr().cast(), memory.len()) };
    if result != 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: as above.
    unsafe { libc::munlock(memory.as_ptr().cast(), memory.len()) };
    Ok(())
}

/// A resource limit's soft value; `None` is unlimited.
fn limit(resource: libc::__rlimit_resource_t) -> Option<u64> {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: `limit` is a valid place to write to.
    let result = unsafe { libc::getrlimit(resource, &mut limit) };
    if result != 0 || limit.rlim_cur == libc::RLIM_INFINITY {
        None
    } else {
        Some(limit.rlim_cur)
    }
}

/// Highest real-time priority that the limits grant; `None` is unlimited.
pub fn real_time_limit() -> Option<u64> {
    limit(libc::RLIMIT_RTPRIO)
}

/// Bytes of memory that the limits let the process lock; `None` is unlimited.
pub fn locked_memory_limit() -> Option<u64> {
    limit(libc::RLIMIT_MEMLOCK)
}

/// True when the process may read and write `path`.
pub fn may_read_and_write(path: &Path) -> bool {
    use std::os::unix::ffi::OsStrExt;
    let Ok(path) = CString::new(path.as_os_str().as_bytes()) else { return false };
    // SAFETY: a NUL-terminated string that outlives the call.
    unsafe { libc::access(path.as_ptr(), libc::R_OK | libc::W_OK) == 0 }
}
