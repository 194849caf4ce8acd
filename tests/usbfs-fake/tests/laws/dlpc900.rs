//! The DLPC900 driver over the unmodified libusb against the emulator: the whole path but the cable.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, HidPort, PortError};
use dpm_dlpc900::image::PlaneOrder;
use dpm_dlpc900::lut::Dmd;
use dpm_dlpc900::sequence::{BitPattern, LedSetup, Repeat, SequenceBuilder};
use dpm_dlpc900::usb::{self, UsbHid, UsbPlace};
use hil_mock::dlpc900::{Dlpc900Fault, Dlpc900Model, Options as Projector};
use hil_mock::usb_plug::{monotonic_clock, Fault, UsbPlug};
use usbfs_fake::{plug_in, Options, Socket};

struct Bench {
    model: Arc<Mutex<Dlpc900Model>>,
    plug: UsbPlug,
    socket: Socket,
}

fn bench(projector: Projector, options: Options) -> Bench {
    let model = Arc::new(Mutex::new(Dlpc900Model::new(projector)));
    let plug = UsbPlug::new(model.clone(), monotonic_clock());
    let socket = plug_in(Arc::new(plug.clone()), options);
    Bench { model, plug, socket }
}

impl Bench {
    fn open(&self) -> Result<UsbHid, PortError> {
        UsbHid::open(Some(self.place()))
    }

    fn place(&self) -> UsbPlace {
        UsbPlace { bus: self.socket.bus_number(), address: self.socket.address() }
    }
}

fn projector() -> Projector {
    Projector { dmd: Dmd::Dlp5500, strict: true, ..Projector::default() }
}

#[test]
fn every_controller_on_the_bus_is_listed_and_the_right_one_opened() {
    let (a, b) = (bench(projector(), Options::default()), bench(projector(), Options::default()));
    let places = usb::list().unwrap();
    for bench in [&a, &b] {
        assert!(
            places.contains(&UsbPlace { bus: bench.socket.bus_number(), address: bench.socket.address() })
        );
        let mut d = Dlpc900::new(bench.open().unwrap()).unwrap();
        d.stop().unwrap();
    }
    assert_eq!((a.model.lock().unwrap().commands(), b.model.lock().unwrap().commands()), (3, 3));
}

#[test]
fn what_hinders_opening_is_said_with_its_remedy() {
    let denied = bench(projector(), Options { denied: true, ..Options::default() });
    let text = denied.open().unwrap_err().to_string();
    assert!(text.contains(usb::UDEV_RULE) && text.contains("/etc/udev/rules.d/"), "{text}");
    let b = bench(projector(), Options::default());
    let first = b.open().unwrap();
    assert_eq!(b.open().unwrap_err(), PortError::Busy);
    drop(first);
    b.open().unwrap();
    b.socket.unplug();
    assert_eq!(b.open().unwrap_err(), PortError::NotFound);
}

#[test]
fn stalls_are_cleared_and_silence_and_unplugging_end_in_time() {
    let b = bench(projector(), Options::default());
    let mut d = Dlpc900::new(b.open().unwrap()).unwrap();
    b.plug.inject(0x01, 0, Fault::Stall);
    b.plug.inject(0x81, 0, Fault::Stall);
    assert!(d.status().is_ok(), "a stall costs one retry each way");
    b.model.lock().unwrap().inject(Dlpc900Fault::LoseReply);
    let start = Instant::now();
    let err = d.status().unwrap_err();
    assert!(matches!(err, Dlpc900Error::Port { source: PortError::Timeout, .. }), "{err}");
    let (text, place) = (err.to_string(), b.place().to_string());
    assert!(
        text.contains("0451:c900") && text.contains(&place) && text.contains("switch it off and on"),
        "{text}"
    );
    assert!((900..2000).contains(&start.elapsed().as_millis()));
    b.plug.inject(0x01, 0, Fault::Short(10));
    let err = d.status().unwrap_err().to_string();
    assert!(err.contains("only 10 of 64 bytes"), "{err}");
    b.plug.inject(0x81, 0, Fault::Unplug(0));
    let start = Instant::now();
    let err = d.status().unwrap_err();
    assert!(matches!(err, Dlpc900Error::Port { source: PortError::Gone, .. }), "{err}");
    assert!(start.elapsed() < Duration::from_millis(500));
}

