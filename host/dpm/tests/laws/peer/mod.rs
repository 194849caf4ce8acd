//! A projector written from docs/PROTOCOL.md alone, on a pseudo-terminal. It shares no line with this project's own
//! implementation, and can be made to break any one rule, to test that the check detects it.
#![allow(dead_code)]

mod light;
mod tracks;
mod wire;

use light::{Flash, Level};
use serialport::{SerialPort, TTYPort};
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracks::Following;
use wire::{crc, packet, u16_at, u32_at, u64_at, unstuffed};

/// A clock rate that no frame rate divides.
const HZ: u64 = 921_600;
const WIDTH: u16 = 40;
const HEIGHT: u16 = 30;
const PLANE: usize = 5 * 30;
const MOST_PLANES: u8 = 8;
const BUFFERS: usize = 3;
const SHORTEST_PLANE_NS: u32 = 100_000;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Mode {
    Off,
    Normal,
    Black,
    Frozen,
}

#[derive(Clone)]
struct Config {
    num: u64,
    den: u64,
    watchdog: u64,
    blank: bool,
    late: u64,
    tracks: bool,
    epoch: u64,
    leds: Vec<u8>,
}

/// A frame that is being received.
struct Arriving {
    frame: u32,
    target: u64,
    got: u32,
    xor: bool,
    planes: Vec<Vec<u8>>,
    refused: bool,
}

#[derive(Clone)]
struct Whole {
    frame: u32,
    slot: u64,
    dark: u64,
    planes: Vec<Vec<u8>>,
}

/// Counters in the order of STATUS, from byte 40.
#[derive(Clone, Copy, Default)]
struct StatusCounters {
    slots: u32,
    seen: u32,
    lit: u32,
    repeated: u32,
    blank: u32,
    incomplete: u32,
    late: u32,
    superseded: u32,
    refused: u32,
    packets: u32,
    headers: u32,
    payloads: u32,
    ignored: u32,
    outside: u32,
}

/// The projector.
pub(crate) struct Peer {
    fault: String,
    start: Instant,
    codecs: u32,
    session: u32,
    former: Vec<u32>,
    greeted_at: u64,
    config: Option<Config>,
    mode: Mode,
    latched: u32,
    rest_until: u64,
    heard: u64,
    next_slot: u64,
    newest: Option<u32>,
    arriving: Option<Arriving>,
    waiting: VecDeque<Whole>,
    shown: Option<Whole>,
    base: Option<Whole>,
    light: bool,
    last_plane: u8,
    last_lit: (u32, u64),
    accounted: u32,
    n: StatusCounters,
    damaged: u32,
    flash: Flash,
    level: Level,
    following: Following,
    line: Vec<u8>,
    half: Vec<u8>,
    out: Vec<u8>,
    say_status: bool,
    statuses: u32,
}

/// A peer on a pseudo-terminal, until it is dropped.
pub(crate) struct PeerLine {
    pub path: String,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
    _other_end: File,
}

impl PeerLine {
    /// `fault`: the rule to break; "" for none.
    pub(crate) fn new(fault: &str) -> Self {
        let (mut ours, theirs) = TTYPort::pair().expect("a pseudo-terminal");
        let path = theirs.name().expect("its path");
        // Kept open so that our end does not hang up between clients, but without a claim.
        let other_end = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(libc::O_NOCTTY)
            .open(&path)
            .expect("the other end");
        drop(theirs);
        ours.set_timeout(Duration::from_millis(1)).expect("a time limit");
        let stop = Arc::new(AtomicBool::new(false));
        let (mut peer, stopped) = (Peer::new(fault), stop.clone());
        let thread = std::thread::spawn(move || {
            let mut bytes = [0u8; 4096];
            while !stopped.load(Ordering::Relaxed) {
                match ours.read(&mut bytes) {
                    Ok(n) => peer.receive(&bytes[..n]),
                    Err(e)
                        if matches!(
                            e.kind(),
                            ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted
                        ) => {}
                    Err(_) => break,
                }
                peer.live();
                while !peer.out.is_empty() {
                    match ours.write(&peer.out) {
                        Ok(n) => drop(peer.out.drain(..n)),
                        Err(_) => break,
                    }
                }
                if peer.out.len() > 20_000 {
                    peer.out.clear();
                }
            }
        });
        Self { path, stop, thread: Some(thread), _other_end: other_end }
    }
}

