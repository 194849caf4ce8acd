//! A software DLPC900: HID reports in, replies and light out, without I/O.
//!
//! [`Dlpc900Model`] is a [`UsbDeviceModel`], so it can be plugged into libusb in-process or served over USB/IP. It has
//! the controller's one-slot reply buffer, order rules, error codes, pattern table and image memory. It decodes uploads
//! and reports what it would project. Deviations from the guide that programs in the field make without harm are
//! accepted and noted in [`Dlpc900Model::warnings`]; [`Options::strict`] enforces the order of commands.

mod controller;
mod descriptors;
mod patterns;
mod port;
mod registers;
mod video;

use std::collections::VecDeque;
use std::fmt::Write as _;

use dpm_device::time::HostTime;
use dpm_dlpc900::command::{flag, CommandAssembler, Opcode, Reply, REPORT_BYTES};
use dpm_dlpc900::image::PlaneOrder;
use dpm_dlpc900::lut::{DisplayMode, Dmd, LutEntry};
use dpm_dlpc900::sequence::Version;

use crate::usb_model::{Progress, Setup, Speed, Then, UsbDeviceModel};
use controller::Controller;
pub use controller::Sequencer;
pub use port::VirtualHid;

/// The emulated projector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Mirror array.
    pub dmd: Dmd,
    /// Firmware.
    pub firmware: Version,
    /// The order of the planes in the bytes of a pixel.
    pub plane_order: PlaneOrder,
    /// Refuse what the guide forbids but programs in the field do.
    pub strict: bool,
    /// Number of HID interfaces, 1 or 2.
    pub interfaces: u8,
    /// Least time between two reports from the host, nanoseconds; the cable's 1 ms is 1,000,000; 0 is without limit.
    pub report_period_ns: i64,
    /// A video signal is connected.
    pub source_present: bool,
    /// Length of its frames, microseconds.
    pub video_frame_us: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            dmd: Dmd::Dlp6500,
            firmware: Version { major: 6, minor: 0, patch: 1 },
            plane_order: PlaneOrder::default(),
            strict: false,
            interfaces: 1,
            report_period_ns: 0,
            source_present: true,
            video_frame_us: 16_667,
        }
    }
}

/// A fault of the controller, planned by [`Dlpc900Model::inject`]. Faults of the cable are those of [`crate::usb_plug::Fault`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dlpc900Fault {
    /// The next command with this opcode is refused with this code.
    Refuse(Opcode, u8),
    /// The next reply is never made.
    LoseReply,
    /// The next reply carries another sequence number; then the right one follows.
    StrayReply,
    /// These bits are added to the hardware status until a mode switch or reset.
    Hardware(u8),
    /// The next start of video patterns is aborted: the signal was changing.
    AbortStart,
    /// The video signal disappears (false) or returns.
    Source(bool),
}

/// One executed command, for inspecting what a program did.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Executed {
    /// Flags byte.
    pub flags: u8,
    /// Opcode.
    pub opcode: Opcode,
    /// The first data bytes, at most 16.
    pub data: Vec<u8>,
    /// Error code, 0 for done.
    pub error: u8,
}

/// Commands kept in [`Dlpc900Model::executed`]; image data and status reads are only counted.
const MOST_EXECUTED: usize = 4096;

/// The emulated projector.
pub struct Dlpc900Model {
    controller: Controller,
    assembler: CommandAssembler,
    /// Reports of the single waiting reply. The next command overwrites it, read or not.
    reply: VecDeque<[u8; REPORT_BYTES]>,
    configuration: Vec<u8>,
    executed: Vec<Executed>,
    commands: u64,
    dropped_reports: u64,
    unread_replies: u64,
    ready_at: HostTime,
}

impl Default for Dlpc900Model {
    fn default() -> Self {
        Self::new(Options::default())
    }
}

impl Dlpc900Model {
    /// A projector that was just switched on.
    pub fn new(options: Options) -> Self {
        Self {
            configuration: descriptors::configuration(options.interfaces.clamp(1, 2)),
            controller: Controller::new(options),
            assembler: CommandAssembler::default(),
            reply: VecDeque::new(),
            executed: Vec::new(),
            commands: 0,
            dropped_reports: 0,
            unread_replies: 0,
            ready_at: HostTime(i64::MIN),
        }
    }

