//! `dpm black | freeze | safe | arm`: an order to a running rig.

use super::watch::print;
use dpm_common::unix::{user, user_name};
use dpm_rig::control::client::{tell, RigAnswer};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::order::Order;

/// Flags of the four commands.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct OrderArgs {
    /// Process of the rig; needed for freeze and arm if several rigs run
    #[arg(long, value_name = "N")]
    pid: Option<u32>,
}

/// Gives `order`. Prints the rigs that it reached with their answers, and those that it did not reach.
///
/// # Errors
/// No rig runs, several do, or a projector has not confirmed that it obeyed (exit code 3).
pub(super) fn execute(args: &OrderArgs, order: Order) -> Result<(), Failure> {
    let device = |e: &dyn std::fmt::Display| Failure::new(FailureKind::Device, e);
    let told = tell(args.pid, order).map_err(|e| device(&e))?;
    let mut text: String = told.answers.iter().map(line).collect();
    text.extend(told.refused.iter().map(|refused| format!("not reached: {refused}\n")));
    if order.is_dark() && args.pid.is_none() && !told.closed.is_empty() {
        let folders: Vec<_> = told.closed.iter().map(|f| f.display().to_string()).collect();
        text += &format!(
            "not searched, because they belong to other users: {}; root can reach all\n",
            folders.join(", ")
        );
    }
    print(&text);
    if told.is_done() {
        return Ok(());
    }
    let word = order.word();
    match told.answers.iter().find(|a| !a.done) {
        Some(a) => Err(device(&format!("{word} is not confirmed by process {}: {}", a.pid, a.text))),
        None => Err(device(&format!("{word} reached no rig of user {} or of a service", user_name(user())))),
    }
}

fn line(answer: &RigAnswer) -> String {
    let RigAnswer { pid, uid, rig, text, is_vouched_for, .. } = answer;
    let rig = if rig.is_empty() { "rig not told" } else { rig };
    let says = if *is_vouched_for { "" } else { "says (unverified): " };
    // The answer of another user's process could contain control characters.
    let line = format!("process {pid} of {}, {rig}: {says}{text}", user_name(*uid));
    line.chars().filter(|c| !c.is_control()).chain(['\n']).collect()
}
