//! Pupil on real sockets: one thread that answers and sends each sample when it is due.

use super::messages::{Message, PupilConfig, FAULTS};
use crate::faults::FaultKind;
use dpm_device::time::{HostClock, HostTime};
use dpm_pupil::zmtp::{put_message, put_words, Event, SocketKind, ZmtpPeer};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Most connections to each of the two sockets.
const MOST_CLIENTS: usize = 16;
/// Most topics of a subscriber, and most bytes of one.
const MOST_TOPICS: usize = 32;
const MOST_TOPIC: usize = 128;
/// Most bytes that wait for a client that does not read; a subscriber loses messages then, as with ZeroMQ.
const MOST_BACKLOG: usize = 256 << 10;
/// Most samples that are made up for after a pause.
const MOST_BEHIND: u64 = 64;
/// Pause of the thread.
const PAUSE: Duration = Duration::from_micros(500);

/// Pupil until it is dropped.
pub struct PupilHost {
    stop: Arc<AtomicBool>,
    subscribers: Arc<AtomicUsize>,
    address: SocketAddr,
    thread: Option<JoinHandle<io::Result<()>>>,
}

impl PupilHost {
    /// Pupil Remote on `address` (port 0 for any), and its data on any port of the same address. Instant 0 of the eyes is
    /// that of `clock`.
    ///
    /// # Errors
    /// Sockets cannot be had, or the faults are not of this mock.
    pub fn start(config: PupilConfig, address: SocketAddrV4, clock: Arc<dyn HostClock>) -> io::Result<Self> {
        config.faults.check_supported(&FAULTS, "Pupil").map_err(io::Error::other)?;
        let remote = Door::open(address, SocketKind::Rep)?;
        let data = Door::open(SocketAddrV4::new(*address.ip(), 0), SocketKind::Pub)?;
        let bound = remote.listener.local_addr()?;
        let port = data.listener.local_addr()?.port();
        let stop = Arc::new(AtomicBool::new(false));
        let subscribers = Arc::new(AtomicUsize::new(0));
        let begin = clock.now();
        let mut server = Server { next: 0, shift_s: 0.0, last: begin, config, clock, remote, data, port };
        server.next = server.due_before(begin);
        let thread = {
            let (stop, count) = (stop.clone(), subscribers.clone());
            std::thread::Builder::new().name("pupil-server".into()).spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    server.turn()?;
                    count.store(server.data.clients.len(), Ordering::Relaxed);
                    std::thread::sleep(PAUSE);
                }
                Ok(())
            })?
        };
        Ok(Self { stop, subscribers, address: bound, thread: Some(thread) })
    }

    /// On any port of this machine.
    ///
    /// # Errors
    /// As [`PupilHost::start`].
    pub fn here(config: PupilConfig, clock: Arc<dyn HostClock>) -> io::Result<Self> {
        Self::start(config, SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), clock)
    }

    /// Where Pupil Remote listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Subscribers now.
    pub fn subscribers(&self) -> usize {
        self.subscribers.load(Ordering::Relaxed)
    }

    /// True until the thread ends, which happens only on a socket error.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }
}

impl Drop for PupilHost {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // `is_running` shows an error or panic of the thread; nobody is left to inform here.
            let _ = thread.join();
        }
    }
}

/// A connection.
struct Client {
    stream: TcpStream,
    peer: ZmtpPeer,
    out: Vec<u8>,
    topics: Vec<Vec<u8>>,
}

/// A listening socket with its connections.
struct Door {
    listener: TcpListener,
    kind: SocketKind,
    clients: Vec<Client>,
}

impl Door {
    fn open(address: SocketAddrV4, kind: SocketKind) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self { listener, kind, clients: Vec::new() })
    }

    fn welcome(&mut self, is_away: bool) {
        // A few at a time. A client that has gone again, and descriptors that ran out, pass.
        for _ in 0..4 {
            let Ok((stream, _)) = self.listener.accept() else { return };
            let is_ready = stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true)).is_ok();
            if is_ready && !is_away && self.clients.len() < MOST_CLIENTS {
                let mut out = Vec::new();
                let peer = ZmtpPeer::new(self.kind, &mut out);
                self.clients.push(Client { stream, peer, out, topics: Vec::new() });
            }
        }
    }
}

