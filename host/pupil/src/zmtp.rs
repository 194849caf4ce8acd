//! ZMTP 3 (rfc.zeromq.org/spec/23 and /37) with the NULL mechanism: one end of a connection, as bytes in and out.
//!
//! No I/O and no clock. Whatever comes, memory is bounded: a part has at most [`MOST_PART`] bytes, a message at most
//! [`MOST_PARTS`] parts and [`MOST_MESSAGE`] bytes, a command at most [`MOST_COMMAND`].

/// Bytes of a greeting.
pub const GREETING_BYTES: usize = 64;
/// Most bytes in a part of a message.
pub const MOST_PART: usize = 64 << 10;
/// Most parts of a message.
pub const MOST_PARTS: usize = 8;
/// Most bytes of a message.
pub const MOST_MESSAGE: usize = 128 << 10;
/// Most bytes of a command with its name.
pub const MOST_COMMAND: usize = 512;
/// Most bytes of the context that a PING carries, by spec 37.
const MOST_CONTEXT: usize = 16;

const MORE: u8 = 1;
const LONG: u8 = 2;
const COMMAND: u8 = 4;

/// What a socket does. Only the pairs REQ to REP and SUB to PUB meet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SocketKind {
    /// Asks, and waits for each answer.
    Req,
    /// Answers.
    Rep,
    /// Hears the topics that it has asked for.
    Sub,
    /// Sends to all who have asked.
    Pub,
}

impl SocketKind {
    /// The word in READY.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Req => "REQ",
            Self::Rep => "REP",
            Self::Sub => "SUB",
            Self::Pub => "PUB",
        }
    }

    /// The words of the sockets that it may meet.
    const fn meets(self) -> [&'static str; 2] {
        match self {
            Self::Req => ["REP", "ROUTER"],
            Self::Rep => ["REQ", "DEALER"],
            Self::Sub => ["PUB", "XPUB"],
            Self::Pub => ["SUB", "XSUB"],
        }
    }
}

/// Why a connection cannot go on.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ZmtpError {
    /// The first bytes are no greeting.
    #[error("what answers there does not speak ZeroMQ")]
    NoGreeting,
    /// A version before 3.
    #[error("it speaks ZMTP {0}, and version 3 is needed")]
    Version(u8),
    /// Another mechanism than NULL.
    #[error("it asks for encryption or a password (a mechanism other than NULL)")]
    Mechanism,
    /// A socket that does not fit to ours.
    #[error("it is a socket of kind {0:?}, which does not fit")]
    Kind(String),
    /// It refuses us.
    #[error("it refuses the connection: {0}")]
    Refused(String),
    /// A frame with unknown flags, a command in the wrong place, or bytes that contradict themselves.
    #[error("it sends bytes that are no ZMTP")]
    Malformed,
    /// More bytes or parts than any message has.
    #[error("it sends a message that is too long")]
    TooLong,
}

/// A whole message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message<'a> {
    bytes: &'a [u8],
    ends: &'a [usize],
}

impl<'a> Message<'a> {
    /// How many parts it has, 1 to [`MOST_PARTS`].
    pub fn count(&self) -> usize {
        self.ends.len()
    }

    /// Part `i`, counted from 0; empty if there is none.
    pub fn part(&self, i: usize) -> &'a [u8] {
        let begin = if i == 0 { 0 } else { self.ends.get(i - 1).copied().unwrap_or(self.bytes.len()) };
        let end = self.ends.get(i).copied().unwrap_or(begin);
        self.bytes.get(begin..end).unwrap_or_default()
    }
}

