//! The projector shows a pattern while something is measured or asked in its light.

use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::monitor::RunMonitor;

/// Runs the projector by `run` while `work` goes on; the projector is dark afterwards. Gives what `work` and `run` give. A
/// projector that fails asks for a stop, so that nobody is asked to work in the dark.
///
/// # Errors
/// The projector fails, which is then the reason why the work ended; or else what `work` says.
pub fn while_shown<R: Send, T>(
    monitor: &RunMonitor,
    run: impl FnOnce() -> Result<R, Failure> + Send,
    work: impl FnOnce() -> Result<T, Failure>,
) -> Result<(T, R), Failure> {
    std::thread::scope(|scope| {
        let runs = scope.spawn(|| {
            let ended = run();
            monitor.request_stop();
            ended
        });
        let worked = work();
        monitor.request_stop();
        let ended = runs.join().unwrap_or_else(|_| {
            Err(Failure::new(FailureKind::Device, "the projector's thread ended by a panic (see above)"))
        })?;
        Ok((worked?, ended))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_projector_that_fails_ends_the_work_and_is_the_reason() {
        let failed = |told: &str| Failure::new(FailureKind::Device, told.to_owned());
        let monitor = RunMonitor::default();
        let work = || {
            while !monitor.stop_requested() {
                std::thread::yield_now();
            }
            Err::<(), _>(failed("interrupted"))
        };
        let ended = while_shown(&monitor, || Err::<(), _>(failed("no projector")), work);
        assert_eq!(ended.unwrap_err().message, "no projector");
    }

    #[test]
    fn the_end_of_the_work_ends_the_run() {
        let monitor = RunMonitor::default();
        let run = || {
            while !monitor.stop_requested() {
                std::thread::yield_now();
            }
            Ok(3)
        };
        assert_eq!(while_shown(&monitor, run, || Ok("done")).unwrap(), ("done", 3));
        let refused = while_shown(
            &monitor,
            || Ok(3),
            || Err::<(), _>(Failure::new(FailureKind::BadInput, "too few points")),
        );
        assert_eq!(refused.unwrap_err().message, "too few points");
    }
}
