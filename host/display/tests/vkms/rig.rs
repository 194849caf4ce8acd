//! The display of the tests, and a host that streams to it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use dpm_device::link::{HostLink, LinkSettings, LinkState, SendOutcome};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::rng::Draws;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::Transport;
use dpm_display::card::open_for;
use dpm_display::encoding::{Encoding, PixelMap};
use dpm_display::mode::{ModeWish, Timing};
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::{on_card, DisplayTransport, Opener};
use dpm_handoff::wake::WaitPolicy;

use crate::common;

/// Small, because the machine is emulated: 160 x 120 at 60 frames/s.
pub(crate) const MODE: &str = "1.8 160 164 180 200 120 124 130 150 +hsync -vsync";
/// Of the kernel's only virtual display.
pub(crate) const CONNECTOR: &str = "Virtual-1";
/// The kernel's checksums of it.
pub(crate) const CRC: &str = "/sys/kernel/debug/dri/0/crtc-0/crc";
/// How long anything may take on a busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) fn timing() -> Timing {
    match MODE.parse() {
        Ok(ModeWish::Exactly(timing)) => timing,
        _ => panic!("a timing"),
    }
}

pub(crate) fn settings(encoding: Encoding) -> DisplaySettings {
    let (width, height) = timing().size();
    DisplaySettings {
        connector: Some(CONNECTOR.into()),
        mode: MODE.parse().unwrap(),
        encoding,
        without: Vec::new(),
        commit_ns: 5_000_000,
        shows_at_pulse: false,
        raster: Raster::new(width, height).unwrap(),
        schedule: PlaneSchedule::rgb24(),
        rate: timing().rate().unwrap(),
    }
}

pub(crate) fn link_settings(settings: &DisplaySettings) -> LinkSettings {
    LinkSettings {
        raster: settings.raster,
        schedule: settings.schedule,
        rate: settings.rate,
        watchdog_us: 2_000_000,
        ..common::link_settings()
    }
}

/// The rig's clock.
pub(crate) fn clock() -> Arc<dyn HostClock> {
    let start = Instant::now();
    Arc::new(move || HostTime(start.elapsed().as_nanos() as i64))
}

pub(crate) fn opener(encoding: Encoding) -> Opener {
    on_card(|| open_for(None, Some(CONNECTOR)), settings(encoding))
}

/// Opens the display by `opener`, with its thread.
pub(crate) fn open_by(opener: Opener) -> (DisplayTransport, Arc<dyn HostClock>) {
    let clock = clock();
    let mut display = DisplayTransport::open(opener, WaitPolicy::Park, 0).expect("vkms");
    display.set_clock(clock.clone());
    (display, clock)
}

/// Planes of frame `id`: any bits in the first rows of each plane, the rest a function of few draws.
pub(crate) fn planes(raster: Raster, id: u64) -> Vec<u8> {
    let draws = Draws::new(id + 1);
    (0..raster.plane_bytes() * 24).map(|i| draws.bits((i % 1999) as u64) as u8 ^ (i / 1999) as u8).collect()
}

/// The pixels of frame `id`, as the product writes them.
pub(crate) fn pixels(encoding: Encoding, id: u64) -> Vec<u8> {
    let settings = settings(encoding);
    let raster = settings.raster;
    let pitch = 4 * raster.width() as usize;
    let mut out = vec![0; pitch * raster.height() as usize];
    PixelMap::new(encoding, &settings.schedule).unwrap().write(raster, &planes(raster, id), &mut out, pitch);
    out
}

/// Streams frames whose bits are a function of their number until `done`, which gets the number of frames sent. It goes on
/// when the display was lost and is back. Returns the frames with their slots.
pub(crate) fn stream(
    display: &mut DisplayTransport,
    clock: &dyn HostClock,
    encoding: Encoding,
    mut done: impl FnMut(usize, &HostLink) -> bool,
) -> Vec<(u64, u64)> {
    let settings = settings(encoding);
    let mut link = HostLink::new(link_settings(&settings));
    link.connect();
    let limit = Instant::now() + PATIENCE;
    let (mut sent, mut next, mut id) = (Vec::new(), 0, 0);
    while !done(sent.len(), &link) {
        assert!(Instant::now() < limit, "still {:?}, {:?}", link.state(), display.counts().map(|c| c.lost()));
        match link.poll(clock.now(), display) {
            Ok(LinkState::Ready) => {
                // A display that was lost begins to count anew.
                next = 0;
                link.arm(0);
            }
            Ok(LinkState::Faulted) => link.arm(u32::MAX),
            Ok(LinkState::Streaming) => {
                let slots = link.slots().unwrap();
                let slot = link.status().and_then(|s| slots.slot_at(s.now)).map_or(0, |slot| slot + 3);
                if slot > next {
                    (next, id) = (slot, id + 1);
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 2_000_000_000));
                    let planes = planes(settings.raster, id);
                    let outcome = link.send_frame(clock.now(), id, target, dark_from, &planes, display);
                    if outcome == SendOutcome::Sent {
                        sent.push((id, slot));
                    }
                }
            }
            Ok(LinkState::Closed) => link.connect(),
            // The link opens the display again by itself.
            Ok(_) | Err(_) => {}
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    if let Some(status) = link.status() {
        println!(
            "  {} sent to {}, {} lit, {} repeated, {} superseded, {} late",
            sent.len(),
            display.name(),
            status.frames_lit,
            status.slots_repeated,
            status.frames_superseded,
            status.frames_late
        );
    }
    sent
}
