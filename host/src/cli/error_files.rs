//! Measured groups of `dpm error` in a folder: found again, joined, and written as tables, curves and pictures.

use super::watch::print;
use crate::experiments::error_figure3::{self, Figure3Group};
use crate::experiments::error_plan::Group;
use crate::experiments::error_plot::{self, curves, Cost};
use crate::experiments::error_report::{csv, markdown};
use crate::experiments::error_runs::GroupResult;
use crate::experiments::error_sheet::stack;
use crate::experiments::error_table::{self, TableGroup};
use crate::experiments::snapshot::paint::Canvas;
use crate::failure::{Failure, FailureKind};
use crate::files::write_atomically;
use crate::telemetry::report::to_json;
use serde::de::DeserializeOwned;
use std::io::Write;
use std::path::{Path, PathBuf};

/// What an earlier run left in `path`, when it was made from the same.
pub(super) fn known<T: DeserializeOwned>(path: &Path, fits: impl Fn(&T) -> bool) -> Option<T> {
    std::fs::read(path).ok().and_then(|b| serde_json::from_slice(&b).ok()).filter(fits)
}

/// Writes table and plot of the settings of figure 3, and prints the table or one JSON object.
pub(super) fn report_figure3(out: &Path, groups: &[Figure3Group], json: bool) -> Result<(), Failure> {
    let object = to_json(&serde_json::json!({ "groups": groups }));
    let table = error_figure3::markdown(groups);
    write(&out.join("figure3.json"), &object)?;
    write(&out.join("figure3.csv"), &error_figure3::csv(groups))?;
    write(&out.join("figure3.md"), &table)?;
    let svg = error_plot::figure3(groups).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
    write(&out.join("figure3.svg"), &svg)?;
    print(&if json { object + "\n" } else { table });
    Ok(())
}

/// Writes the table of all methods with its pictures, and prints the table or one JSON object.
pub(super) fn report_table(out: &Path, groups: &[TableGroup], json: bool) -> Result<(), Failure> {
    let object = to_json(&serde_json::json!({ "groups": groups }));
    let table = error_table::markdown(groups);
    write(&out.join("table.json"), &object)?;
    write(&out.join("table.md"), &table)?;
    let sheets: Vec<Canvas> =
        groups.iter().filter_map(|g| Canvas::load(&table_path(out, g).with_extension("png"))).collect();
    if !sheets.is_empty() {
        save(&out.join("table.png"), &stack(&sheets))?;
    }
    print(&if json { object + "\n" } else { table });
    Ok(())
}

/// Where the numbers of a setting of the table lie.
pub(super) fn table_path(out: &Path, g: &TableGroup) -> PathBuf {
    out.join(format!("table-{}-{}.json", g.name(), g.result.key))
}

/// Joins what lies in a folder: groups of methods, settings of figure 3 or of the table.
pub(super) fn merge(out: &Path, json: bool) -> Result<(), Failure> {
    let mut groups: Vec<GroupResult> = read_all(out, "group-")?;
    groups.sort_by(|a, b| {
        let ((am, ab), (bm, bb)) = (place(a), place(b));
        am.cmp(&bm).then(ab.total_cmp(&bb))
    });
    one_experiment(out, &groups)?;
    let settings: Vec<Figure3Group> = read_all(out, "figure3-")?;
    let mut cells: Vec<TableGroup> = read_all(out, "table-")?;
    cells.sort_by_key(|c| (c.aside, c.moving, c.place()));
    if groups.is_empty() && settings.is_empty() && cells.is_empty() {
        let out = out.display();
        let told = format!("{out}: no measured groups; run dpm error RIG.toml --index N --out {out} first");
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    if !settings.is_empty() {
        report_figure3(out, &settings, json)?;
    }
    if !cells.is_empty() {
        report_table(out, &cells, json)?;
    }
    if groups.is_empty() {
        return Ok(());
    }
    report(out, &groups, json)
}

/// Motion and budget of a group.
fn place(g: &GroupResult) -> (bool, f64) {
    g.rows.first().map_or((false, 0.0), |r| (r.moving, r.budget))
}

/// Where the numbers of a group lie.
fn group_path(out: &Path, g: &GroupResult) -> PathBuf {
    let (moving, budget) = place(g);
    out.join(format!("group-{}-{}.json", Group { moving, budget }.name(), g.key))
}

/// Groups of one configuration, raster, seed and extent, none of them twice: only those have curves in common. They may come from
/// different devices and commits, which the tables tell.
fn one_experiment(out: &Path, sorted: &[GroupResult]) -> Result<(), Failure> {
    let what = |g: &GroupResult| (g.stamp.config_hash.clone(), g.stamp.raster, g.stamp.seed, g.extent);
    let told = |why: &str, a: &GroupResult, b: &GroupResult| {
        let (a, b) = (group_path(out, a), group_path(out, b));
        let told = format!("{} and {} {why}; move one of them to another folder", a.display(), b.display());
        Err(Failure::new(FailureKind::BadInput, told))
    };
    for pair in sorted.windows(2) {
        if what(&pair[0]) != what(&pair[1]) {
            let why = "are of different experiments (configuration, raster, seed, frames or samples of the reference)";
            return told(why, &pair[0], &pair[1]);
        }
        if place(&pair[0]) == place(&pair[1]) {
            return told(
                "are one group, measured twice (another device, commit or --ablation)",
                &pair[0],
                &pair[1],
            );
        }
    }
    Ok(())
}

/// Every measured file of a folder whose name begins like this, by name.
fn read_all<T: DeserializeOwned>(out: &Path, prefix: &str) -> Result<Vec<T>, Failure> {
    let Ok(entries) = std::fs::read_dir(out) else { return Ok(Vec::new()) };
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| {
            let name = p.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(prefix) && name.ends_with(".json")
        })
        .collect();
    paths.sort();
    let mut found = Vec::new();
    for path in paths {
        let bad = |e: &dyn std::fmt::Display| {
            let told = format!("{}: {e}; delete it and measure the group again", path.display());
            Failure::new(FailureKind::BadInput, told)
        };
        let bytes = std::fs::read(&path).map_err(|e| bad(&e))?;
        found.push(serde_json::from_slice::<T>(&bytes).map_err(|e| bad(&e))?);
    }
    Ok(found)
}