impl Drop for PeerLine {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Peer {
    fn new(fault: &str) -> Self {
        Self {
            fault: fault.to_owned(),
            start: Instant::now(),
            // One that does not read LZ4, for the rule on codecs that the device does not name.
            codecs: match fault {
                "codec-unnamed" | "without-lz4" => 7,
                "hello-answer" => 14,
                _ => 15,
            },
            session: 0,
            former: Vec::new(),
            greeted_at: 0,
            config: None,
            mode: Mode::Off,
            latched: 0,
            rest_until: 0,
            heard: 0,
            next_slot: 0,
            newest: None,
            arriving: None,
            waiting: VecDeque::new(),
            shown: None,
            base: None,
            light: false,
            last_plane: 0,
            last_lit: (0, 0),
            accounted: 0,
            n: StatusCounters::default(),
            damaged: 0,
            flash: Flash::default(),
            level: Level::default(),
            following: Following::default(),
            line: Vec::new(),
            half: Vec::new(),
            out: Vec::new(),
            say_status: false,
            statuses: 0,
        }
    }

    fn breaks(&self, rule: &str) -> bool {
        self.fault == rule
    }

    fn now(&self) -> u64 {
        let us = self.start.elapsed().as_micros() as u64;
        let us = if self.breaks("clock-rate") { us + us / 50 } else { us };
        1_000_000 + us * HZ / 1_000_000
    }

    // --- the line ---

    fn receive(&mut self, bytes: &[u8]) {
        self.advance();
        for &b in bytes {
            if b != 0 {
                self.line.push(b);
                continue;
            }
            let frame = std::mem::take(&mut self.line);
            if let Some(bytes) = unstuffed(&frame).filter(|_| !frame.is_empty()) {
                let bytes = [std::mem::take(&mut self.half), bytes].concat();
                self.packets(&bytes);
            }
        }
    }

    fn live(&mut self) {
        self.advance();
        if std::mem::take(&mut self.say_status) {
            self.status(self.session);
        }
    }

    /// Finds the packets in one frame of the line.
    fn packets(&mut self, mut b: &[u8]) {
        while !b.is_empty() {
            if b.len() < 32 {
                self.n.outside += if self.breaks("noise") { 0 } else { b.len() as u32 };
                return;
            }
            let checked = crc(&b[..28]) == u32_at(b, 28) || self.breaks("header-damaged");
            if &b[..4] != b"DPML" || !checked {
                if &b[..4] == b"DPML" {
                    self.n.headers += 1;
                    self.damage();
                }
                self.n.outside += u32::from(!self.breaks("noise"));
                b = &b[1..];
                continue;
            }
            let n = u32_at(b, 24) as usize & 0xff_ffff;
            let pad = (4 - n % 4) % 4;
            let whole = 32 + if n == 0 { 0 } else { n + pad + 4 };
            let foreign = b[4] != 2 && !self.breaks("version-foreign")
                || !(1..=14).contains(&b[5])
                || b[6] > 3 && !self.breaks("flags-unknown");
            if foreign && self.breaks("type-unknown") {
                b = &b[1..];
                continue;
            }
            if b.len() < whole {
                if self.breaks("cut-short") {
                    self.half = b.to_vec();
                }
                return;
            }
            if foreign {
                self.n.ignored += 1;
            } else {
                self.n.packets += u32::from(!self.breaks("packets-counted") || b[5] == 2);
                let payload = &b[32..32 + n];
                let intact = n == 0
                    || crc(payload) == u32_at(b, 32 + n + pad)
                        && !(self.breaks("padding-ignored")
                            && b[32 + n..32 + n + pad].iter().any(|p| *p != 0));
                self.packet(&b[..32], payload, intact);
            }
            b = &b[whole..];
        }
    }

