//! A DLPC900 fed by a display: what its mirrors show is what was packed, and it is dark and at rest before and after.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use dpm_device::dlpc900::command::REPORT_BYTES;
use dpm_device::dlpc900::driver::{Dlpc900, HidPort, PortError};
use dpm_device::dlpc900::lut::Dmd;
use dpm_device::dlpc900::video::{exposure_us, Receiver, VideoBits, VideoPatterns};
use dpm_device::link::{Epoch, HostLink, LightLimits, LinkSettings, LinkState, Underrun};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostClock, HostTime};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::dlpc900::behind;
use dpm_display::encoding::{Encoding, PixelMap};
use dpm_display::fake::{display, FakeKms, Shared};
use dpm_display::kms::Kms;
use dpm_display::mode::{ModeWish, Timing};
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::{on_card, DisplayTransport};
use dpm_handoff::path::Lock;
use dpm_handoff::wake::WaitPolicy;
use dpm_lab::reference::Sampler;
use dpm_render::pack::{halftone, pack, BitPlaneFrame, Halftone, Kernel};
use hil_mock::dlpc900::{Dlpc900Fault, Dlpc900Model, VirtualHid};

const DMD: Dmd = Dmd::Dlp6500;

fn rate() -> FrameRate {
    FrameRate::new(60, 1).unwrap()
}

fn encodings() -> [(Encoding, VideoBits, PlaneSchedule); 2] {
    [
        (Encoding::Planes24, VideoBits::Planes, PlaneSchedule::equal_rgb24()),
        (Encoding::Rgb8, VideoBits::Colours, PlaneSchedule::rgb24()),
    ]
}

fn video(bits: VideoBits, schedule: &PlaneSchedule) -> VideoPatterns {
    let us = exposure_us(bits, DMD, rate(), None).unwrap();
    VideoPatterns::of_rig(DMD, Receiver::Hdmi, rate(), schedule, bits, us)
}

/// Columns and rows of the blocks whose mean light is judged.
const BLOCK: usize = 8;

/// Code values 0x00BBGGRR: each block of mirrors has three of its own, in some of them with a slope.
fn picture(raster: Raster) -> Vec<u32> {
    let mut random = Sampler::new(5, 0);
    let (width, height) = (raster.width() as usize, raster.height() as usize);
    let blocks: Vec<u64> =
        (0..width.div_ceil(BLOCK) * height.div_ceil(BLOCK)).map(|_| random.next_u64()).collect();
    let code = |x: usize, y: usize| {
        let block = blocks[y / BLOCK * width.div_ceil(BLOCK) + x / BLOCK];
        let slope = if block >> 40 & 1 == 1 { (x % BLOCK + y % BLOCK) as u64 } else { 0 };
        (0..3).map(|c| ((block >> (8 * c) & 0xff).saturating_sub(slope) as u32) << (8 * c)).sum()
    };
    (0..width * height).map(|i| code(i % width, i / width)).collect()
}

/// The mean light over blocks of mirrors and two video frames is the code value within half a level, with every encoding.
#[test]
fn light_behind_the_controller_is_the_picture() {
    let raster = DMD.raster();
    let codes = picture(raster);
    let width = raster.width() as usize;
    for (encoding, bits, schedule) in encodings() {
        let model = Arc::new(Mutex::new(Dlpc900Model::default()));
        let mut driver = Dlpc900::new(VirtualHid::new(model.clone())).unwrap();
        driver.start_video_patterns(&video(bits, &schedule)).unwrap();
        let map = PixelMap::new(encoding, &schedule).unwrap();
        let mut light = vec![[0; 3]; raster.pixel_count()];
        for number in 0..2 {
            let mut words = codes.clone();
            if let Some(how) = Halftone::of(&schedule) {
                halftone(how, raster, number, &codes, &mut words);
            }
            let mut frame = BitPlaneFrame::new(raster, schedule);
            pack(Kernel::best(), &words, &mut frame);
            let mut pixels = vec![0; 4 * raster.pixel_count()];
            map.write(raster, frame.bytes(), &mut pixels, 4 * width);
            let mut model = lock(&model);
            model.video_frame(HostTime(0), [raster.width(), raster.height()], &pixels);
            for (sum, of) in light.iter_mut().zip(model.light_of_table()) {
                (0..3).for_each(|c| sum[c] += of[c]);
            }
        }
        let full = 2.0 * f64::from(exposure_us(bits, DMD, rate(), None).unwrap() * bits.patterns() / 3);
        let mut worst = 0f64;
        for y in (0..raster.height() as usize).step_by(BLOCK) {
            for x in (0..width).step_by(BLOCK) {
                let mirrors = (0..BLOCK * BLOCK).map(|i| (y + i / BLOCK) * width + x + i % BLOCK);
                let sums = mirrors.fold([[0.0; 2]; 3], |mut sums, i| {
                    for (c, sum) in sums.iter_mut().enumerate() {
                        sum[0] += light[i][c] as f64 / full;
                        sum[1] += f64::from(codes[i] >> (8 * c) & 0xff);
                    }
                    sums
                });
                for [shown, wanted] in sums {
                    worst = worst.max((shown - wanted).abs() / (BLOCK * BLOCK) as f64);
                }
            }
        }
        println!("{encoding:?}: a block's mean is off by {worst:.3} of 255 at most");
        assert!(worst <= 0.5, "{encoding:?}: {worst}");
    }
}