    /// The host sends `data` to interrupt OUT endpoint `endpoint`: one report per 64 bytes, as the cable splits it.
    pub fn interrupt_out(&mut self, now: HostTime, endpoint: u8, data: &[u8]) {
        if endpoint != 0x01 {
            self.dropped_reports += 1;
            return;
        }
        for report in data.chunks(REPORT_BYTES) {
            self.report(now, report);
        }
    }

    /// The next report that waits for the host on `endpoint`.
    pub fn interrupt_in(&mut self, endpoint: u8) -> Option<[u8; REPORT_BYTES]> {
        if endpoint == 0x81 {
            self.reply.pop_front()
        } else {
            None
        }
    }

    fn report(&mut self, now: HostTime, report: &[u8]) {
        let command = match self.assembler.push(report) {
            Ok(Some(c)) => c,
            Ok(None) => return,
            Err(_) => {
                self.dropped_reports += 1;
                return;
            }
        };
        // The command buffer is shared with the replies.
        self.unread_replies += u64::from(!self.reply.is_empty());
        self.reply.clear();
        self.commands += 1;
        let (data, refused) = self.controller.execute(now, &command);
        let quiet = matches!(command.opcode, Opcode::BMP_DATA_PRIMARY | Opcode::BMP_DATA_SECONDARY);
        if (!quiet || refused) && self.executed.len() < MOST_EXECUTED {
            self.executed.push(Executed {
                flags: command.flags,
                opcode: command.opcode,
                data: command.data[..command.data.len().min(16)].to_vec(),
                error: if refused { self.controller.error } else { 0 },
            });
        }
        if !command.wants_reply() {
            return;
        }
        let flags = command.flags | if refused { flag::NACK } else { 0 };
        let reply = Reply { flags, sequence: command.sequence, data: &data };
        let faults = &mut self.controller.faults;
        let at = faults.iter().position(|f| matches!(f, Dlpc900Fault::LoseReply | Dlpc900Fault::StrayReply));
        match at.map(|i| faults.swap_remove(i)) {
            Some(Dlpc900Fault::LoseReply) => return,
            Some(Dlpc900Fault::StrayReply) => {
                let stray = Reply { sequence: command.sequence.wrapping_add(77), ..reply };
                self.reply.extend(stray.reports().into_iter().flatten());
            }
            _ => {}
        }
        self.reply.extend(reply.reports().into_iter().flatten());
    }

    /// Plans a fault.
    pub fn inject(&mut self, fault: Dlpc900Fault) {
        match fault {
            Dlpc900Fault::Hardware(bits) => self.controller.hardware_fault |= bits,
            Dlpc900Fault::Source(present) => self.controller.source_present = present,
            other => self.controller.faults.push(other),
        }
    }

    /// The configuration.
    pub fn options(&self) -> &Options {
        &self.controller.options
    }

    /// Display mode.
    pub fn mode(&self) -> DisplayMode {
        self.controller.mode
    }

    /// State of the sequencer at `now`.
    pub fn sequencer(&mut self, now: HostTime) -> Sequencer {
        self.controller.settle(now);
        self.controller.sequencer
    }

    /// The effective table in the order shown.
    pub fn table(&self) -> Vec<LutEntry> {
        self.controller.patterns.table()
    }

    /// The `place`-th pattern shown, if it is a plane (depth 1): its mirrors in the project's plane layout, flips and
    /// inversion applied. For deeper patterns its least significant bit.
    pub fn projected_plane(&self, place: usize) -> Option<Vec<u8>> {
        self.projected_bit(place, 0)
    }

    /// Bit `bit` of the `place`-th pattern.
    pub fn projected_bit(&self, place: usize, bit: u8) -> Option<Vec<u8>> {
        let mut plane = if self.controller.has_video() {
            let entry = *self.table().get(place)?;
            self.controller.video_plane(&entry, bit)?
        } else {
            self.controller.patterns.plane(place, bit)?
        };
        let raster = self.options().dmd.raster();
        let on = |o| self.controller.setting_byte(o) & 1 != 0;
        let (mirror, upside_down, invert) =
            (on(Opcode::FLIP_LONG), on(Opcode::FLIP_SHORT), on(Opcode::INVERT));
        if upside_down {
            let rows: Vec<_> = plane.chunks(raster.row_bytes()).rev().map(<[u8]>::to_vec).collect();
            plane = rows.concat();
        }
        let width = raster.width() as usize;
        if mirror || invert {
            for row in plane.chunks_mut(raster.row_bytes()) {
                let old = row.to_vec();
                row.fill(0);
                for x in 0..width {
                    let from = if mirror { width - 1 - x } else { x };
                    let lit = (old[from / 8] >> (7 - from % 8) & 1 != 0) != invert;
                    row[x / 8] |= u8::from(lit) << (7 - x % 8);
                }
            }
        }
        Some(plane)
    }

