//! The client against a server in memory, to which it can connect again and again.

use super::*;
use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Mutex;

#[derive(Default)]
struct Wire {
    to_host: VecDeque<u8>,
    to_server: Vec<u8>,
    connections: u32,
    is_away: bool,
    /// It accepts connections and says nothing.
    is_dumb: bool,
}

#[derive(Clone, Default)]
struct Network(Arc<Mutex<Wire>>);

impl Opener for Network {
    fn begin(&mut self) -> bool {
        true
    }

    fn outcome(&mut self) -> Option<Result<Box<dyn Stream>, String>> {
        let mut wire = self.0.lock().unwrap();
        if wire.is_away {
            return Some(Err("refused".into()));
        }
        wire.connections += 1;
        wire.to_server.clear();
        wire.to_host.clear();
        if wire.is_dumb {
            return Some(Ok(Box::new(Socket(self.clone(), wire.connections))));
        }
        wire.to_host.extend(COOKIE);
        let mut names = Vec::new();
        wire::put_description(&mut names, system::TYPE, 0, type_name::POS_QUAT);
        wire::put_description(&mut names, system::TYPE, 2, type_name::PONG);
        wire::put_description(&mut names, system::SENDER, 0, "Tracker0");
        wire.to_host.extend(names);
        Some(Ok(Box::new(Socket(self.clone(), wire.connections))))
    }
}

/// One connection; the server forgets it when there is a newer one.
struct Socket(Network, u32);

impl Stream for Socket {}

impl Read for Socket {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut wire = self.0 .0.lock().unwrap();
        assert_eq!(wire.connections, self.1);
        match wire.to_host.read(into)? {
            0 => Err(ErrorKind::WouldBlock.into()),
            n => Ok(n),
        }
    }
}

impl Write for Socket {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 .0.lock().unwrap().to_server.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// What the server does in a run.
#[derive(Clone, Copy, PartialEq)]
enum Does {
    Speaks,
    /// What it says is held back.
    IsHeld,
    /// Nothing arrives, and it answers no more.
    IsMute,
    /// It answers no pings.
    IgnoresPings,
}

struct Bench {
    now: Arc<AtomicI64>,
    network: Network,
    client: VrpnClient,
    clock_us: i64,
    /// Bytes that are held back.
    held: Vec<u8>,
    /// The program that polls is stopped.
    is_stopped: bool,
    /// When the client sent something, milliseconds.
    sent_at: Vec<i64>,
}

impl Bench {
    fn new() -> Self {
        let now = Arc::new(AtomicI64::new(0));
        let clock = now.clone();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(clock.load(Ordering::Relaxed)));
        let bodies = vec![BodyKey { name: "a".into(), id: None }];
        let config = VrpnConfig { server: "memory".into(), tracker: "Tracker0".into(), bodies };
        let network = Network::default();
        let client = VrpnClient::open_through(config, clock, Box::new(network.clone())).unwrap();
        Self {
            now,
            network,
            client,
            clock_us: 1_700_000_000_000_000,
            held: Vec::new(),
            is_stopped: false,
            sent_at: Vec::new(),
        }
    }

    fn message(&self, now: i64, kind: i32, payload: &[u8]) -> Vec<u8> {
        let us = now / 1_000 + self.clock_us;
        let (seconds, microseconds) = ((us / 1_000_000) as u32, (us % 1_000_000) as u32);
        let mut out = Vec::new();
        wire::put(&mut out, &Message { seconds, microseconds, sender: 0, kind, sequence: 0, payload });
        out
    }

    /// Runs for `ms`; returns the samples as (captured by the client, truly captured), milliseconds.
    fn run(&mut self, ms: i64, does: Does) -> Vec<(i64, i64)> {
        let mut samples = Vec::new();
        for _ in 0..ms {
            let now = self.now.fetch_add(MS, Ordering::Relaxed) + MS;
            let asked = std::mem::take(&mut self.network.0.lock().unwrap().to_server);
            if !asked.is_empty() {
                self.sent_at.push(now / MS);
            }
            let mut said = std::mem::take(&mut self.held);
            // The client's type 0 is the ping; descriptions have negative ones.
            let ping = |m: &[u8]| m.len() == 24 && m[16..20] == [0; 4];
            if does != Does::IsMute {
                if does != Does::IgnoresPings && asked.chunks(24).any(ping) && asked.len() == 24 {
                    said.extend(self.message(now, 2, &[]));
                }
                if now / MS % 10 == 0 {
                    let position_m = [(now / MS) as f64 * 1e-3, 0.0, 0.0];
                    let pose = crate::pose::Pose { position_m, ..crate::pose::Pose::IDENTITY };
                    said.extend(self.message(now, 0, &wire::encode_pos_quat(0, &pose)));
                }
            }
            if does == Does::IsHeld {
                self.held = said;
            } else if self.network.0.lock().unwrap().connections > 0 {
                self.network.0.lock().unwrap().to_host.extend(said);
            }
            let truth = |s: &TrackerSample| (s.pose.position_m[0] * 1e3).round() as i64;
            let mut sink = |s: &TrackerSample| samples.push((s.captured_at.0 / MS, truth(s)));
            if !self.is_stopped {
                self.client.poll(HostTime(now), &mut sink).unwrap();
            }
            assert!(self.client.counters().is_conserved());
        }
        samples
    }

    fn connections(&self) -> u32 {
        self.network.0.lock().unwrap().connections
    }
}

