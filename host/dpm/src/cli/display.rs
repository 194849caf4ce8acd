//! `dpm display`: the displays of this machine, and what to write for each mode; and the guardian of a run.

use super::watch::print;
use dpm_common::guardian;
use dpm_common::signals;
use dpm_display::card::{cards, show_black, Card};
use dpm_display::kms::{Connector, Kms};
use dpm_display::mode::written;
use dpm_display::scan_out::DisplayError;
use dpm_rig::failure::{Failure, FailureKind};
use std::ffi::OsString;
use std::io::Write;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How long a guardian keeps a dead run's display black if no other program takes it.
const HOLD: Duration = Duration::from_secs(600);

/// Flags of `dpm display`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct DisplayArgs {
    #[command(subcommand)]
    action: Option<Action>,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum Action {
    /// List graphics cards, connectors and modes, with the keys of a rig file for each mode (the default)
    List,
    /// Show black on a display when the run that started this dies: not for the command line
    #[command(hide = true)]
    Guard {
        #[arg(long)]
        crtc: u32,
        #[arg(long)]
        black: u32,
    },
}

/// The command that a run starts as its guardian.
pub(super) fn guardian_command() -> Option<Vec<OsString>> {
    let program = std::env::current_exe().ok()?;
    Some(vec![program.into(), "display".into(), "guard".into()])
}

/// Runs the command.
///
/// # Errors
/// [`FailureKind::Device`] if a guardian cannot show black.
pub(super) fn execute(args: &DisplayArgs) -> Result<(), Failure> {
    match args.action {
        None | Some(Action::List) => {
            print(&listed(&look()));
            Ok(())
        }
        Some(Action::Guard { crtc, black }) => guard(crtc, black),
    }
}

/// Waits until the run ends. If it died, its display, whose descriptor is this process's standard output, is made black.
fn guard(crtc: u32, black: u32) -> Result<(), Failure> {
    let device = |e: String| Failure::new(FailureKind::Device, e);
    // A stop of the run may go to its whole group, session or service. This process must survive it.
    signals::ignore().map_err(|e| device(format!("cannot ignore signals: {e}")))?;
    if !guardian::outlived() {
        return Ok(());
    }
    let descriptor = std::io::stdout().as_fd().try_clone_to_owned();
    let descriptor = descriptor.map_err(|e| device(format!("no display to make black: {e}")))?;
    let _ = writeln!(std::io::stderr(), "the run was killed: its display is made black");
    show_black(descriptor, crtc, black, HOLD).map_err(|e| device(e.to_string()))
}

/// A graphics card, and what is at its connectors.
pub(super) struct CardView {
    /// Its device file.
    pub(super) path: PathBuf,
    /// Another program drives its displays.
    pub(super) is_in_use: bool,
    /// Its connectors.
    pub(super) connectors: Result<Vec<Connector>, DisplayError>,
}

/// All graphics cards of this machine.
pub(super) fn look() -> Vec<CardView> {
    cards().into_iter().map(|path| seen(&path)).collect()
}

fn seen(path: &Path) -> CardView {
    let (is_in_use, connectors) = match Card::look(path) {
        Ok(mut card) => (card.is_in_use(), card.connectors()),
        Err(e) => (false, Err(e)),
    };
    CardView { path: path.into(), is_in_use, connectors }
}

fn listed(all: &[CardView]) -> String {
    if all.is_empty() {
        return "no graphics card that can set modes: /dev/dri has no card\n".into();
    }
    let mut text = String::new();
    for CardView { path, is_in_use, connectors } in all {
        let used = if *is_in_use {
            ", driven by another program (a desktop may lend one of them: docs/DISPLAY.md)"
        } else {
            ""
        };
        text += &format!("{}{used}\n", path.display());
        let connectors = match connectors {
            Ok(connectors) => connectors,
            Err(e) => {
                text += &format!("  {e}\n");
                continue;
            }
        };
        for c in connectors {
            let state = if c.is_connected { "" } else { ": no display answers" };
            text += &format!("  connector = {:?}{state}\n", c.name);
            for mode in c.modes.iter().filter(|m| m.is_progressive()) {
                let Some(rate) = mode.rate() else { continue };
                let (width, height) = mode.size();
                text += &format!(
                    "    mode = \"{mode}\"  width = {width}  height = {height}  frame_rate = {}\n",
                    written(rate)
                );
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_display::mode::{ModeWish, Timing};

    /// What is printed can be copied into a rig file: the mode is found again by its text.
    #[test]
    fn a_listed_mode_is_one_that_is_accepted() {
        let full = Timing {
            clock_khz: 148_352,
            row: [1920, 2008, 2052, 2200],
            frame: [1080, 1084, 1089, 1125],
            flags: 5,
        };
        let other = Timing { clock_khz: 148_500, ..full };
        let connector = Connector {
            name: "HDMI-A-1".into(),
            is_virtual: false,
            is_connected: true,
            modes: vec![other, full],
            properties: Vec::new(),
        };
        let text = listed(&[CardView {
            path: "/dev/dri/card7".into(),
            is_in_use: true,
            connectors: Ok(vec![connector]),
        }]);
        let line = text.lines().nth(3).unwrap();
        assert!(line.contains("frame_rate = \"148352/2475\"") && text.contains("another program"), "{text}");
        let mode = line.split('"').nth(1).unwrap().parse::<ModeWish>().unwrap();
        assert_eq!(mode.choose(&[other, full]), Ok(full));
        assert!(listed(&[]).contains("no graphics card"));
        let gone = CardView {
            path: "/dev/dri/card0".into(),
            is_in_use: false,
            connectors: Err(DisplayError::Denied("x".into())),
        };
        assert!(listed(&[gone]).contains("video"));
    }
}
