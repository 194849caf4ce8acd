//! `dpm run` on a USB projector: an unmodified libusb with an in-process usbfs.

use crate::link_common::{raster, rig, served_time, start, Projector};
use dpm_device::link::DeviceState;
use dpm_device::transport::usb::DATA_OUT;
use dpm_device::transport::LinkDevice;
use dpm_lab::link_test::{link_test, TestFrames};
use dpm_rig::order::Order;
use dpm_rig::pipeline::{projector, PipelineError};
use dpm_rig::telemetry::monitor::ProjectorHealth;
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, Clock, Fault, UsbPlug};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use usbfs_fake::{plug_in, Options, Socket};

const LONG: Duration = Duration::from_secs(20);

struct UsbBench {
    model: Arc<Mutex<UsbProjector>>,
    clock: Clock,
    plugged: Mutex<Option<(UsbPlug, Socket)>>,
    serial: u64,
}

impl UsbBench {
    fn new(serial: u64, options: Options) -> Self {
        let setup = MockConfig { serial, ..MockConfig::new(raster()) };
        let usb = UsbProjector::new(MockProjector::new(setup), Speed::Super, None);
        let bench = Self {
            model: Arc::new(Mutex::new(usb)),
            clock: monotonic_clock(),
            plugged: Mutex::new(None),
            serial,
        };
        bench.plug(options);
        bench
    }

    fn plug(&self, options: Options) {
        let plug = UsbPlug::new(self.model.clone(), self.clock.clone());
        let socket = plug_in(Arc::new(plug.clone()), options);
        *self.plugged.lock().unwrap() = Some((plug, socket));
    }

    fn unplug(&self) {
        *self.plugged.lock().unwrap() = None;
    }

    fn inject(&self, fault: Fault) {
        self.plugged.lock().unwrap().as_ref().expect("plugged in").0.inject(DATA_OUT, 0, fault);
    }

    fn backend(&self) -> String {
        format!("{{ kind = \"usb\", serial_number = \"{:016x}\" }}", self.serial)
    }
}

impl Projector for UsbBench {
    fn look(&self, see: &mut dyn FnMut(&mut MockProjector)) {
        let now = (self.clock)();
        let mut model = self.model.lock().unwrap();
        model.projector().advance_to(now);
        see(model.projector());
    }
}

#[test]
fn a_run_on_usb_lights_whole_frames_over_stalls_and_unplugging_and_ends_dark() {
    let far = UsbBench::new(0xa1, Options::default());
    let run = start(&rig(&far.backend(), &[]), 0);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 10);
    far.check_whole();
    far.inject(Fault::Stall);
    let lit = far.status().frames_lit;
    far.until(LONG, "light over a stall", &mut |s| s.frames_lit >= lit + 10);
    assert_eq!(run.monitor.projector(), ProjectorHealth::Up, "the session survived");
    far.unplug();
    let noticed = served_time("noticed", || run.monitor.projector() == ProjectorHealth::Lost);
    assert!(noticed < Duration::from_millis(100), "U1: {noticed:?}");
    far.plug(Options::default());
    let back = served_time("up again", || run.monitor.projector() == ProjectorHealth::Up);
    assert!(back < Duration::from_secs(1), "U1: {back:?}");
    far.until(LONG, "light again", &mut |s| s.state == DeviceState::Armed && s.frames_lit >= 5);
    far.check_whole();
    run.monitor.give_order(Order::Black);
    far.until(LONG, "black", &mut |s| s.state == DeviceState::Black);
    run.monitor.give_order(Order::Arm);
    let lit = far.status().frames_lit;
    far.until(LONG, "light again", &mut |s| s.frames_lit >= lit + 5);
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    let s = far.status();
    assert!(!far.is_lit() && s.state == DeviceState::Configured, "{s:?}");
    let p = report.projector.expect("the link was used");
    assert_eq!(p.sessions, 2);
    assert!(p.name.contains("USB projector 1209:000d"), "{}", p.name);
    assert!(p.planes[1] + p.planes[2] > 0, "compacted by default: {p:?}");
}

#[test]
fn an_absent_a_denied_and_a_taken_projector_are_told_apart() {
    let told = |backend: &str| {
        let error = start(&rig(backend, &[]), 5).end().err().expect("no run without a projector");
        assert!(matches!(error, PipelineError::Connect(_)), "{error}");
        error.to_string()
    };
    let absent = told(r#"{ kind = "usb", product_id = 0xbad }"#);
    assert!(absent.contains("1209:0bad: not found") && absent.contains("dpm doctor"), "{absent}");
    let far = UsbBench::new(0xa2, Options::default());
    let run = start(&rig(&far.backend(), &[]), 0);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 3);
    let taken = told(&far.backend());
    assert!(taken.contains("in use by another program"), "{taken}");
    run.stop().unwrap_or_else(|e| panic!("{e}"));
    far.unplug();
    far.plug(Options { denied: true, ..Options::default() });
    // An inaccessible device does not show its serial number, so its error is also reported to a user who asked for
    // another one.
    let denied = told(r#"{ kind = "usb", serial_number = "none" }"#);
    assert!(denied.contains("permission denied") && denied.contains("60-dpm.rules"), "{denied}");
}

/// A cable of limited bytes per second carries a limited number of raw frames; the same frames compacted carry more.
#[test]
fn the_link_test_finds_the_rate_that_a_slow_cable_allows() {
    let far = UsbBench::new(0xa3, Options::default());
    let rig = rig(&far.backend(), &["projector.frame_rate=400"]);
    let frame = projector::frame_bytes(raster(), 8) as u64;
    far.model.lock().unwrap().set_bytes_per_second(Some(100 * frame));
    let report =
        link_test(&rig, &TestFrames::prepared(&rig, 4), 1.5, &|| false).unwrap_or_else(|e| panic!("{e}"));
    let [raw, auto] = &report.ways[..] else { panic!("{report:?}") };
    assert_eq!(raw.limited_by, "medium", "{raw:?}");
    // Not faster than the cable, except for its FIFO of 64 KiB at the start; slower only by the delays of a busy
    // machine.
    let fifo = 65_536.0 / frame as f64 / 1.5;
    assert!(raw.frames_per_s < 1.05 * (100.0 + fifo), "{raw:?}");
    assert!(raw.frames_per_s > 50.0, "{raw:?}");
    assert_eq!(raw.bytes_per_frame, frame as f64);
    assert_eq!((raw.planes[1], raw.planes[2]), (0, 0));
    assert_eq!(raw.allows_hz, raw.frames_per_s.floor());
    assert!(auto.bytes_per_frame < 0.8 * raw.bytes_per_frame, "{auto:?}");
    assert!(auto.frames_per_s > raw.frames_per_s, "{auto:?}");
    assert!(
        report.to_table().contains("raw: the link allows projector.frame_rate = "),
        "{}",
        report.to_table()
    );
    let s = far.status();
    assert!(!far.is_lit() && s.state == DeviceState::Configured, "{s:?}");
    assert_eq!((s.frames_incomplete, s.payload_errors), (0, 0), "whole frames only");
}
