//! `dpm black | freeze | safe | arm`: a word to a rig that runs.

use super::watch::print;
use crate::control::{runtime_folder, tell};
use crate::failure::{Failure, FailureKind};
use crate::telemetry::monitor::Order;

/// Flags of the four commands.
#[derive(clap::Args, Clone, Debug)]
pub struct OrderArgs {
    /// Process of the rig; needed for freeze and arm when several run
    #[arg(long, value_name = "N")]
    pid: Option<u32>,
}

/// Gives `order` and prints the answers.
///
/// # Errors
/// No rig runs, several do, or the projector has not obeyed within half a second.
pub fn execute(args: &OrderArgs, order: Order) -> Result<(), Failure> {
    let device = |e: &dyn std::fmt::Display| Failure::new(FailureKind::Device, e);
    let answers = tell(&runtime_folder(), args.pid, order).map_err(|e| device(&e))?;
    for answer in &answers {
        print(&format!("process {}: {}\n", answer.id, answer.text));
    }
    match answers.iter().find(|a| !a.obeyed) {
        Some(a) => Err(device(&format!("{} has not taken effect in process {}", order.word(), a.id))),
        None => Ok(()),
    }
}
