//! The emulated controller: executes one command at a time and returns its reply data, or an error code and its text.

use std::collections::BTreeMap;

use dpm_device::time::HostTime;
use dpm_dlpc900::command::{flag, Command, Opcode};
use dpm_dlpc900::driver::error_meaning;
use dpm_dlpc900::lut::{led, DisplayMode, LutEntry};

use super::patterns::{Patterns, Refusal};
use super::registers::{is_loose, setting};
use super::video::{VideoInput, ABORTED};
use super::{Dlpc900Fault, Options};

/// Time from setting the source until it is locked.
const LOCK_NS: i64 = 300_000_000;
/// Most warnings kept.
const MOST_WARNINGS: usize = 256;

/// State of the sequencer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sequencer {
    /// Stopped.
    Stopped,
    /// Paused after this many microseconds of the sequence.
    Paused(u64),
    /// Running since this instant, from this many microseconds into the sequence.
    Running(HostTime, u64),
}

pub(super) struct Controller {
    pub options: Options,
    pub patterns: Patterns,
    pub sequencer: Sequencer,
    pub mode: DisplayMode,
    pub standby_since: Option<HostTime>,
    pub idle_since: Option<HostTime>,
    pub parked: bool,
    pub blocks_locked: bool,
    /// Set by a fault: bits that are added to the hardware status.
    pub hardware_fault: u8,
    /// What arrives at the video input.
    pub video: VideoInput,
    pub source_present: bool,
    source_set_at: HostTime,
    park_requested: bool,
    settings: BTreeMap<u16, Vec<u8>>,
    pub error: u8,
    pub error_text: String,
    pub warnings: Vec<String>,
    pub faults: Vec<Dlpc900Fault>,
}

fn refuse<T>(code: u8, why: impl ToString) -> Result<T, Refusal> {
    Err((code, why.to_string()))
}

impl Controller {
    pub(super) fn new(options: Options) -> Self {
        Self {
            patterns: Patterns::new(options.dmd, options.plane_order),
            sequencer: Sequencer::Stopped,
            mode: DisplayMode::Video,
            standby_since: None,
            idle_since: None,
            parked: false,
            blocks_locked: options.firmware.locks_blocks(),
            hardware_fault: 0,
            video: VideoInput::default(),
            source_present: options.source_present,
            source_set_at: HostTime(0),
            park_requested: false,
            settings: BTreeMap::new(),
            error: 0,
            error_text: String::new(),
            warnings: Vec::new(),
            faults: Vec::new(),
            options,
        }
    }

    fn warn(&mut self, what: String) {
        if self.warnings.len() < MOST_WARNINGS {
            self.warnings.push(what);
        }
    }

    /// Executes one command: returns the data of its reply (empty for a write), and whether it was refused.
    pub(super) fn execute(&mut self, now: HostTime, c: &Command<'_>) -> (Vec<u8>, bool) {
        self.settle(now);
        // The two queries for the last error leave it unchanged. Some programs send them with the write flag.
        match c.opcode {
            Opcode::ERROR_CODE => return (vec![self.error], false),
            Opcode::ERROR_TEXT => {
                let mut text = self.error_text.clone().into_bytes();
                text.resize(128, 0);
                text[127] = 0;
                return (text, false);
            }
            _ => {}
        }
        let planned =
            self.faults.iter().position(|f| matches!(f, Dlpc900Fault::Refuse(o, _) if *o == c.opcode));
        let outcome = match planned.map(|i| self.faults.swap_remove(i)) {
            Some(Dlpc900Fault::Refuse(_, code)) => refuse(code, error_meaning(code)),
            _ if c.flags & flag::DESTINATION != 0 => refuse(3, "only the projector control is emulated"),
            _ if c.is_read() => self.read(now, c.opcode),
            _ => self.write(now, c).map(|()| Vec::new()),
        };
        match outcome {
            Ok(data) => {
                (self.error, self.error_text) = (0, error_meaning(0).to_owned());
                (data, false)
            }
            Err((code, text)) => {
                self.warn(format!("{}: error {code}: {text}", c.opcode));
                (self.error, self.error_text) = (code, text);
                (Vec::new(), true)
            }
        }
    }

