//! `dpm profile`: where the time between motion and light goes, and whether it improved.

use super::rig_args::RigArgs;
use super::run::PageArgs;
use super::watch::{print, watch};
use dpm_device::regular_file;
use dpm_profile::compare::{compare, failed_gates, to_table};
use dpm_profile::profile_rig;
use dpm_rig::failure::{Ended, Failure, FailureKind};
use dpm_rig::telemetry::profile::ProfileReport;
use std::path::{Path, PathBuf};

/// Length of a profile without `--seconds` or `--frames`, s.
const SECONDS: f64 = 10.0;

/// Largest profile.json that is read, bytes; a usual one has some tens of thousands.
const MAX_PROFILE_BYTES: u64 = 64 << 20;

/// Flags of `dpm profile`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct ProfileArgs {
    /// The rig file; default: the built-in demo
    #[arg(value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Use prepared frames instead of rendered ones: measures hand-offs, packing and link at the true rate, without a
    /// GPU
    #[arg(long)]
    no_render: bool,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    page: PageArgs,
    /// Compare two profile.json files instead of running: shows what improved or got worse, and whether beyond the
    /// noise. Exit code 1 if the share of missed slots or late frames grew by more than the noise
    #[arg(long, num_args = 2, value_names = ["A.json", "B.json"], conflicts_with_all = ["rig", "no_render", "page"])]
    compare: Vec<PathBuf>,
}

/// Profiles a rig, or compares two profiles.
///
/// # Errors
/// Bad rig file, scene, address or profile; a device that fails; torn frames; a comparison in which a gate got worse.
pub(super) fn execute(args: &ProfileArgs) -> Result<(), Failure> {
    if let [before, after] = args.compare.as_slice() {
        let (rows, notes) = compare(&read(before)?, &read(after)?);
        print(&to_table(&rows, &notes));
        let failed = failed_gates(&rows);
        if !failed.is_empty() {
            let told = format!(
                "{} got worse by more than noise: {} against {}",
                failed.join(" and "),
                after.display(),
                before.display()
            );
            return Err(Failure::new(FailureKind::CheckFailed, told));
        }
        return Ok(());
    }
    let mut flags = args.page.with(&args.flags);
    // Inserted first, so that an explicit --set overrides it.
    flags.set.splice(0..0, ["output.images=false".into(), "output.trace=true".into()]);
    flags.pace.get_or_insert_with(|| "real".into());
    flags.out.get_or_insert_with(|| "out/profile".into());
    if flags.frames.is_none() {
        flags.seconds.get_or_insert(SECONDS);
    }
    let rig = flags.rig(args.rig.as_deref())?;
    let prepared = args.no_render;
    let Ended { report: profile, failure } =
        watch(rig, move |rig, monitor| profile_rig(rig, prepared, monitor))?;
    print(&if args.json { profile.to_json() + "\n" } else { profile.to_table() });
    if profile.frames_torn.unwrap_or(0) + profile.frames_reordered > 0 {
        let told = format!(
            "{} lit frames contained parts of another frame and {} came out of order",
            profile.frames_torn.unwrap_or(0),
            profile.frames_reordered
        );
        return Err(Failure::new(FailureKind::CheckFailed, told));
    }
    failure.map_or(Ok(()), Err)?;
    profile.report.check_lit()
}

fn read(path: &Path) -> Result<ProfileReport, Failure> {
    let refuse = |e: &dyn std::fmt::Display| {
        Failure::new(
            FailureKind::BadInput,
            format!("{}: not a profile.json of dpm profile: {e}", path.display()),
        )
    };
    let text = regular_file::read_text(path, MAX_PROFILE_BYTES).map_err(|e| {
        let told =
            format!("{}: cannot read it: {e}; give two files profile.json of dpm profile", path.display());
        Failure::new(FailureKind::BadInput, told)
    })?;
    serde_json::from_str(&text).map_err(|e| refuse(&e))
}
