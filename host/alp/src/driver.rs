//! An allocated ALP: facts, sequences, queue, light and darkness.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::abi;
use super::error::AlpError;
use super::library::Library;
use super::timing::{FrameTiming, Misfit, SequencePart, Weights};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{FrameRate, HostTime};

/// Runs of a sequence at most, so that a host that dies leaves light for three frames at most.
pub const MAX_RUNS: u32 = 3;
/// How often an end of the light is looked for, and how long between two looks.
const LOOKS: u32 = 100;
const LOOK_EVERY: Duration = Duration::from_millis(1);
/// Frames that are written to measure the cable.
const MEASURED_FRAMES: u32 = 3;

/// Lets time pass.
pub type Pause = Box<dyn Fn(Duration) + Send>;

/// What an ALP is.
#[derive(Clone, Debug, PartialEq)]
pub struct AlpFacts {
    /// The library that drives it.
    pub library: PathBuf,
    /// Its serial number.
    pub serial: i32,
    /// Its version number.
    pub version: i32,
    /// Its panel.
    pub panel: &'static str,
    /// Its mirrors.
    pub raster: Raster,
    /// Free memory in binary pictures when it was opened.
    pub free_memory: i32,
    /// Sequences that can wait.
    pub queue: i32,
    /// Shortest time of a plane, microseconds.
    pub shortest_us: i32,
    /// Longest time of a plane, microseconds.
    pub longest_us: i32,
    /// The highest temperatures that it recommends; older devices name none.
    pub hottest: Temperatures,
}

/// Temperatures in degrees Celsius; `None` where the device has no sensor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Temperatures {
    /// The FPGA that drives the DMD.
    pub driver: Option<f64>,
    /// The FPGA of the application.
    pub application: Option<f64>,
    /// The board.
    pub board: Option<f64>,
}

impl Temperatures {
    /// The hottest.
    pub fn highest(&self) -> Option<f64> {
        self.all().into_iter().flatten().reduce(f64::max)
    }

    /// By how much the hottest sensor exceeds its limit, degrees; negative below it. The limit is `limit`, or what `recommended` says of the
    /// sensor. `None` without a sensor that has a limit.
    pub fn excess(&self, recommended: &Self, limit: Option<f64>) -> Option<f64> {
        let pairs = self.all().into_iter().zip(recommended.all());
        pairs.filter_map(|(now, most)| Some(now? - limit.or(most)?)).reduce(f64::max)
    }

    fn all(&self) -> [Option<f64>; 3] {
        [self.driver, self.application, self.board]
    }
}

/// How far the queue has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueProgress {
    /// Nothing is shown.
    pub is_idle: bool,
    /// Sequences that wait.
    pub waiting: u32,
    /// Number in the queue of what is shown.
    pub queue_id: u32,
    /// Pictures left in the present run, the present one included.
    pub pictures_left: u32,
    /// Pictures of it that are over.
    pub pictures_done: u32,
    /// Time of each, microseconds.
    pub picture_us: u32,
}

/// How frames are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ShowMode {
    /// The planes of a frame.
    pub schedule: PlaneSchedule,
    /// How long each is lit.
    pub weights: Weights,
    /// Frames a second.
    pub rate: FrameRate,
    /// Frames in the device's memory at once.
    pub frames: usize,
    /// Runs of each frame, 1 to [`MAX_RUNS`]; more than one bridge a late host.
    pub runs: u32,
}

/// A sequence that was started: its frame (`None` is the dark picture), and the time of its runs in microseconds.
#[derive(Clone, Copy, Debug)]
struct SequenceStart {
    frame: Option<usize>,
    us: i64,
}

/// An ALP that this process has allocated. Dropping it makes it dark and frees it.
///
/// Every sequence is finite, and a dark picture ends each frame: whatever the panel does with its last picture, no light stays.
pub struct Alp {
    library: Library,
    id: u32,
    name: String,
    facts: AlpFacts,
    pause: Pause,
    dark: Option<u32>,
    frames: Vec<Vec<u32>>,
    timing: Option<FrameTiming>,
    /// Time of each sequence of a frame with all its runs, microseconds.
    times_us: Vec<i64>,
    slot_us: i64,
    runs: u32,
    started: VecDeque<SequenceStart>,
    /// Nothing with light was started since it went dark.
    is_dark: bool,
}

