//! A rig's methods in units of people: what of their errors would be noticed, with how sure each figure is.
//!
//! Every method is drawn with several seeds at equal rays. A figure is the mean over the seeds with its 95 % interval by Student's
//! distribution; flicker takes two seeds at a time, because it is what two runs do not share. The reference comes in independent
//! parts, so that each tile of the picture can be tested for bias by Welch's test: without bias its p-values are spread evenly.

use super::plan::{Setting, Window};
use super::reference::mean_of;
use super::runs::{ErrorOptions, ErrorRunError, ErrorRuns, SequenceExtent, EYE_FRAMES};
use crate::metrics::flicker::{SpectralLine, TileSeries};
use crate::metrics::jod::{jod, Viewing};
use crate::metrics::sensitivity::{
    flicker_sensitivity, stroboscopic_threshold, summed, Field, NOTICED_LATE_S,
};
use crate::metrics::{luminance, white_of, MetricError};
use crate::sequence::{eye_mean, rmse, Theatre};
use crate::stamp::Stamp;
use crate::statistics::{chi2_p_value, welch_p};
use crate::temporal_light::TemporalLight;
use dpm_render::method::Method;
use dpm_render::RenderError;
use glam::{DMat3, DVec3, Vec3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

pub use crate::statistics::Estimate;

/// Luminance of the brightest hundredth of the reference, cd/m^2: white paper in a lit room.
const WHITE_CD_M2: f64 = 100.0;
/// Frames that the quality is judged at, a second; all are seen.
const JUDGED_HZ: f64 = 100.0;
/// Where flicker ends and light that modulates too fast to flicker begins, and where that ends, Hz.
const FLICKER_HZ: [f64; 2] = [1.0, 120.0];
const FASTEST_HZ: f64 = 2000.0;
/// Independent parts of the reference.
const PARTS: u32 = 8;
/// Tiles in a row whose means are tested for bias.
const TESTED: usize = 16;
/// Seeds are so far apart.
const SEED_STEP: u32 = 1_000_003;
/// Bodies that are slower are at rest, pixels a second.
const SLOWEST_PX_S: f64 = 1.0;

/// The p-values of the tiles of a method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bias {
    /// Tiles that were tested.
    pub tiles: usize,
    /// How many p-values lie in each tenth from 0 to 1. Even without bias; full at the left with it.
    pub histogram: [u32; 10],
    /// Probability of a histogram that is less even, by chance.
    pub p_even: f64,
}

/// One method. Every figure is that of a single run, as its mean over seeds with its 95 % interval.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeenRow {
    /// Method.
    pub method: String,
    /// Samples a lit pixel and frame.
    pub spp: f64,
    /// Quality beside the reference, JOD.
    pub jod: Estimate,
    /// Flicker from 1 to 120 Hz, in units of its threshold: root of the mean square over tiles.
    pub flicker: Estimate,
    /// Light that changes at 120 to 2,000 Hz, in units of the threshold of the stroboscopic effect.
    pub fast: Estimate,
    /// How far the picture lies from the reference's, in units of what is noticed at its speed; none at rest.
    pub misaligned: Option<Estimate>,
    /// Mean luminance less that of the reference, per cent.
    pub mean_percent: Estimate,
    /// FLIP of what the eye sees.
    pub flip: Estimate,
    /// RMSE of what the eye sees, in the scene's unit of radiance.
    pub perceived_rmse: Estimate,
    /// Bias by tiles.
    pub bias: Bias,
}