/// Pulled in the middle of an upload and plugged in again without what it knew: found, claimed and loaded anew, each time.
#[test]
fn a_controller_that_comes_back_is_loaded_again() {
    let mut b = bench(projector(), Options { kernel_driver: Some("usbhid".into()), ..Options::default() });
    let plane = vec![0xa5; Dmd::Dlp5500.raster().plane_bytes()];
    let mut s = SequenceBuilder::new(Dmd::Dlp5500);
    s.push(&BitPattern::white(vec![&plane], 500));
    let s = s.finish(Repeat::Forever, PlaneOrder::default(), None).unwrap();
    for cycle in 0..10 {
        let mut d = Dlpc900::new(b.open().unwrap()).unwrap();
        b.plug.inject(0x01, 5 + cycle, Fault::Unplug(0));
        let start = Instant::now();
        let gone = d.upload(&s, LedSetup::default(), &mut |_| ()).unwrap_err();
        assert!(matches!(gone, Dlpc900Error::Port { source: PortError::Gone, .. }), "{gone}");
        assert!(start.elapsed() < Duration::from_secs(1), "{:?}", start.elapsed());
        drop(d);
        b = bench(projector(), Options { kernel_driver: Some("usbhid".into()), ..Options::default() });
        let plugged = Instant::now();
        let mut d = Dlpc900::new(b.open().unwrap()).unwrap();
        assert!(plugged.elapsed() < Duration::from_secs(1), "{:?}", plugged.elapsed());
        d.upload(&s, LedSetup::default(), &mut |_| ()).unwrap();
        d.start().unwrap();
        assert!(b.model.lock().unwrap().projected_plane(0).unwrap() == plane);
    }
}

#[test]
fn round_trips_are_quick_enough_for_uploads() {
    let b = bench(projector(), Options::default());
    let mut port = b.open().unwrap();
    let mut report = [0; 64];
    report[..6].copy_from_slice(&[0xc0, 1, 2, 0, 0x0c, 0x1a]);
    let mut took: Vec<_> = (0..500)
        .map(|_| {
            let start = Instant::now();
            port.write_report(&report, Duration::from_secs(1)).unwrap();
            let mut reply = [0; 64];
            port.read_report(&mut reply, Duration::from_secs(1)).unwrap();
            assert_eq!(reply[..4], [0xc0, 1, 1, 0]);
            start.elapsed()
        })
        .collect();
    took.sort();
    println!("64 bytes out and back: median {:?}, worst {:?}", took[250], took[499]);
    assert!(took[250] < Duration::from_millis(5));
}

/// Whole uploads.
mod breadth {
    use super::*;

    #[test]
    fn an_upload_through_libusb_ends_up_on_the_mirrors() {
        // As on a desktop: the kernel's HID driver holds the device and must be detached; two interfaces enumerate.
        let options = Options { kernel_driver: Some("usbhid".into()), ..Options::default() };
        let b = bench(Projector { interfaces: 2, ..projector() }, options);
        let mut d = Dlpc900::new(b.open().unwrap()).unwrap();
        let raster = Dmd::Dlp5500.raster();
        let planes: Vec<Vec<u8>> = (0..26usize)
            .map(|p| (0..raster.plane_bytes()).map(|i| ((i * (2 * p + 1)) >> (i % 5)) as u8).collect())
            .collect();
        let mut s = SequenceBuilder::new(Dmd::Dlp5500);
        planes.iter().for_each(|p| s.push(&BitPattern::white(vec![p], 500)));
        let s = s.finish(Repeat::Forever, PlaneOrder::default(), None).unwrap();
        let start = Instant::now();
        d.upload(&s, LedSetup::default(), &mut |_| ()).unwrap();
        let rate = s.image_bytes() as f64 / start.elapsed().as_secs_f64() / 1e6;
        println!("{} image bytes through libusb: {rate:.1} MB/s", s.image_bytes());
        d.start().unwrap();
        let m = b.model.lock().unwrap();
        for (i, p) in planes.iter().enumerate() {
            assert!(m.projected_plane(i).unwrap() == *p, "plane {i}");
        }
        assert_eq!(m.warnings(), [] as [String; 0]);
        assert_eq!(m.dropped_reports(), 0);
    }
}
