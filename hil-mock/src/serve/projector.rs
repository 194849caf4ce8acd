//! `hil-mock serve projector`: a bit-plane projector on a USB/IP port, a serial port or a pseudo-terminal.

use std::error::Error;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use clap::{Args, ValueEnum};
use dpm_device::link::{faults, SessionNumbers, MAX_SHIFT};
use dpm_device::planes::Raster;
use dpm_device::projector::FirmwareConfig;
use dpm_device::time::HostTime;
use dpm_device::transport::LinkDevice;
use hil_mock::monotonic;
use hil_mock::projector::serial::SerialProjector;
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{LightChange, MockConfig, MockProjector, Shown};
use hil_mock::serial_server::pseudo_terminal;
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, Clock};

use super::usb::{offer_by, UsbArguments};
use super::{cannot_open, complain, say};

/// Arguments of `hil-mock serve projector`.
#[derive(Args)]
pub(crate) struct ProjectorArguments {
    /// Mirrors, width and height
    #[arg(long, value_name = "WxH", default_value = "1024x768", value_parser = raster)]
    raster: Raster,
    /// Whole frames that can wait
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=64))]
    buffers: u8,
    /// Offer to follow tracks, and move light by this many mirrors at most. Pictures and logs of the light show frames as they were sent
    #[arg(long, value_name = "MIRRORS", value_parser = clap::value_parser!(u8).range(1..=MAX_SHIFT as i64))]
    greatest_shift: Option<u8>,
    /// Serial number; 1, which names no projector, without this and --flash
    #[arg(long)]
    serial_number: Option<u64>,
    /// Draw the serial number at random at the first start, and keep it in this file, as a projector keeps it in its flash memory
    #[arg(long, value_name = "FILE", conflicts_with = "serial_number")]
    flash: Option<PathBuf>,
    /// Speed of the USB cable
    #[arg(long, value_enum, default_value_t = SpeedWord::Super)]
    speed: SpeedWord,
    /// Bytes a second that the data endpoint takes; without it as fast as they come
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    bytes_per_second: Option<u64>,
    /// Serve on this serial port instead of USB/IP; `pty` makes a pseudo-terminal and prints its path
    #[arg(long, value_name = "PORT|pty", conflicts_with_all = ["usbip", "faults", "speed", "bytes_per_second"])]
    port: Option<String>,
    /// Bits per second of the serial port
    #[arg(long, default_value_t = 3_000_000)]
    baud: u32,
    /// Write the light on the mirrors to this PPM file once a second; black while it is dark
    #[arg(long, value_name = "FILE")]
    light: Option<PathBuf>,
    /// Write a line to this file whenever light goes on or off or the state changes: the instant in nanoseconds of CLOCK_MONOTONIC, `lit`
    /// with the frame or `dark`, and the state with the faults that are latched
    #[arg(long, value_name = "FILE")]
    light_log: Option<PathBuf>,
    #[command(flatten)]
    usb: UsbArguments,
}

#[derive(Clone, Copy, ValueEnum)]
enum SpeedWord {
    High,
    Super,
}

fn raster(text: &str) -> Result<Raster, String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let raster = sides.and_then(|(w, h)| Raster::new(w, h));
    raster.ok_or_else(|| format!("write it as 1024x768, each side 1 to {}", Raster::MAX_SIDE))
}

impl ProjectorArguments {
    /// The serial number, drawn and kept at the first start.
    fn serial(&self) -> Result<u64, Box<dyn Error>> {
        let Some(flash) = &self.flash else { return Ok(self.serial_number.unwrap_or(1)) };
        let told = |e: std::io::Error| format!("{}: {e}", flash.display());
        let kept = match std::fs::read_to_string(flash) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => None,
            text => u64::from_str_radix(text.map_err(told)?.trim(), 16).ok(),
        };
        let mut random = SessionNumbers::from_system();
        let serial =
            FirmwareConfig::serial_number(kept, || u64::from(random.draw()) << 32 | u64::from(random.draw()));
        if kept != Some(serial) {
            std::fs::write(flash, format!("{serial:016x}\n")).map_err(told)?;
        }
        Ok(serial)
    }

    /// The mirrors.
    pub(super) fn raster(&self) -> Raster {
        self.raster
    }
}