impl Client {
    /// Reads what is there; false if the client is gone or speaks something else. Questions go to `asked`.
    fn read(&mut self, asked: &mut Vec<String>) -> bool {
        let mut bytes = [0; 4096];
        let topics = &mut self.topics;
        for _ in 0..4 {
            let count = match self.stream.read(&mut bytes) {
                Ok(0) => return false,
                Ok(count) => count,
                Err(e) => return matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
            };
            let result = self.peer.push(&bytes[..count], &mut self.out, &mut |heard| match heard {
                Event::Ready => {}
                Event::Message(message) => {
                    let words = String::from_utf8_lossy(message.part(message.count() - 1)).into_owned();
                    asked.push(words);
                }
                Event::Topic(true, topic) if topics.len() < MOST_TOPICS && topic.len() <= MOST_TOPIC => {
                    topics.push(topic.to_vec());
                }
                Event::Topic(true, _) => {}
                Event::Topic(false, topic) => {
                    if let Some(i) = topics.iter().position(|t| t == topic) {
                        topics.swap_remove(i);
                    }
                }
            });
            if result.is_err() {
                return false;
            }
        }
        true
    }

    fn offer(&mut self, (topic, payload): &Message) {
        let wants = self.topics.iter().any(|wanted| topic.as_bytes().starts_with(wanted));
        if wants && self.peer.is_ready() && self.out.len() < MOST_BACKLOG {
            put_message(&[topic.as_bytes(), payload], &mut self.out);
        }
    }

    /// Sends waiting bytes; false if the client is gone.
    fn write(&mut self) -> bool {
        while !self.out.is_empty() {
            match self.stream.write(&self.out) {
                Ok(0) => return false,
                Ok(count) => drop(self.out.drain(..count)),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return e.kind() == ErrorKind::WouldBlock && self.out.len() <= 2 * MOST_BACKLOG,
            }
        }
        true
    }
}

struct Server {
    config: PupilConfig,
    clock: Arc<dyn HostClock>,
    remote: Door,
    data: Door,
    port: u16,
    /// Number of the next sample.
    next: u64,
    /// By how much `T` has set the clock, seconds.
    shift_s: f64,
    last: HostTime,
}

impl Server {
    /// How many samples are due before `now`.
    fn due_before(&self, now: HostTime) -> u64 {
        let rate = &self.config.rate;
        let ns = now.0.saturating_sub(self.config.latency_ns).max(0) as u128;
        (ns * u128::from(rate.num()) / (1_000_000_000 * u128::from(rate.den()))) as u64
    }

    fn turn(&mut self) -> io::Result<()> {
        let now = self.clock.now();
        let faults = &self.config.faults;
        let is_away = faults.is_on(FaultKind::Unplug, now.0);
        if faults.starts_within(FaultKind::Reset, self.last.0, now.0) || is_away {
            self.remote.clients.clear();
            self.data.clients.clear();
        }
        self.last = now;
        self.remote.welcome(is_away);
        self.data.welcome(is_away);
        let (config, clock, port, shift_s) = (&self.config, &self.clock, self.port, &mut self.shift_s);
        self.remote.clients.retain_mut(|client| {
            let mut asked = Vec::new();
            let is_there = client.read(&mut asked);
            for words in asked {
                let answer = config.answer(&words, clock.now().0, port, shift_s);
                put_words(answer.as_bytes(), &mut client.out);
            }
            is_there && client.write()
        });
        let due = self.due_before(now);
        self.next = self.next.max(due.saturating_sub(MOST_BEHIND));
        let mut messages = Vec::new();
        while self.next < due {
            self.next += 1;
            messages.extend(self.config.messages(self.next, self.shift_s));
        }
        self.data.clients.retain_mut(|client| {
            let is_there = client.read(&mut Vec::new());
            messages.iter().for_each(|message| client.offer(message));
            is_there && client.write()
        });
        Ok(())
    }
}
