//! From frames to light: slots, which frame is due, what ends by itself, and how much light that is.

use super::wire::{lz4, rle, u32_at, u64_at};
use super::{Arriving, Config, Mode, Peer, Whole, BUFFERS, HEIGHT, HZ, PLANE, WIDTH};
use std::collections::VecDeque;

impl Config {
    pub(super) fn start(&self, slot: u64) -> u64 {
        let ticks = u128::from(slot) * u128::from(HZ) * u128::from(self.den) / u128::from(self.num);
        self.epoch + ticks as u64
    }

    pub(super) fn slot_at(&self, tick: u64) -> Option<u64> {
        let d = tick.checked_sub(self.epoch)?;
        let k = (u128::from(d) + 1) * u128::from(self.num) - 1;
        Some((k / (u128::from(HZ) * u128::from(self.den))) as u64)
    }
}

/// Counts flashes, slot by slot.
#[derive(Default)]
pub(super) struct Flash {
    extreme: f64,
    rising: Option<bool>,
    changes: VecDeque<u64>,
}

impl Flash {
    /// True when there were more than eight opposing changes within a second.
    fn slot(&mut self, now: u64, luminance: f64) -> bool {
        let up = luminance >= self.extreme + 0.1 && self.extreme < 0.8;
        let down = luminance <= self.extreme - 0.1 && luminance < 0.8;
        let changed = match self.rising {
            Some(true) => down,
            Some(false) => up,
            None => up || down,
        };
        if changed {
            self.rising = Some(up);
            self.extreme = luminance;
            self.changes.push_back(now);
        } else if self.rising == Some(true) {
            self.extreme = self.extreme.max(luminance);
        } else if self.rising == Some(false) {
            self.extreme = self.extreme.min(luminance);
        }
        self.changes.retain(|at| now - at < HZ);
        changed && self.changes.len() > 8
    }
}

/// Applies the limits on light, slot by slot.
#[derive(Default)]
pub(super) struct Level {
    mean: Option<(f64, usize)>,
    white: Option<u64>,
    rests: [u64; 2],
    pause: u64,
    levels: VecDeque<f64>,
    run: u64,
    since: u64,
}

impl Level {
    pub(super) fn configure(&mut self, num: u64, den: u64, [mean, window, white]: [u64; 3]) {
        let slots = |ms: u64| (ms * num / (1000 * den)).max(1);
        *self = Self::default();
        if mean > 0 {
            self.mean = Some((mean as f64 / 1000.0, slots(window) as usize));
        }
        if white > 0 {
            self.white = Some(slots(white));
        }
        self.rests = [window, white].map(|ms| ms.max(2000) * HZ / 1000);
        self.pause = (100 * num).div_ceil(1000 * den).max(1);
    }

    /// The required rest in ticks if a slot of `level` would exceed a limit.
    fn slot(&mut self, level: f64, keeps_mean: bool, keeps_white: bool) -> Option<u64> {
        let mut rest = None;
        if let Some((most, window)) = self.mean {
            self.levels.push_back(level);
            while self.levels.len() > window {
                self.levels.pop_front();
            }
            if keeps_mean && self.levels.iter().sum::<f64>() > most * window as f64 + 1e-9 {
                rest = Some(self.rests[0]);
            }
        }
        if let Some(allowed) = self.white {
            if level >= 0.95 {
                self.run = if self.run == 0 { 1 } else { self.run + self.since + 1 };
                self.since = 0;
                if keeps_white && self.run > allowed {
                    rest = Some(self.rests[1]);
                }
            } else {
                self.since += 1;
                if self.since >= self.pause {
                    self.run = 0;
                }
            }
        }
        if rest.is_some() {
            (self.run, self.since) = (0, 0);
            self.levels.clear();
        }
        rest
    }
}

impl Peer {
    fn newer(&self, a: u32, b: u32) -> bool {
        if self.breaks("frame-wrap") {
            a > b
        } else {
            (a.wrapping_sub(b) as i32) > 0
        }
    }

    /// Starts to receive `frame`; `false` for a frame whose time is over.
    fn enter(&mut self, frame: u32, target: u64) -> bool {
        if let Some(a) = &self.arriving {
            if a.frame == frame {
                return a.target == target || self.breaks("plane-target");
            }
        }
        if self.newest.is_some_and(|n| !self.newer(frame, n)) && !self.breaks("frame-old") {
            return false;
        }
        if self.arriving.take().is_some_and(|a| !a.refused) && !self.breaks("frame-abandoned") {
            self.n.incomplete += 1;
        }
        self.newest = Some(frame);
        self.n.seen += 1;
        let refused = self.mode == Mode::Off;
        self.n.refused += u32::from(refused);
        let planes = vec![vec![0; PLANE]; self.config.as_ref().map_or(0, |c| c.leds.len())];
        self.arriving = Some(Arriving { frame, target, got: 0, xor: false, planes, refused });
        true
    }

