//! Frames over USB, by an unmodified libusb with a usbfs in this process: on the frame path our own code allocates
//! nothing, takes no lock, and makes no system call but those that wait, wake and read the time. What libusb does in
//! our calls is listed, and the list does not grow.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

use crate::frame_law;
use crate::link_common::{raster, rig, start};
use dpm_device::transport::LinkDevice;
use dpm_handoff::path::Place;
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, UsbPlug};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use usbfs_fake::{plug_in, Options};

/// What libusb may do on the frame path; docs/lab/LATENCY.md has the numbers. The kernel's side is a model in this
/// process, so an ioctl of libusb is no system call here. The model counts it instead.
const LIBUSB: [&str; 2] = ["memory", "pthread_mutex_lock"];
/// The only request that it makes of usbfs there: USBDEVFS_SUBMITURB. Ends of transfers are reaped by another thread.
const SUBMIT: u8 = 10;

#[test]
fn frames_over_usb_only_wait_and_wake_and_libusb_does_what_is_listed() {
    frame_law::watch();
    let setup = MockConfig { serial: 0xb1, ..MockConfig::new(raster()) };
    let model = Arc::new(Mutex::new(UsbProjector::new(MockProjector::new(setup), Speed::Super, None)));
    let clock = monotonic_clock();
    let plug = UsbPlug::new(model.clone(), clock.clone());
    let _socket = plug_in(Arc::new(plug), Options::default());
    let backend = "{ kind = \"usb\", serial_number = \"00000000000000b1\" }";
    let run = start(&rig(backend, &[]), 0);
    let begin = Instant::now();
    loop {
        let mut projector = model.lock().unwrap();
        projector.projector().advance_to(clock());
        if projector.projector().status().frames_lit >= 300 {
            break;
        }
        assert!(begin.elapsed() < Duration::from_secs(30), "light");
        drop(projector);
        std::thread::sleep(Duration::from_millis(1));
    }
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    let seen = frame_law::seen();
    let ioctls = usbfs_fake::ioctls_on_frame_path();
    println!("{}usbfs requests {ioctls:?}", seen.table(report.frames_lit));
    seen.check(&[], &[(Place::Libusb, &LIBUSB)]);
    assert!(matches!(ioctls[..], [(SUBMIT, n)] if n >= 300), "the frames went through libusb: {ioctls:?}");
}
