//! Measured groups into what can be said of dpm beside the other methods: at equal rays and at equal time, group by group, the worst group
//! beside the best.
//!
//! Every ratio stands as measured first, then with the reference's own error taken off both sides, then as it would be with either run
//! of either method. Two runs do not give statistics, but a claim that fails in one of the four pairings is rejected.

use super::report::{best_other, dpm_of, least_flicker};
use super::runs::{is_other, EqualTime, ErrorRow, GroupResult};
use crate::median::median;
use std::fmt::Write as _;

/// The error of dpm by that of the best of the other methods.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Ratio {
    /// As measured.
    pub raw: f64,
    /// With the reference's own error taken off both.
    pub clean: f64,
    /// Least and largest of the four ratios of single runs, as measured.
    pub runs: [f64; 2],
    /// The best of the others.
    pub other: String,
}

/// What one group says.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct GroupVerdict {
    /// Name of the group.
    pub group: String,
    /// Errors at the rays of the method `paper`.
    pub rays: Ratio,
    /// Errors at the time of dpm; `None` of groups that were measured before that was.
    pub time: Option<Ratio>,
    /// Flicker of dpm by the least of the others, at equal rays.
    pub flicker: f64,
    /// Mean of dpm's picture against the reference's, minus 1.
    pub mean_shift: f64,
    /// The method of the least FLIP, at equal rays.
    pub first_in_flip: String,
}

/// dpm by another method: errors as measured and with the reference's own taken off, and those of single runs.
pub(super) fn ratio(
    dpm: [f64; 2],
    dpm_runs: [f64; 2],
    other: [f64; 2],
    other_runs: [f64; 2],
    name: &str,
) -> Ratio {
    let all: Vec<f64> = dpm_runs.iter().flat_map(|a| other_runs.map(|b| a / b)).collect();
    Ratio {
        raw: dpm[0] / other[0],
        clean: dpm[1] / other[1],
        runs: [all.iter().copied().fold(f64::INFINITY, f64::min), all.iter().copied().fold(0.0, f64::max)],
        other: name.to_owned(),
    }
}

fn errors(r: &ErrorRow) -> [f64; 2] {
    [r.perceived_rmse_raw, r.perceived_rmse]
}

/// What a group says; `flicker` is what counts as that of a row. `None` without dpm or without any other method.
pub(super) fn verdict(
    group: String,
    result: &GroupResult,
    flicker: &dyn Fn(&ErrorRow) -> f64,
) -> Option<GroupVerdict> {
    let (dpm, best) = (dpm_of(result)?, best_other(result)?);
    let timed = result.rows.iter().filter(|r| is_other(&r.method)).filter_map(|r| Some((r, r.equal_time?)));
    let best_timed = timed
        .min_by(|(_, a), (_, b)| a.perceived_rmse.total_cmp(&b.perceived_rmse))
        .map(|(r, t)| (&r.method, t));
    let in_time = |(name, t): (&String, EqualTime)| {
        ratio(errors(dpm), dpm.runs_raw, [t.perceived_rmse_raw, t.perceived_rmse], t.runs_raw, name)
    };
    let whole = result.rows.iter().filter(|r| is_other(&r.method) || r.method == dpm.method);
    Some(GroupVerdict {
        group,
        rays: ratio(errors(dpm), dpm.runs_raw, errors(best), best.runs_raw, &best.method),
        time: best_timed.map(in_time),
        flicker: flicker(dpm) / least_flicker(result, flicker),
        mean_shift: dpm.mean_shift,
        first_in_flip: whole
            .min_by(|a, b| a.flip.total_cmp(&b.flip))
            .map_or(String::new(), |r| r.method.clone()),
    })
}

/// A row's time of a frame with its spread, ms; a dash without any.
pub(super) fn time_text(r: &ErrorRow) -> String {
    let ms = super::report::time_ms(r);
    let [low, high] = r.middle_half_ms;
    match (ms > 0.0, high > 0.0) {
        (false, _) => "-".to_owned(),
        (true, false) => format!("{ms:.2}"),
        (true, true) => format!("{ms:.2} ({low:.2} to {high:.2})"),
    }
}

