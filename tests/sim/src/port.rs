//! The simulated serial port, as the program sees it: beneath the product's own transport.

use crate::cable::Cable;
use crate::line::{Driver, HungUp};
use dpm_device::time::HostTime;
use dpm_device::transport::serial::{Arrivals, Ports, SerialSettings, SharedClock};
use hil_mock::line_port::LinePort;
use serialport::{Error, ErrorKind, Result, SerialPort};
use std::sync::{Arc, Mutex};

/// The machine's ports: there is one, at the end of the cable.
pub struct SimPorts(pub Arc<Mutex<Cable>>, Option<Driver>);

impl SimPorts {
    /// The ports of a machine with `cable`.
    pub fn new(cable: Arc<Mutex<Cable>>) -> Self {
        Self(cable, None)
    }
}

impl Ports for SimPorts {
    fn open(&mut self, _: &SerialSettings) -> Result<Box<dyn SerialPort>> {
        let driver = Driver::open(&self.0).map_err(|why| Error::new(ErrorKind::NoDevice, why))?;
        self.1 = Some(driver.clone());
        Ok(Box::new(LinePort(driver)))
    }

    fn arrivals(&mut self, _: &dyn SerialPort, _: &SharedClock) -> Option<Box<dyn Arrivals>> {
        Some(Box::new(SimArrivals(self.1.take()?)))
    }
}

/// Stands for the thread that reads the port; nobody else does.
struct SimArrivals(Driver);

impl Arrivals for SimArrivals {
    fn take(&mut self, _: HostTime, sink: &mut dyn FnMut(HostTime, &[u8])) -> Option<usize> {
        let mut taken = 0;
        loop {
            match self.0.next_piece() {
                Ok(Some((at, bytes))) => {
                    taken += bytes.len();
                    sink(HostTime(at), &bytes);
                }
                Ok(None) => return Some(taken),
                Err(HungUp) => return (taken > 0).then_some(taken),
            }
        }
    }
}
