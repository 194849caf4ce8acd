//! `dpm dlpc900`: passes the command line to the DLPC900 driver.

use crate::failure;
use crate::keys::WORD;
use crate::pictures::{sequence_of, PatternFileError, ShowAs};
use crate::rest::put_to_rest;
use clap::ValueEnum;
use dpm_common::{guardian, signals};
use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, UploadProgress};
use dpm_dlpc900::image::{Compression, PlaneOrder};
use dpm_dlpc900::lut::{led, LutEntry};
use dpm_dlpc900::sequence::{LedSetup, Repeat};
use dpm_dlpc900::usb::{self, describe, list, UsbHid, UsbPlace};
use dpm_dlpc900::video::{share_us, Receiver, VideoPatterns};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::projectors;
use dpm_rig::standing::{refuse_where_dark_stands, Identity};
use std::io::Write;
use std::path::PathBuf;

/// Flags of `dpm dlpc900`.
#[derive(clap::Args, Clone, Debug)]
pub struct Dlpc900Args {
    /// The controller, as BUS:ADDRESS in lsusb; needed if several are plugged in
    #[arg(long, value_name = "BUS:ADDRESS", global = true)]
    device: Option<UsbPlace>,
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum Action {
    /// Show what the controller is and what it does
    Status,
    /// Upload pictures as a pattern sequence; it stays stopped unless --start is given
    Upload(UploadArgs),
    /// Set up patterns from the video signal, and start them
    VideoPattern(VideoArgs),
    /// Start the loaded sequence
    Start,
    /// Pause the sequence; start continues it
    Pause,
    /// Stop the sequence
    Stop,
    /// Exercise the mirrors 50/50 with the LEDs off, as recommended whenever nothing is shown
    Idle,
    /// End the exercise (takes 3 s)
    LeaveIdle,
    /// Park the mirrors with the LEDs off
    Park,
    /// Unpark the mirrors; a new upload is needed afterwards
    Unpark,
    /// Go to standby; required two minutes before power is cut
    Standby,
    /// Leave standby
    Wake,
    /// Started by `dpm run`: puts the controller to rest if that run is killed
    #[command(hide = true)]
    Guard,
}

#[derive(clap::Args, Clone, Debug)]
struct UploadArgs {
    /// PNG or JPEG pictures of the DMD's size, one pattern each, in order
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Bits per pattern
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=8))]
    depth: u8,
    /// Exposure, microseconds; default: the shortest possible
    #[arg(long)]
    exposure_us: Option<u32>,
    /// Dark time after each pattern, microseconds
    #[arg(long, default_value_t = 0)]
    dark_us: u32,
    /// LEDs lit
    #[arg(long, value_enum, default_value_t = Leds::White)]
    leds: Leds,
    /// LED currents in units of the driver board, 0 to 255 each
    #[arg(long, value_name = "R,G,B", value_parser = three)]
    led_current: Option<[u8; 3]>,
    /// Each pattern waits for an edge at TRIG_IN1
    #[arg(long)]
    wait_trigger: bool,
    /// Show the sequence this many times; default: forever
    #[arg(long)]
    repeat: Option<u32>,
    /// Which bytes of a pixel contain planes 0-7, 8-15, 16-23; matters for more than 8 planes per image
    #[arg(long, value_enum, default_value_t = PlaneOrderArg::Descending)]
    plane_order: PlaneOrderArg,
    /// How images are coded
    #[arg(long, value_enum, default_value_t = Coding::Smallest)]
    compression: Coding,
    /// Start at once
    #[arg(long)]
    start: bool,
}

#[derive(clap::Args, Clone, Debug)]
struct VideoArgs {
    /// Video input
    #[arg(long, value_enum, default_value_t = Input::Hdmi)]
    input: Input,
    /// Frames per second of the video
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=120))]
    frame_hz: u32,
    /// Patterns per frame, 1 bit each
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u8).range(1..=24))]
    patterns: u8,
    /// Exposure, microseconds; default: an equal share of the frame, of which 250 us are left
    #[arg(long)]
    exposure_us: Option<u32>,
    /// LEDs lit
    #[arg(long, value_enum, default_value_t = Leds::White)]
    leds: Leds,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Leds {
    White,
    Red,
    Green,
    Blue,
}

