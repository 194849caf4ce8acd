//! `dpm profile`: a rig at its true rate into distributions, logs, trace and plots.

use super::run_rig::{cannot_write, open_gpu, traced_raster};
use crate::config::RigConfig;
use crate::failure::Failure;
use crate::files::write_atomically;
use crate::pipeline::{self, RunOptions, RunOutcome};
use crate::plan::slots::MissCause;
use crate::rig::Rig;
use crate::telemetry::interval::IntervalKind;
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::plots::percentiles;
use crate::telemetry::profile::ProfileReport;
use crate::telemetry::report::{to_json, Report};
use crate::telemetry::trace::write_trace;
use crate::telemetry::v2log::write_v2_log;
use serde::Serialize;
use std::io::{Error, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// What a profiling run found: the report of any run, and the distributions.
#[derive(Clone, Debug, Serialize)]
pub struct Profile {
    /// The keys of `dpm demo --json`.
    #[serde(flatten)]
    pub report: Report,
    /// Slots from the first lit frame to the last planned one.
    pub slots: u64,
    /// Slots without a frame of their own for which the machine's standstills are no excuse.
    pub late_slots: u64,
    /// `late_slots` as a share of all.
    pub late_share: f64,
    /// Lit frames with parts of another frame: looked for in prepared frames, `None` otherwise.
    pub frames_torn: Option<u64>,
    /// Frames lit after a newer one, or twice.
    pub frames_reordered: u64,
    /// Distributions, misses by cause, standstills.
    pub profile: ProfileReport,
}

/// Runs the rig at its pace and writes `profile.json`, `profile.hlog`, `trace.json` and plots into the output folder;
/// `prepared`: with frames prepared ahead instead of rendered ones, and no GPU.
///
/// # Errors
/// As [`super::run_rig::run_rig`].
pub fn profile_rig(
    config: &RigConfig,
    prepared: bool,
    monitor: &Arc<RunMonitor>,
) -> Result<Profile, Failure> {
    // As many slots, not frames: a rig that cannot keep its rate must not profile for minutes.
    let options = RunOptions { slots: config.run.frames, ..RunOptions::default() };
    let (outcome, notes, rig) = if prepared {
        let rig = Arc::new(Rig::build(config, None)?);
        (pipeline::run_prepared(rig.clone(), options, monitor)?, Vec::new(), rig)
    } else {
        let gpu = open_gpu(config)?;
        let mut notes = Vec::new();
        let rig = Arc::new(Rig::build(config, traced_raster(config, &gpu, &mut notes))?);
        (pipeline::run(rig.clone(), &gpu, options, monitor)?, notes, rig)
    };
    let mut profile = summary(&outcome, &rig, prepared);
    profile.report.warnings.splice(0..0, notes);
    let _writing = crate::stopping::WritingFiles::begin();
    save(&mut profile, &outcome, &config.output.dir)?;
    Ok(profile)
}

fn summary(outcome: &RunOutcome, rig: &Rig, prepared: bool) -> Profile {
    let mut profile = outcome.profiler.report(&outcome.standstills);
    let report = outcome.report.clone();
    profile.setup = [
        ("dpm", report.version.to_owned()),
        ("gpu", report.gpu.clone()),
        ("method", report.method.to_owned()),
        ("pace", report.pace.to_owned()),
        ("raster", format!("{} x {}", report.raster[0], report.raster[1])),
        ("planes", report.planes.to_string()),
        ("cores", crate::realtime::os::usable_cores().to_string()),
        ("priority", rig.config.real_time.priority.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into();
    let slots = outcome.slots;
    let late_slots = slots.missed_total() - slots.missed[MissCause::Standstill as usize];
    Profile {
        report,
        slots: slots.slots,
        late_slots,
        late_share: late_slots as f64 / slots.slots.max(1) as f64,
        frames_torn: prepared.then_some(outcome.frames_torn),
        frames_reordered: outcome.frames_reordered,
        profile,
    }
}

fn save(profile: &mut Profile, outcome: &RunOutcome, dir: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(dir).map_err(|e| cannot_write(dir, &e))?;
    let length = Duration::from_secs_f64(profile.report.wall_s.max(0.0));
    let mut put = |name: &str, write: &mut dyn FnMut(&mut dyn Write) -> Result<(), Error>| {
        let path: PathBuf = dir.join(name);
        write_atomically(&path, |mut out| write(&mut out)).map_err(|e| cannot_write(&path, &e))?;
        profile.report.files.push(path);
        Ok::<(), Failure>(())
    };
    put("profile.hlog", &mut |mut out| write_v2_log(&mut out, &outcome.profiler, length))?;
    put("trace.json", &mut |out| write_trace(out, &outcome.traced, &outcome.standstills))?;
    for (name, kind) in [
        ("work.svg", IntervalKind::Work),
        ("waits.svg", IntervalKind::Wait),
        ("latency.svg", IntervalKind::Total),
    ] {
        let svg = percentiles(&outcome.profiler, kind).map_err(|e| cannot_write(&dir.join(name), &e))?;
        put(name, &mut |out| out.write_all(svg.as_bytes()))?;
    }
    let text = to_json(&profile.profile);
    put("profile.json", &mut |out| out.write_all(text.as_bytes()))
}

impl Profile {
    /// The profile as one JSON object.
    pub fn to_json(&self) -> String {
        to_json(self)
    }

    /// The profile as text of at most 100 columns.
    pub fn to_table(&self) -> String {
        use std::fmt::Write as _;
        let mut out = self.report.to_table();
        // Writing into a string cannot fail.
        let p = &self.profile;
        let causes: Vec<String> =
            p.missed.iter().filter(|(_, n)| **n > 0).map(|(cause, n)| format!("{cause} {n}")).collect();
        let _ = writeln!(
            out,
            "slots: {}, late {} ({:.3} %), by cause: {}",
            self.slots,
            self.late_slots,
            100.0 * self.late_share,
            if causes.is_empty() { "none".into() } else { causes.join(", ") }
        );
        let (total, longest) = p.standstill_ns;
        let _ = writeln!(
            out,
            "machine stood still: {:.1} ms, longest {:.1} ms; torn {}, out of order {}",
            total as f64 * 1e-6,
            longest as f64 * 1e-6,
            self.frames_torn.map_or("not looked for".into(), |n| n.to_string()),
            self.frames_reordered
        );
        let _ = writeln!(
            out,
            "{:<16} {:<5} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "interval, ms", "kind", "p50", "p90", "p99", "p99.9", "p99.99", "max"
        );
        for (name, d) in &p.intervals_ms {
            let _ = writeln!(
                out,
                "{name:<16} {:<5} {:>9.4} {:>9.4} {:>9.4} {:>9.4} {:>9.4} {:>9.4}",
                d.kind, d.p50, d.p90, d.p99, d.p999, d.p9999, d.max
            );
        }
        out
    }
}
