//! Copies the scheduling of a frame thread to the thread that waits for its replies: stamps are only as precise as the
//! scheduling of the thread that takes them.
#![allow(unsafe_code)]

use std::os::unix::thread::JoinHandleExt;
use std::thread::JoinHandle;

use crate::time::HostTime;

/// Interval between checks of the caller's scheduling.
const EVERY_NS: i64 = 500_000_000;

/// Gives a helper thread the scheduling of the thread that it works for.
#[derive(Debug)]
pub(super) struct Follower {
    looked_at: HostTime,
    given: Option<(i32, i32)>,
}

impl Follower {
    pub(super) const fn new() -> Self {
        Self { looked_at: HostTime(i64::MIN), given: None }
    }

    /// Gives `thread` the policy and priority of the calling thread. Checks twice a second, and changes something only
    /// if they have changed. A refusal is not an error: the thread keeps its scheduling, and stamps arrive later.
    pub(super) fn follow<T>(&mut self, now: HostTime, thread: &JoinHandle<T>) {
        if self.looked_at.0 != i64::MIN && now.ns_since(self.looked_at) < EVERY_NS {
            return;
        }
        self.looked_at = now;
        let (mut policy, mut param) = (0, libc::sched_param { sched_priority: 0 });
        // SAFETY: the first call writes two plain values of the calling thread. The thread of the second has not been joined or
        // detached, because its handle is borrowed here, so its identifier is valid even when it has ended.
        unsafe {
            if libc::pthread_getschedparam(libc::pthread_self(), &mut policy, &mut param) != 0
                || self.given == Some((policy, param.sched_priority))
            {
                return;
            }
            let _ = libc::pthread_setschedparam(thread.as_pthread_t() as libc::pthread_t, policy, &param);
        }
        self.given = Some((policy, param.sched_priority));
    }
}