impl Leds {
    const fn bits(self) -> u8 {
        match self {
            Self::White => led::WHITE,
            Self::Red => led::RED,
            Self::Green => led::GREEN,
            Self::Blue => led::BLUE,
        }
    }
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum PlaneOrderArg {
    /// 16-23, 8-15, 0-7, as usual in open programs
    Descending,
    /// 16-23, 0-7, 8-15, as in TI's program
    BlueGreenRed,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Coding {
    Smallest,
    Raw,
    Rle,
    Erle,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Input {
    Parallel,
    Hdmi,
    DisplayPort,
}

fn three(text: &str) -> Result<[u8; 3], String> {
    let numbers: Result<Vec<u8>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    let numbers = numbers.ok().and_then(|n| <[u8; 3]>::try_from(n).ok());
    numbers.ok_or_else(|| "write three numbers from 0 to 255, such as 80,80,80".to_owned())
}

impl From<PatternFileError> for Failure {
    fn from(e: PatternFileError) -> Self {
        Self::new(FailureKind::BadInput, e)
    }
}

fn open(args: &Dlpc900Args) -> Result<Dlpc900<UsbHid>, Failure> {
    let device = |text: String| Failure::new(FailureKind::Device, text);
    let mut place = args.device;
    if place.is_none() {
        let all = list().map_err(|e| device(e.to_string()))?;
        if all.len() > 1 {
            let names: Vec<_> = all.iter().map(|p| format!("{}:{}", p.bus, p.address)).collect();
            let text = format!(
                "{} controllers are plugged in; name one by --device: {}",
                all.len(),
                names.join(", ")
            );
            return Err(Failure::new(FailureKind::BadInput, text));
        }
        place = all.first().copied();
    }
    let named = |e| device(format!("{}: {e}", describe(place)));
    Dlpc900::new(UsbHid::open(place).map_err(named)?).map_err(failure)
}

/// Runs the command, and returns what it prints.
///
/// # Errors
/// [`FailureKind::Device`] if the controller cannot be reached or refuses; [`FailureKind::BadInput`] if pictures or
/// times break a rule, with the LUT entry and the rule.
pub fn execute(args: &Dlpc900Args) -> Result<String, Failure> {
    if let Action::Guard = args.action {
        return guard(args.device).map(|()| String::new());
    }
    let lights = match &args.action {
        Action::Upload(upload) => upload.start,
        Action::Start | Action::VideoPattern(_) | Action::Wake => true,
        _ => false,
    };
    if lights {
        // Whichever it is: its place on the bus says nothing of it.
        projectors::backend(WORD).map_or(Ok(()), |any| refuse_where_dark_stands(&Identity::of(&any)))?;
    }
    let mut d = open(args)?;
    match &args.action {
        Action::Upload(upload) => execute_upload(&mut d, upload),
        Action::VideoPattern(video) => execute_video(&mut d, video),
        other => act(&mut d, other).map_err(failure),
    }
}

/// What needs only the controller.
fn act(d: &mut Dlpc900<UsbHid>, action: &Action) -> Result<String, Dlpc900Error> {
    match action {
        Action::Guard | Action::Upload(_) | Action::VideoPattern(_) => {}
        Action::Status => return Ok(d.status()?.to_string()),
        Action::Start => {
            make_ready(d)?;
            d.start()?;
        }
        Action::Pause => d.pause()?,
        Action::Stop => d.stop()?,
        Action::Idle => d.idle()?,
        Action::LeaveIdle => d.leave_idle()?,
        Action::Park => d.park()?,
        Action::Unpark => d.unpark()?,
        Action::Standby => {
            d.standby()?;
            return Ok("in standby; the mirrors are safe for a loss of power in 123 s\n".into());
        }
        Action::Wake => d.wake()?,
    }
    Ok(String::new())
}

/// Wakes a resting controller before it shows something. The mirrors need 3 s to leave the exercise.
fn make_ready(d: &mut Dlpc900<UsbHid>) -> Result<(), Dlpc900Error> {
    if d.make_ready()? {
        let _ = writeln!(
            std::io::stderr(),
            "the controller was at rest (exercise, park or standby) and is woken"
        );
    }
    Ok(())
}

/// Watches a run that may be killed: waits until the pipe that the run holds is closed. If nothing was sent through
/// it, the run was killed. Its controller, which has no watchdog, is then put to rest.
///
/// # Errors
/// The controller cannot be reached or refuses.
fn guard(place: Option<UsbPlace>) -> Result<(), Failure> {
    let device = |e: String| Failure::new(FailureKind::Device, e);
    // A stop of the run may go to its whole group, session or service. This process must survive it.
    signals::ignore().map_err(|e| device(format!("cannot ignore signals: {e}")))?;
    if !guardian::outlived() {
        return Ok(());
    }
    put_to_rest(&mut || usb::open(place))
        .map_err(|e| device(format!("{e}; it could not be stopped and continues to show its patterns")))?;
    let _ =
        writeln!(std::io::stderr(), "the run was killed: its DLPC900 is stopped and exercises its mirrors");
    Ok(())
}

fn execute_upload(d: &mut Dlpc900<UsbHid>, u: &UploadArgs) -> Result<String, Failure> {
    let show = ShowAs {
        depth: u.depth,
        exposure_us: u.exposure_us,
        dark_us: u.dark_us,
        leds: u.leds.bits(),
        wait_trigger: u.wait_trigger,
        repeat: u.repeat.map_or(Repeat::Forever, Repeat::Passes),
        order: match u.plane_order {
            PlaneOrderArg::Descending => PlaneOrder::Descending,
            PlaneOrderArg::BlueGreenRed => PlaneOrder::BlueGreenRed,
        },
        compression: match u.compression {
            Coding::Smallest => None,
            Coding::Raw => Some(Compression::Raw),
            Coding::Rle => Some(Compression::Rle),
            Coding::Erle => Some(Compression::Erle),
        },
    };
    let sequence = sequence_of(&u.files, d.dmd(), &show)?;
    let bar = indicatif::ProgressBar::new(sequence.image_bytes() as u64);
    let leds = LedSetup { current: u.led_current, polarity: None };
    if u.start {
        // Done before the upload, which takes many seconds and would otherwise be in vain.
        make_ready(d).map_err(failure)?;
    }
    d.upload(&sequence, leds, &mut |p: UploadProgress| bar.set_position(p.sent as u64)).map_err(failure)?;
    bar.finish_and_clear();
    if u.start {
        d.start().map_err(failure)?;
    }
    let (patterns, images, bytes) =
        (sequence.entries().len(), sequence.images().len(), sequence.image_bytes());
    Ok(format!("{patterns} patterns in {images} images, {bytes} bytes\n"))
}

fn execute_video(d: &mut Dlpc900<UsbHid>, v: &VideoArgs) -> Result<String, Failure> {
    let exposure_us = v.exposure_us.unwrap_or_else(|| share_us(1_000_000 / v.frame_hz, v.patterns.into()));
    let entry = |i: u8| LutEntry { leds: v.leds.bits(), ..LutEntry::one_bit(i.into(), 0, i, exposure_us) };
    make_ready(d).map_err(failure)?;
    d.start_video_patterns(&VideoPatterns {
        dmd: d.dmd(),
        receiver: match v.input {
            Input::Parallel => Receiver::None,
            Input::Hdmi => Receiver::Hdmi,
            Input::DisplayPort => Receiver::DisplayPort,
        },
        ports: None,
        frame_hz: v.frame_hz,
        entries: (0..v.patterns).map(entry).collect(),
        leds: LedSetup::default(),
    })
    .map_err(failure)?;
    Ok(format!(
        "{} patterns of {exposure_us} us in each of {} video frames per second\n",
        v.patterns, v.frame_hz
    ))
}