/// Something that sees the projector's light in the same process.
pub(super) trait Beside {
    /// Slots that were shown since the last call, and the instant up to which nothing else was.
    fn see(&mut self, shown: Vec<Shown>, until: HostTime) -> Result<(), Box<dyn Error>>;
}

/// Nothing sees it.
struct Nobody;

impl Beside for Nobody {
    fn see(&mut self, _: Vec<Shown>, _: HostTime) -> Result<(), Box<dyn Error>> {
        Ok(())
    }
}

/// Serves until the time is over or the port fails.
pub(super) fn run(arguments: &ProjectorArguments) -> Result<(), Box<dyn Error>> {
    run_beside(arguments, 0, monotonic_clock(), &mut Nobody)
}

/// What was shown since the last call.
fn shown_by(projector: &mut MockProjector) -> (Vec<Shown>, HostTime) {
    (std::iter::from_fn(|| projector.next_shown()).collect(), projector.shown_until())
}

/// The same by a given clock, with something that sees the light; `shown_kept` slots are kept for it.
pub(super) fn run_beside(
    arguments: &ProjectorArguments,
    shown_kept: usize,
    clock: Clock,
    beside: &mut dyn Beside,
) -> Result<(), Box<dyn Error>> {
    let projector = MockProjector::new(MockConfig {
        frame_buffers: arguments.buffers,
        serial: arguments.serial()?,
        greatest_shift: arguments.greatest_shift,
        events_kept: 0,
        shown_kept,
        shifts_slots: true,
        exceeds: true,
        ..MockConfig::new(arguments.raster)
    });
    let log = arguments.light_log.as_deref().map(LightLog::create).transpose()?;
    let mut report = Report {
        due: HostTime(0),
        said: String::new(),
        light: arguments.light.clone(),
        was_lit: true,
        log,
        ahead_ns: i64::MAX,
    };
    if let Some(port) = &arguments.port {
        return serve_port(arguments, port, projector, &mut report, &clock, beside);
    }
    let speed = match arguments.speed {
        SpeedWord::High => Speed::High,
        SpeedWord::Super => Speed::Super,
    };
    let model = Arc::new(Mutex::new(UsbProjector::new(projector, speed, arguments.bytes_per_second)));
    let watched = model.clone();
    let mut failed = Ok(());
    offer_by(&arguments.usb, "bit-plane projector", model, clock, |clock| {
        let mut model = watched.lock().unwrap_or_else(PoisonError::into_inner);
        report.look(clock(), model.projector());
        let (shown, until) = shown_by(model.projector());
        // The cable need not wait for what sees the light.
        drop(model);
        if failed.is_ok() {
            failed = beside.see(shown, until);
        }
    })?;
    failed
}

fn serve_port(
    arguments: &ProjectorArguments,
    port: &str,
    projector: MockProjector,
    report: &mut Report,
    clock: &Clock,
    beside: &mut dyn Beside,
) -> Result<(), Box<dyn Error>> {
    let (mut line, path, _other_end) = if port == "pty" {
        let (line, path, other_end) = pseudo_terminal()?;
        (line, path, Some(other_end))
    } else {
        let line = dpm_device::tty::open(port, arguments.baud);
        (line.map_err(|e| cannot_open(port, &e))?, port.to_string(), None)
    };
    say(format_args!("bit-plane projector on {path}"));
    let mut device = SerialProjector::new(projector);
    loop {
        let now = clock();
        if arguments.usb.seconds.is_some_and(|s| now.0 as f64 >= s * 1e9) {
            return Ok(());
        }
        if !device.serve(|| clock(), &mut line)? {
            return Err(format!("{path} failed: unplugged? Check cable and adapter").into());
        }
        report.look(clock(), device.projector());
        let (shown, until) = shown_by(device.projector());
        beside.see(shown, until)?;
        std::thread::sleep(Duration::from_micros(500));
    }
}

