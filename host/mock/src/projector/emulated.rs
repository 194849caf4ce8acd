//! The projector of a rig file: without faults, or with faults injected into its input.

use super::{FaultyProjector, MockConfig, MockProjector, Served};
use crate::faults::{FaultError, FaultPlan};
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};

impl Served for FaultyProjector {
    fn next_due(&self) -> Option<HostTime> {
        Self::next_due(self)
    }
}

/// A [`MockProjector`], with or without a [`FaultPlan`]. Without one there is no additional cost.
pub enum EmulatedProjector {
    /// Gets every packet unchanged.
    Sound(Box<MockProjector>),
    /// Gets the packets after the plan's faults.
    Faulty(Box<FaultyProjector>),
}

impl EmulatedProjector {
    /// A projector with the faults that `faults` names, in the mocks' notation; an empty text means none. Their times
    /// count from `start`; `seed` decides which packets they strike.
    ///
    /// # Errors
    /// The text is not a plan, or contains a fault that does not apply to a projector.
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