    pub(super) fn plane(&mut self, h: &[u8], payload: &[u8]) {
        let leds = self.config.as_ref().map_or(Vec::new(), |c| c.leds.clone());
        let (k, codec) = (usize::from(h[7]), h[6]);
        let named = self.codecs >> codec & 1 == 1 || self.breaks("codec-unnamed");
        let led = leds.get(k).is_some_and(|l| *l == h[27] || self.breaks("plane-led"));
        let length = if codec == 0 { payload.len() == PLANE } else { payload.len() < PLANE };
        if !led || !named || !length || !self.enter(u32_at(h, 12), u64_at(h, 16)) {
            self.n.ignored += 1;
            return;
        }
        let base = self.base.as_ref().map(|w| w.planes[k].clone());
        let there = self.arriving.as_ref().is_none_or(|a| a.refused || a.got >> k & 1 == 1);
        if there || codec == 2 && base.is_none() {
            self.n.ignored += 1;
            return;
        }
        let long = if self.breaks("codec-rle") { 127 } else { 128 };
        let decoded = match codec {
            0 if self.breaks("codec-raw") => None,
            0 => Some(payload.to_vec()),
            1 => rle(payload, long),
            2 if self.breaks("codec-xor") => None,
            2 => rle(payload, long)
                .map(|x| x.iter().zip(base.unwrap_or_default()).map(|(a, b)| a ^ b).collect()),
            _ if self.breaks("codec-lz4") => None,
            _ => lz4(payload),
        };
        let short =
            codec == 1 && self.breaks("codec-rle-wrong") || codec == 3 && self.breaks("codec-lz4-wrong");
        let decoded = match decoded {
            Some(mut plane) if short => {
                plane.resize(PLANE, 0);
                Some(plane)
            }
            other => other,
        };
        match (decoded.filter(|p| p.len() == PLANE), &mut self.arriving) {
            (Some(plane), Some(a)) => {
                a.planes[k] = plane;
                a.got |= 1 << k;
                a.xor |= codec == 2;
                self.last_plane = k as u8;
            }
            _ => self.n.ignored += 1,
        }
    }

    pub(super) fn commit(&mut self, h: &[u8], p: &[u8]) {
        let (sent, kept, base) = (u32_at(p, 0), u32_at(p, 4), u32_at(p, 8));
        let (count, dark, target) = (u32_at(p, 12), u64_at(p, 16), u64_at(h, 16));
        let wrong = sent & kept != 0 || dark <= target && !self.breaks("dark-from-wrong");
        if wrong || self.config.is_none() || !self.enter(u32_at(h, 12), target) {
            self.n.ignored += 1;
            return;
        }
        let free = BUFFERS.saturating_sub(self.waiting.len());
        let limit = self.accounted.wrapping_add(if self.mode == Mode::Off { 0 } else { free as u32 });
        let beyond = (count.wrapping_sub(limit) as i32) > 0 || free == 0;
        if self.breaks("credit-lost") {
            self.accounted += 1;
        } else {
            self.account(count, false);
        }
        self.say_status = !self.breaks("status-commit");
        let Some(a) = self.arriving.take().filter(|a| !a.refused) else { return };
        if beyond && !self.breaks("credit-beyond") {
            self.n.refused += 1;
            return;
        }
        let all = u32::MAX >> (32 - a.planes.len());
        let named = sent | kept == all || self.breaks("masks");
        let arrived = a.got == sent || self.breaks("plane-missing") && a.got != 0;
        let loose = self.breaks("kept-base") && kept != 0 || self.breaks("codec-xor-base") && kept == 0;
        let based = kept == 0 && !a.xor
            || loose
            || self.base.as_ref().is_some_and(|w| w.frame == base) && !(self.breaks("kept") && kept != 0);
        if !(named && arrived && based) {
            self.n.incomplete += 1;
            return;
        }
        let mut planes = a.planes;
        for (k, plane) in planes.iter_mut().enumerate().filter(|(k, _)| kept >> k & 1 == 1) {
            if let Some(w) = &self.base {
                plane.clone_from(&w.planes[k]);
            }
        }
        let Some(config) = self.config.clone() else { return };
        let slot = config.slot_at(a.target).unwrap_or(0);
        let whole = Whole { frame: a.frame, slot, dark, planes };
        if !self.breaks("base-dropped") {
            self.base = Some(whole.clone());
        }
        if a.target > self.now() + 2 * HZ && !self.breaks("frame-early") {
            self.n.refused += 1;
            return;
        }
        let late = self.next_slot.saturating_sub(slot);
        let allowed = match self.fault.as_str() {
            "frame-late" => 255,
            "frame-late-allowed" => 0,
            _ => config.late,
        };
        if late > allowed {
            self.n.late += 1;
            return;
        }
        self.base = Some(whole.clone());
        self.waiting.push_back(whole);
    }

    /// Performs everything that happens by itself up to now, in order of time.
    pub(super) fn advance(&mut self) {
        let now = self.now();
        self.advance_to(now);
        self.light_planes(now);
    }

