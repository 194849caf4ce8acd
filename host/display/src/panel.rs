//! The firmware of a bit-plane projector with a display as its panel: what a slot of the link shows is handed to the
//! kernel so much before each vertical blank, and the kernel's stamps say when it was really shown.
//!
//! There is one picture for every blank: the frame that the firmware lights, or black. Nothing else is ever shown. The
//! state machine has no thread and no clock of its own; [`crate::transport`] gives it both.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::Arc;

use dpm_device::planes::Raster;
use dpm_device::projector::{FirmwareConfig, ProjectorFirmware};
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::transport::{Lane, LinkDevice};
use dpm_handoff::path::Lock;

use crate::encoding::PixelMap;
use crate::pacer::{NoPace, Pacer, LEARNED, MOST_LEARNED};
use crate::scan_out::{DisplayError, Flip, PictureBuffer, ScanOut};

/// A picture that was not taken for this long means that the display gives no blanks any more, nanoseconds.
const LOST_AFTER_NS: i64 = 500_000_000;
/// Interval at which a blank that is due is looked for, nanoseconds.
const LOOK_NS: i64 = 200_000;
/// Interval at which the connector is looked at, nanoseconds.
const CONNECTOR_NS: i64 = 250_000_000;
/// Stamps that one look passes on.
const FLIPS: usize = 8;
/// Whole frames that can wait.
const FRAME_BUFFERS: u8 = 4;

/// What a display did, for reports. All counts are since the scan-out started.
#[derive(Debug, Default)]
pub struct DisplayCounts {
    /// Pictures that the display took.
    pub taken: AtomicU64,
    /// Blanks by which pictures came late: each is one frame shown one slot later.
    pub missed: AtomicU64,
    /// True from the moment at which slots follow the blanks.
    pub is_paced: AtomicBool,
    /// Why scan-out ended; empty while it runs.
    lost: Lock<String>,
}

impl DisplayCounts {
    /// Why scan-out ended; `None` while it runs.
    pub fn lost(&self) -> Option<String> {
        self.lost.lock().ok().map(|text| text.clone()).filter(|text| !text.is_empty())
    }
}

/// A picture on its way.
#[derive(Clone, Copy, Debug)]
struct InFlight {
    picture: PictureBuffer,
    /// The blank from which on it should be shown; `None` while the blanks are learned.
    for_blank: Option<u64>,
    since: HostTime,
}

/// What a panel has to know of its display and its link.
#[derive(Clone, Copy, Debug)]
pub struct PanelSettings {
    /// Mirrors, which are pixels here.
    pub raster: Raster,
    /// Planes of a frame.
    pub planes: usize,
    /// Where the planes go in a pixel.
    pub map: PixelMap,
    /// Vertical blanks a second.
    pub rate: FrameRate,
    /// From the choice of a frame to its first pixel, nanoseconds.
    pub lead_ns: i64,
}

/// A projector whose panel is a display.
pub struct DisplayPanel<S: ScanOut> {
    out: S,
    firmware: ProjectorFirmware,
    map: PixelMap,
    raster: Raster,
    rate: FrameRate,
    lead_ns: i64,
    /// What is added to the time of the display's stamps to get the rig's.
    offset_ns: i64,
    /// `None` while the blanks are learned.
    pacer: Option<Pacer>,
    learned: Vec<(u32, HostTime)>,
    /// The next slot whose picture is to be chosen.
    next: u64,
    in_flight: Option<InFlight>,
    /// The kernel did not take the picture of the newest slot.
    is_refused: bool,
    /// What is scanned out.
    front: PictureBuffer,
    /// Which frame of the firmware each of the two pictures holds.
    holds: [Option<u64>; 2],
    look_at: HostTime,
    connector_at: HostTime,
    counts: Arc<DisplayCounts>,
    is_lost: bool,
}

impl<S: ScanOut> DisplayPanel<S> {
    /// The panel in front of `out`, which shows black. `clock` is the rig's. It allocates everything here.
    pub fn new(out: S, settings: PanelSettings, serial: u64, clock: &dyn HostClock) -> Self {
        let PanelSettings { raster, planes, map, rate, lead_ns } = settings;
        // The two clocks run alike. Of some readings, the closest pair tells how far they are apart.
        let pairs = (0..8).map(|_| {
            let before = clock.now();
            let own = out.now_ns();
            (clock.now().ns_since(before), before.0 - own)
        });
        let (width, low) = pairs.min().unwrap_or((0, 0));
        let now = clock.now();
        let config = FirmwareConfig {
            max_planes: planes as u8,
            frame_buffers: FRAME_BUFFERS,
            // The kernel's minimum lies far below every display's frame: the rate was checked against the mode.
            min_plane_ns: 1,
            serial,
            events_kept: 0,
            shown_kept: 0,
            ..FirmwareConfig::new(raster)
        };
        Self {
            out,
            firmware: ProjectorFirmware::new(config),
            map,
            raster,
            rate,
            lead_ns,
            offset_ns: low + width / 2,
            pacer: None,
            learned: Vec::with_capacity(MOST_LEARNED),
            next: 0,
            in_flight: None,
            is_refused: false,
            front: PictureBuffer::Black,
            holds: [None; 2],
            look_at: now,
            connector_at: now,
            counts: Arc::default(),
            is_lost: false,
        }
    }

