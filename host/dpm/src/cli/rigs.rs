//! `dpm rigs`: serves the overview of several rigs until it is asked to end.

use dpm_common::signals;
use dpm_page::rigs::{RigAddress, Rigs, DEFAULT_LISTEN};
use dpm_page::Page;
use dpm_rig::failure::{Failure, FailureKind};
use std::net::SocketAddr;

/// Flags of `dpm rigs`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct RigsArgs {
    /// The page of a rig, or the tunnel to it: HOST:PORT or NAME=HOST:PORT
    #[arg(value_name = "ADDRESS", required = true)]
    rigs: Vec<RigAddress>,
    /// Where to serve the overview, an address of this machine
    #[arg(long, value_name = "ADDRESS", default_value = DEFAULT_LISTEN)]
    listen: SocketAddr,
}

/// Serves the overview until the program is asked to end.
///
/// # Errors
/// Too many rigs, one that is named twice, or an address that cannot be listened on (exit code 2).
pub(crate) fn execute(args: &RigsArgs) -> Result<(), Failure> {
    let bad = |told: String| Failure::new(FailureKind::BadInput, told);
    if let Some(rig) = args.rigs.iter().find(|rig| rig.address() == args.listen) {
        return Err(bad(format!(
            "--listen {}: this is the address of the rig {:?}",
            args.listen,
            rig.name()
        )));
    }
    let rigs = Rigs::new(args.rigs.clone()).map_err(|e| bad(e.to_string()))?;
    signals::install()
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot handle signals: {e}")))?;
    let page = Page::serve_rigs(args.listen, rigs).map_err(|e| bad(e.to_string()))?;
    eprintln!(
        "page: http://{}/ shows {} rigs, without orders. Ctrl-C ends it.",
        page.address(),
        args.rigs.len()
    );
    signals::wait();
    Ok(())
}