/// A measured group, as it is kept in its file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SeenGroup {
    /// With what.
    pub stamp: Stamp,
    /// Hash of all that the result depends on.
    pub key: String,
    /// How much was drawn.
    pub extent: SequenceExtent,
    /// Bodies move.
    pub moving: bool,
    /// The group's budget: samples a pixel of `paper` where the eye looks.
    pub budget: f64,
    /// The part of the raster that was drawn, at its full density; all of it if none.
    pub window: Option<Window>,
    /// Runs of each method.
    pub seeds: u32,
    /// Lit surface points that the eye follows.
    pub probes: usize,
    /// Pixels in a degree of the observer's view.
    pub pixels_per_degree: f64,
    /// Median speed of the points over the raster, pixels a second.
    pub speed_px_s: f64,
    /// What is noticed of the projector's planes, whatever they show; empty if another program decides them.
    pub light: String,
    /// One a method.
    pub rows: Vec<SeenRow>,
}

impl SeenGroup {
    /// What was measured.
    pub fn setting(&self) -> Setting {
        Setting::plain(self.moving, self.budget)
    }
}

/// Names all that the result of a setting depends on.
pub fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String {
    super::runs::key_of(stamp, setting, options, &format!("seen {}", options.seeds))
}

/// What should be seen.
struct SeenTruth {
    /// Frame after frame, per probe.
    frames: Vec<Vec<Vec3>>,
    /// What the eye sees of each part.
    parts: Vec<Vec<Vec3>>,
    /// Mean of the parts.
    eye: Vec<Vec3>,
}

/// Draws and judges all methods in the setting of `runs`. `each` is called before every sequence with its name.
///
/// # Errors
/// The renderer's; nothing lit; pictures that cannot be compared.
pub fn measure(runs: &ErrorRuns, each: &mut dyn FnMut(&str)) -> Result<SeenGroup, ErrorRunError> {
    measure_beside(runs, runs, each)
}

/// The same beside the reference of another rig that has the same bodies before the same projector: what a fault of the methods
/// would look like.
///
/// # Errors
/// As [`measure`].
pub fn measure_beside(
    runs: &ErrorRuns,
    reference: &ErrorRuns,
    each: &mut dyn FnMut(&str),
) -> Result<SeenGroup, ErrorRunError> {
    let o = &runs.options;
    let theatre = runs.theatre(o.extent.warm_up, o.extent.kept)?;
    if theatre.probes().is_empty() {
        return Err(ErrorRunError::NothingLit);
    }
    let truth = truth(reference, each)?;
    let judge = Judge::new(runs, &theatre, &truth);
    let (mut rows, mut wanted) = (Vec::new(), None);
    for contender in runs.contenders() {
        let spp = match wanted {
            None => runs.setting.budget.max(1.0) as f32,
            Some(rays) => runs.spp_for(&contender.method, rays)?,
        };
        wanted = Some(match wanted {
            None => runs.rays_at(&contender.method, spp)?,
            Some(rays) => rays,
        });
        rows.push(judge.row(contender.name, &contender.method, spp, each)?);
    }
    let light = TemporalLight::of(&runs.rig.config.projector).map_or(String::new(), |light| light.told());
    Ok(SeenGroup {
        stamp: runs.stamp.clone(),
        key: key(&runs.stamp, runs.setting, o),
        extent: o.extent,
        moving: runs.setting.moving,
        budget: runs.setting.budget,
        window: o.window,
        seeds: o.seeds,
        probes: theatre.probes().len(),
        pixels_per_degree: judge.pixels_per_degree,
        speed_px_s: judge.speed_px_s,
        light,
        rows,
    })
}