    /// What the display did.
    pub fn counts(&self) -> Arc<DisplayCounts> {
        self.counts.clone()
    }

    /// The firmware.
    pub fn firmware(&self) -> &ProjectorFirmware {
        &self.firmware
    }

    /// What shows the pictures.
    pub fn out(&mut self) -> &mut S {
        &mut self.out
    }

    /// The clock that follows the blanks; `None` while they are learned.
    pub fn pacer(&self) -> Option<&Pacer> {
        self.pacer.as_ref()
    }

    /// True if the display is gone, or does not run as its mode says. Nothing more is shown; only a new start helps.
    pub fn is_lost(&self) -> bool {
        self.is_lost
    }

    /// When it must be called again at the latest.
    pub fn next_due(&self) -> HostTime {
        let mut due = self.connector_at;
        if self.in_flight.is_some() || self.pacer.is_none() {
            due = due.min(self.look_at);
        }
        if let Some(pacer) = &self.pacer {
            due = due.min(pacer.slot_at(self.next));
            due = self.firmware.next_due().map_or(due, |own| due.min(own));
        }
        due
    }

    /// Does everything that is due at `now`: reads what the display has taken, chooses the pictures of the slots that have
    /// begun, and hands the newest to the kernel. Bounded, and allocates nothing.
    pub fn advance(&mut self, now: HostTime) {
        if self.is_lost {
            return;
        }
        self.look_at_connector(now);
        let stamp = if self.in_flight.is_some() { self.take_flips(now) } else { None };
        if self.is_lost {
            return;
        }
        if self.pacer.is_none() {
            return self.learn(now);
        }
        self.choose(now);
        self.firmware.advance_to(now);
        if let (Some(flip), Some(pacer)) = (stamp, &mut self.pacer) {
            pacer.follow(now, flip.sequence, HostTime(flip.at_ns + self.offset_ns));
            self.firmware.discipline(now, pacer.clock());
        }
    }

    fn lose(&mut self, why: String) {
        self.is_lost = true;
        if let Ok(mut lost) = self.counts.lost.lock() {
            *lost = why;
        }
        self.out.blacken();
    }

    fn look_at_connector(&mut self, now: HostTime) {
        if now >= self.connector_at {
            self.connector_at = now.plus_ns(CONNECTOR_NS);
            if let Some(why) = self.out.lost() {
                self.lose(why.to_string());
            }
        }
    }

    /// Reads which pictures were taken. Returns the newest stamp.
    fn take_flips(&mut self, now: HostTime) -> Option<Flip> {
        let mut flips = [Flip { sequence: 0, at_ns: 0 }; FLIPS];
        let mut n = 0;
        self.out.flips(&mut |flip| {
            if n < FLIPS {
                flips[n] = flip;
                n += 1;
            }
        });
        for flip in &flips[..n] {
            self.taken(*flip);
        }
        if let Some(flight) = &self.in_flight {
            self.look_at = now.plus_ns(LOOK_NS);
            if let (Some(pacer), Some(blank)) = (&self.pacer, flight.for_blank) {
                self.look_at = self.look_at.max(pacer.blank_at(blank).plus_ns(LOOK_NS / 4));
            }
            if now.ns_since(flight.since) > LOST_AFTER_NS {
                self.lose("the display has given no vertical blank for half a second".into());
            }
        }
        n.checked_sub(1).map(|newest| flips[newest])
    }

    /// The picture on its way was taken.
    fn taken(&mut self, flip: Flip) {
        let Some(flight) = self.in_flight else { return };
        if let (Some(pacer), Some(expected)) = (&self.pacer, flight.for_blank) {
            let blank = pacer.number(flip.sequence);
            // Slots up to this blank began while the display was busy, whatever this thread did meanwhile.
            while self.next <= blank {
                self.firmware.panel_busy(true);
                self.firmware.advance_to(pacer.slot_at(self.next));
                self.next += 1;
            }
            // A stamp that is told late comes after slots for whose blanks nothing could be handed over.
            let newest = blank.max(self.next - 1);
            self.counts.missed.fetch_add(newest.saturating_sub(expected), Ordering::Relaxed);
        } else {
            self.learned.push((flip.sequence, HostTime(flip.at_ns + self.offset_ns)));
        }
        self.counts.taken.fetch_add(1, Ordering::Relaxed);
        self.front = flight.picture;
        self.in_flight = None;
        self.firmware.panel_busy(false);
    }

