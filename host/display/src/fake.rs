//! A graphics card made of software: vertical blanks in an injected clock, property sets, refusals, unplugging, flips that
//! are missed. It records what every blank scanned out.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use dpm_device::rng::Draws;
use dpm_device::time::HostClock;
use dpm_handoff::path::Lock;

use crate::kms::{Connector, Domain, Kms, Property, PropertyOwner, ScanOutSetup};
use crate::mode::Timing;
use crate::scan_out::{DisplayError, Flip, PictureBuffer, Pixels, ScanOut};

/// One scanned frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScanFrame {
    /// The kernel's count of this blank.
    pub sequence: u32,
    /// When its first pixel was sent, on the rig's clock, nanoseconds.
    pub at_ns: i64,
    /// The pixels, rows without padding, XRGB8888; empty for black.
    pub pixels: Vec<u8>,
}

/// What happens to the card, and what it did. Times are the rig's.
#[derive(Debug)]
pub struct FakeState {
    /// Its connectors.
    pub connectors: Vec<Connector>,
    /// A display is plugged in.
    pub is_plugged: bool,
    /// Blanks, by their count, at which a waiting picture is not taken.
    pub missed: BTreeSet<u32>,
    /// By how much its crystal is fast, parts in a million.
    pub ppm: i64,
    /// By how much stamps are late at most, nanoseconds: an X server on a busy machine.
    pub jitter_ns: i64,
    /// So long after a picture was taken it is told, nanoseconds: a machine that is slow with interrupts.
    pub told_late_ns: i64,
    /// Blanks are not counted.
    pub counts_none: bool,
    /// Blanks stop.
    pub is_stuck: bool,
    /// The start is refused.
    pub refuses: bool,
    /// What was started last.
    pub setup: Option<ScanOutSetup>,
    /// Everything that was scanned out, oldest first.
    pub scanned: Vec<ScanFrame>,
    /// A picture was written to while it was scanned out or waited.
    pub torn: u64,
    /// What is scanned out now is black.
    pub is_black: bool,
    /// Times that it was started.
    pub starts: u32,
}

/// Handles to the state of a fake card, for tests.
pub type Shared = Arc<Lock<FakeState>>;

/// The kernel's clock is so far from the rig's, nanoseconds.
const OFFSET_NS: i64 = 77_000_000_123;
/// The count of the first blank: it wraps soon.
const FIRST: u32 = u32::MAX - 20;
/// Bytes beside the picture in each row.
const PADDING: usize = 64;

/// A card made of software.
pub struct FakeKms {
    shared: Shared,
    clock: Arc<dyn HostClock>,
    buffers: [Vec<u8>; 2],
    pitch: usize,
    timing: Option<Timing>,
    started_ns: i64,
    /// The next blank, counted from the start.
    next: u64,
    front: PictureBuffer,
    waiting: Option<PictureBuffer>,
    taken: Vec<Flip>,
}

/// A display at connector "HDMI-A-1" that offers `modes`, with every property that keeps bits exact.
pub fn display(modes: &[Timing]) -> FakeState {
    let property = |owner, name: &str, domain, value| Property {
        owner,
        name: name.into(),
        domain,
        is_mutable: true,
        value,
    };
    let words =
        |all: &[&str]| Domain::Words(all.iter().zip(0..).map(|(w, n)| ((*w).to_owned(), n)).collect());
    let properties = vec![
        property(PropertyOwner::Connector, "max bpc", Domain::Range(8, 16), 16),
        property(
            PropertyOwner::Connector,
            "Broadcast RGB",
            words(&["Automatic", "Full", "Limited 16:235"]),
            0,
        ),
        property(PropertyOwner::Connector, "dithering mode", words(&["auto", "off", "on"]), 0),
        property(PropertyOwner::Crtc, "GAMMA_LUT", Domain::Blob, 55),
        property(PropertyOwner::Crtc, "VRR_ENABLED", Domain::Range(0, 1), 1),
    ];
    let connector = |name: &str, is_connected| Connector {
        name: name.into(),
        is_virtual: false,
        is_connected,
        modes: if is_connected { modes.to_vec() } else { Vec::new() },
        properties: properties.clone(),
    };
    FakeState {
        connectors: vec![connector("HDMI-A-1", true), connector("DP-1", false)],
        is_plugged: true,
        missed: BTreeSet::new(),
        ppm: 0,
        jitter_ns: 0,
        told_late_ns: 0,
        counts_none: false,
        is_stuck: false,
        refuses: false,
        setup: None,
        scanned: Vec::new(),
        torn: 0,
        is_black: false,
        starts: 0,
    }
}

impl FakeKms {
    /// A card with the state `shared`, on the rig's `clock`.
    pub fn new(shared: Shared, clock: Arc<dyn HostClock>) -> Self {
        Self {
            shared,
            clock,
            buffers: Default::default(),
            pitch: 0,
            timing: None,
            started_ns: 0,
            next: 0,
            front: PictureBuffer::Black,
            waiting: None,
            taken: Vec::new(),
        }
    }

