//! A serial line between host and projector: two ways of bytes at the line's rate, drivers with buffers, and faults.
//!
//! It carries bytes and knows nothing of packets. A piece of the stream arrives when its zero byte does, because nothing
//! happens at either end before that.

use crate::cable::{lock, Cable, CableFaults};
use crate::dice::Dice;
use hil_mock::line_port::Line;
use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex};

/// What a driver takes from its program before it takes no more.
pub(crate) const DRIVER_BYTES: usize = 4096;
/// Replies that a driver keeps for its program; further bytes are lost.
pub(crate) const INPUT_BYTES: usize = 4095;
/// Faults are given as shares of packets; most packets of such a line have about so many bytes.
const PACKET_BYTES: f64 = 64.0;
/// Bits of a byte: start, eight, stop.
const BITS: i64 = 10;

/// The line of one life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialSetup {
    /// Bits per second.
    pub baud: u32,
    /// The driver can discard what it was given.
    pub can_flush: bool,
    /// The adapter hands replies on so much later, nanoseconds.
    pub reply_late_ns: i64,
}

/// Who hears what was sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Echo {
    /// Only the other end.
    #[default]
    None,
    /// The host hears itself, between the projector's replies.
    Host,
    /// The host hears itself in the midst of the projector's replies.
    Mixed,
    /// The projector hears itself.
    Projector,
}

/// Shares of bytes to which something happens.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Spoils {
    pub(crate) flip: f64,
    pub(crate) lose: f64,
    pub(crate) twice: f64,
    /// Some bytes in a row are lost.
    pub(crate) gap: f64,
    /// Bytes that nobody sent.
    pub(crate) stray: f64,
    /// Every byte is another one.
    pub(crate) all: bool,
    /// Nothing arrives.
    pub(crate) silent: bool,
}

impl Spoils {
    fn any(&self) -> bool {
        self.all || self.silent || self.flip + self.lose + self.twice + self.gap + self.stray > 0.0
    }
}

/// One direction.
#[derive(Debug, Default)]
pub(crate) struct Way {
    /// What the sender's driver holds; the first byte is in transmission.
    pub(crate) queue: VecDeque<u8>,
    /// When that byte is over; if there is none, when the last one was.
    over_at: i64,
    /// What has arrived of a piece whose zero byte has not.
    pub(crate) begun: Vec<u8>,
    /// Pieces that arrive, and when.
    pub(crate) landing: VecDeque<(i64, Vec<u8>)>,
    /// Bytes that are still to be lost of a gap.
    gap: u64,
    /// Bytes in the queue that a program left when it ended, and when the last of them arrives.
    left: usize,
    left_at: i64,
}

impl Way {
    pub(crate) fn put(&mut self, bytes: &[u8], now: i64, byte_ns: i64) {
        if self.queue.is_empty() && !bytes.is_empty() {
            self.over_at = self.over_at.max(now) + byte_ns;
        }
        self.queue.extend(bytes);
    }

    /// Carries the bytes that are over by `now`. Pieces that are whole go to `heard`, too.
    pub(crate) fn carry(
        &mut self,
        now: i64,
        byte_ns: i64,
        travel_ns: i64,
        spoils: &Spoils,
        dice: &mut Dice,
        heard: &mut Vec<u8>,
    ) {
        let spoiled = spoils.any();
        if !spoiled {
            // Where little is said, a gap of some hundred bytes would outlast its cause by seconds.
            self.gap = 0;
        }
        while self.over_at <= now {
            let Some(byte) = self.queue.pop_front() else { break };
            let at = self.over_at;
            if self.left > 0 {
                self.left -= 1;
                self.left_at = at + travel_ns;
            }
            if !self.queue.is_empty() {
                self.over_at += byte_ns;
            }
            if spoiled {
                self.spoil(byte, at + travel_ns, spoils, dice, heard);
            } else {
                self.hear(byte, at + travel_ns, heard);
            }
        }
    }

    fn spoil(&mut self, byte: u8, at: i64, spoils: &Spoils, dice: &mut Dice, heard: &mut Vec<u8>) {
        if self.gap > 0 {
            self.gap -= 1;
            return;
        }
        if spoils.silent || dice.happens(spoils.lose) {
            return;
        }
        if dice.happens(spoils.gap) {
            self.gap = dice.decades(1, 300) as u64;
            return;
        }
        if dice.happens(spoils.stray) {
            for _ in 0..dice.bits() % 40 {
                self.hear(dice.bits() as u8, at, heard);
            }
        }
        let byte = match (spoils.all, dice.happens(spoils.flip)) {
            (true, _) => dice.bits() as u8,
            (false, true) => byte ^ 1 << (dice.bits() % 8),
            (false, false) => byte,
        };
        self.hear(byte, at, heard);
        if dice.happens(spoils.twice) {
            self.hear(byte, at, heard);
        }
    }

    fn hear(&mut self, byte: u8, at: i64, heard: &mut Vec<u8>) {
        self.begun.push(byte);
        if byte == 0 {
            heard.extend_from_slice(&self.begun);
            self.land(at);
        }
    }