    /// The `place`-th pattern as grey values 0 to 255, row by row; a 1-bit pattern is black and white.
    pub fn projected_grey(&self, place: usize) -> Option<Vec<u8>> {
        let depth = self.table().get(place)?.depth;
        let raster = self.options().dmd.raster();
        let mut grey = vec![0u32; raster.pixel_count()];
        for bit in 0..depth {
            let plane = self.projected_bit(place, bit)?;
            for (row, out) in plane.chunks(raster.row_bytes()).zip(grey.chunks_mut(raster.width() as usize)) {
                for (x, g) in out.iter_mut().enumerate() {
                    *g |= u32::from(row[x / 8] >> (7 - x % 8) & 1) << bit;
                }
            }
        }
        let full = (1u32 << depth) - 1;
        Some(grey.into_iter().map(|g| (g * 255 / full) as u8).collect())
    }

    /// The `place`-th pattern as a PGM picture (binary, 8 bits).
    pub fn projected_pgm(&self, place: usize) -> Option<Vec<u8>> {
        let raster = self.options().dmd.raster();
        let mut out = format!("P5\n{} {}\n255\n", raster.width(), raster.height()).into_bytes();
        out.extend(self.projected_grey(place)?);
        Some(out)
    }

    /// A frame of `size` (columns, rows) has arrived at the video input: its last row is there, and the next frame begins at
    /// `now`. `pixels` are XRGB8888, row by row; empty for black.
    pub fn video_frame(&mut self, now: HostTime, size: [u32; 2], pixels: &[u8]) {
        self.controller.settle(now);
        self.controller.video_frame(now, size, pixels);
    }

    /// Light of each mirror in one pass of the table: red, green and blue, in microseconds of a full LED, times 255. It does
    /// not ask whether anything is lit.
    pub fn light_of_table(&self) -> Vec<[u64; 3]> {
        let raster = self.options().dmd.raster();
        let mut light = vec![[0; 3]; raster.pixel_count()];
        for (place, entry) in self.table().iter().enumerate() {
            let full = (1u64 << entry.depth) - 1;
            for bit in 0..entry.depth {
                let Some(plane) = self.projected_bit(place, bit) else { continue };
                let weight = u64::from(entry.exposure_us) * 255 * (1 << bit) / full;
                let rows = plane.chunks(raster.row_bytes()).zip(light.chunks_mut(raster.width() as usize));
                for (x, mirror, row) in
                    rows.flat_map(|(row, out)| out.iter_mut().enumerate().map(move |(x, m)| (x, m, row)))
                {
                    if row[x / 8] >> (7 - x % 8) & 1 != 0 {
                        for (led, light) in mirror.iter_mut().enumerate() {
                            *light += if entry.leds >> led & 1 != 0 { weight } else { 0 };
                        }
                    }
                }
            }
        }
        light
    }

    /// The pattern lit at `now` and its place in the table; `None` while no light leaves the projector.
    pub fn showing(&mut self, now: HostTime) -> Option<(usize, LutEntry)> {
        self.controller.settle(now);
        self.controller.showing(now)
    }

    /// Why no light leaves the projector, if none does.
    pub fn dark_because(&self) -> Option<&'static str> {
        self.controller.dark_because()
    }

    /// Deviations of the program from the guide, and every refusal, oldest first (at most 256).
    pub fn warnings(&self) -> &[String] {
        &self.controller.warnings
    }

    /// Commands executed, oldest first (at most 4096), image data left out unless refused.
    pub fn executed(&self) -> &[Executed] {
        &self.executed
    }

    /// All commands ever executed.
    pub fn commands(&self) -> u64 {
        self.commands
    }

    /// Reports that made no sense.
    pub fn dropped_reports(&self) -> u64 {
        self.dropped_reports
    }

    /// Replies that were overwritten before the host had read them.
    pub fn unread_replies(&self) -> u64 {
        self.unread_replies
    }

    /// The state in a few lines.
    pub fn summary(&mut self, now: HostTime) -> String {
        let mut s = String::new();
        let (sequencer, o) = (self.sequencer(now), self.options());
        let _ =
            writeln!(s, "{} firmware {}, {:?} mode, {sequencer:?}", o.dmd.name(), o.firmware, self.mode());
        let _ = writeln!(
            s,
            "{} patterns, {} commands, dark because: {:?}",
            self.table().len(),
            self.commands,
            self.dark_because()
        );
        for w in self.warnings() {
            let _ = writeln!(s, "warning: {w}");
        }
        s
    }
}

