//! Tests USB/IP with golden bytes, with its own client, and with clients that violate the protocol.

use super::wire::*;
use super::*;
use crate::dlpc900::Dlpc900Model;
use crate::usb_model::Setup;
use crate::usb_plug::{monotonic_clock, Completion, Fault, Request, Status, UsbCable, UsbPlug};
use proptest::prelude::*;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::sync::mpsc::{channel, Receiver};
use std::sync::{Arc, Mutex};
use std::time::Duration;

fn dlpc900() -> (UsbPlug, Export) {
    let plug = UsbPlug::new(Arc::new(Mutex::new(Dlpc900Model::default())), monotonic_clock());
    (plug.clone(), Export::new("1-1", Arc::new(plug)))
}

fn record_bytes() -> Vec<u8> {
    let mut golden = b"/sys/devices/emulated/1-1".to_vec();
    golden.resize(256, 0);
    golden.extend(b"1-1");
    golden.resize(288, 0);
    // Bus 1, device 1, full speed, 0451:c900 release 1.00, class by interface, configuration 1 of 1 with 1 interface.
    golden.extend([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 2, 0x04, 0x51, 0xc9, 0x00, 0x01, 0x00, 0, 0, 0, 1, 1, 1]);
    golden
}

/// Speaks the protocol byte by byte, as written in the kernel's document.
#[test]
fn golden_list_import_submit_and_unlink() {
    let (_plug, export) = dlpc900();
    let talk = |send: &[u8]| {
        let (ours, theirs) = UnixStream::pair().unwrap();
        ours.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        let exports = [export.clone()];
        std::thread::spawn(move || serve(theirs, &exports));
        (&ours).write_all(send).unwrap();
        ours
    };
    let mut list = Vec::new();
    talk(&[0x01, 0x11, 0x80, 0x05, 0, 0, 0, 0]).read_to_end(&mut list).unwrap();
    let mut golden = vec![0x01, 0x11, 0x00, 0x05, 0, 0, 0, 0, 0, 0, 0, 1];
    golden.extend(record_bytes());
    // One interface: HID, no subclass.
    golden.extend([3, 0, 0, 0]);
    assert_eq!(list, golden);

    let mut import = vec![0x01, 0x11, 0x80, 0x03, 0, 0, 0, 0];
    import.extend(b"9-9");
    import.resize(40, 0);
    let mut refused = Vec::new();
    talk(&import).read_to_end(&mut refused).unwrap();
    assert_eq!(refused, [0x01, 0x11, 0x00, 0x03, 0, 0, 0, 1]);

    import[8..11].copy_from_slice(b"1-1");
    let mut link = talk(&import);
    let mut reply = vec![0; 8 + 312];
    link.read_exact(&mut reply).unwrap();
    assert_eq!(reply, [&[0x01, 0x11, 0x00, 0x03, 0, 0, 0, 0], &record_bytes()[..]].concat());
    // A second import while the first lasts is refused.
    let mut busy = Vec::new();
    talk(&import).read_to_end(&mut busy).unwrap();
    assert_eq!(busy, [0x01, 0x11, 0x00, 0x03, 0, 0, 0, 1]);

    let word = |n: u32| n.to_be_bytes();
    let words = |ns: &[u32]| ns.iter().flat_map(|n| word(*n)).collect::<Vec<u8>>();
    // GET_DESCRIPTOR(device), 8 bytes, number 7: command 1, number, device 1-1, IN, endpoint 0.
    let mut submit = words(&[1, 7, 0x0001_0001, 1, 0, 0x0200, 8, 0, 0xffff_ffff, 0]);
    submit.extend([0x80, 6, 0, 1, 0, 0, 8, 0]);
    link.write_all(&submit).unwrap();
    let mut answer = [0; 56];
    link.read_exact(&mut answer).unwrap();
    assert_eq!(answer[..48], words(&[3, 7, 0, 0, 0, 0, 8, 0, 0, 0, 0, 0])[..]);
    assert_eq!(answer[48..], [18, 1, 0x10, 0x01, 0, 0, 0, 64]);
    // Number 8 reads a reply that is not there; number 9 cancels it: only the unlink is answered, with -ECONNRESET.
    link.write_all(&words(&[1, 8, 0x0001_0001, 1, 1, 0x0200, 64, 0, 0xffff_ffff, 1, 0, 0])).unwrap();
    link.write_all(&words(&[2, 9, 0x0001_0001, 0, 0, 8, 0, 0, 0, 0, 0, 0])).unwrap();
    let mut answer = [0; 48];
    link.read_exact(&mut answer).unwrap();
    assert_eq!(answer[..], words(&[4, 9, 0, 0, 0, (-104i32) as u32, 0, 0, 0, 0, 0, 0])[..]);
    // Cancelling a transfer that has ended: status 0.
    link.write_all(&words(&[2, 10, 0x0001_0001, 0, 0, 7, 0, 0, 0, 0, 0, 0])).unwrap();
    link.read_exact(&mut answer).unwrap();
    assert_eq!(answer[..], words(&[4, 10, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])[..]);
    // A vendor request stalls: -EPIPE.
    let mut vendor = words(&[1, 11, 0x0001_0001, 1, 0, 0, 4, 0, 0xffff_ffff, 0]);
    vendor.extend([0xc0, 1, 0, 0, 0, 0, 4, 0]);
    link.write_all(&vendor).unwrap();
    link.read_exact(&mut answer).unwrap();
    assert_eq!(answer[..28], words(&[3, 11, 0, 0, 0, (-32i32) as u32, 0])[..]);
}

