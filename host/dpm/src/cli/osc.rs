//! Opens the OSC socket of a run, and tells the operator where it is.

use super::tell::Teller;
use dpm_rig::config::RigConfig;
use dpm_rig::control::orders::Orders;
use dpm_rig::control::osc::OscSocket;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;

/// Opens the socket if the rig wants one. Without it the run goes on.
pub(super) fn open(
    rig: &RigConfig,
    monitor: &Arc<RunMonitor>,
    orders: &Arc<Orders>,
    teller: &Teller,
) -> Option<OscSocket> {
    let address = rig.osc.address()?;
    match OscSocket::serve(address, rig.osc.senders(), rig.osc.token.clone(), monitor.clone(), orders.clone())
    {
        Ok(socket) => {
            let may = match rig.osc.token {
                Some(_) => "it takes no ARM, and without the token only BLACK and SAFE",
                None => "it only makes dark, because the rig file has no osc.token",
            };
            teller.note(&format!("osc: udp {}; {may}", socket.address()));
            Some(socket)
        }
        Err(e) => {
            teller.note(&format!(
                "no OSC: cannot listen on {address}: {e}; choose another port with osc.listen"
            ));
            None
        }
    }
}
