//! A DLPC900 behind a display, at real pace: what its mirrors show is what was sent, and it is dark and at rest before and
//! after.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use crate::common::{link_settings, lit, planes, raster, run, settings, shared, with, PATIENCE};
use dpm_device::link::{HostLink, LinkState};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::encoding::Encoding;
use dpm_display::fake::{FakeKms, Shared};
use dpm_display::kms::Kms;
use dpm_display::transport::{on_card, DisplayTransport};
use dpm_dlpc900::command::{Opcode, REPORT_BYTES};
use dpm_dlpc900::driver::{Dlpc900, HidPort, PortError};
use dpm_dlpc900::lut::Dmd;
use dpm_dlpc900::video::{exposure_us, Receiver, VideoBits, VideoPatterns};
use dpm_dlpc900_rig::feed::behind;
use dpm_handoff::wake::WaitPolicy;
use hil_mock::dlpc900::{Dlpc900Fault, Dlpc900Model};

const DMD: Dmd = Dmd::Dlp6500;

fn lock(model: &Mutex<Dlpc900Model>) -> MutexGuard<'_, Dlpc900Model> {
    model.lock().unwrap()
}

/// A cable to the emulator at real pace, and a plug to pull.
struct EmulatorCable {
    model: Arc<Mutex<Dlpc900Model>>,
    clock: Arc<dyn HostClock>,
    is_plugged: Arc<AtomicBool>,
}

impl HidPort for EmulatorCable {
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

/// A rig at real pace: a card, the controller that its signal feeds, and what became of them.
struct Chain {
    card: Shared,
    model: Arc<Mutex<Dlpc900Model>>,
    clock: Arc<dyn HostClock>,
    is_plugged: Arc<AtomicBool>,
    /// The run should end.
    stop: Arc<AtomicBool>,
}

impl Chain {
    fn new() -> Self {
        let start = Instant::now();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
        Self {
            card: shared(),
            model: Arc::new(Mutex::new(Dlpc900Model::default())),
            clock,
            is_plugged: Arc::new(AtomicBool::new(true)),
            stop: Arc::default(),
        }
    }

    fn open(&self) -> Result<DisplayTransport, TransportError> {
        let settings = settings(Encoding::Planes24);
        let bits = VideoBits::PLANES;
        let us = exposure_us(bits, DMD, settings.rate, None).unwrap();
        let video = VideoPatterns::of_rig(DMD, Receiver::Hdmi, settings.rate, &settings.schedule, bits, us);
        let (card, clock) = (self.card.clone(), self.clock.clone());
        let kms = move || Ok(Box::new(FakeKms::new(card.clone(), clock.clone())) as Box<dyn Kms>);
        let (model, clock, is_plugged) = (self.model.clone(), self.clock.clone(), self.is_plugged.clone());
        let controller = move || {
            Dlpc900::new(EmulatorCable {
                model: model.clone(),
                clock: clock.clone(),
                is_plugged: is_plugged.clone(),
            })
        };
        let stop = self.stop.clone();
        let stop = Arc::new(move || stop.load(Ordering::Relaxed));
        let opener = behind(on_card(kms, settings), Arc::new(controller), video, stop);
        let mut transport = DisplayTransport::open(opener, WaitPolicy::Park, 0)?;
        transport.set_clock(self.clock.clone());
        Ok(transport)
    }

    /// Passes what the card has sent to the controller: a frame has arrived when the next one begins.
    fn pass(&self) {
        let frame_ns = link_settings().rate.slot_len_ns(0);
        with(&self.card, |card| {
            for frame in card.scanned.drain(..) {
                let size = [raster().width(), raster().height()];
                lock(&self.model).video_frame(HostTime(frame.at_ns + frame_ns), size, &frame.pixels);
            }
        });
    }

    /// Streams a frame for every slot until `done`.
    fn stream(
        &self,
        link: &mut HostLink,
        cable: &mut DisplayTransport,
        mut done: impl FnMut(&HostLink) -> bool,
    ) {
        run(link, cable, self.clock.as_ref(), |link| {
            self.pass();
            done(link)
        });
    }

