//! The bit-plane link over real libusb against the mock projector: streaming, and rows U1 to U15 of the failures that a cable can have.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::link_usb_common::{check, frame_bytes, lit, planes, raster, Device, Host, FPS};
use dpm_device::link::{faults, DeviceState, Header, LinkState, MessageType, Packet, SendOutcome, Verb};
use dpm_device::transport::usb::{UsbSettings, UsbTransport, CONTROL_OUT, DATA_OUT, REPLIES_IN};
use dpm_device::transport::{Lane, Transport, TransportError};
use hil_mock::projector::usb::UsbProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::usb_model::Speed;
use hil_mock::usb_plug::{monotonic_clock, Fault, UsbPlug};
use hil_mock::usbip::{Export, RemoteCable, Server};
use usbfs_fake::{plug_in, Options};

#[test]
fn frames_cross_real_libusb_bit_for_bit() {
    let device = Device::new(1, Options { kernel_driver: Some("usbhid".into()), ..Options::default() });
    let mut host = Host::connected(&device);
    let mut seen = 0;
    host.stream(&device, 20_000, |_| {
        device.mock(|m| {
            if let Some(id) = m.lit_frame() {
                assert_eq!(m.lit_planes().unwrap(), planes(u64::from(id)));
                seen = seen.max(m.status().frames_lit);
            }
        });
        seen >= 40
    });
    check(&device);
    let (c, s) = (host.usb.counters(), device.mock(|m| m.status()));
    assert_eq!((c.frames_lost, c.stalls, c.bus_errors, c.resets), (0, 0, 0, 0));
    assert_eq!((s.header_errors, s.payload_errors, s.frames_incomplete, s.bytes_skipped), (0, 0, 0, 0));
    let mut echoes = 0;
    host.link.take_echoes(|e| {
        echoes += 1;
        assert!(e.host_sent_at <= e.host_received_at && e.device_received_at <= e.device_sent_at);
        // One clock stands behind both: the device's stamps lie between the host's.
        assert!(e.host_sent_at.0 as u64 <= e.device_received_at.0);
        assert!(e.device_sent_at.0 <= e.host_received_at.0 as u64);
    });
    assert!(echoes > 0);
}

#[test]
fn u1_u2_unplug_is_noticed_reaped_and_survived() {
    let mut device = Device::new(2, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 5);
    // With a frame stuck on the cable and the next one queued.
    device.plug.inject(DATA_OUT, 0, Fault::NakNs(i64::MAX));
    host.stream(&device, 5000, |h| h.usb.in_flight() > 9);
    device.unplug();
    let noticed = host.until(&device, 1000, |h| h.link.state() == LinkState::Lost);
    assert!(noticed < Duration::from_millis(100), "{noticed:?}");
    assert_eq!(host.usb.in_flight(), 0);
    let c = host.usb.counters();
    assert_eq!(c.frames_taken, c.frames_carried + c.frames_lost, "every frame is accounted for: {c:?}");
    assert!(c.frames_taken >= host.link.counters().frames_sent, "{c:?}");
    // Rendering goes on into nothing.
    assert!(matches!(host.offer(&device), SendOutcome::Dropped { .. }));
    let before = lit(&device);
    device.plug_in_again();
    let back = host.until(&device, 5000, |h| h.link.state() == LinkState::Ready);
    assert!(back < Duration::from_secs(1), "{back:?}");
    assert!(!device.mock(|m| m.is_lit()), "dark until armed again");
    assert!(before >= 5);
    host.arm(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 5);
    check(&device);
}

