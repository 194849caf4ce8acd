//! `dpm set`: shows the parameters of a running rig, changes them, takes changes back and saves them.

use super::watch::print;
use dpm_rig::control::change::{change, ChangeError};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::parameters::ParameterCommand;

/// Flags of `dpm set`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct SetArgs {
    /// Parameters and their values, for example exposure=1.5 or body.bunny=2,0,0,0,0,0.5; without any all are shown
    #[arg(value_name = "NAME=VALUE")]
    changes: Vec<String>,
    /// Take the last change back; comes before all others
    #[arg(long)]
    undo: bool,
    /// Keep the values for the next run: in the rig file and in the calibration file; comes after all others
    #[arg(long)]
    save: bool,
    /// Process of the rig; needed if several rigs run
    #[arg(long, value_name = "N")]
    pid: Option<u32>,
}

/// Does what the flags say, one after the other, and prints the rig's answers. The first refusal ends it.
///
/// # Errors
/// A value that the rig refuses (exit code 2), no rig, or no confirmation (3).
pub(crate) fn execute(args: &SetArgs) -> Result<(), Failure> {
    let failed = |e: ChangeError| {
        let kind = match e {
            ChangeError::Refused(_) | ChangeError::Several { .. } => FailureKind::BadInput,
            _ => FailureKind::Device,
        };
        Failure::new(kind, e)
    };
    let mut commands: Vec<ParameterCommand> =
        args.undo.then_some(ParameterCommand::Undo).into_iter().collect();
    for text in &args.changes {
        commands
            .push(ParameterCommand::parse_change(text).map_err(|e| Failure::new(FailureKind::BadInput, e))?);
    }
    commands.extend(args.save.then_some(ParameterCommand::Save));
    if commands.is_empty() {
        commands.push(ParameterCommand::List);
    }
    for command in &commands {
        print(&(change(args.pid, command).map_err(failed)? + "\n"));
    }
    Ok(())
}
