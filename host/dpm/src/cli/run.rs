//! `dpm run RIG.toml` and `dpm demo`: run a rig from its file to light.

use super::rig_args::RigArgs;
#[cfg(feature = "lab")]
use super::watch::check_file;
use super::watch::{check_out, print, run_and_report, watch, write_text};
use crate::keep_parameters;
#[cfg(feature = "lab")]
use dpm_lab::film::{film, FilmRequest};
use dpm_rig::config::DEFAULT_PAGE;
use dpm_rig::failure::Failure;
use dpm_rig::own_run;
use dpm_rig::run_rig::run_rig;
use std::path::{Path, PathBuf};

/// Flags of `dpm run`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct RunArgs {
    /// The rig file
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    #[command(flatten)]
    flags: RigArgs,
    #[command(flatten)]
    page: PageArgs,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
}

/// Flags of `dpm demo`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct DemoArgs {
    #[command(flatten)]
    flags: RigArgs,
    #[command(flatten)]
    page: PageArgs,
    #[cfg(feature = "lab")]
    /// Also make a film of the room and of what the observer sees: a .gif, an animated .png, or a .webm. Four instants of it lie
    /// beside it
    #[arg(long, value_name = "FILE")]
    film: Option<PathBuf>,
    #[cfg(feature = "lab")]
    /// Length of the film
    #[arg(long, value_name = "S", default_value_t = 8.0, requires = "film")]
    film_seconds: f64,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
}

/// The flag of the live page.
#[derive(clap::Args, Clone, Debug)]
pub(super) struct PageArgs {
    /// Serve the live page, and metrics, at this address of this machine; 127.0.0.1:8947 if none is given
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, require_equals = true, default_missing_value = DEFAULT_PAGE)]
    page: Option<String>,
}

impl PageArgs {
    /// The rig's flags with this one.
    pub(super) fn with(&self, flags: &RigArgs) -> RigArgs {
        let mut flags = flags.clone();
        // Before `--set`, which overrides it.
        flags.set.splice(0..0, self.page.iter().map(|address| format!("page.listen={address:?}")));
        flags
    }
}

/// Runs a rig file.
///
/// # Errors
/// Bad rig file, scene or device.
pub(crate) fn execute(args: &RunArgs) -> Result<(), Failure> {
    start(Some(&args.rig), &args.page.with(&args.flags), args.json)
}

/// Runs the built-in demo.
///
/// # Errors
/// Bad flags, scene or device.
pub(crate) fn execute_demo(args: &DemoArgs) -> Result<(), Failure> {
    let flags = args.page.with(&args.flags);
    #[cfg(feature = "lab")]
    if let Some(path) = &args.film {
        flags.refuse("dpm demo --film", &["--frames", "--seconds"])?;
        check_file(path, "--film")?;
        let request = FilmRequest::new(path, args.film_seconds)?;
        let rig = request.rig(&flags.rig(None)?)?;
        return run_and_report(rig, args.json, move |rig, monitor| film(rig, &request, monitor));
    }
    start(None, &flags, args.json)
}

fn start(path: Option<&Path>, flags: &RigArgs, json: bool) -> Result<(), Failure> {
    let rig = flags.rig(path)?;
    if let Some(own) = own_run::of(&rig)? {
        check_out(flags.out.as_deref())?;
        let report = watch(rig, |rig, monitor| (own.run)(rig, monitor))?;
        let text = report.json() + "\n";
        print(&if json { text.clone() } else { report.table() });
        return flags.out.as_deref().map_or(Ok(()), |out| write_text(&out.join("report.json"), &text));
    }
    let saver = path.map_or_else(keep_parameters::no_file, |path| keep_parameters::saver(path.into()));
    run_and_report(rig, json, move |rig, monitor| {
        monitor.parameters().set_saver(saver);
        run_rig(rig, monitor)
    })
}