/// Writes the tables, curves and pictures of measured groups, and prints the tables or one JSON object.
pub(super) fn report(out: &Path, groups: &[GroupResult], json: bool) -> Result<(), Failure> {
    let object = to_json(&serde_json::json!({ "groups": groups }));
    write(&out.join("error.json"), &object)?;
    write(&out.join("error.csv"), &csv(groups))?;
    let table = markdown(groups);
    write(&out.join("error.md"), &table)?;
    for (moving, motion) in [(false, "still"), (true, "moving")] {
        for (cost, name) in [(Cost::Rays, "rays"), (Cost::GpuMs, "ms")] {
            let svg = curves(groups, moving, cost).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
            write(&out.join(format!("error-{motion}-{name}.svg")), &svg)?;
        }
    }
    let sheets: Vec<Canvas> =
        groups.iter().filter_map(|g| Canvas::load(&group_path(out, g).with_extension("png"))).collect();
    if !sheets.is_empty() {
        save(&out.join("error.png"), &stack(&sheets))?;
    }
    print(&if json { object + "\n" } else { table });
    Ok(())
}

pub(super) fn save(path: &Path, canvas: &Canvas) -> Result<(), Failure> {
    canvas
        .save(path)
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}

pub(super) fn write(path: &Path, text: &str) -> Result<(), Failure> {
    write_atomically(path, |w| w.write_all(text.as_bytes()))
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::error_runs::{ErrorRow, Extent};
    use crate::experiments::stamp::Stamp;

    fn group(moving: bool, budget: f64, change: impl FnOnce(&mut GroupResult)) -> GroupResult {
        let row = ErrorRow {
            method: "paper".into(),
            moving,
            budget,
            spp: 1.0,
            rays: 1.0,
            rays_to_paper: 1.0,
            samples: 1.0,
            gpu_ms: 1.0,
            wall_ms: 1.0,
            single_rmse: 1.0,
            single_rel_mse: 1.0,
            perceived_rmse: 1.0,
            perceived_rmse_raw: 1.0,
            perceived_fovea: None,
            perceived_periphery: None,
            bias: 1.0,
            bias_floor: 1.0,
            noise: 1.0,
            mean_shift: 0.0,
            flip: 0.0,
            flicker: 0.0,
            flicker_periphery: None,
            ratio_to_paper: 1.0,
        };
        let stamp = Stamp {
            device: "a device".into(),
            driver: "1".into(),
            software: false,
            version: "1".into(),
            commit: "0".into(),
            config_hash: "c".into(),
            raster: [8, 6],
            seed: 1,
        };
        let extent = Extent { warm_up: 1, kept: 2, reference_spp: 3 };
        let key = format!("{moving}{budget}");
        let mut made =
            GroupResult { stamp, key, extent, probes: 1, mean: 1.0, reference_error: 0.0, rows: vec![row] };
        change(&mut made);
        made
    }

    #[test]
    fn only_groups_of_one_experiment_are_joined() {
        let first = || group(false, 2.0, |_| ());
        let joined = |other: GroupResult| one_experiment(Path::new("out"), &[first(), other]);
        assert!(joined(group(false, 4.0, |_| ())).is_ok());
        assert!(joined(group(true, 2.0, |g| g.stamp.device = "another".into())).is_ok());
        let changes: [fn(&mut GroupResult); 4] = [
            |g| g.stamp.config_hash = "d".into(),
            |g| g.stamp.raster = [9, 6],
            |g| g.stamp.seed = 2,
            |g| g.extent.reference_spp = 4,
        ];
        for change in changes {
            let told = joined(group(true, 4.0, change)).unwrap_err().message;
            assert!(told.contains("group-still-2-") && told.contains("different experiments"), "{told}");
        }
        let told = joined(group(false, 2.0, |g| g.key = "k".into())).unwrap_err().message;
        assert!(told.contains("measured twice") && told.contains("group-still-2-k.json"), "{told}");
    }
}
