//! A DLPC900 behind the display: it cuts each frame that the display sends into patterns, and shows them while the next
//! frame arrives.
//!
//! The display shows black before the controller is set up, and the controller rests before the display is given back.
//! In between, a thread of its own asks the controller for its state: the frame path never speaks to it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dpm_device::transport::TransportError;
use dpm_dlpc900::driver::{Dlpc900, Dlpc900Error, HidPort, StopAsked};
use dpm_dlpc900::video::VideoPatterns;

use dpm_display::scan_out::{DisplayError, Flip, PictureBuffer, Pixels, ScanOut};
use dpm_display::transport::Opener;

/// How often the controller is asked for its state.
const LOOK: Duration = Duration::from_millis(200);
/// How often its thread looks for the end.
const STEP: Duration = Duration::from_millis(5);
/// How long the end waits for the controller to rest.
const REST_WITHIN: Duration = Duration::from_millis(400);
/// Answers in a row that may be missing or make no sense: another program may ask the controller too.
const MOST_SILENT: u32 = 4;

/// Whoever opens the controller.
pub type OpenController<P> = Arc<dyn Fn() -> Result<Dlpc900<P>, Dlpc900Error> + Send + Sync>;

/// The opener of a display by `display` with the controller that `controller` opens behind it, set up to show `video`. A set-up
/// takes seconds; it ends in the dark within 20 ms once `stop` is true.
pub fn behind<P: HidPort + Send + 'static>(
    display: Opener,
    controller: OpenController<P>,
    video: VideoPatterns,
    stop: StopAsked,
) -> Opener {
    Arc::new(move || {
        // Black is on the wire before the controller looks at it.
        let mut shown = display()?;
        let failed = |e: Dlpc900Error| match e.is_gone() {
            true => TransportError::Unplugged { device: "DLPC900".into() },
            false => TransportError::Unsuitable { device: "DLPC900".into(), why: e.to_string() },
        };
        let mut controller = controller().map_err(failed)?;
        let found = controller.dmd();
        if found != video.dmd {
            let why = format!(
                "projector.backend.dlpc900.panel is a {}, the controller drives a {}",
                video.dmd.name(),
                found.name()
            );
            return Err(TransportError::Unsuitable { device: "DLPC900".into(), why });
        }
        controller.stop_when(stop.clone());
        if let Err(e) = controller.make_ready().and_then(|_| controller.start_video_patterns(&video)) {
            rest(&mut controller);
            return Err(failed(e));
        }
        shown.name = format!("{} behind {}", found.name(), shown.name);
        shown.out = Box::new(ControllerFeed {
            out: shown.out,
            watch: ControllerWatch::start(controller).map_err(no_thread)?,
        });
        Ok(shown)
    })
}

fn no_thread(e: std::io::Error) -> TransportError {
    let why = format!("cannot start the thread that watches the controller: {e}");
    TransportError::Unsuitable { device: "DLPC900".into(), why }
}

/// Stops the sequence, switches the LEDs off and exercises the mirrors. A controller that cannot be told is the guard
/// process's.
fn rest<P: HidPort>(controller: &mut Dlpc900<P>) {
    let _ = controller.stop_at_the_end().and_then(|()| controller.idle());
}

/// The thread that asks the controller for its state, and puts it to rest at the end.
struct ControllerWatch {
    is_over: Arc<AtomicBool>,
    /// Why the controller shows nothing any more; `None` inside for a controller that is gone.
    lost: Arc<OnceLock<Option<String>>>,
    thread: Option<JoinHandle<()>>,
}

impl ControllerWatch {
    fn start<P: HidPort + Send + 'static>(mut controller: Dlpc900<P>) -> std::io::Result<Self> {
        let (is_over, lost) = (Arc::new(AtomicBool::new(false)), Arc::new(OnceLock::new()));
        let (over, why) = (is_over.clone(), lost.clone());
        let thread = std::thread::Builder::new().name("dpm-dlpc900".into()).spawn(move || {
            if let Some(loss) = look_until(&mut controller, &over) {
                let _ = why.set(loss);
            }
            rest(&mut controller);
        })?;
        Ok(Self { is_over, lost, thread: Some(thread) })
    }

    /// Why the controller shows nothing any more.
    fn lost(&self) -> Option<DisplayError> {
        self.lost.get().map(|why| match why {
            None => DisplayError::Gone,
            Some(what) => DisplayError::Unsuitable { card: "DLPC900".into(), what: what.clone() },
        })
    }
}

impl Drop for ControllerWatch {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Release);
        let Some(thread) = self.thread.take() else { return };
        let limit = Instant::now() + REST_WITHIN;
        while !thread.is_finished() && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(1));
        }
        // A thread that hangs in a call is left behind; the guardian of the run puts the controller to rest then.
        if thread.is_finished() {
            let _ = thread.join();
        }
    }
}

/// Asks the controller for its state until `over`, or until it shows nothing any more: why.
fn look_until<P: HidPort>(controller: &mut Dlpc900<P>, over: &AtomicBool) -> Option<Option<String>> {
    let (mut looked, mut silent) = (Instant::now(), 0);
    while !over.load(Ordering::Acquire) {
        std::thread::sleep(STEP);
        if looked.elapsed() < LOOK {
            continue;
        }
        looked = Instant::now();
        silent = match controller.status() {
            Ok(status) => match status.complaint() {
                Some(what) => return Some(Some(format!("the controller reports {what}"))),
                None if !status.is_locked() => {
                    return Some(Some("the controller receives no video signal".into()))
                }
                None if !status.is_running() => {
                    return Some(Some("its patterns were stopped, perhaps by another program".into()))
                }
                None => 0,
            },
            // The run ends.
            Err(Dlpc900Error::Stopped) => return None,
            Err(e) if e.is_gone() => return Some(None),
            Err(e) if silent == MOST_SILENT => return Some(Some(e.to_string())),
            Err(_) => silent + 1,
        };
    }
    None
}

/// A display in front of a controller.
struct ControllerFeed {
    // Dropped first: the controller rests while the display still shows black.
    watch: ControllerWatch,
    out: Box<dyn ScanOut>,
}

impl ScanOut for ControllerFeed {
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        self.out.pixels(frame)
    }
    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError> {
        self.out.flip(picture)
    }
    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        self.out.flips(sink);
    }
    fn lost(&mut self) -> Option<DisplayError> {
        self.out.lost().or_else(|| self.watch.lost())
    }
    fn now_ns(&self) -> i64 {
        self.out.now_ns()
    }
    fn blacken(&mut self) {
        self.out.blacken();
    }
    fn guarded(&self) -> Option<(std::os::fd::OwnedFd, Vec<std::ffi::OsString>)> {
        self.out.guarded()
    }
}