    /// What has begun arrives as it is.
    fn land(&mut self, at: i64) {
        if !self.begun.is_empty() {
            self.landing.push_back((at, std::mem::take(&mut self.begun)));
        }
    }

    /// When something happens that anybody notices.
    pub(crate) fn due(&self, byte_ns: i64) -> i64 {
        let landing = self.landing.front().map_or(i64::MAX, |(at, _)| *at);
        landing.min(self.whole_at(byte_ns))
    }

    /// When the last byte of the next piece in the queue is over.
    pub(crate) fn whole_at(&self, byte_ns: i64) -> i64 {
        let whole = self.queue.iter().position(|byte| *byte == 0);
        whole.map_or(i64::MAX, |before| self.over_at + before as i64 * byte_ns)
    }
}

/// See the module's documentation.
#[derive(Debug)]
pub struct SerialLine {
    setup: SerialSetup,
    travel_ns: i64,
    out: Way,
    back: Way,
    /// What the host's driver holds, and when it arrived.
    input: VecDeque<(i64, Vec<u8>)>,
    old_reply: Vec<u8>,
    dice: Dice,
}

impl SerialLine {
    /// A line that carries nothing yet.
    pub fn new(seed: u64, setup: SerialSetup, travel_ns: i64) -> Self {
        Self {
            setup,
            travel_ns,
            out: Way::default(),
            back: Way::default(),
            input: VecDeque::new(),
            old_reply: Vec::new(),
            dice: Dice::new(seed, 0x11e),
        }
    }

    /// How long a byte takes from the host, nanoseconds.
    fn byte_ns(&self, faults: &CableFaults) -> i64 {
        if faults.slow_milli > 0 {
            self.full_byte_ns() * faults.slow_milli / 1000
        } else {
            self.full_byte_ns()
        }
    }

    /// How long a byte takes at the line's rate, nanoseconds.
    fn full_byte_ns(&self) -> i64 {
        BITS * 1_000_000_000 / i64::from(self.setup.baud)
    }

    /// When something happens on it.
    pub fn due(&self, faults: &CableFaults) -> i64 {
        let byte_ns = self.full_byte_ns();
        let out = match faults.stalled {
            true => self.out.landing.front().map_or(i64::MAX, |(at, _)| *at),
            false => self.out.due(self.byte_ns(faults)),
        };
        // The projector makes new replies when the last byte of the old ones is out.
        let free = self.back.queue.len().checked_sub(1);
        let free = free.map_or(i64::MAX, |n| self.back.over_at + n as i64 * byte_ns);
        out.min(self.back.due(byte_ns)).min(free)
    }

    /// Carries everything up to `now`. True if there was anything to carry.
    pub fn carry(&mut self, now: i64, faults: &CableFaults, is_plugged: bool) -> bool {
        let had_any = !self.out.queue.is_empty() || !self.back.queue.is_empty();
        let byte_ns = self.byte_ns(faults);
        let full_ns = self.full_byte_ns();
        let (mut told, mut replied) = (Vec::new(), Vec::new());
        let share = |of: f64| of / PACKET_BYTES;
        let silent = faults.silent || !is_plugged;
        let out = Spoils {
            flip: share(faults.corrupt),
            lose: share(faults.loss),
            twice: share(faults.twice),
            gap: share(faults.short),
            stray: 0.0,
            all: faults.garbled,
            silent,
        };
        let back = Spoils {
            flip: share(faults.babble),
            stray: share(faults.babble),
            all: faults.garbled,
            silent,
            ..Spoils::default()
        };
        if faults.stalled {
            self.out.over_at = self.out.over_at.max(now + byte_ns);
        } else {
            self.out.carry(now, byte_ns, self.travel_ns, &out, &mut self.dice, &mut told);
        }
        let travel_ns = self.travel_ns + self.setup.reply_late_ns;
        self.back.carry(now, full_ns, travel_ns, &back, &mut self.dice, &mut replied);
        if !replied.is_empty() {
            self.again(&replied, now, faults);
        }
        match faults.echo {
            Echo::None => {}
            Echo::Host => self.back.put(&told, now, full_ns),
            Echo::Mixed => self.mix(&told, now, full_ns),
            Echo::Projector => self.out.put(&replied, now, byte_ns),
        }
        while self.back.landing.front().is_some_and(|(at, _)| *at <= now) {
            let Some((at, bytes)) = self.back.landing.pop_front() else { break };
            let held: usize = self.input.iter().map(|(_, bytes)| bytes.len()).sum();
            if held + bytes.len() <= INPUT_BYTES {
                self.input.push_back((at, bytes));
            }
        }
        had_any
    }

    /// Old replies may arrive again.
    fn again(&mut self, replied: &[u8], now: i64, faults: &CableFaults) {
        if faults.stale > 0.0 && self.dice.happens(faults.stale) {
            let old = self.old_reply.clone();
            if !old.is_empty() {
                self.back.landing.push_back((now + self.travel_ns, old));
            }
        }
        if self.old_reply.is_empty() || faults.stale > 0.0 && self.dice.happens(0.2) {
            self.old_reply.clear();
            self.old_reply.extend_from_slice(replied);
        }
    }

