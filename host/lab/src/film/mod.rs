//! `dpm demo --film`: a run at virtual pace into a film of the room and of what the observer sees.
//!
//! The light is that of the planes which the mock projector received, added up as an eye does. Bodies are where the mock
//! tracker's truth has them. Nothing of it is drawn from what the renderer meant to show.

mod encode;
mod picture;
mod stages;
#[cfg(feature = "webm")]
mod webm;

pub use encode::FilmFormat;

use crate::paint::Canvas;
use dpm_render::RenderError;
use dpm_rig::config::{Pace, RigConfig};
use dpm_rig::failure::{Ended, Failure, FailureKind};
use dpm_rig::pictures::FallenLight;
use dpm_rig::pipeline::PipelineError;
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::{cannot_write, open_gpu, run_rig};
use dpm_rig::telemetry::live::SeenLight;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::report::Report;
use picture::Studio;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{sync_channel, Receiver};
use std::sync::Arc;

/// Pictures of the film in a second of it.
const PICTURES_PER_S: u32 = 15;
/// The film shows motion so many times slower than it is: an eye can follow 1 m/s on a small picture only then.
pub(crate) const SLOWED: u32 = 6;
/// Shortest and longest film, seconds.
const LENGTHS_S: [f64; 2] = [1.0, 60.0];
/// Frames of light on their way to the film; the run waits while there are more.
const ON_THE_WAY: usize = 16;
/// Slots of the eye's window that are looked at, at most; of longer ones every n-th.
const SLOTS_SEEN: usize = 16;

/// What to film.
#[derive(Clone, Debug)]
pub struct FilmRequest {
    /// The file.
    pub path: PathBuf,
    /// What it is.
    pub format: FilmFormat,
    /// Length of the film, seconds.
    pub seconds: f64,
}

impl FilmRequest {
    /// A film of `seconds` in the file `path`, whose end says what it is.
    ///
    /// # Errors
    /// The end is none of .gif, .png and .webm, or the program was built without the feature `webm` and it is .webm.
    pub fn new(path: &Path, seconds: f64) -> Result<Self, Failure> {
        let bad = |text: String| Failure::new(FailureKind::BadInput, text);
        if !(LENGTHS_S[0]..=LENGTHS_S[1]).contains(&seconds) {
            let [least, most] = LENGTHS_S;
            return Err(bad(format!("--film-seconds {seconds}: a film lasts {least} to {most} s")));
        }
        let format = FilmFormat::of(path).ok_or_else(|| {
            bad(format!(
                "--film {}: the name of a film ends in .gif, .png (animated) or .webm",
                path.display()
            ))
        })?;
        if format == FilmFormat::WebM && !cfg!(feature = "webm") {
            let name = path.display();
            return Err(bad(format!(
                "--film {name}: this dpm was built without an encoder for WebM; take .gif or .png, or build it with \
                 --features webm"
            )));
        }
        Ok(Self { path: path.to_owned(), format, seconds })
    }

    fn pictures(&self) -> u32 {
        ((self.seconds * f64::from(PICTURES_PER_S)).round() as u32).max(4)
    }

    /// The file with four instants beside the film.
    pub fn strip_path(&self) -> PathBuf {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
        self.path.with_file_name(format!("{stem}-strip.png"))
    }

    /// The rig of `config` that runs as long as the film lasts.
    ///
    /// # Errors
    /// Tracker or projector are not mocks: nobody else could say where light and bodies were.
    pub fn rig(&self, config: &RigConfig) -> Result<RigConfig, Failure> {
        let is_mock = config.projector.backend.is_mock() && config.tracker.is_mock();
        if !is_mock {
            let text = "--film: a film is made from the light of the mock projector and the truth of the mock tracker; \
                        add --simulate";
            return Err(Failure::new(FailureKind::BadInput, text));
        }
        let mut config = config.clone();
        config.real_time.pace = Pace::Virtual;
        let rig_s = self.seconds / f64::from(SLOWED) + 2e-3 * config.light_window_ms();
        config.run.frames = (rig_s * config.projector.frame_rate.hz()).ceil() as u64;
        config.run.seconds = 0.0;
        Ok(config)
    }
}

