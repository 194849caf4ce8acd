//! A DLPC900 run against the emulator: what is shown, what orders do, and what happens when the cable is pulled.

use super::*;
use crate::pack::unpack;
use crate::pipeline::prepared::PreparedFrames;
use dpm_device::dlpc900::lut::DisplayMode;
use dpm_device::time::HostTime;
use hil_mock::dlpc900::{Dlpc900Model, Options, Sequencer, VirtualHid};
use std::sync::{Arc, Mutex};

const DMD: Dmd = Dmd::Dlp5500;

fn model() -> Arc<Mutex<Dlpc900Model>> {
    Arc::new(Mutex::new(Dlpc900Model::new(Options { dmd: DMD, strict: true, ..Options::default() })))
}

fn frames(schedule: PlaneSchedule, n: u64) -> Vec<BitPlaneFrame> {
    let mut prepared = PreparedFrames::new(DMD.raster());
    (0..n)
        .map(|k| {
            let mut frame = BitPlaneFrame::new(DMD.raster(), schedule);
            prepared.pack(Kernel::best(), k, &mut frame);
            frame
        })
        .collect()
}

#[test]
fn a_frame_becomes_three_patterns_of_eight_bits_that_share_its_time() {
    let schedule = PlaneSchedule::rgb24();
    let frames = frames(schedule, 2);
    let sequence = preload(DMD, &schedule, &frames, 33_333, Some(10_000)).unwrap();
    let entries = sequence.entries();
    assert_eq!(entries.len(), 6);
    for (i, e) in entries.iter().enumerate() {
        assert_eq!((e.depth, e.exposure_us, e.dark_us), (8, 10_000, 1_111), "entry {i}");
        assert_eq!(e.leds, [led::RED, led::GREEN, led::BLUE][i % 3]);
    }
    // Frames of one channel share an image.
    let mono = PlaneSchedule::mono8();
    let sequence = preload(DMD, &mono, &self::frames(mono, 4), 16_666, None).unwrap();
    assert_eq!((sequence.entries().len(), sequence.images().len()), (4, 2));
    assert!(sequence.entries().iter().all(|e| e.leds == led::WHITE && e.exposure_us == 16_666));
    for (dmd, planes, held) in [(Dmd::Dlp6500, 24, 16), (Dmd::Dlp6500, 8, 48), (Dmd::Dlp500yx, 24, 18)] {
        assert_eq!(frames_held(dmd, planes), held, "{dmd:?} {planes}");
    }
    // A DLP6500 shows eight bits in 4046 us at least.
    let none: &[BitPlaneFrame] = &[];
    assert!(preload(Dmd::Dlp6500, &schedule, none, 10_000, None).is_err());
}

/// What the emulator projects is, grey value by grey value, what was packed; it runs, obeys, and is put to rest.
#[test]
fn loaded_frames_are_shown_bit_for_bit_and_put_to_rest() {
    let schedule = PlaneSchedule::rgb24();
    let frames = frames(schedule, 2);
    let show = Show::Preloaded(preload(DMD, &schedule, &frames, 33_333, None).unwrap());
    let model = model();
    let monitor = Arc::new(RunMonitor::default());
    let (seen, watched) = (model.clone(), monitor.clone());
    let observer = std::thread::spawn(move || {
        let _ends = StopOnExit(watched.clone());
        let until = |what: &str, wanted: &dyn Fn(&mut Dlpc900Model) -> bool| {
            for _ in 0..4000 {
                if wanted(&mut seen.lock().unwrap()) {
                    return;
                }
                std::thread::sleep(Duration::from_millis(5));
            }
            panic!("never {what}");
        };
        let running = |m: &mut Dlpc900Model| matches!(m.sequencer(HostTime(0)), Sequencer::Running(..));
        until("running", &running);
        {
            let m = seen.lock().unwrap();
            assert_eq!(m.mode(), DisplayMode::OnTheFly);
            let mut codes = vec![0u32; DMD.raster().pixel_count()];
            for (k, frame) in frames.iter().enumerate() {
                unpack(frame, &mut codes);
                for channel in 0..3 {
                    let grey = m.projected_grey(3 * k + channel).expect("a pattern");
                    let wanted = codes.iter().map(|c| (c >> (8 * channel)) as u8);
                    assert!(grey.into_iter().eq(wanted), "frame {k} channel {channel}");
                }
            }
            assert_eq!(m.warnings(), [] as [String; 0]);
        }
        watched.give_order(Order::Black);
        until("stopped", &|m| m.sequencer(HostTime(0)) == Sequencer::Stopped);
        watched.give_order(Order::Arm);
        until("running again", &running);
    });
    let mut open = || Dlpc900::new(VirtualHid::new(model.clone()));
    let report = present(&mut open, &show, None, &monitor).unwrap();
    observer.join().unwrap();
    assert_eq!((report.patterns, report.mode, report.came_back), (6, "preloaded", 0));
    assert!((report.frame_rate_hz - 30.0).abs() < 0.01, "{}", report.frame_rate_hz);
    assert_eq!(model.lock().unwrap().dark_because(), Some("mirrors exercised"));
    assert_eq!(monitor.projector(), ProjectorHealth::Stopped);
}

