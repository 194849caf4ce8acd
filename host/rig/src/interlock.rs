//! An external permission for light: a process that lives, a contact that is closed, a key that is held down.
//!
//! A thread of its own asks every few milliseconds and records when it last got a "yes". Light depends on
//! [`Interlock::is_closed`], which costs one atomic read and the clock. The interlock is open after a "no", and
//! equally when its thread hangs, fails or ends. When it opens, the projector goes BLACK at once. When it closes,
//! light returns unless the operator ordered otherwise; where it is reset by hand, not before ARM. docs/SAFETY.md says
//! what it is good for.

mod contacts;

use crate::config::{InterlockConfig, Restart};
use crate::failure::{Failure, FailureKind};
use dpm_common::clock::{Clock, MonotonicClock};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// How often the contact is asked.
pub const ASK_EVERY: Duration = Duration::from_millis(5);
/// A "yes" older than this does not count, because the asking thread has fallen silent.
pub const SILENCE_NS: i64 = 100_000_000;
/// Earlier than any instant of the clock.
const NEVER: i64 = i64::MIN / 2;

/// What decides whether there may be light.
pub trait Contact: Send {
    /// True while light is permitted. Errors and doubts are `false`. Should return within milliseconds; otherwise the
    /// light goes off after [`SILENCE_NS`].
    fn is_closed(&mut self) -> bool;
}

/// What the asking thread shares with all others.
#[derive(Debug)]
struct InterlockState {
    clock: Arc<dyn Clock>,
    /// When the contact was last found closed; [`NEVER`] since it was found open.
    closed_at: AtomicI64,
    /// It was found open since it was reset.
    has_opened: AtomicBool,
    keys: HeldKey,
    stop: AtomicBool,
}

impl InterlockState {
    fn new(clock: Arc<dyn Clock>, release_ms: u32) -> Arc<Self> {
        Arc::new(Self {
            clock,
            closed_at: AtomicI64::new(NEVER),
            has_opened: AtomicBool::new(false),
            keys: HeldKey {
                at: AtomicI64::new(NEVER),
                repeats: AtomicBool::new(false),
                release_ns: i64::from(release_ms) * 1_000_000,
            },
            stop: AtomicBool::new(false),
        })
    }
}

/// The side that asks the contact.
pub struct Asking {
    shared: Arc<InterlockState>,
    contact: Box<dyn Contact>,
}

impl Asking {
    /// Asks once. The interlock opens by itself if this is not done for [`SILENCE_NS`].
    pub fn ask(&mut self) {
        let before = self.shared.clock.now().0;
        // The time before asking counts: an answer that took long is already old.
        let at = if self.contact.is_closed() { before } else { NEVER };
        self.shared.closed_at.store(at, Ordering::SeqCst);
        if at == NEVER {
            self.shared.has_opened.store(true, Ordering::SeqCst);
        }
    }
}

/// A key of a terminal, which auto-repeats while it is held.
#[derive(Debug)]
struct HeldKey {
    /// When it was last received.
    at: AtomicI64,
    /// It was received at least twice, each time soon after the previous time.
    repeats: AtomicBool,
    release_ns: i64,
}

impl HeldKey {
    fn pressed(&self, now: i64) {
        let before = self.at.swap(now, Ordering::AcqRel);
        self.repeats.store(now - before <= self.release_ns, Ordering::Release);
    }

    fn is_held(&self, now: i64) -> bool {
        self.repeats.load(Ordering::Acquire) && now - self.at.load(Ordering::Acquire) <= self.release_ns
    }
}

/// An interlock and the thread that asks its contact. The thread ends when this is dropped.
#[derive(Debug)]
pub struct Interlock {
    shared: Arc<InterlockState>,
    key: Option<u8>,
    what: String,
    reset: Restart,
    thread: Option<JoinHandle<()>>,
}

impl Interlock {
    /// The interlock of a rig file; `None` if it has none. Returns when its contact was asked once, or did not answer
    /// in time. `has_keys`: keys of the terminal will be passed to [`Interlock::key_pressed`].
    ///
    /// # Errors
    /// The rig file names a key but there is no terminal; or the system cannot start a thread.
    pub fn of_config(config: &InterlockConfig, has_keys: bool) -> Result<Option<Self>, Failure> {
        let bad = |text: &str| Failure::new(FailureKind::BadInput, text);
        let (what, key, release_ms) = match config {
            InterlockConfig::None(_) => return Ok(None),
            InterlockConfig::Process(p) => match (&p.name, &p.pid_file) {
                (Some(name), _) => (format!("process {name:?}"), None, 0),
                (None, Some(file)) => (format!("process of {}", file.display()), None, 0),
                (None, None) => return Err(bad("safety.interlock names no process")),
            },
            InterlockConfig::Line(l) => match (&l.port, &l.file) {
                (Some(port), _) => (format!("{} of {port}", l.signal.word().to_uppercase()), None, 0),
                (None, Some(file)) => (format!("\"1\" in {}", file.display()), None, 0),
                (None, None) => return Err(bad("safety.interlock names no line")),
            },
            InterlockConfig::Key(k) => {
                if !has_keys {
                    return Err(bad(
                        "safety.interlock.kind = \"key\": there is no terminal whose key could be held down; start the run from a terminal, in its \
                         foreground, or use kind = \"process\" or \"line\"",
                    ));
                }
                let key = k.key.bytes().next().unwrap_or(b' ');
                (format!("key {:?} held down", char::from(key)), Some(key), k.release_ms)
            }
        };
        let interlock = Self::start(what, key, release_ms, |shared| contacts::of(config, shared))?;
        Ok(Some(interlock.reset_by(config.reset())))
    }

