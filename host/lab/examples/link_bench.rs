//! What sending one frame of a rig's own pictures costs the link's thread, by codecs, as text: median and least of one core's time, without the
//! device's.
//!
//! `cargo run --release -p dpm-lab --example link_bench [RIG.toml]` (the demo's rig without one), 1024 x 768, 24 planes

use dpm_device::link::{Codec, DeviceState, HostLink, LinkSettings, LinkState, Packet, SendOutcome};
use dpm_device::planes::Raster;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::{Lane, SendError, Transport, TransportError};
use dpm_lab::link_test::TestFrames;
use dpm_mock::projector::{MockConfig, MockProjector};
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::projector;
use dpm_rig::rig::Rig;
use std::time::{Duration, Instant};

/// A device called directly behind a buffer that its frames are gathered in, as every real medium does; the device's own time is set apart.
struct Apart {
    device: Direct<MockProjector>,
    buffer: Vec<u8>,
    device_time: Duration,
}

impl Transport for Apart {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        packets.iter().fold(0, |at, packet| at + packet.write_to(&mut self.buffer[at..]));
        let begin = Instant::now();
        let result = self.device.send(now, lane, packets);
        self.device_time += begin.elapsed();
        result
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        self.device.receive(now, sink)
    }

    fn name(&self) -> &str {
        "in-process, timed"
    }
}

/// Median and least milliseconds of the host's part of a frame, the device's, and bytes a frame.
fn time(settings: LinkSettings, content: &TestFrames, frames: u64) -> (f64, f64, f64, f64) {
    let setup = MockConfig { events_kept: 0, ..MockConfig::new(settings.raster) };
    let bytes = projector::frame_bytes(settings.raster, settings.schedule.len());
    let mut medium = Apart {
        device: Direct::new(MockProjector::new(setup)),
        buffer: vec![0; bytes],
        device_time: Duration::ZERO,
    };
    let mut planes = vec![0; settings.raster.plane_bytes() * settings.schedule.len()];
    let mut link = HostLink::new(settings);
    let mut now = HostTime(0);
    let mut step = |link: &mut HostLink, medium: &mut Apart, ns| {
        now = now.plus_ns(ns);
        link.poll(now, medium).expect("the mock answers");
        now
    };
    link.connect();
    while link.state() != LinkState::Streaming {
        if link.state() == LinkState::Ready {
            link.arm(0);
        }
        step(&mut link, &mut medium, 1_000_000);
    }
    let slots = link.slots().expect("configured");
    let mut host = Vec::new();
    for id in 1..=frames {
        content.fill(id, &mut planes);
        let now = loop {
            let now = step(&mut link, &mut medium, 500_000);
            if link.credit() > 0 {
                break now;
            }
        };
        let device_now = link.status().map_or(DeviceTicks(0), |s| s.now);
        let slot = slots.slot_at(device_now).map_or(0, |k| k + 1);
        let before = medium.device_time;
        let begin = Instant::now();
        let outcome =
            link.send_frame(now, id, slots.start(slot), slots.dark_from(slot, 0), &planes, &mut medium);
        let spent = begin.elapsed() - (medium.device_time - before);
        assert_eq!(outcome, SendOutcome::Sent);
        host.push(spent.as_secs_f64() * 1e3);
    }
    let status = link.status().expect("streaming");
    assert_eq!((status.state, status.frames_incomplete), (DeviceState::Armed, 0));
    host.sort_unstable_by(f64::total_cmp);
    let sent = link.counters().frame_bytes_sent as f64 / frames as f64;
    (host[host.len() / 2], host[0], medium.device_time.as_secs_f64() * 1e3 / frames as f64, sent)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let none = Overrides { variables: vec![], flags: vec![] };
    let config = match std::env::args().nth(1) {
        Some(path) => RigConfig::load(path.as_ref(), &none)?,
        None => RigConfig::demo(&none)?,
    };
    let raster = Raster::new(1024, 768).ok_or("raster")?;
    let rig = Rig::build(&config, Some(raster))?;
    let gpu = Gpu::open(&GpuOptions::default())?;
    let contents = [TestFrames::rendered(&rig, &gpu, 8, &|| false)?, TestFrames::prepared(&rig, 8)];
    println!("content   codecs        host ms  least   device   bytes/frame");
    for content in &contents {
        for (name, codecs) in [
            ("raw", Codec::Raw.mask()),
            ("rle", Codec::Rle.mask()),
            ("xor + rle", Codec::XorRle.mask()),
            ("lz4", Codec::Lz4.mask()),
            ("auto", Codec::ALL),
        ] {
            let settings = projector::link_settings(&rig.config, raster);
            let settings = LinkSettings { codecs: codecs | Codec::Raw.mask(), flash_limit: None, ..settings };
            let (median, least, device, bytes) = time(settings, content, 400);
            println!("{:<9} {name:<12} {median:8.3} {least:6.3} {device:8.3} {bytes:13.0}", content.name());
        }
    }
    Ok(())
}
