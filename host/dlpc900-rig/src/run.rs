//! `dpm run` on a DLPC900: frames that are loaded in advance, or patterns from a video signal. Supervises the
//! controller and puts it to rest.
//!
//! A frame takes seconds over USB to a DLPC900, so no tracker sample during the run affects its light. In preloaded
//! mode it repeats the first frames of the rig's known motion, each with three 8-bit patterns (red, green, blue)
//! whose bits the controller weights itself. In video mode the light comes from the source at its video input; this
//! program sets up the controller and supervises it.

mod word;

use super::failure;
use super::keys::{Dlpc900Config, Dlpc900Mode, NO_WATCHDOG};
use dpm_common::clock::Stopwatch;
use dpm_device::link::faults;
use dpm_device::planes::{Channel, PlaneSchedule};
use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, HidPort, PortError};
use dpm_dlpc900::image::PlaneOrder;
use dpm_dlpc900::lut::{led, Dmd, LutEntry, IMAGE_PLANES, MAX_IMAGES};
use dpm_dlpc900::sequence::{BitPattern, LedSetup, PatternSequence, Repeat, SequenceBuilder, SequenceError};
use dpm_dlpc900::usb::{self, UsbHid, UsbPlace};
use dpm_dlpc900::video::{share_us, VideoPatterns};
use dpm_render::pack::{pack, BitPlaneFrame, Kernel};
use dpm_render::{RenderError, Renderer};
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::method_choice;
use dpm_rig::order::Order;
use dpm_rig::pipeline::{renderer_settings, PipelineError};
use dpm_rig::presence;
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::open_gpu;
use dpm_rig::still::{draw, poses_at};
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::Duration;
use word::{standing_after, Over, Word};

/// How often the run checks for orders. The dark thread has already obeyed them by then.
const STEP: Duration = Duration::from_millis(20);
/// How long another process may use the controller at the start: the previous run, or the process that puts the
/// controller to rest after a SIGKILL.
const BUSY_PATIENCE_NS: u64 = 5_000_000_000;
/// How often to query the controller's state, and to search for a lost controller.
const LOOK_NS: u64 = 200_000_000;

/// Report of a run on a DLPC900.
#[derive(Clone, Debug, serde::Serialize)]
pub(crate) struct Dlpc900Report {
    /// Version of the program.
    pub version: &'static str,
    /// The DMD.
    pub dmd: &'static str,
    /// "preloaded" or "video".
    pub mode: &'static str,
    /// Frames loaded; null in video mode, in which the frames come from elsewhere.
    pub frames_loaded: Option<usize>,
    /// Frames per second according to the times in the pattern table.
    pub frame_rate_hz: f64,
    /// Patterns in the table.
    pub patterns: usize,
    /// Bytes of coded images loaded; null in video mode.
    pub image_bytes: Option<usize>,
    /// Duration of the last set-up, seconds.
    pub setup_s: f64,
    /// How often the controller was lost and set up again.
    pub came_back: u64,
    /// Wall time from the start of the sequence to its end, seconds.
    pub shown_s: f64,
    /// Warnings for the operator.
    pub warnings: Vec<String>,
}

impl Dlpc900Report {
    /// The report as text.
    pub(crate) fn to_table(&self) -> String {
        let mut out = format!(
            "projector  {} ({}), {} patterns, {:.3} frames/s\nset up in  {:.2} s, shown for {:.2} s, came back {} times\n",
            self.dmd, self.mode, self.patterns, self.frame_rate_hz, self.setup_s, self.shown_s, self.came_back
        );
        if let (Some(frames), Some(bytes)) = (self.frames_loaded, self.image_bytes) {
            out += &format!("loaded     {frames} frames in {bytes} bytes\n");
        }
        for warning in &self.warnings {
            out += &format!("warning: {warning}\n");
        }
        out
    }
}

/// What the controller shows.
pub(crate) enum Show {
    /// Loaded frames.
    Preloaded(PatternSequence),
    /// Patterns from the video signal.
    Video(VideoPatterns),
}

