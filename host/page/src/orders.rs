//! An order that came over HTTP: given as the control socket gives it, and answered when it was carried out.

use crate::shared::RunView;
use dpm_rig::control::answer::{answer_to, is_obeyed};
use dpm_rig::order::Order;
use dpm_rig::standing::By;
use std::time::{Duration, Instant};

/// How often to look whether the projector has obeyed.
const LOOK: Duration = Duration::from_millis(1);

/// What is answered to an order.
#[derive(Debug, serde::Serialize)]
pub(crate) struct OrderAnswer {
    /// Its name.
    order: &'static str,
    /// The projector has confirmed it, and it is kept over restarts where it should be.
    done: bool,
    /// One line for the operator.
    text: String,
    /// After how long the projector had confirmed it, milliseconds; null if it has not.
    obeyed_ms: Option<f64>,
}

/// Gives `order` and waits for its result, for a second at most.
pub(crate) async fn give(order: Order, shared: &RunView) -> OrderAnswer {
    let begin = Instant::now();
    let ticket = shared.orders.give(order, By::Page);
    let mut obeyed_ms = None;
    let answer = loop {
        if obeyed_ms.is_none() && is_obeyed(order, shared.monitor.projector()) {
            obeyed_ms = Some((begin.elapsed().as_secs_f64() * 1e6).round() / 1e3);
        }
        if let Some(answer) = answer_to(order, ticket, begin.elapsed(), &shared.monitor, &shared.orders) {
            break answer;
        }
        tokio::time::sleep(LOOK).await;
    };
    shared.monitor.note(format!("page: {}: {}", order.word(), answer.text));
    OrderAnswer { order: order.word(), done: answer.is_done, text: answer.text, obeyed_ms }
}
