//! `hil-mock serve projector`: arguments into a bit-plane projector on a USB/IP port, a serial port or a pseudo-terminal.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use hil_mock::projector::serial::SerialProjector;
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::serial_server::pseudo_terminal;
use hil_mock::usb_model::Speed;

use super::cannot_open;
use super::usb::{offer, UsbArguments};

/// Arguments of `hil-mock serve projector`.
#[derive(Args)]
pub struct ProjectorArguments {
    /// Mirrors, width and height
    #[arg(long, value_name = "WxH", default_value = "1024x768", value_parser = raster)]
    raster: Raster,
    /// Whole frames that can wait
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=64))]
    buffers: u8,
    /// Serial number
    #[arg(long, default_value_t = 1)]
    serial_number: u64,
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
    /// Write the light of the frame on the mirrors to this PPM file once a second
    #[arg(long, value_name = "FILE")]
    light: Option<PathBuf>,
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

/// Serves until the time is over or the port fails.
pub fn run(arguments: &ProjectorArguments) -> Result<(), Box<dyn Error>> {
    let projector = MockProjector::new(MockConfig {
        frame_buffers: arguments.buffers,
        serial: arguments.serial_number,
        events_kept: 0,
        ..MockConfig::new(arguments.raster)
    });
    let mut report = Report { due: HostTime(0), said: String::new(), light: arguments.light.clone() };
    if let Some(port) = &arguments.port {
        return serve_port(arguments, port, projector, &mut report);
    }
    let speed = match arguments.speed {
        SpeedWord::High => Speed::High,
        SpeedWord::Super => Speed::Super,
    };
    let model = Arc::new(Mutex::new(UsbProjector::new(projector, speed, arguments.bytes_per_second)));
    let watched = model.clone();
    offer(&arguments.usb, "bit-plane projector", model, move |now| {
        let mut model = watched.lock().unwrap_or_else(PoisonError::into_inner);
        report.look(now, model.projector());
    })
}

fn serve_port(
    arguments: &ProjectorArguments,
    port: &str,
    projector: MockProjector,
    report: &mut Report,
) -> Result<(), Box<dyn Error>> {
    let (mut line, path, _other_end) = if port == "pty" {
        let (line, path, other_end) = pseudo_terminal()?;
        (line, path, Some(other_end))
    } else {
        let line = dpm_device::tty::open(port, arguments.baud);
        (line.map_err(|e| cannot_open(port, &e))?, port.to_string(), None)
    };
    println!("bit-plane projector on {path}");
    let mut device = SerialProjector::new(projector);
    let start = Instant::now();
    loop {
        let now = HostTime(start.elapsed().as_nanos() as i64);
        if arguments.usb.seconds.is_some_and(|s| now.0 as f64 >= s * 1e9) {
            return Ok(());
        }
        if !device.serve(|| HostTime(start.elapsed().as_nanos() as i64), &mut line)? {
            return Err(format!("{path} failed: unplugged? Check cable and adapter").into());
        }
        report.look(now, device.projector());
        std::thread::sleep(Duration::from_micros(500));
    }
}

/// Says once a second what has changed.
struct Report {
    due: HostTime,
    said: String,
    light: Option<PathBuf>,
}

impl Report {
    fn look(&mut self, now: HostTime, projector: &mut MockProjector) {
        if now < self.due {
            return;
        }
        self.due = now.plus_ns(1_000_000_000);
        let s = projector.status();
        let text = format!(
            "{:?}: {} frames lit, {} repeated, {} blank; dropped {} incomplete, {} late, {} superseded, {} refused; \
             {} damaged packets",
            s.state,
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
            println!("{:8.1} s  {text}", now.0 as f64 * 1e-9);
            self.said = text;
        }
        let raster = projector.raster();
        if let (Some(path), Some(light)) = (&self.light, projector.light_of_frame()) {
            if let Err(e) = write_ppm(path, raster, light) {
                eprintln!("{}: {e}", path.display());
                self.light = None;
            }
        }
    }
}

fn write_ppm(path: &Path, raster: Raster, light: &[[u8; 3]]) -> std::io::Result<()> {
    let mut bytes = format!("P6\n{} {}\n255\n", raster.width(), raster.height()).into_bytes();
    bytes.extend(light.iter().flatten());
    // Beside, then over the old one: a reader never sees half a picture.
    let beside = path.with_extension("part");
    std::fs::write(&beside, bytes)?;
    std::fs::rename(beside, path)
}