    fn packet(&mut self, h: &[u8], payload: &[u8], intact: bool) {
        let session = u32_at(h, 8);
        if !intact {
            self.n.payloads += 1;
            self.damage();
            if self.breaks("watchdog-damaged") {
                self.heard = self.now();
            }
            if h[5] == 2 && self.breaks("plane-again") {
                if let Some(a) = &mut self.arriving {
                    a.got &= !(1 << h[7]);
                }
            }
            let obeyed = self.breaks("payload-damaged") || h[5] == 2 && self.breaks("plane-damaged");
            if !obeyed {
                return;
            }
        }
        let length = match h[5] {
            1 => 8,
            3 => 24,
            5 => 24,
            9 | 13 => 4,
            8 | 10 | 11 | 12 => 0,
            _ => payload.len(),
        };
        let wrong = payload.len() != length && !(self.breaks("payload-length") && payload.len() > length);
        if wrong || matches!(h[5], 4 | 7) {
            self.n.ignored += u32::from(!self.breaks("direction") || wrong);
            return;
        }
        match h[5] {
            1 => return self.hello(session, payload),
            8 if self.any(session, "stop-any-session") => return self.stop(),
            12 if self.any(session, "safe-any-session") => return self.safe(),
            10 if self.any(session, "black-any-session") && self.mode != Mode::Off => {
                self.mode = Mode::Black;
                self.light &= self.breaks("black");
                self.say_status = true;
                self.is_ours(session, 10);
                return;
            }
            _ => {}
        }
        if !self.is_ours(session, h[5]) {
            return;
        }
        match h[5] {
            2 => self.plane(h, payload),
            3 => self.commit(h, payload),
            5 => {
                if self.breaks("echo-greeted") && self.config.is_none() {
                    return;
                }
                let now = self.now();
                let mut answer = payload[..8].to_vec();
                answer[7] &= if self.breaks("echo") { 0x7f } else { 0xff };
                answer.extend(now.to_le_bytes());
                answer.extend(self.now().to_le_bytes());
                self.say(5, self.session, &answer);
            }
            6 => self.configure(payload),
            9 => self.arm(u32_at(payload, 0)),
            11 if self.mode == Mode::Normal => {
                self.mode = Mode::Frozen;
                self.light |= self.breaks("freeze-dark");
                self.say_status = true;
            }
            14 => self.tracks(payload),
            13 => {
                if self.arriving.take().is_some_and(|a| !a.refused) {
                    self.n.incomplete += 1;
                }
                self.account(u32_at(payload, 0), self.breaks("credit-sync"));
                self.say_status = true;
            }
            _ => {}
        }
    }

    /// Going dark needs no session, unless this device is to break that rule.
    fn any(&self, session: u32, rule: &str) -> bool {
        !self.breaks(rule) || session == self.session
    }

    fn is_ours(&mut self, session: u32, kind: u8) -> bool {
        let known = session == self.session
            || self.breaks("session-other")
            || self.breaks("session-old") && self.former.contains(&session);
        if self.session == 0 {
            self.say_status = true;
        }
        if self.session == 0 || !known {
            self.n.ignored += 1;
            if self.breaks("watchdog-strangers") {
                self.heard = self.now();
            }
            return false;
        }
        let is_deaf = self.breaks("watchdog-fed") || kind == 14 && self.breaks("tracks-watchdog");
        if kind == 2 || !is_deaf {
            self.heard = self.now();
        }
        true
    }

    fn damage(&mut self) {
        self.damaged += u32::from(self.mode != Mode::Off);
        if self.damaged >= 1000 && !self.breaks("checksum-storm") {
            self.latch(1 << 4);
        }
    }

    fn say(&mut self, kind: u8, session: u32, payload: &[u8]) {
        let spoil = kind == 4 && self.breaks("replies") && self.statuses % 5 == 4;
        let bytes = packet(kind, session, payload, spoil);
        self.out.extend(bytes);
    }

    fn fault(&mut self, code: u16, detail: u16) {
        let mut p = self.latched.to_le_bytes().to_vec();
        p.extend(code.to_le_bytes());
        p.extend(detail.to_le_bytes());
        p.extend(self.now().to_le_bytes());
        self.say(7, self.session, &p);
        self.say_status = true;
    }

