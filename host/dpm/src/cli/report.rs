//! `dpm report DIR`: the folder of a run or a measurement into a page that can be handed on.

use super::watch::print;
use dpm_lab::report::report;
use dpm_rig::failure::Failure;
use dpm_rig::telemetry::report::to_json;
use std::path::PathBuf;

/// Flags of `dpm report`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct ReportArgs {
    /// The folder that --out of `dpm run`, `profile`, `bench`, `plan` or `error` named
    #[arg(value_name = "DIR")]
    dir: PathBuf,
    /// Folder for report.html and the tables as CSV; default: DIR itself
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Title of the page; default: what was measured, and the name of the folder
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// Print the list of files as one JSON object
    #[arg(long)]
    json: bool,
}

/// Writes the page and the tables.
///
/// # Errors
/// A folder without results, or one that cannot be written.
pub(super) fn execute(args: &ReportArgs) -> Result<(), Failure> {
    let out = args.out.as_ref().unwrap_or(&args.dir);
    let files = report(&args.dir, out, args.title.as_deref())?;
    if args.json {
        print(&(to_json(&files) + "\n"));
        return Ok(());
    }
    let mut text: String = files.notes.iter().map(|note| format!("note: {note}\n")).collect();
    for file in std::iter::once(&files.page).chain(&files.tables) {
        text += &format!("{}\n", file.display());
    }
    print(&text);
    Ok(())
}
