//! What the operating system grants a frame path: priority, cores, memory that stays, short sleeps; and how well it keeps its word.
//!
//! Every right is asked for, none is required. A refusal is one [`Refusal`] with the limit to set, for the caller to show once;
//! the rig runs on. [`os`] asks, [`standstill`] measures when the machine itself stood still.

pub mod os;
pub mod standstill;

use dpm_handoff::wake::WaitPolicy;

/// Time slice of a stage under the normal scheduler: the shortest that the kernel grants.
const SLICE_NS: u64 = 100_000;

/// What a stage's thread asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadRights {
    /// SCHED_FIFO priority, 1 to 99; 0 keeps the normal scheduler.
    pub priority: u32,
    /// Core to run on; `None` leaves it to the kernel.
    pub core: Option<u32>,
}

/// A right the kernel did not grant.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} was refused ({reason}): {remedy}")]
pub struct Refusal {
    /// What was asked for.
    pub what: String,
    /// The kernel's word.
    pub reason: String,
    /// The exact setting that grants it.
    pub remedy: String,
}

/// What a thread got.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Granted {
    /// SCHED_FIFO priority in force; 0 is the normal scheduler.
    pub priority: u32,
    /// Core it is bound to.
    pub core: Option<u32>,
    /// What was refused.
    pub refusals: Vec<Refusal>,
}

/// Asks for `rights` for the calling thread. Call once at the start of the thread: it allocates and makes system calls.
pub fn enter_frame_path(rights: ThreadRights) -> Granted {
    let mut granted = Granted::default();
    // Sleeps end within a microsecond instead of 50; needs no right and does nothing under SCHED_FIFO.
    if let Err(refusal) = os::set_timer_slack_ns(1) {
        granted.refusals.push(refusal);
    }
    if let Some(core) = rights.core {
        match os::pin_to_core(core) {
            Ok(()) => granted.core = Some(core),
            Err(refusal) => granted.refusals.push(refusal),
        }
    }
    if rights.priority > 0 {
        match os::set_fifo_priority(rights.priority) {
            Ok(()) => granted.priority = rights.priority,
            Err(refusal) => granted.refusals.push(refusal),
        }
    }
    if granted.priority == 0 {
        // The next best: stages need little at a time, and come before threads that do not say so. Where it is refused nothing is worse.
        let _ = os::set_slice_ns(SLICE_NS);
    }
    granted
}

/// How `stages` waiting threads should wait, given what the machine is and what was granted: the caller's wish if it has
/// one, else by the count of usable cores.
pub fn wait_policy(wish: Option<WaitPolicy>, stages: usize) -> WaitPolicy {
    wish.unwrap_or_else(|| WaitPolicy::for_machine(os::usable_cores(), stages))
}