    fn advance_to(&mut self, now: u64) {
        while let Some(config) = self.config.clone() {
            let bites = match self.fault.as_str() {
                "watchdog" => u64::MAX,
                "watchdog-black" if self.mode == Mode::Black => u64::MAX,
                _ => self.heard + config.watchdog.max(1),
            };
            if self.mode == Mode::Off {
                if self.breaks("watchdog-disarmed") && bites <= now && self.latched == 0 {
                    self.latch(1);
                }
                return;
            }
            let mut start = config.start(self.next_slot);
            if self.breaks("slot-start") {
                start = config.epoch + self.next_slot * (HZ * config.den / config.num);
            }
            let ends = self.dark_at().filter(|d| *d < start && !self.breaks("dark-from-mid-slot"));
            let next = ends.unwrap_or(start);
            if next.min(bites) > now {
                return;
            }
            if bites <= next {
                return self.latch(1);
            }
            match ends {
                Some(dark) => self.end_light(dark),
                None => self.slot(&config, start),
            }
        }
    }

    fn dark_at(&self) -> Option<u64> {
        let frozen = self.mode == Mode::Frozen && !self.breaks("dark-from-frozen");
        let never = self.breaks("dark-from") || frozen || !self.light;
        self.shown.as_ref().filter(|_| !never).map(|w| w.dark)
    }

    pub(super) fn end_light(&mut self, now: u64) {
        if self.dark_at().is_some_and(|d| d <= now) {
            self.light_planes(now);
            self.light = false;
            self.shown = None;
            self.following.forget();
            self.say_status = true;
        }
    }

    fn slot(&mut self, config: &Config, start: u64) {
        self.light_planes(start);
        let slot = self.next_slot;
        self.next_slot += 1;
        self.say_status |= !self.breaks("status-slots");
        // The newest frame that is due, or, if this device is to be wrong, the oldest.
        let due: Vec<usize> = (0..self.waiting.len()).filter(|i| self.waiting[*i].slot <= slot).collect();
        let mut taken: Vec<Whole> = Vec::new();
        if let Some(&last) = due.last() {
            let upto = if self.breaks("frame-superseded") { 0 } else { last };
            taken = self.waiting.drain(..=upto).collect();
        }
        let mut new = taken.pop();
        let others = taken.len() as u32;
        let moves = self.mode == Mode::Normal || self.mode == Mode::Frozen && self.breaks("freeze");
        if moves {
            self.n.superseded += others;
            if new.as_ref().is_some_and(|w| w.dark <= start) && !self.breaks("dark-from-late") {
                self.n.late += 1;
                new = None;
            }
        } else {
            let used_up = others + u32::from(new.is_some());
            if self.breaks("black-frames") {
                self.n.superseded += used_up;
            } else {
                self.n.refused += used_up;
            }
            new = None;
        }
        if new.is_none() {
            self.end_light(start);
        }
        let repeats = match self.mode {
            Mode::Frozen => self.light,
            Mode::Normal => {
                self.shown.is_some()
                    && config.blank == self.breaks("underrun-blank")
                    && !self.breaks("underrun-repeat")
            }
            _ => false,
        };
        let of = |w: &Whole| light_of(config, &w.planes);
        let (level, luminance) = match (&new, &self.shown) {
            (Some(w), _) => of(w),
            (None, Some(w)) if repeats => of(w),
            _ => (0.0, 0.0),
        };
        self.n.slots += u32::from(!self.breaks("slots-counted") || new.is_some());
        if let Some(rest) = self.level.slot(level, !self.breaks("limit-mean"), !self.breaks("limit-white")) {
            self.n.refused += u32::from(new.is_some());
            self.n.blank += 1;
            self.rest_until = start + rest;
            return self.latch(1 << 7);
        }
        if let Some(mut w) = new {
            self.n.lit += 1;
            self.damaged = 0;
            self.last_lit = (w.frame, start + if self.breaks("frame-lit") { 900 } else { 0 });
            if let (true, Some(before)) = (self.breaks("dark-from-replaced"), &self.shown) {
                w.dark = w.dark.min(before.dark + 1);
            }
            self.shown = Some(w);
            self.light = true;
        } else if repeats {
            self.n.repeated += 1;
            self.light = true;
        } else {
            self.n.blank += u32::from(!self.breaks("slots-counted"));
            self.light = false;
        }
        self.begin_planes(config, slot);
        if self.flash.slot(start, luminance) && !self.breaks("flashes") {
            self.rest_until = start + 2 * HZ;
            self.latch(1 << 6);
        }
    }
}

/// Level and luminance of a frame, 0 to 1.
fn light_of(config: &Config, planes: &[Vec<u8>]) -> (f64, f64) {
    let mut drive = [0.0f64; 4];
    for (led, plane) in config.leds.iter().zip(planes) {
        let lit: u32 = plane.iter().map(|b| b.count_ones()).sum();
        let share = f64::from(lit) / (f64::from(WIDTH) * f64::from(HEIGHT));
        drive[usize::from(led >> 4) & 3] += share * f64::from(1 << (led & 7)) / 255.0;
    }
    let [r, g, b] = [0, 1, 2].map(|c| drive[c] + drive[3]);
    (r.max(g).max(b), 0.2126 * r + 0.7152 * g + 0.0722 * b)
}
