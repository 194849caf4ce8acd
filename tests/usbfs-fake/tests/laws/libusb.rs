//! The unmodified libusb, through rusb, on the in-process bus: what each thing that can happen on a cable looks like from there.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dpm_device::time::HostTime;
use hil_mock::usb_model::{Progress, Setup, Speed, UsbDeviceModel};
use hil_mock::usb_plug::{monotonic_clock, Fault, UsbPlug};
use rusb::{Context, DeviceHandle, UsbContext};
use usbfs_fake::{plug_in, Options, Socket};

const DEVICE: [u8; 18] = [18, 1, 0, 2, 0xff, 0, 0, 64, 0x34, 0x12, 0x78, 0x56, 0x02, 0x01, 1, 2, 0, 1];
const CONFIGURATION: [u8; 32] = [
    9, 2, 32, 0, 1, 1, 0, 0x80, 50, 9, 4, 0, 0, 2, 0xff, 0, 0, 0, 7, 5, 0x01, 2, 0, 2, 0, 7, 5, 0x81, 2, 0,
    2, 0,
];

/// A bulk loopback with a vendor request that returns the number of zero-length packets seen.
#[derive(Default)]
struct Loopback {
    stored: VecDeque<u8>,
    zero_length: u8,
}

impl UsbDeviceModel for Loopback {
    fn speed(&self) -> Speed {
        Speed::High
    }
    fn device_descriptor(&self) -> &[u8] {
        &DEVICE
    }
    fn configuration_descriptor(&self) -> &[u8] {
        &CONFIGURATION
    }
    fn string(&self, index: u8) -> Option<&str> {
        [None, Some("maker"), Some("loop")].get(usize::from(index)).copied().flatten()
    }
    fn control(&mut self, _: HostTime, setup: &Setup, data: &mut [u8]) -> Progress {
        if setup.request != 1 {
            return Progress::stall(0);
        }
        data.fill(self.zero_length);
        Progress::complete(data.len())
    }
    fn transfer_out(&mut self, _: HostTime, _: u8, data: &[u8]) -> Progress {
        self.zero_length += u8::from(data.is_empty());
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
}

fn device(options: Options) -> (UsbPlug, Socket) {
    let plug = UsbPlug::new(Arc::new(Mutex::new(Loopback::default())), monotonic_clock());
    let socket = plug_in(Arc::new(plug.clone()), options);
    (plug, socket)
}

fn find(context: &Context, socket: &Socket) -> Option<rusb::Device<Context>> {
    let devices = context.devices().expect("a list of devices");
    let found =
        devices.iter().find(|d| (d.bus_number(), d.address()) == (socket.bus_number(), socket.address()));
    found
}

fn open(socket: &Socket) -> (Context, DeviceHandle<Context>) {
    let context = Context::new().expect("a context");
    let handle = find(&context, socket).expect("the device is listed").open().expect("the device opens");
    (context, handle)
}

const SECOND: Duration = Duration::from_secs(1);

#[test]
fn descriptors_and_strings_arrive_unchanged() {
    let (_plug, socket) = device(Options::default());
    let (_context, handle) = open(&socket);
    let descriptor = handle.device().device_descriptor().unwrap();
    assert_eq!((descriptor.vendor_id(), descriptor.product_id()), (0x1234, 0x5678));
    assert_eq!(handle.device().speed(), rusb::Speed::High);
    let configuration = handle.device().active_config_descriptor().unwrap();
    let interface = configuration.interfaces().next().unwrap().descriptors().next().unwrap();
    let addresses: Vec<_> = interface.endpoint_descriptors().map(|e| e.address()).collect();
    assert_eq!(addresses, [0x01, 0x81]);
    assert_eq!(handle.read_string_descriptor_ascii(2).unwrap(), "loop");
    assert_eq!(handle.read_string_descriptor_ascii(3), Err(rusb::Error::Pipe));
}

#[test]
fn a_large_transfer_crosses_whole_and_a_short_one_says_so() {
    let (_plug, socket) = device(Options::default());
    let (_context, handle) = open(&socket);
    handle.claim_interface(0).unwrap();
    let sent: Vec<u8> = (0..2_359_296u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    assert_eq!(handle.write_bulk(0x01, &sent, SECOND), Ok(sent.len()));
    let mut got = vec![0; sent.len() + 512];
    assert_eq!(handle.read_bulk(0x81, &mut got, SECOND), Ok(sent.len()));
    assert!(got[..sent.len()] == sent);
}

#[test]
fn stall_bus_error_babble_and_silence_look_as_they_do_on_a_cable() {
    let (plug, socket) = device(Options::default());
    let (_context, handle) = open(&socket);
    handle.claim_interface(0).unwrap();
    plug.inject(0x01, 0, Fault::Stall);
    assert_eq!(handle.write_bulk(0x01, &[1], SECOND), Err(rusb::Error::Pipe));
    assert_eq!(handle.write_bulk(0x01, &[1], SECOND), Err(rusb::Error::Pipe), "halted until cleared");
    handle.clear_halt(0x01).unwrap();
    assert_eq!(handle.write_bulk(0x01, &[1, 2, 3], SECOND), Ok(3));
    plug.inject(0x81, 0, Fault::Babble);
    plug.inject(0x81, 1, Fault::BusError);
    let mut got = [0; 8];
    assert_eq!(handle.read_bulk(0x81, &mut got, SECOND), Err(rusb::Error::Overflow));
    assert_eq!(handle.read_bulk(0x81, &mut got, SECOND), Err(rusb::Error::Io));
    assert_eq!(handle.read_bulk(0x81, &mut got, SECOND), Ok(3));
    let start = Instant::now();
    assert_eq!(handle.read_bulk(0x81, &mut got, Duration::from_millis(30)), Err(rusb::Error::Timeout));
    assert!(start.elapsed() >= Duration::from_millis(29));
    assert_eq!(handle.write_bulk(0x01, &[9], SECOND), Ok(1), "usable after a time-out");
    assert_eq!(handle.read_bulk(0x81, &mut got, SECOND), Ok(1));
    assert_eq!(plug.in_flight(), 0);
}

#[test]
fn interfaces_have_one_holder_and_kernel_drivers_must_go_first() {
    let options = Options { kernel_driver: Some("usbhid".into()), ..Options::default() };
    let (_plug, socket) = device(options);
    let (context, first) = open(&socket);
    assert_eq!(first.kernel_driver_active(0), Ok(true));
    assert_eq!(first.claim_interface(0), Err(rusb::Error::Busy));
    assert_eq!(first.set_active_configuration(1), Err(rusb::Error::Busy));
    first.set_auto_detach_kernel_driver(true).unwrap();
    first.claim_interface(0).unwrap();
    let second = find(&context, &socket).unwrap().open().unwrap();
    assert_eq!(second.claim_interface(0), Err(rusb::Error::Busy));
    assert_eq!(second.claim_interface(1), Err(rusb::Error::NotFound));
    drop(first);
    second.claim_interface(0).unwrap();
}

#[test]
fn permission_is_refused_as_without_a_udev_rule() {
    let (_plug, socket) = device(Options { denied: true, ..Options::default() });
    let context = Context::new().unwrap();
    let device = find(&context, &socket).expect("listed all the same");
    assert_eq!(device.open().map(|_| ()), Err(rusb::Error::Access));
}

#[test]
fn pulling_the_plug_ends_a_waiting_read_and_is_announced() {
    struct Watch(Arc<Mutex<Vec<(char, u8, u8)>>>);
    impl rusb::Hotplug<Context> for Watch {
        fn device_arrived(&mut self, d: rusb::Device<Context>) {
            self.0.lock().unwrap().push(('+', d.bus_number(), d.address()));
        }
        fn device_left(&mut self, d: rusb::Device<Context>) {
            self.0.lock().unwrap().push(('-', d.bus_number(), d.address()));
        }
    }
    let context = Context::new().unwrap();
    let seen = Arc::new(Mutex::new(Vec::new()));
    let watch = Box::new(Watch(seen.clone()));
    let _registration = rusb::HotplugBuilder::new().vendor_id(0x1234).register(&context, watch).unwrap();
    let (_plug, socket) = device(Options::default());
    let place = (socket.bus_number(), socket.address());
    let until = Instant::now() + Duration::from_secs(5);
    while !seen.lock().unwrap().contains(&('+', place.0, place.1)) && Instant::now() < until {
        context.handle_events(Some(Duration::from_millis(10))).unwrap();
    }
    let handle = find(&context, &socket).unwrap().open().unwrap();
    handle.claim_interface(0).unwrap();
    let puller = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(30));
        socket.unplug();
        socket
    });
    let mut got = [0; 8];
    let start = Instant::now();
    assert_eq!(handle.read_bulk(0x81, &mut got, Duration::from_secs(5)), Err(rusb::Error::NoDevice));
    assert!(start.elapsed() < SECOND);
    let _socket = puller.join().unwrap();
    while !seen.lock().unwrap().contains(&('-', place.0, place.1)) && Instant::now() < until {
        context.handle_events(Some(Duration::from_millis(10))).unwrap();
    }
    let seen = seen.lock().unwrap();
    let mine: Vec<_> = seen.iter().filter(|e| (e.1, e.2) == place).map(|e| e.0).collect();
    assert_eq!(mine, ['+', '-']);
    assert_eq!(handle.write_bulk(0x01, &[1], SECOND), Err(rusb::Error::NoDevice));
}

