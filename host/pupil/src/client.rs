//! The connection to Pupil Capture or Pupil Service: asks Pupil Remote for the port of its data and for its clock, and
//! hears gaze from there. It connects while it is polled, and again after every loss. Every wait has an end.

use crate::gaze::{decode, NoGaze, FARTHEST_S};
use crate::zmtp::{put_subscription, put_words, Event, Message, SocketKind, ZmtpError, ZmtpPeer};
use dpm_common::unix::wait_readable;
use dpm_device::clock_map::{ClockMap, ExchangeOutcome};
use dpm_device::time::{DeviceTicks, HostClock, HostTime};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::fd::AsRawFd;
use std::sync::Arc;
use std::time::Duration;

/// The port of Pupil Remote unless somebody has chosen another.
pub const PORT: u16 = 50020;
/// How long to wait for a connection.
const CONNECT_WITHIN: Duration = Duration::from_millis(300);
/// Rest before a lost connection is opened again, nanoseconds.
const REST_NS: i64 = 500_000_000;
/// How long a question or a handshake may go without an answer, nanoseconds.
const ANSWER_WITHIN_NS: i64 = 1_000_000_000;
/// Time between two questions for the clock, nanoseconds: the first ones, and the others.
const ASK_EVERY_NS: [i64; 2] = [20_000_000, 250_000_000];
/// How many questions come first.
const FIRST_QUESTIONS: u32 = 8;
/// Gaze that is older than this when it comes, or by more than [`EARLY_NS`] from the future, has no known time.
const OLD_NS: i64 = 1_000_000_000;
const EARLY_NS: i64 = 5_000_000;
/// An instant that is known worse than this is not known, nanoseconds.
const VAGUE_NS: i64 = 50_000_000;
/// Most bytes that are read at once, and that may wait to be sent.
const MOST_BYTES: usize = 16 << 10;
/// Time after which a connection without gaze is doubted, nanoseconds.
const SILENT_NS: i64 = 1_000_000_000;
/// Samples by which the share of unsure ones is judged.
const JUDGED: u64 = 32;

/// What is asked of Pupil.
#[derive(Clone, Debug)]
pub struct PupilSettings {
    /// Where Pupil Remote listens.
    pub address: SocketAddr,
    /// Samples of less confidence are not used, 0 to 1.
    pub min_confidence: f64,
    /// Pupils are heard as well, by which a doctor sees that only the calibration is missing.
    pub hears_pupils: bool,
}

/// Gaze at an instant of the host's clock, of enough confidence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GazeAt {
    /// When the eyes were seen.
    pub at: HostTime,
    /// When the message came.
    pub received_at: HostTime,
    /// How sure Pupil is, 0 to 1.
    pub confidence: f64,
    /// Between the eyes: metres, in the frame of the scene camera (x right, y down, z forward).
    pub eye_m: [f64; 3],
    /// What they look at, the same.
    pub point_m: [f64; 3],
}

/// What has come so far, over all connections.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PupilCounts {
    /// Messages about gaze.
    pub messages: u64,
    /// Of these: used.
    pub used: u64,
    /// Of these: of too little confidence, such as in a blink.
    pub unsure: u64,
    /// Of these: without a direction in space.
    pub flat: u64,
    /// Of these: malformed, or with impossible numbers.
    pub refused: u64,
    /// Of these: of an instant that is not known, too old, in the future, or before the one that came last.
    pub ill_timed: u64,
    /// Messages about pupils, if they are heard.
    pub pupils: u64,
    /// Connections on which gaze could be heard.
    pub sessions: u64,
    /// How often Pupil's clock was set anew.
    pub clock_steps: u64,
}

