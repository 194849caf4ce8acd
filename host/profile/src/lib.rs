//! `dpm profile`: a rig at its true rate into distributions, logs, trace and plots.

pub mod compare;
#[cfg(feature = "plots")]
mod histogram;
#[cfg(feature = "plots")]
pub mod plots;
#[cfg(feature = "plots")]
pub mod svg;
#[cfg(feature = "plots")]
mod v2log;

#[cfg(feature = "plots")]
use self::histogram::latency_histogram;
#[cfg(feature = "plots")]
use self::plots::percentiles;
#[cfg(feature = "plots")]
use self::v2log::write_v2_log;
use dpm_common::files::write_atomically;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Ended, Failure};
use dpm_rig::method_choice;
use dpm_rig::pipeline::{self, RunOptions, RunOutcome};
use dpm_rig::presence;
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::{cannot_write, check_output_folder, open_gpu, planes_offered, traced_raster};
use dpm_rig::telemetry::interval::Interval;
#[cfg(feature = "plots")]
use dpm_rig::telemetry::interval::IntervalKind;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::profile::ProfileReport;
use dpm_rig::telemetry::report::{to_json, Report, MODELLED};
use dpm_rig::telemetry::trace::write_trace;
use serde::Serialize;
use std::io::{Error, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
#[cfg(feature = "plots")]
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// What a profiling run found: the report of any run, and the distributions.
#[derive(Clone, Debug, Serialize)]
pub struct Profile {
    /// The keys of `dpm demo --json`.
    #[serde(flatten)]
    pub report: Report,
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
/// As [`dpm_rig::run_rig::run_rig`].
pub fn profile_rig(
    config: &RigConfig,
    prepared: bool,
    monitor: &Arc<RunMonitor>,
) -> Result<Ended<Profile>, Failure> {
    profile_with(config, prepared, monitor, Vec::new())
}

/// As [`profile_rig`], with notes for the report.
fn profile_with(
    config: &RigConfig,
    prepared: bool,
    monitor: &Arc<RunMonitor>,
    mut notes: Vec<String>,
) -> Result<Ended<Profile>, Failure> {
    check_output_folder(&config.output.dir)?;
    // As many slots, not frames: a rig that cannot keep its rate must not profile for minutes.
    let slots = if config.run.frames > 0 { config.run.frames } else { config.slots_to_run() };
    let options = RunOptions { slots, ..RunOptions::default() };
    let (ran, rig) = if prepared {
        let rig = Arc::new(Rig::build(config, None)?);
        (pipeline::run_prepared(rig.clone(), options, monitor), rig)
    } else {
        presence::look(config)?;
        let gpu = open_gpu(config)?;
        let mut rig = Rig::build(config, traced_raster(config, &gpu, &mut notes))?;
        method_choice::decide(&mut rig, &gpu);
        let rig = Arc::new(rig);
        (pipeline::run(rig.clone(), &gpu, options, monitor), rig)
    };
    let outcome = match ran {
        Ok(outcome) => outcome,
        Err(error) => {
            let Some((config, note)) = planes_offered(config, &error) else { return Err(error.into()) };
            return profile_with(&config, prepared, monitor, vec![note]);
        }
    };
    let mut profile = summary(&outcome, &rig, prepared);
    profile.report.warnings.splice(0..0, notes);
    let _writing = dpm_common::stopping::WritingFiles::begin();
    let saved = save(&mut profile, &outcome, &config.output.dir);
    let mut ended = Ended::from(profile);
    ended.keep(saved);
    Ok(ended)
}

fn summary(outcome: &RunOutcome, rig: &Rig, prepared: bool) -> Profile {
    let mut profile = outcome.profiler.report(&outcome.slots, &outcome.slot_batches, &outcome.standstills);
    let report = outcome.report.clone();
    profile.clock_error_bound_ns = report.projector.as_ref().and_then(|p| p.clock_bound_ns);
    profile.setup = [
        ("dpm", report.version.to_owned()),
        ("commit", report.commit.to_owned()),
        ("gpu", report.gpu.clone()),
        ("method", report.method.to_owned()),
        ("pace", report.pace.to_owned()),
        ("raster", format!("{} x {}", report.raster[0], report.raster[1])),
        ("planes", report.planes.to_string()),
        ("cores", dpm_common::realtime::os::usable_cores().to_string()),
        ("priority", rig.config.real_time.priority.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into();
    Profile {
        report,
        frames_torn: prepared.then_some(outcome.frames_torn),
        frames_reordered: outcome.frames_reordered,
        profile,
    }
}

/// Writes bytes somewhere.
type Fill<'a> = &'a mut dyn FnMut(&mut dyn Write) -> Result<(), Error>;

fn save(profile: &mut Profile, outcome: &RunOutcome, dir: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(dir).map_err(|e| cannot_write(dir, &e))?;
    #[cfg(feature = "plots")]
    let made = made(&profile.report, SystemTime::now());
    #[cfg(feature = "plots")]
    let length = Duration::from_secs_f64(profile.report.wall_s.max(0.0));
    let mut put = |name: &str, write: Fill<'_>| {
        let path: PathBuf = dir.join(name);
        write_atomically(&path, |mut out| write(&mut out)).map_err(|e| cannot_write(&path, &e))?;
        profile.report.files.push(path);
        Ok::<(), Failure>(())
    };
    put("trace.json", &mut |out| write_trace(out, &outcome.traced, &outcome.standstills))?;
    #[cfg(feature = "plots")]
    save_plots(outcome, dir, length, &made, &mut put)?;
    let text = to_json(&profile.profile);
    put("profile.json", &mut |out| out.write_all(text.as_bytes()))
}

/// The log of HdrHistogram and the plots.
#[cfg(feature = "plots")]
fn save_plots(
    outcome: &RunOutcome,
    dir: &Path,
    length: Duration,
    made: &str,
    put: &mut dyn FnMut(&str, Fill<'_>) -> Result<(), Failure>,
) -> Result<(), Failure> {
    put("profile.hlog", &mut |mut out| write_v2_log(&mut out, &outcome.profiler, length))?;
    for (name, kind) in [
        ("work.svg", IntervalKind::Work),
        ("waits.svg", IntervalKind::Wait),
        ("latency.svg", IntervalKind::Total),
    ] {
        let svg =
            percentiles(&outcome.profiler, kind, made).map_err(|e| cannot_write(&dir.join(name), &e))?;
        put(name, &mut |out| out.write_all(svg.as_bytes()))?;
    }
    let path = dir.join("histogram.svg");
    let svg = latency_histogram(&outcome.profiler, made).map_err(|e| cannot_write(&path, &e))?;
    put("histogram.svg", &mut |out| out.write_all(svg.as_bytes()))
}

/// What ran, when and with which program, for the titles of plots.
#[cfg(feature = "plots")]
fn made(report: &Report, now: SystemTime) -> String {
    let seconds = now.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let (year, month, day) = civil(seconds / 86_400);
    format!(
        "{} x {}, {} planes, {:.3} frames/s, {} pace, GPU {}; dpm {}, commit {}; {year:04}-{month:02}-{day:02}",
        report.raster[0],
        report.raster[1],
        report.planes,
        report.frame_rate_hz,
        report.pace,
        report.gpu,
        report.version,
        report.commit
    )
}

/// Days since 1970-01-01 as a date of the Gregorian calendar, UTC.
pub fn civil(days: u64) -> (u64, u64, u64) {
    // Counted from 0000-03-01, so that a leap day is the last of its year, in cycles of 400 years of 146,097 days [Hinnant].
    let z = days + 719_468;
    let (era, of_era) = (z / 146_097, z % 146_097);
    let year = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let day = of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    (year + 400 * era + u64::from(month <= 2), month, day)
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
            "{:<22} {:<5} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
            "interval, ms", "kind", "min", "p50", "p90", "p99", "p99.9", "p99.99", "max"
        );
        let mut has_modelled = false;
        for interval in Interval::ALL {
            let Some(d) = p.intervals_ms.get(interval.name()).filter(|d| d.count > 0) else { continue };
            has_modelled |= d.modelled;
            let name = interval.name().to_owned() + if d.modelled { " *" } else { "" };
            let _ = writeln!(
                out,
                "{name:<22} {:<5} {:>8.4} {:>8.4} {:>8.4} {:>8.4} {:>8.4} {:>8.4} {:>8.4}",
                d.kind, d.min, d.p50, d.p90, d.p99, d.p999, d.p9999, d.max
            );
        }
        if has_modelled {
            let source = if self.report.pace == "virtual" {
                MODELLED
            } else {
                "a constant of the mock tracker, not measured; the times from motion on contain it"
            };
            let _ = writeln!(out, "* {source}");
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (days, date) in [
            (0, (1970, 1, 1)),
            (59, (1970, 3, 1)),
            (10_957, (2000, 1, 1)),
            (11_016, (2000, 2, 29)),
            (11_017, (2000, 3, 1)),
            (20_779, (2026, 11, 22)),
        ] {
            assert_eq!(civil(days), date);
        }
    }
}

#[cfg(test)]
mod fixture {
    use dpm_device::time::HostTime;
    use dpm_rig::frame::FrameTimeline;

    /// A frame whose stamps are `step` ns apart, but packing, which begins in the middle of its step. Packing worked for half of its step, the
    /// link for a quarter. The light lasts for a step, with its centre after a quarter.
    pub(super) fn frame(start: i64, step: i64) -> FrameTimeline {
        let at = |k: i64| HostTime(start + k * step);
        let mut t = FrameTimeline {
            captured_at: at(0),
            received_at: at(1),
            latched_at: at(2),
            submitted_at: at(3),
            rendered_at: at(4),
            packing_at: at(4).plus_ns(step / 2),
            packed_at: at(5),
            sent_at: at(6),
            due_at: at(7),
            lit_at: Some(at(8)),
            centre_at: Some(at(8).plus_ns(step / 4)),
            last_photon_at: Some(at(9)),
            ..FrameTimeline::default()
        };
        (t.wall_ns[2], t.wall_ns[3]) = ((step / 2).unsigned_abs(), (step / 4).unsigned_abs());
        t
    }
}