fn lock(model: &Mutex<Dlpc900Model>) -> MutexGuard<'_, Dlpc900Model> {
    model.lock().unwrap()
}

/// A cable to the emulator at real pace, and a plug to pull.
struct Cable {
    model: Arc<Mutex<Dlpc900Model>>,
    clock: Arc<dyn HostClock>,
    is_plugged: Arc<AtomicBool>,
}

impl HidPort for Cable {
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], _: Duration) -> Result<(), PortError> {
        if !self.is_plugged.load(Ordering::Relaxed) {
            return Err(PortError::Gone);
        }
        lock(&self.model).interrupt_out(self.clock.now(), 0x01, report);
        Ok(())
    }

    fn read_report(&mut self, report: &mut [u8; REPORT_BYTES], _: Duration) -> Result<(), PortError> {
        *report = lock(&self.model).interrupt_in(0x81).ok_or(PortError::Timeout)?;
        Ok(())
    }
}

/// 70 x 16 at 60 Hz.
const SMALL: Timing = Timing { clock_khz: 150, row: [70, 74, 80, 100], frame: [16, 18, 20, 25], flags: 5 };

/// A rig at real pace: a card, the controller that its signal feeds, and what became of them.
struct Chain {
    card: Shared,
    model: Arc<Mutex<Dlpc900Model>>,
    clock: Arc<dyn HostClock>,
    is_plugged: Arc<AtomicBool>,
    /// Frames of the card that the controller has received.
    received: usize,
}

impl Chain {
    fn new() -> Self {
        let start = Instant::now();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
        Self {
            card: Arc::new(Lock::new(display(&[SMALL]))),
            model: Arc::new(Mutex::new(Dlpc900Model::default())),
            clock,
            is_plugged: Arc::new(AtomicBool::new(true)),
            received: 0,
        }
    }

    fn open(&self, schedule: PlaneSchedule) -> Result<DisplayTransport, TransportError> {
        let settings = DisplaySettings {
            connector: Some("HDMI-A-1".into()),
            mode: ModeWish::Named { width: 70, height: 16, millihertz: Some(60_000) },
            encoding: Encoding::Planes24,
            without: Vec::new(),
            commit_ns: 3_000_000,
            raster: Raster::new(70, 16).unwrap(),
            schedule,
            rate: rate(),
        };
        let (card, clock) = (self.card.clone(), self.clock.clone());
        let kms = move || Ok(Box::new(FakeKms::new(card.clone(), clock.clone())) as Box<dyn Kms>);
        let (model, clock, is_plugged) = (self.model.clone(), self.clock.clone(), self.is_plugged.clone());
        let controller = move || {
            Dlpc900::new(Cable { model: model.clone(), clock: clock.clone(), is_plugged: is_plugged.clone() })
        };
        let video = video(VideoBits::Planes, &schedule);
        let opener = behind(on_card(kms, settings), Arc::new(controller), video);
        let mut transport = DisplayTransport::open(opener, WaitPolicy::Park, 0)?;
        transport.set_clock(self.clock.clone());
        Ok(transport)
    }

    /// Passes what the card has sent to the controller: a frame has arrived when the next one begins.
    fn pass(&mut self) {
        let mut card = self.card.lock().unwrap();
        let next_ns = rate().slot_len_ns(0);
        for frame in &card.scanned[self.received..] {
            lock(&self.model).video_frame(HostTime(frame.at_ns + next_ns), [70, 16], &frame.pixels);
        }
        card.scanned.clear();
        self.received = 0;
    }

    fn dark_because(&self) -> Option<&'static str> {
        lock(&self.model).dark_because()
    }
}

/// The planes of every frame: the bits of some number.
fn planes(schedule: &PlaneSchedule, raster: Raster) -> Vec<u8> {
    let mut random = Sampler::new(9, 0);
    let mut all: Vec<u8> =
        (0..raster.plane_bytes() * schedule.len()).map(|_| random.next_u64() as u8).collect();
    for row in all.chunks_mut(raster.row_bytes()) {
        row[raster.row_bytes() - 1] &= 0xff << (raster.row_bytes() * 8 - raster.width() as usize);
    }
    all
}