/// Why a connection ended.
#[derive(Debug, thiserror::Error)]
enum Loss {
    #[error("nothing answers: {0}")]
    Unreachable(io::Error),
    #[error("the connection broke: {0}")]
    Broken(io::Error),
    #[error("{0}")]
    Zmtp(#[from] ZmtpError),
    #[error("the port is open but answers nothing")]
    Silent,
    #[error("it answers the question {0:?} with {1:?}")]
    Answer(&'static str, String),
}

/// What speaks against the gaze, and what to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PupilDoubt {
    /// What was found.
    pub found: String,
    /// What to do.
    pub remedy: &'static str,
}

/// A question to Pupil Remote.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Question {
    DataPort,
    Clock,
}

impl Question {
    const fn words(self) -> &'static str {
        match self {
            Self::DataPort => "SUB_PORT",
            Self::Clock => "t",
        }
    }
}

/// A TCP connection and its end of ZMTP.
struct ZmtpConnection {
    stream: TcpStream,
    peer: ZmtpPeer,
    out: Vec<u8>,
    since: HostTime,
}

impl ZmtpConnection {
    fn open(address: SocketAddr, kind: SocketKind, now: HostTime) -> Result<Self, Loss> {
        let stream = TcpStream::connect_timeout(&address, CONNECT_WITHIN).map_err(Loss::Unreachable)?;
        stream.set_nodelay(true).and_then(|()| stream.set_nonblocking(true)).map_err(Loss::Broken)?;
        let mut out = Vec::new();
        let peer = ZmtpPeer::new(kind, &mut out);
        Ok(Self { stream, peer, out, since: now })
    }

    fn send(&mut self) -> Result<(), Loss> {
        while !self.out.is_empty() {
            match self.stream.write(&self.out) {
                Ok(count) => drop(self.out.drain(..count)),
                Err(e) if e.kind() == ErrorKind::WouldBlock && self.out.len() <= MOST_BYTES => return Ok(()),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(Loss::Broken(e)),
            }
        }
        Ok(())
    }

    /// Reads what is there, once.
    fn read(&mut self, bytes: &mut [u8], heard: &mut dyn FnMut(Event<'_>)) -> Result<(), Loss> {
        match self.stream.read(bytes) {
            Ok(0) => Err(Loss::Broken(ErrorKind::UnexpectedEof.into())),
            Ok(count) => Ok(self.peer.push(&bytes[..count], &mut self.out, heard)?),
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(()),
            Err(e) => Err(Loss::Broken(e)),
        }
    }
}

/// What is asked, since when, and when to ask again.
struct Asking {
    waiting: Option<(Question, HostTime)>,
    asked: u32,
    next_at: HostTime,
}

/// What one read has brought, in a form that outlives it.
#[derive(Default)]
struct Answers {
    text: Option<String>,
}

/// The client.
pub struct PupilClient {
    settings: PupilSettings,
    clock: Arc<dyn HostClock>,
    ears: Ears,
    remote: Option<ZmtpConnection>,
    data: Option<ZmtpConnection>,
    asking: Asking,
    bytes: Vec<u8>,
    ready: Vec<bool>,
    /// The last loss, and until when to rest after it.
    lost: Option<(String, HostTime)>,
    /// Since when gaze can be heard.
    hears_since: Option<HostTime>,
}

/// What becomes of a message of data: everything of the client that has no connection.
pub struct Ears {
    min_confidence: f64,
    map: ClockMap,
    counts: PupilCounts,
    /// The newest instant that was used.
    last: HostTime,
    /// When gaze came last, whatever its confidence.
    heard_at: Option<HostTime>,
    /// Unsure samples among the last ones; the sum of both halves when there are enough.
    judged: [u64; 2],
    unsure_share: Option<f64>,
}

impl Ears {
    /// Ears that have heard nothing.
    pub fn new(min_confidence: f64) -> Self {
        Self {
            min_confidence,
            // A nanosecond counter: no frequency of it can be refused.
            map: ClockMap::new(1_000_000_000).unwrap_or_else(|e| unreachable!("{e}")),
            counts: PupilCounts::default(),
            last: HostTime(i64::MIN),
            heard_at: None,
            judged: [0; 2],
            unsure_share: None,
        }
    }