    /// Advances the state to `now`: a sequence that has completed its passes stops.
    pub(super) fn settle(&mut self, now: HostTime) {
        let pattern_mode = matches!(self.mode, DisplayMode::OnTheFly | DisplayMode::PreStored);
        if pattern_mode
            && self.elapsed_us(now).is_some_and(|us| self.patterns.showing(us, self.counts_patterns()).1)
        {
            if let Sequencer::Running(..) = self.sequencer {
                self.sequencer = Sequencer::Stopped;
            }
        }
    }

    fn counts_patterns(&self) -> bool {
        self.options.firmware.major >= 6
    }

    fn elapsed_us(&self, now: HostTime) -> Option<u64> {
        match self.sequencer {
            Sequencer::Stopped => None,
            Sequencer::Paused(us) => Some(us),
            Sequencer::Running(since, from) => Some(from + (now.ns_since(since).max(0) / 1000) as u64),
        }
    }

    /// Why no light leaves the projector, if none does.
    pub(super) fn dark_because(&self) -> Option<&'static str> {
        let leds = self.setting(Opcode::LED_ENABLE);
        match () {
            () if self.standby_since.is_some() => Some("standby"),
            () if self.parked => Some("mirrors parked"),
            () if self.idle_since.is_some() => Some("mirrors exercised"),
            () if self.blocks_locked => Some("mirror blocks locked (errata): park and unpark"),
            () if leds.first().is_none_or(|b| b & 0x0f == 0) => Some("LEDs off"),
            () if !matches!(self.sequencer, Sequencer::Running(..) | Sequencer::Paused(_)) => {
                Some("sequencer stopped")
            }
            () => None,
        }
    }

    /// The pattern lit at `now`.
    pub(super) fn showing(&self, now: HostTime) -> Option<(usize, LutEntry)> {
        if self.dark_because().is_some() || self.mode == DisplayMode::Video {
            return None;
        }
        let place = if self.has_video() {
            // Each frame's patterns are shown once, from its synchronisation on.
            let elapsed = self.video_elapsed_us(now).filter(|us| *us < self.patterns.table_us())?;
            self.patterns.showing(elapsed, self.counts_patterns()).0?
        } else {
            self.patterns.showing(self.elapsed_us(now)?, self.counts_patterns()).0?
        };
        self.patterns.table().get(place).map(|e| (place, *e)).filter(|(_, e)| e.leds & led::WHITE != 0)
    }

    fn is_locked(&self, now: HostTime) -> bool {
        self.source_present && now.ns_since(self.source_set_at) >= LOCK_NS
    }

    pub(super) fn setting(&self, opcode: Opcode) -> Vec<u8> {
        let reset = || setting(opcode, self.options.firmware).unwrap_or_default();
        self.settings.get(&opcode.0).cloned().unwrap_or_else(reset)
    }

    /// Value of a one-byte setting.
    pub(super) fn setting_byte(&self, opcode: Opcode) -> u8 {
        self.setting(opcode).first().copied().unwrap_or(0)
    }

    fn read(&mut self, now: HostTime, opcode: Opcode) -> Result<Vec<u8>, Refusal> {
        let running = matches!(self.sequencer, Sequencer::Running(..));
        Ok(match opcode {
            Opcode::POWER_MODE => vec![u8::from(self.standby_since.is_some())],
            Opcode::DMD_IDLE => vec![u8::from(self.idle_since.is_some())],
            Opcode::DMD_PARK => vec![u8::from(self.parked)],
            Opcode::VERSION => {
                let application = self.options.firmware.to_bytes();
                // API, software configuration and sequencer configuration.
                [application, [0, 0, 0, 2], [0, 0, 0, 1], [0, 0, 0, 1]].concat()
            }
            Opcode::HARDWARE_ID => {
                let mut tag = vec![self.options.dmd.hardware_id()];
                tag.extend_from_slice(format!("DLPR900PROM-{}", &self.options.dmd.name()[3..]).as_bytes());
                tag.resize(32, 0);
                tag
            }
            Opcode::HARDWARE_STATUS => vec![
                (0x01 | self.hardware_fault) | if self.options.dmd.has_two_controllers() { 0x10 } else { 0 },
            ],
            Opcode::SYSTEM_STATUS => vec![0x01],
            Opcode::MAIN_STATUS => {
                let locked = u8::from(self.is_locked(now));
                vec![
                    u8::from(self.parked)
                        | u8::from(running) << 1
                        | locked << 3
                        | u8::from(self.source_present) << 4,
                ]
            }
            Opcode::DISPLAY_MODE => vec![self.mode as u8],
            Opcode::START_STOP => vec![match self.sequencer {
                Sequencer::Stopped => 0,
                Sequencer::Paused(_) => 1,
                Sequencer::Running(..) => 2,
            }],
            Opcode::LUT_CONFIG => {
                let n = (self.patterns.table().len() as u16).to_le_bytes();
                [&n[..], &self.patterns.repeat.to_le_bytes()].concat()
            }
            // 16 bytes, one u16 per depth; the guide prints it under both opcodes.
            Opcode::MIN_EXPOSURE => {
                let least = |d| self.options.dmd.min_exposure_us(d).unwrap_or(0) as u16;
                (1..=8).flat_map(|d| least(d).to_le_bytes()).collect()
            }
            Opcode::DLPA200_FAULT => vec![0],
            _ if setting(opcode, self.options.firmware).is_some() => self.setting(opcode),
            _ => return refuse(3, format!("there is no {opcode} to read")),
        })
    }

    fn write(&mut self, now: HostTime, c: &Command<'_>) -> Result<(), Refusal> {
        let (opcode, data) = (c.opcode, c.data);
        let one = || match data {
            [b, ..] => Ok(*b),
            [] => refuse(6, "the parameter is missing"),
        };
        if self.standby_since.is_some() && opcode != Opcode::POWER_MODE {
            return refuse(5, "in standby only the normal power mode is accepted");
        }
        let stopped = self.sequencer == Sequencer::Stopped;
        match opcode {
            Opcode::POWER_MODE => self.power(now, one()?),
            Opcode::DMD_IDLE => self.idle(now, one()?),
            Opcode::DMD_PARK => self.park(one()?),
            Opcode::DISPLAY_MODE => self.display_mode(now, one()?),
            Opcode::START_STOP => self.start_stop(now, one()?),
            Opcode::LUT_DEFINITION | Opcode::LUT_CONFIG | Opcode::LUT_REORDER if !stopped => {
                refuse(5, "stop the sequence first")
            }
            Opcode::LUT_DEFINITION | Opcode::LUT_CONFIG | Opcode::LUT_REORDER
                if self.mode == DisplayMode::Video =>
            {
                refuse(5, "video mode has no pattern table: select a pattern mode first")
            }
            Opcode::LUT_DEFINITION => self.patterns.define(data),
            Opcode::LUT_CONFIG => self.patterns.configure(data, self.mode),
            Opcode::LUT_REORDER => self.patterns.reorder(data),
            Opcode::BMP_INIT_PRIMARY | Opcode::BMP_INIT_SECONDARY => {
                if self.mode != DisplayMode::OnTheFly || !stopped {
                    return refuse(
                        5,
                        "images are loaded in pattern-on-the-fly mode with the sequence stopped",
                    );
                }
                if let Some(w) = self.patterns.begin_image(data, opcode == Opcode::BMP_INIT_SECONDARY)? {
                    if self.options.strict {
                        return refuse(5, w);
                    }
                    self.warn(w);
                }
                Ok(())
            }
            Opcode::BMP_DATA_PRIMARY | Opcode::BMP_DATA_SECONDARY => {
                if c.flags & flag::REPLY != 0
                    && !self.warnings.iter().any(|w| w.starts_with("image data with"))
                {
                    self.warn(
                        "image data with a reply wanted: seen to corrupt decompression on real hardware"
                            .into(),
                    );
                }
                self.patterns.image_data(data, opcode == Opcode::BMP_DATA_SECONDARY)
            }
            Opcode::INVERT if !stopped => refuse(5, "stop the sequence first"),
            Opcode::TRIG_OUT1 | Opcode::TRIG_OUT2 => self.trigger_out(opcode, data),
            Opcode::BATCH_RUN => refuse(7, "there is no such batch file in flash"),
            Opcode::I2C => refuse(2, "nothing answers on the I2C bus"),
            _ => self.store(now, opcode, data),
        }
    }

    fn store(&mut self, now: HostTime, opcode: Opcode, data: &[u8]) -> Result<(), Refusal> {
        let Some(reset) = setting(opcode, self.options.firmware) else {
            return refuse(3, format!("there is no {opcode} to write"));
        };
        let fits = if is_loose(opcode) {
            (1..=reset.len().max(32)).contains(&data.len())
        } else {
            data.len() == reset.len()
        };
        if !fits {
            return refuse(6, format!("{} data bytes instead of {}", data.len(), reset.len()));
        }
        match opcode {
            Opcode::INPUT_SOURCE | Opcode::RECEIVER => self.source_set_at = now,
            // "Stop first; LUT must be sent again."
            Opcode::INVERT => self.patterns.deactivate(),
            _ => {}
        }
        self.settings.insert(opcode.0, data.to_vec());
        Ok(())
    }

    fn trigger_out(&mut self, opcode: Opcode, data: &[u8]) -> Result<(), Refusal> {
        let Some([invert, r0, r1, f0, f1]) = data.first_chunk::<5>().filter(|_| data.len() == 5) else {
            return refuse(6, format!("{} data bytes instead of 5", data.len()));
        };
        let (rise, fall) = (i16::from_le_bytes([*r0, *r1]), i16::from_le_bytes([*f0, *f1]));
        if *invert > 1 {
            return refuse(6, "inversion is 0 or 1");
        }
        if [rise, fall].iter().any(|d| !(-20..=20_000).contains(d)) {
            return refuse(13, format!("delays of {rise} and {fall} us; -20 to 20000 are possible"));
        }
        self.settings.insert(opcode.0, data.to_vec());
        Ok(())
    }

    fn power(&mut self, now: HostTime, mode: u8) -> Result<(), Refusal> {
        match mode {
            0 => {
                if self.standby_since.take().is_some() {
                    self.blocks_locked = self.options.firmware.locks_blocks();
                }
            }
            1 => {
                self.sequencer = Sequencer::Stopped;
                self.standby_since.get_or_insert(now);
            }
            2 => {
                let (warnings, faults) =
                    (std::mem::take(&mut self.warnings), std::mem::take(&mut self.faults));
                let (present, video) = (self.source_present, std::mem::take(&mut self.video));
                *self = Self {
                    warnings,
                    faults,
                    source_present: present,
                    video,
                    ..Self::new(self.options.clone())
                };
            }
            other => return refuse(6, format!("power mode {other} of 0 to 2")),
        }
        Ok(())
    }

    fn idle(&mut self, now: HostTime, on: u8) -> Result<(), Refusal> {
        match on & 1 {
            0 => {
                if let Some(since) = self.idle_since.take() {
                    if now.ns_since(since) < 3_000_000_000 {
                        self.warn("idle left before 3 s: the mirrors need them".into());
                    }
                }
                Ok(())
            }
            _ if self.sequencer != Sequencer::Stopped => {
                refuse(5, "stop the sequence before the mirrors exercise")
            }
            _ if self.mode == DisplayMode::Video && self.options.strict => refuse(5, "not in video mode"),
            _ => {
                if self.mode == DisplayMode::Video {
                    self.warn("idle in video mode is not supported".into());
                }
                let leds = self.setting_byte(Opcode::LED_ENABLE);
                if leds & 0x08 == 0 && leds & 0x07 != 0 {
                    self.warn("idle with LEDs on by hand: they stay on".into());
                }
                self.idle_since = Some(now);
                Ok(())
            }
        }
    }

    fn park(&mut self, on: u8) -> Result<(), Refusal> {
        if on & 1 != 0 {
            if self.sequencer != Sequencer::Stopped {
                return refuse(5, "stop the sequence before the mirrors are parked");
            }
            self.parked = true;
            self.park_requested = true;
            // The table must be sent again after unparking.
            self.patterns.deactivate();
        } else {
            self.parked = false;
            if std::mem::take(&mut self.park_requested) {
                self.blocks_locked = false;
                // The one way out of an abort, seen in the field: stopped, parked, unparked, and the table again.
                self.hardware_fault &= !ABORTED;
            }
        }
        Ok(())
    }

    fn display_mode(&mut self, now: HostTime, mode: u8) -> Result<(), Refusal> {
        let Some(mode) = DisplayMode::from_byte(mode) else {
            return refuse(6, format!("display mode {mode} of 0 to 3"));
        };
        if self.sequencer != Sequencer::Stopped {
            if self.options.strict {
                return refuse(5, "stop the sequence before the display mode changes");
            }
            self.warn("display mode changed without a stop".into());
            self.sequencer = Sequencer::Stopped;
        }
        if mode == DisplayMode::VideoPattern && self.mode != mode {
            if self.mode != DisplayMode::Video {
                return refuse(5, "video patterns are reached from video mode only");
            }
            if !self.is_locked(now) {
                return refuse(5, "the video source is not locked: set it first and wait about 300 ms");
            }
        }
        if mode != self.mode {
            self.mode = mode;
            self.patterns.clear();
            self.hardware_fault &= !0xc0;
            self.blocks_locked = self.options.firmware.locks_blocks();
        }
        Ok(())
    }

    fn start_stop(&mut self, now: HostTime, what: u8) -> Result<(), Refusal> {
        let elapsed = self.elapsed_us(now);
        match what {
            0 => self.sequencer = Sequencer::Stopped,
            1 => match elapsed {
                Some(us) => self.sequencer = Sequencer::Paused(us),
                None => return refuse(5, "nothing runs that could pause"),
            },
            2 => {
                if self.parked {
                    return refuse(5, "the mirrors are parked");
                }
                if self.idle_since.is_some() {
                    return refuse(5, "the mirrors exercise: leave idle first");
                }
                match self.mode {
                    DisplayMode::Video => return refuse(5, "video mode has no sequence to start"),
                    _ if self.patterns.table().is_empty() => {
                        return refuse(
                            15,
                            "no pattern table is effective: send definitions and configuration",
                        );
                    }
                    DisplayMode::PreStored => return refuse(11, "the flash holds no patterns"),
                    DisplayMode::OnTheFly => {
                        if let Some(i) = self.patterns.missing_image() {
                            return refuse(7, format!("image {i} of the table was not uploaded"));
                        }
                    }
                    DisplayMode::VideoPattern => {
                        // The sequencer aborts and recovers with the next frame that fits.
                        let planned = self.faults.iter().position(|f| *f == Dlpc900Fault::AbortStart);
                        let is_planned = planned.map(|i| self.faults.swap_remove(i)).is_some();
                        if is_planned || self.patterns.table_us() > self.options.video_frame_us {
                            self.hardware_fault |= ABORTED;
                        }
                    }
                }
                if !matches!(self.sequencer, Sequencer::Running(..)) {
                    self.sequencer = Sequencer::Running(now, elapsed.unwrap_or(0));
                }
            }
            other => return refuse(6, format!("{other} is neither stop (0), pause (1) nor start (2)")),
        }
        Ok(())
    }
}
