//! The bit-plane link over a pseudo-terminal: real serialport, real kernel line, mock projector at the far end.

use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dpm_device::link::{
    packet_bytes, Codec, Epoch, Header, HostLink, LightLimits, LinkSettings, LinkState, MessageType, Packet,
    SendOutcome, Underrun, COMMIT_BYTES,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::{Lane, SendError, Transport, TransportError};
use dpm_device::tty::never_wait;
use hil_mock::line_port::{Line, LinePort};
use hil_mock::projector::serial::SerialProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::serial_server::PortName;
use serialport::{SerialPort, TTYPort};

fn raster() -> Raster {
    Raster::new(64, 32).unwrap()
}

fn planes(id: u64) -> Vec<u8> {
    // Mostly still, with zeros and runs: what COBS and the codecs have to cope with.
    let n = raster().plane_bytes() * 8;
    let moving = |i: u64| (i / 256).is_multiple_of(2) && i % 97 == id % 97;
    (0..n as u64).map(|i| if moving(i) { id as u8 } else { (i / 64) as u8 }).collect()
}

/// A projector on the master end of a pseudo-terminal, served by a thread.
struct Far {
    mock: Arc<Mutex<SerialProjector>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    start: Instant,
    garbage: Arc<Mutex<Vec<u8>>>,
}

fn pair() -> (Box<dyn SerialPort>, Box<dyn SerialPort>) {
    let (master, slave) = TTYPort::pair().expect("a pseudo-terminal");
    (never_wait(master).unwrap(), never_wait(slave).unwrap())
}

impl Far {
    fn new(mut master: Box<dyn SerialPort>, mock: Arc<Mutex<SerialProjector>>, start: Instant) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let garbage = Arc::new(Mutex::new(Vec::new()));
        let (stopped, served, noise) = (stop.clone(), mock.clone(), garbage.clone());
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                let now = HostTime(start.elapsed().as_nanos() as i64);
                let mut mock = served.lock().unwrap();
                let noise: Vec<u8> = std::mem::take(&mut *noise.lock().unwrap());
                if !noise.is_empty() {
                    // Both ways: a glitch on the line, as far as this end can make one.
                    mock.receive(now, &noise);
                    let _ = master.write(&noise);
                }
                match mock.serve(|| HostTime(start.elapsed().as_nanos() as i64), &mut master) {
                    Ok(true) => {}
                    Ok(false) => break,
                    Err(e) => panic!("{e}"),
                }
                drop(mock);
                std::thread::sleep(Duration::from_micros(300));
            }
        });
        Self { mock, stop, thread: Some(thread), start, garbage }
    }

    fn now(&self) -> HostTime {
        HostTime(self.start.elapsed().as_nanos() as i64)
    }

    fn with<R>(&self, f: impl FnOnce(&mut MockProjector) -> R) -> R {
        f(self.mock.lock().unwrap().projector())
    }

    fn hang_up(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

impl Drop for Far {
    fn drop(&mut self) {
        self.hang_up();
    }
}

struct Near {
    link: HostLink,
    line: SerialTransport,
    next_id: u64,
}

fn settings(path: &str) -> SerialSettings {
    let frame_bytes = packet_bytes(raster().plane_bytes()) * 8 + packet_bytes(COMMIT_BYTES);
    SerialSettings { path: path.into(), baud: 3_000_000, frame_bytes }
}

impl Near {
    fn new(line: SerialTransport, codecs: u32) -> Self {
        let link = HostLink::new(LinkSettings {
            raster: raster(),
            schedule: PlaneSchedule::mono8(),
            rate: FrameRate::new(100, 1).unwrap(),
            watchdog_us: 2_000_000,
            underrun: Underrun::Repeat,
            late_slots: 100,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs,
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        Self { link, line, next_id: 1 }
    }

    fn until(&mut self, far: &Far, limit: Duration, mut done: impl FnMut(&mut Self) -> bool) -> Duration {
        let start = Instant::now();
        loop {
            let _ = self.link.poll(far.now(), &mut self.line);
            if self.link.state() == LinkState::Ready {
                self.link.arm(0);
            }
            if self.link.state() == LinkState::Streaming {
                let now = far.now();
                let slots = self.link.slots().unwrap();
                let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap() + 1;
                let (id, target) = (self.next_id, slots.start(slot));
                let dark_from = slots.dark_from(slot, 20_000_000_000);
                let sent = self.link.send_frame(now, id, target, dark_from, &planes(id), &mut self.line);
                if sent == SendOutcome::Sent {
                    self.next_id += 1;
                }
            }
            if done(self) {
                return start.elapsed();
            }
            let status = far.with(|m| m.status());
            assert!(start.elapsed() < limit, "{:?} {status:?} {:?}", self.link.state(), self.line);
            std::thread::sleep(Duration::from_micros(300));
        }
    }
}

fn check_lit(far: &Far) {
    far.with(|m| {
        let id = m.lit_frame().expect("a frame is lit");
        assert_eq!(m.lit_planes().unwrap(), planes(u64::from(id)));
    });
}

const LONG: Duration = Duration::from_secs(10);

fn setup() -> Arc<Mutex<SerialProjector>> {
    Arc::new(Mutex::new(SerialProjector::new(MockProjector::new(MockConfig::new(raster())))))
}

#[test]
fn frames_cross_a_serial_line_and_noise_costs_frames_not_the_link() {
    for codecs in [Codec::Raw.mask(), Codec::ALL] {
        let (master, slave) = pair();
        let far = Far::new(master, setup(), Instant::now());
        let mut near = Near::new(SerialTransport::with_port(settings("pty"), slave), codecs);
        near.link.connect();
        near.until(&far, LONG, |_| far.with(|m| m.status().frames_lit) >= 10);
        check_lit(&far);
        let clean = far.with(|m| m.status());
        assert_eq!((clean.frames_incomplete, clean.header_errors, clean.payload_errors), (0, 0, 0));
        // Noise in the middle of whatever is going on, delimiters and half packets included.
        for noise in [&b"\x00"[..], b"\x05DPML\x00", b"junk without an end", &[0xff; 300], &[0; 5]] {
            far.garbage.lock().unwrap().extend_from_slice(noise);
            let from = far.with(|m| m.status().frames_lit);
            near.until(&far, LONG, |_| far.with(|m| m.status().frames_lit) >= from + 5);
            check_lit(&far);
        }
        assert_eq!(near.link.counters().sessions, 1, "the session survived");
        if codecs == Codec::ALL {
            let c = near.link.counters();
            assert!(c.planes_kept > c.planes_raw, "still planes are not sent: {c:?}");
        }
    }
}

/// A new pseudo-terminal behind `path`, as an adapter that is plugged in: its name and its far end.
fn plug(path: &Path) -> (PortName, Box<dyn SerialPort>) {
    let (master, slave) = pair();
    (PortName::give(path, &slave.name().unwrap()).unwrap(), master)
}

#[test]
fn a_line_that_is_cut_is_noticed_and_taken_up_again() {
    let folder = std::env::temp_dir().join(format!("dpm-serial-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("port");
    let (start, mock) = (Instant::now(), setup());
    // The near end first: a far end without a near one reads as hung up.
    let (name, master) = plug(&path);
    let line = SerialTransport::open(settings(path.to_str().unwrap())).unwrap();
    let mut far = Far::new(master, mock.clone(), start);
    let second = SerialTransport::open(settings(line.name())).unwrap_err();
    assert!(matches!(second, TransportError::InUse { .. }), "exclusive: {second}");
    let mut near = Near::new(line, Codec::Raw.mask());
    near.link.connect();
    near.until(&far, LONG, |_| far.with(|m| m.status().frames_lit) >= 5);
    drop(name);
    far.hang_up();
    let noticed = near.until(&far, LONG, |n| n.link.state() == LinkState::Lost);
    assert!(noticed < Duration::from_millis(100), "{noticed:?}");
    let (_name, master) = plug(&path);
    let replug = Instant::now();
    near.until(&far, LONG, |n| n.link.state() == LinkState::Greeting);
    let far = Far::new(master, mock, start);
    near.until(&far, LONG, |n| n.link.state() == LinkState::Streaming);
    assert!(replug.elapsed() < Duration::from_secs(1), "{:?}", replug.elapsed());
    near.until(&far, LONG, |_| far.with(|m| m.status().frames_lit) >= 5);
    check_lit(&far);
    assert_eq!(near.line.counters().opened, 2);
    let _ = std::fs::remove_dir_all(&folder);
}

#[test]
fn an_absent_port_is_named() {
    let error = SerialTransport::open(settings("/dev/no-such-port")).unwrap_err();
    assert!(matches!(error, TransportError::NotFound { .. }), "{error}");
    assert!(error.to_string().contains("/dev/no-such-port"));
}

/// A line that takes nothing (nobody reads) holds nobody: neither the host who sends frames nor a device that answers.
#[test]
fn a_line_that_nobody_reads_never_holds_the_caller() {
    let (sender, ended) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let (_silent, slave) = pair();
        let mut line = SerialTransport::with_port(settings("pty"), slave);
        let bytes = vec![0x55; raster().plane_bytes()];
        let header = Header { led_code: 0x27, ..Header::control(MessageType::Plane, 1, 0) };
        let packets = vec![Packet::new(header, &bytes); 8];
        // A kernel's line holds some thousand bytes: more than one frame, far fewer than these.
        let mut taken = 0;
        for _ in 0..200 {
            match line.send(HostTime(0), Lane::Data, &packets) {
                Ok(()) => taken += 1,
                Err(SendError::Busy) => break,
                Err(e) => panic!("{e}"),
            }
        }
        assert!(taken < 200 && line.waiting() > 0, "the line is full");
        // Going dark may still be asked for: it waits its turn without holding anybody.
        line.send(HostTime(0), Lane::Control, &[Packet::new(Header::control(MessageType::Stop, 1, 0), &[])])
            .unwrap();
        let (mut answers, _silent) = pair();
        let block = [0u8; 4096];
        let full = (0..200).find_map(|_| answers.write(&block).err()).expect("room ends");
        assert!(
            matches!(full.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut),
            "{full:?}"
        );
        sender.send(()).unwrap();
    });
    ended.recv_timeout(LONG).expect("nobody waits for a full line");
}

/// A device that talks while the port is opened is heard from its next packet on, and the rest of the one before is no fault
/// of its own. Noise later on is passed on, and counted.
#[test]
fn a_port_that_is_opened_amid_a_packet_begins_with_the_next_one() {
    let (mut far, slave) = pair();
    let mut line = SerialTransport::with_port(settings("pty"), slave);
    let whole = Packet::new(Header::control(MessageType::Stop, 7, 0), &[]).to_vec();
    let mut frame = vec![0; dpm_device::cobs::encoded_bytes(whole.len())];
    let n = dpm_device::cobs::encode(&[&whole], &mut frame).unwrap();
    frame.truncate(n);
    let mut rest = vec![2, 9];
    rest.extend(&frame[n - 4..]);
    let noise = [3, 8, 8, 0];
    far.write_all(&[&rest[..], &frame, &noise, &frame].concat()).unwrap();
    let (mut heard, end) = (Vec::new(), Instant::now() + LONG);
    while heard.len() < 3 && Instant::now() < end {
        line.receive(HostTime(0), &mut |_, _, bytes| heard.push(bytes.to_vec())).unwrap();
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(heard, [whole.clone(), vec![8, 8], whole]);
}

/// Found in use, section 2b of the second look at latency: a reply that waits for the next poll is stamped when it arrived.
#[test]
fn replies_are_stamped_when_they_arrive() {
    let shortest = |with_clock: bool| {
        let (master, slave) = pair();
        let far = Far::new(master, setup(), Instant::now());
        let mut near = Near::new(SerialTransport::with_port(settings("pty"), slave), Codec::Raw.mask());
        if with_clock {
            let start = far.start;
            near.line.set_clock(Arc::new(move || HostTime(start.elapsed().as_nanos() as i64)));
        }
        near.link.connect();
        let mut shortest = i64::MAX;
        for _ in 0..40 {
            // Long after any answer has come.
            std::thread::sleep(Duration::from_millis(20));
            let _ = near.link.poll(far.now(), &mut near.line);
            near.link.take_echoes(|e| {
                assert!(e.host_sent_at.0 <= e.device_received_at.0 as i64, "one clock stands behind both");
                assert!(e.device_sent_at.0 as i64 <= e.host_received_at.0);
                shortest = shortest.min(e.host_received_at.ns_since(e.host_sent_at));
            });
        }
        shortest
    };
    assert!(shortest(true) < 10_000_000, "{} ns", shortest(true));
    assert!(shortest(false) >= 20_000_000, "what the stamps are for: {} ns", shortest(false));
}

/// A line of a given rate in virtual time, whose kernel takes a lot and whose driver may be one that cannot take it back.
#[derive(Clone)]
struct SlowLine(Arc<Mutex<SlowLineState>>);

struct SlowLineState {
    /// Accepted by the kernel, not on the line yet.
    queue: std::collections::VecDeque<u8>,
    replies: Vec<u8>,
    can_flush: bool,
}

/// What the kernel takes at once.
const KERNEL_BYTES: usize = 64 * 1024;

impl Line for SlowLine {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let queue = &mut self.0.lock().unwrap().queue;
        let n = bytes.len().min(KERNEL_BYTES - queue.len());
        queue.extend(&bytes[..n]);
        Ok(n)
    }

    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        let replies = &mut self.0.lock().unwrap().replies;
        let n = bytes.len().min(replies.len());
        bytes[..n].copy_from_slice(&replies[..n]);
        replies.drain(..n);
        Ok(n)
    }

    fn waiting(&self) -> std::io::Result<usize> {
        Ok(self.0.lock().unwrap().queue.len())
    }

    fn discard_output(&self) {
        let mut state = self.0.lock().unwrap();
        if state.can_flush {
            state.queue.clear();
        }
    }
}

/// Found in use, R2 and its siblings: dark within 50 ms of the order, on a line that is full of planes, whether its driver can take
/// back what it was given or not, and whatever the order cuts.
#[test]
fn stop_means_dark_within_50_ms_on_a_line_that_is_full() {
    use dpm_device::link::Verb;
    for baud in [115_200u32, 921_600, 3_000_000] {
        for (verb, can_flush) in
            [(Verb::Stop, true), (Verb::Stop, false), (Verb::Black, true), (Verb::Safe, false)]
        {
            let queue = std::collections::VecDeque::new();
            let line =
                SlowLine(Arc::new(Mutex::new(SlowLineState { queue, replies: Vec::new(), can_flush })));
            let far = SerialProjector::new(MockProjector::new(MockConfig::new(raster())));
            let mut far = far;
            let near_end = SerialSettings { baud, ..settings("slow") };
            let near_end = SerialTransport::with_port(near_end, Box::new(LinePort(line.clone())));
            let mut near = Near::new(near_end, Codec::Raw.mask());
            near.link.connect();
            let (mut ordered_at, mut dark_at) = (None, None);
            let mut carried = 0u64;
            // A tenth of a millisecond a step; the host polls once a millisecond.
            for step in 1..200_000i64 {
                let now = HostTime(step * 100_000);
                let due = now.0 as u64 * u64::from(baud) / 10_000_000_000;
                let bytes: Vec<u8> = {
                    let queue = &mut line.0.lock().unwrap().queue;
                    let n = ((due - carried) as usize).min(queue.len());
                    queue.drain(..n).collect()
                };
                carried = due;
                far.receive(now, &bytes);
                let out = far.replies(now);
                line.0.lock().unwrap().replies.append(out);
                if step % 10 != 0 && ordered_at.is_none() {
                    continue;
                }
                let _ = near.link.poll(now, &mut near.line);
                match near.link.state() {
                    LinkState::Ready if ordered_at.is_none() => near.link.arm(0),
                    LinkState::Streaming => {
                        let slots = near.link.slots().unwrap();
                        let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap() + 1;
                        let (id, dark_from) = (near.next_id, slots.dark_from(slot, 60_000_000_000));
                        let sent = near.link.send_frame(
                            now,
                            id,
                            slots.start(slot),
                            dark_from,
                            &planes(id),
                            &mut near.line,
                        );
                        near.next_id += u64::from(sent == SendOutcome::Sent);
                    }
                    _ => {}
                }
                let lit = far.projector().is_lit();
                let frames_lit = far.projector().status().frames_lit;
                // In the middle of a frame, some time after the first was lit.
                if ordered_at.is_none() && lit && frames_lit >= 3 && near.line.waiting() > 500 {
                    near.link.command(now, verb, &mut near.line).unwrap();
                    ordered_at = Some(now);
                }
                if ordered_at.is_some() && !lit && dark_at.is_none() {
                    dark_at = Some(now);
                }
                if dark_at.is_some_and(|at| now.ns_since(at) > 200_000_000) {
                    break;
                }
            }
            let context = format!("{baud} baud, {verb:?}, flush {can_flush}");
            let ordered_at = ordered_at.unwrap_or_else(|| panic!("never streamed: {context}"));
            let dark_at = dark_at.unwrap_or_else(|| panic!("never dark: {context}"));
            let ms = dark_at.ns_since(ordered_at) as f64 * 1e-6;
            println!("{context}: dark after {ms:.1} ms");
            assert!(ms <= 50.0, "{context}: dark after {ms:.1} ms");
            // And it stays so: nothing that was on its way lights it again, and the host knows.
            assert!(!far.projector().is_lit(), "{context}");
            let state = near.link.status().unwrap().state;
            assert_ne!(state, dpm_device::link::DeviceState::Armed, "{context}");
        }
    }
}
