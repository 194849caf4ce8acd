//! Opens the live page of a run, and tells the operator where it is.

use super::guide::RigGuide;
use super::tell::Teller;
use dpm_page::token::Token;
use dpm_page::{Page, Settings};
use dpm_rig::config::RigConfig;
use dpm_rig::control::orders::Orders;
use dpm_rig::standing::state_folder;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

/// Opens the page if the rig wants one. Without it the run goes on.
pub(super) fn open(
    rig: &RigConfig,
    monitor: &Arc<RunMonitor>,
    orders: &Arc<Orders>,
    teller: &Teller,
) -> Option<Page> {
    let address = rig.page.address()?;
    let token = token(address.port());
    let settings = Settings {
        address,
        hosts: rig.page.hosts.clone(),
        token: token.as_ref().ok().map(|(token, _)| token.clone()),
        guide: Arc::new(RigGuide::of_run(rig)),
    };
    let page = match Page::serve(settings, monitor.clone(), orders.clone(), teller.kept()) {
        Ok(page) => page,
        Err(e) => {
            teller.note(&format!("no page: {e}"));
            return None;
        }
    };
    match link(page.address(), token) {
        PageLink::Secret(told) => teller.whisper(&told),
        PageLink::Open(told) => teller.note(&told),
    }
    Some(page)
}

/// The token for the page at `port` that is kept in the state folder, and its file; or why there is none.
pub(super) fn token(port: u16) -> Result<(Token, PathBuf), String> {
    let folder = state_folder().ok_or("there is no state folder; name one by DPM_STATE_DIR")?;
    Token::kept_in(&folder, port).map_err(|e| e.to_string())
}

/// Where a page is, in words for the operator.
pub(super) enum PageLink {
    /// With the token: for a terminal.
    Secret(String),
    /// Without it.
    Open(String),
}

/// Tells where the page at `address` is. A log is read by more people than a terminal, so only there the token is told.
pub(super) fn link(address: SocketAddr, token: Result<(Token, PathBuf), String>) -> PageLink {
    let link = format!("http://{address}/");
    match token {
        Ok((token, _)) if std::io::stderr().is_terminal() => {
            PageLink::Secret(format!("page: {link}#key={}", token.as_str()))
        }
        Ok((_, path)) => PageLink::Open(format!(
            "page: {link}; for orders, `dpm page {address}` prints a link (the key is in {})",
            path.display()
        )),
        Err(why) => PageLink::Open(format!("page: {link}, without orders: {why}")),
    }
}
