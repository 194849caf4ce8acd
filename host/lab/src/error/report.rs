//! Measured groups into what people read: CSV, and Markdown tables at equal rays, at equal time and at equal error.

use super::plan::Setting;
use super::runs::{is_other, ErrorRow, GroupResult, DPM};
use super::verdict::{equal_time_table, runs_text, table, time_text, verdict};
use crate::stamp::Stamp;
use std::fmt::Write;

fn optional(v: Option<f64>) -> String {
    v.map_or(String::new(), |v| format!("{v:.6e}"))
}

/// All rows as CSV with a head line. Columns are the fields of [`ErrorRow`], preceded by device and configuration hash.
pub fn csv(groups: &[GroupResult]) -> String {
    let mut text = String::from(
        "device,driver,commit,config,seed,motion,budget,method,spp,rays,walked_rays,rays_to_paper,samples,gpu_ms,wall_ms,single_rmse,single_rel_mse,\
         perceived_rmse,perceived_rmse_raw,perceived_fovea,perceived_periphery,bias,bias_floor,noise,mean_shift,flip,flicker,\
         flicker_periphery,ratio_to_paper,reference_error,ms_low,ms_high,run_a_raw,run_b_raw,equal_time_spp,equal_time_to_dpm,\
         equal_time_rmse_raw,equal_time_rmse\n",
    );
    for g in groups {
        for r in &g.rows {
            // Writing into a string cannot fail.
            let _ = writeln!(
                text,
                "{},{},{},\"{}\",{:.4},{:.1},{:.1},{:.5},{:.1},{:.6},{:.6},{:.6e},{:.6e},{:.6e},{:.6e},{},{},{:.6e},{:.6e},{:.6e},{:.6e},{:.6e},{:.6e},{},{:.5},{:.6e},{:.6},{:.6},{:.6e},{:.6e},{}",
                g.stamp.csv(),
                if r.moving { "moving" } else { "still" },
                r.budget,
                r.method,
                r.spp,
                r.rays,
                r.walked_rays,
                r.rays_to_paper,
                r.samples,
                r.gpu_ms,
                r.wall_ms,
                r.single_rmse,
                r.single_rel_mse,
                r.perceived_rmse,
                r.perceived_rmse_raw,
                optional(r.perceived_fovea),
                optional(r.perceived_periphery),
                r.bias,
                r.bias_floor,
                r.noise,
                r.mean_shift,
                r.flip,
                r.flicker,
                optional(r.flicker_periphery),
                r.ratio_to_paper,
                g.reference_error,
                r.middle_half_ms[0],
                r.middle_half_ms[1],
                r.runs_raw[0],
                r.runs_raw[1],
                r.equal_time.map_or(",,,".to_owned(), |t| format!(
                    "{:.4},{:.4},{:.6e},{:.6e}",
                    t.spp, t.time_to_dpm, t.perceived_rmse_raw, t.perceived_rmse
                )),
            );
        }
    }
    text
}

/// What stands above tables: every stamp of their groups once, and what more than one of them means.
pub(super) fn stamps<'a>(all: impl Iterator<Item = &'a Stamp>) -> String {
    let mut text = String::new();
    let mut told: Vec<&Stamp> = Vec::new();
    for stamp in all {
        if !told.contains(&stamp) {
            told.push(stamp);
            text += &stamp.line();
        }
    }
    if told.len() > 1 {
        text += "Times of different devices, drivers or commits are in these tables: only rows of one group can be compared in time.\n\n";
    }
    text
}

/// What counts as flicker: in the periphery where the eye looks past, else everywhere.
fn flicker(setting: Setting, row: &ErrorRow) -> f64 {
    row.flicker_periphery.filter(|_| setting.aside).unwrap_or(row.flicker)
}

/// All rows as Markdown: see [`tables`].
pub fn markdown(groups: &[GroupResult]) -> String {
    tables(&groups.iter().map(|g| (g.setting(), g)).collect::<Vec<_>>())
}

