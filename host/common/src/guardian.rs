//! A process that outlives this one and acts for it: it makes a projector dark that has no watchdog, when this program is
//! killed.
//!
//! The program holds one end of a pipe, which is the guardian's standard input. An orderly end says so through it. If it
//! closes without a word, the program is dead, however it died.

use std::io::{self, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

/// What an orderly end says.
const OVER: &[u8] = b"over";

/// The program's side. The guardian acts if this process ends, or drops this value, without [`Guardian::dismiss`].
#[derive(Debug)]
pub struct Guardian(Child);

impl Guardian {
    /// Starts `command`, which calls [`outlived`] first. It gets a process group of its own: what stops the program's group
    /// does not reach it.
    ///
    /// # Errors
    /// The process cannot be started; the program may go on without this precaution.
    pub fn start(mut command: Command) -> io::Result<Self> {
        command.stdin(Stdio::piped()).process_group(0).spawn().map(Self)
    }

    /// Ends it, because the program has made everything dark by itself.
    pub fn dismiss(mut self) {
        let said = self.0.stdin.take().map(|mut pipe| pipe.write_all(OVER));
        if let Some(Ok(())) = said {
            let _ = self.0.wait();
        }
    }
}

/// The guardian's side: waits until the program ends. True if it died without a word.
pub fn outlived() -> bool {
    let mut said = Vec::new();
    let _ = io::stdin().lock().take(16).read_to_end(&mut said);
    said.is_empty()
}
