//! What the link thread does besides sending frames: it obeys the operator's orders, arms again after a fault,
//! follows the projector's clock, and reads the projector's reports.
//!
//! If nobody ordered the dark, light comes back by itself only where the cause was the cable or the host: a new
//! session after unplugging or a reset, the watchdog, damaged packets. Heat, lamp, emergency stop, flashes and SAFE
//! wait for an ARM of the operator.

use super::connect::ConnectError;
use super::reported_light::ReportedLight;
use crate::frame::slots::OrderedDark;
use crate::light::recorder::LightNote;
use crate::light::status::StatusLight;
use crate::order::Order;
use crate::plan::frame::FramePlan;
use crate::plan::link_time::LinkTime;
use crate::telemetry::light_gauge::LightReport;
use crate::telemetry::link_gauges::{LinkGauges, LinkReport};
use crate::telemetry::monitor::{ProjectorHealth, RunMonitor};
use crate::telemetry::projector::ProjectorReport;
use dpm_device::clock_map::ClockMap;
use dpm_device::link::{faults, DeviceState, HostLink, LinkError, LinkState, Verb};
use dpm_device::time::HostTime;
use dpm_device::transport::Transport;
use dpm_handoff::channel::Sender;
use dpm_handoff::latest::Publisher;

/// The shortest time between two such returns. A projector that keeps faulting stays mostly dark.
const REARM_NS: i64 = 1_000_000_000;
/// A correction of the map beyond this is a step of one of the clocks (a machine that was suspended), nanoseconds.
const STEP_NS: i64 = 2_000_000;
/// How often the planning thread gets a new map of the projector's clock.
const RETIME_NS: i64 = 100_000_000;
/// The number of clock exchanges that give a better map than those of the handshake.
const EXCHANGES: usize = 8;

/// See the module's documentation.
pub(crate) struct LinkKeeper {
    time: LinkTime,
    /// Publishes the projector's clock to planning; `None` before there is a crew.
    times: Option<Publisher<LinkTime>>,
    retimed_at: HostTime,
    map: Option<ClockMap>,
    clock_bound_ns: Option<i64>,
    /// How often the map of the projector's clock was found wrong.
    clock_steps: u64,
    session: u64,
    /// `time` belongs to this session.
    is_timed: bool,
    reports: Option<StatusLight>,
    /// What the projector's reports say of the light, wherever it is.
    light: ReportedLight,
    polled_at: HostTime,
    /// The operator's last order that was not taken back.
    standing: Option<Verb>,
    rearmed_at: HostTime,
    rearmed: u64,
    /// The device's hottest sensor, thousandths of a degree Celsius.
    milli_celsius: Option<i32>,
    /// The interlock was closed at the last check.
    allowed: bool,
    /// No light may fall on heads that move, so no picture is held.
    pub guards_heads: bool,
}

impl LinkKeeper {
    /// For a link that has just come up with `time`, in a rig of so many tracked `bodies`. `lights` receives notes of the projector's light if its reports
    /// are the only source for them; light falls so many nanoseconds after the start of its slot.
    pub(crate) fn new(
        time: LinkTime,
        link: &HostLink,
        bodies: usize,
        lights: Option<(Sender<LightNote>, i64)>,
    ) -> Self {
        Self {
            time,
            times: None,
            retimed_at: HostTime(i64::MIN),
            map: None,
            clock_bound_ns: None,
            clock_steps: 0,
            session: link.counters().sessions,
            is_timed: true,
            light: ReportedLight::new(bodies),
            polled_at: HostTime(i64::MIN),
            reports: lights.map(|(lights, delay_ns)| StatusLight::new(lights, delay_ns)),
            standing: None,
            rearmed_at: HostTime(i64::MIN),
            rearmed: 0,
            milli_celsius: None,
            allowed: true,
            guards_heads: false,
        }
    }

    /// The projector's slots on the host's clock.
    pub(crate) fn time(&self) -> &LinkTime {
        &self.time
    }

    /// True if the projector is outside this process, so that its reports are the only source for its light.
    pub(crate) fn has_reports(&self) -> bool {
        self.reports.is_some()
    }

