//! The client against a device in memory, whose line may hold back what it says.

use super::*;
use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Mutex;

#[derive(Default)]
struct Wire {
    to_host: VecDeque<u8>,
    to_device: Vec<u8>,
}

#[derive(Clone, Default)]
struct Port(Arc<Mutex<Wire>>);

impl Stream for Port {}

impl Read for Port {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        match self.0.lock().unwrap().to_host.read(into)? {
            0 => Err(ErrorKind::WouldBlock.into()),
            n => Ok(n),
        }
    }
}

impl Write for Port {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().to_device.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A tracker, and a device that sends a pose every 10 ms with the truth about its capture.
struct Bench {
    now: Arc<AtomicI64>,
    port: Port,
    tracker: SerialTracker,
    deframer: Deframer<[u8; MAX_PACKET]>,
    /// What its clock showed at time 0, microseconds.
    clock_us: i64,
    answers: bool,
    held: Vec<u8>,
    sequence: u32,
}

impl Bench {
    fn new() -> Self {
        let now = Arc::new(AtomicI64::new(0));
        let clock = now.clone();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(clock.load(Ordering::Relaxed)));
        let bodies = vec![BodyKey { name: "a".into(), id: None }];
        let config = SerialTrackerConfig { port: "memory".into(), baud: 921_600, bodies };
        let port = Port::default();
        let tracker = SerialTracker::over(config, clock, Box::new(port.clone())).unwrap();
        let deframer = Deframer::new([0; MAX_PACKET]);
        let held = Vec::new();
        Self { now, port, tracker, deframer, clock_us: 50_000_000, answers: true, held, sequence: 0 }
    }

    /// Runs for `ms`; returns the samples as (captured by the client, truly captured), milliseconds.
    fn run(&mut self, ms: i64, holds: bool) -> Vec<(i64, i64)> {
        let mut samples = Vec::new();
        for _ in 0..ms {
            let now = self.now.fetch_add(MS, Ordering::Relaxed) + MS;
            let ticks = (now / 1_000 + self.clock_us) as u64;
            let mut said = std::mem::take(&mut self.held);
            let asked = std::mem::take(&mut self.port.0.lock().unwrap().to_device);
            let answers = self.answers;
            self.deframer.push(&asked, &mut |packet| match SerialMessage::decode(packet) {
                Ok(SerialMessage::HelloRequest) => {
                    SerialMessage::Hello { version: VERSION, bodies: 1, ticks_per_second: 1_000_000 }
                        .encode(&mut said);
                }
                Ok(SerialMessage::EchoRequest { token }) if answers => {
                    SerialMessage::EchoResponse { token, ticks }.encode(&mut said);
                }
                _ => {}
            });
            if now / MS % 10 == 0 {
                self.sequence += 1;
                // The position is the time of capture.
                SerialMessage::Pose {
                    body: 0,
                    tracked: true,
                    sequence: self.sequence,
                    captured: ticks,
                    position: [(now / MS) as f32 * 1e-3, 0.0, 0.0],
                    rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
                    mean_error: 0.0,
                }
                .encode(&mut said);
            }
            if holds {
                self.held = said;
            } else {
                self.port.0.lock().unwrap().to_host.extend(said);
            }
            let truth = |s: &TrackerSample| (s.pose.position_m[0] * 1e3).round() as i64;
            let mut sink = |s: &TrackerSample| samples.push((s.captured_at.0 / MS, truth(s)));
            self.tracker.poll(HostTime(now), &mut sink).unwrap();
            assert!(self.tracker.counters().is_conserved());
        }
        samples
    }
}

fn are_true(samples: &[(i64, i64)]) -> bool {
    samples.iter().all(|(told, truth)| (told - truth).abs() <= 2)
}

#[test]
fn poses_that_waited_for_seconds_are_not_dated_as_new() {
    let mut bench = Bench::new();
    let before = bench.run(1_000, false);
    assert!(before.len() > 80 && are_true(&before), "{before:?}");
    assert!(bench.run(3_000, true).is_empty());
    let after = bench.run(300, false);
    assert!(are_true(&after), "{after:?}");
    // What is new is passed on as soon as an echo has told that the clock is right.
    assert!(after.iter().any(|(_, truth)| *truth <= 4_050), "{after:?}");
    assert!(bench.tracker.counters().samples.unknown_age > 100, "{}", bench.tracker.status());
}

#[test]
fn a_clock_that_steps_is_learned_anew_and_no_wrong_age_is_passed_on() {
    for step_us in [-40_000_000, 40_000_000] {
        let mut bench = Bench::new();
        bench.run(1_000, false);
        bench.clock_us += step_us;
        let after = bench.run(300, false);
        assert!(after.len() > 15 && are_true(&after), "{step_us}: {after:?}");
    }
}

#[test]
fn a_device_that_steps_and_answers_no_echo_any_more_is_dated_by_arrival() {
    let mut bench = Bench::new();
    bench.run(1_000, false);
    (bench.answers, bench.clock_us) = (false, 0);
    let after = bench.run(1_000, false);
    assert!(after.len() > 50 && are_true(&after), "{after:?}");
}

#[test]
fn a_line_that_is_held_back_from_the_beginning_is_not_dated_by_arrival() {
    let mut bench = Bench::new();
    bench.answers = false;
    bench.run(200, false);
    bench.run(700, true);
    bench.answers = true;
    let after = bench.run(300, false);
    assert!(after.len() >= 15 && are_true(&after), "{after:?}");
}

#[test]
fn a_device_that_never_answered_is_doubted_again_after_each_pause() {
    let mut bench = Bench::new();
    bench.answers = false;
    let before = bench.run(1_000, false);
    assert!(before.len() > 50 && are_true(&before), "{before:?}");
    bench.run(500, true);
    let after = bench.run(1_000, false);
    assert!(after.len() > 50 && are_true(&after), "{after:?}");
}
