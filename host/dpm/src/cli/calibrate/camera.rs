//! `dpm calibrate camera`: prints the board, and finds the inside of the camera that looks at it.

use super::{form_of, seconds};
use crate::cli::rig_args::RigArgs;
use crate::cli::watch::print;
use dpm_calibrate::camera::{calibrate, told_of, Task};
use dpm_camera::board_pdf;
use dpm_camera_files::{export, MAX_BYTES};
use dpm_common::files::{keep_old, write_atomically};
use dpm_device::tag36h11::TagBoard;
use dpm_rig::failure::{Failure, FailureKind};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

#[derive(clap::Args, Clone, Debug)]
pub(super) struct CameraArgs {
    /// The rig file whose tracker is the camera
    #[arg(value_name = "RIG.toml", required_unless_present = "print")]
    rig: Option<PathBuf>,
    /// Write the board as a page of PDF, to be printed at 100 % and fixed to something flat, and do nothing else
    #[arg(long, value_name = "FILE.pdf", conflicts_with = "rig")]
    print: Option<PathBuf>,
    /// The paper on which the board is printed
    #[arg(long, value_enum, default_value = "a4")]
    paper: Paper,
    /// Views of the board that are enough
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u16).range(6..=100))]
    views: u16,
    /// Longest time, seconds
    #[arg(long, value_name = "S", default_value_t = 180.0, value_parser = seconds)]
    seconds: f64,
    /// The new file (.yml, .yaml, .xml or .json); default: that of tracker.calibration, or camera.yaml beside the rig file
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Set a key of the rig file; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
pub(super) enum Paper {
    /// 297 x 210 mm
    A4,
    /// 11 x 8.5 inches
    Letter,
    /// 420 x 297 mm
    A3,
}

impl Paper {
    /// The board, and width and height of the sheet, millimetres.
    pub(super) fn board(self) -> (TagBoard, [f64; 2]) {
        match self {
            Self::A4 => (TagBoard::SMALL, [297.0, 210.0]),
            Self::Letter => (TagBoard::SMALL, [279.4, 215.9]),
            Self::A3 => (TagBoard::LARGE, [420.0, 297.0]),
        }
    }
}

impl CameraArgs {
    /// Prints or measures.
    ///
    /// # Errors
    /// As [`super::execute`].
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let (board, sheet) = self.paper.board();
        match (&self.print, &self.rig) {
            (Some(path), _) => print_board(path, &board_pdf(&board, sheet)),
            (None, Some(rig)) => self.measure(rig, board),
            // The command line asks for one of the two.
            (None, None) => Ok(()),
        }
    }

    fn measure(&self, rig: &Path, board: TagBoard) -> Result<(), Failure> {
        let args = RigArgs { set: self.set.clone(), ..RigArgs::default() };
        let config = args.rig_to_calibrate(rig)?;
        let clock = dpm_calibrate::view::clock();
        let bad = |told: String| Failure::new(FailureKind::BadInput, told);
        let view = config.tracker.view(&clock).ok_or_else(|| {
            bad(format!("the tracker of {} has no pictures; write tracker.kind = \"camera\"", rig.display()))
        })?;
        let mut view = view.map_err(|e| bad(e.to_string()))?;
        let beside = || rig.with_file_name("camera.yaml");
        let path = self.file.clone().or_else(|| view.calibration.clone()).unwrap_or_else(beside);
        let form = form_of(&path)?;
        let (views, time) = (usize::from(self.views), Duration::from_secs_f64(self.seconds));
        let task = Task { board, raster: view.raster, views, time };
        let fit = calibrate(&mut *view.source, &task, &mut |text| print(&format!("{text}\n")))?;
        print(&format!("{}\n", told_of(&fit)));
        let camera = fit.model.camera(view.raster).map_err(|e| bad(e.to_string()))?;
        let named = |e: std::io::Error| bad(format!("{}: {e}", path.display()));
        let kept = keep_old(&path, MAX_BYTES as u64).map_err(named)?;
        let text = export(&camera, form);
        write_atomically(&path, |out| out.write_all(text.as_bytes())).map_err(named)?;
        let kept =
            kept.map_or(String::new(), |old| format!(" (the one before is kept as {})", old.display()));
        print(&format!("written: {}{kept}\n", path.display()));
        if view.calibration.is_none() {
            let named = path.display().to_string();
            print(&format!("for `dpm run`, name it in the rig file:\n[tracker]\ncalibration = {named:?}\n"));
        }
        Ok(())
    }
}

fn print_board(path: &Path, page: &[u8]) -> Result<(), Failure> {
    let named = |e: std::io::Error| Failure::new(FailureKind::BadInput, format!("{}: {e}", path.display()));
    write_atomically(path, |out| out.write_all(page)).map_err(named)?;
    print(&format!(
        "written: {}\nprint it at 100 %, without \"fit to page\"; its line must measure 100 mm. Fix it to something flat\n",
        path.display()
    ));
    Ok(())
}