/// What an end has heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event<'a> {
    /// The other end is ready: messages may be sent.
    Ready,
    /// A message.
    Message(Message<'a>),
    /// A subscriber wants this topic (true), or no longer (false).
    Topic(bool, &'a [u8]),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ConnectionPhase {
    Greeting,
    Handshake,
    Traffic,
}

/// One end of a connection.
#[derive(Debug)]
pub struct ZmtpPeer {
    kind: SocketKind,
    stage: ConnectionPhase,
    /// What has come and is not yet whole.
    held: Vec<u8>,
    message: Vec<u8>,
    ends: Vec<usize>,
}

/// The header of a frame: flags, where its body begins, and how long it is.
struct FrameHeader {
    flags: u8,
    begin: usize,
    length: usize,
}

impl ZmtpPeer {
    /// An end of kind `kind`. Puts its greeting and READY into `out`.
    pub fn new(kind: SocketKind, out: &mut Vec<u8>) -> Self {
        let mut greeting = [0; GREETING_BYTES];
        (greeting[0], greeting[9]) = (0xff, 0x7f);
        // 3.0: a peer of 3.1 then takes subscriptions as messages, which both versions have.
        greeting[10] = 3;
        greeting[12..16].copy_from_slice(b"NULL");
        out.extend_from_slice(&greeting);
        let mut ready = b"\x05READY\x0bSocket-Type\0\0\0\x03".to_vec();
        ready.extend_from_slice(kind.word().as_bytes());
        put_frame(COMMAND, &ready, out);
        Self {
            kind,
            stage: ConnectionPhase::Greeting,
            held: Vec::new(),
            message: Vec::new(),
            ends: Vec::new(),
        }
    }

    /// True once both ends have said READY.
    pub fn is_ready(&self) -> bool {
        self.stage == ConnectionPhase::Traffic
    }

    /// Takes bytes as they come; answers go into `out`. What is heard does not depend on how the bytes are split.
    ///
    /// # Errors
    /// The connection must be closed: the other end speaks something else, or does not end.
    pub fn push(
        &mut self,
        bytes: &[u8],
        out: &mut Vec<u8>,
        heard: &mut dyn FnMut(Event<'_>),
    ) -> Result<(), ZmtpError> {
        self.held.extend_from_slice(bytes);
        let held = std::mem::take(&mut self.held);
        let mut at = 0;
        let result = loop {
            match self.step(&held[at..], out, heard) {
                Ok(0) => break Ok(()),
                Ok(used) => at += used,
                Err(e) => break Err(e),
            }
        };
        self.held = held;
        self.held.drain(..at);
        result
    }

    /// Takes the first whole piece of `held`. Returns its length, and 0 if it is not whole yet.
    fn step(
        &mut self,
        held: &[u8],
        out: &mut Vec<u8>,
        heard: &mut dyn FnMut(Event<'_>),
    ) -> Result<usize, ZmtpError> {
        if self.stage == ConnectionPhase::Greeting {
            return self.greeting(held);
        }
        let Some(head) = self.head(held)? else { return Ok(0) };
        let end = head.begin + head.length;
        let Some(body) = held.get(head.begin..end) else { return Ok(0) };
        if head.flags & COMMAND != 0 {
            self.command(body, out, heard)?;
        } else {
            self.part(body, head.flags & MORE != 0, heard)?;
        }
        Ok(end)
    }

    fn greeting(&mut self, held: &[u8]) -> Result<usize, ZmtpError> {
        // Whoever speaks something else is found by its first byte, and need not send 64.
        let is_wrong = |at: usize, byte: u8| held.get(at).is_some_and(|found| *found != byte);
        if is_wrong(0, 0xff) || is_wrong(9, 0x7f) {
            return Err(ZmtpError::NoGreeting);
        }
        match held.get(10) {
            Some(&version) if version < 3 => return Err(ZmtpError::Version(version)),
            _ => {}
        }
        let Some(greeting) = held.get(..GREETING_BYTES) else { return Ok(0) };
        let mut mechanism = [0; 20];
        mechanism[..4].copy_from_slice(b"NULL");
        if greeting[12..32] != mechanism {
            return Err(ZmtpError::Mechanism);
        }
        self.stage = ConnectionPhase::Handshake;
        Ok(GREETING_BYTES)
    }

    /// The header of the next frame, checked before its body is waited for.
    fn head(&self, held: &[u8]) -> Result<Option<FrameHeader>, ZmtpError> {
        let Some(&flags) = held.first() else { return Ok(None) };
        let is_command = flags & COMMAND != 0;
        if flags & !(MORE | LONG | COMMAND) != 0 || (is_command && flags & MORE != 0) {
            return Err(ZmtpError::Malformed);
        }
        let (begin, length) = if flags & LONG != 0 {
            let Some(bytes) = held.get(1..9).and_then(|b| <[u8; 8]>::try_from(b).ok()) else {
                return Ok(None);
            };
            (9, u64::from_be_bytes(bytes))
        } else {
            let Some(&length) = held.get(1) else { return Ok(None) };
            (2, u64::from(length))
        };
        let most = if is_command { MOST_COMMAND } else { MOST_PART };
        if length > most as u64 {
            return Err(ZmtpError::TooLong);
        }
        Ok(Some(FrameHeader { flags, begin, length: length as usize }))
    }

    fn command(
        &mut self,
        body: &[u8],
        out: &mut Vec<u8>,
        heard: &mut dyn FnMut(Event<'_>),
    ) -> Result<(), ZmtpError> {
        let (name, rest) = short(body).ok_or(ZmtpError::Malformed)?;
        if !self.ends.is_empty() {
            // Commands stand between messages, never within one.
            return Err(ZmtpError::Malformed);
        }
        match (name, self.stage) {
            (b"ERROR", _) => {
                let (why, _) = short(rest).unwrap_or((b"", b""));
                let why: String = String::from_utf8_lossy(why).chars().filter(|c| !c.is_control()).collect();
                Err(ZmtpError::Refused(why))
            }
            (b"READY", ConnectionPhase::Handshake) => {
                self.check_kind(rest)?;
                self.stage = ConnectionPhase::Traffic;
                heard(Event::Ready);
                Ok(())
            }
            (_, ConnectionPhase::Handshake) | (b"READY", _) => Err(ZmtpError::Malformed),
            (b"SUBSCRIBE" | b"CANCEL", _) if self.kind == SocketKind::Pub => {
                heard(Event::Topic(name == b"SUBSCRIBE", rest));
                Ok(())
            }
            (b"PING", _) => {
                let context = rest.get(2..).ok_or(ZmtpError::Malformed)?;
                let pong = [b"\x04PONG", &context[..context.len().min(MOST_CONTEXT)]].concat();
                put_frame(COMMAND, &pong, out);
                Ok(())
            }
            // Specification 37 lets a peer ignore what it does not understand.
            _ => Ok(()),
        }
    }

    /// Whether the other end, with these properties, is a socket that fits.
    fn check_kind(&self, mut properties: &[u8]) -> Result<(), ZmtpError> {
        let mut kind = String::new();
        while !properties.is_empty() {
            let (name, rest) = short(properties).ok_or(ZmtpError::Malformed)?;
            let (length, rest) = rest.split_first_chunk::<4>().ok_or(ZmtpError::Malformed)?;
            let length = u32::from_be_bytes(*length) as usize;
            let value = rest.get(..length).ok_or(ZmtpError::Malformed)?;
            if name.eq_ignore_ascii_case(b"Socket-Type") {
                kind = String::from_utf8_lossy(value).chars().take(16).collect();
            }
            properties = &rest[length..];
        }
        self.kind.meets().contains(&kind.as_str()).then_some(()).ok_or(ZmtpError::Kind(kind))
    }

    fn part(&mut self, body: &[u8], more: bool, heard: &mut dyn FnMut(Event<'_>)) -> Result<(), ZmtpError> {
        if self.stage != ConnectionPhase::Traffic {
            return Err(ZmtpError::Malformed);
        }
        if self.ends.len() == MOST_PARTS || self.message.len() + body.len() > MOST_MESSAGE {
            return Err(ZmtpError::TooLong);
        }
        self.message.extend_from_slice(body);
        self.ends.push(self.message.len());
        if more {
            return Ok(());
        }
        let whole = Message { bytes: &self.message, ends: &self.ends };
        match (self.kind, whole.part(0).split_first()) {
            // In version 3.0 a subscription is a message: 1 or 0, and the topic.
            (SocketKind::Pub, Some((word @ (0 | 1), topic))) if whole.count() == 1 => {
                heard(Event::Topic(*word == 1, topic));
            }
            (SocketKind::Pub, _) => {}
            _ => heard(Event::Message(whole)),
        }
        self.message.clear();
        self.ends.clear();
        Ok(())
    }
}

/// A text with its length in one byte before it, and what follows.
fn short(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (&length, rest) = bytes.split_first()?;
    rest.split_at_checked(usize::from(length))
}

fn put_frame(flags: u8, body: &[u8], out: &mut Vec<u8>) {
    match u8::try_from(body.len()) {
        Ok(length) => out.extend_from_slice(&[flags, length]),
        Err(_) => {
            out.push(flags | LONG);
            out.extend_from_slice(&(body.len() as u64).to_be_bytes());
        }
    }
    out.extend_from_slice(body);
}

/// Puts a message of these parts into `out`.
pub fn put_message(parts: &[&[u8]], out: &mut Vec<u8>) {
    for (i, part) in parts.iter().enumerate() {
        put_frame(if i + 1 < parts.len() { MORE } else { 0 }, part, out);
    }
}

/// Puts a question of a REQ socket or an answer of a REP socket into `out`: an empty part, and the words.
pub fn put_words(words: &[u8], out: &mut Vec<u8>) {
    put_message(&[b"", words], out);
}

/// Puts the wish for a topic into `out`: all messages whose first part begins with it.
pub fn put_subscription(topic: &[u8], out: &mut Vec<u8>) {
    put_message(&[&[b"\x01", topic].concat()], out);
}
