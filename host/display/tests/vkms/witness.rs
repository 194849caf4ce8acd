//! What stands between the product and the kernel's card, and sees both: it passes every call on, reads back by the
//! writeback connector what the CRTC composes of each picture that the card took, and delays or disturbs where a test
//! wants it.

use std::ffi::OsString;
use std::os::fd::OwnedFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use dpm_display::scan_out::{DisplayError, Flip, PictureBuffer, Pixels, ScanOut};
use dpm_display::transport::Opener;

use crate::rig::timing;
use crate::writeback::WritebackReader;

/// A picture that the card took.
#[derive(Clone, Debug)]
pub(crate) struct CardPicture {
    /// The kernel's count of the blank from which on it is scanned out, and its stamp.
    pub(crate) flip: Flip,
    /// Which one.
    pub(crate) picture: PictureBuffer,
    /// What was composed of it: XRGB8888 with zeros in the unused bytes. `None` where the test reads later.
    pub(crate) pixels: Option<Vec<u8>>,
}

/// What the witness does to the next picture that is not the one on the display.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Disturbance {
    /// Passes it on.
    #[default]
    None,
    /// Lets so many blanks pass between the choice of the picture and its way to the kernel.
    Stall(u32),
    /// Gives the kernel something else to do, so that it refuses the picture.
    Occupy,
}

/// What the witness saw.
#[derive(Debug, Default)]
pub(crate) struct Log {
    /// Pictures that the card was given and accepted.
    pub(crate) accepted: usize,
    /// Pictures that it refused because it was busy.
    pub(crate) refused: usize,
    /// Pictures are not read back, which would take a blank each.
    pub(crate) is_blind: bool,
    /// Pictures that it took, oldest first.
    pub(crate) taken: Vec<CardPicture>,
    /// What was composed after each call for black on a way out.
    pub(crate) blackened: Vec<Vec<u8>>,
    /// What is to happen next.
    pub(crate) next: Disturbance,
    front: Option<PictureBuffer>,
}

/// The log, shared with the test.
#[derive(Clone, Default)]
pub(crate) struct WitnessLog(Arc<Mutex<Log>>);

impl WitnessLog {
    pub(crate) fn lock(&self) -> MutexGuard<'_, Log> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The witness.
pub(crate) struct Witness {
    out: Box<dyn ScanOut>,
    pub(crate) reader: WritebackReader,
    log: WitnessLog,
    waiting: Option<PictureBuffer>,
}

impl Witness {
    /// In front of `out`, a card that was started.
    pub(crate) fn new(out: Box<dyn ScanOut>, log: WitnessLog) -> Self {
        let (descriptor, arguments) = out.guarded().expect("a card");
        let at = arguments.iter().position(|a| a == "--crtc").expect("the CRTC is named");
        let crtc = arguments[at + 1].to_string_lossy().parse().expect("by its number");
        Self { out, reader: WritebackReader::attach(descriptor, crtc, timing().size()), log, waiting: None }
    }
}

/// Puts a witness before everything that `opener` opens.
pub(crate) fn witnessed(opener: Opener, log: &WitnessLog) -> Opener {
    let log = log.clone();
    Arc::new(move || {
        let mut shown = opener()?;
        shown.out = Box::new(Witness::new(shown.out, log.clone()));
        Ok(shown)
    })
}

impl ScanOut for Witness {
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        self.out.pixels(frame)
    }

    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError> {
        let is_new = self.log.lock().front != Some(picture);
        let next = if is_new { std::mem::take(&mut self.log.lock().next) } else { Disturbance::None };
        match next {
            Disturbance::None => {}
            Disturbance::Stall(blanks) => {
                self.reader.wait_blanks(blanks);
            }
            Disturbance::Occupy => self.reader.occupy(),
        }
        let result = self.out.flip(picture);
        let mut log = self.log.lock();
        match &result {
            Ok(()) => {
                log.accepted += 1;
                self.waiting = Some(picture);
            }
            Err(DisplayError::Busy) => log.refused += 1,
            Err(_) => {}
        }
        result
    }

    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        let mut flips = Vec::new();
        self.out.flips(&mut |flip| flips.push(flip));
        for flip in flips {
            // Nothing else is on its way, so what is composed now is this picture.
            let is_blind = self.log.lock().is_blind;
            let pixels = (!is_blind).then(|| self.reader.read().expect("the card is there"));
            let picture = self.waiting.take().expect("it was handed over");
            let mut log = self.log.lock();
            log.front = Some(picture);
            log.taken.push(CardPicture { flip, picture, pixels });
            drop(log);
            sink(flip);
        }
    }

    fn lost(&mut self) -> Option<DisplayError> {
        self.out.lost()
    }

    fn now_ns(&self) -> i64 {
        self.out.now_ns()
    }

    fn blacken(&mut self) {
        self.out.blacken();
        if let Ok(pixels) = self.reader.read() {
            self.log.lock().blackened.push(pixels);
        }
    }

    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)> {
        self.out.guarded()
    }
}
