//! The experiments of `dpm error`: what each measures of a setting, what that takes, and what it reports. One loop runs them all.

use super::error::{chosen, folder, list, list_names, options, rig_files, rig_of, stage, ErrorArgs};
use super::error_files::{known, known_or, report, report_rigs, show};
use super::progress::WorkProgress;
use dpm_lab::error::costs::CardCosts;
use dpm_lab::error::figure3::{self, Figure3Group, SPP};
use dpm_lab::error::groups::RigGroup;
use dpm_lab::error::plan::{contenders, Setting};
use dpm_lab::error::plot::{self, curves, Cost};
use dpm_lab::error::report::{csv, markdown};
use dpm_lab::error::runs::{
    is_other, key_of, ErrorOptions, ErrorRunError, ErrorRuns, GroupResult, Measured, SequenceExtent,
    AT_EQUAL_TIME, EYE_FRAMES, RACES,
};
use dpm_lab::error::seen::{self, SeenGroup};
use dpm_lab::error::table::{self, TableGroup};
use dpm_lab::stamp::Stamp;
use dpm_rig::config::RenderConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pipeline::PipelineError;
use serde::de::DeserializeOwned;
use serde::Serialize;
use std::path::Path;

/// An experiment, by a measured group of it as it lies in a folder.
pub(super) trait Experiment: Serialize + DeserializeOwned {
    /// What the names of its files begin with.
    const PREFIX: &'static str;
    /// What the names of the experiment's reports begin with.
    const REPORT: &'static str;

    /// What was measured.
    fn setting(&self) -> Setting;
    /// What it came from.
    fn origin(&self) -> GroupOrigin<'_>;
    /// Names all that the result of a setting depends on.
    fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String;
    /// Measures the setting of `runs`, with a picture of what the eye saw where there is one.
    ///
    /// # Errors
    /// The renderer's; nothing lit; the cache cannot be written.
    fn measure(
        runs: &ErrorRuns,
        each: &mut dyn FnMut(&str),
    ) -> Result<(Self, Option<Measured>), ErrorRunError>;
    /// The numbers of the methods, where they can be drawn again frame by frame.
    fn methods(&self) -> Option<&GroupResult> {
        None
    }
    /// What all sequences of a setting cost but those of its reference.
    fn cost(setting: Setting, extent: SequenceExtent, methods: usize) -> u64 {
        cost_of_methods(setting, extent, methods)
    }
    /// The experiment's tables.
    fn markdown(groups: &[Self]) -> String;
    /// The experiment's other reports: name and text.
    ///
    /// # Errors
    /// What the drawing library says.
    fn reports(_groups: &[Self]) -> Result<Vec<(String, String)>, String> {
        Ok(Vec::new())
    }
}

/// What a measured group came from.
pub(super) struct GroupOrigin<'a> {
    /// Hash of all that it depends on.
    pub key: &'a str,
    /// With what it was measured.
    pub stamp: &'a Stamp,
    /// How much was drawn of it, where a group tells.
    pub extent: Option<SequenceExtent>,
}

impl Experiment for GroupResult {
    const PREFIX: &'static str = "group";
    const REPORT: &'static str = "error";

    fn setting(&self) -> Setting {
        self.setting()
    }

    fn origin(&self) -> GroupOrigin<'_> {
        GroupOrigin { key: &self.key, stamp: &self.stamp, extent: Some(self.extent) }
    }

    fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String {
        key_of(stamp, setting, options, "")
    }

    fn measure(
        runs: &ErrorRuns,
        each: &mut dyn FnMut(&str),
    ) -> Result<(Self, Option<Measured>), ErrorRunError> {
        let measured = runs.measure(each)?;
        Ok((measured.result.clone(), Some(measured)))
    }

    fn methods(&self) -> Option<&GroupResult> {
        Some(self)
    }

    fn markdown(groups: &[Self]) -> String {
        markdown(groups)
    }

    fn reports(groups: &[Self]) -> Result<Vec<(String, String)>, String> {
        let mut all = vec![(".csv".to_owned(), csv(groups))];
        for (moving, motion) in [(false, "still"), (true, "moving")] {
            for (cost, name) in [(Cost::Rays, "rays"), (Cost::GpuMs, "ms")] {
                all.push((format!("-{motion}-{name}.svg"), curves(groups, moving, cost)?));
            }
        }
        Ok(all)
    }
}