    /// True if pattern `k` shows plane `k` of frame `id` in the corner of the panel, and nothing beside it.
    fn shows(&self, id: u64, k: usize) -> bool {
        let (own, sent) = (raster(), planes(id));
        let wanted = |y: usize| {
            let mut rows = sent[k * own.plane_bytes()..][..own.plane_bytes()].chunks(own.row_bytes());
            rows.nth(y)
        };
        let shown = lock(&self.model).projected_plane(k).expect("a frame has arrived");
        shown.chunks(DMD.raster().row_bytes()).enumerate().all(|(y, row)| {
            let (inside, outside) = row.split_at(own.row_bytes());
            outside.iter().all(|b| *b == 0)
                && wanted(y).map_or(inside.iter().all(|b| *b == 0), |wanted| wanted == inside)
        })
    }

    fn dark_because(&self) -> Option<&'static str> {
        lock(&self.model).dark_because()
    }
}

/// The whole chain: every pattern shows its plane, a cable that is pulled is survived, an abort is told, and the end is at
/// rest.
#[test]
fn a_live_rig_behind_a_controller_shows_its_planes_and_ends_at_rest() {
    let chain = Chain::new();
    let mut cable = chain.open().unwrap();
    assert!(cable.name().contains("DLP6500 behind display HDMI-A-1"), "{}", cable.name());
    assert_eq!(chain.dark_because(), None, "the patterns run, of black frames");
    let mut link = HostLink::new(link_settings());
    link.connect();
    chain.stream(&mut link, &mut cable, |link| lit(link) >= 20);
    // The frame of some slot, which the first plane tells.
    let frame = (0..2000).find(|id| chain.shows(*id, 0)).expect("a frame that was sent");
    assert!((1..24).all(|k| chain.shows(frame, k)), "all planes of frame {frame}");

    // The controller's own cable: the display goes dark, and both are set up again.
    chain.is_plugged.store(false, Ordering::Relaxed);
    chain.stream(&mut link, &mut cable, |link| link.state() == LinkState::Lost);
    assert!(with(&chain.card, |card| card.is_black));
    chain.is_plugged.store(true, Ordering::Relaxed);
    chain.stream(&mut link, &mut cable, |link| link.state() == LinkState::Streaming && lit(link) >= 10);

    // A sequence that aborts is a loss too, and is told.
    lock(&chain.model).inject(Dlpc900Fault::Hardware(0x40));
    let limit = Instant::now() + PATIENCE;
    let told = loop {
        assert!(Instant::now() < limit);
        chain.pass();
        if let Err(e) = cable.receive(chain.clock.now(), &mut |_, _, _| {}) {
            break e.to_string();
        }
        std::thread::sleep(Duration::from_millis(1));
    };
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
    for (fault, why) in [
        (Dlpc900Fault::Source(false), "did not lock"),
        (Dlpc900Fault::Hardware(0x04), "reset controller error"),
    ] {
        let chain = Chain::new();
        lock(&chain.model).inject(fault);
        let told = chain.open().err().expect("refused").to_string();
        assert!(told.contains("DLPC900") && told.contains(why), "{told}");
        assert_eq!(chain.dark_because(), Some("mirrors exercised"), "{why}");
        assert!(with(&chain.card, |card| card.is_black));
    }
    let chain = Chain::new();
    chain.is_plugged.store(false, Ordering::Relaxed);
    assert!(matches!(chain.open().err(), Some(TransportError::Unplugged { .. })));
}

/// A stop during the seconds of a set-up is not waited for: the controller rests at once, and nothing was lit.
#[test]
fn a_stop_ends_a_set_up_at_once() {
    let chain = Chain::new();
    let stop = chain.stop.clone();
    let asked = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_secs(1));
        stop.store(true, Ordering::Relaxed);
        Instant::now()
    });
    assert!(chain.open().is_err());
    let ended = asked.join().unwrap().elapsed();
    assert!(ended < Duration::from_millis(500), "{ended:?}");
    assert_eq!(chain.dark_because(), Some("mirrors exercised"));
    let led_on =
        |m: &Dlpc900Model| m.executed().iter().any(|c| c.opcode == Opcode::LED_ENABLE && c.data != [0]);
    assert!(!led_on(&lock(&chain.model)), "the LEDs were never switched on");
}
