//! A rig into the method that errs least on this device, in the time of a frame of method `dpm`: what `render.method = "auto"` stands for.
//!
//! Times are raced on the raster that the rig traces, because on a small one too much of a frame does not depend on its samples. Errors
//! are measured in windows of that raster, about the tracked bodies, at its full density: each method twice, against a reference of many
//! samples. Bodies move as the rig file says. What a real tracker will report is not known before it does.

use crate::error::equal::{samples_at_equal_time, with_samples, Trial};
use crate::error::plan::{switched_method_of, Window};
use crate::error::reference::{mean_of, Reference};
use crate::error::runs::{ErrorRunError, EYE_FRAMES, LAST_SLOT};
use crate::sequence::{eye_mean, FrameTime, Span, Theatre};
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::RenderError;
use dpm_rig::config::{Pace, RenderMethod};
use dpm_rig::method_choice::{device_of, key, MethodCandidate, MethodChoice};
use dpm_rig::rig::{Rig, RigError};
use std::path::Path;
use std::sync::Arc;

/// The candidates. The first is the measure of time; the others take as long.
const CANDIDATES: [RenderMethod; 4] =
    [RenderMethod::Dpm, RenderMethod::Own, RenderMethod::Sequence, RenderMethod::Paper];
/// A method replaces `dpm` only if its error is smaller by more than this: `dpm` flickers least.
const TIE: f64 = 0.97;
/// Frames before those that count, for histories to reach their full length.
const WARM_UP: u32 = 112;
/// Samples a pixel and frame of the reference, on a GPU and on software Vulkan.
const REFERENCE_SPP: [u32; 2] = [256, 64];
/// Columns and rows of a window.
const WINDOW: [u32; 2] = [96, 72];
/// So many tracked bodies get a window.
const WINDOWS: usize = 2;
/// A window with fewer lit points says little.
const FEWEST_POINTS: usize = 64;
/// Share of a slot that a frame may take at real pace, as the budget of samples has it.
const OF_SLOT: f64 = 0.8;
/// The fewest samples that the budget leaves, by those that are asked for.
const LEAST_SHARE: f32 = 0.125;
/// What is added to the seed for the second run.
const OTHER_SEED: u32 = 1_000_003;

