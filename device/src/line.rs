//! A serial port that a client keeps open: it is opened beside the client, read without waiting, and opened again after an
//! unplug. With it comes the pacing of the echoes that map a device's clock.

use crate::stream::{OnThread, Opener, Stream};
use crate::time::HostTime;

const MS: i64 = 1_000_000;
/// Interval between attempts to open the port.
const RETRY_EVERY_NS: i64 = 200 * MS;
/// Echoes that come quickly, at the beginning.
const QUICK_ECHOES: u32 = 20;
const QUICK_ECHO_EVERY_NS: i64 = 10 * MS;
/// An echo that was not answered for so long is given up.
const ECHO_LOST_NS: i64 = 500 * MS;

enum State {
    Idle { retry_at: HostTime },
    Opening,
    Open(Box<dyn Stream>),
}

/// What became of a line in a poll.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PollResult {
    /// It is not open.
    Closed,
    /// It has just been opened: whatever is known of the device is from before.
    Opened,
    /// It is open.
    Open,
}

/// A port that is kept open.
pub(crate) struct Line {
    port: String,
    opener: Box<dyn Opener>,
    state: State,
    problem: Option<String>,
}

/// Opens `port` of the operating system.
fn os_port(port: &str, baud: u32) -> Result<Box<dyn Stream>, String> {
    match crate::tty::open(port, baud) {
        Ok(port) => Ok(Box::new(port)),
        Err(error) => {
            let remedy = crate::tty::refusal(&error).remedy();
            Err(format!("cannot open {port}: {error}; {remedy}"))
        }
    }
}

impl Line {
    /// A line to `port`, which the first poll begins to open.
    pub(crate) fn new(port: &str, baud: u32) -> Self {
        let path = port.to_owned();
        Self::through(port, Box::new(OnThread::new("serial-open", move || os_port(&path, baud))))
    }

    /// The same, but `opener` opens it; `port` is only its name.
    pub(crate) fn through(port: &str, opener: Box<dyn Opener>) -> Self {
        let state = State::Idle { retry_at: HostTime(i64::MIN) };
        Self { port: port.to_owned(), opener, state, problem: None }
    }

    /// Takes a port that is open already; if it is lost, the line opens its own.
    pub(crate) fn take_over(&mut self, port: Box<dyn Stream>) {
        (self.state, self.problem) = (State::Open(port), None);
    }

    /// True while the port is open.
    pub(crate) fn is_open(&self) -> bool {
        matches!(self.state, State::Open(_))
    }

    /// Opens the port if it is time to. Never waits.
    pub(crate) fn poll(&mut self, now: HostTime) -> PollResult {
        match &self.state {
            State::Idle { retry_at } if now >= *retry_at => {
                self.state = match self.opener.begin() {
                    true => State::Opening,
                    false => State::Idle { retry_at: now.plus_ns(RETRY_EVERY_NS) },
                }
            }
            State::Idle { .. } => {}
            State::Opening => match self.opener.outcome() {
                None => {}
                Some(Ok(port)) => {
                    self.take_over(port);
                    return PollResult::Opened;
                }
                Some(Err(why)) => self.lose(now, why),
            },
            State::Open(_) => return PollResult::Open,
        }
        PollResult::Closed
    }

    fn lose(&mut self, now: HostTime, why: String) {
        self.problem = Some(why);
        self.state = State::Idle { retry_at: now.plus_ns(RETRY_EVERY_NS) };
    }

    /// Reads what is there, without waiting: the number of bytes, or `None` if the port is not open or was lost.
    pub(crate) fn read(&mut self, now: HostTime, into: &mut [u8]) -> Option<usize> {
        let State::Open(port) = &mut self.state else { return None };
        match port.read(into) {
            Ok(0) => self.lose(now, format!("{} was unplugged: check cable and supply", self.port)),
            Ok(n) => return Some(n),
            Err(e) if crate::tty::would_wait(&e) => return Some(0),
            Err(e) => self.lose(now, format!("{}: {e}", self.port)),
        }
        None
    }

    /// True if the line took the whole message. Half a message is noise that the device skips.
    pub(crate) fn write(&mut self, message: &[u8]) -> bool {
        let State::Open(port) = &mut self.state else { return false };
        port.write(message).is_ok_and(|sent| sent == message.len())
    }

