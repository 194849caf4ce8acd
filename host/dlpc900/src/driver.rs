//! The driver: turns calls into commands to a DLPC900, and its answers into values, or into errors that name the
//! remedy.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::command::{
    Command, Opcode, ReplyAssembler, ReportFault, TooLong, MAX_BMP_BYTES, MAX_REPLY_DATA, REPORT_BYTES,
};
use super::lut::{DisplayMode, Dmd};
use super::port::POLL;
use super::sequence::{self, LedSetup, PatternSequence, SequenceError, Step, Version};
use super::video::VideoPatterns;

pub use super::error::{error_meaning, remedy, Dlpc900Error, PortError};
pub use super::port::{DarkLine, HidPort, SecondLine};
pub use super::status::Status;

/// Timeout for sending one report, and for receiving one reply. The controller answers within a few milliseconds; while
/// it takes an image it may refuse data for some time.
const TIMEOUT: Duration = Duration::from_millis(1000);
/// Replies to other commands that are dropped before a reply counts as missing (another program's, or one never read).
const MOST_STALE: usize = 8;
/// From the start of video patterns to the switch of the LEDs: by then an abort would have been reported.
const ABORT_SHOWS: Duration = Duration::from_millis(500);
/// How often a start of video patterns is tried.
const MOST_STARTS: u32 = 4;
/// Timeout for one report once a stop was requested: the process must end within two seconds, whatever the cable does.
const HURRY: Duration = Duration::from_millis(250);
/// How far an upload has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UploadProgress {
    /// Image bytes sent.
    pub sent: usize,
    /// Image bytes of the whole upload.
    pub total: usize,
}

/// Counters of one connection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Commands sent.
    pub commands: u64,
    /// Replies used.
    pub replies: u64,
    /// Reports dropped because they answered another command or made no sense.
    pub stale: u64,
}

/// True once whoever waits for the controller should wait no more.
pub type StopAsked = Arc<dyn Fn() -> bool + Send + Sync>;

/// A DLPC900 behind a cable.
pub struct Dlpc900<P> {
    port: P,
    /// Locked from a command to its reply.
    turn: Arc<Mutex<()>>,
    /// When set, every long operation ends with [`Dlpc900Error::Stopped`].
    stop: Option<StopAsked>,
    timeout: Duration,
    sequence: u8,
    firmware: Version,
    dmd: Dmd,
    tag: String,
    counters: Counters,
}

impl<P: HidPort> Dlpc900<P> {
    /// Greets the controller: reads its firmware and DMD. It asks a second time if the first question gets no answer: a
    /// program that was killed may have left half a command, which takes the first one with it, or a pending read,
    /// which takes the answer.
    pub fn new(port: P) -> Result<Self, Dlpc900Error> {
        let firmware = Version { major: 0, minor: 0, patch: 0 };
        let (dmd, tag, counters) = (Dmd::Dlp6500, String::new(), Counters::default());
        let (turn, stop, timeout) = (Arc::default(), None, TIMEOUT);
        let mut this = Self { port, turn, stop, timeout, sequence: 0, firmware, dmd, tag, counters };
        let version = match this.read(Opcode::VERSION, &[]) {
            Err(Dlpc900Error::Port { source: PortError::Timeout, .. }) => this.read(Opcode::VERSION, &[])?,
            other => other?,
        };
        let bytes = version.first_chunk::<4>().ok_or_else(|| short(Opcode::VERSION, &version, 4))?;
        this.firmware = Version::from_bytes(*bytes);
        let hardware = this.read(Opcode::HARDWARE_ID, &[])?;
        let (id, tag) = hardware.split_first().ok_or_else(|| short(Opcode::HARDWARE_ID, &hardware, 1))?;
        this.dmd = Dmd::from_hardware_id(*id).ok_or(Dlpc900Error::UnknownDmd(*id))?;
        let text = tag.split(|b| *b == 0).next().unwrap_or_default();
        this.tag = text.iter().map(|b| if b.is_ascii_graphic() { char::from(*b) } else { '?' }).collect();
        Ok(this)
    }

    /// The DMD found.
    pub fn dmd(&self) -> Dmd {
        self.dmd
    }

    /// The firmware found.
    pub fn firmware(&self) -> Version {
        self.firmware
    }

    /// Counters since the connection was made.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// A way to make the controller dark from another thread; `None` if the cable has none.
    pub fn dark_line(&self) -> Option<DarkLine> {
        self.port.second_line().map(|line| DarkLine { line, turn: Arc::clone(&self.turn) })
    }

