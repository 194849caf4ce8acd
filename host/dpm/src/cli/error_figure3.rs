//! `dpm error --preset figure3`: measures the settings that are missing, then writes table and plot.

use super::error::{chosen, end, failure, folder, list, options, stage, ErrorArgs};
use super::error_files::{known_or, Kept, Origin};
use super::progress::Progress;
use dpm_lab::error::figure3::{self, Figure3Group, Setting, SPP};
use dpm_lab::error::plot;
use dpm_lab::error::runs::EYE_FRAMES;
use dpm_lab::stamp::Stamp;
use dpm_rig::failure::Failure;
use dpm_rig::rig::Rig;

impl Kept for Figure3Group {
    const PREFIX: &'static str = "figure3";
    const REPORT: &'static str = "figure3";

    fn name(&self) -> String {
        self.setting().name()
    }

    fn origin(&self) -> Origin<'_> {
        Origin { key: &self.key, stamp: &self.stamp, extent: None }
    }

    fn order(&self) -> (bool, bool, f64) {
        let setting = self.setting();
        (false, setting.moving, setting.look as f64)
    }

    fn markdown(groups: &[Self]) -> String {
        figure3::markdown(groups)
    }

    fn reports(groups: &[Self]) -> Result<Vec<(String, String)>, String> {
        Ok(vec![(".csv".to_owned(), figure3::csv(groups)), (".svg".to_owned(), plot::figure3(groups)?)])
    }
}

/// Measures the settings that are missing, and writes table and plot.
///
/// # Errors
/// Bad rig or flags, no GPU, a folder that cannot be written.
pub(super) fn figure3(args: &ErrorArgs) -> Result<(), Failure> {
    let all = Setting::all();
    if args.list {
        return list(args, all.iter().map(|s| s.name()));
    }
    let (out, chosen) = (folder(args), chosen(args, &all)?);
    let options = options(args, &out);
    let (gpu, rig) = stage(args)?;
    let raster = rig.camera.raster;
    let stamp = Stamp::new(&rig, gpu.summary());
    let reference = EYE_FRAMES as u64 * u64::from(options.extent.reference_spp) / 2;
    let sequence = |spp: u32| EYE_FRAMES as u64 * (u64::from(spp) + 3);
    let whole = 2 * (reference + SPP.into_iter().map(sequence).sum::<u64>());
    let mut progress = Progress::new(&vec![whole; chosen.len()]);
    let mut groups = Vec::new();
    for &setting in &chosen {
        let name = setting.name();
        let key = figure3::key(&stamp, setting, &options, &SPP);
        let group = known_or(&out, &name, &key, || {
            let rig = Rig::build(&rig.config, Some(raster))?;
            let mut each = |what: &str| {
                let spp = what.split(' ').next().and_then(|n| n.parse().ok());
                progress.step(&format!("{name} {what}"), spp.map_or(reference, sequence));
            };
            let group = figure3::measure(rig, &gpu, setting, &options, &SPP, &mut each);
            Ok((group.map_err(failure)?, None))
        })?;
        progress.end_of_part(&name);
        groups.push(group);
    }
    end(args, &out, &groups)
}