impl Show {
    /// Loads it; the sequence is stopped afterwards.
    fn load<P: HidPort>(&self, d: &mut Dlpc900<P>) -> Result<(), Dlpc900Error> {
        match self {
            Self::Preloaded(sequence) => d.upload(sequence, LedSetup::default(), &mut |_| ()),
            Self::Video(video) => d.load_video_patterns(video),
        }
    }

    fn entries(&self) -> &[LutEntry] {
        match self {
            Self::Preloaded(sequence) => sequence.entries(),
            Self::Video(video) => &video.entries,
        }
    }
}

/// Maximum number of frames of `planes` planes in the memory of a DMD's controller.
pub(crate) fn frames_held(dmd: Dmd, planes: usize) -> usize {
    let images = (dmd.max_planes() as usize / IMAGE_PLANES).min(MAX_IMAGES);
    images * (IMAGE_PLANES / planes.max(1))
}

/// Makes `frames` into a sequence that runs forever. Each channel is one pattern of its eight bits, and all patterns
/// of a frame take `frame_us` us. `exposure_us`: exposure of each pattern; its whole share of the frame if `None`.
///
/// # Errors
/// The controller's rule that they break.
pub(crate) fn preload(
    dmd: Dmd,
    schedule: &PlaneSchedule,
    frames: &[BitPlaneFrame],
    frame_us: u32,
    exposure_us: Option<u32>,
) -> Result<PatternSequence, SequenceError> {
    let channels = [Channel::Red, Channel::Green, Channel::Blue, Channel::White];
    // Indices of a channel's planes, least significant first.
    let bits_of = |channel: Channel| {
        let mut bits: Vec<(u8, usize)> = schedule
            .planes()
            .iter()
            .enumerate()
            .filter(|(_, p)| p.channel == channel)
            .map(|(k, p)| (p.bit, k))
            .collect();
        bits.sort_unstable();
        bits.into_iter().map(|(_, k)| k).collect::<Vec<_>>()
    };
    let shown: Vec<(Channel, Vec<usize>)> =
        channels.into_iter().map(|c| (c, bits_of(c))).filter(|(_, bits)| !bits.is_empty()).collect();
    let share = frame_us / shown.len().max(1) as u32;
    let exposure_us = exposure_us.unwrap_or(share).min(share);
    let mut builder = SequenceBuilder::new(dmd);
    for frame in frames {
        for (channel, bits) in &shown {
            builder.push(&BitPattern {
                planes: bits.iter().map(|&k| frame.plane(k)).collect(),
                exposure_us,
                dark_us: share - exposure_us,
                leds: match channel {
                    Channel::Red => led::RED,
                    Channel::Green => led::GREEN,
                    Channel::Blue => led::BLUE,
                    Channel::White => led::WHITE,
                },
                wait_trigger: false,
                no_trigger_out2: false,
            });
        }
    }
    builder.finish(Repeat::Forever, PlaneOrder::default(), None)
}

/// Runs the rig of `config`, whose backend is a DLPC900, until its frames are over or `monitor` requests a stop.
///
/// # Errors
/// A bad scene or a broken rule of the controller (exit code 2), a controller that fails (3), or no GPU (4).
pub(crate) fn run_dlpc900(config: &RigConfig, monitor: &RunMonitor) -> Result<Dlpc900Report, Failure> {
    let backend = super::keys_of(&config.projector.backend)?;
    let place = backend.device.as_deref().map(str::parse::<UsbPlace>).transpose();
    let place =
        place.map_err(|e| Failure::new(FailureKind::BadInput, format!("projector.backend.device: {e}")))?;
    let mut open = opener(place, monitor);
    // Before minutes of rendering, check that the controller is connected and has the right DMD.
    check_panel(&mut open, backend)?;
    let dmd = backend.panel.dmd();
    let mut warnings = vec![NO_WATCHDOG.to_owned()];
    let (show, frames_loaded) = match backend.mode {
        Dlpc900Mode::Preloaded => {
            let (sequence, frames) = load(config, backend, dmd, &mut warnings, monitor)?;
            (Show::Preloaded(sequence), Some(frames))
        }
        Dlpc900Mode::Video => {
            warnings.push(
                "video mode: the light is what the video input carries; this program traces nothing".into(),
            );
            (Show::Video(video(config, backend, dmd)), None)
        }
    };
    let seconds = match config.run.frames {
        0 => Some(config.run.seconds).filter(|s| *s > 0.0),
        frames => Some(frames as f64 / config.projector.frame_rate.hz()),
    };
    let mut report = present(&mut open, &show, seconds, monitor)?;
    report.frames_loaded = frames_loaded;
    report.warnings = warnings;
    Ok(report)
}