/// Both runs of a row, as measured; a dash of groups that were measured before runs were told apart.
pub(super) fn runs_text(runs: [f64; 2]) -> String {
    if runs[0] > 0.0 {
        format!("{:.5}, {:.5}", runs[0], runs[1])
    } else {
        "-".to_owned()
    }
}

/// Every other method with as many samples as fill the time of dpm, as a Markdown table with what it says above. Nothing where no group
/// was measured so.
pub(super) fn equal_time_table<'a>(
    groups: impl Iterator<Item = (String, &'a GroupResult)> + Clone,
) -> String {
    let here = "At equal time every other method is drawn again with as many samples as fill the time of a frame of dpm on this device: \
                races of all methods in turns say how many these are, and `time / dpm` how well that was met.";
    let mut text = table_at(groups.clone(), here, &|r| r.equal_time);
    let mut cards: Vec<&str> = Vec::new();
    let known = groups.clone().flat_map(|(_, g)| &g.rows).flat_map(|r| &r.on_cards);
    known.for_each(|t| {
        if !cards.contains(&t.card.as_str()) {
            cards.push(&t.card);
        }
    });
    for card in cards {
        let told = format!(
            "The same by the costs that passes and rays had on a card that was measured, `dpm bench --report` of {card}: computed, and not \
             timed here."
        );
        let on_card = |r: &ErrorRow| r.on_cards.iter().find(|t| t.card == card).map(|t| t.seen);
        text += &format!("\n{}", table_at(groups.clone(), &told, &on_card));
    }
    text
}

/// Methods at equal times of one kind, with what these are above; nothing where none is known.
fn table_at<'a>(
    groups: impl Iterator<Item = (String, &'a GroupResult)>,
    told: &str,
    time: &dyn Fn(&ErrorRow) -> Option<EqualTime>,
) -> String {
    let mut text = String::new();
    for (name, g) in groups {
        let Some(dpm) = dpm_of(g) else { continue };
        for (r, t) in g.rows.iter().filter_map(|r| Some((r, time(r)?))) {
            // Writing into a string cannot fail.
            let _ = writeln!(
                text,
                "| {name} | {} | {:.1} | {:.1} | {:.2} | {:.5} | {:.5} | {} | {:.2} |",
                r.method,
                r.spp,
                t.spp,
                t.time_to_dpm,
                t.perceived_rmse_raw,
                t.perceived_rmse,
                runs_text(t.runs_raw),
                dpm.perceived_rmse_raw / t.perceived_rmse_raw,
            );
        }
    }
    if text.is_empty() {
        return text;
    }
    format!(
        "{told}\n\n\
         | group | method | samples at equal rays | in the time of dpm | time / dpm | perceived RMSE as measured | less the reference's own | \
         two runs | dpm / it, as measured |\n|---|---|---:|---:|---:|---:|---:|---|---:|\n{text}"
    )
}

fn cells(r: &Ratio) -> String {
    format!("{:.2} | {:.2} | {:.2} to {:.2} | {}", r.raw, r.clean, r.runs[0], r.runs[1], r.other)
}

/// Worst, median and best of some ratios, with the groups of both ends.
fn ends<'a>(what: &str, ratios: impl Iterator<Item = (&'a str, f64)>) -> String {
    let mut all: Vec<(&str, f64)> = ratios.filter(|r| r.1.is_finite()).collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1));
    let (Some(worst), Some(best)) = (all.first(), all.last()) else { return String::new() };
    let better = all.iter().filter(|r| r.1 < 1.0).count();
    format!(
        "- {what}: worst {:.2} ({}), median {:.2}, best {:.2} ({}); below 1 in {better} of {}.\n",
        worst.1,
        worst.0,
        median(all.iter().map(|r| r.1)),
        best.1,
        best.0,
        all.len(),
    )
}