    fn status(&mut self, session: u32) {
        self.statuses += 1;
        let state = match (self.session, &self.config, self.mode) {
            (0, ..) if self.breaks("no-session") => 3,
            _ if self.latched != 0 => 6,
            (0, ..) => 0,
            (_, None, _) => 1,
            (_, _, Mode::Off) => 2,
            (_, _, Mode::Normal) => 3,
            (_, _, Mode::Black) => 4,
            (_, _, Mode::Frozen) => 5,
        };
        let free = BUFFERS.saturating_sub(self.waiting.len()) as u32;
        let armed = self.mode != Mode::Off || self.breaks("config-accepted") && self.config.is_some();
        let limit = self.accounted
            + if armed { free } else { 0 }
            + u32::from(self.breaks("law-credit") && state == 3);
        let lit = self.light || self.breaks("law-dark") && state == 2 || self.breaks("arm") && state == 3;
        let mut now = self.now();
        if self.breaks("clock-monotonic") && self.statuses.is_multiple_of(7) {
            now -= HZ / 10;
        }
        let mut p = vec![
            state,
            u8::from(lit),
            if self.breaks("last-plane") { 0 } else { self.last_plane },
            free as u8,
        ];
        for v in [self.latched, limit, self.accounted, self.newest_whole(), self.last_lit.0] {
            p.extend(v.to_le_bytes());
        }
        p.extend(self.last_lit.1.to_le_bytes());
        p.extend(now.to_le_bytes());
        let n = self.n;
        let blank = n.blank + u32::from(self.breaks("law-slots") && n.blank > 3);
        let seen = n.seen + if self.breaks("law-seen") && n.seen > 2 { 9 } else { 0 };
        for v in [
            n.slots,
            seen,
            n.lit,
            n.repeated,
            blank,
            n.incomplete,
            n.late,
            n.superseded,
            n.refused,
            n.packets,
            n.headers,
            n.payloads,
            n.ignored,
            n.outside,
        ] {
            p.extend(v.to_le_bytes());
        }
        p.extend(self.track_counts());
        self.say(4, session, &p);
    }

    fn newest_whole(&self) -> u32 {
        self.base.as_ref().map_or(0, |w| w.frame)
    }

    // --- sessions and states ---

    fn hello(&mut self, session: u32, p: &[u8]) {
        let now = self.now();
        if session == 0 && !self.breaks("hello-zero") {
            self.n.ignored += 1;
            return;
        }
        if self.breaks("replug") && self.greeted_at > 0 && now < self.greeted_at + 3 * HZ {
            return;
        }
        self.greeted_at = now;
        let spoken = (u16_at(p, 0)..=u16_at(p, 2)).contains(&2) || self.breaks("hello-version");
        if !spoken {
            self.fault(1, 2);
        } else if session != self.session || self.breaks("hello-same") {
            self.disarm();
            self.former.push(self.session);
            self.session = session;
            self.config = None;
            self.newest = None;
            self.accounted = 0;
            if !self.breaks("hello-new") {
                self.n = StatusCounters::default();
            }
            self.following = Following::default();
        }
        let mut a = 2u16.to_le_bytes().to_vec();
        a.extend(0x0305u16.to_le_bytes());
        a.extend(self.codecs.to_le_bytes());
        a.extend(WIDTH.to_le_bytes());
        a.extend(HEIGHT.to_le_bytes());
        a.extend([MOST_PLANES, BUFFERS as u8]);
        a.extend(self.offer());
        a.extend((HZ as u32).to_le_bytes());
        a.extend(SHORTEST_PLANE_NS.to_le_bytes());
        a.extend(77u64.to_le_bytes());
        a.extend(self.now().to_le_bytes());
        self.say(1, session, &a);
        if spoken {
            self.heard = now;
            self.say_status = true;
        }
    }

