//! Measured groups of several rigs into one table: dpm beside each of the methods that it has to beat, group by group, with what single
//! runs say of each ratio.

use super::plan::OWN;
use super::report::{dpm_of, stamps};
use super::runs::{ErrorRow, GroupResult, DPM};
use super::verdict::{ratio, Ratio};
use std::fmt::Write as _;

/// What dpm is compared with: the floor under it, what keeps nothing, and what it develops.
const BESIDE: [&str; 3] = [OWN, "sequence", "paper"];

/// A group of one rig.
#[derive(Clone, Copy, Debug)]
pub struct RigGroup<'a> {
    /// Name of the rig's file.
    pub rig: &'a str,
    /// What was measured of it.
    pub result: &'a GroupResult,
}

fn row<'a>(g: &'a GroupResult, method: &str) -> Option<&'a ErrorRow> {
    g.rows.iter().find(|r| r.method == method)
}

/// dpm by another method: at equal rays, and at equal time if that was measured.
fn beside(g: &GroupResult, method: &str) -> Option<(Ratio, Option<Ratio>)> {
    let (dpm, other) = (dpm_of(g)?, row(g, method)?);
    let of = |raw, clean, runs| {
        ratio([dpm.perceived_rmse_raw, dpm.perceived_rmse], dpm.runs_raw, [raw, clean], runs, method)
    };
    let in_time = other.equal_time.map(|t| of(t.perceived_rmse_raw, t.perceived_rmse, t.runs_raw));
    Some((of(other.perceived_rmse_raw, other.perceived_rmse, other.runs_raw), in_time))
}

fn cell(r: Option<&Ratio>) -> String {
    r.map_or("-".to_owned(), |r| format!("{:.2} ({:.2} to {:.2})", r.raw, r.runs[0], r.runs[1]))
}

/// The geometric mean, and in how many of all a ratio is below 1; nothing without any.
fn together(what: &str, ratios: &[f64]) -> String {
    if ratios.is_empty() {
        return String::new();
    }
    let mean = (ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp();
    let (worst, below) =
        (ratios.iter().copied().fold(0.0, f64::max), ratios.iter().filter(|r| **r < 1.0).count());
    format!("- {what}: geometric mean {mean:.2}, worst {worst:.2}, below 1 in {below} of {}.\n", ratios.len())
}

/// One row a group as Markdown, with the stamps above and what all groups say together below. Ratios are of errors as measured; in brackets
/// the least and the largest that single runs give.
pub fn markdown(groups: &[RigGroup<'_>]) -> String {
    let mut text = stamps(groups.iter().map(|g| &g.result.stamp));
    text += "| group | budget | dpm: perceived RMSE | bias | mean |";
    for name in BESIDE {
        // Writing into a string cannot fail.
        let _ = write!(text, " / {name}, equal rays |");
    }
    for name in BESIDE {
        let _ = write!(text, " / {name}, equal time |");
    }
    text +=
        " FLIP / least | flicker / least |\n|---|---:|---:|---:|---:|---|---|---|---|---|---|---:|---:|\n";
    let (mut rays, mut time) = ([const { Vec::new() }; 3], [const { Vec::new() }; 3]);
    for RigGroup { rig, result } in groups {
        let Some(dpm) = dpm_of(result) else { continue };
        let _ = write!(
            text,
            "| {rig} | {} | {:.5} | {:.5} | {:+.2} % |",
            dpm.budget,
            dpm.perceived_rmse_raw,
            dpm.bias,
            100.0 * dpm.mean_shift
        );
        let all = BESIDE.map(|name| beside(result, name));
        for (i, ratios) in all.iter().enumerate() {
            let _ = write!(text, " {} |", cell(ratios.as_ref().map(|(r, _)| r)));
            rays[i].extend(ratios.as_ref().map(|(r, _)| r.raw));
        }
        for (i, ratios) in all.iter().enumerate() {
            let in_time = ratios.as_ref().and_then(|(_, t)| t.as_ref());
            let _ = write!(text, " {} |", cell(in_time));
            time[i].extend(in_time.map(|r| r.raw));
        }
        let least = |of: &dyn Fn(&ErrorRow) -> f64| {
            let others = result.rows.iter().filter(|r| !r.method.starts_with(DPM));
            others.map(of).fold(f64::INFINITY, f64::min)
        };
        let _ = writeln!(
            text,
            " {:.2} | {:.2} |",
            dpm.flip / least(&|r| r.flip),
            dpm.flicker / least(&|r| r.flicker)
        );
    }
    text.push('\n');
    for (i, name) in BESIDE.iter().enumerate() {
        text += &together(&format!("dpm / {name} at equal rays"), &rays[i]);
    }
    for (i, name) in BESIDE.iter().enumerate() {
        text += &together(&format!("dpm / {name} at equal time on this device"), &time[i]);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_of_several_groups_have_their_geometric_mean_and_their_worst() {
        assert_eq!(
            together("a / b", &[0.5, 2.0, 1.0]),
            "- a / b: geometric mean 1.00, worst 2.00, below 1 in 1 of 3.\n"
        );
        assert_eq!(together("a / b", &[]), "");
    }
}