/// Streams frames of `planes` over `link` until `done`.
fn stream(
    chain: &mut Chain,
    link: &mut HostLink,
    cable: &mut DisplayTransport,
    planes: &[u8],
    mut done: impl FnMut(&Chain, &HostLink) -> bool,
) {
    let limit = Instant::now() + Duration::from_secs(60);
    let mut next = 0;
    while !done(chain, link) {
        assert!(Instant::now() < limit, "{:?}, {:?}", link.state(), lock(&chain.model).summary(HostTime(0)));
        match link.poll(chain.clock.now(), cable) {
            Ok(LinkState::Ready) => link.arm(0),
            Ok(LinkState::Faulted) => link.arm(u32::MAX),
            Ok(LinkState::Streaming) => {
                let slots = link.slots().unwrap();
                let slot = link.status().and_then(|s| slots.slot_at(s.now)).map_or(0, |slot| slot + 3);
                if slot > next {
                    next = slot;
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 1_000_000_000));
                    let _ = link.send_frame(chain.clock.now(), slot, target, dark_from, planes, cable);
                }
            }
            _ if link.state() == LinkState::Closed => link.connect(),
            _ => {}
        }
        chain.pass();
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn link_settings(schedule: PlaneSchedule) -> LinkSettings {
    LinkSettings {
        raster: Raster::new(70, 16).unwrap(),
        schedule,
        rate: rate(),
        watchdog_us: 200_000,
        underrun: Underrun::Repeat,
        late_slots: 255,
        epoch: Epoch::At(DeviceTicks(0)),
        codecs: 0,
        flash_limit: None,
        limits: LightLimits::OFF,
    }
}

/// The whole chain at real pace: every pattern shows its plane, a cable that is pulled is survived, and the end is at rest.
#[test]
fn a_live_rig_behind_a_controller_shows_its_planes_and_ends_at_rest() {
    let schedule = PlaneSchedule::equal_rgb24();
    let raster = Raster::new(70, 16).unwrap();
    let sent = planes(&schedule, raster);
    let mut chain = Chain::new();
    let mut cable = chain.open(schedule).unwrap();
    assert!(cable.name().contains("DLP6500 behind display HDMI-A-1"), "{}", cable.name());
    assert_eq!(chain.dark_because(), None, "the patterns run, of black frames");
    let mut link = HostLink::new(link_settings(schedule));
    link.connect();
    let is_shown = |chain: &Chain, k: usize| {
        let shown = lock(&chain.model).projected_plane(k);
        let own = &sent[k * raster.plane_bytes()..][..raster.plane_bytes()];
        // The picture is in the corner of the panel; nothing else is lit.
        shown.is_some_and(|shown| {
            let rows = shown.chunks(DMD.raster().row_bytes()).enumerate();
            rows.into_iter().all(|(y, row)| {
                let (inside, outside) = row.split_at(raster.row_bytes());
                let wanted = own.chunks(raster.row_bytes()).nth(y);
                outside.iter().all(|b| *b == 0)
                    && wanted.map_or(inside.iter().all(|b| *b == 0), |w| w == inside)
            })
        })
    };
    let lit = |link: &HostLink| link.status().map_or(0, |s| s.frames_lit);
    stream(&mut chain, &mut link, &mut cable, &sent, |_, link| lit(link) >= 20);
    for k in 0..24 {
        assert!(is_shown(&chain, k), "plane {k}");
    }

    // The controller's own cable: the display goes dark, and both are set up again.
    chain.is_plugged.store(false, Ordering::Relaxed);
    stream(&mut chain, &mut link, &mut cable, &sent, |_, link| link.state() == LinkState::Lost);
    assert!(chain.card.lock().unwrap().is_black);
    chain.is_plugged.store(true, Ordering::Relaxed);
    stream(&mut chain, &mut link, &mut cable, &sent, |_, link| {
        link.state() == LinkState::Streaming && lit(link) >= 10
    });

    // A sequence that aborts is a loss too, and is told.
    lock(&chain.model).inject(Dlpc900Fault::Hardware(0x40));
    let mut told = String::new();
    let limit = Instant::now() + Duration::from_secs(20);
    while told.is_empty() {
        assert!(Instant::now() < limit);
        if let Err(e) = cable.receive(chain.clock.now(), &mut |_, _, _| {}) {
            told = e.to_string();
        }
        chain.pass();
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(told.contains("sequencer abort"), "{told}");
    drop(cable);
    assert_eq!(chain.dark_because(), Some("mirrors exercised"));
    let model = lock(&chain.model);
    let warnings: Vec<_> = model.warnings().iter().filter(|w| !w.contains("error 5")).collect();
    assert!(warnings.is_empty(), "{warnings:?}");
}

/// Whatever keeps the controller from showing the frames ends the start, with its reason, dark and at rest.
#[test]
fn a_controller_that_cannot_be_fed_is_told_and_rests() {
    let schedule = PlaneSchedule::equal_rgb24();
    for (fault, why) in [
        (Dlpc900Fault::Source(false), "did not lock"),
        (Dlpc900Fault::Hardware(0x04), "reset controller error"),
    ] {
        let chain = Chain::new();
        lock(&chain.model).inject(fault);
        let told = chain.open(schedule).err().expect("refused").to_string();
        assert!(told.contains("DLPC900") && told.contains(why), "{told}");
        assert_eq!(chain.dark_because(), Some("mirrors exercised"), "{why}");
        assert!(chain.card.lock().unwrap().is_black);
    }
    let chain = Chain::new();
    chain.is_plugged.store(false, Ordering::Relaxed);
    assert!(matches!(chain.open(schedule).err(), Some(TransportError::Unplugged { .. })));
}