/// A table of all groups and what they say together. Nothing without any.
pub(super) fn table(verdicts: &[GroupVerdict]) -> String {
    if verdicts.is_empty() {
        return String::new();
    }
    let mut text = String::from(
        "dpm by the best of the others. `two runs`: the least and the largest ratio that single runs have; a ratio that reaches over 1 there is no \
         difference.\n\n\
         | group | error at equal rays, as measured | less the reference's own | two runs | best other | error at equal time, as measured | \
         less the reference's own | two runs | best other | flicker | first in FLIP | mean of dpm |\n\
         |---|---:|---:|---|---|---:|---:|---|---|---:|---|---:|\n",
    );
    for v in verdicts {
        let time = v.time.as_ref().map_or("- | - | - | -".to_owned(), cells);
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "| {} | {} | {time} | {:.2} | {} | {:+.2} % |",
            v.group,
            cells(&v.rays),
            v.flicker,
            v.first_in_flip,
            100.0 * v.mean_shift
        );
    }
    text.push('\n');
    text +=
        &ends("error at equal rays, as measured", verdicts.iter().map(|v| (v.group.as_str(), v.rays.raw)));
    let timed = verdicts.iter().filter_map(|v| Some((v.group.as_str(), v.time.as_ref()?.raw)));
    text += &ends("error at equal time on this device, as measured", timed);
    text += &ends("flicker at equal rays", verdicts.iter().map(|v| (v.group.as_str(), v.flicker)));
    let shifted = verdicts.iter().max_by(|a, b| a.mean_shift.abs().total_cmp(&b.mean_shift.abs()));
    let first = verdicts.iter().filter(|v| !is_other(&v.first_in_flip)).count();
    let _ = writeln!(text, "- FLIP puts dpm first in {first} of {}.", verdicts.len());
    if let Some(v) = shifted {
        let _ = writeln!(
            text,
            "- The mean of dpm's picture is farthest from the reference's in {}: {:+.2} %.",
            v.group,
            100.0 * v.mean_shift
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(group: &str, raw: f64, time: Option<f64>, flip: &str, mean_shift: f64) -> GroupVerdict {
        let ratio = |raw: f64| Ratio { raw, clean: raw, runs: [raw, raw], other: "sequence".into() };
        GroupVerdict {
            group: group.into(),
            rays: ratio(raw),
            time: time.map(ratio),
            flicker: 0.5 * raw,
            mean_shift,
            first_in_flip: flip.into(),
        }
    }

    #[test]
    fn the_worst_group_is_told_beside_the_best() {
        let all = [
            of("a", 0.2, Some(0.5), "dpm", 0.001),
            of("b", 1.15, Some(1.9), "sequence", -0.03),
            of("c", 0.6, None, "full", 0.01),
        ];
        let text = table(&all);
        assert!(
            text.contains(
                "equal rays, as measured: worst 1.15 (b), median 0.60, best 0.20 (a); below 1 in 2 of 3."
            ),
            "{text}"
        );
        assert!(text.contains("equal time on this device, as measured: worst 1.90 (b), median 1.20, best 0.50 (a); below 1 in 1 of 2."), "{text}");
        assert!(text.contains("FLIP puts dpm first in 1 of 3."), "{text}");
        assert!(text.contains("farthest from the reference's in b: -3.00 %."), "{text}");
        assert!(table(&[]).is_empty());
    }

    #[test]
    fn a_ratio_has_the_spread_of_all_four_runs() {
        let r = ratio([2.0, 1.0], [1.8, 2.2], [4.0, 4.0], [3.6, 4.4], "full");
        assert_eq!((r.raw, r.clean), (0.5, 0.25));
        assert!((r.runs[0] - 1.8 / 4.4).abs() < 1e-12 && (r.runs[1] - 2.2 / 3.6).abs() < 1e-12);
    }
}
