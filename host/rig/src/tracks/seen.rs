//! The bodies that the tracker has reported since the run began, whichever crew was at work.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

/// One flag for each tracked body.
#[derive(Debug)]
pub struct SeenBodies(Box<[AtomicBool]>);

impl SeenBodies {
    /// None of `bodies` bodies has been seen.
    pub fn new(bodies: usize) -> Self {
        Self((0..bodies).map(|_| AtomicBool::new(false)).collect())
    }

    /// The body was reported.
    pub(super) fn mark(&self, body: usize) {
        if let Some(seen) = self.0.get(body) {
            seen.store(true, Ordering::Relaxed);
        }
    }

    /// Whether it ever was.
    pub(super) fn has(&self, body: usize) -> bool {
        self.0.get(body).is_some_and(|seen| seen.load(Ordering::Relaxed))
    }
}

/// What the tracker says of bodies that it had not seen a second after its start.
#[derive(Debug)]
pub struct BlindBodies {
    /// The message, which names them all.
    pub told: String,
    /// Their numbers.
    pub(super) bodies: Vec<usize>,
    pub(super) seen: Arc<SeenBodies>,
}

impl BlindBodies {
    /// The message still holds: none of them was seen since.
    pub fn holds(&self) -> bool {
        !self.bodies.iter().any(|body| self.seen.has(*body))
    }
}
