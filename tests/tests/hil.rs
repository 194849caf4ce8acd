//! USB through a real kernel: usbcore, usbfs and usbhid on one side, device models behind `vhci_hcd` on the other.
//! `./x hil` boots a kernel for these tests. On your own machine run them as root after `modprobe vhci-hcd`, with
//! `--ignored`.

use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dpm_device::link::{
    faults, packet_bytes, Codec, Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome,
    Underrun, COMMIT_BYTES,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::usb::{UsbSettings, UsbTransport, DATA_OUT};
use dpm_device::transport::LinkDevice;
use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, PortError};
use dpm_dlpc900::image::PlaneOrder;
use dpm_dlpc900::lut::Dmd;
use dpm_dlpc900::sequence::{BitPattern, LedSetup, Repeat, SequenceBuilder};
use dpm_dlpc900::usb::{list, UsbHid};
use hil_mock::dlpc900::{Dlpc900Model, Options};
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, Clock, Fault, UsbCable, UsbPlug};
use hil_mock::usbip::serve_imported;

/// The kernel's interface for virtual devices.
const VHCI: &str = "/sys/devices/platform/vhci_hcd.0";

/// Attaches `plug` to a free port of the virtual controller, as `usbip attach` does after its import.
fn attach(plug: &UsbPlug) {
    let super_speed = UsbCable::speed(plug) == Speed::Super;
    let status = std::fs::read_to_string(format!("{VHCI}/status")).expect("the module vhci-hcd is loaded");
    // Rows: hub, port, state (004 = nothing attached), ...
    let free = status
        .lines()
        .map(|l| l.split_whitespace().collect::<Vec<_>>())
        .find(|w| w.len() > 2 && w[0] == if super_speed { "ss" } else { "hs" } && w[2] == "004");
    let port: u32 = free.expect("a free port")[1].parse().expect("its number");
    let (ours, kernels) = UnixStream::pair().expect("a socket pair");
    let line = format!("{port} {} {} {}", kernels.as_raw_fd(), 0x0001_0001, UsbCable::speed(plug) as u32);
    std::fs::write(format!("{VHCI}/attach"), line).expect("the kernel takes the device");
    let cable: Arc<dyn UsbCable> = Arc::new(plug.clone());
    // The session ends with the plug.
    std::thread::spawn(move || serve_imported(ours, cable));
}