#[test]
fn five_hundred_plug_cycles_leave_nothing_behind() {
    let context = Context::new().unwrap();
    let descriptors = || std::fs::read_dir("/proc/self/fd").unwrap().count();
    let files = || std::fs::read_dir("/sys/bus/usb/devices").unwrap().count();
    let mut after_ten = 0;
    for cycle in 0..500 {
        let (plug, socket) = device(Options::default());
        context.handle_events(Some(Duration::ZERO)).unwrap();
        let found = find(&context, &socket).unwrap_or_else(|| panic!("cycle {cycle}: not listed"));
        let handle = found.open().unwrap();
        handle.claim_interface(0).unwrap();
        assert_eq!(handle.write_bulk(0x01, &[7; 100], SECOND), Ok(100));
        if cycle % 2 == 0 {
            socket.unplug();
            let mut b = [0; 200];
            assert_eq!(handle.read_bulk(0x81, &mut b, SECOND), Err(rusb::Error::NoDevice));
        }
        drop((handle, found, socket));
        assert_eq!(plug.in_flight(), 0);
        if cycle == 10 {
            after_ten = descriptors();
        }
    }
    // Other tests of this process come and go: their handful of descriptors and folders is the slack.
    assert!(descriptors() < after_ten + 40, "{} descriptors, {after_ten} at first", descriptors());
    assert!(files() < 20, "{} device folders", files());
}