/// The reference of every frame, and of the eye in parts: the last frames of the sequence are the first part.
fn truth(runs: &ErrorRuns, each: &mut dyn FnMut(&str)) -> Result<SeenTruth, RenderError> {
    let extent = runs.options.extent;
    let spp = extent.reference_spp.div_ceil(PARTS);
    let method = Method::full(spp);
    let mut play = |theatre: &Theatre, part: u32| {
        each("reference");
        Ok::<_, RenderError>(theatre.play(&method, spp as f32, 0x9e37_1000 + part, &mut |_, _| ())?.frames)
    };
    let frames = play(&runs.theatre(0, extent.kept)?, 0)?;
    let short = runs.theatre(0, EYE_FRAMES as u32)?;
    let mut parts = vec![eye_mean(&frames, EYE_FRAMES)];
    for part in 1..PARTS {
        parts.push(eye_mean(&play(&short, part)?, EYE_FRAMES));
    }
    let mean = |i: usize| parts.iter().map(|part| part[i]).sum::<Vec3>() / parts.len() as f32;
    let eye: Vec<Vec3> = (0..parts[0].len()).map(mean).collect();
    // Where nothing moves, every frame should look as the mean of all does.
    let frames = if runs.setting.moving { frames } else { vec![eye.clone(); frames.len()] };
    Ok(SeenTruth { frames, parts, eye })
}

/// What judges the runs of every method alike.
struct Judge<'a> {
    runs: &'a ErrorRuns,
    theatre: &'a Theatre,
    truth: &'a SeenTruth,
    pixels_per_degree: f64,
    speed_px_s: f64,
    frame_hz: f64,
    /// Of one unit of radiance, cd/m^2.
    luminance_scale: f64,
    width: usize,
    height: usize,
}

impl<'a> Judge<'a> {
    fn new(runs: &'a ErrorRuns, theatre: &'a Theatre, truth: &'a SeenTruth) -> Self {
        let raster = theatre.raster();
        let frame_hz = 1e9 / runs.rig.rate().slot_len_ns(0).max(1) as f64;
        Self {
            runs,
            theatre,
            truth,
            pixels_per_degree: theatre.pixels_per_degree().unwrap_or(1.0),
            speed_px_s: if runs.setting.moving { theatre.speed_px() * frame_hz } else { 0.0 },
            frame_hz,
            luminance_scale: WHITE_CD_M2 / f64::from(white_of(&truth.eye)),
            width: raster.width() as usize,
            height: raster.height() as usize,
        }
    }

    /// A picture of one value a probe; what is not lit, or no number, is black.
    fn painted<T: Copy + Default>(&self, values: &[Vec3], of: impl Fn(Vec3) -> T) -> Vec<T> {
        let mut picture = vec![T::default(); self.width * self.height];
        for (probe, v) in self.theatre.probes().iter().zip(values).filter(|(_, v)| v.is_finite()) {
            picture[probe.pixel as usize] = of(*v);
        }
        picture
    }

    /// All seeds of a method.
    fn row(
        &self,
        name: &str,
        method: &Method,
        spp: f32,
        each: &mut dyn FnMut(&str),
    ) -> Result<SeenRow, ErrorRunError> {
        let seed = self.runs.rig.config.render.seed as u32;
        let (mut quality, mut flickers, mut fast) = (Vec::new(), Vec::new(), Vec::new());
        let (mut misaligned, mut means, mut flip, mut errors) = (vec![], vec![], vec![], vec![]);
        let (mut tiles, mut other): (Vec<Vec<f64>>, Option<Vec<Vec<Vec3>>>) = (Vec::new(), None);
        for k in 0..self.runs.options.seeds {
            each(name);
            let seed = seed.wrapping_add(k.wrapping_mul(SEED_STEP));
            let seen = self.theatre.play(method, spp, seed, &mut |_, _| ())?;
            let eye = eye_mean(&seen.frames, EYE_FRAMES);
            quality.push(self.quality(&seen.frames)?);
            means.push(100.0 * (mean_of(&eye) / mean_of(&self.truth.eye) - 1.0));
            flip.push(self.runs.flip(self.theatre, &eye, &self.truth.eye)?);
            errors.push(rmse(&eye, &self.truth.eye, |_| true));
            misaligned.extend(self.misaligned(&eye));
            tiles.push(self.tile_means(&eye));
            match other.take() {
                None => other = Some(seen.frames),
                Some(before) => {
                    let [slow, quick] = self.changes(&before, &seen.frames)?;
                    flickers.push(slow);
                    fast.push(quick);
                }
            }
        }
        let parts: Vec<Vec<f64>> = self.truth.parts.iter().map(|part| self.tile_means(part)).collect();
        Ok(SeenRow {
            method: name.to_owned(),
            spp: f64::from(spp),
            jod: Estimate::of(&quality),
            flicker: Estimate::of(&flickers),
            fast: Estimate::of(&fast),
            misaligned: (!misaligned.is_empty()).then(|| Estimate::of(&misaligned)),
            mean_percent: Estimate::of(&means),
            flip: Estimate::of(&flip),
            perceived_rmse: Estimate::of(&errors),
            bias: bias(&tiles, &parts),
        })
    }