    /// The counts so far.
    pub fn counts(&self) -> PupilCounts {
        self.counts
    }

    /// Takes Pupil's answer to the question for its clock, which was asked at `asked` and answered at `now`. False if it
    /// is no time.
    pub fn on_clock(&mut self, answer: &str, asked: HostTime, now: HostTime) -> bool {
        let time = answer.trim().parse::<f64>().ok().filter(|t| (-FARTHEST_S..=FARTHEST_S).contains(t));
        let Some(at_s) = time else { return false };
        let ticks = ticks(at_s);
        if self.map.add_exchange(asked, ticks, ticks, now) == ExchangeOutcome::Stepped {
            self.counts.clock_steps += 1;
            // What follows a step counts from anew, however far back the clock was set.
            self.last = HostTime(i64::MIN);
        }
        true
    }

    /// Takes a message of data that came at `now`. What can be used goes to `sink`.
    pub fn on_message(&mut self, topic: &[u8], payload: &[u8], now: HostTime, sink: &mut dyn FnMut(&GazeAt)) {
        if topic.starts_with(b"pupil") {
            self.counts.pupils += 1;
        }
        if !topic.starts_with(b"gaze") {
            return;
        }
        self.counts.messages += 1;
        self.heard_at = Some(now);
        let gaze = match decode(payload) {
            Ok(gaze) => gaze,
            Err(NoGaze::Flat) => return self.counts.flat += 1,
            Err(_) => return self.counts.refused += 1,
        };
        let is_unsure = gaze.confidence < self.min_confidence;
        self.judge(is_unsure);
        if is_unsure {
            return self.counts.unsure += 1;
        }
        let at = self.map.to_host(ticks(gaze.at_s)).and_then(|mapped| {
            let age_ns = now.ns_since(mapped.at);
            let is_known = mapped.uncertainty_ns <= VAGUE_NS;
            let earliest_ns = -(EARLY_NS + mapped.uncertainty_ns.min(VAGUE_NS));
            let is_now = (earliest_ns..=OLD_NS).contains(&age_ns);
            (is_known && is_now && mapped.at > self.last).then_some(mapped.at)
        });
        let Some(at) = at else { return self.counts.ill_timed += 1 };
        self.last = at;
        self.counts.used += 1;
        let (confidence, eye_m, point_m) = (gaze.confidence, gaze.eye_m, gaze.point_m);
        sink(&GazeAt { at, received_at: now, confidence, eye_m, point_m });
    }

    fn judge(&mut self, is_unsure: bool) {
        self.judged[0] += 1;
        self.judged[1] += u64::from(is_unsure);
        if self.judged[0] == JUDGED {
            self.unsure_share = Some(self.judged[1] as f64 / JUDGED as f64);
            self.judged = [0; 2];
        }
    }
}

/// Pupil's seconds as ticks of a nanosecond. The range of [`FARTHEST_S`] fits.
fn ticks(at_s: f64) -> DeviceTicks {
    DeviceTicks((at_s * 1e9) as i64 as u64)
}

impl PupilClient {
    /// A client that connects when it is polled. `clock` stamps what comes.
    pub fn new(settings: PupilSettings, clock: Arc<dyn HostClock>) -> Self {
        Self {
            ears: Ears::new(settings.min_confidence),
            settings,
            clock,
            remote: None,
            data: None,
            asking: Asking { waiting: None, asked: 0, next_at: HostTime(i64::MIN) },
            bytes: vec![0; MOST_BYTES],
            ready: Vec::with_capacity(2),
            lost: None,
            hears_since: None,
        }
    }