impl std::fmt::Debug for Alp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Alp").field("name", &self.name).field("facts", &self.facts).finish_non_exhaustive()
    }
}

impl Alp {
    /// Opens the library at `library`, or the newest that the system has, and in it the device with the serial number `number`, or the
    /// first one for 0. The device is dark, and a pulled cable stops it.
    ///
    /// # Errors
    /// No library, no device, or one that refuses a call that every ALP-4 and ALP-5 has.
    pub fn open(library: Option<&Path>, number: i32) -> Result<Self, AlpError> {
        Self::open_paced(library, number, Box::new(std::thread::sleep))
    }

    /// The same with another way to let time pass, for a device at virtual pace.
    ///
    /// # Errors
    /// As [`Alp::open`].
    pub fn open_paced(library: Option<&Path>, number: i32, pause: Pause) -> Result<Self, AlpError> {
        let library = Library::open(library)?;
        let name = if number == 0 { "the first ALP".into() } else { format!("ALP {number}") };
        let alloc = library.dev_alloc(number);
        let id = alloc.map_err(|code| AlpError::Call { device: name.clone(), call: "AlpDevAlloc", code })?;
        let facts = AlpFacts {
            library: library.path().to_owned(),
            serial: number,
            version: 0,
            panel: "",
            raster: Raster::new(1, 1).expect("sides of 1"),
            free_memory: 0,
            queue: 0,
            shortest_us: 0,
            longest_us: 0,
            hottest: Temperatures::default(),
        };
        let (frames, times_us, started) = (Vec::new(), Vec::new(), VecDeque::new());
        // From here on dropping it frees the device, whatever fails.
        let mut alp = Self {
            library,
            id,
            name,
            facts,
            pause,
            dark: None,
            frames,
            timing: None,
            times_us,
            slot_us: 0,
            runs: 1,
            started,
            is_dark: true,
        };
        alp.set_up()?;
        Ok(alp)
    }

    fn set_up(&mut self) -> Result<(), AlpError> {
        let ask = |what| self.called("AlpDevInquire", self.library.dev_inquire(self.id, what));
        let serial = ask(abi::DEVICE_NUMBER)?;
        let sides = [abi::DEV_DISPLAY_WIDTH, abi::DEV_DISPLAY_HEIGHT].map(ask);
        let [width, height] = sides.map(|side| side.map(|n| u32::try_from(n).unwrap_or(0)));
        let raster = Raster::new(width?, height?);
        let (version, dmd_type) = (ask(abi::VERSION)?, ask(abi::DEV_DMDTYPE)?);
        let free_memory = ask(abi::AVAIL_MEMORY)?;
        self.name = format!("ALP {serial}");
        let odd_size = || self.failed("AlpDevInquire(ALP_DEV_DISPLAY_WIDTH)", 0);
        let raster = raster.ok_or_else(odd_size)?;
        self.called(
            "AlpDevControl(ALP_USB_DISCONNECT_BEHAVIOUR)",
            self.library.dev_control(self.id, abi::USB_DISCONNECT_BEHAVIOUR, abi::USB_RESET),
        )?;
        self.projection("ALP_PROJ_QUEUE_MODE", abi::PROJ_QUEUE_MODE, abi::PROJ_SEQUENCE_QUEUE)?;
        let queue = self.library.proj_inquire(self.id, abi::PROJ_QUEUE_MAX_AVAIL);
        let queue = self.called("AlpProjInquire(ALP_PROJ_QUEUE_MAX_AVAIL)", queue)?;
        let panel = abi::panel_name(dmd_type);
        self.facts = AlpFacts { serial, version, panel, raster, free_memory, queue, ..self.facts.clone() };
        self.facts.hottest = self.celsius([
            abi::MAX_DDC_FPGA_TEMPERATURE,
            abi::MAX_APPS_FPGA_TEMPERATURE,
            abi::MAX_PCB_TEMPERATURE,
        ]);
        let dark = self.allocate(1)?;
        self.dark = Some(dark);
        let ask = |what| self.called("AlpSeqInquire", self.library.seq_inquire(self.id, dark, what));
        // The limits depend on the binary mode, which the timing puts in force.
        self.called("AlpSeqTiming", self.library.seq_timing(self.id, dark, abi::DEFAULT))?;
        let (shortest_us, longest_us) = (ask(abi::MIN_PICTURE_TIME)?, ask(abi::MAX_PICTURE_TIME)?);
        (self.facts.shortest_us, self.facts.longest_us) = (shortest_us, longest_us);
        self.set_picture_time(dark, shortest_us)?;
        self.write(dark, 0, &vec![0; raster.plane_bytes()])
    }