    /// From now on planning receives the projector's clock through `times`.
    pub(crate) fn tell_times_to(&mut self, mut times: Publisher<LinkTime>) {
        times.publish(self.time);
        self.times = Some(times);
    }

    /// Polls the link and does what is due. At virtual pace (`steady`) the projector's clock stays as the handshake
    /// found it. A frozen picture is held only while all stages are `alive`.
    ///
    /// # Errors
    /// The link cannot come up again: another projector was plugged in, or it refuses. It is no error if the medium
    /// is gone or the projector refuses to be armed; the run then continues in the dark.
    pub(crate) fn poll(
        &mut self,
        now: HostTime,
        link: &mut HostLink,
        transport: &mut dyn Transport,
        steady: bool,
        alive: bool,
        monitor: &RunMonitor,
    ) -> Result<(), ConnectError> {
        let result = match link.poll(now, transport) {
            Ok(_) | Err(LinkError::Transport(_) | LinkError::ArmRefused { .. }) => Ok(()),
            Err(e) => Err(e.into()),
        };
        if link.counters().sessions != self.session {
            self.session = link.counters().sessions;
            (self.is_timed, self.map) = (false, None);
            if let Some(reports) = &mut self.reports {
                reports.new_session();
            }
        }
        // A session begins some polls before its projector says HELLO, and nothing is armed before that.
        if let Some(hello) = link.device() {
            monitor.meet_device(hello.serial);
        }
        if !steady {
            self.keep_slots(link);
            self.keep_time(now, link);
        }
        // After a stop request, no order lights the projector again.
        let stopping = monitor.stop_requested() || self.standing == Some(Verb::Stop);
        if !stopping {
            self.follow_interlock(now, monitor.light_allowed(), link, transport);
        }
        if let Some(order) = monitor.take_order().filter(|order| !(stopping && *order == Order::Arm)) {
            self.obey(now, order, link, transport);
        }
        if self.standing == Some(Verb::Freeze) && !alive {
            // Nobody would replace the frozen frame, and nobody knows for how long.
            self.obey(now, Order::Black, link, transport);
        }
        if !stopping {
            self.arm_again(now, link, steady);
        }
        monitor.dark().tell(now, ordered_dark(now, link, self.standing, self.allowed));
        if let (Some(reports), Some(status)) = (&mut self.reports, link.status().filter(|_| self.is_timed)) {
            reports.observe(status, &self.time);
        }
        self.milli_celsius = transport.milli_celsius();
        monitor.link().tell(&self.carried(link));
        monitor.set_projector(if self.allowed {
            health(link, self.standing)
        } else {
            match health(link, self.standing) {
                dark @ (ProjectorHealth::Lost | ProjectorHealth::Faulted(_) | ProjectorHealth::Stopped) => {
                    dark
                }
                _ => ProjectorHealth::InterlockOpen,
            }
        });
        self.tell_light(now, link, monitor);
        result
    }

    /// Tells those who look what light there is, and for how long there has been what.
    fn tell_light(&mut self, now: HostTime, link: &HostLink, monitor: &RunMonitor) {
        let gauge = monitor.light_gauge();
        let before = std::mem::replace(&mut self.polled_at, now);
        if before.0 != i64::MIN {
            gauge.spent(monitor.light(), now.ns_since(before).max(0) as u64);
        }
        let seen = self.light.observe(link.status(), now, gauge);
        let standing = self.standing.and_then(|verb| match verb {
            Verb::Black => Some(Order::Black),
            Verb::Freeze => Some(Order::Freeze),
            Verb::Safe => Some(Order::Safe),
            Verb::Stop => None,
        });
        gauge.tell(&LightReport { standing, ..seen }, now);
    }

    /// How often the map of the projector's clock was found wrong. What was learned by it is wrong then, too.
    pub(crate) fn clock_steps(&self) -> u64 {
        self.clock_steps
    }

