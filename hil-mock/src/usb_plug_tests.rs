//! The plug's laws: order, halts, cancelling, standard requests, unplugging, faults.

use super::*;
use crate::usb_model::Speed;
use std::sync::mpsc::{channel, Receiver};

/// Endpoint 0x01 stores bytes, 0x81 returns them and refuses while empty.
#[derive(Default)]
struct Loopback {
    stored: VecDeque<u8>,
    cleared: Vec<u8>,
}

impl UsbDeviceModel for Loopback {
    fn speed(&self) -> Speed {
        Speed::High
    }
    fn device_descriptor(&self) -> &[u8] {
        &[18, 1, 0, 2, 0, 0, 0, 64, 0x34, 0x12, 0x78, 0x56, 0, 1, 0, 1, 0, 1]
    }
    fn configuration_descriptor(&self) -> &[u8] {
        &[9, 2, 9, 0, 0, 1, 0, 0x80, 50]
    }
    fn string(&self, index: u8) -> Option<&str> {
        (index == 1).then_some("loop")
    }
    fn control(&mut self, now: HostTime, setup: &Setup, data: &mut [u8]) -> Progress {
        if setup.request != 7 {
            return Progress::stall(0);
        }
        data.fill(now.0 as u8);
        Progress::complete(data.len())
    }
    fn transfer_out(&mut self, _: HostTime, _: u8, data: &[u8]) -> Progress {
        self.stored.extend(data);
        Progress::complete(data.len())
    }
    fn transfer_in(&mut self, _: HostTime, _: u8, buffer: &mut [u8]) -> Progress {
        if self.stored.is_empty() {
            return Progress::nak(0);
        }
        let n = buffer.len().min(self.stored.len());
        buffer.iter_mut().zip(self.stored.drain(..n)).for_each(|(b, v)| *b = v);
        Progress::complete(n)
    }
    fn halt_cleared(&mut self, endpoint: u8) {
        self.cleared.push(endpoint);
    }
}

struct Bench {
    plug: UsbPlug,
    model: Arc<Mutex<Loopback>>,
    next: u64,
}

type Ended = Receiver<(Status, usize, Vec<u8>)>;

impl Bench {
    fn new() -> Self {
        let model = Arc::new(Mutex::new(Loopback::default()));
        Self { plug: UsbPlug::new(model.clone(), monotonic_clock()), model, next: 0 }
    }

    fn send(&mut self, endpoint: u8, setup: Option<Setup>, buffer: Vec<u8>) -> (u64, Ended) {
        let (tx, rx) = channel();
        self.next += 1;
        let done = Box::new(move |c: Completion| tx.send((c.status, c.actual, c.buffer)).unwrap());
        let sent = self.plug.submit(Request { id: self.next, endpoint, setup, buffer, done });
        assert!(sent.is_ok());
        (self.next, rx)
    }

    fn control(&mut self, bytes: [u8; 8]) -> (Status, Vec<u8>) {
        let setup = Setup::from_bytes(bytes);
        let (_, rx) = self.send(0, Some(setup), vec![0; usize::from(setup.length)]);
        let (status, n, data) = wait(&rx);
        (status, data[..n].to_vec())
    }
}

fn wait(rx: &Ended) -> (Status, usize, Vec<u8>) {
    rx.recv_timeout(Duration::from_secs(5)).expect("the transfer ends")
}

#[test]
fn a_refused_read_waits_for_data_or_is_taken_back() {
    let mut b = Bench::new();
    let (_, read) = b.send(0x81, None, vec![0; 8]);
    assert!(read.recv_timeout(Duration::from_millis(20)).is_err());
    let (_, write) = b.send(0x01, None, vec![1, 2, 3]);
    assert_eq!(wait(&write), (Status::Ok, 3, vec![1, 2, 3]));
    assert_eq!(wait(&read), (Status::Ok, 3, vec![1, 2, 3, 0, 0, 0, 0, 0]));
    let (first, r1) = b.send(0x81, None, vec![0; 8]);
    let (second, r2) = b.send(0x81, None, vec![0; 8]);
    assert!(b.plug.cancel(second) && b.plug.cancel(first));
    assert_eq!((wait(&r1).0, wait(&r2).0), (Status::Cancelled, Status::Cancelled));
    assert!(!b.plug.cancel(first), "an ended transfer cannot be taken back");
    assert_eq!(b.plug.in_flight(), 0);
}

