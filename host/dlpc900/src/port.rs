//! The cable to a controller, and the second way to it by which another thread makes it dark.

use std::sync::{Arc, Mutex, OnceLock, TryLockError};
use std::time::{Duration, Instant};

use super::command::{Command, REPORT_BYTES};
use super::error::PortError;
use super::sequence::{self, Step};

/// Pause between two polls of the status while waiting, and the longest time until a stop is noticed during a wait.
pub(super) const POLL: Duration = Duration::from_millis(20);
/// How long a [`DarkLine`] waits for a pending command, so as not to disturb its reply.
const MANNERS: Duration = Duration::from_millis(25);

/// The cable: sends and receives reports of 64 bytes. Every wait MUST end within the time given.
pub trait HidPort {
    /// Sends one report.
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError>;

    /// Receives one report.
    fn read_report(&mut self, report: &mut [u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError>;

    /// Name of the controller in messages.
    fn name(&self) -> &str {
        "DLPC900"
    }

    /// Waits. Simulated ports advance their own time.
    fn pause(&mut self, time: Duration) {
        std::thread::sleep(time);
    }

    /// The time since a fixed instant, by the clock that pauses and timeouts go by. Simulated ports have their own.
    fn now(&self) -> Duration {
        static BEGIN: OnceLock<Instant> = OnceLock::new();
        BEGIN.get_or_init(Instant::now).elapsed()
    }

    /// A second way to send reports over the same cable from another thread. It works even while this thread hangs
    /// inside a call. `None` if there is none.
    fn second_line(&self) -> Option<Box<dyn SecondLine>> {
        None
    }
}

/// Sends reports beside the [`HidPort`] that it belongs to.
pub trait SecondLine: Send {
    /// Sends one report. MUST end within `timeout`.
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError>;
}

/// Makes a controller dark from another thread than the one that uses it. Its commands request no reply, so it need not
/// wait for one. It waits briefly for a pending command, and no longer.
pub struct DarkLine {
    pub(super) line: Box<dyn SecondLine>,
    pub(super) turn: Arc<Mutex<()>>,
}

impl DarkLine {
    /// Stops the sequence, so that no light leaves the projector. With `leds_off`, for the end of a run, it also
    /// switches the LEDs off. The first report is sent within some 25 ms.
    ///
    /// # Errors
    /// Those of the cable. The controller did not receive the orders then.
    pub fn dark(&mut self, leds_off: bool) -> Result<(), PortError> {
        let mut waited = Duration::ZERO;
        let step = Duration::from_millis(1);
        let turn = loop {
            match self.turn.try_lock() {
                Ok(turn) => break Some(turn),
                Err(TryLockError::Poisoned(turn)) => break Some(turn.into_inner()),
                // The other thread hangs inside a command; its reply is no longer of use.
                Err(TryLockError::WouldBlock) if waited >= MANNERS => break None,
                Err(TryLockError::WouldBlock) => {
                    std::thread::sleep(step);
                    waited += step;
                }
            }
        };
        let mut steps = sequence::stop();
        if leds_off {
            steps.push(sequence::leds_off());
        }
        for step in &steps {
            let Step::Write(opcode, data) = step else { continue };
            // Fits one report, so it cannot end up between the reports of another command.
            for report in Command::write(0, *opcode, data, false).reports().into_iter().flatten() {
                self.line.write_report(&report, POLL)?;
            }
        }
        drop(turn);
        Ok(())
    }
}
