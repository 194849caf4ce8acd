//! The simulated serial port, as the program sees it: beneath the product's own transport.

use crate::cable::Cable;
use crate::line::{Driver, HungUp};
use dpm_device::time::HostTime;
use dpm_device::transport::serial::{Arrivals, Ports, SerialSettings, SharedClock};
use serialport::{
    ClearBuffer, DataBits, Error, ErrorKind, FlowControl, Parity, Result, SerialPort, StopBits,
};
use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

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
        Ok(Box::new(SimPort(driver)))
    }

    fn arrivals(&mut self, _: &dyn SerialPort, _: &SharedClock) -> Option<Box<dyn Arrivals>> {
        Some(Box::new(SimArrivals(self.1.take()?)))
    }
}

/// Stands for the thread that reads the port.
struct SimArrivals(Driver);

impl Arrivals for SimArrivals {
    fn take(&mut self, _: HostTime, sink: &mut dyn FnMut(HostTime, &[u8])) -> Option<usize> {
        let mut taken = 0;
        loop {
            match self.0.read() {
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

/// The open port. What no program of this world asks for is absent.
struct SimPort(Driver);

impl io::Write for SimPort {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.0.write(bytes) {
            Ok(0) => Err(io::ErrorKind::WouldBlock.into()),
            Ok(n) => Ok(n),
            Err(HungUp) => Err(io::ErrorKind::BrokenPipe.into()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl io::Read for SimPort {
    fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
        // Whoever reads the port is `SimArrivals`.
        Err(io::ErrorKind::WouldBlock.into())
    }
}

fn absent<T>() -> Result<T> {
    Err(Error::new(ErrorKind::Unknown, "this port has no such thing"))
}

impl SerialPort for SimPort {
    fn bytes_to_write(&self) -> Result<u32> {
        match self.0.waiting() {
            Ok(n) => Ok(n as u32),
            Err(HungUp) => absent(),
        }
    }
    fn clear(&self, buffer: ClearBuffer) -> Result<()> {
        if buffer == ClearBuffer::Output {
            self.0.discard_output();
        }
        Ok(())
    }
    fn name(&self) -> Option<String> {
        None
    }
    fn baud_rate(&self) -> Result<u32> {
        absent()
    }
    fn data_bits(&self) -> Result<DataBits> {
        absent()
    }
    fn flow_control(&self) -> Result<FlowControl> {
        absent()
    }
    fn parity(&self) -> Result<Parity> {
        absent()
    }
    fn stop_bits(&self) -> Result<StopBits> {
        absent()
    }
    fn timeout(&self) -> Duration {
        Duration::ZERO
    }
    fn set_baud_rate(&mut self, _: u32) -> Result<()> {
        absent()
    }
    fn set_data_bits(&mut self, _: DataBits) -> Result<()> {
        absent()
    }
    fn set_flow_control(&mut self, _: FlowControl) -> Result<()> {
        absent()
    }
    fn set_parity(&mut self, _: Parity) -> Result<()> {
        absent()
    }
    fn set_stop_bits(&mut self, _: StopBits) -> Result<()> {
        absent()
    }
    fn set_timeout(&mut self, _: Duration) -> Result<()> {
        absent()
    }
    fn write_request_to_send(&mut self, _: bool) -> Result<()> {
        absent()
    }
    fn write_data_terminal_ready(&mut self, _: bool) -> Result<()> {
        absent()
    }
    fn read_clear_to_send(&mut self) -> Result<bool> {
        absent()
    }
    fn read_data_set_ready(&mut self) -> Result<bool> {
        absent()
    }
    fn read_ring_indicator(&mut self) -> Result<bool> {
        absent()
    }
    fn read_carrier_detect(&mut self) -> Result<bool> {
        absent()
    }
    fn bytes_to_read(&self) -> Result<u32> {
        absent()
    }
    fn try_clone(&self) -> Result<Box<dyn SerialPort>> {
        absent()
    }
    fn set_break(&self) -> Result<()> {
        absent()
    }
    fn clear_break(&self) -> Result<()> {
        absent()
    }
}