/// Waits for a result of the kernel, including device nodes without udev.
fn within<T>(limit: Duration, what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = look() {
            println!("  {what}: {:?}", start.elapsed());
            return found;
        }
        assert!(start.elapsed() < limit, "{what}: not within {limit:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

const ENUMERATION: Duration = Duration::from_secs(20);

#[test]
#[ignore = "needs a kernel with vhci-hcd: ./x hil"]
fn dlpc900_patterns_cross_the_kernel_and_the_hid_driver_is_detached() {
    let model = Arc::new(Mutex::new(Dlpc900Model::new(Options {
        dmd: Dmd::Dlp5500,
        strict: true,
        ..Options::default()
    })));
    let clock = monotonic_clock();
    let plug = UsbPlug::new(model.clone(), clock.clone());
    attach(&plug);
    within(ENUMERATION, "enumerated", || list().ok().filter(|l| l.len() == 1));
    // The kernel's own HID driver has requested the report descriptor and is bound.
    within(ENUMERATION, "bound by usbhid", || {
        let entries = std::fs::read_dir("/sys/bus/usb/drivers/usbhid").ok()?;
        entries.filter_map(Result::ok).find(|e| e.file_name().to_string_lossy().contains(':'))
    });
    let mut d = Dlpc900::new(UsbHid::open(None).expect("opened, usbhid detached")).expect("greeted");
    let raster = Dmd::Dlp5500.raster();
    let planes: Vec<Vec<u8>> = (0..25usize)
        .map(|p| (0..raster.plane_bytes()).map(|i| ((i / 16 * (p + 3)) >> 3) as u8).collect())
        .collect();
    let mut s = SequenceBuilder::new(Dmd::Dlp5500);
    planes.iter().for_each(|p| s.push(&BitPattern::white(vec![p], 1000)));
    let s = s.finish(Repeat::Forever, PlaneOrder::default(), None).expect("a sequence");
    let start = Instant::now();
    d.upload(&s, LedSetup::default(), &mut |_| ()).expect("uploaded");
    let rate = s.image_bytes() as f64 / start.elapsed().as_secs_f64() / 1e3;
    println!("  {} image bytes in {:?}: {rate:.0} kB/s", s.image_bytes(), start.elapsed());
    d.start().expect("started");
    {
        let m = model.lock().expect("the model");
        for (i, p) in planes.iter().enumerate() {
            assert!(m.projected_plane(i).expect("a plane") == *p, "plane {i}");
        }
        assert_eq!(m.warnings(), [] as [String; 0]);
    }
    plug.inject(0x01, 0, Fault::Stall);
    assert!(d.status().is_ok(), "a stall is cleared through the kernel");
    let start = Instant::now();
    plug.unplug();
    let err = d.status().expect_err("unplugged");
    assert!(matches!(err, Dlpc900Error::Port { source: PortError::Gone, .. }), "{err}");
    println!("  unplug noticed after {:?}", start.elapsed());
    assert!(start.elapsed() < Duration::from_secs(2));
    drop(d);
    let plug = UsbPlug::new(model, clock);
    attach(&plug);
    let mut d =
        within(ENUMERATION, "plugged in again and greeted", || Dlpc900::new(UsbHid::open(None).ok()?).ok());
    d.stop().expect("stopped");
}

const PLANES: usize = 24;
const FPS: u32 = 100;

struct Rig {
    model: Arc<Mutex<UsbProjector>>,
    clock: Clock,
    link: HostLink,
    usb: UsbTransport,
    frames: Vec<Vec<u8>>,
    next: u64,
}

impl Rig {
    fn projector() -> Arc<Mutex<UsbProjector>> {
        let raster = Raster::new(1024, 768).expect("XGA");
        let setup = MockConfig { serial: 0x77, min_plane_ns: 5_000, ..MockConfig::new(raster) };
        Arc::new(Mutex::new(UsbProjector::new(MockProjector::new(setup), Speed::Super, None)))
    }

    fn new(model: Arc<Mutex<UsbProjector>>, clock: Clock) -> Self {
        let raster = Raster::new(1024, 768).expect("XGA");
        let link = HostLink::new(LinkSettings {
            raster,
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(FPS, 1).expect("a rate"),
            watchdog_us: 5_000_000,
            underrun: Underrun::Repeat,
            late_slots: 50,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: Codec::Raw.mask(),
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        let frame_bytes = packet_bytes(raster.plane_bytes()) * PLANES + packet_bytes(COMMIT_BYTES);
        let settings = UsbSettings { stuck_after_ns: 2_000_000_000, ..UsbSettings::new(frame_bytes) };
        let usb = within(ENUMERATION, "projector enumerated and opened", || {
            UsbTransport::open(settings.clone()).ok()
        });
        let bytes = raster.plane_bytes() * PLANES;
        let frame = |id: u64| (0..bytes as u64).map(|i| (i * 31 + (i >> 7) * (id + 1)) as u8).collect();
        Self { model, clock, link, usb, frames: (0..4).map(frame).collect(), next: 1 }
    }

    fn mock<R>(&self, f: impl FnOnce(&mut MockProjector) -> R) -> R {
        let now = (self.clock)();
        let mut model = self.model.lock().expect("the model");
        let mock = model.projector();
        mock.advance_to(now);
        f(mock)
    }

    /// Streams until `done`.
    fn stream(&mut self, limit: Duration, what: &str, mut done: impl FnMut(&mut Self) -> bool) -> Duration {
        let start = Instant::now();
        loop {
            let now: HostTime = (self.clock)();
            // The link's state records the loss of the device.
            let _ = self.link.poll(now, &mut self.usb);
            match self.link.state() {
                LinkState::Ready => self.link.arm(0),
                // An emulated kernel on a busy machine may pause for longer than the watchdog permits; going dark is
                // then correct.
                LinkState::Faulted => self.link.arm(faults::WATCHDOG),
                LinkState::Streaming => {
                    if let Some(slots) = self.link.slots() {
                        let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap_or(0) + 1;
                        let frame = &self.frames[(self.next % 4) as usize];
                        let (at, dark_from) = (slots.start(slot), slots.dark_from(slot, 20_000_000_000));
                        let usb = &mut self.usb;
                        if self.link.send_frame(now, self.next, at, dark_from, frame, usb)
                            == SendOutcome::Sent
                        {
                            self.next += 1;
                        }
                    }
                }
                _ => {}
            }
            if done(self) {
                println!("  {what}: {:?}", start.elapsed());
                return start.elapsed();
            }
            assert!(
                start.elapsed() < limit,
                "{what}: {:?} {:?} {:?}",
                self.link.state(),
                self.link.status(),
                self.usb.counters()
            );
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    fn lit(&self) -> u32 {
        self.mock(|m| m.status().frames_lit)
    }

    fn check_lit_frame(&self) {
        let (id, planes) = self.mock(|m| (m.lit_frame(), m.lit_planes().map(<[u8]>::to_vec)));
        let (id, planes) = (id.expect("a lit frame"), planes.expect("its planes"));
        assert!(planes == self.frames[(id % 4) as usize], "frame {id} arrived as it was sent");
    }
}

#[test]
#[ignore = "needs a kernel with vhci-hcd: ./x hil"]
fn frames_stream_through_the_kernel_stall_and_unplug_included() {
    let clock = monotonic_clock();
    let model = Rig::projector();
    let plug = UsbPlug::new(model.clone(), clock.clone());
    attach(&plug);
    let mut rig = Rig::new(model.clone(), clock.clone());
    println!("  {} frames of 2,359,296 bytes may be in flight", rig.usb.depth());
    rig.link.connect();
    rig.stream(Duration::from_secs(60), "first light", |r| r.lit() >= 1);
    let (from, start) = (rig.lit(), Instant::now());
    rig.stream(Duration::from_secs(120), "30 frames", |r| r.lit() >= from + 30);
    println!("  {:.1} raw frames per second through the kernel", 30.0 / start.elapsed().as_secs_f64());
    rig.check_lit_frame();
    plug.inject(DATA_OUT, 0, Fault::Stall);
    let from = rig.lit();
    rig.stream(Duration::from_secs(60), "10 frames over a stall", |r| {
        r.usb.counters().stalls == 1 && r.lit() >= from + 10
    });
    plug.unplug();
    rig.stream(Duration::from_secs(5), "unplug noticed", |r| r.link.state() == LinkState::Lost);
    assert_eq!(rig.usb.in_flight(), 0, "nothing is left with the kernel");
    let plug = UsbPlug::new(model, clock);
    attach(&plug);
    let from = rig.lit();
    rig.stream(Duration::from_secs(60), "light again after plugging in", |r| r.lit() >= from + 3);
    rig.check_lit_frame();
    rig.mock(|m| assert_eq!(m.credit_violations(), 0));
}
