//! A bit-plane projector whose firmware runs in this process and whose panel is an ALP.
//!
//! The firmware ([`ProjectorFirmware`]) keeps the link's contract: sessions, slots, watchdog, ends of light. This adapter writes each whole
//! frame into the ALP's memory while it waits for its slot, plane by plane, and shows it when the slot begins. A frame that is not written
//! by then is lit in a later slot, and the firmware tells so. Light ends when the firmware says so, and by itself when this process dies:
//! every sequence is finite.

use super::driver::{Alp, ShowMode, Temperatures};
use super::error::AlpError;
use dpm_device::light::LightKind;
use dpm_device::link::faults;
use dpm_device::planes::PlaneSchedule;
use dpm_device::projector::{FirmwareConfig, ProjectorFirmware, Served};
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::transport::{Lane, LinkDevice};

/// Time between two looks at the temperatures.
const LOOK_EVERY_NS: i64 = 2_000_000_000;
/// How much cooler than its limit the device must be before light may return, degrees Celsius.
const HYSTERESIS: f64 = 5.0;
/// Frames of the ALP's memory beyond those that wait: one is shown, one is in the queue, one is being written.
pub const MEMORY_SPARE: usize = 3;
/// Slots of which the light is kept for this adapter between two steps.
const EVENTS_KEPT: usize = 64;

/// What the adapter has done.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AlpCounts {
    /// Frames that were written and shown.
    pub frames: u64,
    /// Slots in which a frame was shown once more.
    pub repeats: u64,
    /// Slots whose frame was shown later than half a slot after the slot had begun, and was left out for that.
    pub skipped: u64,
    /// Longest time from the start of a slot to the order that shows its frame, nanoseconds.
    pub latest_ns: i64,
    /// Sum of the times from the start of a slot to the end of that order, nanoseconds.
    pub delay_sum_ns: i64,
}

/// One frame of the ALP's memory.
#[derive(Clone, Copy, Debug, Default)]
struct Memory {
    /// Number of the frame in it.
    frame: Option<u32>,
    /// Planes of it that are written.
    written: usize,
}

/// The link's device in front of an ALP.
#[derive(Debug)]
pub struct AlpProjector {
    firmware: ProjectorFirmware,
    alp: Alp,
    /// How frames are shown; order and rate are those of the session.
    showing: ShowMode,
    /// The session that the memory was prepared for.
    prepared: Option<(u32, PlaneSchedule, FrameRate)>,
    memory: Vec<Memory>,
    /// Number of the frame that is shown.
    lit: Option<u32>,
    /// The newest frame was not shown in its slot: the next slot shows it.
    owed: bool,
    max_celsius: Option<f64>,
    temperatures: Temperatures,
    look_at: HostTime,
    /// All frames of the memory are in use: asked again then.
    retry_at: Option<HostTime>,
    counts: AlpCounts,
    error: Option<AlpError>,
}

impl AlpProjector {
    /// A projector on `alp`, dark. `showing.frames` frames may be in the device's memory, at least [`MEMORY_SPARE`] + 1. Above
    /// `max_celsius` it goes dark and latches; above what the device itself recommends, if that is left out.
    ///
    /// # Errors
    /// What panel, memory or queue cannot do.
    pub fn new(
        alp: Alp,
        showing: ShowMode,
        max_celsius: Option<f64>,
        power_on_at: HostTime,
    ) -> Result<Self, AlpError> {
        alp.check(&showing)?;
        let facts = alp.facts();
        let mut setup = FirmwareConfig::new(facts.raster);
        setup.max_planes = showing.schedule.len() as u8;
        setup.frame_buffers = showing.frames.saturating_sub(MEMORY_SPARE).clamp(1, 64) as u8;
        setup.min_plane_ns = alp.shortest_share_ns(&showing);
        setup.serial = facts.serial as u64;
        setup.firmware = facts.version as u16;
        setup.clock.power_on_at = power_on_at;
        setup.events_kept = EVENTS_KEPT;
        let memory = vec![Memory::default(); showing.frames];
        Ok(Self {
            firmware: ProjectorFirmware::new(setup),
            alp,
            showing,
            prepared: None,
            memory,
            lit: None,
            owed: false,
            max_celsius,
            temperatures: Temperatures::default(),
            look_at: HostTime(i64::MIN),
            retry_at: None,
            counts: AlpCounts::default(),
            error: None,
        })
    }

