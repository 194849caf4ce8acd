//! `dpm calibrate camera`: a printed board is held before a camera, still at one place after another.

use dpm_calibration::board::{solve, BoardView, CameraFit, LEAST_POINTS, LEAST_VIEWS};
use dpm_camera::{board_view, GreyImage, Picture, PictureSource, TagDetector};
use dpm_device::planes::Raster;
use dpm_device::tag36h11::TagBoard;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DVec2;
use std::time::{Duration, Instant};

/// What is looked for.
#[derive(Clone, Copy, Debug)]
pub struct CameraTask {
    /// The board.
    pub board: TagBoard,
    /// Columns and rows of the pictures.
    pub raster: Raster,
    /// Views that are enough.
    pub views: usize,
    /// Longest time.
    pub time: Duration,
}

/// A picture that counts, and what was seen of the board in it.
struct BoardPicture {
    picture: Picture,
    view: BoardView,
}

/// How far the board may move from one picture to the next, pixels: then it is held still.
const STILL_PX: f64 = 0.35;
/// How far it must have moved since each view that counts, as a share of the picture's width.
const ELSEWHERE: f64 = 0.04;
/// How long a picture is waited for.
const PATIENCE: Duration = Duration::from_millis(200);
/// A camera that is silent for so long has failed.
const SILENCE: Duration = Duration::from_secs(5);

/// Takes views until there are enough or the time is over, and solves. `tell`: what the operator reads.
///
/// # Errors
/// The camera fails (exit code 3), sends pictures of another size, or the views make no camera (2).
pub fn calibrate(
    source: &mut dyn PictureSource,
    task: &CameraTask,
    tell: &mut dyn FnMut(&str),
) -> Result<CameraFit, Failure> {
    tell(
        "Hold the board still at one place after another, a second each: near and far, in the middle and in all corners,\n\
         turned by 20 to 45 degrees to the left, to the right, up and down.",
    );
    let taken = take(source, task, tell)?;
    solved(&taken, task).map_err(|e| Failure::new(FailureKind::BadInput, e))
}

fn take(
    source: &mut dyn PictureSource,
    task: &CameraTask,
    tell: &mut dyn FnMut(&str),
) -> Result<Vec<BoardPicture>, Failure> {
    let (begin, mut heard) = (Instant::now(), Instant::now());
    let (mut picture, mut tags, mut detector) = (Picture::default(), Vec::new(), TagDetector::new());
    let (mut taken, mut before): (Vec<BoardPicture>, BoardView) = (Vec::new(), BoardView::new());
    while taken.len() < task.views && begin.elapsed() < task.time {
        match source.next(PATIENCE, &mut picture) {
            Ok(true) => heard = Instant::now(),
            Ok(false) if heard.elapsed() < SILENCE => continue,
            Ok(false) => {
                let told = format!("{} has sent no picture for {} s", source.name(), SILENCE.as_secs());
                return Err(Failure::new(FailureKind::Device, told));
            }
            Err(why) if heard.elapsed() < SILENCE => {
                std::thread::sleep(PATIENCE);
                tracing::debug!(why, "the camera");
                continue;
            }
            Err(why) => return Err(Failure::new(FailureKind::Device, why)),
        }
        let image = image_of(&picture, task.raster)?;
        detector.detect(&image, None, &mut tags);
        let view = board_view(&task.board, &tags);
        let is_still = moved_px(&view, &before).is_some_and(|px| px < STILL_PX);
        let elsewhere = ELSEWHERE * f64::from(task.raster.width());
        let is_new = taken.iter().all(|t| moved_px(&view, &t.view).is_none_or(|px| px > elsewhere));
        before.clone_from(&view);
        if view.len() < LEAST_POINTS || !is_still || !is_new {
            continue;
        }
        let seen = view.len() / 4;
        taken.push(BoardPicture { picture: picture.clone(), view });
        let all = task.board.columns * task.board.rows;
        tell(&format!("view {}: {seen} of {all} tags{}", taken.len(), outlook(&taken, task)));
    }
    Ok(taken)
}