    /// Records that the frame of `plan` was sent at `now`. `has_light`: a mirror is lit in it.
    pub(crate) fn sent(&mut self, plan: &FramePlan, has_light: bool, now: HostTime) {
        self.light.sent(plan, has_light, now);
        if let Some(reports) = &mut self.reports {
            reports.sent(plan.id.0 as u32, plan.slot, now);
        }
    }

    /// How much earlier frames must leave than the host's own stages require, nanoseconds.
    pub(crate) fn travel_ns(&self) -> i64 {
        self.reports.as_ref().map_or(0, StatusLight::travel_ns)
    }

    /// Ends the light; nothing brings it back.
    pub(crate) fn stop(&mut self, now: HostTime, link: &mut HostLink, transport: &mut dyn Transport) {
        self.standing = Some(Verb::Stop);
        let _ = link.command(now, Verb::Stop, transport);
    }

    /// What the link carried.
    pub(crate) fn report(&self, link: &HostLink, name: &str) -> ProjectorReport {
        let gauges = LinkGauges::default();
        gauges.tell(&self.carried(link));
        gauges.report(name)
    }

    /// What the link has carried so far.
    fn carried(&self, link: &HostLink) -> LinkReport {
        let c = link.counters();
        let by_tracks = link.status().and_then(|status| status.tracks).unwrap_or_default();
        let by_tracks = [by_tracks.planes_moved, by_tracks.planes_clamped, by_tracks.planes_stale];
        LinkReport {
            sessions: c.sessions,
            rearmed: self.rearmed,
            bytes_sent: c.bytes_sent,
            planes: [c.planes_raw, c.planes_coded, c.planes_kept],
            not_sent: [c.not_streaming, c.no_credit, c.link_busy, c.link_lost, c.flash_limit, c.light_limit],
            tracks_sent: c.tracks_sent,
            planes_by_tracks: by_tracks.map(u64::from),
            device: self.reports.as_ref().map(StatusLight::counts),
            clock_bound_ns: self.clock_bound_ns,
            travel_ns: self.reports.as_ref().map(StatusLight::travel_ns),
            milli_celsius: self.milli_celsius,
        }
    }

    /// Follows the interlock. When it opens, orders BLACK at once. When it closes, light returns unless an order of
    /// the operator stands.
    fn follow_interlock(
        &mut self,
        now: HostTime,
        allowed: bool,
        link: &mut HostLink,
        transport: &mut dyn Transport,
    ) {
        if allowed == std::mem::replace(&mut self.allowed, allowed) {
            return;
        }
        if self.standing == Some(Verb::Freeze) {
            // The frozen picture is dark now and will be old when light may return, so the operator must decide.
            self.standing = Some(Verb::Black);
        }
        if !allowed && !matches!(self.standing, Some(Verb::Stop | Verb::Safe)) {
            // The link repeats a command that does not get through.
            let _ = link.command(now, Verb::Black, transport);
        } else if allowed && self.standing.is_none() && link.state() == LinkState::Streaming {
            link.arm(0);
        }
    }

    fn obey(&mut self, now: HostTime, order: Order, link: &mut HostLink, transport: &mut dyn Transport) {
        let verb = match order {
            Order::Black => Verb::Black,
            // Nothing is lit that could be frozen, or nothing could be cut of it when a head moves into it.
            Order::Freeze if !self.allowed || self.guards_heads => Verb::Black,
            Order::Freeze => Verb::Freeze,
            Order::Safe => Verb::Safe,
            Order::Arm if !self.allowed => {
                // Light returns when the interlock closes. Latched faults still have to be acknowledged then.
                self.standing = None;
                return;
            }
            Order::Arm => {
                self.standing = None;
                return link.arm(link.status().map_or(0, |s| s.faults));
            }
        };
        // A weaker order does not replace a stronger one: FREEZE after BLACK, or BLACK after SAFE.
        if self.standing.is_some_and(|standing| rank(standing) > rank(verb)) {
            return;
        }
        self.standing = Some(verb);
        // The link repeats a command that does not get through. If the medium is gone, the projector is dark anyway.
        let _ = link.command(now, verb, transport);
    }