    /// Why it works no longer. The device is dark or gone, and must be opened anew.
    pub fn error(&self) -> Option<&AlpError> {
        self.error.as_ref()
    }

    /// What it has done.
    pub fn counts(&self) -> AlpCounts {
        self.counts
    }

    /// The temperatures when they were last looked at.
    pub fn temperatures(&self) -> Temperatures {
        self.temperatures
    }

    /// The firmware.
    pub fn firmware(&self) -> &ProjectorFirmware {
        &self.firmware
    }

    /// The device.
    pub fn alp(&self) -> &Alp {
        &self.alp
    }

    /// Does what is due at `now`. Bounded: at most one plane is written.
    fn step(&mut self, now: HostTime) {
        if self.error.is_some() {
            return;
        }
        let done = self.work(now);
        if let Err(error) = done {
            // Opening it again is the only way to a known state; until then nothing is shown.
            let _ = self.alp.darken();
            self.error = Some(error);
        }
    }

    fn work(&mut self, now: HostTime) -> Result<(), AlpError> {
        self.firmware.advance_to(now);
        self.adopt()?;
        let shown = self.follow(now)?;
        self.look(now);
        if !shown {
            self.write_ahead(now)?;
        }
        let next = self.firmware.next_frame();
        let is_open = next.is_some_and(|frame| !self.is_written(frame));
        self.firmware.panel_busy(is_open || self.owed);
        Ok(())
    }

    /// Prepares the memory for a new session or configuration.
    fn adopt(&mut self) -> Result<(), AlpError> {
        let configured = self.firmware.configured();
        if configured == self.prepared {
            return Ok(());
        }
        let before = std::mem::replace(&mut self.prepared, configured);
        self.memory.fill(Memory::default());
        let Some((_, schedule, rate)) = configured else { return Ok(()) };
        if before.is_some_and(|(_, s, r)| (s, r) == (schedule, rate)) && self.alp.frames() > 0 {
            return Ok(());
        }
        self.showing = ShowMode { schedule, rate, ..self.showing };
        self.alp.prepare(&self.showing)
    }

    /// Shows what the firmware lights, and ends what it ends. True if a frame was shown.
    fn follow(&mut self, now: HostTime) -> Result<bool, AlpError> {
        let mut last = None;
        while let Some(event) = self.firmware.next_light() {
            last = Some(event);
        }
        if !self.firmware.is_lit() {
            self.owed = false;
            if self.lit.take().is_some() {
                self.alp.darken()?;
            }
            return Ok(false);
        }
        let Some(event) = last.filter(|event| event.kind != LightKind::Blank) else { return Ok(false) };
        let Some(frame) = event.frame else { return Ok(false) };
        let slot_ns = self.showing.rate.slot_len_ns(0);
        let late_ns = now.ns_since(event.first_photon_at);
        self.counts.latest_ns = self.counts.latest_ns.max(late_ns);
        if late_ns > slot_ns / 2 {
            // Its light would reach far into the next slot. What is shown ends by itself.
            self.counts.skipped += 1;
            self.owed = event.kind == LightKind::Lit;
            return Ok(false);
        }
        // A frame that the firmware has not waited for: the planes of one that is held by order are gone from the memory.
        let Some(at) = self.memory_of(frame) else { return self.write_lit(frame).map(|()| false) };
        self.alp.show(at)?;
        let is_new = self.lit != Some(frame) && event.kind == LightKind::Lit;
        self.counts.frames += u64::from(is_new);
        self.counts.repeats += u64::from(!is_new);
        self.counts.delay_sum_ns += late_ns;
        (self.lit, self.owed) = (Some(frame), false);
        self.firmware.panel_busy(false);
        Ok(true)
    }

    /// Where the planes of `frame` are, all of them.
    fn memory_of(&self, frame: u32) -> Option<usize> {
        let planes = self.showing.schedule.len();
        self.memory.iter().position(|memory| memory.frame == Some(frame) && memory.written == planes)
    }

    fn is_written(&self, frame: u32) -> bool {
        self.memory_of(frame).is_some()
    }

