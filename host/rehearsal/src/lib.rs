//! `dpm rehearse`: what a rig can be expected to do, before its parts are bought.
//!
//! The engine of every run goes at virtual pace over a played tracker and a played projector with the rates, delays, errors
//! and raster of the rig's own; a truth is drawn from every seed; light is measured where it falls through the true projector,
//! against where the true body is at the centre of that light. Each row is runs of its own. Beside them stands a closed form
//! (`predict.rs`) that shares nothing with the engine.

mod predict;
mod projector;
mod report;
mod stage;
mod tracker;
mod truth;

pub use report::{CaseReport, RehearsalReport, RehearsedPercentiles};

use dpm_device::time::FrameRate;
use dpm_rig::config::{ProjectorBackend, RigConfig};
use dpm_rig::failure::Failure;
use report::PicturesReport;
use stage::{LightFall, RehearsalCase, RehearsalStage};

/// Time of each run after the filters have settled, seconds, if nothing else is asked for.
pub const SECONDS: f64 = 6.0;
/// Truths of each row, if nothing else is asked for.
pub const SEEDS: u64 = 5;
/// Time of the run whose pictures are painted, seconds.
const PICTURES_S: f64 = 1.0;
/// Exposure of a camera's picture where the rig file gives none, microseconds.
const EXPOSURE_US: u32 = 2_000;
/// Speed of the surface by which a misalignment that people notice is that many seconds \[Misalignment23\].
const NOTICED_S: f64 = 3.87e-3;

/// How much a rehearsal does.
#[derive(Clone, Copy, Debug)]
pub struct RehearsalExtent {
    /// Truths of each row, at least 1.
    pub seeds: u64,
    /// Time of each run, seconds, above 0.
    pub seconds: f64,
    /// The rig itself alone: neither suspects nor better parts.
    pub only_rig: bool,
    /// Some frames go through painted pictures, where the tracker is a camera.
    pub pictures: bool,
}

impl Default for RehearsalExtent {
    fn default() -> Self {
        Self { seeds: SEEDS, seconds: SECONDS, only_rig: false, pictures: true }
    }
}

/// What is other in a row.
type Change = fn(&mut RehearsalCase);

/// What may be at fault, switched off one at a time.
const SUSPECTS: [(&str, Change); 7] = [
    ("noise of poses", |c| {
        let r = &mut c.config.rehearsal;
        (r.corner_px, r.noise_m, r.noise_rad) = (0.0, 0.0, 0.0);
    }),
    ("delays of tracker, computer and projector", |c| {
        (c.exposure_us, c.config.rehearsal.delivery_us, c.is_prompt) = (1, Some(0), true);
        c.config.projector.latency_us = 0;
        render_within(c, 0);
    }),
    ("rate of the projector", |c| set_rate(c, 947, 1.0)),
    ("time that is not known", |c| c.config.rehearsal.late_us = 0.0),
    ("calibration of the camera", |c| c.config.rehearsal.camera_px = 0.0),
    ("calibration of the projector", |c| c.config.rehearsal.projector_px = 0.0),
    ("places of meshes on bodies", |c| c.config.rehearsal.body_m = 0.0),
];

/// Parts that can be bought or bettered.
const PARTS: [(&str, Change); 10] = [
    ("a tracker of twice the rate", |c| c.rate_hz = (2 * c.rate_hz).min(10_000)),
    ("half the noise of corners or poses", |c| {
        let r = &mut c.config.rehearsal;
        (r.corner_px, r.noise_m, r.noise_rad) = (0.5 * r.corner_px, 0.5 * r.noise_m, 0.5 * r.noise_rad);
    }),
    ("half the exposure", |c| c.exposure_us = (c.exposure_us / 2).max(1)),
    ("pictures and poses in half the time", |c| {
        let period_us = 1_000_000 / c.rate_hz.max(1);
        let r = &mut c.config.rehearsal;
        r.delivery_us = Some(r.delivery_us.unwrap_or(period_us) / 2);
    }),
    ("a renderer of half the time", |c| {
        let half = c.config.real_time.stage_costs_us.render / 2;
        c.config.real_time.stage_costs_us.render = half;
    }),
    ("half the projector's own delay", |c| c.config.projector.latency_us /= 2),
    ("a projector of 120 frames/s", |c| set_rate(c, 120, 0.5)),
    ("a projector of 240 frames/s", |c| set_rate(c, 240, 0.25)),
    ("a bit-plane projector of 947 frames/s", |c| {
        set_rate(c, 947, 0.0);
        c.config.projector.backend = ProjectorBackend::default();
        render_within(c, 900);
    }),
    ("calibrations that leave half open", |c| {
        let r = &mut c.config.rehearsal;
        (r.camera_px, r.projector_px, r.late_us) = (0.5 * r.camera_px, 0.5 * r.projector_px, 0.5 * r.late_us);
        r.body_m *= 0.5;
    }),
];

