//! Keys pressed on the terminal of a run. b (black), f (freeze), s (safe) and a (arm) are orders; another key may
//! belong to the interlock.
#![allow(unsafe_code)]

/// The terminal at the standard input, in a mode that reads single keys without echo. Dropping this restores the
/// former mode. Signals remain signals.
pub(super) struct Keys {
    before: libc::termios,
}

/// True if this process is in the terminal's foreground. From the background, reading or setting the terminal would
/// stop the process.
fn is_in_foreground() -> bool {
    // SAFETY: both calls take plain numbers and fail with -1.
    unsafe { libc::tcgetpgrp(libc::STDIN_FILENO) == libc::getpgrp() }
}

impl Keys {
    /// `None` if the standard input is not a terminal, or another process is in its foreground.
    pub(super) fn new() -> Option<Self> {
        if !is_in_foreground() {
            return None;
        }
        // SAFETY: a zeroed termios is a valid place to write to; the calls check the descriptor.
        unsafe {
            let mut before: libc::termios = std::mem::zeroed();
            if libc::tcgetattr(libc::STDIN_FILENO, &mut before) != 0 {
                return None;
            }
            let mut raw = before;
            raw.c_lflag &= !(libc::ICANON | libc::ECHO);
            raw.c_cc[libc::VMIN] = 0;
            raw.c_cc[libc::VTIME] = 0;
            (libc::tcsetattr(libc::STDIN_FILENO, libc::TCSANOW, &raw) == 0).then_some(Self { before })
        }
    }

    /// The keys pressed since the last call, at most 16; never waits.
    pub(super) fn pressed(&mut self) -> impl Iterator<Item = u8> {
        let mut keys = [0u8; 16];
        let mut n = 0;
        if is_in_foreground() {
            // SAFETY: the buffer is as long as said. With VMIN and VTIME zero the call returns at once.
            let got = unsafe { libc::read(libc::STDIN_FILENO, keys.as_mut_ptr().cast(), keys.len()) };
            n = usize::try_from(got).unwrap_or(0);
        }
        keys.into_iter().take(n)
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        if is_in_foreground() {
            // SAFETY: `before` came from tcgetattr.
            unsafe { libc::tcsetattr(libc::STDIN_FILENO, libc::TCSANOW, &self.before) };
        }
    }
}
