//! Measured groups of `dpm error` in a folder: found again or measured and kept, joined, and reported. What differs from experiment to
//! experiment is in `error_experiments.rs`.

use super::error_experiments::{Experiment, GroupOrigin};
use super::watch::print;
use dpm_common::files::write_atomically;
use dpm_device::regular_file;
use dpm_lab::error::figure3::Figure3Group;
use dpm_lab::error::groups::{markdown, RigGroup};
use dpm_lab::error::plan::Setting;
use dpm_lab::error::runs::{GroupResult, Measured};
use dpm_lab::error::seen::SeenGroup;
use dpm_lab::error::sheet::{stack, strip};
use dpm_lab::error::table::TableGroup;
use dpm_lab::paint::Canvas;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::report::to_json;
use serde_json::Value;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Largest file of a group that is read, bytes; real ones have some hundred thousand.
const MAX_GROUP_BYTES: u64 = 1 << 30;

fn path<T: Experiment>(out: &Path, name: &str, key: &str) -> PathBuf {
    out.join(format!("{}-{name}-{key}.json", T::PREFIX))
}

fn path_of<T: Experiment>(out: &Path, group: &T) -> PathBuf {
    path::<T>(out, &group.setting().name(), group.origin().key)
}

/// The result of an earlier run for a group, if it was made from the same inputs.
pub(super) fn known<T: Experiment>(out: &Path, name: &str, key: &str) -> Option<T> {
    let bytes = regular_file::read(&path::<T>(out, name, key), MAX_GROUP_BYTES).ok()?;
    serde_json::from_slice(&bytes).ok().filter(|group: &T| group.origin().key == key)
}

/// The result of an earlier run for a group, or else the result of `measure`, which is kept, with a picture of what
/// the eye saw if there is one.
pub(super) fn known_or<T: Experiment>(
    out: &Path,
    name: &str,
    key: &str,
    measure: impl FnOnce() -> Result<(T, Option<Measured>), Failure>,
) -> Result<T, Failure> {
    if let Some(group) = known(out, name, key) {
        return Ok(group);
    }
    let (group, seen) = measure()?;
    let path = path_of(out, &group);
    if let Some(seen) = &seen {
        save(&path.with_extension("png"), &strip(seen, &name.replace('-', " ")))?;
    }
    write(&path, &to_json(&group))?;
    if let Some(seen) = seen {
        seen.is_kept();
    }
    Ok(group)
}

/// Writes the tables, curves and pictures of an experiment, and prints the tables or one JSON object.
pub(super) fn report<T: Experiment>(out: &Path, groups: &[T], json: bool) -> Result<(), Failure> {
    write_reports(out, groups)?;
    show(groups, json);
    Ok(())
}

fn write_reports<T: Experiment>(out: &Path, groups: &[T]) -> Result<(), Failure> {
    let file = |end: &str| out.join(format!("{}{end}", T::REPORT));
    write(&file(".json"), &to_json(&object(groups)))?;
    write(&file(".md"), &T::markdown(groups))?;
    for (end, text) in T::reports(groups).map_err(|e| Failure::new(FailureKind::BadInput, e))? {
        write(&file(&end), &text)?;
    }
    let sheets: Vec<Canvas> =
        groups.iter().filter_map(|g| Canvas::load(&path_of(out, g).with_extension("png"))).collect();
    if !sheets.is_empty() {
        save(&file(".png"), &stack(&sheets))?;
    }
    Ok(())
}

/// Prints one JSON object or the tables.
pub(super) fn show<T: Experiment>(groups: &[T], json: bool) {
    print(&if json { to_json(&object(groups)) + "\n" } else { T::markdown(groups) });
}