/// All rows as Markdown tables, with the stamps above, and dpm beside the best of the others below.
pub(super) fn tables(groups: &[(Setting, &GroupResult)]) -> String {
    let mut text = stamps(groups.iter().map(|(_, g)| &g.stamp));
    text += "| group | method | rays/frame | of them walked | rays / paper | ms a frame (middle half) | single RMSE | perceived RMSE as measured | two runs | less the reference's own | bias | of chance | noise | mean | FLIP | flicker | perceived / paper | perceived / best other | flicker / least other |\n";
    text += "|---|---|---:|---:|---:|---|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n";
    for &(setting, g) in groups {
        let best = best_other(g).map_or(f64::NAN, |r| r.perceived_rmse);
        let least = least_flicker(g, |r| flicker(setting, r));
        for r in &g.rows {
            text += &row(setting, r, best, least);
        }
    }
    text.push('\n');
    text += &equal_time_table(groups.iter().map(|(s, g)| (s.name(), *g)));
    text.push('\n');
    // Curves over budgets, where there are more than one.
    let plain: Vec<&GroupResult> = groups.iter().filter(|(s, _)| s.look.is_none()).map(|(_, g)| *g).collect();
    if !plain.is_empty() {
        text += &equal_cost(&plain);
        text.push('\n');
    }
    let verdicts: Vec<_> =
        groups.iter().filter_map(|(s, g)| verdict(s.name(), g, &|r| flicker(*s, r))).collect();
    text += &table(&verdicts);
    text += "\n| group | reference error | mean radiance | probes |\n|---|---:|---:|---:|\n";
    for (setting, g) in groups {
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "| {} | {:.5} | {:.4} | {} |",
            setting.name(),
            g.reference_error,
            g.mean,
            g.probes
        );
    }
    text
}

/// One row of the first table; `best` and `least` are the least error and flicker of the other methods.
fn row(setting: Setting, r: &ErrorRow, best: f64, least: f64) -> String {
    format!(
        "| {} | {} | {:.0} | {:.0} | {:.3} | {} | {:.4} | {:.5} | {} | {:.5} | {:.5} | {:.5} | {:.5} | {:+.2} % | {:.4} | {:.5} | {:.2} | {:.2} | {:.2} |\n",
        setting.name(),
        r.method,
        r.rays,
        r.walked_rays,
        r.rays_to_paper,
        time_text(r),
        r.single_rmse,
        r.perceived_rmse_raw,
        runs_text(r.runs_raw),
        r.perceived_rmse,
        r.bias,
        r.bias_floor,
        r.noise,
        100.0 * r.mean_shift,
        r.flip,
        flicker(setting, r),
        r.ratio_to_paper,
        r.perceived_rmse / best,
        flicker(setting, r) / least,
    )
}

/// Time of a frame, ms: the GPU's, or until its light is known where the device has no time stamps.
pub(crate) fn time_ms(r: &ErrorRow) -> f64 {
    if r.gpu_ms > 0.0 {
        r.gpu_ms
    } else {
        r.wall_ms
    }
}

/// What a curve says at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum CurveReading {
    /// Between two measured points.
    Within(f64),
    /// Beyond an end by at most [`REACH`] either way, along the last line.
    Beyond(f64),
}

/// How far beyond its measured points a curve is read, as a factor.
pub(crate) const REACH: f64 = 4.0;

/// `y` where `x` is on a curve of straight lines between the logarithms of points. `None` farther beyond its ends than [`REACH`], and where
/// it passes `x` more than once: then no one value is right.
pub(crate) fn on_curve(points: &[(f64, f64)], x: f64) -> Option<CurveReading> {
    let at = |a: (f64, f64), b: (f64, f64)| {
        let t = (x / a.0).ln() / (b.0 / a.0).ln();
        (a.1.ln() + t * (b.1 / a.1).ln()).exp()
    };
    let mut found: Option<f64> = None;
    for pair in points.windows(2) {
        let [a, b] = [pair[0], pair[1]];
        if !(a.0.min(b.0)..=a.0.max(b.0)).contains(&x) || a.0 == b.0 {
            continue;
        }
        let y = at(a, b);
        match found {
            Some(before) if (before / y - 1.0).abs() > 1e-9 => return None,
            _ => found = Some(y),
        }
    }
    if let Some(y) = found {
        return y.is_finite().then_some(CurveReading::Within(y));
    }
    let by_x = |a: &&(f64, f64), b: &&(f64, f64)| a.0.total_cmp(&b.0);
    let (low, high) = (points.iter().min_by(by_x)?, points.iter().max_by(by_x)?);
    let end = if x < low.0 { low } else { high };
    let next = if points.first() == Some(end) {
        points.get(1)?
    } else {
        points.get(points.len().checked_sub(2)?)?
    };
    let is_end = points.first() == Some(end) || points.last() == Some(end);
    let y = at(*next, *end);
    let reach = [x / end.0, end.0 / x, y / end.1, end.1 / y].into_iter().fold(1.0, f64::max);
    (is_end && next.0 != end.0 && reach <= REACH && y.is_finite()).then_some(CurveReading::Beyond(y))
}