impl UsbDeviceModel for Dlpc900Model {
    fn speed(&self) -> Speed {
        Speed::Full
    }

    fn device_descriptor(&self) -> &[u8] {
        &descriptors::DEVICE
    }

    fn configuration_descriptor(&self) -> &[u8] {
        &self.configuration
    }

    fn string(&self, index: u8) -> Option<&str> {
        usize::from(index).checked_sub(1).and_then(|i| descriptors::STRINGS.get(i)).copied()
    }

    fn other_descriptor(&self, kind: u8, _index: u8, windex: u16) -> Option<&[u8]> {
        if windex >= u16::from(self.controller.options.interfaces.clamp(1, 2)) {
            return None;
        }
        match kind {
            0x21 => Some(&descriptors::HID),
            0x22 => Some(&descriptors::REPORT),
            _ => None,
        }
    }

    /// The class requests of HID 1.11 section 7.2.
    fn control(&mut self, now: HostTime, setup: &Setup, data: &mut [u8]) -> Progress {
        match (setup.request_type, setup.request) {
            // GET_REPORT: the waiting report, else an empty one.
            (0xa1, 0x01) => {
                let report = self.interrupt_in(0x81).unwrap_or([0; REPORT_BYTES]);
                let n = data.len().min(REPORT_BYTES);
                data[..n].copy_from_slice(&report[..n]);
                Progress::complete(n)
            }
            // SET_REPORT: an output report by control. Some stacks put the report ID 0 in front.
            (0x21, 0x09) => {
                let report = if data.len() == REPORT_BYTES + 1 { &data[1..] } else { &data[..] };
                self.interrupt_out(now, 0x01, report);
                Progress::complete(data.len())
            }
            // GET_IDLE, GET_PROTOCOL (report protocol), SET_IDLE, SET_PROTOCOL.
            (0xa1, 0x02) | (0xa1, 0x03) => {
                let value = setup.request - 2;
                data.iter_mut().take(1).for_each(|b| *b = value);
                Progress::complete(data.len().min(1))
            }
            (0x21, 0x0a | 0x0b) => Progress::complete(0),
            _ => Progress::stall(0),
        }
    }

    fn transfer_out(&mut self, now: HostTime, endpoint: u8, data: &[u8]) -> Progress {
        let period = self.controller.options.report_period_ns;
        if period <= 0 {
            self.interrupt_out(now, endpoint, data);
            return Progress::complete(data.len());
        }
        if now < self.ready_at {
            return Progress::nak(0);
        }
        self.ready_at = now.plus_ns(period);
        let n = data.len().min(REPORT_BYTES);
        self.interrupt_out(now, endpoint, &data[..n]);
        if n == data.len() {
            Progress::complete(n)
        } else {
            Progress::nak(n)
        }
    }

    fn transfer_in(&mut self, _now: HostTime, endpoint: u8, buffer: &mut [u8]) -> Progress {
        if buffer.len() < REPORT_BYTES {
            // A report is one packet of 64 bytes; it does not fit.
            let waits = endpoint == 0x81 && !self.reply.is_empty();
            return Progress { bytes: 0, then: if waits { Then::Babble } else { Then::Nak } };
        }
        match self.interrupt_in(endpoint) {
            Some(report) => {
                buffer[..REPORT_BYTES].copy_from_slice(&report);
                Progress::complete(REPORT_BYTES)
            }
            None => Progress::nak(0),
        }
    }

    fn bus_reset(&mut self, _now: HostTime) {
        // A half-received command and an unread reply are lost; the controller's own state is not. Programs reset the
        // bus at their end.
        self.assembler.reset();
        self.reply.clear();
    }
}

#[cfg(test)]
mod tests;