    fn with<R>(&self, look: impl FnOnce(&mut FakeState) -> R) -> R {
        look(&mut self.shared.lock().expect("no test panics while it looks"))
    }

    /// When blank `k` after the start begins.
    fn blank_ns(&self, k: u64, ppm: i64) -> i64 {
        let rate = self.timing.and_then(|t| t.rate()).expect("started");
        let exact = i128::from(k) * 1_000_000_000 * i128::from(rate.den()) / i128::from(rate.num());
        self.started_ns + (exact - exact * i128::from(ppm) / 1_000_000) as i64
    }

    /// Scans out everything up to now.
    fn scan(&mut self) {
        let now = self.clock.now().0;
        let Some(timing) = self.timing else { return };
        let (ppm, is_stuck, is_plugged) = self.with(|s| (s.ppm, s.is_stuck, s.is_plugged));
        if is_stuck || !is_plugged {
            return;
        }
        while self.blank_ns(self.next, ppm) <= now {
            let at_ns = self.blank_ns(self.next, ppm);
            let (missed, counts_none, jitter_ns) = self.with(|s| {
                (s.missed.contains(&FIRST.wrapping_add(self.next as u32)), s.counts_none, s.jitter_ns)
            });
            let late_ns = (Draws::new(1).unit(self.next) * jitter_ns as f64) as i64;
            let sequence = if counts_none { 0 } else { FIRST.wrapping_add(self.next as u32) };
            if let Some(picture) = self.waiting.take_if(|_| !missed) {
                self.front = picture;
                self.taken.push(Flip { sequence, at_ns: at_ns + late_ns + OFFSET_NS });
            }
            let width = 4 * timing.size().0 as usize;
            let pixels = match self.front {
                PictureBuffer::Black => Vec::new(),
                PictureBuffer::Frame(frame) => {
                    let rows = self.buffers[frame].chunks_exact(self.pitch);
                    rows.flat_map(|row| row[..width].iter().copied()).collect()
                }
            };
            let is_black = pixels.iter().all(|b| *b == 0);
            self.with(|s| {
                s.is_black = is_black;
                s.scanned.push(ScanFrame { sequence, at_ns, pixels });
            });
            self.next += 1;
        }
    }
}

impl Kms for FakeKms {
    fn name(&self) -> String {
        "fake card".into()
    }

    fn connectors(&mut self) -> Result<Vec<Connector>, DisplayError> {
        Ok(self.with(|s| {
            let mut all = s.connectors.clone();
            if !s.is_plugged {
                for c in &mut all {
                    c.is_connected = false;
                    c.modes.clear();
                }
            }
            all
        }))
    }

    fn start(&mut self, setup: &ScanOutSetup) -> Result<(), DisplayError> {
        if self.with(|s| !s.is_plugged) {
            return Err(DisplayError::Gone);
        }
        if self.with(|s| s.refuses) {
            let source = std::io::Error::from_raw_os_error(libc::EINVAL);
            return Err(DisplayError::Call { doing: "set the mode", source });
        }
        let (width, height) = setup.timing.size();
        self.pitch = 4 * width as usize + PADDING;
        self.buffers = [0, 1].map(|_| vec![0; self.pitch * height as usize]);
        (self.timing, self.started_ns, self.next) = (Some(setup.timing), self.clock.now().0, 0);
        (self.front, self.waiting) = (PictureBuffer::Black, None);
        self.taken.clear();
        self.with(|s| {
            s.setup = Some(setup.clone());
            s.is_black = true;
            s.starts += 1;
        });
        Ok(())
    }
}

impl ScanOut for FakeKms {
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        self.scan();
        if [Some(self.front), self.waiting].contains(&Some(PictureBuffer::Frame(frame))) {
            self.with(|s| s.torn += 1);
        }
        Pixels { bytes: &mut self.buffers[frame], pitch: self.pitch }
    }

    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError> {
        self.scan();
        if self.with(|s| !s.is_plugged) {
            return Err(DisplayError::Gone);
        }
        // The kernel is busy until its event was made, not until it was read.
        if self.waiting.is_some() {
            return Err(DisplayError::Busy);
        }
        self.waiting = Some(picture);
        Ok(())
    }

    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        self.scan();
        let told_until = self.now_ns() - self.with(|s| s.told_late_ns);
        let told = self.taken.iter().take_while(|flip| flip.at_ns <= told_until).count();
        self.taken.drain(..told).for_each(sink);
    }

    fn lost(&mut self) -> Option<DisplayError> {
        self.with(|s| (!s.is_plugged).then_some(DisplayError::Gone))
    }

    fn now_ns(&self) -> i64 {
        self.clock.now().0 + OFFSET_NS
    }

    fn blacken(&mut self) {
        self.scan();
        (self.front, self.waiting) = (PictureBuffer::Black, None);
        self.with(|s| s.is_black = true);
    }

    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)> {
        None
    }
}
