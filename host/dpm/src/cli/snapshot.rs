//! `dpm snapshot RIG.toml`: everything that one frame was made from, as pictures.

use super::rig_args::RigArgs;
use super::watch::print;
use dpm_lab::snapshot::{snapshot, SnapshotImage};
use dpm_rig::failure::Failure;
use dpm_rig::telemetry::report::to_json;
use std::path::PathBuf;

/// Flags of `dpm snapshot`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct SnapshotArgs {
    /// The rig file; default: the built-in demo
    #[arg(value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Number of the frame; the frames before it are also played, so that histories settle
    #[arg(long, value_name = "N", default_value_t = 32)]
    frame: u32,
    /// Pictures to write, separated by commas; default: all that the method has
    #[arg(long, value_name = "NAME", value_enum, value_delimiter = ',')]
    what: Vec<SnapshotImage>,
    /// Print the list of files as one JSON object
    #[arg(long)]
    json: bool,
}

/// Writes the pictures.
///
/// # Errors
/// Bad rig file or scene, no GPU.
pub(super) fn execute(args: &SnapshotArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm snapshot", &["--frames", "--seconds", "--no-prediction"])?;
    let rig = args.flags.rig_at_rest(args.rig.as_deref())?;
    let dir = args.flags.out.clone().unwrap_or_else(|| rig.output.dir.join("snapshot"));
    let report = snapshot(&rig, args.frame, &args.what, &dir)?;
    if args.json {
        print(&(to_json(&report) + "\n"));
        return Ok(());
    }
    let [width, height] = report.raster;
    let mut text = format!("method {}, frame {}, {width} x {height}\n", report.method, report.frame);
    report.warnings.iter().for_each(|w| text += &format!("note: {w}\n"));
    report.files.iter().for_each(|f| text += &format!("{}\n", f.display()));
    report.not_made.iter().for_each(|n| text += &format!("no {}: {}\n", n.image, n.why));
    print(&text);
    Ok(())
}
