//! Tells systemd how the rig is: READY, STATUS, WATCHDOG and STOPPING (sd_notify(3)).
//!
//! The protocol is one datagram of text lines to the socket that `NOTIFY_SOCKET` names. Without that variable nothing
//! is sent. No call waits: a socket that is full loses a message, and the next one comes soon.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::{Duration, Instant};

/// The shortest time between two lines of STATUS.
const STATUS_EVERY: Duration = Duration::from_secs(1);

/// The connection to systemd, if this process is a service of type `notify`.
#[derive(Debug)]
pub(crate) struct Notifier {
    socket: Option<(UnixDatagram, SocketAddr)>,
    /// How often a sign of life is due; `None` if none is wanted.
    alive_every: Option<Duration>,
    alive_at: Option<Instant>,
    status: (String, Option<Instant>),
    is_ready: bool,
}

impl Notifier {
    /// From the environment of this process.
    pub(crate) fn from_environment() -> Self {
        let variable = |name: &str| std::env::var(name).ok();
        Self::new(&variable, std::process::id())
    }

    fn new(variable: &dyn Fn(&str) -> Option<String>, pid: u32) -> Self {
        let socket = variable("NOTIFY_SOCKET").and_then(|name| {
            let address = match name.strip_prefix('@') {
                Some(name) => SocketAddr::from_abstract_name(name.as_bytes()),
                None => SocketAddr::from_pathname(&name),
            };
            let socket = UnixDatagram::unbound().ok()?;
            socket.set_nonblocking(true).ok()?;
            Some((socket, address.ok()?))
        });
        let is_for_me = variable("WATCHDOG_PID").is_none_or(|it| it.parse() == Ok(pid));
        let limit_us: Option<u64> = variable("WATCHDOG_USEC").and_then(|us| us.parse().ok());
        // Twice as often as is demanded.
        let alive_every = limit_us.filter(|us| *us > 0 && is_for_me).map(|us| Duration::from_micros(us / 2));
        Self { socket, alive_every, alive_at: None, status: Default::default(), is_ready: false }
    }

    fn send(&self, text: &str) {
        if let Some((socket, address)) = &self.socket {
            let _ = socket.send_to_addr(text.as_bytes(), address);
        }
    }

    /// The rig works, with or without light. Only the first call tells it.
    pub(crate) fn ready(&mut self) {
        if !std::mem::replace(&mut self.is_ready, true) {
            self.send("READY=1");
        }
    }

    /// The rig is alive. Call it often; it tells as often as is wanted.
    pub(crate) fn alive(&mut self, now: Instant) {
        let Some(every) = self.alive_every else { return };
        if self.alive_at.is_none_or(|at| now.duration_since(at) >= every) {
            self.alive_at = Some(now);
            self.send("WATCHDOG=1");
        }
    }

    /// How the rig is, in one line. Told when it is new, once a second at most. `text` is made only then.
    pub(crate) fn status(&mut self, now: Instant, text: impl FnOnce() -> String) {
        let (told, at) = &self.status;
        if self.socket.is_none() || at.is_some_and(|at| now.duration_since(at) < STATUS_EVERY) {
            return;
        }
        let line: String = text().chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        if line != *told {
            self.send(&format!("STATUS={line}"));
        }
        self.status = (line, Some(now));
    }

    /// The rig is ending.
    pub(crate) fn stopping(&self) {
        self.send("STOPPING=1");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listen(name: &str) -> (UnixDatagram, std::path::PathBuf) {
        let path = std::env::temp_dir().join(format!("dpm-notify-{}-{name}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_nonblocking(true).unwrap();
        (socket, path)
    }

    fn heard(socket: &UnixDatagram) -> Vec<String> {
        let mut bytes = [0; 256];
        std::iter::from_fn(|| {
            socket.recv(&mut bytes).ok().map(|n| String::from_utf8_lossy(&bytes[..n]).into_owned())
        })
        .collect()
    }

    fn notifier(all: &[(&str, &str)], pid: u32) -> Notifier {
        Notifier::new(&|name| all.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned()), pid)
    }

    #[test]
    fn systemd_hears_each_thing_when_it_is_due() {
        let (socket, path) = listen("due");
        let name = path.display().to_string();
        let mut notifier = notifier(&[("NOTIFY_SOCKET", &name), ("WATCHDOG_USEC", "1000000")], 7);
        let begin = Instant::now();
        let at = |ms| begin + Duration::from_millis(ms);
        notifier.ready();
        notifier.ready();
        assert_eq!(heard(&socket), ["READY=1"]);
        for ms in 0..=2000 {
            notifier.alive(at(ms));
        }
        assert_eq!(heard(&socket), vec!["WATCHDOG=1"; 5]);
        for ms in 0..3000 {
            notifier.status(at(ms), || if ms < 2500 { "up\n1".into() } else { "later".into() });
        }
        notifier.status(at(3000), || "dark".into());
        assert_eq!(heard(&socket), ["STATUS=up 1", "STATUS=dark"]);
        notifier.stopping();
        assert_eq!(heard(&socket), ["STOPPING=1"]);
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn a_process_that_is_no_service_or_another_one_tells_nothing() {
        let mut none = notifier(&[], 7);
        none.ready();
        none.alive(Instant::now());
        none.status(Instant::now(), || panic!("nobody asks"));
        let (socket, path) = listen("other");
        let name = path.display().to_string();
        let all = [("NOTIFY_SOCKET", name.as_str()), ("WATCHDOG_USEC", "1000"), ("WATCHDOG_PID", "8")];
        notifier(&all, 7).alive(Instant::now());
        assert!(heard(&socket).is_empty());
        for bad in ["", "0", "soon", "-1"] {
            assert_eq!(notifier(&[("WATCHDOG_USEC", bad)], 7).alive_every, None);
        }
        // Nobody reads, or there is no such socket.
        std::fs::remove_file(path).unwrap();
        notifier(&all, 8).alive(Instant::now());
    }

    #[test]
    fn an_abstract_socket_is_a_socket() {
        let name = format!("dpm-notify-{}", std::process::id());
        let address = SocketAddr::from_abstract_name(name.as_bytes()).unwrap();
        let socket = UnixDatagram::bind_addr(&address).unwrap();
        socket.set_nonblocking(true).unwrap();
        notifier(&[("NOTIFY_SOCKET", &format!("@{name}"))], 7).stopping();
        assert_eq!(heard(&socket), ["STOPPING=1"]);
    }
}