#[test]
fn u3_a_stall_costs_at_most_a_frame_and_three_a_reset() {
    let device = Device::new(3, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 5);
    device.plug.inject(DATA_OUT, 0, Fault::Stall);
    let from = lit(&device);
    let mut stalled: Option<Instant> = None;
    host.stream(&device, 5000, |h| {
        let c = h.usb.counters();
        if c.stalls >= 1 {
            stalled.get_or_insert_with(Instant::now);
        }
        c.frames_resent == 1
    });
    // Two frames, and what a busy machine takes.
    let repaired = stalled.expect("a stall").elapsed();
    assert!(repaired < Duration::from_millis(1000 * 2 / u64::from(FPS) + 50), "{repaired:?}");
    assert!(host.usb.counters().frames_lost <= 1, "{:?}", host.usb.counters());
    host.stream(&device, 5000, |_| lit(&device) >= from + 5);
    assert_eq!(host.link.state(), LinkState::Streaming, "the session survived");
    // Three within a second: the device is reset, greets again, and is dark until armed.
    for _ in 2..=4 {
        let before = host.usb.counters();
        device.plug.inject(DATA_OUT, 0, Fault::Stall);
        host.stream(&device, 5000, |h| {
            let c = h.usb.counters();
            c.frames_resent > before.frames_resent || c.resets == 1
        });
    }
    host.until(&device, 5000, |h| h.usb.counters().resets == 1 && h.link.state() == LinkState::Ready);
    assert!(!device.mock(|m| m.is_lit()));
    host.arm(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 5);
    check(&device);
}