    fn configure(&mut self, p: &[u8]) {
        let planes = if p.len() > 16 { usize::from(p[16]) } else { 0 };
        if p.len() != 40 + planes || !(1..=32).contains(&planes) {
            return self.fault(2, 4);
        }
        let leds = p[40..].to_vec();
        let twice = leds.iter().enumerate().any(|(i, l)| leds[..i].contains(l));
        let (num, den) = (u64::from(u32_at(p, 4)), u64::from(u32_at(p, 8)));
        let watchdog = u64::from(u32_at(p, 12));
        let (mean, window, white) =
            (u64::from(u16_at(p, 20)), u64::from(u32_at(p, 32)), u64::from(u32_at(p, 36)));
        let ms = |v: u64| (500..=3_600_000).contains(&v);
        let limits =
            mean <= 1000 && (mean == 0 && window == 0 || mean > 0 && ms(window)) && (white == 0 || ms(white));
        let format = num > 0
            && den > 0
            && p[17] <= 1
            && (1..=10_000_000).contains(&watchdog)
            && leds.iter().all(|l| l >> 4 < 4 && l & 15 < 8)
            && !twice;
        if !(format || self.breaks("config-format")) || !(limits || self.breaks("limits-format")) {
            return self.fault(2, 4);
        }
        if (u16_at(p, 0), u16_at(p, 2)) != (WIDTH, HEIGHT) && !self.breaks("config-raster") {
            return self.fault(2, 1);
        }
        if planes > usize::from(MOST_PLANES) && !self.breaks("config-planes") {
            return self.fault(2, 2);
        }
        let too_fast = 1_000_000_000 * den < u64::from(SHORTEST_PLANE_NS) * num * planes as u64;
        if too_fast && !self.breaks("config-rate") {
            return self.fault(2, 3);
        }
        if !self.breaks("config-disarms") {
            self.disarm();
        }
        let late = u64::from(p[18]);
        self.config = Some(Config {
            num: num.max(1),
            den: den.max(1),
            watchdog: watchdog * HZ / 1_000_000,
            blank: p[17] == 1,
            late,
            tracks: p[19] & 2 != 0,
            epoch: u64_at(p, 24),
            leds,
        });
        self.level.configure(num, den, [mean, window, white]);
        self.flash = Flash::default();
        self.say_status = true;
    }

    fn arm(&mut self, named: u32) {
        let Some(config) = self.config.clone() else {
            return if self.breaks("arm-unconfigured") { self.fault(3, 2) } else { self.fault(3, 1) };
        };
        if self.latched & !named != 0 && !self.breaks("arm-faults") {
            return self.fault(3, 2);
        }
        let now = self.now();
        if now < self.rest_until {
            return self.fault(3, 3);
        }
        self.latched = 0;
        if self.breaks("slots-over-arms") {
            (self.n.slots, self.n.lit, self.n.repeated, self.n.blank) = (0, 0, 0, 0);
        }
        if self.mode == Mode::Off {
            self.next_slot = config.slot_at(now).map_or(0, |k| k + 1);
            self.damaged = 0;
        } else if self.breaks("arm-twice") {
            self.disarm();
        }
        self.mode = Mode::Normal;
        self.end_light(now);
        self.say_status = true;
    }

    fn stop(&mut self) {
        let light = self.light;
        self.disarm();
        self.light = light && self.breaks("stop");
    }

    fn safe(&mut self) {
        if self.breaks("safe") && self.mode != Mode::Off {
            self.mode = Mode::Black;
            self.light = false;
            self.say_status = true;
        } else {
            self.latch(1 << 3);
        }
    }

    fn latch(&mut self, fault: u32) {
        self.disarm();
        self.latched |= fault;
        self.fault(0, 0);
    }

    fn disarm(&mut self) {
        self.mode = Mode::Off;
        self.light = false;
        self.n.refused +=
            self.waiting.len() as u32 + u32::from(self.arriving.take().is_some_and(|a| !a.refused));
        self.waiting.clear();
        (self.shown, self.base) = (None, None);
        if !self.breaks("tracks-forgotten") {
            self.following.forget();
        }
        self.say_status = true;
    }

    fn account(&mut self, sent: u32, always: bool) {
        if always || (sent.wrapping_sub(self.accounted) as i32) > 0 {
            self.accounted = sent;
        }
    }
}
