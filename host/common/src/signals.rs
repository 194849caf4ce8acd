//! Turns signals and panics into the flags of [`crate::stopping`], and limits how long the process lives after
//! them.
//!
//! SIGINT, SIGTERM, SIGHUP and a panic request a stop. Every thread sees the request at once, the link's first of
//! all. A kernel timer then starts, whose signal ends the process whichever of its threads hangs. SIGUSR1 is BLACK
//! and SIGUSR2 is SAFE. No thread blocks any of these signals, so the kernel can deliver them to a thread that is not
//! stopped.
#![allow(unsafe_code)]

use crate::stopping;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::Once;
use std::time::Duration;

/// Signals that request an orderly stop. Supervisors send some of them twice, so the second one has no effect. The
/// third one ends the process at once (the projector's watchdog then makes it dark).
const STOPS: [libc::c_int; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];
/// Time from the first signal to the end of the process, microseconds: two seconds with a reserve for a busy machine.
const GONE_WITHIN_US: libc::suseconds_t = 800_000;
const GONE_WITHIN_S: libc::time_t = 1;
/// After SIGINT, a run that has ended in order (dark, all threads ended) may write its report and pictures. It is
/// checked this often, microseconds ...
const FILES_STEP_US: libc::suseconds_t = 200_000;
/// ... and at most this many times: ten seconds.
const FILES_STEPS: u32 = 50;
/// How often [`wait`] looks for a signal.
const LOOK: Duration = Duration::from_millis(50);
/// Exit code after a panic, the same as Rust's own.
const PANIC_CODE: libc::c_int = 101;

/// The timer is running.
static COUNTING: AtomicBool = AtomicBool::new(false);
/// How often the timer was extended for files.
static EXTENDED: AtomicU32 = AtomicU32::new(0);

extern "C" fn on_stop(signal: libc::c_int) {
    if stopping::note_signal(signal) >= 2 {
        // SAFETY: _exit is async-signal-safe and does not return.
        unsafe { libc::_exit(128 + signal) }
    }
    start_timer(GONE_WITHIN_S, GONE_WITHIN_US);
}

extern "C" fn on_order(signal: libc::c_int) {
    stopping::note_order(if signal == libc::SIGUSR1 { stopping::BLACK } else { stopping::SAFE });
}

extern "C" fn on_timer(_: libc::c_int) {
    const TOLD: &str =
        "error: the rig did not end in time after it was asked to stop; the process ends now, \
                        the projector goes dark by its watchdog\n";
    // A person at the terminal waits for files, or presses the key twice more. A supervisor does not wait.
    let waits = stopping::signal() == Some(libc::SIGINT) && stopping::is_writing_files();
    if waits && EXTENDED.fetch_add(1, Ordering::SeqCst) < FILES_STEPS {
        return set_timer(0, FILES_STEP_US);
    }
    let code = stopping::signal().map_or(PANIC_CODE, |signal| 128 + signal);
    let mut stderr = libc::pollfd { fd: libc::STDERR_FILENO, events: libc::POLLOUT, revents: 0 };
    // SAFETY: poll, write and _exit are async-signal-safe; the arguments outlive the calls. poll first checks that
    // there is room, because a pipe without a reader or a stopped terminal would block the last code that still
    // works.
    unsafe {
        if libc::poll(&raw mut stderr, 1, 0) == 1 && stderr.revents & libc::POLLOUT != 0 {
            libc::write(libc::STDERR_FILENO, TOLD.as_ptr().cast(), TOLD.len());
        }
        libc::_exit(code)
    }
}

/// Starts the timer that ends the process, unless it is running. May be called from a signal handler.
fn start_timer(seconds: libc::time_t, microseconds: libc::suseconds_t) {
    if COUNTING.swap(true, Ordering::SeqCst) {
        return;
    }
    set_timer(seconds, microseconds);
}

fn set_timer(seconds: libc::time_t, microseconds: libc::suseconds_t) {
    let none = libc::timeval { tv_sec: 0, tv_usec: 0 };
    let timer = libc::itimerval {
        it_interval: none,
        it_value: libc::timeval { tv_sec: seconds, tv_usec: microseconds },
    };
    // SAFETY: the timer outlives the call. setitimer is a bare system call, which a handler may make, and valid
    // values never fail.
    unsafe { libc::setitimer(libc::ITIMER_REAL, &raw const timer, std::ptr::null_mut()) };
}

/// Installs the signal handlers and the panic hook. Interrupted system calls are restarted.
///
/// # Errors
/// An error of the operating system, which does not occur for these signals.
pub fn install() -> io::Result<()> {
    for signal in STOPS {
        handle(signal, on_stop as *const () as libc::sighandler_t)?;
    }
    for signal in [libc::SIGUSR1, libc::SIGUSR2] {
        handle(signal, on_order as *const () as libc::sighandler_t)?;
    }
    handle(libc::SIGALRM, on_timer as *const () as libc::sighandler_t)?;
    // Output or input from the background of a terminal must not stop the process, and with it the light.
    for signal in [libc::SIGTTOU, libc::SIGTTIN] {
        handle(signal, libc::SIG_IGN)?;
    }
    unblock()?;
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            // Dark first, because what follows writes to a stream, which may take time.
            if stopping::note_panic() {
                start_timer(GONE_WITHIN_S, GONE_WITHIN_US);
            }
            before(panic);
        }));
    });
    Ok(())
}

/// Ignores the signals that request a stop, for a process that must outlive the one for which they are meant.
///
/// # Errors
/// An error of the operating system, which does not occur for these signals.
pub fn ignore() -> io::Result<()> {
    STOPS.into_iter().try_for_each(|signal| handle(signal, libc::SIG_IGN))
}

fn handle(signal: libc::c_int, handler: libc::sighandler_t) -> io::Result<()> {
    // SAFETY: an all-zero sigaction is valid: no flags, an empty mask. The handlers touch only atomics and make only
    // async-signal-safe calls.
    let result = unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = handler;
        action.sa_flags = libc::SA_RESTART;
        libc::sigemptyset(&raw mut action.sa_mask);
        libc::sigaction(signal, &raw const action, std::ptr::null_mut())
    };
    if result != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(())
}

/// The parent process may have blocked signals, and threads inherit that. None of our signals may be blocked.
fn unblock() -> io::Result<()> {
    // SAFETY: the set is made by sigemptyset before it is used, and outlives the calls.
    let result = unsafe {
        let mut set: libc::sigset_t = std::mem::zeroed();
        libc::sigemptyset(&raw mut set);
        for signal in STOPS.into_iter().chain([libc::SIGUSR1, libc::SIGUSR2, libc::SIGALRM]) {
            libc::sigaddset(&raw mut set, signal);
        }
        libc::pthread_sigmask(libc::SIG_UNBLOCK, &raw const set, std::ptr::null_mut())
    };
    if result != 0 {
        return Err(io::Error::from_raw_os_error(result));
    }
    Ok(())
}

/// Waits until a signal requests a stop. For a thread whose program works on others.
pub fn wait() {
    while received().is_none() {
        std::thread::sleep(LOOK);
    }
}

/// The name of the signal that requested a stop; `None` if there was none.
pub fn received() -> Option<&'static str> {
    Some(match stopping::signal()? {
        libc::SIGINT => "SIGINT",
        libc::SIGTERM => "SIGTERM",
        _ => "SIGHUP",
    })
}
