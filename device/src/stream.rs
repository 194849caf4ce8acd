//! What bytes come over without waiting, and how it is opened without waiting.

#[cfg(any(feature = "serial", feature = "net"))]
use crossbeam::channel::{Receiver, TryRecvError};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::fd::{AsRawFd, RawFd};

/// What a device's bytes come over: a socket, a port, or a conversation in memory. Reads and writes MUST NOT block;
/// what is not there yet is [`std::io::ErrorKind::WouldBlock`].
pub trait Stream: Read + Write + Send {
    /// The descriptor whose readability announces bytes; `None` if there is none, or none that may be waited for.
    fn descriptor(&self) -> Option<RawFd> {
        None
    }
}

impl Stream for TcpStream {
    fn descriptor(&self) -> Option<RawFd> {
        Some(self.as_raw_fd())
    }
}

/// A serial port is not waited for: see [`crate::tty`], which says what the kernel waits for then.
#[cfg(feature = "serial")]
impl Stream for Box<dyn serialport::SerialPort> {}

/// Opens a [`Stream`] for a client that must never wait. The clients bring one that asks the operating system on a
/// helper thread; a simulator brings its own. There is one attempt at a time.
pub trait Opener: Send {
    /// Begins an attempt. Returns false if none can be made now.
    fn begin(&mut self) -> bool;

    /// What came of the attempt: the stream, or why there is none, for an operator. `None` as long as it lasts.
    fn outcome(&mut self) -> Option<Result<Box<dyn Stream>, String>>;
}

/// Opens on a helper thread, because opening a port or looking up a name can block.
#[cfg(any(feature = "serial", feature = "net"))]
pub(crate) struct OnThread<F> {
    name: &'static str,
    open: F,
    result: Option<Receiver<Result<Box<dyn Stream>, String>>>,
}

#[cfg(any(feature = "serial", feature = "net"))]
impl<F: Fn() -> Result<Box<dyn Stream>, String> + Clone + Send + 'static> OnThread<F> {
    /// Each attempt calls `open` on a thread of this name.
    pub(crate) fn new(name: &'static str, open: F) -> Self {
        Self { name, open, result: None }
    }
}

#[cfg(any(feature = "serial", feature = "net"))]
impl<F: Fn() -> Result<Box<dyn Stream>, String> + Clone + Send + 'static> Opener for OnThread<F> {
    fn begin(&mut self) -> bool {
        let (send, receive) = crossbeam::channel::bounded(1);
        let open = self.open.clone();
        // If the client was dropped, nobody receives this, and what was opened is closed again.
        let run = move || drop(send.send(open()));
        let spawned = std::thread::Builder::new().name(self.name.into()).spawn(run);
        self.result = spawned.is_ok().then_some(receive);
        self.result.is_some()
    }

    fn outcome(&mut self) -> Option<Result<Box<dyn Stream>, String>> {
        let result = match self.result.as_ref()?.try_recv() {
            Ok(result) => result,
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => Err("the thread that opens it ended".into()),
        };
        self.result = None;
        Some(result)
    }
}

#[cfg(all(test, any(feature = "serial", feature = "net")))]
mod tests {
    use super::*;
    use std::time::{Duration, Instant};

    impl Stream for std::io::Cursor<Vec<u8>> {}

    fn wait(opener: &mut impl Opener) -> Result<Box<dyn Stream>, String> {
        let begin = Instant::now();
        loop {
            if let Some(result) = opener.outcome() {
                return result;
            }
            assert!(begin.elapsed() < Duration::from_secs(30), "no outcome");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn an_attempt_has_one_outcome_even_if_its_thread_panics() {
        let mut opener = OnThread::new("opens", || Ok(Box::new(std::io::Cursor::new(vec![1u8])) as _));
        assert!(opener.outcome().is_none() && opener.begin());
        assert!(wait(&mut opener).is_ok() && opener.outcome().is_none());
        let mut refused = OnThread::new("refuses", || Err("no".into()));
        assert!(refused.begin() && wait(&mut refused).is_err_and(|why| why == "no"));
        let mut broken = OnThread::new("panics", || panic!("a test of what a panic does"));
        assert!(broken.begin() && wait(&mut broken).is_err_and(|why| why.contains("ended")));
    }
}
