//! What waited in the sockets while nobody read, against a server in memory whose datagrams the kernel stamps.

use super::super::frame::{encode_frame, FrameContent};
use super::*;
use std::collections::VecDeque;
use std::io;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Mutex;

const SERVER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 1510);
const S: i64 = 1_000 * MS;

/// The host's clock, and how far the wall clock is ahead of it.
#[derive(Default)]
struct Clocks {
    host_ns: AtomicI64,
    wall_ahead_ns: AtomicI64,
}

impl HostClock for Clocks {
    fn now(&self) -> HostTime {
        HostTime(self.host_ns.load(Ordering::Relaxed))
    }
}

/// Datagrams with the stamps of their arrival.
type Queue = VecDeque<(Vec<u8>, i64)>;

#[derive(Clone)]
struct Port(Arc<Clocks>, Arc<Mutex<Queue>>);

impl Datagrams for Port {
    fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<Arrival>> {
        let Some((datagram, stamp)) = self.1.lock().unwrap().pop_front() else { return Ok(None) };
        buffer[..datagram.len()].copy_from_slice(&datagram);
        Ok(Some(Arrival { len: datagram.len(), from: SERVER, kernel_ns: Some(stamp), cut: false }))
    }

    fn send(&self, _: &[u8], _: SocketAddrV4) -> io::Result<()> {
        Ok(())
    }

    fn keep_only(&self, _: Ipv4Addr, _: &[u16]) -> io::Result<()> {
        Ok(())
    }

    fn keep_all(&self) -> io::Result<()> {
        Ok(())
    }

    fn local(&self) -> io::Result<SocketAddrV4> {
        Ok(SERVER)
    }

    fn realtime_offset_ns(&self, _: &dyn HostClock) -> i64 {
        -self.0.wall_ahead_ns.load(Ordering::Relaxed)
    }
}

struct Bench {
    clocks: Arc<Clocks>,
    port: Port,
    client: NatNetClient,
    number: i32,
}

impl Bench {
    fn new() -> Self {
        let clocks = Arc::new(Clocks::default());
        clocks.host_ns.store(100 * S, Ordering::Relaxed);
        clocks.wall_ahead_ns.store(1_700_000_000 * S, Ordering::Relaxed);
        let port = Port(clocks.clone(), Arc::default());
        let body = BodyKey { name: "hare".into(), id: Some(1) };
        let config = NatNetConfig::unicast(Ipv4Addr::LOCALHOST, vec![body]);
        let client = NatNetClient::with_ports(config, clocks.clone(), Box::new(port.clone()), None);
        Self { clocks, port, client, number: 0 }
    }

    fn forward(&self, ns: i64) {
        self.clocks.host_ns.fetch_add(ns, Ordering::Relaxed);
    }

    /// A frame arrives now. The body is at as many metres as the host's clock shows seconds.
    fn send_frame(&mut self) {
        self.number += 1;
        let at = self.clocks.now().0;
        let body = RigidBody {
            id: 1,
            position: [at as f32 / S as f32, 0.0, 0.0],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            mean_error: 0.0,
            params: 1,
        };
        let (info, mut out) = (FrameInfo { number: self.number, ..FrameInfo::default() }, Vec::new());
        let content = FrameContent { bodies: &[body], ..FrameContent::default() };
        encode_frame(&mut out, Version::V3_0, &info, &content).unwrap();
        let stamp = at + self.clocks.wall_ahead_ns.load(Ordering::Relaxed);
        self.port.1.lock().unwrap().push_back((out, stamp));
    }

    /// How far each delivered sample is from where the body was at its time of capture, seconds of the body's way.
    fn poll(&mut self) -> Vec<f64> {
        let mut errors = Vec::new();
        let now = self.clocks.now();
        self.client
            .poll(now, &mut |s| {
                errors.push((s.captured_at.0 as f64 / S as f64 - s.pose.position_m[0]).abs());
            })
            .unwrap();
        errors
    }
}

/// The program is stopped for two seconds, in which 240 frames arrive, and `meanwhile` happens after one of them.
fn stopped(meanwhile: impl Fn(&Clocks)) -> (Bench, Vec<f64>) {
    let mut bench = Bench::new();
    for _ in 0..10 {
        bench.forward(8 * MS);
        bench.send_frame();
        assert!(bench.poll().iter().all(|error| *error < 1e-4));
    }
    for frame in 0..240 {
        bench.forward(S / 120);
        bench.send_frame();
        if frame == 100 {
            meanwhile(&bench.clocks);
        }
    }
    let mut errors = Vec::new();
    for _ in 0..8 {
        errors.extend(bench.poll());
        bench.forward(MS);
    }
    (bench, errors)
}

/// The kernel's stamps date whatever waited, however many polls it takes to read.
#[test]
fn what_waited_is_dated_by_its_stamps() {
    let (bench, errors) = stopped(|_| ());
    assert_eq!(errors.len(), 240);
    assert!(errors.iter().all(|error| *error < 1e-4), "{errors:?}");
    assert_eq!(bench.client.counters().samples.unknown_age, 0);
}

/// A wall clock that was set meanwhile, forwards or backwards, by little or by much, dates none of it, and neither does
/// anything else; what arrives later is used at once.
#[test]
fn what_waited_while_the_wall_clock_was_set_is_of_unknown_age() {
    for set_ns in [-3_600 * S, -S, -50 * MS, 50 * MS, S, 3_600 * S] {
        let (mut bench, errors) = stopped(|clocks| {
            clocks.wall_ahead_ns.fetch_add(set_ns, Ordering::Relaxed);
        });
        assert_eq!(errors, [0.0; 0], "set by {set_ns} ns");
        assert_eq!(bench.client.counters().samples.unknown_age, 240);
        bench.send_frame();
        let errors = bench.poll();
        assert!(errors.len() == 1 && errors[0] < 1e-4, "set by {set_ns} ns: {errors:?}");
    }
}