struct Bench {
    plug: UsbPlug,
    cable: RemoteCable,
    _server: Server,
}

fn bench() -> Bench {
    let (plug, export) = dlpc900();
    let server = Server::start("127.0.0.1:0", vec![export]).unwrap();
    let devices = list(server.address()).unwrap();
    assert_eq!(devices.iter().map(|d| (d.bus_id.as_str(), d.ids[1])).collect::<Vec<_>>(), [("1-1", 0xc900)]);
    let cable = RemoteCable::import(server.address(), "1-1").unwrap();
    Bench { plug, cable, _server: server }
}

type Ended = Receiver<(Status, usize, Vec<u8>)>;

fn send(cable: &RemoteCable, id: u64, endpoint: u8, buffer: Vec<u8>) -> Ended {
    let (tx, rx) = channel();
    let done = Box::new(move |c: Completion| drop(tx.send((c.status, c.actual, c.buffer))));
    assert!(cable.submit(Request { id, endpoint, setup: None, buffer, done }).is_ok());
    rx
}

fn wait(rx: &Ended) -> (Status, usize, Vec<u8>) {
    rx.recv_timeout(Duration::from_secs(5)).expect("the transfer ends")
}

#[test]
fn commands_cross_and_stalls_cancels_and_unplugging_arrive() {
    let b = bench();
    assert_eq!(b.cable.descriptors(), UsbCable::descriptors(&b.plug));
    let mut read = vec![0; 64];
    read[..6].copy_from_slice(&[0xc0, 5, 2, 0, 0x0c, 0x1a]);
    assert_eq!(wait(&send(&b.cable, 1, 0x01, read.clone())).1, 64);
    let (status, n, reply) = wait(&send(&b.cable, 2, 0x81, vec![0; 64]));
    assert_eq!((status, n, &reply[..4]), (Status::Ok, 64, &[0xc0, 5, 1, 0][..]));
    // A waiting read is cancelled; the transfer after it is served.
    let waiting = send(&b.cable, 3, 0x81, vec![0; 64]);
    assert!(b.cable.cancel(3));
    assert_eq!(wait(&waiting).0, Status::Cancelled);
    b.plug.inject(0x01, 0, Fault::Stall);
    assert_eq!(wait(&send(&b.cable, 4, 0x01, read.clone())).0, Status::Stall);
    assert_eq!(wait(&send(&b.cable, 5, 0x01, read.clone())).0, Status::Stall);
    b.cable.clear_halt(0x01);
    assert_eq!(wait(&send(&b.cable, 6, 0x01, read)).0, Status::Ok);
    assert!(b.cable.control(Setup::from_bytes([0xc0, 1, 0, 0, 0, 0, 4, 0])).is_err());
    let waiting: Vec<_> = (10..13).map(|id| send(&b.cable, id, 0x82, vec![0; 64])).collect();
    let (tx, gone) = channel();
    b.cable.on_unplug(Box::new(move || tx.send(()).unwrap()));
    b.plug.unplug();
    waiting.iter().for_each(|w| assert_eq!(wait(w).0, Status::Gone));
    gone.recv_timeout(Duration::from_secs(5)).unwrap();
    let refused = Request { id: 20, endpoint: 1, setup: None, buffer: vec![], done: Box::new(|_| ()) };
    assert!(b.cable.submit(refused).is_err());
}