    /// Arms a projector that came back, or that stopped for a reason that has passed, unless the operator wants it
    /// dark.
    fn arm_again(&mut self, now: HostTime, link: &mut HostLink, steady: bool) {
        // A rest after flashes ends by itself and cannot be cut short.
        if self.standing.is_some() || !self.allowed || link.is_resting(now) {
            return;
        }
        match link.state() {
            LinkState::Ready if self.is_timed || steady => link.arm(0),
            LinkState::Faulted => {
                let latched = link.status().map_or(0, |s| s.faults);
                let rested = self.rearmed_at.0 == i64::MIN || now.ns_since(self.rearmed_at) >= REARM_NS;
                if latched != 0 && latched & !faults::PASSING == 0 && rested {
                    self.rearmed_at = now;
                    self.rearmed += 1;
                    link.arm(latched);
                }
            }
            _ => {}
        }
    }

    /// Takes over slots that were shifted.
    fn keep_slots(&mut self, link: &HostLink) {
        let clock = link.slots().filter(|clock| self.is_timed && *clock != self.time.clock);
        if let Some(clock) = clock {
            self.time.clock = clock;
            if let Some(times) = &mut self.times {
                times.publish(self.time);
            }
        }
    }

    /// Maps the projector's clock and publishes it to the planning thread.
    fn keep_time(&mut self, now: HostTime, link: &mut HostLink) {
        let Some(hello) = link.device() else { return };
        if self.map.is_none() {
            self.map = ClockMap::new(u64::from(hello.tick_hz)).ok();
        }
        let Some(map) = &mut self.map else { return };
        let mut newest = None;
        link.take_echoes(|e| {
            map.add_exchange(e.host_sent_at, e.device_received_at, e.device_sent_at, e.host_received_at);
            newest = Some(e.device_sent_at);
        });
        let (Some(ticks), Some(clock)) = (newest, link.slots()) else { return };
        let Some(mapped) = map.to_host(ticks) else { return };
        self.clock_bound_ns = Some(mapped.uncertainty_ns);
        if self.is_timed {
            let due = self.retimed_at.0 == i64::MIN || now.ns_since(self.retimed_at) >= RETIME_NS;
            if !due || map.exchanges() < EXCHANGES {
                return;
            }
            let stepped_ns = mapped.at.ns_since(self.time.host_of(ticks)).abs();
            if stepped_ns > STEP_NS {
                self.clock_steps += 1;
                if let Some(reports) = &mut self.reports {
                    reports.clock_was_wrong();
                }
            }
            (self.time.anchor, self.time.bound_ns) = ((ticks, mapped.at), mapped.uncertainty_ns);
        } else {
            let (anchor, bound_ns) = ((ticks, mapped.at), mapped.uncertainty_ns);
            let mut time = LinkTime { clock, first: 0, anchor, bound_ns };
            // The run continues to count its slots.
            time.first = self.time.slot_after(time.host_of_slot(0));
            (self.time, self.is_timed) = (time, true);
        }
        self.retimed_at = now;
        if let Some(times) = &mut self.times {
            times.publish(self.time);
        }
    }
}

/// True when the device reports that it is dark and will stay so, or when it cannot be asked.
pub(crate) fn is_dark(link: &HostLink) -> bool {
    matches!(link.state(), LinkState::Lost | LinkState::Closed)
        || link.status().is_some_and(|s| {
            !s.lit && !matches!(s.state, DeviceState::Armed | DeviceState::Black | DeviceState::Frozen)
        })
}

/// The strength of an order. A standing order yields only to one of at least equal strength.
fn rank(verb: Verb) -> u8 {
    match verb {
        Verb::Freeze => 0,
        Verb::Black => 1,
        Verb::Safe => 2,
        Verb::Stop => 3,
    }
}