/// Runs `config`, as [`FilmRequest::rig`] made it, and films it. The report lists the files.
///
/// # Errors
/// As [`run_rig`]; or the film cannot be drawn or written, which does not discard the report.
pub fn film(
    config: &RigConfig,
    request: &FilmRequest,
    monitor: &Arc<RunMonitor>,
) -> Result<Ended<Report>, Failure> {
    let (to_film, light) = sync_channel(ON_THE_WAY);
    monitor.live().follow(to_film);
    let maker = {
        let (config, request, monitor) = (config.clone(), request.clone(), monitor.clone());
        std::thread::Builder::new()
            .name("film".into())
            .spawn(move || shoot(&config, &request, &monitor, &light))
            .map_err(|e| Failure::new(FailureKind::Device, format!("no thread for the film: {e}")))?
    };
    let ran = run_rig(config, monitor);
    // A run that ended before it was lit leaves the other end of the light behind.
    drop(monitor.live().take_follower());
    let made = maker.join().unwrap_or_else(|_| {
        Err(Failure::new(FailureKind::CheckFailed, "the film was stopped by a panic (see above)"))
    });
    let mut ended = ran?;
    if let Some(files) = ended.keep(made) {
        ended.report.files.extend(files);
    }
    Ok(ended)
}

/// Draws the film while its light comes, then writes it.
fn shoot(
    config: &RigConfig,
    request: &FilmRequest,
    monitor: &RunMonitor,
    light: &Receiver<SeenLight>,
) -> Result<Vec<PathBuf>, Failure> {
    let Ok(first) = light.recv() else { return Ok(Vec::new()) };
    let Some(rig) = monitor.live().rig().cloned() else { return Ok(Vec::new()) };
    let gpu = open_gpu(config)?;
    let failed = |e: RenderError| Failure::from(PipelineError::Render(e));
    let mut studio = Studio::new(&rig, &gpu).map_err(failed)?;
    let mut window = FilmWindow::new(&rig);
    let mut pictures: Vec<Canvas> = Vec::new();
    let wanted = request.pictures();
    let begun_ns = first.first_photon_at.0;
    let every_ns = 1e9 / f64::from(PICTURES_PER_S * SLOWED);
    for seen in std::iter::once(first).chain(light.iter()) {
        let at_ns = seen.first_photon_at.0;
        window.take(&rig, &seen);
        // The first picture is taken when an eye has seen a whole window.
        let due_ns = begun_ns + window.length_ns + (f64::from(pictures.len() as u32) * every_ns) as i64;
        if (pictures.len() as u32) < wanted && at_ns >= due_ns && !window.slots.is_empty() {
            let share = pictures.len() as f64 / f64::from(wanted);
            pictures.push(studio.picture(share, window.seen(), &seen).map_err(failed)?);
        }
    }
    if pictures.is_empty() {
        let text = "--film: no light was seen for as long as a picture takes, so there is no film";
        return Err(Failure::new(FailureKind::CheckFailed, text));
    }
    encode::write(&request.path, request.format, &pictures, PICTURES_PER_S)
        .map_err(|e| cannot_write(&request.path, &e))?;
    let strip = request.strip_path();
    picture::strip(&pictures, &stages::INSTANTS).save(&strip).map_err(|e| cannot_write(&strip, &e))?;
    Ok(vec![request.path.clone(), strip])
}

/// The light of the last slots, as many as an eye adds up.
struct FilmWindow {
    slots: VecDeque<FallenLight>,
    length_ns: i64,
    /// Every so many slots are kept.
    step: u64,
    taken: u64,
}

impl FilmWindow {
    fn new(rig: &Rig) -> Self {
        let length_ns = (rig.config.light_window_ms() * 1e6) as i64;
        let slots = (length_ns / rig.rate().slot_len_ns(0)).max(1) as usize;
        Self { slots: VecDeque::new(), length_ns, step: slots.div_ceil(SLOTS_SEEN) as u64, taken: 0 }
    }

    fn take(&mut self, rig: &Rig, seen: &SeenLight) {
        let is_kept = self.taken.is_multiple_of(self.step);
        self.taken += 1;
        let oldest = seen.first_photon_at.0 - self.length_ns;
        while self.slots.front().is_some_and(|slot| slot.light.first_photon_at.0 <= oldest) {
            self.slots.pop_front();
        }
        if is_kept {
            self.slots.extend(FallenLight::of(rig, seen));
        }
    }

    fn seen(&mut self) -> &[FallenLight] {
        self.slots.make_contiguous()
    }
}
