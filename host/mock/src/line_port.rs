//! A serial port that stands on a line in memory: what the product's transport opens where no operating system has one.

use serialport::{
    ClearBuffer, DataBits, Error, ErrorKind, FlowControl, Parity, Result, SerialPort, StopBits,
};
use std::io;
use std::time::Duration;

/// What a line in memory does for a port. None of it waits.
pub trait Line: Send {
    /// Takes some bytes. Returns how many, 0 if none fit now.
    ///
    /// # Errors
    /// The line has ended.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize>;

    /// Gives bytes that have arrived. Returns how many, 0 if there are none now.
    ///
    /// # Errors
    /// The line has ended.
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize>;

    /// Bytes that were taken and are not on the line yet.
    ///
    /// # Errors
    /// The line has ended.
    fn waiting(&self) -> io::Result<usize>;

    /// Discards them, as far as the driver can.
    fn discard_output(&self);
}

/// A port on a [`Line`]. What `dpm` does not ask of a port is absent.
pub struct LinePort<L>(pub L);

fn at_once(n: usize) -> io::Result<usize> {
    match n {
        0 => Err(io::ErrorKind::WouldBlock.into()),
        n => Ok(n),
    }
}

impl<L: Line> io::Write for LinePort<L> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        at_once(self.0.write(bytes)?)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<L: Line> io::Read for LinePort<L> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        at_once(self.0.read(bytes)?)
    }
}

fn absent<T>() -> Result<T> {
    Err(Error::new(ErrorKind::Unknown, "this port has no such thing"))
}

impl<L: Line> SerialPort for LinePort<L> {
    fn bytes_to_write(&self) -> Result<u32> {
        Ok(self.0.waiting()? as u32)
    }
    fn clear(&self, buffer: ClearBuffer) -> Result<()> {
        if buffer == ClearBuffer::Output {
            self.0.discard_output();
        }
        Ok(())
    }
    fn timeout(&self) -> Duration {
        Duration::ZERO
    }
    fn set_timeout(&mut self, _: Duration) -> Result<()> {
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
