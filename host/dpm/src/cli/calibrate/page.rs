//! `dpm calibrate page`: the guided page of a rig that does not run.

use crate::cli::guide::RigGuide;
use crate::cli::live_page::{link, token, PageLink};
use crate::cli::rig_args::RigArgs;
use dpm_common::signals;
use dpm_page::{Page, Settings};
use dpm_rig::config::DEFAULT_PAGE;
use dpm_rig::failure::{Failure, FailureKind};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

#[derive(clap::Args, Clone, Debug)]
pub(super) struct GuideArgs {
    /// The rig file
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    /// Where to serve the page, an address of this machine; default: page.listen of the rig file, or 127.0.0.1:8947
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<SocketAddr>,
    /// Set a key of the rig file, for every step as well; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl GuideArgs {
    /// Serves the page until the program is asked to end.
    ///
    /// # Errors
    /// A bad rig file, or an address that cannot be listened on (exit code 2).
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let args = RigArgs { set: self.set.clone(), ..RigArgs::default() };
        let config = args.rig_to_calibrate(&self.rig)?;
        let usual = || DEFAULT_PAGE.parse().ok();
        let address = self.listen.or_else(|| config.page.address()).or_else(usual);
        let bad = |told: String| Failure::new(FailureKind::BadInput, told);
        let address = address.ok_or_else(|| bad("--listen: name an address with a port".into()))?;
        let token = token(address.port());
        let settings = Settings {
            address,
            hosts: config.page.hosts.clone(),
            token: token.as_ref().ok().map(|(token, _)| token.clone()),
            guide: Arc::new(RigGuide::at_rest(&config, &self.set)),
        };
        signals::install()
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot handle signals: {e}")))?;
        let page = Page::serve_calibration(settings).map_err(|e| bad(e.to_string()))?;
        let (PageLink::Secret(told) | PageLink::Open(told)) = link(page.address(), token);
        eprintln!("{told}");
        eprintln!("Nothing is lit before you start a step there. Ctrl-C ends the page and the step.");
        signals::wait();
        Ok(())
    }
}