impl Experiment for TableGroup {
    const PREFIX: &'static str = "table";
    const REPORT: &'static str = "table";

    fn setting(&self) -> Setting {
        self.setting()
    }

    fn origin(&self) -> GroupOrigin<'_> {
        self.result.origin()
    }

    fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String {
        key_of(stamp, setting, options, "")
    }

    fn measure(
        runs: &ErrorRuns,
        each: &mut dyn FnMut(&str),
    ) -> Result<(Self, Option<Measured>), ErrorRunError> {
        let measured = runs.measure(each)?;
        Ok((Self::new(runs.setting, measured.result.clone()), Some(measured)))
    }

    fn markdown(groups: &[Self]) -> String {
        table::markdown(groups)
    }
}

impl Experiment for SeenGroup {
    const PREFIX: &'static str = "seen";
    const REPORT: &'static str = "seen";

    fn setting(&self) -> Setting {
        self.setting()
    }

    fn origin(&self) -> GroupOrigin<'_> {
        GroupOrigin { key: &self.key, stamp: &self.stamp, extent: Some(self.extent) }
    }

    fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String {
        seen::key(stamp, setting, options)
    }

    fn measure(
        runs: &ErrorRuns,
        each: &mut dyn FnMut(&str),
    ) -> Result<(Self, Option<Measured>), ErrorRunError> {
        Ok((seen::measure(runs, each)?, None))
    }

    fn markdown(groups: &[Self]) -> String {
        seen::markdown(groups)
    }
}

impl Experiment for Figure3Group {
    const PREFIX: &'static str = "figure3";
    const REPORT: &'static str = "figure3";

    fn setting(&self) -> Setting {
        self.setting()
    }

    fn origin(&self) -> GroupOrigin<'_> {
        GroupOrigin { key: &self.key, stamp: &self.stamp, extent: None }
    }

    fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String {
        figure3::key(stamp, setting, options)
    }

    fn measure(
        runs: &ErrorRuns,
        each: &mut dyn FnMut(&str),
    ) -> Result<(Self, Option<Measured>), ErrorRunError> {
        Ok((figure3::measure(runs, each)?, None))
    }

    fn cost(setting: Setting, extent: SequenceExtent, methods: usize) -> u64 {
        2 * SPP.into_iter().map(|spp| cost(&format!("{spp} spp"), setting, extent, methods)).sum::<u64>()
    }

    fn markdown(groups: &[Self]) -> String {
        figure3::markdown(groups)
    }

    fn reports(groups: &[Self]) -> Result<Vec<(String, String)>, String> {
        Ok(vec![(".csv".to_owned(), figure3::csv(groups)), (".svg".to_owned(), plot::figure3(groups)?)])
    }
}

/// What the sequences of this name cost beside others, for the time that is left: sample frames, and as much for each frame as 3 samples
/// take.
fn cost(what: &str, setting: Setting, extent: SequenceExtent, methods: usize) -> u64 {
    let (frames, eye) = (f64::from(extent.warm_up + extent.kept), EYE_FRAMES as f64);
    let samples = setting.budget.max(1.0);
    let of = match what {
        "reference" => eye * f64::from(extent.reference_spp) / 2.0,
        "reference of every frame" => f64::from(extent.kept * extent.reference_spp),
        "times" => 40.0 * (samples + 3.0) * methods as f64,
        // About twice the samples, for the warm-up and the frames that the eye sees.
        what if what.ends_with(AT_EQUAL_TIME) => (f64::from(extent.warm_up) + eye) * (2.0 * samples + 3.0),
        what => match what.strip_suffix(" spp").and_then(|n| n.parse::<f64>().ok()) {
            Some(spp) => eye * (spp + 3.0),
            None => frames * (samples + 3.0),
        },
    };
    of as u64
}

/// Races of a group at most: one at equal rays, the others for equal time.
const MOST_RACES: u64 = 1 + RACES as u64;

/// Each method twice, the races, and each of the others twice at equal time, here and on every card.
fn cost_of_methods(setting: Setting, extent: SequenceExtent, methods: usize) -> u64 {
    let of = |what: &str| cost(what, setting, extent, methods);
    let others = contenders(&RenderConfig::default(), false).iter().filter(|c| is_other(c.name)).count();
    let times = (others * (1 + CardCosts::all().len())) as u64;
    2 * methods as u64 * of("") + MOST_RACES * of("times") + 2 * times * of(AT_EQUAL_TIME)
}

