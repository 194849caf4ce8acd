//! A kernel that allows less memory for transfers than the frames need: fewer in flight, frames dropped whole, and advice that says what
//! to set. In a program of its own, because the limit is the whole machine's.

use std::sync::{Arc, Mutex};

use dpm_device::link::{Header, MessageType, Packet};
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_device::transport::usb::{memory_limit_mb, UsbSettings, UsbTransport, DATA_OUT};
use dpm_device::transport::{Lane, SendError, Transport};
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, Fault, UsbPlug};
use usbfs_fake::{plug_in, set_memory_limit_mb, Options};

#[test]
fn too_little_memory_means_fewer_frames_in_flight_and_advice() {
    let mock = MockProjector::new(MockConfig::new(Raster::new(64, 64).unwrap()));
    let model = Arc::new(Mutex::new(UsbProjector::new(mock, Speed::High, None)));
    let plug = UsbPlug::new(model, monotonic_clock());
    let _socket = plug_in(Arc::new(plug.clone()), Options::default());
    let settings = UsbSettings { depth: 8, ..UsbSettings::new(2_400_000) };

    // The default of 16 MB: half of it holds three of these frames.
    assert_eq!(memory_limit_mb(), Some(16));
    let advice = settings.memory_advice().expect("8 frames of 2.4 MB do not fit");
    assert!(
        advice.contains("usbfs_memory_mb") && advice.contains("16 MB") && advice.contains("echo 38 |"),
        "{advice}"
    );
    let usb = UsbTransport::open(settings.clone()).unwrap();
    assert_eq!(usb.depth(), 3);
    drop(usb);

    set_memory_limit_mb(38);
    assert_eq!(settings.memory_advice(), None, "the advice was right");
    drop(UsbTransport::open(settings.clone()).unwrap());

    // Others on the machine use it up: the frame is dropped, the link stays.
    set_memory_limit_mb(3);
    let mut usb = UsbTransport::open(settings).unwrap();
    assert_eq!(usb.depth(), 1);
    set_memory_limit_mb(1);
    plug.inject(DATA_OUT, 0, Fault::NakNs(i64::MAX));
    let payload = vec![0u8; 2_000_000];
    let packet = Packet::new(Header::control(MessageType::Plane, 1, 0), &payload);
    let refused = usb.send(HostTime(0), Lane::Data, &[packet]);
    assert!(matches!(refused, Err(SendError::Busy)), "{refused:?}");
    assert_eq!(usb.counters().out_of_memory, 1);
    set_memory_limit_mb(0);
    usb.send(HostTime(1), Lane::Data, &[packet]).expect("without a limit it goes");
}
