//! A mock projector on the fake bus, and a host that streams to it over real libusb.
#![allow(dead_code)]

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dpm_device::link::{
    packet_bytes, Codec, Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome, Underrun,
    COMMIT_BYTES,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::usb::{UsbSettings, UsbTransport};
use dpm_device::transport::Transport;
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, Clock, UsbPlug};
use usbfs_fake::{plug_in, Options, Socket};

pub(crate) fn raster() -> Raster {
    Raster::new(128, 32).unwrap()
}

pub(crate) const PLANES: usize = 24;
pub(crate) const FPS: u32 = 200;

pub(crate) fn planes(id: u64) -> Vec<u8> {
    let n = raster().plane_bytes() * PLANES;
    (0..n as u64).map(|i| ((i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15 ^ (id << 20)) >> 40) as u8).collect()
}

pub(crate) fn frame_bytes() -> usize {
    packet_bytes(raster().plane_bytes()) * PLANES + packet_bytes(COMMIT_BYTES)
}

/// A projector of its own serial number, on the bus.
pub(crate) struct Device {
    pub model: Arc<Mutex<UsbProjector>>,
    pub plug: UsbPlug,
    pub socket: Option<Socket>,
    pub clock: Clock,
    pub serial: u64,
}

impl Device {
    pub(crate) fn new(serial: u64, options: Options) -> Self {
        let clock = monotonic_clock();
        let setup = MockConfig { serial, min_plane_ns: 5_000, ..MockConfig::new(raster()) };
        let mock = MockProjector::new(setup);
        let model = Arc::new(Mutex::new(UsbProjector::new(mock, Speed::Super, None)));
        let plug = UsbPlug::new(model.clone(), clock.clone());
        let socket = plug_in(Arc::new(plug.clone()), options);
        Self { model, plug, socket: Some(socket), clock, serial }
    }

    pub(crate) fn unplug(&mut self) {
        self.socket = None;
    }

    pub(crate) fn plug_in_again(&mut self) {
        self.plug = UsbPlug::new(self.model.clone(), self.clock.clone());
        self.socket = Some(plug_in(Arc::new(self.plug.clone()), Options::default()));
    }

    pub(crate) fn now(&self) -> HostTime {
        (self.clock)()
    }

    pub(crate) fn mock<R>(&self, f: impl FnOnce(&mut MockProjector) -> R) -> R {
        let now = self.now();
        let mut model = self.model.lock().unwrap();
        let mock = model.projector();
        dpm_device::transport::LinkDevice::advance_to(mock, now);
        f(mock)
    }

    pub(crate) fn settings(&self) -> UsbSettings {
        UsbSettings {
            serial: Some(format!("{:016x}", self.serial)),
            stuck_after_ns: 150_000_000,
            ..UsbSettings::new(frame_bytes())
        }
    }
}

/// A host at the other end.
pub(crate) struct Host {
    pub link: HostLink,
    pub usb: UsbTransport,
    pub next_id: u64,
}

impl Host {
    pub(crate) fn new(device: &Device, watchdog_us: u32, fps: u32) -> Self {
        let link = HostLink::new(LinkSettings {
            raster: raster(),
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(fps, 1).unwrap(),
            watchdog_us,
            underrun: Underrun::Repeat,
            late_slots: 20,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: Codec::Raw.mask(),
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        let mut usb = UsbTransport::open(device.settings()).expect("the device opens");
        let clock = device.clock.clone();
        usb.set_clock(Arc::new(move || clock()));
        Self { link, usb, next_id: 1 }
    }

    pub(crate) fn connected(device: &Device) -> Self {
        let mut host = Self::new(device, 2_000_000, FPS);
        host.link.connect();
        host.arm(device);
        host
    }

    pub(crate) fn until(
        &mut self,
        device: &Device,
        limit_ms: u64,
        mut done: impl FnMut(&mut Self) -> bool,
    ) -> Duration {
        let start = Instant::now();
        loop {
            let _ = self.link.poll(device.now(), &mut self.usb);
            if done(self) {
                return start.elapsed();
            }
            assert!(
                start.elapsed() < Duration::from_millis(limit_ms),
                "after {limit_ms} ms: {:?} {:?} {:?} {:?}",
                self.link.state(),
                self.link.status(),
                self.usb.counters(),
                device.mock(|m| m.status())
            );
            std::thread::sleep(Duration::from_micros(300));
        }
    }

    pub(crate) fn arm(&mut self, device: &Device) {
        self.until(device, 5000, |h| h.link.state() == LinkState::Ready);
        self.link.arm(0);
        self.until(device, 5000, |h| h.link.state() == LinkState::Streaming);
    }

    /// Offers a new frame for the next slot.
    pub(crate) fn offer(&mut self, device: &Device) -> SendOutcome {
        let now = device.now();
        let slots = self.link.slots().unwrap();
        let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap() + 1;
        let id = self.next_id;
        let dark_from = slots.dark_from(slot, 20_000_000_000);
        let outcome = self.link.send_frame(now, id, slots.start(slot), dark_from, &planes(id), &mut self.usb);
        if outcome == SendOutcome::Sent {
            self.next_id += 1;
        }
        outcome
    }

    /// Streams until `done`, a frame as often as one is taken.
    pub(crate) fn stream(
        &mut self,
        device: &Device,
        limit_ms: u64,
        mut done: impl FnMut(&mut Self) -> bool,
    ) -> Duration {
        self.until(device, limit_ms, |h| {
            if h.link.state() == LinkState::Streaming {
                h.offer(device);
            }
            done(h)
        })
    }
}

/// What must hold at the end of every test: the lit frame is one that was sent, bit for bit, and every frame is accounted for.
pub(crate) fn check(device: &Device) {
    device.mock(|m| {
        if let Some(id) = m.lit_frame() {
            assert_eq!(m.lit_planes().unwrap(), planes(u64::from(id)), "frame {id}");
        }
        let s = m.status();
        assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank);
        let ended =
            s.frames_lit + s.frames_incomplete + s.frames_late + s.frames_superseded + s.frames_refused;
        assert!((ended..=ended + 5).contains(&s.frames_seen), "{s:?}");
        assert_eq!(m.credit_violations(), 0);
    });
}

pub(crate) fn lit(device: &Device) -> u32 {
    device.mock(|m| m.status().frames_lit)
}
