//! `dpm error --preset table`: settings of the table that are not measured yet, then the whole table.

use super::error::{chosen, failure, folder, list, options, stage, weight, ErrorArgs};
use super::error_files::{known, report_table, save, table_path, write};
use super::progress::Progress;
use super::watch::print;
use crate::experiments::error_sheet::strip;
use crate::experiments::error_table::{self, TableGroup, TableSetting};
use crate::failure::Failure;
use crate::rig::Rig;
use crate::telemetry::report::to_json;

/// Methods of the table.
const METHODS: usize = 4;

/// Measures what is not measured yet and writes the table.
///
/// # Errors
/// Bad rig or flags, no GPU, a folder that cannot be written.
pub(super) fn table(args: &ErrorArgs) -> Result<(), Failure> {
    let all = TableSetting::all();
    if args.list {
        return list(args, all.iter().map(|s| s.name()));
    }
    let (out, chosen) = (folder(args), chosen(args, &all)?);
    let options = options(args, &out);
    let (gpu, rig) = stage(args)?;
    let raster = rig.camera.raster;
    let cost = |what: &str, s: TableSetting| weight(what, s.group(), options.extent, METHODS);
    let totals: Vec<u64> = chosen
        .iter()
        .map(|&s| 2 * METHODS as u64 * cost("", s) + cost("times", s) + 2 * cost("reference", s))
        .collect();
    let mut progress = Progress::new(&totals);
    let mut groups = Vec::new();
    for &setting in &chosen {
        let rig = Rig::build(&rig.config, Some(raster))?;
        let (runs, key) = error_table::runs(rig, &gpu, setting, &options);
        let path = out.join(format!("table-{}-{key}.json", setting.name()));
        let group = match known(&path, |g: &TableGroup| g.result.key == key) {
            Some(group) => group,
            None => {
                let name = setting.name();
                let mut each = |what: &str| progress.step(&format!("{name} {what}"), cost(what, setting));
                let (group, measured) = error_table::measure(&runs, setting, &mut each).map_err(failure)?;
                let path = table_path(&out, &group);
                save(&path.with_extension("png"), &strip(&measured, &name.replace('-', " ")))?;
                write(&path, &to_json(&group))?;
                measured.is_kept();
                group
            }
        };
        progress.end_of_part(&setting.name());
        groups.push(group);
    }
    if args.index.is_some() && !args.json {
        print(&error_table::markdown(&groups));
        return Ok(());
    }
    report_table(&out, &groups, args.json)
}