/// Prints the table of the groups of several rigs or one JSON object; with `whole` both are also written into the folder.
pub(super) fn report_rigs(
    out: &Path,
    groups: &[RigGroup<'_>],
    json: bool,
    whole: bool,
) -> Result<(), Failure> {
    let each = groups.iter().map(|g| serde_json::json!({ "rig": g.rig, "group": g.result }));
    let object = to_json(&serde_json::json!({ "rigs": each.collect::<Vec<_>>() }));
    let table = markdown(groups);
    if whole {
        write(&out.join("groups.json"), &object)?;
        write(&out.join("groups.md"), &table)?;
    }
    print(&if json { object + "\n" } else { table });
    Ok(())
}

fn object<T: Experiment>(groups: &[T]) -> Value {
    serde_json::json!({ "groups": groups })
}

/// Joins the results in a folder: groups of methods, settings of figure 3, cells of the table. Prints the tables, or
/// one JSON object that contains each experiment under the name of its report.
pub(super) fn merge(out: &Path, json: bool) -> Result<(), Failure> {
    print(&merged(out, json)?);
    Ok(())
}

fn merged(out: &Path, json: bool) -> Result<String, Failure> {
    let (groups, settings, cells) =
        (joined::<GroupResult>(out)?, joined::<Figure3Group>(out)?, joined::<TableGroup>(out)?);
    let seen = joined::<SeenGroup>(out)?;
    let (mut objects, mut tables) = (serde_json::Map::new(), String::new());
    add(out, &settings, &mut objects, &mut tables)?;
    add(out, &cells, &mut objects, &mut tables)?;
    add(out, &groups, &mut objects, &mut tables)?;
    add(out, &seen, &mut objects, &mut tables)?;
    if objects.is_empty() {
        let out = out.display();
        let told = format!("{out}: no measured groups; run dpm error RIG.toml --index N --out {out} first");
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    Ok(if json { to_json(&Value::Object(objects)) + "\n" } else { tables })
}

/// Writes the reports of an experiment, if any part of it was measured, and adds it to the output.
fn add<T: Experiment>(
    out: &Path,
    groups: &[T],
    objects: &mut serde_json::Map<String, Value>,
    tables: &mut String,
) -> Result<(), Failure> {
    if groups.is_empty() {
        return Ok(());
    }
    write_reports(out, groups)?;
    objects.insert(T::REPORT.to_owned(), object(groups));
    tables.push_str(&T::markdown(groups));
    Ok(())
}

/// All groups of an experiment in a folder, in their order.
fn joined<T: Experiment>(out: &Path) -> Result<Vec<T>, Failure> {
    let mut groups = read_all::<T>(out)?;
    groups.sort_by(|a, b| {
        let (a, b) = (a.setting(), b.setting());
        let order = |s: &Setting| (s.aside, s.moving, s.look);
        order(&a).cmp(&order(&b)).then(a.budget.total_cmp(&b.budget))
    });
    one_experiment(out, &groups)?;
    Ok(groups)
}

/// Checks that all groups have the same configuration, raster, seed and extent, and that none occurs twice; only such
/// groups share curves. They may come from different devices and commits, which the tables show.
fn one_experiment<T: Experiment>(out: &Path, sorted: &[T]) -> Result<(), Failure> {
    let what = |g: &T| {
        let GroupOrigin { stamp, extent, .. } = g.origin();
        (stamp.config_hash.clone(), stamp.raster, stamp.seed, extent)
    };
    let told = |why: &str, a: &T, b: &T| {
        let (a, b) = (path_of(out, a), path_of(out, b));
        let told = format!("{} and {} {why}; move one of them to another folder", a.display(), b.display());
        Err(Failure::new(FailureKind::BadInput, told))
    };
    for pair in sorted.windows(2) {
        if what(&pair[0]) != what(&pair[1]) {
            let why = "are of different experiments (configuration, raster, seed, frames or samples of the reference)";
            return told(why, &pair[0], &pair[1]);
        }
        if pair[0].setting().name() == pair[1].setting().name() {
            return told(
                "are the same group, measured twice (another device, commit or --ablation)",
                &pair[0],
                &pair[1],
            );
        }
    }
    Ok(())
}

/// All measured files of an experiment in a folder, by name.
fn read_all<T: Experiment>(out: &Path) -> Result<Vec<T>, Failure> {
    let Ok(entries) = std::fs::read_dir(out) else { return Ok(Vec::new()) };
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| {
            let name = p.file_name().unwrap_or_default().to_string_lossy();
            name.strip_prefix(T::PREFIX).is_some_and(|rest| rest.starts_with('-')) && name.ends_with(".json")
        })
        .collect();
    paths.sort();
    let mut found = Vec::new();
    for path in paths {
        let bad = |e: &dyn std::fmt::Display| {
            let told = format!("{}: {e}; delete it and measure the group again", path.display());
            Failure::new(FailureKind::BadInput, told)
        };
        let bytes = regular_file::read(&path, MAX_GROUP_BYTES).map_err(|e| bad(&e))?;
        found.push(serde_json::from_slice::<T>(&bytes).map_err(|e| bad(&e))?);
    }
    Ok(found)
}

fn save(path: &Path, canvas: &Canvas) -> Result<(), Failure> {
    canvas
        .save(path)
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    write_atomically(path, |w| w.write_all(text.as_bytes()))
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_lab::error::runs::{ErrorRow, SequenceExtent};
    use dpm_lab::stamp::Stamp;

    fn group(moving: bool, budget: f64, change: impl FnOnce(&mut GroupResult)) -> GroupResult {
        let row = ErrorRow {
            method: "paper".into(),
            moving,
            budget,
            spp: 1.0,
            rays: 1.0,
            walked_rays: 1.0,
            rays_to_paper: 1.0,
            samples: 1.0,
            gpu_ms: 1.0,
            wall_ms: 1.0,
            middle_half_ms: [0.9, 1.1],
            runs_raw: [0.1; 2],
            equal_time: None,
            on_cards: Vec::new(),
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
        let extent = SequenceExtent { warm_up: 1, kept: 2, reference_spp: 3 };
        let key = format!("{moving}{budget}");
        let mut made =
            GroupResult { stamp, key, extent, probes: 1, mean: 1.0, reference_error: 0.0, rows: vec![row] };
        change(&mut made);
        made
    }

    /// What must be equal in groups that are joined.
    const CHANGES: [fn(&mut GroupResult); 4] = [
        |g| g.stamp.config_hash = "d".into(),
        |g| g.stamp.raster = [9, 6],
        |g| g.stamp.seed = 2,
        |g| g.extent.reference_spp = 4,
    ];

    #[test]
    fn only_groups_of_one_experiment_are_joined() {
        let first = || group(false, 2.0, |_| ());
        let joined = |other: GroupResult| one_experiment(Path::new("out"), &[first(), other]);
        assert!(joined(group(false, 4.0, |_| ())).is_ok());
        assert!(joined(group(true, 2.0, |g| g.stamp.device = "another".into())).is_ok());
        for change in CHANGES {
            let told = joined(group(true, 4.0, change)).unwrap_err().message;
            assert!(told.contains("group-still-2-") && told.contains("different experiments"), "{told}");
        }
        let told = joined(group(false, 2.0, |g| g.key = "k".into())).unwrap_err().message;
        assert!(told.contains("measured twice") && told.contains("group-still-2-k.json"), "{told}");
    }

    #[test]
    fn only_settings_of_one_table_are_joined_and_all_their_stamps_are_told() {
        let cell = |material: &str, change: fn(&mut GroupResult)| TableGroup {
            material: material.into(),
            moving: true,
            aside: false,
            result: group(true, 18.0, change),
        };
        let joined = |other: TableGroup| one_experiment(Path::new("out"), &[cell("diffuse", |_| ()), other]);
        let elsewhere = cell("glossy", |g| g.stamp.device = "another".into());
        assert!(joined(elsewhere.clone()).is_ok());
        for change in CHANGES {
            let told = joined(cell("mirror", change)).unwrap_err().message;
            let names = told.contains("table-diffuse-moving-") && told.contains("table-mirror-moving-");
            assert!(names && told.contains("different experiments"), "{told}");
        }
        let told = joined(cell("diffuse", |g| g.key = "k".into())).unwrap_err().message;
        assert!(told.contains("measured twice") && told.contains("table-diffuse-moving-k.json"), "{told}");
        let text = TableGroup::markdown(&[cell("diffuse", |_| ()), elsewhere, cell("mirror", |_| ())]);
        assert_eq!((text.matches("a device (").count(), text.matches("another (").count()), (1, 1), "{text}");
        assert!(text.contains("only rows of one group can be compared in time"));
    }

    #[test]
    fn a_folder_gives_back_what_was_kept_in_order_and_measures_only_what_is_missing() {
        let out = std::env::temp_dir().join(format!("dpm-error-files-{}", std::process::id()));
        let keep = |moving, budget| {
            let made = group(moving, budget, |_| ());
            known_or(&out, &made.setting().name(), &made.key.clone(), || Ok((made, None))).unwrap()
        };
        for (moving, budget) in [(true, 0.5), (false, 18.0), (false, 2.0), (true, 64.0)] {
            keep(moving, budget);
        }
        let joined: Vec<String> =
            joined::<GroupResult>(&out).unwrap().iter().map(|g| g.setting().name()).collect();
        assert_eq!(joined, ["still-2", "still-18", "moving-0.5", "moving-64"]);
        let again = known_or::<GroupResult>(&out, "still-2", "false2", || panic!("it lies there"));
        assert_eq!(again.unwrap().setting().budget, 2.0);
        // Another key means another group, and so does a file whose content has another name.
        let mut measured = false;
        let other = known_or(&out, "still-2", "another", || {
            measured = true;
            Ok((group(false, 2.0, |g| g.key = "another".into()), None))
        });
        assert!(measured && other.unwrap().key == "another");
        std::fs::copy(out.join("group-still-2-false2.json"), out.join("group-still-2-forged.json")).unwrap();
        assert!(known::<GroupResult>(&out, "still-2", "forged").is_none());
        assert!(super::joined::<GroupResult>(&out).unwrap_err().message.contains("measured twice"));
        assert!(super::joined::<TableGroup>(&out).unwrap().is_empty());
        std::fs::remove_dir_all(out).unwrap();
    }

    #[test]
    fn a_folder_of_several_experiments_is_one_json_object_with_what_each_report_holds() {
        let out = std::env::temp_dir().join(format!("dpm-error-merged-{}", std::process::id()));
        let made = group(false, 2.0, |_| ());
        known_or(&out, &made.setting().name(), &made.key.clone(), || Ok((made, None))).unwrap();
        let alone: Value = serde_json::from_str(&merged(&out, true).unwrap()).unwrap();
        assert_eq!(alone.as_object().unwrap().keys().collect::<Vec<_>>(), ["error"]);
        let cell = TableGroup {
            material: "glossy".into(),
            moving: true,
            aside: false,
            result: group(true, 18.0, |_| ()),
        };
        known_or(&out, &cell.setting().name(), &cell.result.key.clone(), || Ok((cell, None))).unwrap();
        // The whole text is one value: from_str refuses anything after it.
        let both: Value = serde_json::from_str(&merged(&out, true).unwrap()).unwrap();
        assert_eq!(both.as_object().unwrap().len(), 2);
        for name in ["error", "table"] {
            let file = std::fs::read(out.join(name).with_extension("json")).unwrap();
            assert_eq!(both[name], serde_json::from_slice::<Value>(&file).unwrap(), "{name}");
            assert_eq!(both[name]["groups"].as_array().unwrap().len(), 1, "{name}");
        }
        let tables = merged(&out, false).unwrap();
        for name in ["error", "table"] {
            let part = std::fs::read_to_string(out.join(name).with_extension("md")).unwrap();
            assert!(tables.contains(&part), "{name}");
        }
        std::fs::remove_dir_all(out).unwrap();
    }
}