/// Opens the controller at `place`, and waits a while for another process that still uses it.
pub(crate) fn opener(
    place: Option<UsbPlace>,
    monitor: &RunMonitor,
) -> impl FnMut() -> Result<Dlpc900<UsbHid>, Dlpc900Error> + '_ {
    let waited = Stopwatch::start();
    move || loop {
        match usb::open(place) {
            Err(Dlpc900Error::Port { source: PortError::Busy, .. })
                if waited.elapsed_ns() < BUSY_PATIENCE_NS && !monitor.stop_requested() =>
            {
                std::thread::sleep(STEP);
            }
            opened => break opened,
        }
    }
}

/// Checks that the controller is connected and drives the DMD that the rig file names.
///
/// # Errors
/// It is not, or does not.
pub(crate) fn check_panel(
    open: &mut dyn FnMut() -> Result<Dlpc900<UsbHid>, Dlpc900Error>,
    backend: &Dlpc900Config,
) -> Result<(), Failure> {
    let found = open().map_err(failure)?.dmd();
    if found == backend.panel.dmd() {
        return Ok(());
    }
    let told = format!(
        "projector.backend.panel = {:?}, the controller drives a {}",
        backend.panel.word(),
        found.name()
    );
    Err(Failure::new(FailureKind::BadInput, told))
}

/// Renders as many frames as fit.
fn load(
    config: &RigConfig,
    backend: &Dlpc900Config,
    dmd: Dmd,
    warnings: &mut Vec<String>,
    monitor: &RunMonitor,
) -> Result<(PatternSequence, usize), Failure> {
    presence::GPU.look(config)?;
    let mut rig = Rig::build(config, None)?;
    let schedule = config.projector.schedule();
    let most = frames_held(dmd, schedule.len());
    let frames = if config.tracker.is_mock() {
        let wanted = if config.run.frames == 0 { most as u64 } else { config.run.frames };
        if wanted > most as u64 {
            warnings.push(format!("the {} holds {most} frames; they are shown repeatedly", dmd.name()));
        }
        wanted.min(most as u64)
    } else {
        warnings.push(
            "the tracker has no effect on preloaded frames: a single frame with all bodies at rest is shown"
                .into(),
        );
        1
    };
    let gpu = open_gpu(config)?;
    method_choice::decide(&mut rig, &gpu);
    warnings.extend(rig.method_choice.iter().map(|told| format!("render.method = \"auto\": {told}")));
    let mut renderer =
        Renderer::new(&gpu, &rig.scene, renderer_settings(&rig)).map_err(PipelineError::from)?;
    let mut slot = renderer.create_slot(false).map_err(RenderError::from).map_err(PipelineError::from)?;
    let spp = rig.config.render.spp;
    let mut packed = Vec::new();
    for k in 0..frames {
        if monitor.stop_requested() {
            break;
        }
        let poses = poses_at(&rig, k);
        draw(&rig, &mut renderer, &mut slot, &poses, k as u32, spp as f32)
            .map_err(|source| PipelineError::Gpu { frame: k, source })?;
        let mut frame = BitPlaneFrame::new(rig.camera.raster, schedule);
        pack(Kernel::best(), slot.codes(), &mut frame);
        packed.push(frame);
        monitor.count_planned();
    }
    if packed.is_empty() {
        return Err(Failure::new(FailureKind::BadInput, "stopped before the first frame was rendered"));
    }
    let rate = config.projector.frame_rate;
    let frame_us = (1_000_000 * u64::from(rate.den()) / u64::from(rate.num())) as u32;
    let sequence = preload(dmd, &schedule, &packed, frame_us, backend.exposure_us).map_err(|e| {
        let remedy = "lower projector.frame_rate, or set projector.planes = 8";
        Failure::new(FailureKind::BadInput, format!("{e}; {remedy}"))
    })?;
    Ok((sequence, packed.len()))
}