    /// Shows black until the phase of the blanks is known.
    fn learn(&mut self, now: HostTime) {
        if self.in_flight.is_some() {
            return;
        }
        if self.learned.len() >= LEARNED {
            match Pacer::learn(self.rate, self.lead_ns, &self.learned) {
                Ok(pacer) => {
                    self.firmware.discipline(now, pacer.clock());
                    // The newest stamp is blank 0.
                    self.next = 1;
                    self.pacer = Some(pacer);
                    self.counts.is_paced.store(true, Ordering::Release);
                    return;
                }
                Err(NoPace::OtherRate { .. }) if self.learned.len() < MOST_LEARNED => {}
                Err(e) => return self.lose(e.to_string()),
            }
        }
        self.hand_over(now, PictureBuffer::Black, None);
    }

    /// Chooses the pictures of all slots that have begun. Only that of the newest can still be shown.
    fn choose(&mut self, now: HostTime) {
        while let Some(pacer) = &self.pacer {
            let at = pacer.slot_at(self.next);
            if self.is_lost || at > now {
                break;
            }
            let is_newest = pacer.slot_at(self.next + 1) > now;
            let is_free = is_newest && self.in_flight.is_none();
            let was_refused = self.is_refused;
            self.firmware.panel_busy(!is_free || was_refused);
            self.firmware.advance_to(at);
            if is_free {
                self.is_refused = false;
                let picture = self.picture();
                self.hand_over(now, picture, Some(self.next));
            } else if self.in_flight.is_none() {
                // This thread was too late for the slot: it shows what the one before showed.
                self.counts.missed.fetch_add(1, Ordering::Relaxed);
            }
            self.next += 1;
        }
    }

    /// The picture that the firmware lights now, written if it is not there yet.
    fn picture(&mut self) -> PictureBuffer {
        let Some(frame) = self.firmware.lit_generation() else { return PictureBuffer::Black };
        if let Some(there) = self.holds.iter().position(|held| *held == Some(frame)) {
            return PictureBuffer::Frame(there);
        }
        let back = usize::from(self.front == PictureBuffer::Frame(0));
        let Some(planes) = self.firmware.lit_planes() else { return PictureBuffer::Black };
        let pixels = self.out.pixels(back);
        self.map.write(self.raster, planes, pixels.bytes, pixels.pitch);
        self.holds[back] = Some(frame);
        PictureBuffer::Frame(back)
    }

    fn hand_over(&mut self, now: HostTime, picture: PictureBuffer, for_blank: Option<u64>) {
        match self.out.flip(picture) {
            Ok(()) => {
                self.in_flight = Some(InFlight { picture, for_blank, since: now });
                self.firmware.panel_busy(true);
                self.look_at = match (&self.pacer, for_blank) {
                    (Some(pacer), Some(blank)) => pacer.blank_at(blank).plus_ns(LOOK_NS / 4),
                    _ => now.plus_ns(LOOK_NS),
                };
            }
            // The kernel is busy with something else than a picture of ours. The next slot tries again.
            Err(DisplayError::Busy) => {
                self.firmware.panel_busy(true);
                self.is_refused = true;
                self.look_at = now.plus_ns(LOOK_NS);
                if for_blank.is_some() {
                    self.counts.missed.fetch_add(1, Ordering::Relaxed);
                }
            }
            Err(e) => self.lose(e.to_string()),
        }
    }
}

impl<S: ScanOut> LinkDevice for DisplayPanel<S> {
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]) {
        self.advance(now);
        if self.pacer.is_some() && !self.is_lost {
            self.firmware.receive(now, lane, bytes);
        }
    }

    fn end_of_transfer(&mut self, now: HostTime, lane: Lane) {
        self.advance(now);
        if self.pacer.is_some() && !self.is_lost {
            self.firmware.end_of_transfer(now, lane);
        }
    }

    fn advance_to(&mut self, now: HostTime) {
        self.advance(now);
    }

    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) {
        self.advance(now);
        if self.pacer.is_some() && !self.is_lost {
            self.firmware.replies(now, sink);
        }
    }
}

/// Black on every way out of the thread, a panic's too.
impl<S: ScanOut> Drop for DisplayPanel<S> {
    fn drop(&mut self) {
        self.out.blacken();
        if let Ok(mut lost) = self.counts.lost.lock() {
            if lost.is_empty() {
                *lost = "scan-out has ended".into();
            }
        }
    }
}