/// Why no new picture is wanted; slots without a frame then have no other cause.
fn ordered_dark(
    now: HostTime,
    link: &HostLink,
    standing: Option<Verb>,
    allowed: bool,
) -> Option<OrderedDark> {
    match standing {
        Some(Verb::Black) => return Some(OrderedDark::Black),
        Some(Verb::Freeze) => return Some(OrderedDark::Frozen),
        Some(Verb::Safe) => return Some(OrderedDark::Safe),
        Some(Verb::Stop) => return Some(OrderedDark::Stop),
        _ => {}
    }
    let latched = link.status().map_or(0, |s| s.faults);
    if !allowed {
        Some(OrderedDark::Interlock)
    } else if link.is_resting(now) {
        Some(OrderedDark::Rest)
    } else if link.state() == LinkState::Faulted && latched & faults::HOST_SAFE != 0 {
        Some(OrderedDark::Safe)
    } else if link.state() == LinkState::Faulted && latched & !(faults::PASSING | faults::OF_FRAMES) != 0 {
        Some(OrderedDark::Fault)
    } else if link.state() == LinkState::Faulted && latched & faults::OF_FRAMES != 0 {
        Some(OrderedDark::Exceeded)
    } else {
        None
    }
}

/// A projector that has latched these faults. Where they would pass by themselves, an order that stands is what keeps it
/// dark.
fn faulted(latched: u32, standing: Option<Verb>) -> ProjectorHealth {
    let passes = latched != 0 && latched & !faults::PASSING == 0;
    match standing.filter(|_| passes) {
        // FREEZE has no picture left to hold.
        Some(Verb::Black | Verb::Freeze) => ProjectorHealth::Black,
        Some(Verb::Safe) => ProjectorHealth::Faulted(latched | faults::HOST_SAFE),
        Some(Verb::Stop) | None => ProjectorHealth::Faulted(latched),
    }
}

fn health(link: &HostLink, standing: Option<Verb>) -> ProjectorHealth {
    use DeviceState as D;
    let state = link.status().map_or(D::Idle, |s| s.state);
    if let (Some(limit), LinkState::Streaming) = (link.resting_for(), link.state()) {
        return ProjectorHealth::Resting(limit);
    }
    if link.rests_after_flashes() && link.state() == LinkState::Streaming {
        return ProjectorHealth::RestingAfterFlashes;
    }
    match (link.state(), standing) {
        (LinkState::Lost | LinkState::Closed, _) => ProjectorHealth::Lost,
        (LinkState::Faulted, _) => faulted(link.status().map_or(0, |s| s.faults), standing),
        // Black only once the projector reports it.
        (_, Some(Verb::Black)) if !matches!(state, D::Armed | D::Frozen) => ProjectorHealth::Black,
        (_, Some(Verb::Freeze)) if state != D::Armed => ProjectorHealth::Frozen,
        // A projector that lost power has forgotten SAFE; the host has not.
        (_, Some(Verb::Safe)) if state == D::Configured => ProjectorHealth::Faulted(faults::HOST_SAFE),
        (_, Some(Verb::Stop)) if is_dark(link) => ProjectorHealth::Stopped,
        (LinkState::Streaming, _) => ProjectorHealth::Up,
        _ => ProjectorHealth::Connecting,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nothing says that light comes back by itself where somebody has ordered the dark.
    #[test]
    fn what_would_pass_by_itself_does_not_while_an_order_stands() {
        let all = [None, Some(Verb::Freeze), Some(Verb::Black), Some(Verb::Safe)];
        for latched in [faults::WATCHDOG, faults::CHECKSUM_STORM, faults::PASSING] {
            for standing in all {
                let told = faulted(latched, standing).to_string();
                assert_eq!(told.contains("by itself"), standing.is_none(), "{standing:?}: {told}");
                assert!(standing.is_none() || told.contains("`dpm arm`"), "{standing:?}: {told}");
            }
            // What waits for a person is named, whatever else stands.
            for standing in all {
                let hot = latched | faults::OVER_TEMPERATURE;
                assert_eq!(faulted(hot, standing), ProjectorHealth::Faulted(hot));
            }
        }
        assert_eq!(faulted(faults::HOST_SAFE, Some(Verb::Safe)), ProjectorHealth::Faulted(faults::HOST_SAFE));
        assert_eq!(faulted(0, Some(Verb::Black)), ProjectorHealth::Faulted(0));
    }
}