/// A log of light going on and off, for other programs to read.
struct LightLog {
    path: PathBuf,
    file: File,
}

impl LightLog {
    fn create(path: &Path) -> Result<Self, String> {
        match File::create(path) {
            Ok(file) => Ok(Self { path: path.to_owned(), file }),
            Err(e) => Err(format!("cannot write {}: {e}", path.display())),
        }
    }

    /// Writes `change`, whose clock is `ahead_ns` behind CLOCK_MONOTONIC, as one line in one piece, at once.
    fn write(&mut self, change: &LightChange, ahead_ns: i64) -> std::io::Result<()> {
        let light = change.frame.map_or_else(|| "dark".to_owned(), |frame| format!("lit {frame}"));
        let state = format!("{:?}", change.state).to_lowercase();
        let latched = match change.faults {
            0 => String::new(),
            mask => format!(": {}", faults::names(mask)),
        };
        self.file.write_all(format!("{} {light} {state}{latched}\n", change.at.0 + ahead_ns).as_bytes())
    }
}

/// Reports changes once a second, and at once when light goes on or off.
struct Report {
    due: HostTime,
    said: String,
    light: Option<PathBuf>,
    was_lit: bool,
    log: Option<LightLog>,
    /// CLOCK_MONOTONIC minus the model's clock.
    ahead_ns: i64,
}

impl Report {
    /// Advances `projector` to `now`, whether or not a packet arrives, and reports. `now` was read immediately before.
    fn look(&mut self, now: HostTime, projector: &mut MockProjector) {
        // The time between the two readings only increases it.
        self.ahead_ns = self.ahead_ns.min(monotonic::now_ns() - now.0);
        projector.advance_to(now);
        while let Some(change) = projector.next_change() {
            if let Some(log) = &mut self.log {
                if let Err(e) = log.write(&change, self.ahead_ns) {
                    complain(format_args!("{}: {e}", log.path.display()));
                    self.log = None;
                }
            }
        }
        if now < self.due {
            return;
        }
        self.due = now.plus_ns(1_000_000_000);
        let s = projector.status();
        let text = format!(
            "{:?}, {}: {} frames lit, {} repeated, {} blank; dropped {} incomplete, {} late, {} superseded, {} refused; \
             {} damaged packets",
            s.state,
            if s.lit { "lit" } else { "dark" },
            s.frames_lit,
            s.slots_repeated,
            s.slots_blank,
            s.frames_incomplete,
            s.frames_late,
            s.frames_superseded,
            s.frames_refused,
            s.header_errors.wrapping_add(s.payload_errors)
        );
        if text != self.said {
            say(format_args!("{:8.1} s  {text}", now.0 as f64 * 1e-9));
            self.said = text;
        }
        let (raster, lit) = (projector.raster(), projector.is_lit());
        let Some(path) = &self.light else { return };
        let written = match projector.light_of_frame().filter(|_| lit) {
            Some(light) => write_ppm(path, raster, light),
            // A picture of the last light would suggest that it is still on.
            None if self.was_lit => write_ppm(path, raster, &vec![[0; 3]; raster.pixel_count()]),
            None => Ok(()),
        };
        self.was_lit = lit;
        if let Err(e) = written {
            complain(format_args!("{}: {e}", path.display()));
            self.light = None;
        }
    }
}

fn write_ppm(path: &Path, raster: Raster, light: &[[u8; 3]]) -> std::io::Result<()> {
    let mut bytes = format!("P6\n{} {}\n255\n", raster.width(), raster.height()).into_bytes();
    bytes.extend(light.iter().flatten());
    // Written beside the old one, then renamed over it: a reader never sees half a picture.
    let beside = path.with_extension("part");
    std::fs::write(&beside, bytes)?;
    std::fs::rename(beside, path)
}
