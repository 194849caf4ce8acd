//! `dpm completions` and `dpm man`: what the command line says of itself, for shells and for `man`.

use super::watch::print;
use clap_complete::Shell;
use dpm_rig::failure::{Failure, FailureKind};
use std::path::{Path, PathBuf};

/// Arguments of `dpm completions`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct CompletionsArgs {
    /// The shell that reads them
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

/// Arguments of `dpm man`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct ManArgs {
    /// Folder for the pages; made if it does not exist
    #[arg(value_name = "DIR")]
    dir: PathBuf,
}

/// Prints the completions of a shell.
///
/// # Errors
/// None: a reader that goes away is no error.
pub(super) fn completions(args: &CompletionsArgs) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut super::command(), "dpm", &mut script);
    print(&String::from_utf8_lossy(&script));
    Ok(())
}

/// Writes a page for the program and one for each of its commands.
///
/// # Errors
/// The folder or a page cannot be written.
pub(super) fn man(args: &ManArgs) -> Result<(), Failure> {
    let failed = |path: &Path, e: &std::io::Error| {
        let told = format!("cannot write the man pages to {}: {e}", path.display());
        Failure::new(FailureKind::BadInput, told)
    };
    std::fs::create_dir_all(&args.dir).map_err(|e| failed(&args.dir, &e))?;
    // `dpm help run` needs no page of its own.
    let command = super::command().disable_help_subcommand(true);
    clap_mangen::generate_to(command, &args.dir).map_err(|e| failed(&args.dir, &e))
}
