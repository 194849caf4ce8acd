//! A rig into the error of every method at equal rays, against a reference that tells its own error.
//!
//! Every method is drawn twice with different seeds. What the two runs share is bias, what they do not is noise; half of the power of
//! their difference is the flicker of one of them, without any reference. The reference comes in two independent halves for the same
//! reason: half of their difference is its own error, and its power is taken off what is measured against it.
//!
//! Equal rays are not equal time, so the other methods are drawn once more with as many samples as fill the time of a frame of dpm.

use super::costs::CardCosts;
pub use super::equal::RACES;
use super::equal::{corrected, least_spp, most_spp, samples_at_equal_time, with_samples, Trial};
use super::parts::GroupShare;
use super::plan::{contenders, looks, paper_at, Contender, Setting, Window};
use super::reference::{mean_of, Reference};
use crate::metrics::error::compare;
use crate::metrics::flicker::TileSeries;
use crate::metrics::flip::{mean_flip, DEFAULT_PIXELS_PER_DEGREE};
use crate::metrics::{luminance, white_of, LinearImage, MetricError};
use crate::sequence::{eye_mean, rmse, FrameTime, Seen, Span, Theatre};
use crate::stamp::Stamp;
use dpm_common::fnv::Fnv;
use dpm_device::planes::Raster;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::RenderError;
use dpm_rig::rig::Rig;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;

/// How much is drawn of every sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SequenceExtent {
    /// Frames before those that count.
    pub warm_up: u32,
    /// Frames that count: flicker is measured over all of them, the eye over the last [`EYE_FRAMES`].
    pub kept: u32,
    /// Samples a pixel and frame of the reference, both halves together.
    pub reference_spp: u32,
}

/// What is drawn.
#[derive(Clone, Debug)]
pub struct ErrorOptions {
    /// How much.
    pub extent: SequenceExtent,
    /// Dpm with each part off in turn is measured too.
    pub ablation: bool,
    /// Runs of each method where figures have intervals: an even number, at least 4.
    pub seeds: u32,
    /// The part of the raster that the rig has; all of it if none.
    pub window: Option<Window>,
    /// Folder for references, and for methods whose group is not complete yet.
    pub cache: PathBuf,
}

/// Slot of the last frame of every sequence: the same however much is drawn before it, so that short runs and long ones judge one moment of
/// the motions. Late enough for the longest warm-up and 250 ms at 947 fps.
pub(crate) const LAST_SLOT: u64 = 383;
/// Frames over which the eye takes the mean: 33 ms at 947 fps.
pub const EYE_FRAMES: usize = 31;
/// Rays count as equal within this share.
const EQUAL_RAYS: f64 = 0.01;
/// Fewer probes in the periphery than this share of all do not tell its flicker.
const LEAST_PERIPHERY: f64 = 0.01;

/// A method with as many samples as fill the time of a frame of dpm: what the eye saw then.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct EqualTime {
    /// Samples a lit pixel and frame.
    pub spp: f64,
    /// Time of a frame by that of dpm, drawn in turns with it: how equal the times were.
    pub time_to_dpm: f64,
    /// RMSE of what the eye sees, as measured.
    pub perceived_rmse_raw: f64,
    /// The same with the reference's own error taken off.
    pub perceived_rmse: f64,
    /// `perceived_rmse_raw` of either run.
    pub runs_raw: [f64; 2],
}

/// A method with as many samples as fill the time of a frame of dpm on a card that was measured before.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TimeOnCard {
    /// The card.
    pub card: String,
    /// What the eye saw. Its time is computed from the costs of the card.
    pub seen: EqualTime,
}