/// Every method against every point of `paper`: its error at paper's time, and its time at paper's error, read off its curve.
fn equal_cost(groups: &[&GroupResult]) -> String {
    let rows = || groups.iter().flat_map(|g| &g.rows);
    let mut text = String::from(
        "| motion | budget of paper | method | error / paper at equal time | time / paper at equal error |\n|---|---:|---|---:|---:|\n",
    );
    let mut names: Vec<&str> = Vec::new();
    rows().for_each(|r| {
        if r.method != "paper" && !names.contains(&r.method.as_str()) {
            names.push(&r.method);
        }
    });
    let mut missing = false;
    for paper in rows().filter(|r| r.method == "paper") {
        for name in &names {
            let mut own: Vec<&ErrorRow> =
                rows().filter(|r| r.method == *name && r.moving == paper.moving).collect();
            own.sort_by(|a, b| a.budget.total_cmp(&b.budget));
            let by_time: Vec<(f64, f64)> = own.iter().map(|r| (time_ms(r), r.perceived_rmse)).collect();
            let by_error: Vec<(f64, f64)> = by_time.iter().map(|&(t, e)| (e, t)).collect();
            let mut told = |found: Option<CurveReading>, paper: f64| match found {
                Some(CurveReading::Within(v)) => format!("{:.2}", v / paper),
                Some(CurveReading::Beyond(v)) => format!("~{:.2}", v / paper),
                None => {
                    missing = true;
                    "-".to_owned()
                }
            };
            let error = told(on_curve(&by_time, time_ms(paper)), paper.perceived_rmse);
            let time = told(on_curve(&by_error, paper.perceived_rmse), time_ms(paper));
            let motion = if paper.moving { "moving" } else { "still" };
            // Writing into a string cannot fail.
            let _ = writeln!(text, "| {motion} | {} | {name} | {error} | {time} |", paper.budget);
        }
    }
    text += "\n~: read along the curve's last line, beyond its measured points.\n";
    if missing {
        text += "-: no measured budget of the method reaches so far, or its curve is not monotone there; more --budgets fill it in.\n";
    }
    text
}

/// The row of this program's own method.
pub(super) fn dpm_of(g: &GroupResult) -> Option<&ErrorRow> {
    g.rows.iter().find(|r| r.method == DPM)
}

fn others(g: &GroupResult) -> impl Iterator<Item = &ErrorRow> {
    g.rows.iter().filter(|r| is_other(&r.method))
}

/// The least perceived error of the other methods.
pub(super) fn best_other(g: &GroupResult) -> Option<&ErrorRow> {
    others(g).min_by(|a, b| a.perceived_rmse.total_cmp(&b.perceived_rmse))
}

/// The least of what `flicker` tells of the other methods.
pub(super) fn least_flicker(g: &GroupResult, flicker: impl Fn(&ErrorRow) -> f64) -> f64 {
    others(g).map(flicker).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_power_law_is_read_off_exactly_and_not_far_beyond_its_ends() {
        let points: Vec<(f64, f64)> = [1.0f64, 4.0, 64.0].iter().map(|x| (*x, 3.0 / x.sqrt())).collect();
        for x in [1.0f64, 2.5, 4.0, 20.0, 64.0, 0.3, 250.0] {
            let (y, within) = match on_curve(&points, x).unwrap() {
                CurveReading::Within(y) => (y, true),
                CurveReading::Beyond(y) => (y, false),
            };
            assert!((y * x.sqrt() / 3.0 - 1.0).abs() < 1e-12, "{x}: {y}");
            assert_eq!(within, (1.0..=64.0).contains(&x));
        }
        assert_eq!(on_curve(&points, 0.24), None);
        assert_eq!(on_curve(&points, 257.0), None);
        // A line so steep that its end says nothing: a little less error for a hundredth of the time.
        assert_eq!(on_curve(&[(0.0470, 12.0), (0.0467, 6.0)], 0.044), None);
        assert_eq!(on_curve(&points[..1], 1.0), None);
        assert_eq!(on_curve(&[], 1.0), None);
        // Up and down again: two answers are none, and no end to go on from.
        let bent = [(1.0, 1.0), (3.0, 2.0), (1.5, 4.0)];
        assert_eq!(on_curve(&bent, 2.0), None);
        assert_eq!(on_curve(&bent, 4.0), None);
        assert_eq!(on_curve(&[(1.0, 0.0), (2.0, 1.0)], 1.5), None);
    }
}
