//! `dpm pattern KIND RIG.toml`: shows a pattern on the rig's projector, or writes it as pictures.

use super::rig_args::RigArgs;
use super::watch::{print, run_and_report, watch};
use clap::ValueEnum;
use dpm_device::planes::Channel;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::own_run;
use dpm_rig::pattern::{
    flashes, run_pattern, shortest_hold_ms, Axis, Ink, Pattern, PatternError, PatternShow,
};
use dpm_rig::run_rig::cannot_write;
use dpm_rig::telemetry::report::to_json;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Flags of `dpm pattern`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct PatternArgs {
    /// What is shown
    #[arg(value_enum)]
    kind: PatternKind,
    /// The rig file; only its projector is used, and neither scene nor tracker nor GPU is needed
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    #[command(flatten)]
    flags: RigArgs,
    /// Pixel of a cross or a dot: column and row, counted from 0 at the upper left
    #[arg(long, value_name = "X,Y", value_parser = pixel)]
    at: Option<[u32; 2]>,
    /// Pixels of a cross's arms (default: up to the edges), of a dot's diameter (7), of a grid's or a chessboard's squares (64);
    /// spokes of a focus star (36)
    #[arg(long, value_name = "N")]
    size: Option<u32>,
    /// Code value of what is lit, 0 to 255; default: 255
    #[arg(long, value_name = "L")]
    level: Option<u8>,
    /// Show one colour instead of white
    #[arg(long, value_enum)]
    channel: Option<Colour>,
    /// Direction along which gray-shifted, phase and ramp vary; default: columns
    #[arg(long, value_enum)]
    axis: Option<Along>,
    /// Pixels from stripe to stripe of gray-shifted (default 16) or phase (default 32)
    #[arg(long, value_name = "PX")]
    period: Option<u32>,
    /// Steps of phase, each moved by an equal part of the period; default: 4
    #[arg(long, value_name = "N")]
    shifts: Option<u32>,
    /// How long each step of a pattern with several steps is shown, milliseconds; default: 1000
    #[arg(long, value_name = "MS")]
    hold_ms: Option<u64>,
    /// Show only this step, counted from 0; for a counter, this number
    #[arg(long, value_name = "N")]
    step: Option<u32>,
    /// Write what would be shown as a PNG file, and show nothing; several steps become FILE-000.png, FILE-001.png, ...
    #[arg(long, value_name = "FILE")]
    png: Option<PathBuf>,
    /// Print the report, or the list of files, as one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PatternKind {
    /// A column and a row of pixels that cross at the pixel --at
    Cross,
    /// A disc around the pixel --at
    Dot,
    /// Lines of one pixel
    Grid,
    /// Lit and dark squares
    Chessboard,
    /// Gray code of the column, most significant bit first, each bit followed by its inverse
    GrayColumns,
    /// Gray code of the row
    GrayRows,
    /// Stripes that move by one pixel from step to step, to refine a Gray code
    GrayShifted,
    /// Sinusoidal fringes that move by an equal part of their period from step to step
    Phase,
    /// Every pixel at --level
    Full,
    /// From dark to --level over the raster
    Ramp,
    /// The number of each frame as blocks that a camera can read
    Counter,
    /// A Siemens star
    FocusStar,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Colour {
    /// Red
    R,
    /// Green
    G,
    /// Blue
    B,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Along {
    Columns,
    Rows,
}

fn pixel(text: &str) -> Result<[u32; 2], String> {
    let parts: Result<Vec<u32>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    let pixel = parts.ok().and_then(|n| <[u32; 2]>::try_from(n).ok());
    pixel.ok_or_else(|| "write the column and the row as whole numbers, such as 512,384".to_owned())
}

impl PatternArgs {
    /// The name of the kind on the command line.
    fn word(&self) -> String {
        self.kind.to_possible_value().map_or_else(String::new, |v| v.get_name().to_owned())
    }

    /// Refuses flags that the kind would accept and then ignore.
    fn refuse_meaningless(&self) -> Result<(), Failure> {
        use PatternKind::*;
        self.flags.refuse("dpm pattern", &["--no-prediction", "--out"])?;
        let sized = [Cross, Dot, Grid, Chessboard, FocusStar];
        let stepping = [GrayColumns, GrayRows, GrayShifted, Phase];
        let of = |kinds: &[PatternKind]| kinds.contains(&self.kind);
        let flags: [(&str, bool, bool); 8] = [
            ("--at", self.at.is_some(), of(&[Cross, Dot])),
            ("--size", self.size.is_some(), of(&sized)),
            ("--axis", self.axis.is_some(), of(&[GrayShifted, Phase, Ramp])),
            ("--period", self.period.is_some(), of(&[GrayShifted, Phase])),
            ("--shifts", self.shifts.is_some(), of(&[Phase])),
            ("--hold-ms", self.hold_ms.is_some(), of(&stepping)),
            ("--step", self.step.is_some(), of(&stepping) || self.kind == Counter),
            ("--scene", self.flags.scene.is_some(), false),
        ];
        let told = match flags.iter().find(|(_, given, meant)| *given && !meant) {
            Some((flag, ..)) => format!("{flag} means nothing to dpm pattern {}: leave it out", self.word()),
            None if self.at.is_none() && of(&[Cross, Dot]) => {
                format!("dpm pattern {} needs the pixel: add --at X,Y", self.word())
            }
            None => return Ok(()),
        };
        Err(Failure::new(FailureKind::BadInput, told))
    }

    fn pattern(&self) -> Pattern {
        let axis = match self.axis {
            None | Some(Along::Columns) => Axis::Columns,
            Some(Along::Rows) => Axis::Rows,
        };
        let at = self.at.unwrap_or_default();
        match self.kind {
            PatternKind::Cross => Pattern::Cross { at, arm: self.size },
            PatternKind::Dot => Pattern::Dot { at, diameter: self.size.unwrap_or(7) },
            PatternKind::Grid => Pattern::Grid { pitch: self.size.unwrap_or(64) },
            PatternKind::Chessboard => Pattern::Chessboard { square: self.size.unwrap_or(64) },
            PatternKind::GrayColumns => Pattern::Gray { axis: Axis::Columns },
            PatternKind::GrayRows => Pattern::Gray { axis: Axis::Rows },
            PatternKind::GrayShifted => Pattern::Shifted { axis, period: self.period.unwrap_or(16) },
            PatternKind::Phase => {
                Pattern::Phase { axis, period: self.period.unwrap_or(32), shifts: self.shifts.unwrap_or(4) }
            }
            PatternKind::Full => Pattern::Full,
            PatternKind::Ramp => Pattern::Ramp { axis },
            PatternKind::Counter => Pattern::Counter,
            PatternKind::FocusStar => Pattern::FocusStar { spokes: self.size.unwrap_or(36) },
        }
    }

    fn show(&self, rig: &RigConfig) -> Result<PatternShow, Failure> {
        let channel = self.channel.map(|colour| match colour {
            Colour::R => Channel::Red,
            Colour::G => Channel::Green,
            Colour::B => Channel::Blue,
        });
        let ink = Ink { level: self.level.unwrap_or(255), channel };
        let p = &rig.projector;
        let place = (p.raster(), &p.schedule());
        Ok(PatternShow::new(
            self.pattern(),
            ink,
            place,
            p.frame_rate,
            self.hold_ms.unwrap_or(1000),
            self.step,
        )?)
    }
}

/// Shows the pattern until it is stopped, or writes it.
///
/// # Errors
/// A bad rig file, a measure that does not fit (exit code 2), or a device that fails (3).
pub(super) fn execute(args: &PatternArgs) -> Result<(), Failure> {
    args.refuse_meaningless()?;
    let rig = args.flags.rig_of_projector(&args.rig, args.png.is_some())?;
    let show = args.show(&rig)?;
    if let Some(file) = &args.png {
        return write_pictures(&show, file, args.json);
    }
    refuse_flashes(&rig, &show)?;
    if let Some(own) = own_run::of(&rig)? {
        let report = watch(rig, move |rig, monitor| (own.pattern)(rig, &show, monitor))?;
        print(&if args.json { report.json() + "\n" } else { report.table() });
        return Ok(());
    }
    run_and_report(rig, args.json, move |rig, monitor| run_pattern(rig, Arc::new(show), monitor))
}

/// Refuses steps that would make the limiter end the light.
fn refuse_flashes(rig: &RigConfig, show: &PatternShow) -> Result<(), Failure> {
    let p = &rig.projector;
    let limit = u8::try_from(rig.safety.flashes_per_second.min(255)).ok().filter(|&n| n > 0);
    match limit {
        Some(limit) if flashes(show, &p.schedule(), p.frame_rate, Some(limit)) => {
            let least_ms = shortest_hold_ms(show, &p.schedule(), p.frame_rate, limit);
            Err(PatternError::Flashes { hold_ms: show.hold_ms(), least_ms }.into())
        }
        _ => Ok(()),
    }
}

/// The files written by `--png`.
#[derive(serde::Serialize)]
struct Written {
    raster: [u32; 2],
    files: Vec<PathBuf>,
}

/// The name of picture `number` of several: "a.png" becomes "a-003.png".
fn numbered(file: &Path, number: u32) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let end = file.extension().map_or("png".into(), |e| e.to_string_lossy());
    file.with_file_name(format!("{stem}-{number:03}.{end}"))
}

fn write_pictures(show: &PatternShow, file: &Path, json: bool) -> Result<(), Failure> {
    let raster = show.raster();
    let [width, height] = [raster.width(), raster.height()];
    let mut codes = vec![0u32; raster.pixel_count()];
    let mut files = Vec::new();
    let several = show.pictures().len() > 1;
    for picture in show.pictures() {
        let path = if several { numbered(file, picture) } else { file.to_owned() };
        show.fill(picture, &mut codes);
        let rgb: Vec<u8> = codes.iter().flat_map(|c| [*c as u8, (c >> 8) as u8, (c >> 16) as u8]).collect();
        let rgb_type = image::ExtendedColorType::Rgb8;
        dpm_common::files::write_atomically(&path, |out| {
            let encoder = image::codecs::png::PngEncoder::new(out);
            image::ImageEncoder::write_image(encoder, &rgb, width, height, rgb_type)
                .map_err(std::io::Error::other)
        })
        .map_err(|e| cannot_write_picture(&path, &e))?;
        files.push(path);
    }
    let written = Written { raster: [width, height], files };
    let lines = written.files.iter().map(|f| format!("{}\n", f.display())).collect::<String>();
    print(&if json { to_json(&written) + "\n" } else { lines });
    Ok(())
}

fn cannot_write_picture(path: &Path, error: &dyn std::fmt::Display) -> Failure {
    let Failure { kind, message } = cannot_write(path, error);
    Failure::new(kind, message.replace("--out", "--png"))
}
