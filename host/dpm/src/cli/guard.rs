//! The guard of a run whose projector cannot end its light by itself: a process that outlives the run.

use dpm_common::guardian::Guardian;
use std::io::Write;
use std::process::Stdio;

/// A process that watches this one. It acts if this process ends, or drops this value, without [`Guard::dismiss`].
pub(super) struct Guard(Option<Guardian>);

impl Guard {
    /// Starts this program with `words`. If that fails, the run continues without this precaution.
    pub(super) fn start(words: &[String]) -> Self {
        let start = || {
            let mut command = std::process::Command::new(std::env::current_exe()?);
            command.args(words).stdout(Stdio::null());
            Guardian::start(command)
        };
        match start() {
            Ok(guardian) => Self(Some(guardian)),
            Err(e) => {
                let _ = writeln!(
                    std::io::stderr(),
                    "cannot start the process that ends the projector's light if this run is killed: {e}"
                );
                Self(None)
            }
        }
    }

    /// Ends it, because the run has ended by itself and has put the projector to rest.
    pub(super) fn dismiss(self) {
        if let Some(guardian) = self.0 {
            guardian.dismiss();
        }
    }
}
