//! Puts the DLPC900 of a killed run to rest.

use dpm_common::clock::Stopwatch;
use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, HidPort};
use std::time::Duration;

/// How long to try. Giving up leaves the light on.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time between two tries.
const STEP: Duration = Duration::from_millis(5);

/// Stops the controller that `open` reaches, switches its LEDs off and lets it exercise its mirrors, as a run does at
/// its end.
///
/// A killed run may leave half a command in the controller, which then loses the next one or its answer; the kernel
/// releases the dead process's interface in its own time. Therefore every failure begins anew, from opening, for a
/// minute.
///
/// # Errors
/// The last failure.
pub(crate) fn put_to_rest<P: HidPort>(
    open: &mut dyn FnMut() -> Result<Dlpc900<P>, Dlpc900Error>,
) -> Result<(), Dlpc900Error> {
    let watch = Stopwatch::start();
    loop {
        match open().and_then(rest) {
            Err(_) if watch.elapsed_ns() < PATIENCE.as_nanos() as u64 => std::thread::sleep(STEP),
            other => return other,
        }
    }
}

/// A controller that rests refuses both commands, and is dark.
fn rest<P: HidPort>(mut d: Dlpc900<P>) -> Result<(), Dlpc900Error> {
    let is_refused = |e: &Dlpc900Error| matches!(e, Dlpc900Error::Refused { .. });
    d.stop().or_else(|e| if is_refused(&e) { Ok(()) } else { Err(e) })?;
    d.idle().or_else(|e| if is_refused(&e) && !d.status()?.is_running() { Ok(()) } else { Err(e) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_dlpc900::driver::PortError;
    use dpm_dlpc900::lut::{led, Dmd, LutEntry};
    use dpm_dlpc900::sequence::LedSetup;
    use dpm_dlpc900::video::{Receiver, VideoPatterns};
    use hil_mock::dlpc900::{Dlpc900Model, Options, VirtualHid};
    use std::cell::Cell;
    use std::rc::Rc;
    use std::sync::{Arc, Mutex};

    /// A cable that carries so many reports, and then acts as told.
    struct LimitedCable {
        hid: VirtualHid,
        left: Rc<Cell<usize>>,
        then: PortError,
    }

    impl HidPort for LimitedCable {
        fn write_report(&mut self, report: &[u8; 64], timeout: Duration) -> Result<(), PortError> {
            if self.left.get() == 0 {
                return Err(self.then.clone());
            }
            self.left.set(self.left.get() - 1);
            self.hid.write_report(report, timeout)
        }
        fn read_report(&mut self, report: &mut [u8; 64], timeout: Duration) -> Result<(), PortError> {
            self.hid.read_report(report, timeout)
        }
        fn pause(&mut self, time: Duration) {
            self.hid.pause(time);
        }
        fn now(&self) -> Duration {
            HidPort::now(&self.hid)
        }
    }

    fn model() -> Arc<Mutex<Dlpc900Model>> {
        Arc::new(Mutex::new(Dlpc900Model::new(Options { dmd: Dmd::Dlp5500, ..Options::default() })))
    }

    fn video() -> VideoPatterns {
        let entry = |i: u8| LutEntry { leds: led::WHITE, ..LutEntry::one_bit(i.into(), 0, i, 2000) };
        VideoPatterns {
            dmd: Dmd::Dlp5500,
            receiver: Receiver::Hdmi,
            ports: None,
            frame_hz: 60,
            entries: (0..8).map(entry).collect(),
            leds: LedSetup::default(),
        }
    }

    /// Sets up what a run in video mode sets up, until the cable ends it. Returns the number of reports written.
    fn run(model: &Arc<Mutex<Dlpc900Model>>, reports: usize) -> usize {
        let left = Rc::new(Cell::new(reports));
        let port =
            LimitedCable { hid: VirtualHid::new(model.clone()), left: left.clone(), then: PortError::Gone };
        let _ = Dlpc900::new(port).and_then(|mut d| {
            d.make_ready()?;
            d.stop()?;
            d.load_video_patterns(&video())?;
            d.start()
        });
        reports - left.get()
    }

    /// Wherever a run is killed, between any two reports, on a controller that is fresh or that rests after an
    /// earlier run, and although the first command of the guard is lost and its next one times out halfway.
    #[test]
    fn a_run_that_is_killed_at_any_report_leaves_a_controller_at_rest() {
        let whole = run(&model(), usize::MAX);
        assert!(whole > 20, "a run writes more than {whole} reports");
        for rested_before in [false, true] {
            for killed_after in 0..=whole + 4 {
                let model = model();
                if rested_before {
                    run(&model, usize::MAX);
                    put_to_rest(&mut || Dlpc900::new(VirtualHid::new(model.clone()))).unwrap();
                }
                run(&model, killed_after);
                let mut opened = 0;
                let mut open = || {
                    opened += 1;
                    let reports = [0, 3, usize::MAX][(opened - 1).min(2)];
                    Dlpc900::new(LimitedCable {
                        hid: VirtualHid::new(model.clone()),
                        left: Rc::new(Cell::new(reports)),
                        then: PortError::Timeout,
                    })
                };
                put_to_rest(&mut open).unwrap();
                let dark = model.lock().unwrap().dark_because();
                assert_eq!(dark, Some("mirrors exercised"), "{killed_after} reports, {rested_before}");
            }
        }
    }
}
