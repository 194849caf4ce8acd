//! A projector as a rig file describes it: sound, or with faults injected into what it receives.

use super::{FaultyProjector, MockConfig, MockProjector};
use crate::faults::{FaultError, FaultPlan};
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};

/// A device that a cable can be served with: it says when it wants to live next.
pub trait Served: LinkDevice {
    /// When something happens next of which nobody tells it; `None` when nothing does.
    fn next_due(&self) -> Option<HostTime>;
}

impl Served for MockProjector {
    fn next_due(&self) -> Option<HostTime> {
        Self::next_due(self)
    }
}

impl Served for FaultyProjector {
    fn next_due(&self) -> Option<HostTime> {
        Self::next_due(self)
    }
}

/// A [`MockProjector`], with a [`FaultPlan`] or without: one without costs nothing more.
pub enum EmulatedProjector {
    /// Gets every packet as it was sent.
    Sound(Box<MockProjector>),
    /// Gets what the plan leaves of them.
    Faulty(Box<FaultyProjector>),
}

impl EmulatedProjector {
    /// A projector with the faults that `faults` names, in the mocks' notation; an empty text is none. Their times count from `start`; `seed` decides what they strike.
    ///
    /// # Errors
    /// The text is no plan, or has a fault that means nothing to a projector.
    pub fn new(setup: MockConfig, faults: &str, seed: u64, start: HostTime) -> Result<Self, FaultError> {
        let plan: FaultPlan = faults.parse()?;
        let projector = MockProjector::new(setup);
        if plan.is_empty() {
            return Ok(Self::Sound(Box::new(projector)));
        }
        Ok(Self::Faulty(Box::new(FaultyProjector::new(projector, plan, seed, start)?)))
    }

    /// The projector itself: its light, its state.
    pub fn projector(&mut self) -> &mut MockProjector {
        match self {
            Self::Sound(projector) => projector,
            Self::Faulty(faulty) => faulty.projector(),
        }
    }

    fn device(&mut self) -> &mut dyn LinkDevice {
        match self {
            Self::Sound(projector) => projector.as_mut(),
            Self::Faulty(faulty) => faulty.as_mut(),
        }
    }
}

impl Served for EmulatedProjector {
    fn next_due(&self) -> Option<HostTime> {
        match self {
            Self::Sound(projector) => projector.next_due(),
            Self::Faulty(faulty) => faulty.next_due(),
        }
    }
}

impl LinkDevice for EmulatedProjector {
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]) {
        self.device().receive(now, lane, bytes);
    }

    fn end_of_transfer(&mut self, now: HostTime, lane: Lane) {
        self.device().end_of_transfer(now, lane);
    }

    fn advance_to(&mut self, now: HostTime) {
        self.device().advance_to(now);
    }

    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) {
        self.device().replies(now, sink);
    }
}
