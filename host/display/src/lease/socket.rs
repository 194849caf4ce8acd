//! The socket of a desktop that may have stopped to answer: every wait has an end.

use std::os::unix::net::UnixStream;
use std::time::Instant;

use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};

use super::STEP;

/// Connects to the socket `address` of a server that may have stopped to answer.
pub(super) fn connect_to(address: &SocketAddrUnix, until: Instant) -> Result<UnixStream, Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    loop {
        match rustix::net::connect(&socket, address) {
            Ok(()) => return Ok(UnixStream::from(socket)),
            // Too many wait for the server already.
            Err(Errno::AGAIN) if Instant::now() < until => std::thread::sleep(STEP / 10),
            Err(e) => return Err(e),
        }
    }
}

/// What is left until `until`, in the form of a system call; `None` if it is over.
pub(super) fn left(until: Instant) -> Option<rustix::event::Timespec> {
    let left = until.checked_duration_since(Instant::now()).filter(|left| !left.is_zero())?;
    rustix::event::Timespec::try_from(left).ok()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use std::io::Read;
    use std::os::fd::OwnedFd;
    use std::time::Duration;

    /// A descriptor that a fake server hands out, and what tells whether another one is the same.
    pub(in super::super) struct HandedSocket {
        pub(in super::super) given: OwnedFd,
        heard: std::io::PipeReader,
    }

    impl HandedSocket {
        pub(in super::super) fn new() -> Self {
            let (heard, given) = std::io::pipe().unwrap();
            Self { given: given.into(), heard }
        }

        /// Reads what is written to `descriptor`.
        pub(in super::super) fn is(self, descriptor: OwnedFd) -> bool {
            rustix::io::write(&descriptor, b"same").unwrap();
            drop((descriptor, self.given));
            let mut heard = String::new();
            let mut pipe = self.heard;
            pipe.read_to_string(&mut heard).unwrap();
            heard == "same"
        }
    }

    #[test]
    fn a_server_that_takes_nobody_is_given_up_in_time() {
        let folder = std::env::temp_dir().join(format!("dpm-lease-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("full");
        let server = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None).unwrap();
        let address = SocketAddrUnix::new(&path).unwrap();
        rustix::net::bind(&server, &address).unwrap();
        rustix::net::listen(&server, 0).unwrap();
        let start = Instant::now();
        let until = start + Duration::from_millis(300);
        let mut kept = Vec::new();
        let refused = loop {
            match connect_to(&address, until) {
                Ok(stream) => kept.push(stream),
                Err(e) => break e,
            }
            assert!(kept.len() < 100, "the queue ends");
        };
        assert_eq!(refused, Errno::AGAIN);
        assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