#[test]
fn u4_a_slow_device_gets_whole_frames_newest_first() {
    let device = Device::new(4, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    for tenths in [5, 1] {
        // Of the rate that 200 frames a second need.
        let rate = frame_bytes() as u64 * u64::from(FPS) * tenths / 10;
        device.model.lock().unwrap().set_bytes_per_second(Some(rate));
        let (from, start) = (lit(&device), Instant::now());
        let mut oldest = Duration::ZERO;
        let mut shown = None;
        let mut offered: Vec<(u64, Instant)> = Vec::new();
        host.stream(&device, 20_000, |h| {
            if offered.last().is_none_or(|o| o.0 + 1 < h.next_id) {
                offered.push((h.next_id - 1, Instant::now()));
            }
            let now_lit = device.mock(|m| m.lit_frame());
            if now_lit != shown {
                shown = now_lit;
                let sent = offered.iter().find(|o| Some(o.0 as u32) == shown);
                oldest = oldest.max(sent.map_or(Duration::ZERO, |o| o.1.elapsed()));
            }
            lit(&device) >= from + 8
        });
        // Two frames in flight and one slot: no backlog builds up, however slow the cable.
        let frame_time = Duration::from_secs_f64(frame_bytes() as f64 / rate as f64);
        let bound = frame_time * 3 + Duration::from_millis(10 + 100);
        assert!(oldest < bound, "{oldest:?} at {tenths}/10, {bound:?} allowed, {:?}", start.elapsed());
    }
    let (c, s) = (host.link.counters(), device.mock(|m| m.status()));
    assert_eq!((s.frames_incomplete, s.payload_errors), (0, 0), "never a partial frame");
    assert!(c.link_busy + c.no_credit > 0);
    assert_eq!(c.frames_offered, c.frames_sent + c.link_busy + c.no_credit + c.not_streaming + c.not_newer);
    check(&device);
}

#[test]
fn u4_a_device_that_never_takes_anything_is_cleared() {
    let device = Device::new(5, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    device.plug.inject(DATA_OUT, 0, Fault::NakNs(i64::MAX));
    host.stream(&device, 5000, |h| h.usb.counters().stuck == 1);
    let from = lit(&device);
    host.stream(&device, 5000, |_| lit(&device) >= from + 5);
    assert_eq!(host.link.state(), LinkState::Streaming, "control went on, the watchdog was fed");
    check(&device);
}

#[test]
fn u5_a_short_write_restarts_the_frame() {
    let device = Device::new(6, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    for bytes in [0, 1, 700, frame_bytes() - 1] {
        device.plug.inject(DATA_OUT, 0, Fault::Short(bytes));
        let (from, short) = (lit(&device), host.usb.counters().short_writes);
        host.stream(&device, 5000, |h| h.usb.counters().short_writes == short + 1);
        host.stream(&device, 5000, |_| lit(&device) >= from + 5);
        // Out of the storm's second, so that four of them are not a reset.
        host.stream(&device, 5000, |_| lit(&device) >= from + 110);
    }
    check(&device);
}

#[test]
fn u6_babble_and_bus_errors_on_replies_are_survived() {
    let device = Device::new(7, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    device.plug.inject(REPLIES_IN, 1, Fault::Babble);
    device.plug.inject(REPLIES_IN, 3, Fault::BusError);
    device.plug.inject(REPLIES_IN, 5, Fault::Short(7));
    let from = lit(&device);
    host.stream(&device, 5000, |_| lit(&device) >= from + 20);
    let c = host.usb.counters();
    assert_eq!((c.babbles, c.bus_errors), (1, 1));
    // A halted reply endpoint is cleared.
    device.plug.inject(REPLIES_IN, 0, Fault::Stall);
    let from = lit(&device);
    host.stream(&device, 5000, |h| lit(&device) >= from + 20 && h.usb.counters().stalls > 0);
    check(&device);
}

#[test]
fn u8_a_device_that_forgot_everything_is_greeted_within_half_a_second() {
    let device = Device::new(8, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    let now = device.now();
    // In the middle of a frame.
    host.offer(&device);
    device.model.lock().unwrap().projector().power_cycle(now);
    let back = host.stream(&device, 5000, |h| h.link.state() == LinkState::Ready);
    assert!(back < Duration::from_millis(500), "{back:?}");
    host.arm(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    check(&device);
}

#[test]
fn u12_a_hot_device_is_dark_until_acknowledged() {
    let device = Device::new(9, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    let now = device.now();
    device.mock(|m| m.set_faults(now, faults::OVER_TEMPERATURE));
    host.until(&device, 5000, |h| h.link.state() == LinkState::Faulted);
    assert!(!device.mock(|m| m.is_lit()));
    let now = device.now();
    device.mock(|m| m.set_faults(now, 0));
    host.link.arm(faults::OVER_TEMPERATURE);
    host.until(&device, 5000, |h| h.link.state() == LinkState::Streaming);
}

#[test]
fn u13_a_second_host_is_refused() {
    let device = Device::new(10, Options::default());
    let _host = Host::connected(&device);
    let second = UsbTransport::open(device.settings()).unwrap_err();
    assert!(matches!(second, TransportError::InUse { .. }), "{second}");
    let text = second.to_string();
    assert!(text.contains("in use by another program") && text.contains(" at /dev/bus/usb/"), "{text}");
}

#[test]
fn u14_denied_names_the_rule_and_absent_names_the_device() {
    let device = Device::new(11, Options { denied: true, ..Options::default() });
    let settings = UsbSettings { serial: None, ..device.settings() };
    // Other tests' devices are on the bus too: by serial number only the denied one is asked for, which cannot be read.
    let refused = UsbTransport::open(UsbSettings { serial: Some("none".into()), ..settings }).unwrap_err();
    let text = refused.to_string();
    assert!(text.contains("permission denied") && text.contains("packaging/60-dpm.rules"), "{text}");
    assert!(text.contains(r#"ATTR{idVendor}=="1209""#), "{text}");
    assert!(text.contains("1209:000d") && text.contains(" at /dev/bus/usb/"), "which device: {text}");
    let rules = include_str!("../../../../packaging/60-dpm.rules");
    assert!(
        rules.contains(dpm_device::transport::usb::UDEV_RULE),
        "the rule in the error is the rule in the file"
    );
    let absent = UsbTransport::open(UsbSettings { product_id: 0x0bad, ..device.settings() }).unwrap_err();
    assert!(matches!(absent, TransportError::NotFound { .. }), "{absent}");
}

#[test]
fn u15_a_killed_host_leaves_darkness() {
    let device = Device::new(12, Options::default());
    let mut host = Host::new(&device, 200_000, FPS);
    host.link.connect();
    host.arm(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    assert!(device.mock(|m| m.is_lit()));
    // SIGKILL: no STOP, no farewell.
    std::mem::forget(host);
    let start = Instant::now();
    while device.mock(|m| m.is_lit()) {
        assert!(start.elapsed() < Duration::from_millis(250), "lit {:?} after the kill", start.elapsed());
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(device.mock(|m| m.status().faults), faults::WATCHDOG);
}

#[test]
fn the_lanes_are_independent_and_stop_overtakes_planes() {
    let device = Device::new(13, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    device.plug.inject(DATA_OUT, 0, Fault::NakNs(i64::MAX));
    host.offer(&device);
    let now = device.now();
    host.link.command(now, dpm_device::link::Verb::Stop, &mut host.usb).unwrap();
    let start = Instant::now();
    while device.mock(|m| m.status().state) != DeviceState::Configured {
        assert!(start.elapsed() < Duration::from_millis(50));
        std::thread::sleep(Duration::from_micros(200));
    }
    assert!(!device.mock(|m| m.is_lit()));
    assert!(host.usb.has_room(Lane::Control));
    device.plug.inject(CONTROL_OUT, 0, Fault::Stall);
    // Once for each transfer that the halt met.
    host.until(&device, 5000, |h| h.usb.counters().stalls >= 1);
    host.until(&device, 5000, |h| h.link.state() == LinkState::Ready);
}

/// The whole way: libusb, the usbfs calls, USB/IP over TCP, the projector at the far end.
#[test]
fn frames_cross_usbip_bit_for_bit() {
    let clock = monotonic_clock();
    let setup = MockConfig { serial: 15, ..MockConfig::new(raster()) };
    let model = Arc::new(Mutex::new(UsbProjector::new(MockProjector::new(setup), Speed::Super, None)));
    let plug = UsbPlug::new(model.clone(), clock.clone());
    let exports = vec![Export::new("1-1", Arc::new(plug.clone()))];
    let server = Server::start("127.0.0.1:0", exports).unwrap();
    let cable = RemoteCable::import(server.address(), "1-1").unwrap();
    let socket = Some(plug_in(Arc::new(cable), Options::default()));
    let device = Device { model, plug, socket, clock, serial: 15 };
    let mut host = Host::connected(&device);
    host.stream(&device, 10_000, |_| lit(&device) >= 20);
    check(&device);
    let s = device.mock(|m| m.status());
    assert_eq!((s.header_errors, s.payload_errors, s.frames_incomplete), (0, 0, 0));
    device.plug.unplug();
    let noticed = host.until(&device, 5000, |h| h.link.state() == LinkState::Lost);
    assert!(noticed < Duration::from_millis(100), "{noticed:?}");
    assert_eq!(host.usb.in_flight(), 0);
}

/// Found in use, section 2b of the second look at latency: a reply that waits for the next poll is stamped when it arrived.
#[test]
fn replies_are_stamped_when_they_arrive() {
    for (serial, with_clock) in [(31, true), (32, false)] {
        let device = Device::new(serial, Options::default());
        let mut host = Host::new(&device, 2_000_000, FPS);
        if !with_clock {
            let link = host.link;
            drop(host.usb);
            let usb = UsbTransport::open(device.settings()).unwrap();
            host = Host { link, usb, next_id: 1 };
        }
        host.link.connect();
        let mut shortest = i64::MAX;
        for _ in 0..40 {
            // Long after any answer has come.
            std::thread::sleep(Duration::from_millis(20));
            let _ = host.link.poll(device.now(), &mut host.usb);
            host.link.take_echoes(|e| {
                assert!(e.host_sent_at.0 as u64 <= e.device_received_at.0, "one clock stands behind both");
                assert!(!with_clock || e.device_sent_at.0 <= e.host_received_at.0 as u64);
                shortest = shortest.min(e.host_received_at.ns_since(e.host_sent_at));
            });
        }
        if with_clock {
            assert!(shortest < 10_000_000, "{shortest} ns");
        } else {
            assert!((20_000_000..i64::MAX).contains(&shortest), "what the stamps are for: {shortest} ns");
        }
    }
}

/// Found in use, R2: an order to be dark finds a transfer though all others of its lane hang.
#[test]
fn an_order_to_be_dark_passes_messages_that_wait() {
    let device = Device::new(33, Options::default());
    let mut host = Host::connected(&device);
    host.stream(&device, 5000, |_| lit(&device) >= 3);
    // The device takes no control message for a while: as many wait as the lane lets.
    device.plug.inject(CONTROL_OUT, 0, Fault::NakNs(60_000_000));
    let message = |kind| Packet::new(Header::control(kind, 1, 0), &[]);
    let mut waiting = 0;
    while host.usb.send(device.now(), Lane::Control, &[message(MessageType::Freeze)]).is_ok() {
        waiting += 1;
        assert!(waiting < 100, "the lane is never full");
    }
    assert!(!host.usb.has_room(Lane::Control));
    host.link.command(device.now(), Verb::Stop, &mut host.usb).expect("a place is kept for it");
    let dark = host.until(&device, 5000, |_| device.mock(|m| !m.is_lit()));
    assert!(dark < Duration::from_millis(400), "{dark:?}");
}