    /// The same interlock, which lets light return as `reset` says after it has opened.
    #[must_use]
    pub fn reset_by(mut self, reset: Restart) -> Self {
        self.reset = reset;
        self
    }

    /// An interlock that asks `contact`; `what` is its name in messages.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub fn with_contact(what: &str, contact: impl Contact + 'static) -> Result<Self, Failure> {
        Self::start(what.to_owned(), None, 0, |_| Box::new(contact))
    }

    /// The same without a thread: whoever moves `clock` asks the contact every few milliseconds.
    pub fn stepped(what: &str, clock: Arc<dyn Clock>, contact: impl Contact + 'static) -> (Self, Asking) {
        let shared = InterlockState::new(clock, 0);
        let asking = Asking { shared: shared.clone(), contact: Box::new(contact) };
        (Self { shared, key: None, what: what.to_owned(), reset: Restart::ByItself, thread: None }, asking)
    }

    fn start(
        what: String,
        key: Option<u8>,
        release_ms: u32,
        contact: impl FnOnce(&Arc<InterlockState>) -> Box<dyn Contact>,
    ) -> Result<Self, Failure> {
        let shared = InterlockState::new(Arc::new(MonotonicClock::new(0)), release_ms);
        let mut asking = Asking { contact: contact(&shared), shared: shared.clone() };
        let (asked, first) = crossbeam::channel::unbounded();
        let thread = std::thread::Builder::new()
            .name("dpm-interlock".into())
            .spawn(move || {
                // A panic of the contact ends the thread, and with it the light.
                while !asking.shared.stop.load(Ordering::Relaxed) {
                    asking.ask();
                    let _ = asked.send(());
                    std::thread::sleep(ASK_EVERY);
                }
            })
            .map_err(|e| {
                Failure::new(FailureKind::Device, format!("cannot start the interlock's thread: {e}"))
            })?;
        let _ = first.recv_timeout(Duration::from_millis(200));
        Ok(Self { shared, key, what, reset: Restart::ByItself, thread: Some(thread) })
    }

    /// True while light is permitted: the contact was found closed within the last [`SILENCE_NS`], and it needs no
    /// reset. Never waits.
    pub fn is_closed(&self) -> bool {
        let is_closed = self.contact_is_closed();
        if !is_closed {
            self.shared.has_opened.store(true, Ordering::SeqCst);
        }
        is_closed && !self.awaits_reset()
    }

    fn contact_is_closed(&self) -> bool {
        self.shared.clock.now().0 - self.shared.closed_at.load(Ordering::SeqCst) <= SILENCE_NS
    }

    /// True if it has opened, and permits no light until it is reset by hand.
    pub fn awaits_reset(&self) -> bool {
        self.reset == Restart::ByHand && self.shared.has_opened.load(Ordering::SeqCst)
    }

    /// A person wants light again. While the contact is open this resets nothing.
    pub fn reset(&self) {
        // In this order, an opening meanwhile is not lost.
        self.shared.has_opened.store(false, Ordering::SeqCst);
        if !self.contact_is_closed() {
            self.shared.has_opened.store(true, Ordering::SeqCst);
        }
    }

    /// The condition for light, for messages: `process "laser-guard"`.
    pub fn what(&self) -> &str {
        &self.what
    }

    /// A key was pressed on the terminal. Returns `true` if it is the interlock's key.
    pub fn key_pressed(&self, key: u8) -> bool {
        let ours = self.key == Some(key);
        if ours {
            self.shared.keys.pressed(self.shared.clock.now().0);
        }
        ours
    }
}

impl Drop for Interlock {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        // A thread that hangs in its contact is left behind until the process ends.
        if let Some(thread) = self.thread.take().filter(|t| {
            let deadline = std::time::Instant::now() + Duration::from_millis(200);
            while !t.is_finished() && std::time::Instant::now() < deadline {
                std::thread::sleep(Duration::from_millis(1));
            }
            t.is_finished()
        }) {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests;
