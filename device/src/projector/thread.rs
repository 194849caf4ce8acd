//! A projector at the end of a cable between threads, for rigs that run at real pace.
//!
//! The thread never decides *when* light falls: it reads its clock and lets the state machine catch up, so the times of
//! events are exact however late the thread runs. Only packets that wait for the thread arrive late.

use crate::time::HostTime;
use crate::transport::inproc::DeviceEnd;
use crate::transport::{Lane, LinkDevice};

use super::ProjectorFirmware;

/// A device that can be served on a cable: it reports the time of its next own event.
pub trait Served: LinkDevice {
    /// Time of the next own event; `None` if there is none.
    fn next_due(&self) -> Option<HostTime>;
}

impl Served for ProjectorFirmware {
    fn next_due(&self) -> Option<HostTime> {
        Self::next_due(self)
    }
}

/// Longest sleep of a thread whose projector has no due event.
const REST_NS: i64 = 1_000_000_000;

/// Serves `cable` with `projector` until the host's end is dropped. Sleeps between arrivals and due events. `clock`
/// gives the rig's time, the one that the host reads too. `witness` is called with it before each delivery, to advance
/// the projector to that time and take its light.
pub fn serve_cable<P: Served>(
    projector: &mut P,
    mut cable: DeviceEnd,
    clock: impl Fn() -> HostTime,
    mut witness: impl FnMut(&mut P, HostTime) + Send,
) {
    // Arrived packets come first: they may be older than now, and a projector never goes back in time.
    while cable.serve(&clock, &mut WitnessedProjector { projector, witness: &mut witness }) {
        witness(projector, clock());
        let limit = clock().plus_ns(REST_NS);
        cable.rest(projector.next_due().map_or(limit, |due| due.min(limit)), &clock);
    }
    witness(projector, clock());
}

/// A projector whose light is taken before anything happens to it.
struct WitnessedProjector<'a, P, W> {
    projector: &'a mut P,
    witness: &'a mut W,
}

impl<P: Served, W: FnMut(&mut P, HostTime) + Send> LinkDevice for WitnessedProjector<'_, P, W> {
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]) {
        (self.witness)(self.projector, now);
        self.projector.receive(now, lane, bytes);
    }

    fn end_of_transfer(&mut self, now: HostTime, lane: Lane) {
        (self.witness)(self.projector, now);
        self.projector.end_of_transfer(now, lane);
    }

    fn advance_to(&mut self, now: HostTime) {
        (self.witness)(self.projector, now);
        self.projector.advance_to(now);
    }

    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) {
        (self.witness)(self.projector, now);
        self.projector.replies(now, sink);
    }
}

#[cfg(test)]
mod tests {
    use super::super::{FirmwareConfig, LightKind, ProjectorFirmware};
    use super::*;
    use crate::link::{
        packet_bytes, Epoch, HostLink, LightLimits, LinkSettings, LinkState, Underrun, COMMIT_BYTES,
    };
    use crate::planes::{PlaneSchedule, Raster};
    use crate::time::{DeviceTicks, FrameRate};
    use crate::transport::inproc::threaded;
    use dpm_handoff::wake::WaitPolicy;
    use std::time::{Duration, Instant};

