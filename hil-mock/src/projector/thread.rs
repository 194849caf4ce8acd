//! A projector on a thread of its own, for rigs that run at the pace of the wall clock.
//!
//! The thread never decides *when* light falls: it asks the clock it is given and lets the state machine catch up, so an event's
//! times are exact however late the thread runs; only packets that wait for it arrive late.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::DeviceEnd;

use super::{LightEvent, MockProjector};

/// Longest rest of an idle thread: how late a packet may be served when nothing else is due.
const REST: Duration = Duration::from_micros(100);
/// Light events that may wait to be taken.
const EVENTS: usize = 4096;

/// A running projector. Dropping it stops the thread.
pub struct ProjectorThread {
    thread: Option<JoinHandle<MockProjector>>,
    stop: Arc<AtomicBool>,
    events: Arc<ArrayQueue<LightEvent>>,
}

impl ProjectorThread {
    /// Starts a thread that serves `cable` with `projector` until stopped or until the host's end is gone. `clock` gives the
    /// rig's time.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        mut projector: MockProjector,
        mut cable: DeviceEnd,
        clock: impl Fn() -> HostTime + Send + 'static,
    ) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let events = Arc::new(ArrayQueue::new(EVENTS));
        let (stopped, sink) = (stop.clone(), events.clone());
        let thread = std::thread::Builder::new().name("mock-projector".into()).spawn(move || {
            let mut plugged = true;
            while plugged && !stopped.load(Ordering::Acquire) {
                plugged = cable.serve(clock(), &mut projector);
                while let Some(event) = projector.next_light() {
                    // Newest matter most: the oldest makes room.
                    let _ = sink.force_push(event);
                }
                if cable.is_idle() {
                    let due = projector.next_due().map_or(i64::MAX, |at| at.ns_since(clock()));
                    let rest = REST.min(Duration::from_nanos(due.max(0) as u64));
                    if !rest.is_zero() {
                        std::thread::park_timeout(rest);
                    }
                }
            }
            projector
        })?;
        Ok(Self { thread: Some(thread), stop, events })
    }

    /// The oldest light event not yet taken; takes no lock.
    pub fn next_light(&self) -> Option<LightEvent> {
        self.events.pop()
    }

    /// Ends the thread and returns the projector.
    ///
    /// # Panics
    /// When the thread panicked.
    pub fn stop(mut self) -> MockProjector {
        self.stop.store(true, Ordering::Release);
        let thread = self.thread.take().expect("taken only here and in drop");
        thread.thread().unpark();
        thread.join().expect("the mock projector's thread panicked")
    }
}

impl Drop for ProjectorThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            // A panic there has been reported on standard error; dropping must not panic again.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{LightKind, MockConfig};
    use super::*;
    use dpm_device::link::{packet_bytes, Epoch, HostLink, LinkSettings, LinkState, Underrun};
    use dpm_device::planes::{PlaneSchedule, Raster};
    use dpm_device::time::{DeviceTicks, FrameRate};
    use dpm_device::transport::inproc::threaded;
    use std::time::Instant;

    /// At the pace of the wall clock, over the rings: whatever the scheduler does, what is lit was sent and nothing is lost
    /// without a reason.
    #[test]
    fn frames_cross_between_threads() {
        let raster = Raster::new(64, 16).unwrap();
        let frame_bytes = packet_bytes(raster.plane_bytes()) * 24 + packet_bytes(16);
        let (mut host, device) = threaded(frame_bytes, 4);
        let start = Instant::now();
        let clock = move || HostTime(start.elapsed().as_nanos() as i64);
        let mock =
            ProjectorThread::start(MockProjector::new(MockConfig::new(raster)), device, clock).unwrap();
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
            session_seed: 3,
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
                    let outcome = link.send_frame(now, sent, slots.start(slot + 1), &planes, &mut host);
                    if outcome == dpm_device::link::SendOutcome::Sent {
                        sent += 1;
                    }
                }
                _ => {}
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(sent, 40, "streaming within 20 s");
        std::thread::sleep(Duration::from_millis(50));
        let mut lit = Vec::new();
        while let Some(e) = mock.next_light() {
            if e.kind == LightKind::Lit {
                lit.push(e.frame.unwrap());
            }
        }
        let mut mock = mock.stop();
        mock.check_laws();
        let s = mock.status();
        assert_eq!(lit.len() as u32, s.frames_lit);
        assert!(lit.windows(2).all(|w| w[0] < w[1]) && !lit.is_empty());
        assert_eq!(s.frames_lit + s.frames_superseded + s.frames_late + mock.waiting(), 40, "{s:?}");
        assert_eq!((s.payload_errors, s.header_errors, mock.credit_violations()), (0, 0, 0));
        let last = *lit.last().unwrap() as u8;
        assert!(mock.lit_planes().unwrap().iter().all(|&b| b == last));
        assert!(mock.light_of_frame().is_some());
    }

    #[test]
    fn the_thread_ends_with_the_cable() {
        let raster = Raster::new(8, 8).unwrap();
        let (host, device) = threaded(1000, 2);
        let mock = MockProjector::new(MockConfig::new(raster));
        let thread = ProjectorThread::start(mock, device, || HostTime(0)).unwrap();
        drop(host);
        let deadline = Instant::now() + Duration::from_secs(10);
        while !thread.thread.as_ref().unwrap().is_finished() {
            assert!(Instant::now() < deadline, "still running without a cable");
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
