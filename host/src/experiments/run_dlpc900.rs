//! `dpm run` on a DLPC900: frames loaded before they are shown, or patterns cut out of a video signal; watched, and put to rest.
//!
//! USB carries seconds, not frames, to a DLPC900, so nothing that a tracker says while it runs reaches its light. Preloaded, it shows the
//! first frames of the rig's known motion over and over, three 8-bit patterns each (red, green, blue), whose bits the controller weighs
//! itself. In video mode the light comes from whatever feeds its video input; this program sets it up and looks after it.

use super::sequence::{draw, poses_at};
use crate::clock::Stopwatch;
use crate::config::{Dlpc900Config, Dlpc900Mode, ProjectorBackend, RigConfig, TrackerConfig, VideoInput};
use crate::experiments::run_rig::open_gpu;
use crate::failure::{Failure, FailureKind};
use crate::pack::{pack, BitPlaneFrame, Kernel};
use crate::pipeline::{renderer_settings, PipelineError};
use crate::render::{RenderError, Renderer};
use crate::rig::Rig;
use crate::telemetry::monitor::{Order, ProjectorHealth, RunMonitor};
use dpm_device::dlpc900::driver::{Dlpc900, Dlpc900Error, HidPort, PortError};
use dpm_device::dlpc900::image::PlaneOrder;
use dpm_device::dlpc900::lut::{led, Dmd, LutEntry, IMAGE_PLANES, MAX_IMAGES};
use dpm_device::dlpc900::sequence::{
    LedSetup, Pattern, PatternSequence, Receiver, Repeat, SequenceBuilder, SequenceError, VideoPatterns,
};
use dpm_device::dlpc900::usb::{describe, UsbHid, UsbPlace};
use dpm_device::link::faults;
use dpm_device::planes::{Channel, PlaneSchedule};
use std::time::Duration;

/// How often orders are looked for.
const STEP: Duration = Duration::from_millis(20);
/// How often the controller is asked how it is, and a lost one is looked for.
const LOOK_NS: u64 = 200_000_000;

/// What a run on a DLPC900 did.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Dlpc900Report {
    /// Version of the program.
    pub version: &'static str,
    /// The DMD.
    pub dmd: &'static str,
    /// "preloaded" or "video".
    pub mode: &'static str,
    /// Frames loaded; null in video mode, whose frames come from elsewhere.
    pub frames_loaded: Option<usize>,
    /// Frames a second that the pattern table adds up to.
    pub frame_rate_hz: f64,
    /// Patterns in the table.
    pub patterns: usize,
    /// Bytes of coded images loaded; null in video mode.
    pub image_bytes: Option<usize>,
    /// Time that the set-up took, the last time, seconds.
    pub setup_s: f64,
    /// Times that the controller was lost and set up again.
    pub came_back: u64,
    /// Wall time from the start of the sequence to its end, seconds.
    pub shown_s: f64,
    /// What the operator should know.
    pub warnings: Vec<String>,
}

