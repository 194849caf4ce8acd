//! `dpm calibrate camera`: prints the board, and finds the inside of the camera that looks at it.

use super::{form_of, seconds};
use crate::cli::rig_args::RigArgs;
use crate::cli::watch::print;
use dpm_calibrate::beside;
use dpm_calibrate::camera::{calibrate, told_of, CameraTask};
use dpm_camera::{board_pdf, TAGS};
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
    /// With --print: tags for bodies in place of the board, from this number on, as many as the paper holds
    #[arg(long, value_name = "FIRST", requires = "print", value_parser = clap::value_parser!(u16).range(0..TAGS as i64))]
    tags: Option<u16>,
    /// With --tags: length of a side of each tag's black border, millimetres (tracker.tags[].side_m)
    #[arg(long, value_name = "MM", default_value_t = 60.0, requires = "tags", value_parser = side_mm)]
    side_mm: f64,
    /// Find where each of tracker.others stands beside the first camera, from bodies that both see, and print it
    #[arg(long, conflicts_with = "print")]
    places: bool,
    /// The paper on which the board is printed
    #[arg(long, value_enum, default_value = "a4")]
    paper: Paper,
    /// Views of the board, or with --places places of a body, that are enough
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
            (Some(path), _) if self.tags.is_some() => {
                let page = sheet_of_tags(self.tags.unwrap_or(0), self.side_mm, sheet);
                let page = page.map_err(|told| Failure::new(FailureKind::BadInput, told))?;
                print_board(path, &board_pdf(&page, sheet))
            }
            (Some(path), _) => print_board(path, &board_pdf(&board, sheet)),
            (None, Some(rig)) if self.places => self.find_places(rig),
            (None, Some(rig)) => self.measure(rig, board),
            // The command line asks for one of the two.
            (None, None) => Ok(()),
        }
    }

    fn find_places(&self, rig: &Path) -> Result<(), Failure> {
        let args = RigArgs { set: self.set.clone(), ..RigArgs::default() };
        let config = args.rig_to_calibrate(rig)?;
        let bad = |told: String| Failure::new(FailureKind::BadInput, told);
        let clock = dpm_calibrate::view::clock();
        let mut cameras = config.tracker.cameras_alone(&clock).map_err(|e| bad(e.to_string()))?;
        if cameras.len() < 2 {
            let told = format!("{} has one camera at most: name more as tracker.others", rig.display());
            return Err(bad(told));
        }
        let (places, time) = (usize::from(self.views), Duration::from_secs_f64(self.seconds));
        let task = beside::PlaceTask { clock, places, time };
        let found = beside::measure(&mut cameras, &task, &mut |text| print(&format!("{text}\n")))?;
        print("for tracker.others of the rig file:\n");
        found.iter().for_each(|one| print(&format!("{}\n", beside::told_of(one))));
        Ok(())
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
        let task = CameraTask { board, raster: view.raster, views, time };
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

/// Room below the tags for the line of 100 mm and its words, on both sides because tags stand in the middle; and at the sides.
const BELOW_MM: f64 = 12.0;
const BESIDE_MM: f64 = 6.0;

fn side_mm(text: &str) -> Result<f64, String> {
    let side: f64 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    (5.0..=320.0).contains(&side).then_some(side).ok_or_else(|| "must be from 5 to 320".into())
}

/// As many tags of this side as a sheet holds, in rows from the number `first` on.
fn sheet_of_tags(first: u16, side_mm: f64, [w, h]: [f64; 2]) -> Result<TagBoard, String> {
    let one = TagBoard { columns: 1, rows: 1, side_m: 1e-3 * side_mm, first };
    let pitch = 1e3 * one.pitch_m();
    let fit = |room: f64| (room / pitch).floor().max(0.0) as u16;
    let (columns, rows) = (fit(w - 2.0 * BESIDE_MM), fit(h - 2.0 * BELOW_MM));
    let left = (TAGS as u16).saturating_sub(first);
    let columns = columns.min(left);
    let rows = rows.min(left / columns.max(1));
    if columns == 0 || rows == 0 {
        return Err(format!(
            "the paper of {w:.0} x {h:.0} mm holds no tag with a border of {side_mm} mm and its white margin: give a smaller \
             --side-mm or a larger --paper"
        ));
    }
    Ok(TagBoard { columns, rows, ..one })
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Every sheet of tags stays on its paper with the words below, and shows only numbers that exist.
    #[test]
    fn tags_fit_their_sheet() {
        for (w, h) in [(297.0, 210.0), (279.4, 215.9), (420.0, 297.0)] {
            for side in [5.0, 28.0, 60.0, 120.0] {
                for first in [0, 580, 586] {
                    let board = sheet_of_tags(first, side, [w, h]).unwrap();
                    let [wide, high] = board.size_m().map(|m| 1e3 * m);
                    assert!(wide <= w - 10.0 && high <= h - 20.0, "{board:?}");
                    assert!(usize::from(board.first + board.columns * board.rows) <= TAGS, "{board:?}");
                }
            }
        }
        assert_eq!(sheet_of_tags(0, 60.0, [297.0, 210.0]).unwrap().tags().count(), 6);
        assert!(sheet_of_tags(0, 300.0, [297.0, 210.0]).unwrap_err().contains("--side-mm"));
    }
}
