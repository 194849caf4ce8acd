//! The emulator as a driver's cable without USB, at virtual pace: time passes only while the driver waits.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use dpm_device::time::HostTime;
use dpm_dlpc900::command::REPORT_BYTES;
use dpm_dlpc900::driver::{HidPort, PortError, SecondLine};

use super::Dlpc900Model;

/// Time that one report takes, nanoseconds: full-speed HID polls every millisecond.
const REPORT_NS: i64 = 1_000_000;

/// A cable to an emulator in the same process.
#[derive(Clone)]
pub struct VirtualHid {
    model: Arc<Mutex<Dlpc900Model>>,
    now: HostTime,
}

impl VirtualHid {
    /// A cable that starts at instant 0.
    pub fn new(model: Arc<Mutex<Dlpc900Model>>) -> Self {
        Self::starting_at(model, HostTime(0))
    }

    /// A cable that is plugged in at instant `now`, for a controller that was used before.
    pub fn starting_at(model: Arc<Mutex<Dlpc900Model>>, now: HostTime) -> Self {
        Self { model, now }
    }

    /// The virtual instant reached.
    pub fn now(&self) -> HostTime {
        self.now
    }

    fn model(&self) -> std::sync::MutexGuard<'_, Dlpc900Model> {
        self.model.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl HidPort for VirtualHid {
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], _timeout: Duration) -> Result<(), PortError> {
        self.now = self.now.plus_ns(REPORT_NS);
        self.model().interrupt_out(self.now, 0x01, report);
        Ok(())
    }

    fn read_report(&mut self, report: &mut [u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        let next = self.model().interrupt_in(0x81);
        match next {
            Some(r) => {
                self.now = self.now.plus_ns(REPORT_NS);
                *report = r;
                Ok(())
            }
            None => {
                self.now = self.now.plus_ns(timeout.as_nanos() as i64);
                Err(PortError::Timeout)
            }
        }
    }

    fn pause(&mut self, time: Duration) {
        self.now = self.now.plus_ns(time.as_nanos() as i64);
    }

    fn now(&self) -> Duration {
        Duration::from_nanos(self.now.0.max(0).unsigned_abs())
    }

    fn second_line(&self) -> Option<Box<dyn SecondLine>> {
        Some(Box::new(self.clone()))
    }
}

impl SecondLine for VirtualHid {
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        HidPort::write_report(self, report, timeout)
    }
}