    fn mix(&mut self, told: &[u8], now: i64, byte_ns: i64) {
        if self.back.queue.len() < 2 {
            return self.back.put(told, now, byte_ns);
        }
        let at = 1 + self.dice.bits() as usize % (self.back.queue.len() - 1);
        let rest = self.back.queue.split_off(at);
        self.back.queue.extend(told);
        self.back.queue.extend(rest);
    }

    /// The next bytes that have reached the projector.
    pub fn arrived(&mut self, now: i64) -> Option<(i64, Vec<u8>)> {
        if self.out.landing.front()?.0 > now {
            return None;
        }
        self.out.landing.pop_front()
    }

    /// True when the line has taken all replies.
    pub fn takes_replies(&self) -> bool {
        self.back.queue.is_empty()
    }

    /// The projector replies.
    pub fn reply(&mut self, bytes: &[u8], now: i64) {
        let byte_ns = self.full_byte_ns();
        self.back.put(bytes, now, byte_ns);
    }

    /// The adapter is pulled out of the host: what has left it arrives, and half a packet stays with the projector.
    pub fn pull(&mut self, now: i64) {
        self.out.queue.clear();
        self.out.left = 0;
        self.out.land(now);
        self.back.begun.clear();
        self.back.landing.clear();
        self.input.clear();
    }

    /// The program has ended: nobody adds to what its driver holds.
    pub fn last_words(&mut self) {
        self.out.left = self.out.queue.len();
    }

    /// True while what a program left may still arrive.
    pub fn has_words(&self, now: i64) -> bool {
        self.out.left > 0 || self.out.left_at >= now
    }

    /// The projector starts anew: its replies are gone, and it makes some noise.
    pub fn boot(&mut self, now: i64) {
        self.back.queue.clear();
        let noise: Vec<u8> = (0..self.dice.bits() % 200).map(|_| self.dice.bits() as u8).collect();
        self.reply(&noise, now);
    }

    /// The most pieces that are under way in one direction.
    pub fn pieces(&self) -> usize {
        self.out.landing.len().max(self.back.landing.len())
    }
}

/// The host's driver: what its program does with the port.
#[derive(Clone, Debug)]
pub(crate) struct Driver {
    cable: Arc<Mutex<Cable>>,
    plug: u64,
}

/// The adapter is gone.
#[derive(Debug)]
pub(crate) struct HungUp;

impl From<HungUp> for io::Error {
    fn from(HungUp: HungUp) -> Self {
        io::ErrorKind::BrokenPipe.into()
    }
}

impl Driver {
    /// Opens the port: what waits in it is discarded. Why not, in the words of the operating system.
    pub(crate) fn open(cable: &Arc<Mutex<Cable>>) -> Result<Self, &'static str> {
        let mut state = lock(cable);
        if state.faults.denied {
            state.met.denied += 1;
            return Err("Device or resource busy");
        }
        if state.calls.fails() || !state.plugged {
            return Err("No such file or directory");
        }
        let plug = state.plug;
        if let Some(line) = &mut state.line {
            line.input.clear();
        }
        Ok(Self { cable: cable.clone(), plug })
    }

    /// Works on the line, if the port is not hung up. Receives the time and the faults, too.
    fn with<R>(&self, work: impl FnOnce(&mut SerialLine, i64, &CableFaults) -> R) -> Result<R, HungUp> {
        let mut state = lock(&self.cable);
        let has_failed = state.calls.fails();
        let Cable { plugged, plug, now, line, faults, .. } = &mut *state;
        match line {
            _ if has_failed => Err(HungUp),
            Some(line) if *plugged && *plug == self.plug => Ok(work(line, *now, faults)),
            _ => Err(HungUp),
        }
    }

    /// The next piece that has arrived, and when on the host's clock.
    pub(crate) fn next_piece(&self) -> Result<Option<(i64, Vec<u8>)>, HungUp> {
        let lag = lock(&self.cable).host_lag;
        let piece = self.with(|line, _, _| line.input.pop_front())?;
        Ok(piece.map(|(at, bytes)| (at - lag, bytes)))
    }
}

impl Line for Driver {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(self.with(|line, now, faults| {
            let n = bytes.len().min(DRIVER_BYTES.saturating_sub(line.out.queue.len()));
            let byte_ns = line.byte_ns(faults);
            line.out.put(&bytes[..n], now, byte_ns);
            n
        })?)
    }

    fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
        // Whoever reads the port takes `next_piece`, with its instant.
        Ok(0)
    }

    fn waiting(&self) -> io::Result<usize> {
        Ok(self.with(|line, _, _| line.out.queue.len())?)
    }

    fn discard_output(&self) {
        // The byte in transmission is finished.
        let _ = self.with(|line, _, _| {
            if line.setup.can_flush {
                line.out.queue.truncate(1);
            }
        });
    }
}