/// Ends the run with the thread that watches it, should that fail, too.
struct StopOnExit(Arc<RunMonitor>);

impl Drop for StopOnExit {
    fn drop(&mut self) {
        self.0.request_stop();
    }
}

/// A cable that can be cut: what stands at its other end is looked up each time it is opened.
struct Cut {
    hid: VirtualHid,
    plugged: Arc<Mutex<Option<Arc<Mutex<Dlpc900Model>>>>>,
}

impl Cut {
    fn is_whole(&self) -> Result<(), PortError> {
        self.plugged.lock().unwrap().as_ref().map(|_| ()).ok_or(PortError::Gone)
    }
}

impl HidPort for Cut {
    fn write_report(&mut self, report: &[u8; 64], timeout: Duration) -> Result<(), PortError> {
        self.is_whole()?;
        self.hid.write_report(report, timeout)
    }
    fn read_report(&mut self, report: &mut [u8; 64], timeout: Duration) -> Result<(), PortError> {
        self.is_whole()?;
        self.hid.read_report(report, timeout)
    }
    fn pause(&mut self, time: Duration) {
        self.hid.pause(time);
    }
}

/// Unplugged it is lost within a look, plugged in again it is set up from nothing, and what the operator said last still holds.
#[test]
fn a_controller_that_was_unplugged_is_set_up_again_as_the_operator_left_it() {
    let schedule = PlaneSchedule::mono8();
    let frames = frames(schedule, 3);
    let show = Show::Preloaded(preload(DMD, &schedule, &frames, 33_333, None).unwrap());
    let plugged = Arc::new(Mutex::new(Some(model())));
    let monitor = Arc::new(RunMonitor::default());
    let (socket, watched) = (plugged.clone(), monitor.clone());
    let observer = std::thread::spawn(move || {
        let _ends = StopOnExit(watched.clone());
        let until = |what: &str, limit: Duration, wanted: &dyn Fn() -> bool| {
            let (mut waited, step) = (Duration::ZERO, Duration::from_millis(2));
            while !wanted() {
                assert!(waited < limit, "not {what} within {limit:?} of this machine's time");
                std::thread::sleep(step);
                waited += step;
            }
        };
        let sequencer = || {
            let model = socket.lock().unwrap().clone().expect("plugged in");
            let state = model.lock().unwrap().sequencer(HostTime(0));
            state
        };
        let long = Duration::from_secs(20);
        // The sequencer runs before the set-up has had its last answer, and one that is unplugged before that ends the run.
        until("set up", long, &|| watched.projector() == ProjectorHealth::Up);
        until("running", long, &|| matches!(sequencer(), Sequencer::Running(..)));
        for (order, stays_dark) in [(None, false), (Some(Order::Black), true)] {
            *socket.lock().unwrap() = None;
            // It is looked at five times a second.
            let noticed = || watched.projector() == ProjectorHealth::Lost;
            until("lost", Duration::from_millis(500), &noticed);
            order.into_iter().for_each(|o| watched.give_order(o));
            std::thread::sleep(Duration::from_millis(50));
            // Another one, or the same without power meanwhile: it knows nothing.
            *socket.lock().unwrap() = Some(model());
            let wanted = if stays_dark { ProjectorHealth::Black } else { ProjectorHealth::Up };
            until("taken up again", long, &|| watched.projector() == wanted);
            assert_eq!(matches!(sequencer(), Sequencer::Running(..)), !stays_dark);
            let model = socket.lock().unwrap().clone().expect("plugged in");
            let m = model.lock().unwrap();
            let mut codes = vec![0u32; DMD.raster().pixel_count()];
            unpack(&frames[2], &mut codes);
            // A white plane comes back as the green bits.
            let wanted = codes.iter().map(|c| (c >> 8) as u8);
            assert!(m.projected_grey(2).expect("a pattern").into_iter().eq(wanted), "loaded again");
        }
    });
    let mut open = || {
        let there = plugged.lock().unwrap().clone();
        let not_found = Dlpc900Error::Port { doing: "open".into(), source: PortError::NotFound };
        let hid = VirtualHid::new(there.ok_or(not_found)?);
        Dlpc900::new(Cut { hid, plugged: plugged.clone() })
    };
    let report = present(&mut open, &show, None, &monitor).unwrap();
    observer.join().unwrap();
    assert_eq!(report.came_back, 2);
    let last = plugged.lock().unwrap().clone().expect("plugged in");
    assert_eq!(last.lock().unwrap().dark_because(), Some("mirrors exercised"));
}
