//! `dpm scene export`: the room of a rig as a file for other programs.

use super::rig_args::RigArgs;
use super::watch::{check_file, print};
use dpm_lab::room::export::export;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::cannot_write;
use std::path::PathBuf;

/// Flags of `dpm scene`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct SceneArgs {
    #[command(subcommand)]
    what: SceneCommand,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum SceneCommand {
    /// Write projector, cone, observer, bodies and the space in which they move as binary glTF 2.0 (.glb)
    Export(ExportArgs),
}

/// Flags of `dpm scene export`.
#[derive(clap::Args, Clone, Debug)]
struct ExportArgs {
    /// The file
    #[arg(value_name = "FILE.glb")]
    file: PathBuf,
    /// The rig; default: the built-in demo
    #[arg(long, value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
}

/// A run of this length says where the bodies move.
const LENGTH_NS: i64 = 10_000_000_000;

/// Writes the file.
///
/// # Errors
/// A bad rig file or scene, a file that cannot be written.
pub(super) fn execute(args: &SceneArgs) -> Result<(), Failure> {
    let SceneCommand::Export(args) = &args.what;
    args.flags.refuse("dpm scene export", &["--frames", "--seconds", "--no-prediction"])?;
    if args.file.extension().is_none_or(|end| !end.eq_ignore_ascii_case("glb")) {
        let told = format!("{}: the file is binary glTF, so its name ends in .glb", args.file.display());
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    check_file(&args.file, "FILE.glb")?;
    let rig = Rig::build(&args.flags.rig_at_rest(args.rig.as_deref())?, None)?;
    export(&rig, LENGTH_NS, &args.file).map_err(|e| cannot_write(&args.file, &e))?;
    print(&format!("{}\n", args.file.display()));
    Ok(())
}
