//! What is answered to an order, and when: after the projector has obeyed and the disk has it, or when waiting any
//! longer would help nobody.

pub use super::is_obeyed;
use super::orders::{KeepResult, Orders, Ticket};
use crate::order::Order;
use crate::telemetry::monitor::RunMonitor;
use std::time::Duration;

/// How long an answer waits for the projector to obey.
const OBEYED_WITHIN: Duration = Duration::from_millis(500);
/// How long an answer waits for the disk.
const KEPT_WITHIN: Duration = Duration::from_millis(1000);

/// The last word on an order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OrderOutcome {
    /// The projector has confirmed it, and it is kept over restarts where it should be.
    pub is_done: bool,
    /// One line for the operator.
    pub text: String,
}

/// The answer to an order that was given `ago`; `None` while a better one is possible.
pub fn answer_to(
    order: Order,
    ticket: Ticket,
    ago: Duration,
    monitor: &RunMonitor,
    orders: &Orders,
) -> Option<OrderOutcome> {
    let health = monitor.projector();
    let is_done = is_obeyed(order, health);
    let kept = orders.outcome(ticket);
    let failed = |text| Some(OrderOutcome { is_done: false, text });
    if let (Order::Arm, Some(KeepResult::Not(why))) = (order, &kept) {
        return failed(format!("not armed: the standing order cannot be removed: {why}; projector {health}"));
    }
    let hope = if is_done { kept.is_none() && ago < KEPT_WITHIN } else { ago < OBEYED_WITHIN };
    if hope {
        return None;
    }
    let done = match (is_done, order) {
        (true, _) => "ok",
        // The link repeats it until the projector confirms.
        (false, _) => "not yet",
    };
    let on_disk = match kept {
        Some(KeepResult::In(path)) => format!("; kept in {}", path.display()),
        Some(KeepResult::Forgotten) => String::new(),
        Some(KeepResult::Nowhere) if order == Order::Arm => String::new(),
        Some(KeepResult::Nowhere) => "; not kept over a restart (a mock without a state folder)".into(),
        Some(KeepResult::Not(why)) => {
            return failed(format!("{done}, but NOT kept over a restart: {why}; projector {health}"))
        }
        None => {
            return failed(format!(
                "{done}, but NOT kept over a restart yet: the disk is slow; projector {health}"
            ))
        }
    };
    Some(OrderOutcome { is_done, text: format!("{done}: projector {health}{on_disk}") })
}