    /// Once `stop` is true, every long operation (uploads, the mirrors' three seconds, waiting for a video signal) ends
    /// with [`Dlpc900Error::Stopped`] within 20 ms. Calls that make the controller dark are exempt once
    /// [`Dlpc900::hurry`] was called.
    pub fn stop_when(&mut self, stop: StopAsked) {
        self.stop = Some(stop);
    }

    /// For the end of a run: commands are no longer stopped, and none waits for the cable for more than 250 ms.
    pub fn hurry(&mut self) {
        (self.stop, self.timeout) = (None, HURRY);
    }

    fn go_on(&self) -> Result<(), Dlpc900Error> {
        match &self.stop {
            Some(stop) if stop() => Err(Dlpc900Error::Stopped),
            _ => Ok(()),
        }
    }

    /// Waits for `time`, or until a stop is requested.
    fn pause_for(&mut self, time: Duration) -> Result<(), Dlpc900Error> {
        let mut left = time;
        while !left.is_zero() {
            self.go_on()?;
            let piece = left.min(POLL);
            self.port.pause(piece);
            left -= piece;
        }
        Ok(())
    }

    /// The cable, for tests and for closing it.
    pub fn into_port(self) -> P {
        self.port
    }

    /// Reads a command's data.
    pub fn read(&mut self, opcode: Opcode, parameters: &[u8]) -> Result<Vec<u8>, Dlpc900Error> {
        let doing = opcode.to_string();
        self.exchange(opcode, parameters, true, &doing, true)
    }

    /// Sends a command and receives its reply. No other command may come between, because the controller keeps only one
    /// reply. With `explain`, asks the controller for the reason of a refusal.
    fn exchange(
        &mut self,
        opcode: Opcode,
        data: &[u8],
        read: bool,
        doing: &str,
        explain: bool,
    ) -> Result<Vec<u8>, Dlpc900Error> {
        let turn = Arc::clone(&self.turn);
        let held = turn.lock().unwrap_or_else(PoisonError::into_inner);
        // Checked under the lock: after a stop was requested and a dark line has had its turn, nothing starts the
        // sequence again.
        self.go_on()?;
        self.send(opcode, data, read, true, doing)?;
        let (refused, data) = self.receive(doing)?;
        drop(held);
        if refused && explain {
            Err(self.why_refused(doing))
        } else {
            Ok(data)
        }
    }

    /// Writes a command's data and waits for the acknowledgement.
    pub fn write(&mut self, opcode: Opcode, data: &[u8]) -> Result<(), Dlpc900Error> {
        self.write_about(opcode, data, opcode.to_string())
    }

    fn write_about(&mut self, opcode: Opcode, data: &[u8], doing: String) -> Result<(), Dlpc900Error> {
        self.exchange(opcode, data, false, &doing, true).map(|_| ())
    }

    fn send(
        &mut self,
        opcode: Opcode,
        data: &[u8],
        read: bool,
        reply: bool,
        doing: &str,
    ) -> Result<(), Dlpc900Error> {
        self.sequence = self.sequence.wrapping_add(1);
        let command = if read {
            Command::read(self.sequence, opcode, data)
        } else {
            Command::write(self.sequence, opcode, data, reply)
        };
        let reports = command.reports().map_err(|e: TooLong| protocol(doing, e))?;
        for report in reports {
            self.port.write_report(&report, self.timeout).map_err(|source| self.failed(doing, source))?;
        }
        self.counters.commands += 1;
        Ok(())
    }

    fn failed(&self, doing: &str, source: PortError) -> Dlpc900Error {
        Dlpc900Error::Port { doing: format!("{}: {doing}", self.port.name()), source }
    }

    /// Waits for the reply to the last command: returns whether it was refused, and its data.
    fn receive(&mut self, doing: &str) -> Result<(bool, Vec<u8>), Dlpc900Error> {
        let mut assembler = ReplyAssembler::default();
        let mut report = [0; REPORT_BYTES];
        let mut stale = 0;
        // A reply has at most this many reports, and at most this many stale replies precede it, so the loop ends.
        for _ in 0..MOST_STALE * MAX_REPLY_DATA.div_ceil(REPORT_BYTES) {
            self.port.read_report(&mut report, self.timeout).map_err(|source| self.failed(doing, source))?;
            match assembler.push(&report) {
                Ok(None) => {}
                Ok(Some(reply)) if reply.sequence == self.sequence => {
                    let (refused, data) = (reply.is_refused(), reply.data.to_vec());
                    self.counters.replies += 1;
                    return Ok((refused, data));
                }
                Ok(Some(_)) | Err(ReportFault::Short(_) | ReportFault::Length(_)) => {
                    stale += 1;
                    self.counters.stale += 1;
                    if stale > MOST_STALE {
                        break;
                    }
                }
            }
        }
        Err(protocol(doing, format!("{stale} replies to other commands and none to this one")))
    }

