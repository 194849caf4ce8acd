//! A small display, frames whose bits are a function of their number, and what their pixels must be.
#![allow(dead_code, unreachable_pub, reason = "each test uses its part")]

use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use dpm_device::link::{Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome, Underrun};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::projector::light_of_planes;
use dpm_device::rng::Draws;
use dpm_device::time::{DeviceTicks, FrameRate, HostClock, HostTime};
use dpm_device::transport::inproc::Direct;
use dpm_display::encoding::Encoding;
use dpm_display::fake::{display, FakeKms, FakeState, Shared};
use dpm_display::kms::Kms;
use dpm_display::mode::{ModeWish, Timing};
use dpm_display::panel::DisplayPanel;
use dpm_display::set_up::{plan, DisplaySettings};
use dpm_display::transport::DisplayTransport;
use dpm_handoff::path::Lock;

/// 70 x 16 at 60 Hz: 70 columns are a run of 64 and one that ends within a byte.
pub const SMALL: Timing =
    Timing { clock_khz: 150, row: [70, 74, 80, 100], frame: [16, 18, 20, 25], flags: 5 };

pub fn raster() -> Raster {
    Raster::new(70, 16).unwrap()
}

pub fn settings(encoding: Encoding) -> DisplaySettings {
    DisplaySettings {
        connector: Some("HDMI-A-1".into()),
        mode: ModeWish::Named { width: 70, height: 16, millihertz: Some(60_000) },
        encoding,
        without: Vec::new(),
        commit_ns: 3_000_000,
        shows_at_pulse: false,
        raster: raster(),
        schedule: PlaneSchedule::rgb24(),
        rate: FrameRate::new(60, 1).unwrap(),
    }
}

pub fn shared() -> Shared {
    Arc::new(Lock::new(display(&[SMALL])))
}

pub fn with<R>(shared: &Shared, look: impl FnOnce(&mut FakeState) -> R) -> R {
    look(&mut shared.lock().unwrap())
}

/// Planes of frame `id`: any bits, none of them beside the picture.
pub fn planes(id: u64) -> Vec<u8> {
    let (r, draws) = (raster(), Draws::new(id + 1));
    let mut all: Vec<u8> = (0..r.plane_bytes() * 24).map(|i| draws.bits(i as u64) as u8).collect();
    for row in all.chunks_mut(r.row_bytes()) {
        row[r.row_bytes() - 1] &= 0xff << (r.row_bytes() * 8 - r.width() as usize);
    }
    all
}

/// The pixels of frame `id`, written one bit at a time: the oracle.
pub fn pixels(id: u64, encoding: Encoding) -> Vec<u8> {
    let (r, planes) = (raster(), planes(id));
    let mut out = vec![0; 4 * r.pixel_count()];
    match encoding {
        Encoding::Rgb8 => {
            let mut light = vec![[0; 3]; r.pixel_count()];
            light_of_planes(r, &PlaneSchedule::rgb24(), &planes, &mut light);
            for (out, [red, green, blue]) in out.chunks_exact_mut(4).zip(light) {
                out.copy_from_slice(&[blue, green, red, 0]);
            }
        }
        Encoding::Planes24 => {
            for k in 0..24 {
                for y in 0..r.height() as usize {
                    for x in 0..r.width() as usize {
                        let bit = planes[k * r.plane_bytes() + y * r.row_bytes() + x / 8] >> (7 - x % 8) & 1;
                        // Green, red and blue, in memory the second, third and first byte.
                        let byte = [1, 2, 0][k / 8];
                        out[4 * (y * r.width() as usize + x) + byte] |= bit << (k % 8);
                    }
                }
            }
        }
    }
    out
}

/// A rig at virtual pace: a host, a display, and the time.
pub struct DisplayRig {
    pub link: HostLink,
    pub cable: Direct<DisplayPanel<FakeKms>>,
    pub shared: Shared,
    now: Arc<AtomicI64>,
    pub encoding: Encoding,
    /// Frames that were sent, with their slots.
    pub sent: Vec<(u64, u64)>,
    last_slot: u64,
}

pub fn link_settings() -> LinkSettings {
    LinkSettings {
        raster: raster(),
        schedule: PlaneSchedule::rgb24(),
        rate: FrameRate::new(60, 1).unwrap(),
        watchdog_us: 100_000,
        underrun: Underrun::Repeat,
        late_slots: 255,
        epoch: Epoch::At(DeviceTicks(0)),
        codecs: 0,
        flash_limit: None,
        limits: LightLimits::OFF,
    }
}

/// How long anything may take on a busy machine.
pub const PATIENCE: Duration = Duration::from_secs(20);