/// One-bit patterns of the video's 24 planes, which share the frame equally.
fn video(config: &RigConfig, backend: &Dlpc900Config, dmd: Dmd) -> VideoPatterns {
    let rate = config.projector.frame_rate;
    let frame_hz = rate.hz().round() as u32;
    let patterns = config.projector.planes as u8;
    let share = share_us(1_000_000 / frame_hz.max(1), patterns.into());
    let exposure_us = backend.exposure_us.unwrap_or(share).min(share);
    let entry = |i: u8| LutEntry { leds: led::WHITE, ..LutEntry::one_bit(i.into(), 0, i, exposure_us) };
    VideoPatterns {
        dmd,
        receiver: backend.input.receiver(),
        ports: None,
        frame_hz,
        entries: (0..patterns).map(entry).collect(),
        leds: LedSetup::default(),
    }
}

/// The report of a show that has not begun.
fn report_of(dmd: Dmd, show: &Show) -> Dlpc900Report {
    let step_us: u64 = show.entries().iter().map(|e| u64::from(e.exposure_us) + u64::from(e.dark_us)).sum();
    let frames = match show {
        Show::Preloaded(s) => s.images().len(),
        Show::Video(_) => 1,
    };
    Dlpc900Report {
        version: env!("CARGO_PKG_VERSION"),
        dmd: dmd.name(),
        mode: if matches!(show, Show::Preloaded(_)) { "preloaded" } else { "video" },
        frames_loaded: None,
        frame_rate_hz: frames as f64 * 1e6 / step_us.max(1) as f64,
        patterns: show.entries().len(),
        image_bytes: match show {
            Show::Preloaded(s) => Some(s.image_bytes()),
            Show::Video(_) => None,
        },
        setup_s: 0.0,
        came_back: 0,
        shown_s: 0.0,
        warnings: Vec::new(),
    }
}

/// Sets up the controller, obeys orders, supervises it for `seconds` (forever if `None`), and puts it to rest.
///
/// # Errors
/// The controller refuses or fails. It is no error if it is unplugged: the run searches for it and sets it up again.
pub(crate) fn present<P: HidPort>(
    open: &mut dyn FnMut() -> Result<Dlpc900<P>, Dlpc900Error>,
    show: &Show,
    seconds: Option<f64>,
    monitor: &RunMonitor,
) -> Result<Dlpc900Report, Failure> {
    let mut d = open().map_err(failure)?;
    let mut report = report_of(d.dmd(), show);
    let word = Word::default();
    if let Some(order) = monitor.take_order() {
        // An order that stood before the run, or came while it rendered: the controller is set up dark.
        word.waiting.store(order as u8, Ordering::Relaxed);
    }
    let (result, rested) = std::thread::scope(|scope| {
        // Also during a panic: the scope waits for the other thread.
        let _over = Over(&word);
        let spawned = std::thread::Builder::new()
            .name("dpm-dark".into())
            .spawn_scoped(scope, || word.make_dark_when_told(monitor))
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")));
        let result = spawned.and_then(|_| {
            let mut watch = ShowWatch {
                d: &mut d,
                open,
                show,
                word: &word,
                monitor,
                report: &mut report,
                standing: None,
                allowed: true,
                lost: false,
                is_torn: false,
                spoken: 0,
                looked: Stopwatch::start(),
            };
            watch.run(seconds)
        });
        // Whatever happened: stopped, LEDs off, mirrors exercised. A controller that is gone cannot be told, and one that does not
        // answer is not asked again: the process must end.
        let stopped = d.stop_at_the_end();
        word.is_dark.store(stopped.is_ok(), Ordering::SeqCst);
        let rested = if matches!(stopped, Err(Dlpc900Error::Port { .. })) { stopped } else { d.idle() };
        (result, rested)
    });
    monitor.set_projector_and_light(ProjectorHealth::Stopped);
    result?;
    match rested {
        Err(e) if !e.is_gone() => Err(failure(e)),
        _ => Ok(report),
    }
}

