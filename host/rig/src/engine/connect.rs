//! Brings the link up: handshake, configuration, clock, ARM. This happens before the first frame, so it may wait for
//! a bounded time.

use crate::plan::link_time::LinkTime;
use crate::telemetry::monitor::RunMonitor;
use dpm_device::link::{faults, EchoSample, HostLink, LinkError, LinkState, Verb};
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_device::transport::Transport;

/// The longest time that a device may take to answer.
const LIMIT_NS: i64 = 2_000_000_000;
/// Clock exchanges before the first frame.
const ECHOES: usize = 4;

/// Why the projector did not come up.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The link reported an error.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The device does not answer.
    #[error(
        "{device}: the projector did not come up within {0} s (state {state:?}); check that it is switched on, that it is the intended \
         one (port, baud), and the cable, then switch it off and on",
        LIMIT_NS / 1_000_000_000
    )]
    Silent {
        /// Name of the transport.
        device: String,
        /// The state that the link reached.
        state: LinkState,
    },
    /// A stop was requested while the link came up.
    #[error("stopped before the projector was up; nothing was lit")]
    Stopped,
}

/// Latched faults that starting a run acknowledges.
pub const ENDED_WITH_THE_LAST_RUN: u32 = faults::PASSING;

/// Brings a link up, step by step: connects, learns the projector's clock, and arms.
///
/// Latched faults in the mask `acknowledged` are acknowledged. If the monitor holds an order for BLACK, SAFE or a
/// stop, the link comes up but does not arm, and the order stays in the monitor for whoever takes the link over. A
/// SAFE that the projector itself has latched counts as ordered, whatever `acknowledged` contains, and the monitor is
/// informed of it.
pub(crate) struct Connecting {
    acknowledged: u32,
    begin: HostTime,
    /// The session to which the exchanges belong: a projector that lost power starts its clock anew.
    session: u64,
    /// The exchange with the shortest round trip, and that round trip in nanoseconds.
    best: Option<(i64, EchoSample)>,
    echoes: usize,
    is_safe: bool,
}

impl Connecting {
    /// Begins to connect at `now`.
    pub(crate) fn begin(link: &mut HostLink, acknowledged: u32, now: HostTime) -> Self {
        link.connect();
        let session = link.counters().sessions;
        Self { acknowledged, begin: now, session, best: None, echoes: 0, is_safe: false }
    }

    /// Continues at `now`. `stop`: light is no longer wanted. Returns `None` while the link is not up yet.
    ///
    /// # Errors
    /// The device is missing, refuses, has latched other faults, or is silent; or a stop was requested.
    pub(crate) fn step(
        &mut self,
        now: HostTime,
        link: &mut HostLink,
        transport: &mut dyn Transport,
        monitor: &RunMonitor,
        stop: bool,
    ) -> Result<Option<LinkTime>, ConnectError> {
        let state = link.poll(now, transport)?;
        if link.counters().sessions != self.session {
            self.session = link.counters().sessions;
            (self.best, self.echoes) = (None, 0);
        }
        if let Some(hello) = link.device() {
            monitor.meet_device(hello.serial);
        }
        link.take_echoes(|e| {
            self.echoes += 1;
            let round_trip = e.host_received_at.ns_since(e.host_sent_at);
            if self.best.is_none_or(|(shortest, _)| round_trip < shortest) {
                self.best = Some((round_trip, e));
            }
        });
        if stop {
            // After a stop request the projector is never armed, and goes dark if it was armed before.
            let _ = link.command(now, Verb::Stop, transport);
            return Err(ConnectError::Stopped);
        }
        let latched = link.status().map_or(0, |s| s.faults);
        if state == LinkState::Faulted && latched & faults::HOST_SAFE != 0 && !self.is_safe {
            self.is_safe = true;
            monitor.find_safe();
        }
        let stays_dark = monitor.dark_is_ordered();
        match state {
            LinkState::Ready | LinkState::Faulted if stays_dark => {}
            LinkState::Ready => link.arm(0),
            LinkState::Faulted if latched & !self.acknowledged == 0 => link.arm(latched),
            LinkState::Faulted => {
                let device = transport.name().to_owned();
                return Err(LinkError::ArmRefused { device, faults: latched }.into());
            }
            _ => {}
        }
        let is_up = state == LinkState::Streaming
            || stays_dark && matches!(state, LinkState::Ready | LinkState::Faulted);
        if let (true, Some((round_trip, echo)), Some(clock)) = (is_up, self.best, link.slots()) {
            if self.echoes >= ECHOES {
                // The middle between the device's two stamps corresponds to the middle of the round trip. The time
                // that the device held the request is not travel time.
                let held = echo.device_sent_at.0.saturating_sub(echo.device_received_at.0);
                let there = DeviceTicks(echo.device_received_at.0.saturating_add(held / 2));
                let middle = echo.host_sent_at.plus_ns(round_trip / 2);
                let bound_ns = round_trip - round_trip / 2;
                return Ok(Some(LinkTime { clock, first: 0, anchor: (there, middle), bound_ns }));
            }
        }
        if now.ns_since(self.begin) > LIMIT_NS {
            return Err(ConnectError::Silent { device: transport.name().to_owned(), state });
        }
        Ok(None)
    }
}

/// Brings a link up as [`Connecting`] describes. `now` reads the clock and lets a little time pass with every call.
/// `stop` says that light is no longer wanted.
///
/// # Errors
/// The device is missing, refuses, has latched other faults, or is silent; or a stop was requested.
pub fn connect(
    link: &mut HostLink,
    transport: &mut dyn Transport,
    acknowledged: u32,
    monitor: &RunMonitor,
    now: &mut dyn FnMut() -> HostTime,
    stop: &dyn Fn() -> bool,
) -> Result<LinkTime, ConnectError> {
    let mut connecting = Connecting::begin(link, acknowledged, now());
    loop {
        if let Some(time) = connecting.step(now(), link, transport, monitor, stop())? {
            return Ok(time);
        }
    }
}