/// Polls, arms, and sends a frame for every slot, until `done`.
pub fn run(
    link: &mut HostLink,
    display: &mut DisplayTransport,
    clock: &dyn HostClock,
    mut done: impl FnMut(&HostLink) -> bool,
) {
    let limit = Instant::now() + PATIENCE;
    let mut next = 0;
    while !done(link) {
        assert!(Instant::now() < limit, "still {:?}, {:?}", link.state(), display.counts().map(|c| c.lost()));
        match link.poll(clock.now(), display) {
            Ok(LinkState::Ready) => link.arm(0),
            Ok(LinkState::Faulted) => link.arm(u32::MAX),
            Ok(LinkState::Streaming) => {
                // The slot is taken from what the display told last.
                let slots = link.slots().unwrap();
                let slot = link.status().and_then(|s| slots.slot_at(s.now)).map_or(0, |slot| slot + 3);
                if slot > next {
                    next = slot;
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 1_000_000_000));
                    let sent = link.send_frame(clock.now(), slot, target, dark_from, &planes(slot), display);
                    assert!(!matches!(sent, SendOutcome::Sent) || target < dark_from);
                }
            }
            Ok(LinkState::Lost | LinkState::Closed) | Err(_) if link.state() == LinkState::Closed => {
                link.connect()
            }
            _ => {}
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

pub fn lit(link: &HostLink) -> u32 {
    link.status().map_or(0, |s| s.frames_lit)
}

impl DisplayRig {
    pub fn new(encoding: Encoding, change: impl FnOnce(&mut FakeState)) -> Self {
        let shared = shared();
        with(&shared, change);
        let now = Arc::new(AtomicI64::new(1_000_000));
        let read = now.clone();
        let clock = Arc::new(move || HostTime(read.load(Ordering::Relaxed)));
        let mut kms = FakeKms::new(shared.clone(), clock.clone());
        let plan = plan(&kms.connectors().unwrap(), &settings(encoding)).unwrap();
        kms.start(&plan.setup).unwrap();
        let panel = DisplayPanel::new(kms, plan.panel, 1, clock.as_ref());
        let mut link = HostLink::new(link_settings());
        link.connect();
        Self { link, cable: Direct::new(panel), shared, now, encoding, sent: Vec::new(), last_slot: 0 }
    }

    pub fn now(&self) -> HostTime {
        HostTime(self.now.load(Ordering::Relaxed))
    }

    /// Time passes, and the panel's thread is as fast as it should be.
    pub fn pass(&mut self, ns: i64) {
        let end = self.now().plus_ns(ns);
        while self.now() < end {
            let due = self.cable.device().next_due().max(self.now().plus_ns(20_000)).min(end);
            self.now.store(due.0, Ordering::Relaxed);
            self.cable.device_mut().advance(due);
        }
    }

    /// Time passes, and the panel's thread sleeps.
    pub fn sleep(&mut self, ns: i64) {
        self.now.fetch_add(ns, Ordering::Relaxed);
    }

    /// The host polls; then half a millisecond passes.
    pub fn step(&mut self) -> LinkState {
        let now = self.now();
        let state = self.link.poll(now, &mut self.cable).expect("in-process");
        if state == LinkState::Ready {
            self.link.arm(0);
        }
        self.pass(500_000);
        state
    }

    pub fn stream(&mut self) {
        for _ in 0..2000 {
            if self.step() == LinkState::Streaming {
                return;
            }
        }
        panic!("still {:?}", self.link.state());
    }

    /// The link's slot that has begun, by the panel's clock.
    pub fn slot(&self) -> u64 {
        let clock = self.cable.device().pacer().expect("paced").clock();
        self.link.slots().unwrap().slot_at(clock.ticks_at(self.now())).unwrap()
    }

    /// Streams a frame for every slot until `frames` have been sent.
    pub fn send(&mut self, frames: usize) {
        let all = self.sent.len() + frames;
        while self.sent.len() < all {
            self.send_if_due();
            self.step();
        }
    }

    pub fn send_if_due(&mut self) {
        let slot = self.slot() + 2;
        if slot <= self.last_slot {
            return;
        }
        let id = self.sent.len() as u64 + 1;
        let slots = self.link.slots().unwrap();
        let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 60_000_000_000));
        let now = self.now();
        let outcome = self.link.send_frame(now, id, target, dark_from, &planes(id), &mut self.cable);
        if outcome == SendOutcome::Sent {
            self.sent.push((id, slot));
            self.last_slot = slot;
        }
    }

    /// What was scanned out at each blank from blank 0 on: the number of the frame, or `None` for black.
    ///
    /// # Panics
    /// When something was scanned out that is neither black nor a frame that was sent.
    pub fn scanned(&self) -> Vec<(u64, Option<u64>)> {
        let known: Vec<(u64, Vec<u8>)> =
            self.sent.iter().map(|(id, _)| (*id, pixels(*id, self.encoding))).collect();
        let pacer = self.cable.device().pacer().expect("paced");
        let last = with(&self.shared, |s| s.scanned.last().unwrap().sequence);
        with(&self.shared, |s| {
            let ahead = |sequence: u32| u64::from(last.wrapping_sub(sequence));
            let newest = pacer.number(last);
            s.scanned
                .iter()
                .filter(|scan| ahead(scan.sequence) <= newest)
                .map(|scan| {
                    let blank = newest - ahead(scan.sequence);
                    if scan.pixels.iter().all(|b| *b == 0) {
                        return (blank, None);
                    }
                    let frame = known.iter().find(|(_, pixels)| *pixels == scan.pixels);
                    (blank, Some(frame.expect("only frames that were sent, whole").0))
                })
                .collect()
        })
    }
}