    /// Works for about `limit`, and a little longer while it connects. Gaze that can be used goes to `sink`, in the order
    /// of its instants.
    pub fn poll(&mut self, limit: Duration, sink: &mut dyn FnMut(&GazeAt)) {
        let now = self.clock.now();
        if let Some(until) = self.lost.as_ref().map(|(_, until)| *until).filter(|until| now < *until) {
            let rest = Duration::from_nanos(until.ns_since(now).max(0) as u64);
            return std::thread::sleep(rest.min(limit));
        }
        if let Err(loss) = self.work(now, limit, sink) {
            (self.remote, self.data, self.hears_since) = (None, None, None);
            self.lost = Some((loss.to_string(), self.clock.now().plus_ns(REST_NS)));
        }
    }

    fn work(&mut self, now: HostTime, limit: Duration, sink: &mut dyn FnMut(&GazeAt)) -> Result<(), Loss> {
        if self.remote.is_none() {
            self.asking = Asking { waiting: None, asked: 0, next_at: now };
            self.remote = Some(ZmtpConnection::open(self.settings.address, SocketKind::Req, now)?);
        }
        self.ask()?;
        self.check_patience(now)?;
        let next_ns = match self.asking.waiting {
            Some(_) => ANSWER_WITHIN_NS,
            None => self.asking.next_at.ns_since(now),
        };
        let wait = limit.min(Duration::from_nanos(next_ns.max(1_000_000) as u64));
        let lines = [&self.remote, &self.data];
        let descriptors: Vec<_> = lines.into_iter().flatten().map(|line| line.stream.as_raw_fd()).collect();
        let mut ready = std::mem::take(&mut self.ready);
        let waited = wait_readable(&descriptors, wait.as_millis() as i32, &mut ready);
        // Stamped here: an answer is as old as the wait for what came before it.
        let now = self.clock.now();
        let is_ready = |i: usize| ready.get(i).is_some_and(|ready| *ready);
        let (remote, data) = (is_ready(0), is_ready(1));
        self.ready = ready;
        waited.map_err(Loss::Broken)?;
        if remote {
            self.read_remote(now)?;
        }
        if data {
            self.read_data(now, sink)?;
        }
        Ok(())
    }

    /// Asks what is due.
    fn ask(&mut self) -> Result<(), Loss> {
        let Some(remote) = &mut self.remote else { return Ok(()) };
        let now = self.clock.now();
        if remote.peer.is_ready() && self.asking.waiting.is_none() && now >= self.asking.next_at {
            let question = if self.data.is_some() { Question::Clock } else { Question::DataPort };
            put_words(question.words().as_bytes(), &mut remote.out);
            self.asking.waiting = Some((question, now));
        }
        remote.send()?;
        self.data.as_mut().map_or(Ok(()), ZmtpConnection::send)
    }

    fn check_patience(&self, now: HostTime) -> Result<(), Loss> {
        let is_over = |since: HostTime| now.ns_since(since) > ANSWER_WITHIN_NS;
        let stuck = [&self.remote, &self.data]
            .into_iter()
            .flatten()
            .any(|line| !line.peer.is_ready() && is_over(line.since));
        let unanswered = self.asking.waiting.is_some_and(|(_, asked)| is_over(asked));
        if stuck || unanswered {
            return Err(Loss::Silent);
        }
        Ok(())
    }

    fn read_remote(&mut self, now: HostTime) -> Result<(), Loss> {
        let Some(remote) = &mut self.remote else { return Ok(()) };
        let mut answers = Answers::default();
        remote.read(&mut self.bytes, &mut |heard| {
            if let Event::Message(message) = heard {
                answers.text = Some(answer_of(&message));
            }
        })?;
        let Some((text, (question, asked))) = answers.text.zip(self.asking.waiting) else { return Ok(()) };
        self.asking.waiting = None;
        let refused = |text: String| Err(Loss::Answer(question.words(), text));
        match question {
            Question::DataPort => {
                let Some(port) = text.trim().parse::<u16>().ok().filter(|port| *port > 0) else {
                    return refused(text);
                };
                let address = SocketAddr::new(self.settings.address.ip(), port);
                self.data = Some(ZmtpConnection::open(address, SocketKind::Sub, now)?);
                self.asking.next_at = now;
            }
            Question::Clock => {
                if !self.ears.on_clock(&text, asked, now) {
                    return refused(text);
                }
                self.asking.asked += 1;
                let pause = ASK_EVERY_NS[usize::from(self.asking.asked >= FIRST_QUESTIONS)];
                self.asking.next_at = now.plus_ns(pause);
            }
        }
        Ok(())
    }

