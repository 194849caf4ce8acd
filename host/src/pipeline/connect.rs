//! Brings the link up: handshake, configuration, clock, ARM. Before the first frame, so it may wait (bounded).

use super::stages::LinkTime;
use dpm_device::link::{HostLink, LinkError, LinkState};
use dpm_device::time::HostTime;
use dpm_device::transport::Transport;

/// Longest time that a device may take to answer.
const LIMIT_NS: i64 = 2_000_000_000;
/// Clock exchanges before the first frame.
const ECHOES: usize = 4;

/// Why the projector did not come up.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The link's own word.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// It does not answer.
    #[error("the projector did not get beyond {state:?} within {0} s; check power and cable", LIMIT_NS / 1_000_000_000)]
    Silent {
        /// How far it came.
        state: LinkState,
    },
}

/// Connects and arms. `now` reads the clock and lets a little time pass with every call.
///
/// # Errors
/// The device is missing, refuses, or is silent.
pub fn connect(
    link: &mut HostLink,
    transport: &mut dyn Transport,
    now: &mut dyn FnMut() -> HostTime,
) -> Result<LinkTime, ConnectError> {
    link.connect();
    let begin = now();
    let mut best: Option<(i64, dpm_device::link::EchoSample)> = None;
    let mut echoes = 0;
    loop {
        let t = now();
        let state = link.poll(t, transport)?;
        link.take_echoes(|e| {
            echoes += 1;
            let round_trip = e.host_received_at.ns_since(e.host_sent_at);
            if best.is_none_or(|(shortest, _)| round_trip < shortest) {
                best = Some((round_trip, e));
            }
        });
        if state == LinkState::Ready {
            link.arm(0);
        }
        if let (LinkState::Streaming, Some((round_trip, echo)), Some(clock)) = (state, best, link.slots()) {
            if echoes >= ECHOES {
                // The device's stamp lies in the middle of the shortest exchange.
                let middle = echo.host_sent_at.plus_ns(round_trip / 2);
                return Ok(LinkTime { clock, anchor: (echo.device_received_at, middle) });
            }
        }
        if t.ns_since(begin) > LIMIT_NS {
            return Err(ConnectError::Silent { state });
        }
    }
}