    fn failed(&self, call: &'static str, code: i32) -> AlpError {
        AlpError::Call { device: self.name.clone(), call, code }
    }

    fn called<T>(&self, call: &'static str, answer: Result<T, i32>) -> Result<T, AlpError> {
        answer.map_err(|code| self.failed(call, code))
    }

    fn projection(&self, call: &'static str, what: i32, value: i32) -> Result<(), AlpError> {
        self.called(call, self.library.proj_control(self.id, what, value))
    }

    /// A sequence of binary pictures in the project's own layout, shown without dark phases.
    fn allocate(&self, pictures: usize) -> Result<u32, AlpError> {
        let sequence = self.called("AlpSeqAlloc", self.library.seq_alloc(self.id, pictures as i32))?;
        let set = |what, value| self.library.seq_control(self.id, sequence, what, value);
        let both = set(abi::DATA_FORMAT, abi::DATA_BINARY_TOPDOWN)
            .and_then(|()| set(abi::BIN_MODE, abi::BIN_UNINTERRUPTED));
        if let Err(code) = both {
            let _ = self.library.seq_free(self.id, sequence);
            return Err(self.failed("AlpSeqControl", code));
        }
        Ok(sequence)
    }

    fn set_picture_time(&self, sequence: u32, asked_us: i32) -> Result<(), AlpError> {
        self.called("AlpSeqTiming", self.library.seq_timing(self.id, sequence, asked_us))?;
        let used = self.library.seq_inquire(self.id, sequence, abi::PICTURE_TIME);
        let used_us = self.called("AlpSeqInquire(ALP_PICTURE_TIME)", used)?;
        if used_us == asked_us {
            return Ok(());
        }
        Err(AlpError::Timing { device: self.name.clone(), asked_us, used_us })
    }

    fn write(&self, sequence: u32, first: usize, planes: &[u8]) -> Result<(), AlpError> {
        let bytes = self.facts.raster.plane_bytes();
        self.called("AlpSeqPut", self.library.seq_put(self.id, sequence, first as i32, bytes, planes))
    }

    /// What it is.
    pub fn facts(&self) -> &AlpFacts {
        &self.facts
    }

    /// Its name for messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The times of frames that are shown like this.
    fn fit(&self, showing: &ShowMode) -> Result<FrameTiming, AlpError> {
        let ShowMode { schedule, weights, rate, .. } = showing;
        let AlpFacts { shortest_us, longest_us, .. } = self.facts;
        let misfit = match FrameTiming::new(schedule, *weights, *rate, shortest_us, longest_us) {
            Ok(timing) => return Ok(timing),
            Err(misfit) => misfit,
        };
        let device = self.name.clone();
        Err(match misfit {
            Misfit::TooFast { left_us, most_hz } => {
                let how = match weights {
                    Weights::Equal => "of equal length and a dark one",
                    Weights::Binary => "of binary weights and a dark one",
                };
                let (planes, hz) = (schedule.len(), rate.hz());
                AlpError::TooFast { device, planes, how, hz, shortest_us, left_us, most_hz }
            }
            Misfit::TooSlow { asked_us } => AlpError::TooSlow { device, longest_us, asked_us },
        })
    }

    /// Refuses a panel of another size than the rig's.
    ///
    /// # Errors
    /// With both sizes.
    pub fn check_raster(&self, raster: Raster) -> Result<(), AlpError> {
        let found = self.facts.raster;
        if found == raster {
            return Ok(());
        }
        Err(AlpError::Raster {
            device: self.name.clone(),
            found_width: found.width(),
            found_height: found.height(),
            width: raster.width(),
            height: raster.height(),
        })
    }

    /// Refuses what the panel, its memory or its queue cannot do.
    ///
    /// # Errors
    /// With the figures.
    pub fn check(&self, showing: &ShowMode) -> Result<(), AlpError> {
        let timing = self.fit(showing)?;
        let device = || self.name.clone();
        let parts = timing.parts.len();
        let needed = showing.frames * (showing.schedule.len() + usize::from(parts == 1));
        let free = self.library.dev_inquire(self.id, abi::AVAIL_MEMORY);
        let free = self.called("AlpDevInquire(ALP_AVAIL_MEMORY)", free)?;
        if needed > usize::try_from(free).unwrap_or(0) {
            return Err(AlpError::Memory { device: device(), free, frames: showing.frames, needed });
        }
        let needed = 2 * (parts + usize::from(parts > 1));
        if needed > usize::try_from(self.facts.queue).unwrap_or(0) {
            return Err(AlpError::Queue { device: device(), places: self.facts.queue, parts, needed });
        }
        Ok(())
    }