    /// Reads the last error's code and text.
    fn why_refused(&mut self, doing: &str) -> Dlpc900Error {
        match self.error_code() {
            Ok(code) => self.refused(doing, code),
            Err(e) => e,
        }
    }

    fn refused(&mut self, doing: &str, code: u8) -> Dlpc900Error {
        let text = self.error_text().unwrap_or_default();
        let text = if text.is_empty() { error_meaning(code).to_owned() } else { text };
        let remedy = self.remedy_for(code);
        Dlpc900Error::Refused { doing: doing.to_owned(), code, text, remedy }
    }

    /// The remedy for `code`: "not allowed now" has as many remedies as there are states in which nothing can be shown.
    fn remedy_for(&mut self, code: u8) -> &'static str {
        if code != 5 {
            return remedy(code);
        }
        let is = |d: &mut Self, opcode| d.ask(opcode).is_ok_and(|b| b.first().is_some_and(|b| b & 1 != 0));
        if is(self, Opcode::POWER_MODE) {
            "the controller is in standby: `dpm dlpc900 wake` brings it back"
        } else if is(self, Opcode::DMD_PARK) {
            "the mirrors are parked: `dpm dlpc900 unpark` frees them; upload again afterwards"
        } else if is(self, Opcode::DMD_IDLE) {
            "the mirrors exercise: `dpm dlpc900 leave-idle` ends that, in 3 s"
        } else {
            remedy(code)
        }
    }

    fn ask(&mut self, opcode: Opcode) -> Result<Vec<u8>, Dlpc900Error> {
        // No explanation here: asking why a question about errors was refused would recurse without end.
        self.exchange(opcode, &[], true, &opcode.to_string(), false)
    }

    /// The code of the last error, 0 for none.
    pub fn error_code(&mut self) -> Result<u8, Dlpc900Error> {
        let data = self.ask(Opcode::ERROR_CODE)?;
        data.first().copied().ok_or_else(|| short(Opcode::ERROR_CODE, &data, 1))
    }

    /// The last error as the controller's text.
    pub fn error_text(&mut self) -> Result<String, Dlpc900Error> {
        let data = self.ask(Opcode::ERROR_TEXT)?;
        let text = data.split(|b| *b == 0).next().unwrap_or_default();
        Ok(text.iter().filter(|b| b.is_ascii() && !b.is_ascii_control()).map(|b| char::from(*b)).collect())
    }

    fn byte(&mut self, opcode: Opcode) -> Result<u8, Dlpc900Error> {
        let data = self.read(opcode, &[])?;
        data.first().copied().ok_or_else(|| short(opcode, &data, 1))
    }

    /// Reads the whole status.
    pub fn status(&mut self) -> Result<Status, Dlpc900Error> {
        Ok(Status {
            firmware: self.firmware,
            dmd: self.dmd,
            tag: self.tag.clone(),
            mode: DisplayMode::from_byte(self.byte(Opcode::DISPLAY_MODE)?),
            hardware: self.byte(Opcode::HARDWARE_STATUS)?,
            system: self.byte(Opcode::SYSTEM_STATUS)?,
            main: self.byte(Opcode::MAIN_STATUS)?,
        })
    }

    /// Executes `steps` in order and stops at the first that fails.
    pub fn run(
        &mut self,
        steps: &[Step<'_>],
        progress: &mut dyn FnMut(UploadProgress),
    ) -> Result<(), Dlpc900Error> {
        let size = |s: &Step<'_>| if let Step::Image { bytes, .. } = s { bytes.len() } else { 0 };
        let total = steps.iter().map(size).sum();
        let (mut sent, mut entry) = (0, 0);
        for step in steps {
            self.go_on()?;
            match step {
                Step::Write(opcode, data) => {
                    let mut doing = opcode.to_string();
                    if *opcode == Opcode::LUT_DEFINITION {
                        doing = format!("LUT entry {entry}: {doing}");
                        entry += 1;
                    }
                    self.write_about(*opcode, data, doing)?;
                }
                Step::Image { secondary, index, bytes } => {
                    self.image(*secondary, *index, bytes, &mut |n| {
                        sent += n;
                        progress(UploadProgress { sent, total });
                    })?;
                }
                Step::Pause(time) => self.pause_for(*time)?,
                Step::WaitLocked(time) => {
                    if !self.wait(*time, |d| Ok(d.byte(Opcode::MAIN_STATUS)? & 8 != 0))? {
                        return Err(Dlpc900Error::NotLocked(*time));
                    }
                }
                Step::WaitReady(time) => {
                    // While the controller wakes up it may not answer at all.
                    let ready =
                        self.wait(*time, |d| Ok(d.byte(Opcode::HARDWARE_STATUS).is_ok_and(|s| s & 1 != 0)))?;
                    if !ready {
                        return Err(Dlpc900Error::Hardware(format!("nothing within {time:?} of waking")));
                    }
                }
            }
        }
        Ok(())
    }

    /// Polls until `done` or until `most` has passed, in which a question that nobody answers counts with its timeout.
    fn wait(
        &mut self,
        most: Duration,
        done: impl Fn(&mut Self) -> Result<bool, Dlpc900Error>,
    ) -> Result<bool, Dlpc900Error> {
        let begin = self.port.now();
        loop {
            if done(self)? {
                return Ok(true);
            }
            if self.port.now().saturating_sub(begin) >= most {
                return Ok(false);
            }
            self.pause_for(POLL)?;
        }
    }

    fn image(
        &mut self,
        secondary: bool,
        index: u16,
        bytes: &[u8],
        sent: &mut dyn FnMut(usize),
    ) -> Result<(), Dlpc900Error> {
        let (init, load) = if secondary {
            (Opcode::BMP_INIT_SECONDARY, Opcode::BMP_DATA_SECONDARY)
        } else {
            (Opcode::BMP_INIT_PRIMARY, Opcode::BMP_DATA_PRIMARY)
        };
        let doing = format!("image {index}: {init}");
        let (i, n) = (index.to_le_bytes(), (bytes.len() as u32).to_le_bytes());
        self.write_about(init, &[i[0], i[1], n[0], n[1], n[2], n[3]], doing)?;
        let doing = format!("image {index}: {load}");
        let mut data = Vec::with_capacity(2 + MAX_BMP_BYTES);
        for chunk in bytes.chunks(MAX_BMP_BYTES) {
            data.clear();
            data.extend_from_slice(&(chunk.len() as u16).to_le_bytes());
            data.extend_from_slice(chunk);
            self.go_on()?;
            // No acknowledgement: requesting one was seen to corrupt the decompression. The cable's own flow control
            // sets the pace.
            let turn = Arc::clone(&self.turn);
            let held = turn.lock().unwrap_or_else(PoisonError::into_inner);
            self.send(load, &data, false, false, &doing)?;
            drop(held);
            sent(chunk.len());
        }
        // The data were not acknowledged, so ask once whether they were accepted.
        match self.error_code()? {
            0 => Ok(()),
            code => Err(self.refused(&doing, code)),
        }
    }

    /// Uploads a sequence; it is then loaded and stopped.
    pub fn upload(
        &mut self,
        sequence: &PatternSequence,
        leds: LedSetup,
        progress: &mut dyn FnMut(UploadProgress),
    ) -> Result<(), Dlpc900Error> {
        if sequence.dmd() != self.dmd {
            let (made_for, found) = (sequence.dmd().name(), self.dmd.name());
            return Err(SequenceError::OtherDmd { made_for, found }.into());
        }
        self.run(&sequence.upload(leds, self.firmware), progress)
    }

    /// Sets up video patterns and starts them, with the LEDs last: what is wrong with the signal shows in the dark.
    ///
    /// # Errors
    /// Those of the cable and of the controller; [`Dlpc900Error::Hardware`] if the sequence aborts every time.
    pub fn start_video_patterns(&mut self, video: &VideoPatterns) -> Result<(), Dlpc900Error> {
        let steps = video.dark_steps(self.firmware).map_err(SequenceError::from)?;
        self.run(&steps, &mut |_| ())?;
        self.start_until_it_runs(video)
    }

    /// Starts loaded video patterns in the dark. A start in the middle of a change of the signal aborts the sequence, and
    /// the controller stays in that state; so it is tried some times before the LEDs are switched on.
    fn start_until_it_runs(&mut self, video: &VideoPatterns) -> Result<(), Dlpc900Error> {
        let mut tries = 0;
        loop {
            self.run(&sequence::start(), &mut |_| ())?;
            self.pause_for(ABORT_SHOWS)?;
            let status = self.status()?;
            tries += 1;
            if !status.is_aborted() || tries == MOST_STARTS {
                if let Some(what) = status.complaint() {
                    return Err(Dlpc900Error::Hardware(what));
                }
                break;
            }
            self.run(&video.again(), &mut |_| ())?;
        }
        self.run(&video.light(), &mut |_| ())
    }

    /// Sets up video patterns; they are then loaded and stopped.
    pub fn load_video_patterns(&mut self, video: &VideoPatterns) -> Result<(), Dlpc900Error> {
        let steps = video.steps(self.firmware).map_err(SequenceError::from)?;
        self.run(&steps, &mut |_| ())
    }

    /// Brings the controller out of every state in which it shows nothing whatever the commands: standby, parked
    /// mirrors, and the 50/50 exercise, which every run ends in and which must last three seconds. True if it was in
    /// one of them. The table must be sent afterwards.
    ///
    /// # Errors
    /// Those of the cable and of the controller.
    pub fn make_ready(&mut self) -> Result<bool, Dlpc900Error> {
        let mut rested = false;
        if self.byte(Opcode::POWER_MODE)? & 1 != 0 {
            self.wake()?;
            rested = true;
        }
        if self.byte(Opcode::DMD_PARK)? & 1 != 0 {
            self.unpark()?;
            rested = true;
        }
        let exercises = match self.byte(Opcode::DMD_IDLE) {
            Ok(byte) => byte & 1 != 0,
            // If the firmware does not report it, assume the exercise: leaving it when it is not active does nothing.
            Err(Dlpc900Error::Refused { .. }) => true,
            Err(e) => return Err(e),
        };
        if exercises {
            self.leave_idle()?;
            rested = true;
        }
        Ok(rested)
    }

    /// Starts the loaded sequence and makes sure that it runs.
    pub fn start(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::start(), &mut |_| ())?;
        self.check_running()
    }

    fn check_running(&mut self) -> Result<(), Dlpc900Error> {
        match self.status()?.complaint() {
            Some(what) => Err(Dlpc900Error::Hardware(what)),
            None => Ok(()),
        }
    }

    /// Stops the sequence.
    pub fn stop(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::stop(), &mut |_| ())
    }

    /// Stops the sequence at the end of a run, whatever the cable did before: half a command may have been sent, and the next
    /// one may be lost with it. Everything after it is in a hurry too; see [`Dlpc900::hurry`].
    pub fn stop_at_the_end(&mut self) -> Result<(), Dlpc900Error> {
        self.hurry();
        self.stop().or_else(|e| if e.is_gone() { Err(e) } else { self.stop() })
    }

    /// Pauses the sequence.
    pub fn pause(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::pause(), &mut |_| ())
    }

    /// Puts the mirrors into the 50/50 exercise, LEDs off.
    pub fn idle(&mut self) -> Result<(), Dlpc900Error> {
        let mode = DisplayMode::from_byte(self.byte(Opcode::DISPLAY_MODE)?).unwrap_or(DisplayMode::Video);
        self.run(&sequence::idle(mode, self.firmware), &mut |_| ())
    }

    /// Leaves the exercise, after at least three seconds of it.
    pub fn leave_idle(&mut self) -> Result<(), Dlpc900Error> {
        // The start of the exercise is unknown here: wait as if it were now.
        self.run(&sequence::leave_idle(Duration::ZERO), &mut |_| ())
    }

    /// Parks the mirrors, LEDs off.
    pub fn park(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::park(), &mut |_| ())
    }

    /// Unparks the mirrors; the sequence must be uploaded again.
    pub fn unpark(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::unpark(), &mut |_| ())
    }

    /// Enters standby, which must happen before power is cut.
    pub fn standby(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::standby(), &mut |_| ())
    }

    /// Leaves standby.
    pub fn wake(&mut self) -> Result<(), Dlpc900Error> {
        self.run(&sequence::wake(self.firmware), &mut |_| ())
    }
}

fn protocol(doing: &str, what: impl ToString) -> Dlpc900Error {
    Dlpc900Error::Protocol { doing: doing.to_owned(), what: what.to_string() }
}

fn short(opcode: Opcode, data: &[u8], wanted: usize) -> Dlpc900Error {
    protocol(&opcode.to_string(), format!("{} bytes instead of at least {wanted}", data.len()))
}