#[test]
fn a_client_that_goes_leaves_nothing_running_and_the_next_one_gets_the_device() {
    let (plug, export) = dlpc900();
    let server = Server::start("127.0.0.1:0", vec![export]).unwrap();
    for round in 0..20 {
        // The server frees the device when it has seen the connection end, shortly after the client closed it.
        let until = std::time::Instant::now() + Duration::from_secs(5);
        let cable = loop {
            match RemoteCable::import(server.address(), "1-1") {
                Ok(c) => break c,
                Err(e) => assert!(std::time::Instant::now() < until, "round {round}: {e}"),
            }
        };
        let waiting = send(&cable, round, 0x81, vec![0; 64]);
        drop(cable);
        assert_eq!(wait(&waiting).0, Status::Gone);
    }
    let until = std::time::Instant::now() + Duration::from_secs(5);
    while plug.in_flight() > 0 && std::time::Instant::now() < until {
        std::thread::yield_now();
    }
    assert_eq!(plug.in_flight(), 0);
}

#[test]
fn nonsense_ends_its_own_connection_only() {
    let (_plug, export) = dlpc900();
    let server = Server::start("127.0.0.1:0", vec![export]).unwrap();
    let import = Operation::Import("1-1".into()).encode();
    let huge = Urb::Submit {
        seqnum: 1,
        devid: 0,
        endpoint: 1,
        is_in: false,
        flags: 0,
        length: u32::MAX,
        packets: 0,
        interval: 0,
        setup: Setup::from_bytes([0; 8]),
    };
    for nonsense in [
        vec![0xff; 8],
        [import.clone(), vec![0xff; 48]].concat(),
        [import.clone(), huge.encode().to_vec()].concat(),
    ] {
        let mut s = TcpStream::connect(server.address()).unwrap();
        s.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        s.write_all(&nonsense).unwrap();
        let mut rest = Vec::new();
        // Closed by the server (or reset, because it left bytes unread), not left hanging.
        let end = s.read_to_end(&mut rest);
        assert!(end.is_ok() || end.is_err_and(|e| e.kind() == std::io::ErrorKind::ConnectionReset));
    }
    assert_eq!(list(server.address()).unwrap().len(), 1);
}

proptest! {
    #[test]
    fn any_header_is_survived_and_ours_come_back(bytes in prop::array::uniform32(any::<u8>()), more in prop::array::uniform16(any::<u8>())) {
        let mut header = [0; 48];
        header[..32].copy_from_slice(&bytes);
        header[32..].copy_from_slice(&more);
        header[..3].fill(0);
        header[3] %= 6;
        if let Ok(urb) = Urb::decode(&header) {
            prop_assert_eq!(Urb::decode(&urb.encode()).unwrap(), urb);
        }
    }

    #[test]
    fn any_operation_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
        let _ = Operation::read(&mut &bytes[..]);
        let _ = read_list_reply(&mut &bytes[..]);
        let _ = read_import_reply(&mut &bytes[..]);
    }
}