/// What the views so far would give.
fn outlook(taken: &[BoardPicture], task: &CameraTask) -> String {
    if taken.len() < LEAST_VIEWS {
        return String::new();
    }
    let views: Vec<BoardView> = taken.iter().map(|t| t.view.clone()).collect();
    match solve(task.raster, &views) {
        Ok(fit) => format!("; predicted error {:.2} px", fit.predicted.p99_px),
        Err(why) => format!("; not yet: {why}"),
    }
}

/// The views as they are, and once more with edges that are looked for along the lens's own bends.
fn solved(
    taken: &[BoardPicture],
    task: &CameraTask,
) -> Result<CameraFit, dpm_calibration::board::BoardRefusal> {
    let views: Vec<BoardView> = taken.iter().map(|t| t.view.clone()).collect();
    let mut fit = solve(task.raster, &views)?;
    for _ in 0..2 {
        let Ok(camera) = fit.model.camera(task.raster) else { break };
        let views: Vec<BoardView> = taken.iter().map(|t| again(t, task, &camera)).collect();
        fit = solve(task.raster, &views)?;
    }
    Ok(fit)
}

fn again(taken: &BoardPicture, task: &CameraTask, camera: &ProjectorCamera) -> BoardView {
    let Ok(image) = image_of(&taken.picture, task.raster) else { return taken.view.clone() };
    let mut tags = Vec::new();
    TagDetector::new().detect(&image, Some(camera), &mut tags);
    board_view(&task.board, &tags)
}

fn image_of(picture: &Picture, raster: Raster) -> Result<GreyImage<'_>, Failure> {
    let (w, h) = (raster.width() as usize, raster.height() as usize);
    let told = || {
        let (pw, ph) = (picture.width, picture.height);
        Failure::new(FailureKind::BadInput, format!("pictures have {pw} x {ph} pixels: set tracker.size"))
    };
    let fits = (picture.width, picture.height) == (w, h);
    GreyImage::new(w, h, &picture.pixels).filter(|_| fits).ok_or_else(told)
}

/// How far the corners that both views show are apart in the mean, pixels; `None` if they share too few.
fn moved_px(a: &BoardView, b: &BoardView) -> Option<f64> {
    let partner = |p: &dpm_calibration::board::BoardPoint| {
        let same = b.iter().find(|q| (q.place - p.place).length() < 1e-6)?;
        Some((same.pixel - p.pixel).length())
    };
    let moves: Vec<f64> = a.iter().filter_map(partner).collect();
    (moves.len() >= LEAST_POINTS / 2).then(|| moves.iter().sum::<f64>() / moves.len() as f64)
}

/// What the operator is told of a camera.
pub fn told_of(fit: &CameraFit) -> String {
    let [focal, cx, cy] = fit.deviations();
    let (m, p) = (&fit.model, &fit.predicted);
    let mut told = format!(
        "predicted error {:.3} px (99th percentile over the picture, of the directions that it shows);\n\
         focal lengths {:.2} and {:.2} px, known to {focal:.2} px; centre ({:.2}, {:.2}) px, known to {:.2} px; lens {:?};\n\
         residual {:.3} px rms of {} of {} views, tilted by up to {:.0} degrees",
        p.p99_px,
        m.focal.x,
        m.focal.y,
        m.centre.x,
        m.centre.y,
        DVec2::new(cx, cy).max_element(),
        m.lens_numbers().iter().map(|k| (k * 1e5).round() / 1e5).collect::<Vec<f64>>(),
        fit.rms_px,
        fit.views - fit.left_out.len(),
        fit.views,
        fit.tilt.to_degrees()
    );
    if fit.bend_m > 3e-4 {
        told += &format!("\nthe board bulges by {:.1} mm, which is reckoned with", 1e3 * fit.bend_m);
    }
    told
}

#[cfg(test)]
mod tests;
