//! The machine's monotonic clock as a number that other programs can read too.
#![allow(unsafe_code)]

/// CLOCK_MONOTONIC now, nanoseconds: the clock of [`std::time::Instant`], with the epoch that all programs of the
/// machine share.
pub fn now_ns() -> i64 {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: writes one plain value that lives for the call; the clock exists on every Linux.
    let rc = unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut t) };
    debug_assert_eq!(rc, 0, "CLOCK_MONOTONIC exists");
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}
