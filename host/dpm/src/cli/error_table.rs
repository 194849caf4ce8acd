//! `dpm error --preset table`: measures the settings that are missing, then writes the whole table.

use super::error::{
    chosen, end, failure, folder, list, options, stage, weight, weight_of_methods, ErrorArgs,
};
use super::error_files::{known_or, Kept, Origin};
use super::progress::Progress;
use dpm_lab::error::plan::contenders;
use dpm_lab::error::table::{self, TableGroup, TableSetting};
use dpm_rig::failure::Failure;
use dpm_rig::rig::Rig;

impl Kept for TableGroup {
    const PREFIX: &'static str = "table";
    const REPORT: &'static str = "table";

    fn name(&self) -> String {
        self.setting().name()
    }

    fn origin(&self) -> Origin<'_> {
        self.result.origin()
    }

    fn order(&self) -> (bool, bool, f64) {
        (self.aside, self.moving, self.setting().look as f64)
    }

    fn markdown(groups: &[Self]) -> String {
        table::markdown(groups)
    }
}

/// Measures the settings that are missing, and writes the table.
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
    let methods = contenders(&rig.config.render, options.ablation).len();
    let cost = |what: &str, s: TableSetting| weight(what, s.group(), options.extent, methods);
    let totals: Vec<u64> = chosen
        .iter()
        .map(|&s| weight_of_methods(s.group(), options.extent, methods) + 2 * cost("reference", s))
        .collect();
    let mut progress = Progress::new(&totals);
    let mut groups = Vec::new();
    for &setting in &chosen {
        let rig = Rig::build(&rig.config, Some(raster))?;
        let (runs, key) = table::runs(rig, &gpu, setting, &options);
        let name = setting.name();
        let group = known_or(&out, &name, &key, || {
            let mut each = |what: &str| progress.step(&format!("{name} {what}"), cost(what, setting));
            let (group, seen) = table::measure(&runs, setting, &mut each).map_err(failure)?;
            Ok((group, Some(seen)))
        })?;
        progress.end_of_part(&name);
        groups.push(group);
    }
    end(args, &out, &groups)
}