/// Why nothing was chosen.
#[derive(Debug, thiserror::Error)]
pub enum ChoiceRunError {
    /// The measurement failed.
    #[error(transparent)]
    Run(#[from] ErrorRunError),
    /// The rig cannot be built.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The windows do not fit.
    #[error("{0}")]
    Window(String),
}

impl From<RenderError> for ChoiceRunError {
    fn from(error: RenderError) -> Self {
        Self::Run(error.into())
    }
}

/// Measures the candidates. `build` makes the rig as its file has it, with method "auto"; references are kept in `cache` while they are
/// needed. `each` is called before every part of the measurement with its name.
///
/// # Errors
/// The rig cannot be built or drawn; nothing of it is lit.
pub fn choose(
    build: &dyn Fn() -> Result<Rig, RigError>,
    gpu: &Arc<Gpu>,
    cache: &Path,
    each: &mut dyn FnMut(&str),
) -> Result<MethodChoice, ChoiceRunError> {
    let rig = Arc::new(build()?);
    let device = device_of(gpu);
    let key = key(&rig, &device);
    let span = Span { last_slot: LAST_SLOT, warm_up: 0, kept: EYE_FRAMES as u32 };
    let whole = Theatre::new(rig.clone(), gpu.clone(), span)?;
    if whole.probes().is_empty() {
        return Err(ErrorRunError::NothingLit.into());
    }
    let methods = CANDIDATES.map(|which| switched_method_of(&rig.config.render, which));
    let trials = equal_times(&rig, &whole, &methods, each)?;
    let drawn: Vec<(Method, f32)> = methods
        .iter()
        .zip(&trials)
        .map(|(method, (spp, _))| (with_samples(method, *spp as f32), *spp as f32))
        .collect();
    let mut seen = Sums { squares: vec![[0.0; 2]; drawn.len()], points: 0.0, light: 0.0 };
    for window in windows(&whole) {
        let part = Arc::new(window.of(build()?).map_err(ChoiceRunError::Window)?);
        let theatre = Theatre::new(part, gpu.clone(), span)?;
        if theatre.probes().len() >= FEWEST_POINTS || seen.points == 0.0 {
            let spp = REFERENCE_SPP[usize::from(gpu.summary().software)];
            let reference = Reference::new(&theatre, spp, &format!("{key} {window}"), cache, each)?;
            seen.add(&theatre, &drawn, rig.config.render.seed as u32, &reference, each)?;
        }
    }
    let (points, mean) = (seen.points, seen.light / seen.points);
    let mut candidates: Vec<MethodCandidate> = CANDIDATES
        .iter()
        .zip(&trials)
        .zip(&seen.squares)
        .map(|((which, (spp, time_to_dpm)), sum)| {
            let relative = |square: f64| (square / points).max(0.0).sqrt() / mean;
            MethodCandidate {
                method: which.word().to_owned(),
                spp: *spp,
                time_to_dpm: *time_to_dpm,
                error: relative(0.5 * (sum[0] + sum[1])),
                runs: sum.map(relative),
            }
        })
        .collect();
    let best = best_of(&candidates);
    let choice = chosen(&rig, &candidates[best], CANDIDATES[best]);
    candidates.sort_by(|a, b| a.error.total_cmp(&b.error));
    Ok(MethodChoice { key, device, candidates, ..choice })
}

/// What was seen in all windows.
struct Sums {
    /// Of each candidate the square errors of its two runs, over all points.
    squares: Vec<[f64; 2]>,
    points: f64,
    light: f64,
}

impl Sums {
    fn add(
        &mut self,
        theatre: &Theatre,
        drawn: &[(Method, f32)],
        seed: u32,
        reference: &Reference,
        each: &mut dyn FnMut(&str),
    ) -> Result<(), RenderError> {
        let n = theatre.probes().len() as f64;
        for ((which, (method, spp)), sum) in CANDIDATES.iter().zip(drawn).zip(&mut self.squares) {
            each(which.word());
            let squares = errors(theatre, method, *spp, seed, reference)?;
            sum.iter_mut().zip(squares).for_each(|(sum, square)| *sum += n * square);
        }
        self.points += n;
        self.light += n * mean_of(&reference.eye);
        Ok(())
    }
}

/// Samples with which each candidate takes the time of `dpm`, as a run can be given them, and how well.
fn equal_times(
    rig: &Rig,
    whole: &Theatre,
    methods: &[Method],
    each: &mut dyn FnMut(&str),
) -> Result<Vec<Trial>, RenderError> {
    let (asked, seed) = (rig.config.render.spp as f32, rig.config.render.seed as u32);
    let race = |spp: f32| {
        let runners: Vec<_> = methods.iter().map(|m| (with_samples(m, spp), spp)).collect();
        Ok::<Vec<f64>, RenderError>(whole.race(&runners, seed)?.iter().map(FrameTime::ms).collect())
    };
    each("times");
    let mut spp = asked;
    let mut first = race(spp)?;
    // At real pace the budget takes samples off until a frame fits.
    let room_ms = OF_SLOT * rig.rate().slot_len_ns(0) as f64 * 1e-6;
    if rig.config.real_time.pace == Pace::Real && first[0] > room_ms {
        spp = (asked * (room_ms / first[0]) as f32).max(LEAST_SHARE * asked);
        first = race(spp)?;
    }
    let others: Vec<&Method> = methods[1..].iter().collect();
    let trials: Vec<Trial> = first[1..].iter().map(|ms| (f64::from(spp), ms / first[0])).collect();
    let beside = (methods[0].clone(), spp);
    let equal = samples_at_equal_time(whole, &others, &trials, &beside, seed, &mut || each("times"))?;
    let all = [(f64::from(spp), 1.0)].into_iter().chain(equal);
    Ok(CANDIDATES
        .iter()
        .zip(all)
        .map(|(which, (spp, time))| (as_a_run_has_them(*which, spp), time))
        .collect())
}

/// Samples in the steps in which a rig file has them, rounded down: a budget goes by eighths, all else is whole.
fn as_a_run_has_them(which: RenderMethod, spp: f64) -> f64 {
    match which {
        RenderMethod::Dpm => spp,
        which if which.takes_a_budget() => ((8.0 * spp).floor() / 8.0).max(0.125),
        _ => spp.floor().max(1.0),
    }
}

/// Windows about the tracked bodies with most lit points; the whole raster if it is no larger.
fn windows(whole: &Theatre) -> Vec<Window> {
    let (raster, probes) = (whole.raster(), whole.probes());
    let [width, height] = [WINDOW[0].min(raster.width()), WINDOW[1].min(raster.height())];
    let of = |body: usize| probes.iter().filter(move |p| p.body == body).map(|p| p.pixel);
    let mut bodies: Vec<usize> = probes.iter().map(|p| p.body).collect();
    bodies.sort_unstable();
    bodies.dedup();
    bodies.sort_by_key(|body| std::cmp::Reverse(of(*body).count()));
    let mut all: Vec<Window> = Vec::new();
    for body in bodies.into_iter().take(WINDOWS) {
        let n = of(body).count().max(1) as u64;
        let middle = |at: &dyn Fn(u32) -> u32| (of(body).map(|p| u64::from(at(p))).sum::<u64>() / n) as u32;
        let begin = |middle: u32, size: u32, all: u32| middle.saturating_sub(size / 2).min(all - size);
        let x = begin(middle(&|p| p % raster.width()), width, raster.width());
        let y = begin(middle(&|p| p / raster.width()), height, raster.height());
        let window = Window { x, y, width, height };
        if !all.contains(&window) {
            all.push(window);
        }
    }
    all
}

/// Square errors of two runs as the eye sees them, without the reference's own.
fn errors(
    theatre: &Theatre,
    method: &Method,
    spp: f32,
    seed: u32,
    reference: &Reference,
) -> Result<[f64; 2], RenderError> {
    let warm_up = if method.needs_history() { WARM_UP } else { 0 };
    let theatre = theatre.with_warm_up(warm_up);
    let eye = |seed: u32| {
        let seen = theatre.play(method, spp, seed, &mut |_, _| ())?;
        Ok::<_, RenderError>(eye_mean(&seen.frames, EYE_FRAMES))
    };
    let eyes = [eye(seed)?, eye(seed.wrapping_add(OTHER_SEED))?];
    Ok(reference.each_run(&eyes).map(|raw| raw * raw - reference.error * reference.error))
}

/// The candidate with the least error, or `dpm` where that is about as good.
fn best_of(candidates: &[MethodCandidate]) -> usize {
    let least = (0..candidates.len()).min_by(|a, b| candidates[*a].error.total_cmp(&candidates[*b].error));
    least.filter(|best| candidates[*best].error < TIE * candidates[0].error).unwrap_or(0)
}

/// What a run of the candidate is given.
fn chosen(rig: &Rig, candidate: &MethodCandidate, which: RenderMethod) -> MethodChoice {
    let render = &rig.config.render;
    let mut choice = MethodChoice {
        key: String::new(),
        method: which.word().to_owned(),
        spp: render.spp,
        budget_spp: render.budget_spp,
        zone_spp: render.paper.zone_spp,
        device: String::new(),
        commit: dpm_common::commit::get().to_owned(),
        candidates: Vec::new(),
    };
    match which {
        RenderMethod::Dpm => {}
        RenderMethod::Paper => {
            let method = switched_method_of(render, which);
            choice.zone_spp = with_samples(&method, candidate.spp as f32).paper.zone_spp;
        }
        which => {
            choice.spp = candidate.spp.ceil() as u32;
            choice.budget_spp = which.takes_a_budget().then_some(candidate.spp);
        }
    }
    choice
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(method: &str, error: f64) -> MethodCandidate {
        MethodCandidate { method: method.into(), spp: 2.0, time_to_dpm: 1.0, error, runs: [error; 2] }
    }

    #[test]
    fn dpm_stays_unless_another_is_clearly_better() {
        let of = |dpm: f64, own: f64, sequence: f64| {
            best_of(&[candidate("dpm", dpm), candidate("own", own), candidate("sequence", sequence)])
        };
        assert_eq!(of(0.010, 0.012, 0.020), 0);
        assert_eq!(of(0.010, 0.0098, 0.020), 0, "a draw");
        assert_eq!(of(0.010, 0.0075, 0.009), 1);
        assert_eq!(of(0.010, 0.0075, 0.006), 2);
    }

    #[test]
    fn samples_are_rounded_down_to_what_a_rig_file_can_say() {
        for (which, spp, wanted) in [
            (RenderMethod::Dpm, 1.7, 1.7),
            (RenderMethod::Own, 2.99, 2.875),
            (RenderMethod::Own, 0.01, 0.125),
            (RenderMethod::Sequence, 5.9, 5.0),
            (RenderMethod::Sequence, 0.4, 1.0),
            (RenderMethod::Paper, 2.7, 2.0),
        ] {
            assert_eq!(as_a_run_has_them(which, spp), wanted, "{which:?}");
        }
    }
}