/// One method at one budget. Errors are in the scene's unit of radiance.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ErrorRow {
    /// Method.
    pub method: String,
    /// Bodies move.
    pub moving: bool,
    /// The group's budget: samples a pixel of `paper` where the eye looks. Below 1 it is that share of the rays of 1.
    pub budget: f64,
    /// Samples a lit pixel and frame asked of this method; at least 1 where nothing is kept.
    pub spp: f64,
    /// Rays of a frame, with those that were proven to meet nothing. Methods get equal numbers of these.
    pub rays: f64,
    /// Those of them that were walked through the scene.
    #[serde(default)]
    pub walked_rays: f64,
    /// Rays by those of the group's budget: those of `paper`, or less below 1. Above 1 for a method that cannot take so few.
    pub rays_to_paper: f64,
    /// Samples of a frame.
    pub samples: f64,
    /// GPU time of a frame, ms, in turns with the other methods; 0 without time stamps.
    pub gpu_ms: f64,
    /// Time of a frame until its light is known, ms.
    pub wall_ms: f64,
    /// Between these lies the middle half of the frames that were timed, ms.
    #[serde(default)]
    pub middle_half_ms: [f64; 2],
    /// RMSE of the last frame alone.
    pub single_rmse: f64,
    /// Relative MSE of the last frame alone \[Rousselle11\].
    pub single_rel_mse: f64,
    /// RMSE of what the eye sees, the reference's own error taken off.
    pub perceived_rmse: f64,
    /// The same as measured.
    pub perceived_rmse_raw: f64,
    /// `perceived_rmse_raw` of either run: how far chance moves it.
    #[serde(default)]
    pub runs_raw: [f64; 2],
    /// The same within 15 deg of the gaze (the paper's inner zone), and outside; `None` where too little is lit.
    pub perceived_fovea: Option<f64>,
    /// See `perceived_fovea`.
    pub perceived_periphery: Option<f64>,
    /// RMS over probes of what both runs have in common against the reference: lag, smear, filtering.
    pub bias: f64,
    /// What chance alone makes of `bias` in an unbiased method, one standard deviation: less than this is none that can be told.
    pub bias_floor: f64,
    /// RMS of the eye's noise.
    pub noise: f64,
    /// Mean of the picture against the reference's, minus 1.
    pub mean_shift: f64,
    /// FLIP of what the eye sees, at 67 pixels a degree.
    pub flip: f64,
    /// RMS flicker of tiles from 1 to 60 Hz, everywhere.
    pub flicker: f64,
    /// The same in tiles beyond 15 deg; `None` where too little is lit.
    pub flicker_periphery: Option<f64>,
    /// `perceived_rmse` by that of `paper`.
    pub ratio_to_paper: f64,
    /// With the time of dpm in place of the rays of `paper`; `None` of dpm itself and its parts.
    #[serde(default)]
    pub equal_time: Option<EqualTime>,
    /// The same on each card of `host/lab/cards/` that has the costs of the method.
    #[serde(default)]
    pub on_cards: Vec<TimeOnCard>,
}

/// A measured group, as it is kept in its file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct GroupResult {
    /// With what.
    pub stamp: Stamp,
    /// Hash of all that the result depends on.
    pub key: String,
    /// How much was drawn.
    pub extent: SequenceExtent,
    /// Probes: lit surface points that the eye follows.
    pub probes: usize,
    /// Their mean radiance.
    pub mean: f64,
    /// RMS error of the reference as the eye sees it, from its two halves.
    pub reference_error: f64,
    /// One a method, `paper` first.
    pub rows: Vec<ErrorRow>,
}

impl GroupResult {
    /// What was measured, of a rig as its file has it.
    pub fn setting(&self) -> Setting {
        let (moving, budget) = self.rows.first().map_or((false, 0.0), |r| (r.moving, r.budget));
        Setting::plain(moving, budget)
    }
}