    /// Takes memory for the frames and sets their times. Frames of an earlier call are freed.
    ///
    /// # Errors
    /// As [`Alp::check`], and a device that refuses a call.
    pub fn prepare(&mut self, showing: &ShowMode) -> Result<(), AlpError> {
        self.free_frames();
        self.check(showing)?;
        let timing = self.fit(showing)?;
        self.runs = showing.runs.clamp(1, MAX_RUNS);
        let is_one = timing.parts.len() == 1;
        let zero = vec![0; self.facts.raster.plane_bytes()];
        let runs = self.runs as i32;
        for _ in 0..showing.frames {
            self.frames.push(Vec::with_capacity(timing.parts.len()));
            for SequencePart { planes, picture_us, .. } in &timing.parts {
                let sequence = self.allocate(planes + usize::from(is_one))?;
                self.frames.last_mut().expect("just pushed").push(sequence);
                self.set_picture_time(sequence, *picture_us)?;
                if is_one {
                    self.write(sequence, *planes, &zero)?;
                    let set = self.library.seq_control(self.id, sequence, abi::SEQ_REPEAT, runs);
                    self.called("AlpSeqControl(ALP_SEQ_REPEAT)", set)?;
                }
            }
        }
        // A frame and its dark picture are at most as many entries as these; nothing is allocated while frames are shown.
        self.started.reserve(4 * showing.frames * (timing.parts.len() + 1));
        let time_of = |part: &SequencePart| {
            let pictures = part.planes as i64 + i64::from(is_one);
            pictures * i64::from(part.picture_us) * i64::from(if is_one { self.runs } else { 1 })
        };
        self.times_us = timing.parts.iter().map(time_of).collect();
        self.slot_us = showing.rate.slot_len_ns(0) / 1000;
        self.timing = Some(timing);
        Ok(())
    }

    /// Bytes a second that the cable takes, by dark planes written to frame 0.
    ///
    /// # Errors
    /// A device that refuses a call.
    ///
    /// # Panics
    /// Before [`Alp::prepare`].
    pub fn measure_cable(&mut self, clock: &dyn Fn() -> HostTime) -> Result<f64, AlpError> {
        let planes = self.timing.as_ref().expect("prepared").parts.iter().map(|p| p.planes).sum::<usize>();
        let zero = vec![0; self.facts.raster.plane_bytes()];
        let start = clock();
        for _ in 0..MEASURED_FRAMES {
            for plane in 0..planes {
                self.put(0, plane, &zero)?;
            }
        }
        let ns = clock().ns_since(start).max(1);
        Ok((MEASURED_FRAMES as usize * planes * zero.len()) as f64 * 1e9 / ns as f64)
    }

    /// From the order that shows a frame to its first picture, nanoseconds, and how uncertain that is: from the progress of frame 0, which
    /// must be dark. The device has no clock that could be read.
    ///
    /// # Errors
    /// A device that refuses a call.
    pub fn measure_start(&mut self, clock: &dyn Fn() -> HostTime) -> Result<(i64, i64), AlpError> {
        let (mut low, mut high) = (0, 0);
        for _ in 0..MEASURED_FRAMES {
            let ordered = clock();
            self.show(0)?;
            let (mut not_before, mut not_after) = (0, clock().ns_since(ordered) + self.slot_us * 1000);
            for _ in 0..LOOKS {
                let before = clock().ns_since(ordered);
                let progress = self.progress()?;
                if progress.is_idle {
                    break;
                }
                let picture_ns = i64::from(progress.picture_us) * 1000;
                let done = i64::from(progress.pictures_done);
                not_before = not_before.max(before - (done + 1) * picture_ns);
                not_after = not_after.min(clock().ns_since(ordered) - done * picture_ns);
            }
            low = low.max(not_before);
            high = high.max(not_after);
            self.settle();
        }
        Ok((low.midpoint(high.max(low)), (high - low).max(0) / 2))
    }

