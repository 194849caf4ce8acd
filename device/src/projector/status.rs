//! What the device tells of itself: HELLO, its state, and the counters of STATUS.

use super::{Core, Mode};
use crate::link::{Decoder, DecoderCounters, DeviceHello, DeviceState, FrameTiming, Status};
use crate::time::DeviceTicks;

/// Counts of both lanes' decoders since power-on.
pub(super) fn summed(decoders: &[Decoder; 2]) -> DecoderCounters {
    let [a, b] = decoders.each_ref().map(Decoder::counters);
    DecoderCounters {
        packets: a.packets.wrapping_add(b.packets),
        header_errors: a.header_errors.wrapping_add(b.header_errors),
        payload_errors: a.payload_errors.wrapping_add(b.payload_errors),
        foreign: a.foreign.wrapping_add(b.foreign),
        cut_short: a.cut_short.wrapping_add(b.cut_short),
        bytes_skipped: a.bytes_skipped.wrapping_add(b.bytes_skipped),
    }
}

impl Core {
    /// HELLO by the settings.
    pub(super) fn hello(&self, now: DeviceTicks) -> DeviceHello {
        DeviceHello {
            version: self.setup.version,
            firmware: self.setup.firmware,
            codecs: self.setup.codecs,
            raster: self.setup.raster,
            max_planes: self.setup.max_planes,
            frame_buffers: self.setup.frame_buffers,
            greatest_shift: self.setup.greatest_shift,
            measures_timing: self.setup.measures_timing,
            shifts_slots: self.setup.shifts_slots,
            exceeds: self.setup.exceeds,
            tick_hz: self.setup.clock.tick_hz,
            min_plane_ns: self.setup.min_plane_ns,
            serial: self.setup.serial,
            now,
        }
    }

    /// The state that STATUS and changes of light tell.
    pub(super) fn state(&self) -> DeviceState {
        match (self.session, &self.config, self.mode) {
            _ if self.latched != 0 => DeviceState::Faulted,
            (0, ..) => DeviceState::Idle,
            (_, None, _) => DeviceState::Greeted,
            (_, _, Mode::Disarmed) => DeviceState::Configured,
            (_, _, Mode::Normal) => DeviceState::Armed,
            (_, _, Mode::Black) => DeviceState::Black,
            (_, _, Mode::Frozen) => DeviceState::Frozen,
        }
    }

    /// STATUS, with what the decoders counted in this session.
    pub(super) fn status_now(&self, decoders: &[Decoder; 2]) -> Status {
        let (all, before) = (summed(decoders), self.counted_before);
        Status {
            state: self.state(),
            lit: self.lit_now,
            buffers_free: self.store.free() as u8,
            faults: self.latched,
            frame_limit: self.frame_limit(),
            now: self.ticks(),
            packets: all.packets.wrapping_sub(before.packets),
            header_errors: all.header_errors.wrapping_sub(before.header_errors),
            payload_errors: all.payload_errors.wrapping_sub(before.payload_errors),
            packets_ignored: self
                .status
                .packets_ignored
                .wrapping_add(all.foreign.wrapping_sub(before.foreign)),
            bytes_skipped: all.bytes_skipped.wrapping_sub(before.bytes_skipped),
            tracks: self.track_counts(),
            timing: self.times().then(|| FrameTiming {
                epoch: self.present_epoch(),
                ..self.status.timing.unwrap_or_default()
            }),
            ..self.status
        }
    }

    /// True if CONFIG asked for timing and this projector measures it.
    fn times(&self) -> bool {
        self.setup.measures_timing && self.config.as_ref().is_some_and(|(config, _)| config.timing)
    }

    /// The frame up to which the host has credit.
    pub(super) fn frame_limit(&self) -> u32 {
        if self.mode == Mode::Disarmed {
            // No credit while the device would refuse frames.
            return self.status.frames_accounted;
        }
        self.status.frames_accounted.wrapping_add(self.store.free() as u32)
    }
}
