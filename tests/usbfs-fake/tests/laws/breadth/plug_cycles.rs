//! A thousand times unplugged, in the middle of a frame, and plugged in again: nothing is leaked and the picture comes back each time. A
//! program of its own, so that its memory and descriptors are nobody else's.
#![allow(unsafe_code)]

use crate::link_usb_common::{check, lit, Device, Host};
use dpm_device::link::{LinkError, LinkState};
use dpm_device::transport::usb::DATA_OUT;
use dpm_device::transport::{Transport, TransportError};
use hil_mock::usb_plug::Fault;
use std::time::Duration;
use usbfs_fake::Options;

/// Slots so short that the next one has always come.
const FPS: u32 = 4000;
const CYCLES: u32 = 1000;
/// Until here everything that is made once has been made.
const SETTLED: u32 = 100;

/// Bytes that this program holds by `malloc`, Rust's and libusb's alike, and its open descriptors.
fn held() -> (i64, usize) {
    // SAFETY: reads counters of the C library.
    let heap = unsafe { libc::mallinfo2() };
    let files = std::fs::read_dir("/proc/self/fd").expect("a list of descriptors").count();
    ((heap.uordblks + heap.hblkhd) as i64, files)
}

#[test]
fn a_thousand_plugs_leak_nothing() {
    // One arena for all threads: the C library counts no other.
    // SAFETY: sets a number of the C library, before any other thread is at work.
    assert_eq!(unsafe { libc::mallopt(libc::M_ARENA_MAX, 1) }, 1);
    let mut device = Device::new(14, Options::default());
    let mut host = Host::new(&device, 2_000_000, FPS);
    host.link.connect();
    host.arm(&device);
    let (mut first, mut most) = (held(), held());
    for cycle in 0..CYCLES {
        host.stream(&device, 20_000, |_| lit(&device) >= 1);
        check(&device);
        // Every second time with a frame that the device does not take and another behind it.
        if cycle % 2 == 1 {
            device.plug.inject(DATA_OUT, 0, Fault::NakNs(i64::MAX));
            host.stream(&device, 20_000, |h| h.usb.in_flight() > 9);
        }
        device.unplug();
        // Without waiting for the tenth of a second at which the link would try by itself.
        let error = loop {
            match host.link.poll(device.now(), &mut host.usb) {
                Err(e) => break e,
                Ok(state) => assert_eq!(state, LinkState::Streaming),
            }
        };
        assert!(matches!(error, LinkError::Transport(TransportError::Unplugged { .. })), "{error}");
        assert_eq!(host.usb.in_flight(), 0, "transfers left with the kernel in cycle {cycle}");
        let (sent, c) = (host.link.counters().frames_sent, host.usb.counters());
        assert_eq!(c.frames_taken, c.frames_carried + c.frames_lost, "every frame is accounted for: {c:?}");
        assert!(c.frames_taken >= sent, "{sent} frames, and perhaps a SYNC: {c:?}");
        device.plug_in_again();
        while host.usb.reopen().is_err() {
            std::thread::sleep(Duration::from_micros(200));
        }
        host.link.connect();
        host.arm(&device);
        if cycle == SETTLED {
            (first, most) = (held(), held());
        } else if cycle > SETTLED {
            let now = held();
            most = (most.0.max(now.0), most.1.max(now.1));
        }
    }
    let last = held();
    println!("heap {} bytes after {SETTLED} cycles, {} after {CYCLES}, at most {}", first.0, last.0, most.0);
    println!("descriptors {} after {SETTLED} cycles, {} after {CYCLES}, at most {}", first.1, last.1, most.1);
    // The C library counts what its threads keep for themselves as held, which levels off after some thousand cycles. The least that could be
    // leaked, one transfer without its buffer, takes 200 bytes: 180 KB in 900 cycles.
    assert!(last.0 - first.0 < 72 * 900, "{first:?} {last:?}");
    assert!(last.1 <= first.1 + 1 && most.1 <= first.1 + 4, "{first:?} {last:?} {most:?}");
    assert_eq!(host.usb.counters().opened, u64::from(CYCLES) + 1);
}