    /// Refuses frames that the cable cannot carry.
    ///
    /// # Errors
    /// With the figures.
    pub fn check_cable(&self, showing: &ShowMode, bytes_per_s: f64) -> Result<(), AlpError> {
        let frame_bytes = (self.facts.raster.plane_bytes() * showing.schedule.len()) as f64;
        let (hz, planes) = (showing.rate.hz(), showing.schedule.len());
        if frame_bytes * hz <= bytes_per_s {
            return Ok(());
        }
        Err(AlpError::Cable {
            device: self.name.clone(),
            measured_mb: bytes_per_s / 1e6,
            needed_mb: frame_bytes * hz / 1e6,
            planes,
            hz,
            most_hz: bytes_per_s / frame_bytes,
        })
    }

    /// The shortest share of a plane in a frame's time that the panel can show in this way, nanoseconds: what a frame needs at least,
    /// divided by its planes.
    pub fn shortest_share_ns(&self, showing: &ShowMode) -> u32 {
        let AlpFacts { shortest_us, longest_us, .. } = self.facts;
        let any = FrameRate::new(100_000_000, 1).expect("not zero");
        match FrameTiming::new(&showing.schedule, showing.weights, any, shortest_us, longest_us) {
            Err(Misfit::TooFast { most_hz, .. }) => {
                (1e9 / most_hz / showing.schedule.len() as f64).ceil() as u32
            }
            _ => 0,
        }
    }

    /// Frames that memory was taken for.
    pub fn frames(&self) -> usize {
        self.frames.len()
    }

    /// Time of a frame on the mirrors with its dark picture, nanoseconds.
    pub fn frame_ns(&self) -> i64 {
        self.timing.as_ref().map_or(0, |timing| timing.frame_us() * 1000)
    }

    /// Writes one plane of a frame. The frame must not be shown or wait: see [`Alp::is_busy`].
    ///
    /// # Errors
    /// The device refuses, or is gone.
    ///
    /// # Panics
    /// When the frame or the plane does not exist, or the bytes are not one plane.
    pub fn put(&mut self, frame: usize, plane: usize, bytes: &[u8]) -> Result<(), AlpError> {
        let parts = &self.timing.as_ref().expect("prepared").parts;
        let at = parts.iter().rposition(|part| part.first <= plane).expect("a plane of the frame");
        assert!(plane < parts[at].first + parts[at].planes, "plane {plane}");
        self.write(self.frames[frame][at], plane - parts[at].first, bytes)
    }

    /// Shows a frame as soon as what was started before is over, or after the picture that is on the mirrors if that would take longer than
    /// a quarter of a slot: the light of a late frame ends early, and no delay adds up.
    ///
    /// # Errors
    /// The device refuses, or is gone.
    pub fn show(&mut self, frame: usize) -> Result<(), AlpError> {
        let before = self.progress()?;
        let is_late = !before.is_idle && self.left_us(&before) > self.slot_us / 4;
        if is_late && before.waiting > 0 {
            self.drop_waiting()?;
        }
        for part in 0..self.frames[frame].len() {
            let us = self.times_us[part];
            self.start(self.frames[frame][part], Some(frame), us)?;
        }
        if self.frames[frame].len() > 1 {
            self.start(self.dark.expect("set up"), None, i64::from(self.facts.shortest_us))?;
        }
        if !before.is_idle && (is_late || self.runs > 1) {
            // In the last picture of a run, the next run may begin before the order arrives: then it ends after one picture.
            let after_picture = is_late || before.pictures_left <= 1;
            let how = if after_picture { abi::PROJ_ABORT_FRAME } else { abi::PROJ_ABORT_SEQUENCE };
            // What was shown before may be over by now, or may be ending by an earlier order: then the device refuses, and all is well.
            let _ = self.library.proj_control(self.id, how, before.queue_id as i32);
        }
        Ok(())
    }

    /// Time until the present run and all that waits are over, microseconds.
    fn left_us(&self, progress: &QueueProgress) -> i64 {
        let present = i64::from(progress.pictures_left) * i64::from(progress.picture_us);
        let waiting = self.started.iter().rev().take(progress.waiting as usize);
        present + waiting.map(|started| started.us).sum::<i64>()
    }

    fn drop_waiting(&mut self) -> Result<(), AlpError> {
        self.projection("AlpProjControl(ALP_PROJ_RESET_QUEUE)", abi::PROJ_RESET_QUEUE, abi::DEFAULT)
    }