    /// JOD of a run. Before the first frame the eye saw what it should have seen.
    fn quality(&self, frames: &[Vec<Vec3>]) -> Result<f64, MetricError> {
        let viewing = Viewing {
            width: self.width,
            height: self.height,
            frame_hz: self.frame_hz,
            pixels_per_degree: self.pixels_per_degree,
            every: (self.frame_hz / JUDGED_HZ).round().max(1.0) as usize,
        };
        let scale = self.luminance_scale as f32;
        let show = |frame: &Vec<Vec3>| self.painted(frame, |v| v * scale);
        let before = self.truth.frames.first().map(show);
        let video =
            |frames: &[Vec<Vec3>]| before.iter().cloned().chain(frames.iter().map(show)).collect::<Vec<_>>();
        jod(&video(frames), &video(&self.truth.frames), viewing)
    }

    /// How far what the eye sees lies from where it should be, over how far the surface moves while a delay is not yet noticed;
    /// `None` at rest, and where the picture has no edges. By least squares: shifted, and brighter or darker as a whole.
    /// \[Lucas81\]
    fn misaligned(&self, eye: &[Vec3]) -> Option<f64> {
        if self.speed_px_s < SLOWEST_PX_S {
            return None;
        }
        let [seen, wanted] =
            [eye, &self.truth.eye[..]].map(|values| self.painted(values, |v| Some(f64::from(luminance(v)))));
        shift_px(self.width, &seen, &wanted).map(|px| px / (self.speed_px_s * NOTICED_LATE_S))
    }

    /// What two runs do not share, as one of them has it: flicker, and what changes faster.
    fn changes(&self, a: &[Vec<Vec3>], b: &[Vec<Vec3>]) -> Result<[f64; 2], MetricError> {
        let tile = (self.width / 64).max(1);
        let period_ns = (1e9 / self.frame_hz).round().max(1.0) as u64;
        let mut series = TileSeries::new(self.width, self.height, tile, period_ns)?;
        for (a, b) in a.iter().zip(b) {
            let difference: Vec<Vec3> = a.iter().zip(b).map(|(a, b)| *a - *b).collect();
            series.add(&self.painted(&difference, luminance))?;
        }
        let across = series.tiles().0;
        let mut angles: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        for probe in self.theatre.probes() {
            let at = probe.pixel as usize;
            let (sum, n) =
                angles.entry(at / self.width / tile * across + at % self.width / tile).or_default();
            (*sum, *n) = (*sum + f64::from(probe.angle), *n + 1.0);
        }
        // The eye is adapted to the picture, not to each tile of it.
        let mean =
            self.truth.eye.iter().filter(|v| v.is_finite()).map(|v| f64::from(luminance(*v))).sum::<f64>()
                / self.truth.eye.len() as f64;
        let field = |degrees: i64| Field {
            eccentricity_deg: degrees as f64,
            radius_deg: tile as f64 / self.pixels_per_degree / std::f64::consts::PI.sqrt(),
            luminance: mean * self.luminance_scale,
        };
        let lines = series.lines(FLICKER_HZ[0], FASTEST_HZ);
        let (slow, quick): (Vec<&SpectralLine>, Vec<&SpectralLine>) =
            lines.iter().partition(|line| line.hz <= FLICKER_HZ[1]);
        let mut known: BTreeMap<i64, Vec<f64>> = BTreeMap::new();
        let (mut flicker, mut fast) = (0.0, 0.0);
        for (place, (sum, n)) in &angles {
            let degrees = (sum / n).round() as i64;
            let sensitivities = known.entry(degrees).or_insert_with(|| {
                slow.iter().map(|line| flicker_sensitivity(field(degrees), line.hz)).collect()
            });
            // Half of the difference's power is that of one run, and an amplitude is the root of twice a power.
            let modulation = |line: &SpectralLine| line.power[*place].sqrt() / mean;
            flicker +=
                slow.iter().zip(sensitivities).map(|(line, s)| (modulation(line) * *s).powi(2)).sum::<f64>();
            fast +=
                summed(quick.iter().map(|line| modulation(line) / stroboscopic_threshold(line.hz))).powi(2);
        }
        Ok([flicker, fast].map(|sum| (sum / angles.len().max(1) as f64).sqrt()))
    }