/// A show on a controller: what was ordered, whether light is allowed, whether the controller is there.
struct ShowWatch<'a, P: HidPort> {
    d: &'a mut Dlpc900<P>,
    open: &'a mut dyn FnMut() -> Result<Dlpc900<P>, Dlpc900Error>,
    show: &'a Show,
    word: &'a Word,
    monitor: &'a RunMonitor,
    report: &'a mut Dlpc900Report,
    /// What the operator ordered last and did not take back.
    standing: Option<Order>,
    /// The interlock was closed when it was looked at last.
    allowed: bool,
    /// The controller does not answer, or its cable is out.
    lost: bool,
    /// The last answer was lost to the other thread's command.
    is_torn: bool,
    /// How often the other thread had spoken to the controller before the last step.
    spoken: u32,
    looked: Stopwatch,
}

impl<P: HidPort> ShowWatch<'_, P> {
    /// Shows until `seconds` are over or a stop is asked for.
    fn run(&mut self, seconds: Option<f64>) -> Result<(), Failure> {
        self.wait_for_interlock()?;
        match self.set_up() {
            Err(Dlpc900Error::Stopped) => return Ok(()),
            other => other.map_err(failure)?,
        }
        let shown = Stopwatch::start();
        let is_over = |shown: &Stopwatch| seconds.is_some_and(|s| shown.elapsed_ns() as f64 * 1e-9 >= s);
        while !self.monitor.stop_requested() && !is_over(&shown) {
            let order = self.word.order();
            let step = self.step(order);
            self.judge(step, order)?;
            std::thread::sleep(STEP);
        }
        self.report.shown_s = shown.elapsed_ns() as f64 * 1e-9;
        Ok(())
    }

    /// A controller that is set up shows at once, so this waits until the interlock allows light.
    fn wait_for_interlock(&mut self) -> Result<(), Failure> {
        if !self.monitor.light_allowed() {
            // A run that was killed may have left it lit. A controller that rests refuses the command, and is dark.
            match self.d.stop() {
                Ok(()) | Err(Dlpc900Error::Refused { .. }) => {}
                Err(e) => return Err(failure(e)),
            }
        }
        while !self.monitor.light_allowed() && !self.monitor.stop_requested() {
            self.monitor.set_projector_and_light(ProjectorHealth::InterlockOpen);
            std::thread::sleep(STEP);
        }
        Ok(())
    }

    /// Loads the show and starts it, unless an order or the interlock says otherwise.
    fn set_up(&mut self) -> Result<(), Dlpc900Error> {
        let watch = Stopwatch::start();
        let word = self.word;
        *word.line.lock().unwrap_or_else(PoisonError::into_inner) = self.d.dark_line();
        let stop = Arc::clone(&word.stop);
        self.d.stop_when(Arc::new(move || stop.load(Ordering::Relaxed)));
        // Before seconds go into an upload: out of the exercise that every run ends in, and of a sequence that a killed run left.
        self.d.make_ready()?;
        self.d.stop()?;
        word.is_dark.store(true, Ordering::SeqCst);
        let loaded = self.show.load(self.d);
        word.is_dark.store(false, Ordering::SeqCst);
        loaded?;
        if let Some(order) = word.take() {
            self.standing = standing_after(self.standing, order);
        }
        // The interlock may have opened during the seconds of the upload.
        let number;
        (self.allowed, number) = word.look_at_interlock(self.monitor);
        // Nobody's order to be dark is answered by light, not even by that of one pattern.
        match self.standing {
            _ if !self.allowed => {}
            Some(Order::Black | Order::Safe) => {}
            Some(Order::Freeze) => self.d.start().and_then(|()| self.d.pause())?,
            Some(Order::Arm) | None => self.d.start()?,
        }
        word.interlock_done.store(number, Ordering::SeqCst);
        self.report.setup_s = watch.elapsed_ns() as f64 * 1e-9;
        self.monitor.set_projector_and_light(self.health());
        Ok(())
    }

    fn health(&self) -> ProjectorHealth {
        if self.allowed {
            health(self.standing)
        } else {
            ProjectorHealth::InterlockOpen
        }
    }

    /// Acts on `order`, on the interlock, and on what the controller says of itself.
    fn step(&mut self, order: Option<Order>) -> Result<(), Dlpc900Error> {
        if let Some(order) = order {
            self.standing = standing_after(self.standing, order);
        }
        let was_allowed = self.allowed;
        let number;
        (self.allowed, number) = self.word.look_at_interlock(self.monitor);
        // Open and closed again since the last look counts as well: the other thread has stopped the sequence.
        let changed =
            self.allowed != was_allowed || number != self.word.interlock_done.load(Ordering::SeqCst);
        if (changed || !self.allowed) && self.standing == Some(Order::Freeze) {
            // What was held is dark now, and the operator's to show again.
            self.standing = Some(Order::Black);
        }
        self.spoken = self.word.spoken.load(Ordering::SeqCst);
        let due = self.looked.elapsed_ns() >= LOOK_NS;
        if self.lost {
            return if due && self.allowed { self.come_back() } else { Ok(()) };
        }
        if changed {
            let wanted = if self.allowed { self.standing } else { Some(Order::Black) };
            obey(self.d, wanted)?;
            self.word.interlock_done.store(number, Ordering::SeqCst);
            self.monitor.set_projector_and_light(self.health());
        } else if self.allowed && order.is_some() {
            obey(self.d, self.standing)?;
            self.monitor.set_projector_and_light(health(self.standing));
        } else if self.allowed && due {
            // What was ordered while the interlock was open is done when it closes.
            self.looked = Stopwatch::start();
            look(self.d, self.standing, self.word)?;
        }
        Ok(())
    }

    /// Looks for a controller that was lost, and sets it up anew: it may have been without power.
    fn come_back(&mut self) -> Result<(), Dlpc900Error> {
        self.looked = Stopwatch::start();
        *self.d = (self.open)()?;
        self.set_up()?;
        self.lost = false;
        self.report.came_back += 1;
        Ok(())
    }

    /// What the outcome of a step means.
    fn judge(&mut self, step: Result<(), Dlpc900Error>, order: Option<Order>) -> Result<(), Failure> {
        match step {
            Ok(()) => {
                self.is_torn = false;
                order.into_iter().for_each(|order| self.word.acted_on(order));
            }
            Err(Dlpc900Error::Stopped) => {}
            // A command of the dark thread took the answer away. The step is repeated in the next round, but not
            // twice in a row.
            Err(Dlpc900Error::Port { source: PortError::Timeout, .. })
                if !self.is_torn && self.word.spoken.load(Ordering::SeqCst) != self.spoken =>
            {
                self.is_torn = true;
            }
            // Right after it was plugged in it may still be without rights, in other hands, or silent.
            Err(e) if e.is_gone() || self.lost && matches!(e, Dlpc900Error::Port { .. }) => {
                self.lost = true;
                self.monitor.set_projector_and_light(ProjectorHealth::Lost);
            }
            Err(e) => return Err(failure(e)),
        }
        Ok(())
    }
}

