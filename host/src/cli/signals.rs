//! SIGINT, SIGTERM and SIGHUP into one flag that the main thread turns into an ordered stop.
#![allow(unsafe_code)]

use std::sync::atomic::{AtomicI32, AtomicU32, Ordering};

static COUNT: AtomicU32 = AtomicU32::new(0);
static LAST: AtomicI32 = AtomicI32::new(0);

/// Signals that ask for an ordered stop. Supervisors send some of them twice, so the second changes nothing; the third ends
/// the process on the spot (the projector's watchdog then makes it dark).
const SIGNALS: [libc::c_int; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];

extern "C" fn on_signal(signal: libc::c_int) {
    LAST.store(signal, Ordering::Relaxed);
    if COUNT.fetch_add(1, Ordering::Relaxed) >= 2 {
        // SAFETY: _exit is async-signal-safe and does not return.
        unsafe { libc::_exit(128 + signal) }
    }
}

/// Installs the handlers; a system call that is interrupted goes on by itself.
///
/// # Errors
/// The operating system's, which does not happen for these signals.
pub fn install() -> std::io::Result<()> {
    for signal in SIGNALS {
        // SAFETY: an all-zero sigaction is valid: no flags, an empty mask; the handler only touches atomics and _exit.
        let result = unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = on_signal as *const () as libc::sighandler_t;
            action.sa_flags = libc::SA_RESTART;
            libc::sigemptyset(&mut action.sa_mask);
            libc::sigaction(signal, &action, std::ptr::null_mut())
        };
        if result != 0 {
            return Err(std::io::Error::last_os_error());
        }
    }
    Ok(())
}

/// Ignores them: for a process that must outlive the one that they are meant for.
///
/// # Errors
/// The operating system's, which does not happen for these signals.
pub fn ignore() -> std::io::Result<()> {
    for signal in SIGNALS {
        // SAFETY: SIG_IGN is a valid disposition for each of them, and no handler of this process is lost that anybody relies on.
        if unsafe { libc::signal(signal, libc::SIG_IGN) } == libc::SIG_ERR {
            return Err(std::io::Error::last_os_error());
        }
    }
    Ok(())
}

/// The signal that asked for a stop, by name; `None` as long as none did.
pub fn received() -> Option<&'static str> {
    if COUNT.load(Ordering::Relaxed) == 0 {
        return None;
    }
    Some(match LAST.load(Ordering::Relaxed) {
        libc::SIGINT => "SIGINT",
        libc::SIGTERM => "SIGTERM",
        _ => "SIGHUP",
    })
}
