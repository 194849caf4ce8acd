//! What the operating system grants to the frame path: priority, cores, locked memory, short sleeps, cores that wake
//! at once; and how reliably it does.
//!
//! Every right is requested, and none is required. A refusal is one [`RightRefusal`] with the limit to set, which the
//! caller shows once; the rig continues to run. [`os`] requests for threads and memory, [`awake`] for idle cores,
//! [`standstill`] measures when the machine itself stood still, and [`starvation`] for how long threads waited for a core.

pub mod awake;
pub mod os;
pub mod standstill;
pub mod starvation;

use dpm_handoff::wake::WaitPolicy;

/// Time slice of a stage under the normal scheduler: the shortest that the kernel grants.
const SLICE_NS: u64 = 100_000;

/// The rights that a stage's thread requests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThreadRights {
    /// SCHED_FIFO priority, 1 to 99; 0 keeps the normal scheduler.
    pub priority: u32,
    /// Core to run on; `None` leaves it to the kernel.
    pub core: Option<u32>,
}

/// A right that the kernel did not grant.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} was refused ({reason}): {remedy}")]
pub struct RightRefusal {
    /// What was requested.
    pub what: String,
    /// The kernel's reason.
    pub reason: String,
    /// The exact setting that grants it.
    pub remedy: String,
}

/// The rights that a thread got.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Grant {
    /// SCHED_FIFO priority in force; 0 is the normal scheduler.
    pub priority: u32,
    /// Core it is bound to.
    pub core: Option<u32>,
    /// What was refused.
    pub refusals: Vec<RightRefusal>,
}

/// Requests `rights` for the calling thread. Call once at the start of the thread: it allocates and makes system
/// calls.
pub fn enter_frame_path(rights: ThreadRights) -> Grant {
    let mut granted = Grant::default();
    // Makes sleeps end within a microsecond instead of 50. Needs no right and has no effect under SCHED_FIFO.
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
        // The second-best option: stages need little time at once, and a short slice puts them before threads without
        // one. A refusal does no harm.
        let _ = os::set_slice_ns(SLICE_NS);
    }
    granted
}

/// How `stages` waiting threads should wait: as the caller wishes, or else according to the number of usable cores.
pub fn wait_policy(wish: Option<WaitPolicy>, stages: usize) -> WaitPolicy {
    wish.unwrap_or_else(|| WaitPolicy::for_machine(os::usable_cores(), stages))
}