fn obey<P: HidPort>(d: &mut Dlpc900<P>, standing: Option<Order>) -> Result<(), Dlpc900Error> {
    match standing {
        // The controller has only one kind of dark that keeps its table.
        Some(Order::Black | Order::Safe) => d.stop(),
        // A paused sequence continues where it was paused; pausing it again has no effect.
        Some(Order::Freeze) => d.pause(),
        Some(Order::Arm) | None => d.start(),
    }
}

fn health(standing: Option<Order>) -> ProjectorHealth {
    match standing {
        Some(Order::Black) => ProjectorHealth::Black,
        Some(Order::Freeze) => ProjectorHealth::Frozen,
        Some(Order::Safe) => ProjectorHealth::Faulted(faults::HOST_SAFE),
        Some(Order::Arm) | None => ProjectorHealth::Up,
    }
}

/// Checks the controller. If it stopped by itself or reports a problem, the run ends.
fn look<P: HidPort>(d: &mut Dlpc900<P>, standing: Option<Order>, word: &Word) -> Result<(), Dlpc900Error> {
    let status = d.status()?;
    match status.complaint() {
        Some(what) => Err(Dlpc900Error::Hardware(what)),
        None if standing.is_none() && !status.is_running() && !word.is_waiting() => {
            Err(Dlpc900Error::Hardware("the sequence stopped by itself".into()))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
#[path = "run_tests.rs"]
mod tests;