    /// Mean luminance of the lit points of large tiles; tiles without any are left out.
    fn tile_means(&self, values: &[Vec3]) -> Vec<f64> {
        let tile = self.width.div_ceil(TESTED).max(1);
        let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        for (probe, v) in self.theatre.probes().iter().zip(values) {
            let at = probe.pixel as usize;
            let (sum, n) = sums.entry(at / self.width / tile * TESTED + at % self.width / tile).or_default();
            let light = f64::from(luminance(*v));
            if light.is_finite() {
                (*sum, *n) = (*sum + light, *n + 1.0);
            }
        }
        sums.values().map(|(sum, n)| sum / n.max(1.0)).collect()
    }
}

/// Length of the shift of `seen` from `wanted`, pixels: rows of `width` pixels, `None` where nothing is lit.
fn shift_px(width: usize, seen: &[Option<f64>], wanted: &[Option<f64>]) -> Option<f64> {
    let (mut left, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for at in width + 1..wanted.len().saturating_sub(width + 1) {
        let around = [at - 1, at + 1, at - width, at + width].map(|i| wanted[i]);
        let (Some(own), Some(target)) = (seen[at], wanted[at]) else { continue };
        let [Some(w), Some(e), Some(n), Some(s)] = around else { continue };
        // Shifted by d and scaled by 1 + g: own - target = -d . gradient + g target.
        let row = DVec3::new(-0.5 * (e - w), -0.5 * (s - n), target);
        left += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        right += row * (own - target);
    }
    let scale = left.x_axis.x.max(left.y_axis.y);
    let sound = scale > 0.0 && left.determinant() > 1e-9 * scale * scale * left.z_axis.z;
    let found = sound.then(|| left.inverse() * right)?;
    Some(found.truncate().length() / (1.0 + found.z).max(0.1)).filter(|px| px.is_finite())
}

/// Welch's test of every tile: runs against parts of the reference.
fn bias(runs: &[Vec<f64>], parts: &[Vec<f64>]) -> Bias {
    let of = |all: &[Vec<f64>], tile: usize| all.iter().map(|one| one[tile]).collect::<Vec<_>>();
    let tiles = parts.first().map_or(0, Vec::len);
    let values: Vec<f64> = (0..tiles).filter_map(|tile| welch_p(&of(runs, tile), &of(parts, tile))).collect();
    let mut histogram = [0u32; 10];
    values.iter().for_each(|p| histogram[((p * 10.0) as usize).min(9)] += 1);
    let expected = values.len() as f64 / 10.0;
    let chi2: f64 = histogram.iter().map(|n| (f64::from(*n) - expected).powi(2) / expected.max(1e-9)).sum();
    let p_even = if values.is_empty() { 1.0 } else { chi2_p_value(chi2, 9.0) };
    Bias { tiles: values.len(), histogram, p_even }
}

/// All rows as a Markdown table, with the stamps above and the units below.
pub fn markdown(groups: &[SeenGroup]) -> String {
    let mut text = super::report::stamps(groups.iter().map(|g| &g.stamp));
    text += "| group | method | spp | JOD | flicker | 120 to 2000 Hz | misaligned | mean % | FLIP | perceived RMSE | p of an even histogram |\n";
    text += "|---|---|---:|---|---|---|---|---|---|---|---:|\n";
    for g in groups {
        for r in &g.rows {
            let misaligned = r.misaligned.map_or("at rest".to_owned(), |e| e.told(3));
            text += &format!(
                "| {} | {} | {:.2} | {} | {} | {} | {misaligned} | {} | {} | {} | {:.3} |\n",
                g.setting().name(),
                r.method,
                r.spp,
                r.jod.told(3),
                r.flicker.told(3),
                r.fast.told(3),
                r.mean_percent.told(2),
                r.flip.told(4),
                r.perceived_rmse.told(5),
                r.bias.p_even,
            );
        }
    }
    text += "\nFlicker, faster changes and misalignment are in units of what is just noticed; in brackets 95 % intervals of a single run's \
             expectation. docs/ERROR.md has the models.\n";
    for g in groups {
        let window = g.window.map_or(String::new(), |w| format!(", window {w}"));
        text += &format!(
            "\n{}: {} seeds, {} points, {:.1} pixels a degree, {:.0} pixels a second{window}. The projector's planes: {}.\n",
            g.setting().name(),
            g.seeds,
            g.probes,
            g.pixels_per_degree,
            g.speed_px_s,
            g.light
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;

    /// A smooth picture that is moved by a fraction of a pixel, and darker.
    #[test]
    fn a_shift_is_found_whatever_the_brightness() {
        let (width, height) = (40, 30);
        let picture = |dx: f64, dy: f64, gain: f64| -> Vec<Option<f64>> {
            (0..width * height)
                .map(|i| {
                    let (x, y) = ((i % width) as f64 - dx, (i / width) as f64 - dy);
                    Some(gain * (2.0 + (0.3 * x).sin() * (0.25 * y).cos())).filter(|_| i % width > 2)
                })
                .collect()
        };
        let wanted = picture(0.0, 0.0, 1.0);
        for (dx, dy, gain) in [(0.3, 0.0, 1.0), (0.0, -0.2, 0.9), (0.25, 0.2, 1.2), (0.0, 0.0, 0.8)] {
            let found = shift_px(width, &picture(dx, dy, gain), &wanted).unwrap();
            let truth = f64::hypot(dx, dy);
            assert!((found - truth).abs() < 0.02 + 0.1 * truth, "{dx}, {dy}: {found}");
        }
        assert_eq!(shift_px(width, &vec![Some(1.0); 1200], &vec![Some(1.0); 1200]), None);
        assert_eq!(shift_px(width, &vec![None; 1200], &wanted), None);
    }

    /// Without bias p-values are even; a bias of a standard deviation is seen in the tiles together.
    #[test]
    fn bias_leaves_an_uneven_histogram() {
        let draws = Draws::new(5);
        let all = |first: u64, runs: u64, shift: f64| -> Vec<Vec<f64>> {
            let at = |run: u64, tile: u64| 1.0 + shift + 0.1 * draws.normal(first + run * 192 + tile);
            (0..runs).map(|run| (0..192).map(|tile| at(run, tile)).collect()).collect()
        };
        let parts = all(0, 8, 0.0);
        let fair = bias(&all(100_000, 8, 0.0), &parts);
        assert_eq!((fair.tiles, fair.histogram.iter().sum::<u32>()), (192, 192));
        assert!(fair.p_even > 1e-3, "{fair:?}");
        let biased = bias(&all(100_000, 8, 0.1), &parts);
        assert!(biased.p_even < 1e-6 && biased.histogram[0] > 60, "{biased:?}");
    }
}