fn failure(error: ErrorRunError) -> Failure {
    match error {
        ErrorRunError::Render(e) => PipelineError::from(e).into(),
        other => Failure::new(FailureKind::BadInput, other),
    }
}

/// Measures the settings of `all` that are not measured yet, and reports the whole experiment, or shows the group that `--index` names.
///
/// # Errors
/// Bad rig or flags, no GPU, a folder that cannot be written.
pub(super) fn run<T: Experiment>(args: &ErrorArgs, all: &[Setting]) -> Result<(), Failure> {
    if args.list {
        return list(args, all.iter().map(|s| s.name()));
    }
    let groups = measure_all::<T>(args, &chosen(args, all)?)?;
    if args.index.is_some() {
        // One group of many is no report: those of the whole come from `merge`.
        show(&groups, args.json);
        return Ok(());
    }
    report(&folder(args), &groups, args.json)
}

/// Measures the settings of every rig file of a folder, each into a folder of its own, and reports all of them in one table.
///
/// # Errors
/// As [`run`]; no rig file lies in the folder.
pub(super) fn run_folder(args: &ErrorArgs, rigs: &Path, settings: &[Setting]) -> Result<(), Failure> {
    let files = rig_files(rigs)?;
    let name = |file: &Path| file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let of_rig = |file: &Path| {
        let mut own = args.clone();
        (own.rig, own.index) = (Some(file.to_owned()), None);
        own.flags.out = Some(folder(args).join(name(file)));
        own
    };
    if args.list {
        // A file that cannot be run is found now.
        files.iter().try_for_each(|file| of_rig(file).flags.rig_at_rest(Some(file)).map(|_| ()))?;
        return list_names(args, files.iter().map(|file| name(file)));
    }
    let mut measured = Vec::new();
    for file in chosen(args, &files)? {
        for group in measure_all::<GroupResult>(&of_rig(&file), settings)? {
            measured.push((name(&file), group));
        }
    }
    let groups: Vec<RigGroup<'_>> = measured.iter().map(|(rig, result)| RigGroup { rig, result }).collect();
    report_rigs(&folder(args), &groups, args.json, args.index.is_none())
}

/// Measures the settings that are not measured yet. All of them come back, in their order.
fn measure_all<T: Experiment>(args: &ErrorArgs, chosen: &[Setting]) -> Result<Vec<T>, Failure> {
    let out = folder(args);
    let (options, (gpu, rig)) = (options(args, &out), stage(args)?);
    let (extent, stamp) = (options.extent, Stamp::new(&rig, gpu.summary()));
    let methods = contenders(&rig.config.render, options.ablation).len();
    let of = |what: &str, setting| cost(what, setting, extent, methods);
    let total = |(k, &s): (usize, &Setting)| {
        let shared = chosen[..k].iter().any(|e| (e.look, e.moving) == (s.look, s.moving));
        let reference = if shared { 0 } else { 2 * of("reference", s) };
        let every = if s.moving { of("reference of every frame", s) } else { 0 };
        let measured = match known::<T>(&out, &s.name(), &T::key(&stamp, s, &options)) {
            Some(_) => 0,
            None => T::cost(s, extent, methods) + reference,
        };
        measured + if args.sequences { methods as u64 * of("", s) + every } else { 0 }
    };
    let totals: Vec<u64> = chosen.iter().enumerate().map(total).collect();
    let mut progress = WorkProgress::new(&totals);
    let mut groups: Vec<T> = Vec::new();
    for &setting in chosen {
        let name = setting.name();
        let runs = || {
            let own = rig_of(args, &rig.config, Some(rig.camera.raster))?;
            Ok::<_, Failure>(ErrorRuns::new(own, gpu.clone(), setting, options.clone()))
        };
        let mut each = |what: &str| progress.step(&format!("{name} {what}"), of(what, setting));
        let group = known_or(&out, &name, &T::key(&stamp, setting, &options), || {
            T::measure(&runs()?, &mut each).map_err(failure)
        })?;
        if let Some(result) = group.methods().filter(|_| args.sequences) {
            runs()?.export(result, &out.join("sequences").join(&name), &mut each).map_err(failure)?;
        }
        progress.end_of_part(&name);
        groups.push(group);
    }
    Ok(groups)
}