    /// At real pace, over the rings: whatever the scheduler does, every lit frame was sent, and nothing is lost without
    /// a reason.
    #[test]
    fn frames_cross_between_threads() {
        let raster = Raster::new(64, 16).unwrap();
        let frame_bytes = packet_bytes(raster.plane_bytes()) * 24 + packet_bytes(COMMIT_BYTES);
        let (mut host, device) = threaded(frame_bytes, 4, WaitPolicy::Park);
        let start = Instant::now();
        let clock = move || HostTime(start.elapsed().as_nanos() as i64);
        let thread = std::thread::spawn(move || {
            let mut mock = ProjectorFirmware::new(FirmwareConfig::new(raster));
            let mut lit = Vec::new();
            serve_cable(&mut mock, device, clock, |mock, now| {
                mock.advance_to(now);
                while let Some(e) = mock.next_light() {
                    if e.kind == LightKind::Lit {
                        lit.push(e.frame.unwrap());
                    }
                }
            });
            (mock, lit)
        });
        let mut link = HostLink::new(LinkSettings {
            raster,
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(200, 1).unwrap(),
            watchdog_us: 2_000_000,
            underrun: Underrun::Repeat,
            late_slots: 100,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: 0,
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        link.connect();
        let deadline = Instant::now() + Duration::from_secs(20);
        let mut sent = 0u64;
        while sent < 40 && Instant::now() < deadline {
            match link.poll(clock(), &mut host).expect("in-process") {
                LinkState::Ready => link.arm(0),
                LinkState::Streaming => {
                    let now = clock();
                    let slots = link.slots().unwrap();
                    let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap();
                    let planes = vec![sent as u8; raster.plane_bytes() * 24];
                    let outcome = link.send_frame(
                        now,
                        sent,
                        slots.start(slot + 1),
                        slots.dark_from(slot + 1, 20_000_000_000),
                        &planes,
                        &mut host,
                    );
                    if outcome == crate::link::SendOutcome::Sent {
                        sent += 1;
                    }
                }
                _ => {}
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(sent, 40, "streaming within 20 s");
        std::thread::sleep(Duration::from_millis(50));
        drop(host);
        let (mut mock, lit) = thread.join().unwrap();
        mock.check_laws();
        let s = mock.status();
        assert_eq!(lit.len() as u32, s.frames_lit);
        assert!(lit.windows(2).all(|w| w[0] < w[1]) && !lit.is_empty());
        assert_eq!(s.frames_lit + s.frames_superseded + s.frames_late + mock.in_flight(), 40, "{s:?}");
        assert_eq!((s.payload_errors, s.header_errors, mock.credit_violations()), (0, 0, 0));
        let last = *lit.last().unwrap() as u8;
        assert!(mock.lit_planes().unwrap().iter().all(|&b| b == last));
        assert!(mock.light_of_frame().is_some());
    }

    /// Found in use, section 2b of the second look at latency: with full frames and a host that polls once a slot, the
    /// map of the projector's clock was 0.25 to 0.5 ms wrong. The device's clock is the host's own here, so the map can
    /// be compared with the truth.
    #[test]
    fn the_projectors_clock_is_right_while_frames_flow() {
        use crate::clock_map::ClockMap;
        let raster = Raster::new(1024, 768).unwrap();
        let frame_bytes = packet_bytes(raster.plane_bytes()) * 24 + packet_bytes(COMMIT_BYTES);
        let (mut host, device) = threaded(frame_bytes, 2, WaitPolicy::Park);
        let start = Instant::now();
        let clock = move || HostTime(start.elapsed().as_nanos() as i64);
        let thread = std::thread::spawn(move || {
            let mut mock =
                ProjectorFirmware::new(FirmwareConfig { events_kept: 0, ..FirmwareConfig::new(raster) });
            serve_cable(&mut mock, device, clock, |mock, now| mock.advance_to(now));
        });
        let rate = FrameRate::new(500, 1).unwrap();
        let mut link = HostLink::new(LinkSettings {
            raster,
            schedule: PlaneSchedule::rgb24(),
            rate,
            watchdog_us: 40_000,
            underrun: Underrun::Repeat,
            late_slots: 255,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: 0,
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        link.connect();
        let planes = vec![0x35; raster.plane_bytes() * 24];
        let mut map = ClockMap::new(1_000_000_000).unwrap();
        let (mut errors, mut sent) = (Vec::new(), 0u64);
        let deadline = Instant::now() + Duration::from_secs(60);
        while sent < 500 && Instant::now() < deadline {
            // Once a slot, like a thread that has a frame to send, and not again before the next.
            match link.poll(clock(), &mut host).expect("in-process") {
                LinkState::Ready => link.arm(0),
                LinkState::Faulted => link.arm(crate::link::faults::WATCHDOG),
                LinkState::Streaming => {
                    let slots = link.slots().unwrap();
                    let slot = slots.slot_at(DeviceTicks(clock().0 as u64)).unwrap() + 2;
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 100_000_000));
                    let outcome = link.send_frame(clock(), sent, target, dark_from, &planes, &mut host);
                    sent += u64::from(outcome == crate::link::SendOutcome::Sent);
                }
                _ => {}
            }
            link.take_echoes(|e| {
                map.add_exchange(e.host_sent_at, e.device_received_at, e.device_sent_at, e.host_received_at);
            });
            if sent > 100 {
                let now = clock();
                let mapped = map.to_host(DeviceTicks(now.0 as u64)).unwrap();
                let error = mapped.at.ns_since(now);
                assert!(error.abs() <= mapped.uncertainty_ns, "{error} ns, bound {}", mapped.uncertainty_ns);
                errors.push(error.abs());
            }
            let slot = rate.slot_at_ns(clock().0) + 1;
            std::thread::sleep(Duration::from_nanos((rate.slot_start_ns(slot) - clock().0).max(0) as u64));
        }
        assert_eq!(sent, 500, "streaming within a minute");
        drop(host);
        thread.join().unwrap();
        errors.sort_unstable();
        // Half a slot is 1000 us. A busy machine delays a thread now and then; this does not affect the shortest
        // exchanges of four seconds.
        let p50 = errors[errors.len() / 2];
        assert!(p50 < 20_000, "half of the time {p50} ns wrong or more");
    }

    #[test]
    fn the_thread_ends_with_the_cable() {
        let raster = Raster::new(8, 8).unwrap();
        let (host, device) = threaded(1000, 2, WaitPolicy::Park);
        let start = Instant::now();
        let clock = move || HostTime(start.elapsed().as_nanos() as i64);
        let thread = std::thread::spawn(move || {
            let mut mock = ProjectorFirmware::new(FirmwareConfig::new(raster));
            serve_cable(&mut mock, device, clock, |mock, now| mock.advance_to(now));
        });
        // Its own sleep would last a second; it is woken during it.
        std::thread::sleep(Duration::from_millis(20));
        drop(host);
        let deadline = Instant::now() + Duration::from_secs(10);
        while !thread.is_finished() {
            assert!(Instant::now() < deadline, "still running without a cable");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// The cost of the thread while nothing happens: it sleeps and does not poll.
    #[cfg(target_os = "linux")]
    #[test]
    fn an_idle_projector_uses_no_processor() {
        let ticks = |id: &str| -> u64 {
            let stat = std::fs::read_to_string(format!("/proc/self/task/{id}/stat")).unwrap();
            let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
            fields[11].parse::<u64>().unwrap() + fields[12].parse::<u64>().unwrap()
        };
        let raster = Raster::new(8, 8).unwrap();
        let (host, device) = threaded(1000, 2, WaitPolicy::Park);
        let start = Instant::now();
        let clock = move || HostTime(start.elapsed().as_nanos() as i64);
        let (give, take) = crossbeam::channel::unbounded();
        let thread = std::thread::spawn(move || {
            let id = std::fs::read_link("/proc/thread-self").unwrap();
            give.send(id.file_name().unwrap().to_str().unwrap().to_owned()).unwrap();
            let mut mock = ProjectorFirmware::new(FirmwareConfig::new(raster));
            serve_cable(&mut mock, device, clock, |mock, now| mock.advance_to(now));
        });
        let id = take.recv().unwrap();
        let before = ticks(&id);
        std::thread::sleep(Duration::from_millis(300));
        // In hundredths of a second, of thirty.
        assert!(ticks(&id) - before <= 3);
        drop(host);
        thread.join().unwrap();
    }
}
