//! `dpm page`: prints the link for orders to the page of a running rig, after the rig has proven that it is one.

use super::watch::print;
use dpm_page::probe::is_rig;
use dpm_page::rigs::RigAddress;
use dpm_page::token::{file, Token};
use dpm_rig::config::DEFAULT_PAGE;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::standing::state_folder;

/// Flags of `dpm page`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct PageArgs {
    /// Where the rig's page listens on this machine: HOST:PORT
    #[arg(value_name = "ADDRESS", default_value = DEFAULT_PAGE)]
    address: RigAddress,
}

/// Prints the link.
///
/// # Errors
/// There is no key for that port (exit code 2), nobody answers (3), or what answers is not the rig (1).
pub(crate) fn execute(args: &PageArgs) -> Result<(), Failure> {
    let address = args.address.address();
    let bad = |told: String| Failure::new(FailureKind::BadInput, told);
    let folder =
        state_folder().ok_or_else(|| bad("there is no state folder; name one by DPM_STATE_DIR".into()))?;
    let token = Token::read_in(&folder, address.port()).ok_or_else(|| {
        let path = folder.join(file(address.port()));
        bad(format!(
            "{} cannot be read: no rig of this user has had its page on this port; is it another user's (sudo dpm page), or another port?",
            path.display()
        ))
    })?;
    let is_rig = is_rig(address, &token).map_err(|e| {
        Failure::new(
            FailureKind::Device,
            format!("{address}: no answer: {e}; does the rig run, with --page?"),
        )
    })?;
    if !is_rig {
        let told = format!(
            "what listens on {address} is not the rig: it does not have the rig's key. No link is printed, because opening it would give \
             the key away. Find out which program that is (ss -ltnp)"
        );
        return Err(Failure::new(FailureKind::CheckFailed, told));
    }
    print(&format!("http://{address}/#key={}\n", token.as_str()));
    Ok(())
}