    /// The port, whether it is open, and what was wrong.
    pub(crate) fn status(&self) -> String {
        let mut text = format!("{} {}", self.port, if self.is_open() { "open" } else { "not open" });
        if let Some(problem) = &self.problem {
            text.push_str(&format!("; {problem}"));
        }
        text
    }
}

/// When to ask for the next echo, and which one is pending.
pub(crate) struct EchoPace {
    every_ns: i64,
    sent: Option<HostTime>,
    due: HostTime,
    count: u32,
}

impl EchoPace {
    /// An echo every `every_ns`, after some that come quickly.
    pub(crate) fn new(every_ns: i64) -> Self {
        Self { every_ns, sent: None, due: HostTime(i64::MIN), count: 0 }
    }

    /// A device that is new: nothing is pending.
    pub(crate) fn begin(&mut self, now: HostTime) {
        (self.sent, self.due, self.count) = (None, now, 0);
    }

    /// The map is to be made anew: quickly again.
    pub(crate) fn hurry(&mut self, now: HostTime) {
        (self.count, self.due) = (0, now);
    }

    /// Whether something may be asked now.
    pub(crate) fn is_due(&self, now: HostTime) -> bool {
        now >= self.due && self.sent.is_none_or(|t| now.ns_since(t) >= ECHO_LOST_NS)
    }

    /// An echo is about to be asked for: sets when the next one is due.
    pub(crate) fn ask(&mut self, now: HostTime) {
        let quick = self.count < QUICK_ECHOES;
        self.due = now.plus_ns(if quick { QUICK_ECHO_EVERY_NS } else { self.every_ns });
        self.count = self.count.saturating_add(1);
    }

    /// The request with the host's time `at` as its token is on its way.
    pub(crate) fn asked(&mut self, at: HostTime) {
        self.sent = Some(at);
    }

    /// When the request with this token was sent, if it is the pending one. Anything else proves nothing.
    pub(crate) fn answered(&mut self, token: u64) -> Option<HostTime> {
        self.sent.take_if(|t| t.0 as u64 == token)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn echoes_come_quickly_at_first_and_only_the_pending_one_counts() {
        let mut pace = EchoPace::new(100 * MS);
        let at = |ms: i64| HostTime(ms * MS);
        let mut asked = Vec::new();
        pace.begin(at(0));
        for ms in 0..1000 {
            if pace.is_due(at(ms)) {
                pace.ask(at(ms));
                pace.asked(at(ms));
                asked.push(ms);
                assert_eq!(pace.answered(1), None, "not the token");
                assert_eq!(pace.answered((ms * MS) as u64), Some(at(ms)));
                assert_eq!(pace.answered((ms * MS) as u64), None, "once");
            }
        }
        let quick: Vec<i64> = (0..21).map(|i| 10 * i).collect();
        assert_eq!(asked[..21], quick[..]);
        assert!(asked[21..].windows(2).all(|w| w[1] - w[0] == 100), "{asked:?}");
        // One that stays unanswered holds the next one up for half a second.
        pace.hurry(at(2000));
        pace.ask(at(2000));
        pace.asked(at(2000));
        assert!(!pace.is_due(at(2499)) && pace.is_due(at(2500)));
    }

    #[test]
    fn a_port_that_is_not_there_is_tried_again_and_named() {
        let mut line = Line::new("/dev/no-such-port", 115_200);
        let begin = std::time::Instant::now();
        while line.problem.is_none() && begin.elapsed().as_secs() < 30 {
            assert_eq!(line.poll(HostTime(0)), PollResult::Closed);
            std::thread::yield_now();
        }
        assert!(line.status().contains("cannot open /dev/no-such-port"), "{}", line.status());
        assert!(!line.is_open() && !line.write(b"x") && line.read(HostTime(0), &mut [0; 4]).is_none());
        // Not before the interval is over.
        line.poll(HostTime(100 * MS));
        assert!(matches!(line.state, State::Idle { .. }));
        line.poll(HostTime(200 * MS));
        assert!(matches!(line.state, State::Opening));
    }
}