    fn read_data(&mut self, now: HostTime, sink: &mut dyn FnMut(&GazeAt)) -> Result<(), Loss> {
        let Some(data) = &mut self.data else { return Ok(()) };
        let (ears, mut is_ready) = (&mut self.ears, false);
        data.read(&mut self.bytes, &mut |heard| match heard {
            Event::Ready => is_ready = true,
            Event::Message(message) => ears.on_message(message.part(0), message.part(1), now, sink),
            Event::Topic(..) => {}
        })?;
        if is_ready {
            put_subscription(b"gaze", &mut data.out);
            if self.settings.hears_pupils {
                put_subscription(b"pupil", &mut data.out);
            }
            data.send()?;
            self.ears.counts.sessions += 1;
            (self.lost, self.hears_since) = (None, Some(now));
        }
        Ok(())
    }

    /// What has come so far.
    pub fn counts(&self) -> PupilCounts {
        self.ears.counts()
    }

    /// Bound on the error of the instants of samples that come now, nanoseconds; `None` before the first answer.
    pub fn clock_bound_ns(&self) -> Option<i64> {
        let now = self.ears.map.to_device(self.clock.now())?;
        self.ears.map.to_host(now).map(|mapped| mapped.uncertainty_ns)
    }

    /// What speaks against the gaze as it comes now; `None` if nothing does, or if it is too early to say.
    pub fn doubt(&self) -> Option<PupilDoubt> {
        let doubt = |found: String, remedy| Some(PupilDoubt { found, remedy });
        let (counts, now) = (self.counts(), self.clock.now());
        let Some(since) = self.hears_since else {
            let (why, _) = self.lost.as_ref()?;
            let remedy = "start Pupil Capture or Pupil Service there, switch its plugin \"Network API\" on with this port, and let \
                          the firewall pass it and the port of its data";
            return doubt(format!("Pupil at {}: {why}", self.settings.address), remedy);
        };
        let heard_at = self.ears.heard_at.map_or(since, |at| at.max(since));
        if now.ns_since(heard_at) > SILENT_NS {
            return match counts.pupils {
                0 => doubt(
                    "Pupil is connected and sends no gaze".into(),
                    "switch both eye cameras on in Pupil Capture, and calibrate with its 3D method",
                ),
                _ => doubt(
                    "Pupil sees pupils and sends no gaze: it has no calibration".into(),
                    "calibrate in Pupil Capture, with the 3D method (key C)",
                ),
            };
        }
        if counts.used == 0 && counts.flat > 0 {
            let remedy = "choose the 3D method in Pupil Capture's calibration, and calibrate again";
            return doubt("Pupil maps gaze in 2D, which has no direction in space".into(), remedy);
        }
        if let Some(share) = self.ears.unsure_share.filter(|share| *share > 0.5) {
            let found = format!(
                "{:.0} % of Pupil's last samples have a confidence below {}",
                100.0 * share,
                self.settings.min_confidence
            );
            return doubt(
                found,
                "move the eye cameras until both pupils are large, sharp and ringed in red in Pupil Capture",
            );
        }
        if counts.used == 0 && counts.ill_timed > 0 {
            let remedy =
                "does Pupil Capture's clock run evenly, and did another program set it by Pupil Remote?";
            return doubt("Pupil's samples are of instants that cannot be".into(), remedy);
        }
        None
    }
}

/// The words of an answer: the last part, behind the empty one.
fn answer_of(message: &Message<'_>) -> String {
    let words = message.part(message.count().saturating_sub(1));
    String::from_utf8_lossy(words).chars().filter(|c| !c.is_control()).take(64).collect()
}