/// A group with what the eye saw, for a picture of it.
pub struct Measured {
    /// The numbers.
    pub result: GroupResult,
    /// Raster of the pictures.
    pub raster: Raster,
    /// Pixel of every probe.
    pub pixels: Vec<u32>,
    /// What the eye should have seen at every probe.
    pub reference: Vec<Vec3>,
    /// By method, in the order of the rows: what it saw in the first run.
    pub eyes: Vec<(&'static str, Vec<Vec3>)>,
    parts: Vec<GroupShare>,
}

impl Measured {
    /// The group is kept as a whole: what was kept of its methods one by one is not needed any more.
    pub fn is_kept(self) {
        self.parts.iter().for_each(GroupShare::remove);
    }
}

/// Why a group could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum ErrorRunError {
    /// The renderer's.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Pictures that cannot be compared.
    #[error("cannot compare with the reference: {0}")]
    Metric(#[from] MetricError),
    /// Nothing to look at.
    #[error("the projector lights nothing at the end of the sequence: check projector.position and look_at, and scene.bodies")]
    NothingLit,
    /// The cache.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Names all that the result of a setting depends on; `more` is what the experiment depends on beside.
pub fn key_of(stamp: &Stamp, setting: Setting, options: &ErrorOptions, more: &str) -> String {
    let (o, mut hash) = (options, Fnv::default());
    let look = setting.look.map(|look| looks()[look].clone());
    // Writing into a hash cannot fail.
    let _ = write!(hash, "{stamp:?}{setting:?}{look:?}{:?}{}{more}", o.extent, o.ablation);
    if let Some(window) = o.window {
        let _ = write!(hash, "{window}");
    }
    hash.text()
}

/// Draws and compares the methods in one setting of a rig.
pub struct ErrorRuns {
    pub(super) rig: Arc<Rig>,
    gpu: Arc<Gpu>,
    pub(super) options: ErrorOptions,
    pub(super) stamp: Stamp,
    /// What is measured.
    pub setting: Setting,
    /// The body that is looked at.
    pub(super) body: usize,
}

impl ErrorRuns {
    /// Ready to measure `rig` in `setting` on `gpu`.
    pub fn new(rig: Rig, gpu: Arc<Gpu>, setting: Setting, options: ErrorOptions) -> Self {
        let stamp = Stamp::new(&rig, gpu.summary());
        let (rig, body) = setting.apply(rig);
        Self { rig: Arc::new(rig), gpu, options, stamp, setting, body }
    }

    /// The setting's sequence: its last `warm_up` and `kept` frames.
    pub(super) fn theatre(&self, warm_up: u32, kept: u32) -> Result<Theatre, RenderError> {
        let span = Span { last_slot: LAST_SLOT, warm_up, kept };
        let make = if self.setting.moving { Theatre::new } else { Theatre::frozen };
        make(self.rig.clone(), self.gpu.clone(), span)
    }

    /// The methods; `paper` has the samples of the setting's budget.
    pub(super) fn contenders(&self) -> Vec<Contender> {
        let mut all = contenders(&self.rig.config.render, self.options.ablation);
        all[0].method = paper_at(&all[0].method, self.setting.budget.max(1.0));
        all
    }

    /// The setting's reference, from the cache where it lies there. What it converges to depends neither on the methods' seed nor on how
    /// long the methods run, nor on what the eye looks at.
    pub(super) fn reference(&self, each: &mut dyn FnMut(&str)) -> Result<Reference, ErrorRunError> {
        let (o, stamp, setting) = (&self.options, &self.stamp, self.setting);
        let look = setting.look.map(|look| format!(" {:?}", looks()[look])).unwrap_or_default();
        let look = o.window.map_or(look.clone(), |window| format!("{look} {window}"));
        let what = format!("{}{look}{:?}{}{LAST_SLOT}", stamp.config_hash, stamp.raster, setting.moving);
        let short = self.theatre(0, EYE_FRAMES as u32)?;
        Reference::new(&short, o.extent.reference_spp, &what, &o.cache, each)
    }

    /// Measures all methods at the rays of `paper`. `each` is called before every sequence with its name. Methods that an
    /// earlier call has measured before it was stopped are not drawn again.
    ///
    /// # Errors
    /// The renderer's; nothing lit; the cache cannot be written.
    pub fn measure(&self, each: &mut dyn FnMut(&str)) -> Result<Measured, ErrorRunError> {
        let o = &self.options;
        let key = key_of(&self.stamp, self.setting, o, "");
        let theatre = self.theatre(o.extent.warm_up, o.extent.kept)?;
        if theatre.probes().is_empty() {
            return Err(ErrorRunError::NothingLit);
        }
        let reference = self.reference(each)?;
        let contenders = self.contenders();
        let parts: Vec<GroupShare> =
            (contenders.iter().map(|c| GroupShare::new(&o.cache, &key, c.name))).collect();
        let (mut rows, mut eyes): (Vec<ErrorRow>, Vec<_>) = (Vec::new(), Vec::new());
        let mut wanted = None;
        for (contender, part) in contenders.iter().zip(&parts) {
            let (mut row, eye) = match part.read(theatre.probes().len()) {
                Some(known) => known,
                None => {
                    let spp = match wanted {
                        None => self.setting.budget.max(1.0) as f32,
                        Some(rays) => self.spp_for(&contender.method, rays)?,
                    };
                    let measured = self.row(&theatre, contender, spp, wanted, &reference, each)?;
                    part.write(&measured)?;
                    measured
                }
            };
            let rays = match wanted {
                Some(rays) => rays,
                // `paper` takes no less than one sample a coarse pixel: a smaller budget is a share of what that takes.
                None if self.setting.budget < 1.0 => {
                    let base = self.rays_at(&Method::full(1), 0.0)?;
                    base + self.setting.budget * (row.rays - base)
                }
                None => row.rays,
            };
            wanted = Some(rays);
            row.rays_to_paper = row.rays / rays;
            row.ratio_to_paper =
                row.perceived_rmse / rows.first().map_or(row.perceived_rmse, |paper| paper.perceived_rmse);
            rows.push(row);
            eyes.push((contender.name, eye));
        }
        let runners: Vec<(Method, f32)> =
            contenders.iter().zip(&rows).map(|(c, r)| (c.method.clone(), r.spp as f32)).collect();
        each("times");
        let times = theatre.race(&runners, self.stamp.seed as u32)?;
        for (row, time) in rows.iter_mut().zip(&times) {
            (row.gpu_ms, row.wall_ms, row.middle_half_ms) = (time.gpu_ms, time.wall_ms, time.middle_half_ms);
        }
        self.at_equal_time(&theatre, &contenders, &times, &mut rows, &reference, each)?;
        self.on_cards(theatre.probes().len() as f64, &contenders, &mut rows, &reference, each)?;
        let result = GroupResult {
            stamp: self.stamp.clone(),
            key,
            extent: o.extent,
            probes: theatre.probes().len(),
            mean: mean_of(&reference.eye),
            reference_error: reference.error,
            rows,
        };
        let pixels = theatre.probes().iter().map(|p| p.pixel).collect();
        Ok(Measured { result, raster: theatre.raster(), pixels, reference: reference.eye, eyes, parts })
    }

    /// Draws every method but dpm and its parts with as many samples as fill the time of a frame of dpm.
    #[allow(clippy::too_many_arguments)]
    fn at_equal_time(
        &self,
        theatre: &Theatre,
        contenders: &[Contender],
        times: &[FrameTime],
        rows: &mut [ErrorRow],
        reference: &Reference,
        each: &mut dyn FnMut(&str),
    ) -> Result<(), ErrorRunError> {
        let Some(dpm) = contenders.iter().position(|c| c.name == DPM) else { return Ok(()) };
        let others: Vec<usize> = (0..rows.len()).filter(|&i| is_other(contenders[i].name)).collect();
        let methods: Vec<&Method> = others.iter().map(|&i| &contenders[i].method).collect();
        // Samples that were tried, and the time of a frame by that of dpm, which ran along with its own.
        let first: Vec<Trial> =
            others.iter().map(|&i| (rows[i].spp, times[i].ms() / times[dpm].ms())).collect();
        let beside = (contenders[dpm].method.clone(), rows[dpm].spp as f32);
        let seed = self.stamp.seed as u32;
        let equal = samples_at_equal_time(theatre, &methods, &first, &beside, seed, &mut || each("times"))?;
        for (&i, trial) in others.iter().zip(equal) {
            rows[i].equal_time = Some(self.seen_with(&contenders[i], trial, reference, each)?);
        }
        Ok(())
    }

    /// What the eye sees of a method with the samples of a trial.
    fn seen_with(
        &self,
        contender: &Contender,
        (spp, time_to_dpm): Trial,
        reference: &Reference,
        each: &mut dyn FnMut(&str),
    ) -> Result<EqualTime, ErrorRunError> {
        let (name, seed) = (contender.name, self.stamp.seed as u32);
        let method = with_samples(&contender.method, spp as f32);
        // Only what the eye sees at the end is wanted.
        let warm_up = if method.needs_history() { self.options.extent.warm_up } else { 0 };
        let short = self.theatre(warm_up, EYE_FRAMES as u32)?;
        let mut play = |seed: u32| {
            each(&format!("{name}{AT_EQUAL_TIME}"));
            let seen = short.play(&method, spp as f32, seed, &mut |_, _| ())?;
            Ok::<_, RenderError>(eye_mean(&seen.frames, EYE_FRAMES))
        };
        let eyes = [play(seed)?, play(seed.wrapping_add(1_000_003))?];
        let (raw, clean) = reference.perceived(&eyes, &|_| true);
        let runs_raw = reference.each_run(&eyes);
        Ok(EqualTime { spp, time_to_dpm, perceived_rmse_raw: raw, perceived_rmse: clean, runs_raw })
    }

    /// Draws every method but dpm and its parts with as many samples as fill the time of a frame of dpm on each card whose costs
    /// are known.
    fn on_cards(
        &self,
        lit_pixels: f64,
        contenders: &[Contender],
        rows: &mut [ErrorRow],
        reference: &Reference,
        each: &mut dyn FnMut(&str),
    ) -> Result<(), ErrorRunError> {
        let Some(dpm) = rows.iter().find(|r| r.method == DPM).map(|r| r.rays) else { return Ok(()) };
        for card in CardCosts::all() {
            let Some(wanted) = card.of(DPM).map(|costs| costs.frame_ms(lit_pixels, dpm)) else { continue };
            for (contender, row) in contenders.iter().zip(&mut *rows).filter(|(c, _)| is_other(c.name)) {
                let Some(costs) = card.of(contender.name) else { continue };
                let least = least_spp(&contender.method);
                let most = most_spp(row.spp as f32, least);
                // A method whose samples go by the visual angle keeps its table's shape, and its rays grow with it.
                let rays = |spp: f32| self.rays_at(&with_samples(&contender.method, spp), spp);
                let (few, many) = (row.spp as f32, 2.0 * row.spp as f32);
                let (at_few, at_many) = (rays(few)?, rays(many)?);
                let slope = (at_many - at_few) / f64::from(many - few);
                let base = at_few - slope * f64::from(few);
                let spp = corrected(few, base, at_few, costs.rays_in(wanted, lit_pixels)).clamp(least, most);
                let time = costs.frame_ms(lit_pixels, base + slope * f64::from(spp)) / wanted;
                let seen = self.seen_with(contender, (f64::from(spp), time), reference, each)?;
                row.on_cards.push(TimeOnCard { card: card.name().to_owned(), seen });
            }
        }
        Ok(())
    }

    /// Rays of a frame with so many samples, from a short sequence.
    pub(super) fn rays_at(&self, method: &Method, spp: f32) -> Result<f64, RenderError> {
        const FRAMES: u32 = 6;
        let short = self.theatre(FRAMES, FRAMES)?;
        Ok(short.play(method, spp, 77, &mut |_, _| ())?.rays as f64 / f64::from(FRAMES))
    }

    /// Samples with which a method takes `rays` a frame: a frame without samples tells the fixed part, a short sequence the rest.
    pub(super) fn spp_for(&self, method: &Method, rays: f64) -> Result<f32, RenderError> {
        const TRIAL: f32 = 4.0;
        let (base, trial) = (self.rays_at(method, 0.0)?, self.rays_at(method, TRIAL)?);
        Ok(corrected(TRIAL, base, trial, rays).max(least_spp(method)))
    }

    #[allow(clippy::too_many_arguments)]
    fn row(
        &self,
        theatre: &Theatre,
        contender: &Contender,
        mut spp: f32,
        wanted: Option<f64>,
        reference: &Reference,
        each: &mut dyn FnMut(&str),
    ) -> Result<(ErrorRow, Vec<Vec3>), ErrorRunError> {
        let seed = self.rig.config.render.seed as u32;
        let mut play = |spp: f32, seed: u32| {
            each(contender.name);
            theatre.play(&contender.method, spp, seed, &mut |_, _| ())
        };
        let frames = f64::from(self.options.extent.kept);
        let mut a = play(spp, seed)?;
        // A line through two trials meets the rays that are wanted; the first trial has only what a sample takes at most.
        let (mut earlier, mut trials) = (None, 0);
        while let Some(wanted) = wanted {
            let (rays, samples) = (a.rays as f64 / frames, (a.samples as f64 / frames).max(1.0));
            if (rays / wanted - 1.0).abs() <= EQUAL_RAYS || trials == 2 {
                break;
            }
            let base = match earlier {
                Some((spp_before, rays_before)) => {
                    rays - (rays - rays_before) / f64::from(spp - spp_before) * f64::from(spp)
                }
                None => rays - 4.0f64.min(rays / samples) * samples,
            };
            let better = corrected(spp, base, rays, wanted).max(least_spp(&contender.method));
            if better == spp {
                break;
            }
            (earlier, trials) = (Some((spp, rays)), trials + 1);
            spp = better;
            a = play(spp, seed)?;
        }
        let b = play(spp, seed.wrapping_add(1_000_003))?;
        self.compare(theatre, contender, spp, [a, b], reference)
    }

    fn compare(
        &self,
        theatre: &Theatre,
        contender: &Contender,
        spp: f32,
        runs: [Seen; 2],
        reference: &Reference,
    ) -> Result<(ErrorRow, Vec<Vec3>), ErrorRunError> {
        let frames = f64::from(self.options.extent.kept);
        let eyes = [0, 1].map(|i| eye_mean(&runs[i].frames, EYE_FRAMES));
        let inner = self.rig.config.render.paper.phi_h_deg as f32;
        let angle = |i: usize| theatre.probes()[i].angle;
        let outside = theatre.probes().iter().filter(|p| p.angle >= inner).count() as f64;
        let share = outside / theatre.probes().len() as f64;
        let zone = |enough: bool, keep: &dyn Fn(usize) -> bool| {
            enough.then(|| reference.perceived(&eyes, keep)).map(|(_, clean)| clean)
        };
        let (raw, clean) = reference.perceived(&eyes, &|_| true);
        let [a, b] = &runs;
        let (flicker, flicker_periphery) = self.flicker(theatre, a, b, inner)?;
        let single = |seen: &Seen| {
            let last = seen.frames.last().map_or(&[][..], Vec::as_slice);
            let (test, truth) =
                (LinearImage::new(last.len(), 1, last)?, LinearImage::new(last.len(), 1, &reference.last)?);
            compare(&test, &truth, None, 1.0)
        };
        let (first, second) = (single(a)?, single(b)?);
        let (bias, bias_floor) = reference.bias(&eyes);
        let both = |of: &dyn Fn(&Seen) -> u64| 0.5 * (of(a) + of(b)) as f64 / frames;
        let row = ErrorRow {
            method: contender.name.to_owned(),
            moving: self.setting.moving,
            budget: self.setting.budget,
            spp: f64::from(spp),
            rays: both(&|s| s.rays),
            walked_rays: both(&|s| s.walked_rays),
            rays_to_paper: 1.0,
            samples: both(&|s| s.samples),
            gpu_ms: 0.0,
            wall_ms: 0.0,
            middle_half_ms: [0.0; 2],
            single_rmse: (0.5 * (first.rmse.powi(2) + second.rmse.powi(2))).sqrt(),
            single_rel_mse: 0.5 * (first.rel_mse + second.rel_mse),
            perceived_rmse: clean,
            perceived_rmse_raw: raw,
            runs_raw: reference.each_run(&eyes),
            perceived_fovea: zone(1.0 - share >= LEAST_PERIPHERY, &|i| angle(i) < inner),
            perceived_periphery: zone(share >= LEAST_PERIPHERY, &|i| angle(i) >= inner),
            bias,
            bias_floor,
            noise: rmse(&eyes[0], &eyes[1], |_| true) / std::f64::consts::SQRT_2,
            mean_shift: 0.5 * (mean_of(&eyes[0]) + mean_of(&eyes[1])) / mean_of(&reference.eye) - 1.0,
            flip: self.flip(theatre, &eyes[0], &reference.eye)?,
            flicker,
            flicker_periphery: flicker_periphery.filter(|_| share >= LEAST_PERIPHERY),
            ratio_to_paper: 1.0,
            equal_time: None,
            on_cards: Vec::new(),
        };
        let [eye, _] = eyes;
        Ok((row, eye))
    }

    /// RMS flicker everywhere and beyond `inner` degrees: half of the power of two runs' difference.
    fn flicker(
        &self,
        theatre: &Theatre,
        a: &Seen,
        b: &Seen,
        inner: f32,
    ) -> Result<(f64, Option<f64>), MetricError> {
        let raster = theatre.raster();
        let (width, height) = (raster.width() as usize, raster.height() as usize);
        // About the paper's tiles (16 px of 1024) on every raster.
        let tile = (width / 64).max(1);
        let rate = self.rig.rate();
        let mut series = TileSeries::new(width, height, tile, rate.slot_len_ns(0).max(1) as u64)?;
        let mut picture = vec![0.0f32; raster.pixel_count()];
        for (a, b) in a.frames.iter().zip(&b.frames) {
            picture.fill(0.0);
            for ((probe, a), b) in theatre.probes().iter().zip(a).zip(b) {
                let d = luminance(*a - *b);
                if d.is_finite() {
                    picture[probe.pixel as usize] = d;
                }
            }
            series.add(&picture)?;
        }
        let power = series.power()?;
        let across = series.tiles().0;
        let mean = |keep: &dyn Fn(f32) -> bool| {
            let mut wanted = vec![false; power.len()];
            for p in theatre.probes().iter().filter(|p| keep(p.angle)) {
                wanted[p.pixel as usize / width / tile * across + p.pixel as usize % width / tile] = true;
            }
            let chosen: Vec<f64> =
                power.iter().zip(&wanted).filter(|(_, &w)| w).map(|(p, _)| 0.5 * p).collect();
            (!chosen.is_empty()).then(|| (chosen.iter().sum::<f64>() / chosen.len() as f64).sqrt())
        };
        Ok((mean(&|_| true).unwrap_or(0.0), mean(&|angle| angle >= inner)))
    }

    /// FLIP over the lit pixels; white is the reference's brightest hundredth.
    pub(super) fn flip(&self, theatre: &Theatre, test: &[Vec3], truth: &[Vec3]) -> Result<f64, MetricError> {
        let raster = theatre.raster();
        let (width, height) = (raster.width() as usize, raster.height() as usize);
        let white = white_of(truth);
        let paint = |values: &[Vec3]| {
            let mut out = vec![Vec3::ZERO; raster.pixel_count()];
            for (probe, v) in theatre.probes().iter().zip(values) {
                out[probe.pixel as usize] = if v.is_finite() { *v / white } else { Vec3::ZERO };
            }
            out
        };
        let (test, truth) = (paint(test), paint(truth));
        let (test, truth) =
            (LinearImage::new(width, height, &test)?, LinearImage::new(width, height, &truth)?);
        let over_all = mean_flip(&test, &truth, DEFAULT_PIXELS_PER_DEGREE)?;
        Ok(over_all * raster.pixel_count() as f64 / theatre.probes().len() as f64)
    }
}

/// What the row of this program's own method is called; those of its ablations begin so.
pub(crate) const DPM: &str = "dpm";
/// What the name of a method ends with while it is drawn at the time of dpm.
pub const AT_EQUAL_TIME: &str = " at equal time";

/// Whether this is the name of a method that dpm is compared with: neither dpm nor dpm without a part.
pub fn is_other(method: &str) -> bool {
    !method.starts_with(DPM)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_dpm_are_not_what_dpm_is_compared_with() {
        assert!(is_other("sequence") && is_other("paper") && !is_other(DPM) && !is_other("dpm, even rays"));
    }
}
