//! `hil-mock serve dlpc900`: an emulated projector controller on a USB/IP port.

use super::usb::{offer, UsbArguments};
use super::{complain, say};
use clap::{Args, ValueEnum};
use dpm_dlpc900::image::PlaneOrder;
use dpm_dlpc900::lut::Dmd;
use dpm_dlpc900::sequence::Version;
use hil_mock::dlpc900::{Dlpc900Model, Options, Sequencer};
use std::error::Error;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Arguments of `hil-mock serve dlpc900`.
#[derive(Args)]
pub(crate) struct Dlpc900Arguments {
    /// Mirror array behind the controller
    #[arg(long, value_enum, default_value_t = DmdWord::Dlp6500)]
    dmd: DmdWord,
    /// Firmware version
    #[arg(long, default_value = "6.0.1")]
    firmware: String,
    /// In which bytes of a pixel planes 0-7, 8-15 and 16-23 stand
    #[arg(long, value_enum, default_value_t = OrderWord::Descending)]
    plane_order: OrderWord,
    /// Refuse what the programmer's guide forbids but programs get away with
    #[arg(long)]
    strict: bool,
    /// Enumerate two HID interfaces
    #[arg(long)]
    two_interfaces: bool,
    /// Take a report every millisecond, as full-speed USB does, instead of as fast as they come
    #[arg(long)]
    paced: bool,
    /// No video signal is connected
    #[arg(long)]
    no_source: bool,
    /// Write what is projected as PGM pictures into this folder whenever a sequence starts
    #[arg(long, value_name = "FOLDER")]
    dump: Option<PathBuf>,
    /// Print warnings and state changes
    #[arg(long, short)]
    verbose: bool,
    #[command(flatten)]
    usb: UsbArguments,
}

#[derive(Clone, Copy, ValueEnum)]
enum DmdWord {
    Dlp6500,
    Dlp9000,
    Dlp670s,
    Dlp500yx,
    Dlp5500,
}

#[derive(Clone, Copy, ValueEnum)]
enum OrderWord {
    /// 16-23, 8-15, 0-7: common open programs
    Descending,
    /// 16-23, 0-7, 8-15: TI's own program
    BlueGreenRed,
}

/// Serves until the time is over or the port fails.
pub(super) fn run(arguments: &Dlpc900Arguments) -> Result<(), Box<dyn Error>> {
    let mut numbers = arguments.firmware.split('.').map(str::parse::<u16>);
    let mut next = || numbers.next().transpose().ok().flatten();
    let version = (|| {
        let (major, minor, patch) = (next()?, next()?, next().unwrap_or(0));
        Some(Version { major: u8::try_from(major).ok()?, minor: u8::try_from(minor).ok()?, patch })
    })();
    let options = Options {
        dmd: match arguments.dmd {
            DmdWord::Dlp6500 => Dmd::Dlp6500,
            DmdWord::Dlp9000 => Dmd::Dlp9000,
            DmdWord::Dlp670s => Dmd::Dlp670s,
            DmdWord::Dlp500yx => Dmd::Dlp500yx,
            DmdWord::Dlp5500 => Dmd::Dlp5500,
        },
        firmware: version.ok_or("--firmware: write it as 6.0.1")?,
        plane_order: match arguments.plane_order {
            OrderWord::Descending => PlaneOrder::Descending,
            OrderWord::BlueGreenRed => PlaneOrder::BlueGreenRed,
        },
        strict: arguments.strict,
        interfaces: if arguments.two_interfaces { 2 } else { 1 },
        report_period_ns: if arguments.paced { 1_000_000 } else { 0 },
        source_present: !arguments.no_source,
        ..Options::default()
    };
    if let Some(folder) = &arguments.dump {
        std::fs::create_dir_all(folder).map_err(|e| format!("--dump {}: {e}", folder.display()))?;
    }
    let model = Arc::new(Mutex::new(Dlpc900Model::new(options)));
    let (watched, mut warned, mut was) = (model.clone(), 0, Sequencer::Stopped);
    let mut starts = 0;
    offer(&arguments.usb, "DLPC900", model, |clock| {
        let mut m = watched.lock().unwrap_or_else(PoisonError::into_inner);
        let now = clock();
        let is = m.sequencer(now);
        let started = matches!(is, Sequencer::Running(..)) && is != was;
        if arguments.verbose {
            m.warnings()[warned..].iter().for_each(|w| say(format_args!("warning: {w}")));
            if std::mem::discriminant(&is) != std::mem::discriminant(&was) || started {
                say(format_args!("{}", m.summary(now).trim_end()));
            }
        }
        (warned, was) = (m.warnings().len(), is);
        let Some(folder) = arguments.dump.as_ref().filter(|_| started) else { return };
        starts += 1;
        for place in 0..m.table().len() {
            let path = folder.join(format!("{starts:03}-{place:03}.pgm"));
            if let Some(Err(e)) = m.projected_pgm(place).map(|bytes| std::fs::write(&path, bytes)) {
                complain(format_args!("{}: {e}", path.display()));
                return;
            }
        }
        say(format_args!("sequence {starts}: {} patterns written to {}", m.table().len(), folder.display()));
    })
}