#[test]
fn a_stall_lasts_until_the_halt_is_cleared() {
    let mut b = Bench::new();
    b.plug.inject(0x01, 1, Fault::Stall);
    let ended: Vec<_> = (0..3).map(|i| b.send(0x01, None, vec![i]).1).collect();
    let status: Vec<_> = ended.iter().map(|e| wait(e).0).collect();
    assert_eq!(status, [Status::Ok, Status::Stall, Status::Stall]);
    assert_eq!(b.control([0x82, 0, 0, 0, 1, 0, 2, 0]), (Status::Ok, vec![1, 0]));
    assert_eq!(b.control([0x02, 1, 0, 0, 1, 0, 0, 0]).0, Status::Ok);
    assert_eq!(b.control([0x82, 0, 0, 0, 1, 0, 2, 0]), (Status::Ok, vec![0, 0]));
    let (_, again) = b.send(0x01, None, vec![9]);
    assert_eq!(wait(&again).0, Status::Ok);
    let model = b.model.lock().unwrap();
    assert_eq!((Vec::from(model.stored.clone()), &model.cleared), (vec![0, 9], &vec![1]));
}

#[test]
fn standard_requests_are_answered_and_unknown_ones_refused() {
    let mut b = Bench::new();
    assert_eq!(b.control([0x80, 6, 0, 1, 0, 0, 8, 0]), (Status::Ok, vec![18, 1, 0, 2, 0, 0, 0, 64]));
    assert_eq!(b.control([0x80, 6, 0, 2, 0, 0, 255, 0]).1, [9, 2, 9, 0, 0, 1, 0, 0x80, 50]);
    assert_eq!(b.control([0x80, 6, 0, 3, 0, 0, 255, 0]).1, [4, 3, 9, 4]);
    assert_eq!(b.control([0x80, 6, 1, 3, 9, 4, 255, 0]).1, [10, 3, b'l', 0, b'o', 0, b'o', 0, b'p', 0]);
    assert_eq!(b.control([0x80, 6, 2, 3, 9, 4, 255, 0]).0, Status::Stall);
    assert_eq!(b.control([0x80, 8, 0, 0, 0, 0, 1, 0]).1, [0]);
    assert_eq!(b.control([0x00, 9, 1, 0, 0, 0, 0, 0]).0, Status::Ok);
    assert_eq!(b.control([0x80, 8, 0, 0, 0, 0, 1, 0]).1, [1]);
    assert_eq!(b.control([0x00, 9, 2, 0, 0, 0, 0, 0]).0, Status::Stall);
    assert_eq!(b.control([0xc0, 7, 0, 0, 0, 0, 3, 0]).1.len(), 3);
    assert_eq!(b.control([0xc0, 8, 0, 0, 0, 0, 3, 0]).0, Status::Stall);
}

#[test]
fn pulling_the_plug_ends_everything_before_it_is_signalled() {
    let mut b = Bench::new();
    let reads: Vec<_> = (0..5).map(|_| b.send(0x81, None, vec![0; 4]).1).collect();
    let (tx, gone) = channel();
    let plug = b.plug.clone();
    b.plug.on_unplug(Box::new(move || tx.send(plug.in_flight()).unwrap()));
    b.plug.inject(0x01, 0, Fault::Unplug(2));
    let (_, write) = b.send(0x01, None, vec![1, 2, 3, 4]);
    assert_eq!(wait(&write).0, Status::Gone);
    assert_eq!(gone.recv_timeout(Duration::from_secs(5)).unwrap(), 0);
    // The two bytes that crossed may have reached the first waiting read; no other read can have ended well.
    let ok = reads.iter().map(wait).filter(|r| r.0 == Status::Ok).count();
    assert!(ok <= 1);
    let refused = b.plug.submit(Request {
        id: 99,
        endpoint: 1,
        setup: None,
        buffer: vec![],
        done: Box::new(|_| panic!("a refused request never ends")),
    });
    assert!(refused.is_err() && !b.plug.is_plugged());
}

#[test]
fn faults_hit_the_transfer_they_are_planned_for() {
    let mut b = Bench::new();
    b.plug.inject(0x01, 0, Fault::Short(1));
    b.plug.inject(0x01, 1, Fault::BusError);
    b.plug.inject(0x81, 0, Fault::Babble);
    b.plug.inject(0x81, 1, Fault::NakNs(30_000_000));
    let (_, w0) = b.send(0x01, None, vec![5, 6]);
    let (_, w1) = b.send(0x01, None, vec![7]);
    assert_eq!((wait(&w0).1, wait(&w1).0), (1, Status::BusError));
    let (_, r0) = b.send(0x81, None, vec![0; 4]);
    let start = Instant::now();
    let (_, r1) = b.send(0x81, None, vec![0; 4]);
    assert_eq!(wait(&r0).0, Status::Babble);
    assert_eq!(wait(&r1), (Status::Ok, 1, vec![5, 0, 0, 0]));
    assert!(start.elapsed() >= Duration::from_millis(30));
    let start = Instant::now();
    b.plug.set_delay_ns(20_000_000);
    wait(&b.send(0x01, None, vec![1]).1);
    assert!(start.elapsed() >= Duration::from_millis(20));
}