    fn start(&mut self, sequence: u32, frame: Option<usize>, us: i64) -> Result<(), AlpError> {
        self.called("AlpProjStart", self.library.proj_start(self.id, sequence))?;
        self.started.push_back(SequenceStart { frame, us });
        self.is_dark &= frame.is_none();
        Ok(())
    }

    /// Asks how far the queue has come.
    ///
    /// # Errors
    /// The device is gone.
    pub fn progress(&mut self) -> Result<QueueProgress, AlpError> {
        let raw = self.library.proj_progress(self.id, abi::PROJ_PROGRESS);
        let raw = self.called("AlpProjInquireEx(ALP_PROJ_PROGRESS)", raw)?;
        let is_idle = raw.flags & abi::FLAG_QUEUE_IDLE != 0;
        let waiting = raw.waiting;
        // Sequences are shown in the order in which they were started: those that are left are the newest.
        let left = waiting as usize + usize::from(!is_idle);
        let over = self.started.len().saturating_sub(left);
        self.started.drain(..over);
        let pictures_done = raw.pictures_of_run.saturating_sub(raw.pictures);
        Ok(QueueProgress {
            is_idle,
            waiting,
            queue_id: raw.queue_id,
            pictures_left: raw.pictures,
            pictures_done,
            picture_us: raw.picture_us,
        })
    }

    /// Whether a frame was shown or waited when [`Alp::progress`] was last asked, or was started since.
    pub fn is_busy(&self, frame: usize) -> bool {
        self.started.iter().any(|started| started.frame == Some(frame))
    }

    /// Goes dark: drops what waits, and puts a dark picture behind the one that is on the mirrors, which is cut short. Light ends within
    /// the time of one plane.
    ///
    /// # Errors
    /// The device refuses, or is gone.
    pub fn darken(&mut self) -> Result<(), AlpError> {
        let Some(dark) = self.dark.filter(|_| !self.is_dark) else { return Ok(()) };
        self.drop_waiting()?;
        self.start(dark, None, i64::from(self.facts.shortest_us))?;
        if self.library.proj_control(self.id, abi::PROJ_ABORT_FRAME, abi::DEFAULT) == Err(abi::NOT_IDLE) {
            // Another end is already asked for.
            self.projection("AlpProjControl(ALP_PROJ_ABORT_ASYNC)", abi::PROJ_ABORT_ASYNC, abi::DEFAULT)?;
        }
        self.is_dark = true;
        Ok(())
    }

    /// Its temperatures now.
    pub fn temperatures(&self) -> Temperatures {
        self.celsius([abi::DDC_FPGA_TEMPERATURE, abi::APPS_FPGA_TEMPERATURE, abi::PCB_TEMPERATURE])
    }

    fn celsius(&self, what: [i32; 3]) -> Temperatures {
        // One unit is 1/256 of a degree. A sensor that the device lacks is refused.
        let of = |what| self.library.dev_inquire(self.id, what).ok().map(|raw| f64::from(raw) / 256.0);
        let [driver, application, board] = what.map(of);
        Temperatures { driver, application, board }
    }

    /// Waits until nothing is shown, for a tenth of a second at most.
    fn settle(&self) {
        for _ in 0..LOOKS {
            if self.library.proj_inquire(self.id, abi::PROJ_STATE) != Ok(abi::PROJ_ACTIVE) {
                return;
            }
            (self.pause)(LOOK_EVERY);
        }
    }

    fn free_frames(&mut self) {
        if self.frames.is_empty() {
            return;
        }
        if self.darken().is_ok() {
            self.settle();
        }
        for sequence in std::mem::take(&mut self.frames).into_iter().flatten() {
            let _ = self.library.seq_free(self.id, sequence);
        }
        (self.timing, self.started) = (None, VecDeque::new());
    }
}

impl Drop for Alp {
    fn drop(&mut self) {
        if self.darken().is_ok() {
            self.settle();
        }
        // Stopping ends later than its call returns, and what is in use cannot be freed.
        let _ = self.library.proj_halt(self.id);
        self.settle();
        let _ = self.library.dev_halt(self.id);
        self.started.clear();
        for sequence in std::mem::take(&mut self.frames).into_iter().flatten().chain(self.dark.take()) {
            let _ = self.library.seq_free(self.id, sequence);
        }
        let _ = self.library.dev_free(self.id);
    }
}
