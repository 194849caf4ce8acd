//! What a program without the live page says of it.

use super::tell::Teller;
use dpm_rig::config::RigConfig;
use dpm_rig::control::orders::Orders;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;

/// Says that there is none, if the rig wants one.
pub(super) fn open(rig: &RigConfig, _monitor: &Arc<RunMonitor>, _orders: &Arc<Orders>, teller: &Teller) {
    if rig.page.address().is_some() {
        teller.note("no page: this program was built without its feature \"page\"");
    }
}