fn are_true(samples: &[(i64, i64)]) -> bool {
    samples.iter().all(|(told, truth)| (told - truth).abs() <= 2)
}

#[test]
fn poses_that_waited_while_the_program_was_stopped_are_not_dated_as_new() {
    let mut bench = Bench::new();
    let before = bench.run(1_000, Does::Speaks);
    assert!(before.len() > 80 && are_true(&before[10..]), "{before:?}");
    bench.is_stopped = true;
    bench.run(2_500, Does::Speaks);
    bench.is_stopped = false;
    let after = bench.run(300, Does::Speaks);
    assert!(after.len() > 20 && are_true(&after), "{after:?}");
    // What waited was not taken for silence.
    assert_eq!(bench.connections(), 1, "{}", bench.client.status());
}

#[test]
fn a_server_whose_clock_is_set_is_believed_again_after_some_pongs() {
    for step_us in [-40_000_000, 40_000_000] {
        let mut bench = Bench::new();
        bench.run(1_050, Does::Speaks);
        bench.clock_us += step_us;
        let after = bench.run(400, Does::Speaks);
        assert!(after.len() > 20 && are_true(&after), "{step_us}: {after:?}");
        assert!(bench.client.counters().samples.unknown_age > 0);
    }
}

#[test]
fn a_connection_that_nobody_answers_is_given_up_after_a_second() {
    let mut bench = Bench::new();
    bench.run(1_000, Does::Speaks);
    bench.run(1_600, Does::IsMute);
    assert_eq!(bench.connections(), 2, "{}", bench.client.status());
    // The ping of the new connection is lost, so that poses wait until the server has been heard for 300 ms.
    let after = bench.run(600, Does::Speaks);
    assert!(after.len() > 20, "{}", bench.client.status());
    // One that refuses is asked four times a second.
    bench.network.0.lock().unwrap().is_away = true;
    bench.run(2_000, Does::IsMute);
    bench.network.0.lock().unwrap().is_away = false;
    let after = bench.run(400, Does::Speaks);
    assert!(after.len() > 10, "{}", bench.client.status());
}

#[test]
fn a_connection_that_is_not_greeted_is_given_up_after_a_second() {
    let mut bench = Bench::new();
    bench.network.0.lock().unwrap().is_dumb = true;
    bench.run(900, Does::IsMute);
    assert_eq!(bench.connections(), 1, "{}", bench.client.status());
    assert!(bench.client.status().contains("did not greet"), "{}", bench.client.status());
    bench.network.0.lock().unwrap().is_dumb = false;
    bench.run(400, Does::IsMute);
    assert_eq!(bench.connections(), 2, "{}", bench.client.status());
    assert!(bench.run(500, Does::Speaks).len() > 20, "{}", bench.client.status());
}

#[test]
fn what_a_network_held_back_for_a_moment_keeps_its_age() {
    let mut bench = Bench::new();
    bench.run(1_000, Does::Speaks);
    bench.run(600, Does::IsHeld);
    let after = bench.run(300, Does::Speaks);
    assert!(after.len() > 80 && are_true(&after), "{after:?}");
    assert_eq!(bench.connections(), 1);
}

/// The simulator found light 22 mm beside a body: the first pose of a connection was dated by its arrival, 3.5 ms late, and the
/// second by a pong, so that the body seemed to leap.
#[test]
fn poses_of_a_new_connection_wait_for_a_pong_and_not_for_long() {
    let mut bench = Bench::new();
    // What the server says first is late.
    bench.run(40, Does::IsHeld);
    let early = bench.run(200, Does::Speaks);
    assert!(are_true(&early) && early.len() > 15, "{early:?}");
    assert!(bench.client.counters().samples.unknown_age > 0, "{:?}", bench.client.counters());
    let mut without = Bench::new();
    without.run(40, Does::IsHeld);
    let late = without.run(600, Does::IgnoresPings);
    assert!((300..420).contains(&late[0].1), "{late:?}");
    assert!(are_true(&late) && late.len() > 20, "{late:?}");
}

/// The simulator found light 125 mm beside a body: the network was cut just after the server had greeted. The doubt about the
/// age of poses had lapsed by the time when all arrived that had waited.
#[test]
fn poses_that_waited_since_the_greeting_are_not_dated_as_new() {
    for does in [Does::Speaks, Does::IgnoresPings] {
        let mut bench = Bench::new();
        bench.run(40, Does::IsHeld);
        assert_eq!(bench.run(1_200, Does::IsHeld), [], "nothing arrives");
        let after = bench.run(700, does);
        assert!(after.len() > 20 && are_true(&after), "{after:?}");
        assert_eq!(bench.connections(), 1, "{}", bench.client.status());
    }
}

/// A machine that has forgotten a connection says so when something is sent to it. While a ping waits for its pong, no other
/// follows for a second.
#[test]
fn a_silent_server_is_asked_for_five_times_a_second() {
    let mut bench = Bench::new();
    bench.run(1_000, Does::Speaks);
    bench.sent_at.clear();
    bench.run(900, Does::IsMute);
    let since: Vec<i64> = bench.sent_at.iter().map(|at| at - 1_000).collect();
    assert!(since.len() >= 4, "{since:?}");
    assert!(since.windows(2).all(|pair| pair[1] - pair[0] <= 205) && since[0] <= 405, "{since:?}");
    assert_eq!(bench.connections(), 1);
}