/// Another frame rate; the projector's own delay goes with the length of a frame by `delays`.
fn set_rate(case: &mut RehearsalCase, rate: u32, delays: f64) {
    let projector = &mut case.config.projector;
    projector.frame_rate = FrameRate::new(rate, 1).expect("above 0");
    projector.latency_us = (f64::from(projector.latency_us) * delays) as u32;
}

/// No stage takes longer than this, microseconds.
fn render_within(case: &mut RehearsalCase, most_us: u32) {
    let costs = &mut case.config.real_time.stage_costs_us;
    for cost in [&mut costs.track, &mut costs.plan, &mut costs.render, &mut costs.pack, &mut costs.send] {
        *cost = (*cost).min(most_us);
    }
}

/// Rehearses a rig. `tell`: what is being done.
///
/// # Errors
/// The rig cannot be built, nothing of its kind can be rehearsed (exit code 2), or no light fell (1).
pub fn rehearse(
    config: &RigConfig,
    extent: RehearsalExtent,
    tell: &mut dyn FnMut(&str),
) -> Result<RehearsalReport, Failure> {
    let mut stage = RehearsalStage::new(config)?;
    let rate_hz = config.tracker.rate_hz().unwrap_or(100);
    let exposure_us = config.tracker.exposure_us().unwrap_or(EXPOSURE_US);
    let own = RehearsalCase { config: config.clone(), rate_hz, exposure_us, is_prompt: false, paints: false };
    let row = |stage: &mut RehearsalStage, name: &str, change: Option<Change>| {
        let mut case = own.clone();
        change.into_iter().for_each(|change| change(&mut case));
        let fallen = runs(stage, &case, extent)?;
        Ok::<_, Failure>(CaseReport::new(name, predict::p99_mm(stage, &case), &fallen))
    };
    tell("the rig itself");
    let itself = row(&mut stage, "the rig as it is", None)?;
    let mut report = RehearsalReport::new(config, &own, extent, &stage, itself);
    if extent.pictures {
        tell("a part of it in painted pictures");
        report.pictures = pictures(&mut stage, &own)?;
    }
    if extent.only_rig {
        return Ok(report);
    }
    for (rows, out) in [(&SUSPECTS[..], &mut report.without), (&PARTS[..], &mut report.better)] {
        for (name, change) in rows {
            if is_idle(&stage, &own, *change) {
                continue;
            }
            tell(name);
            out.push(row(&mut stage, name, Some(*change))?);
        }
    }
    Ok(report)
}

/// A row in which nothing that counts is other, as a camera's exposure of a tracker that has none, or a projector is slower.
fn is_idle(stage: &RehearsalStage, own: &RehearsalCase, change: Change) -> bool {
    let told = |case: &RehearsalCase| {
        let mut case = case.clone();
        let r = &mut case.config.rehearsal;
        let is_mock = case.config.tracker.errors().is_some();
        if stage.camera.is_some() {
            (r.noise_m, r.noise_rad) = (0.0, 0.0);
        } else {
            (r.corner_px, r.camera_px, case.exposure_us) = (0.0, 0.0, 1);
            if is_mock {
                (r.noise_m, r.noise_rad, r.delivery_us) = (0.0, 0.0, None);
            }
        }
        let c = &case.config;
        format!(
            "{:?} {} {} {} {:?} {} {:?} {}",
            c.rehearsal,
            case.rate_hz,
            case.exposure_us,
            case.is_prompt && c.projector.backend.light_delay_ns(1_000_000) > 0,
            c.projector.frame_rate,
            c.projector.latency_us,
            c.real_time.stage_costs_us,
            c.projector.backend.word()
        )
    };
    let mut other = own.clone();
    change(&mut other);
    let rate = |case: &RehearsalCase| case.config.projector.frame_rate.hz();
    told(&other) == told(own) || rate(&other) < rate(own)
}

fn runs(
    stage: &mut RehearsalStage,
    case: &RehearsalCase,
    extent: RehearsalExtent,
) -> Result<LightFall, Failure> {
    let mut all = LightFall::default();
    for seed in 1..=extent.seeds.max(1) {
        all.add(stage.run(case, seed, extent.seconds)?);
    }
    Ok(all)
}

/// The same short run by drawn corners and by painted pictures; `None` where there is no camera or the mock has no such lens.
fn pictures(stage: &mut RehearsalStage, own: &RehearsalCase) -> Result<Option<PicturesReport>, Failure> {
    let Some((eye, _)) = &stage.camera else { return Ok(None) };
    if tracker::optics(eye).is_none() {
        return Ok(None);
    }
    let painted = stage.run(&RehearsalCase { paints: true, ..own.clone() }, 1, PICTURES_S)?;
    let drawn = stage.run(own, 1, PICTURES_S)?;
    let count = f64::from(own.rate_hz) * (PICTURES_S + 1e-9 * stage::SETTLE_NS as f64);
    Ok(Some(PicturesReport {
        pictures: count as u64,
        painted_mm: RehearsedPercentiles::of(&painted.mm),
        drawn_mm: RehearsedPercentiles::of(&drawn.mm),
    }))
}

#[cfg(test)]
mod breadth;