    /// Writes the next plane of the first waiting frame that is not whole in the memory.
    fn write_ahead(&mut self, now: HostTime) -> Result<(), AlpError> {
        if self.retry_at.is_some_and(|at| now < at) {
            return Ok(());
        }
        self.retry_at = None;
        let open = self.firmware.waiting_frames().map(|waiting| waiting.frame).find(|f| !self.is_written(*f));
        let Some(frame) = open else { return Ok(()) };
        let begun = self.memory.iter().position(|memory| memory.frame == Some(frame));
        let at = match begun {
            Some(at) => at,
            None => {
                self.alp.progress()?;
                let Some(at) = self.free_memory() else {
                    self.retry_at = Some(now.plus_ns(self.showing.rate.slot_len_ns(0) / 8));
                    return Ok(());
                };
                self.memory[at] = Memory { frame: Some(frame), written: 0 };
                at
            }
        };
        let bytes = self.firmware.raster().plane_bytes();
        let plane = self.memory[at].written;
        let Some(waiting) = self.firmware.waiting_frames().find(|w| w.frame == frame) else { return Ok(()) };
        self.alp.put(at, plane, &waiting.planes[plane * bytes..(plane + 1) * bytes])?;
        self.memory[at].written += 1;
        Ok(())
    }

    /// Writes the frame on the mirrors again, for a later slot.
    fn write_lit(&mut self, frame: u32) -> Result<(), AlpError> {
        self.alp.progress()?;
        let Some(at) = self.free_memory() else { return Ok(()) };
        let bytes = self.firmware.raster().plane_bytes();
        let Some(planes) = self.firmware.lit_planes() else { return Ok(()) };
        for (plane, content) in planes.chunks_exact(bytes).enumerate() {
            self.alp.put(at, plane, content)?;
        }
        self.memory[at] = Memory { frame: Some(frame), written: self.showing.schedule.len() };
        Ok(())
    }

    /// A frame of the memory that is neither shown nor waits for its slot.
    fn free_memory(&self) -> Option<usize> {
        let is_needed = |frame: u32| {
            self.lit == Some(frame)
                || self.firmware.lit_frame() == Some(frame)
                || self.firmware.waiting_frames().any(|waiting| waiting.frame == frame)
        };
        let is_free = |at: &usize| !self.memory[*at].frame.is_some_and(is_needed) && !self.alp.is_busy(*at);
        (0..self.memory.len()).find(is_free)
    }

    /// Looks at the temperatures now and then. Too hot is a fault of the projector, which the operator must acknowledge.
    fn look(&mut self, now: HostTime) {
        if now < self.look_at {
            return;
        }
        self.look_at = now.plus_ns(LOOK_EVERY_NS);
        self.temperatures = self.alp.temperatures();
        let recommended = self.alp.facts().hottest;
        let Some(excess) = self.temperatures.excess(&recommended, self.max_celsius) else { return };
        if excess > 0.0 {
            self.firmware.set_faults(now, faults::OVER_TEMPERATURE);
        } else if excess < -HYSTERESIS {
            self.firmware.set_faults(now, 0);
        }
    }

    /// A plane waits to be written, and there is room for it.
    fn has_work(&self) -> bool {
        self.retry_at.is_none()
            && self.firmware.waiting_frames().any(|waiting| !self.is_written(waiting.frame))
    }
}

impl LinkDevice for AlpProjector {
    fn receive(&mut self, now: HostTime, lane: Lane, bytes: &[u8]) {
        self.firmware.receive(now, lane, bytes);
        self.step(now);
    }

    fn end_of_transfer(&mut self, now: HostTime, lane: Lane) {
        self.firmware.end_of_transfer(now, lane);
        self.step(now);
    }

    fn advance_to(&mut self, now: HostTime) {
        self.step(now);
    }

    fn replies(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) {
        self.step(now);
        self.firmware.replies(now, sink);
    }
}

impl Served for AlpProjector {
    fn next_due(&self) -> Option<HostTime> {
        if self.error.is_some() || self.has_work() {
            // At once.
            return Some(HostTime(i64::MIN));
        }
        let own = self.retry_at.map_or(self.look_at, |at| at.min(self.look_at));
        Some(self.firmware.next_due().map_or(own, |due| due.min(own)))
    }
}