impl Dlpc900Report {
    /// The report for people.
    pub fn to_table(&self) -> String {
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

/// What the controller is set up with.
pub enum Show {
    /// Frames that are loaded.
    Preloaded(PatternSequence),
    /// Patterns out of the video signal.
    Video(VideoPatterns),
}

impl Show {
    /// Sets the controller up and lets it show; where that is not wanted now, as far as it goes without light. True when it shows.
    fn set_up<P: HidPort>(&self, d: &mut Dlpc900<P>, lit: bool) -> Result<bool, Dlpc900Error> {
        match self {
            Self::Preloaded(sequence) => {
                d.upload(sequence, LedSetup::default(), &mut |_| ())?;
                if lit {
                    d.start()?;
                }
            }
            Self::Video(video) if lit => d.start_video_patterns(video)?,
            // Setting up and starting are one command here.
            Self::Video(_) => d.stop()?,
        }
        Ok(lit)
    }

    /// Lets a controller that was set up dark show.
    fn start<P: HidPort>(&self, d: &mut Dlpc900<P>) -> Result<(), Dlpc900Error> {
        match self {
            Self::Preloaded(_) => d.start(),
            Self::Video(video) => d.start_video_patterns(video),
        }
    }

    fn entries(&self) -> &[LutEntry] {
        match self {
            Self::Preloaded(sequence) => sequence.entries(),
            Self::Video(video) => &video.entries,
        }
    }
}

/// Most frames of `planes` planes that a DMD's controller holds.
pub fn frames_held(dmd: Dmd, planes: usize) -> usize {
    let images = (dmd.max_planes() as usize / IMAGE_PLANES).min(MAX_IMAGES);
    images * (IMAGE_PLANES / planes.max(1))
}

/// `frames` as a sequence that runs for ever: for each channel one pattern of its eight bits, all of a frame in `frame_us` us.
/// `exposure_us`: time lit of each pattern, its whole share of the frame when `None`.
///
/// # Errors
/// The rule of the controller that they break.
pub fn preload(
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
            builder.push(&Pattern {
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

/// Runs the rig of `config`, whose backend is a DLPC900, until its frames are over or `monitor` asks to stop.
///
/// # Errors
/// Bad scene or rules of the controller broken (exit code 2), a controller that fails (3), no GPU (4).
pub fn run_dlpc900(config: &RigConfig, monitor: &RunMonitor) -> Result<Dlpc900Report, Failure> {
    let ProjectorBackend::Dlpc900(backend) = &config.projector.backend else {
        return Err(Failure::new(FailureKind::BadInput, "projector.backend.kind is not \"dlpc900\""));
    };
    let place = backend.device.as_deref().map(str::parse::<UsbPlace>).transpose();
    let place =
        place.map_err(|e| Failure::new(FailureKind::BadInput, format!("projector.backend.device: {e}")))?;
    let mut open = || {
        let port =
            UsbHid::open(place).map_err(|source| Dlpc900Error::Port { doing: describe(place), source })?;
        Dlpc900::new(port)
    };
    // Before minutes of rendering: is it there, and the one that is meant?
    let dmd = backend.panel.dmd();
    let found = open()?.dmd();
    if found != dmd {
        let told = format!(
            "projector.backend.panel = {:?}, the controller drives a {}",
            backend.panel.word(),
            found.name()
        );
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    let mut warnings =
        vec!["a DLPC900 has no watchdog: if this program is killed, it goes on showing; `dpm dlpc900 idle` ends it".into()];
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
        0 => None,
        frames => Some(frames as f64 / config.projector.frame_rate.hz()),
    };
    let mut report = present(&mut open, &show, seconds, monitor)?;
    report.frames_loaded = frames_loaded;
    report.warnings = warnings;
    Ok(report)
}

/// Renders the frames that fit.
fn load(
    config: &RigConfig,
    backend: &Dlpc900Config,
    dmd: Dmd,
    warnings: &mut Vec<String>,
    monitor: &RunMonitor,
) -> Result<(PatternSequence, usize), Failure> {
    let rig = Rig::build(config, None)?;
    let schedule = config.projector.schedule();
    let most = frames_held(dmd, schedule.len());
    let frames = if matches!(config.tracker, TrackerConfig::Mock(_)) {
        let wanted = if config.run.frames == 0 { most as u64 } else { config.run.frames };
        if wanted > most as u64 {
            warnings.push(format!("the {} holds {most} frames; they are shown over and over", dmd.name()));
        }
        wanted.min(most as u64)
    } else {
        warnings.push(
            "nothing that the tracker says reaches preloaded frames: one is shown, all bodies at rest".into(),
        );
        1
    };
    let gpu = open_gpu(config)?;
    let mut renderer =
        Renderer::new(&gpu, &rig.scene, renderer_settings(&rig)).map_err(PipelineError::from)?;
    let mut slot = renderer.create_slot(false).map_err(RenderError::from).map_err(PipelineError::from)?;
    let spp = config.render.spp;
    let mut packed = Vec::new();
    for k in 0..frames {
        if monitor.stop_requested() {
            break;
        }
        let poses = poses_at(&rig, k);
        draw(&rig, &mut renderer, &mut slot, &poses, k as u32, spp, spp as f32)
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

/// One-bit patterns of the video's 24 planes, the frame shared out evenly.
fn video(config: &RigConfig, backend: &Dlpc900Config, dmd: Dmd) -> VideoPatterns {
    let rate = config.projector.frame_rate;
    let frame_hz = rate.hz().round() as u32;
    let patterns = config.projector.planes as u8;
    let share = 1_000_000 / frame_hz.max(1) / u32::from(patterns);
    let exposure_us = backend.exposure_us.unwrap_or(share).min(share);
    let entry = |i: u8| LutEntry { leds: led::WHITE, ..LutEntry::one_bit(i.into(), 0, i, exposure_us) };
    VideoPatterns {
        dmd,
        receiver: match backend.input {
            VideoInput::Parallel => Receiver::None,
            VideoInput::Hdmi => Receiver::Hdmi,
            VideoInput::DisplayPort => Receiver::DisplayPort,
        },
        frame_hz,
        entries: (0..patterns).map(entry).collect(),
        leds: LedSetup::default(),
    }
}

/// Sets the controller up, obeys orders, looks after it for `seconds` (for ever when `None`), and puts it to rest.
///
/// # Errors
/// The controller refuses or fails. While it is unplugged there is no error: it is looked for, and set up again.
pub fn present<P: HidPort>(
    open: &mut dyn FnMut() -> Result<Dlpc900<P>, Dlpc900Error>,
    show: &Show,
    seconds: Option<f64>,
    monitor: &RunMonitor,
) -> Result<Dlpc900Report, Failure> {
    let mut d = open()?;
    let step_us: u64 = show.entries().iter().map(|e| u64::from(e.exposure_us) + u64::from(e.dark_us)).sum();
    let frames = match show {
        Show::Preloaded(s) => s.images().len(),
        Show::Video(_) => 1,
    };
    let mut report = Dlpc900Report {
        version: env!("CARGO_PKG_VERSION"),
        dmd: d.dmd().name(),
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
    };
    let result = watch_over(&mut d, open, show, seconds, monitor, &mut report);
    // Whatever happened: stopped, LEDs off, mirrors exercised. A controller that is gone cannot be told.
    let _ = d.stop();
    let rested = d.idle();
    monitor.set_projector(ProjectorHealth::Stopped);
    result?;
    match rested {
        Err(e) if !is_gone(&e) => Err(e.into()),
        _ => Ok(report),
    }
}

fn is_gone(e: &Dlpc900Error) -> bool {
    matches!(e, Dlpc900Error::Port { source: PortError::Gone | PortError::NotFound, .. })
}

fn watch_over<P: HidPort>(
    d: &mut Dlpc900<P>,
    open: &mut dyn FnMut() -> Result<Dlpc900<P>, Dlpc900Error>,
    show: &Show,
    seconds: Option<f64>,
    monitor: &RunMonitor,
    report: &mut Dlpc900Report,
) -> Result<(), Failure> {
    // What stands from before the run, or was ordered while it rendered: the controller is set up dark.
    let mut standing = monitor.take_order().filter(|order| *order != Order::Arm);
    let mut lost = false;
    let set_up = |d: &mut Dlpc900<P>, lit: bool, report: &mut Dlpc900Report| {
        let watch = Stopwatch::start();
        let done = show.set_up(d, lit && !monitor.dark_is_ordered());
        report.setup_s = watch.elapsed_ns() as f64 * 1e-9;
        done
    };
    let mut has_shown = set_up(d, standing.is_none(), report)?;
    monitor.set_projector(if has_shown { ProjectorHealth::Up } else { health(standing) });
    let (shown, mut looked) = (Stopwatch::start(), Stopwatch::start());
    while !monitor.stop_requested() && seconds.is_none_or(|s| shown.elapsed_ns() as f64 * 1e-9 < s) {
        let order = monitor.take_order();
        if let Some(order) = order {
            // A weaker word does not replace a stronger one.
            let holds = standing.is_some_and(|s| order != Order::Arm && s.strength() > order.strength());
            standing = if holds { standing } else { Some(order).filter(|order| *order != Order::Arm) };
        }
        let due = looked.elapsed_ns() >= LOOK_NS;
        let step = match (lost, order) {
            (true, _) if due => {
                looked = Stopwatch::start();
                open().and_then(|found| {
                    *d = found;
                    // It may have been without power.
                    has_shown = set_up(d, standing.is_none(), report)?;
                    (lost, report.came_back) = (false, report.came_back + 1);
                    monitor.set_projector(health(standing));
                    Ok(())
                })
            }
            (true, _) => Ok(()),
            (false, Some(Order::Arm)) if !has_shown => show.start(d).map(|()| {
                has_shown = true;
                monitor.set_projector(health(standing));
            }),
            (false, Some(_)) => {
                obey(d, standing.unwrap_or(Order::Arm)).map(|()| monitor.set_projector(health(standing)))
            }
            (false, None) if due => {
                looked = Stopwatch::start();
                look(d, standing)
            }
            (false, None) => Ok(()),
        };
        match step {
            Ok(()) => {}
            // Right after it was plugged in it may still be without rights, in other hands, or silent.
            Err(e) if is_gone(&e) || lost && matches!(e, Dlpc900Error::Port { .. }) => {
                lost = true;
                monitor.set_projector(ProjectorHealth::Lost);
            }
            Err(e) => return Err(e.into()),
        }
        std::thread::sleep(STEP);
    }
    report.shown_s = shown.elapsed_ns() as f64 * 1e-9;
    Ok(())
}

fn obey<P: HidPort>(d: &mut Dlpc900<P>, order: Order) -> Result<(), Dlpc900Error> {
    match order {
        // The controller knows one kind of dark without losing its table.
        Order::Black | Order::Safe => d.stop(),
        Order::Freeze => d.pause(),
        Order::Arm => d.start(),
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

/// A controller that stopped by itself, or complains, ends the run.
fn look<P: HidPort>(d: &mut Dlpc900<P>, standing: Option<Order>) -> Result<(), Dlpc900Error> {
    let status = d.status()?;
    match status.complaint() {
        Some(what) => Err(Dlpc900Error::Hardware(what)),
        None if standing.is_none() && !status.is_running() => {
            Err(Dlpc900Error::Hardware("the sequence stopped by itself".into()))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
#[path = "run_dlpc900_tests.rs"]
mod tests;
