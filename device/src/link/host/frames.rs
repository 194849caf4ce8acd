//! Sends one frame's planes as packets: whole or not at all.

use super::light::{LimitHit, SlotLight};
use super::{DropReason, HostLink, LinkState, SendOutcome, Verb};
use crate::link::compact::PlaneForm;
use crate::link::flash::REST_US;
use crate::link::message::{Commit, HostMessage};
use crate::packet::MAX_CONTROL_BYTES;
use crate::packet::{frame_newer, Codec, Header, MessageType, Packet};
use crate::planes::MAX_PLANES;
use crate::time::{DeviceTicks, HostTime};
use crate::transport::{Lane, SendError, Transport};

impl HostLink {
    /// Hands one frame to the medium, all of it or nothing. `planes` holds the frame's planes one after the other in
    /// the configured order, each [`crate::planes::Raster::plane_bytes`] long; raw planes are sent from there without a
    /// copy on this side. `frame_id` must grow from frame to frame; the wire carries its low 32 bits. `target_at` is
    /// the instant of light on the device's clock, usually [`SlotClock::start`](crate::link::slots::SlotClock::start)
    /// of the slot. From `dark_from` on, on the same clock, the device shows nothing of this frame, even if it never
    /// hears from a host again; usually [`SlotClock::dark_from`](crate::link::slots::SlotClock::dark_from). A device
    /// refuses a frame whose light would end before it begins, so a `dark_from` that is not later than `target_at` is
    /// sent as one tick after it.
    ///
    /// # Panics
    /// When `planes` does not have the configured size.
    pub fn send_frame(
        &mut self,
        now: HostTime,
        frame_id: u64,
        target_at: DeviceTicks,
        dark_from: DeviceTicks,
        planes: &[u8],
        transport: &mut dyn Transport,
    ) -> SendOutcome {
        self.counters.frames_offered += 1;
        match self.try_send_frame(now, frame_id as u32, target_at, dark_from, planes, transport) {
            Ok(()) => {
                self.counters.frames_sent += 1;
                SendOutcome::Sent
            }
            Err(reason) => {
                *match reason {
                    DropReason::NotStreaming => &mut self.counters.not_streaming,
                    DropReason::NoCredit => &mut self.counters.no_credit,
                    DropReason::LinkBusy => &mut self.counters.link_busy,
                    DropReason::LinkLost => &mut self.counters.link_lost,
                    DropReason::NotNewer => &mut self.counters.not_newer,
                    DropReason::FlashLimit => &mut self.counters.flash_limit,
                    DropReason::LightLimit(_) => &mut self.counters.light_limit,
                } += 1;
                SendOutcome::Dropped { reason }
            }
        }
    }

    fn try_send_frame(
        &mut self,
        now: HostTime,
        frame: u32,
        target_at: DeviceTicks,
        dark_from: DeviceTicks,
        planes: &[u8],
        transport: &mut dyn Transport,
    ) -> Result<(), DropReason> {
        let target_at = self.aim(target_at);
        let schedule = self.settings.schedule;
        let expected = self.settings.raster.plane_bytes() * schedule.len();
        assert!(planes.len() == expected, "frame of {} bytes, configured {expected}", planes.len());
        // No frame may be queued before or behind an order to go dark.
        let darkens = self.rest.is_none() && self.verb.is_some_and(Verb::is_dark);
        if self.state != LinkState::Streaming || darkens {
            return Err(DropReason::NotStreaming);
        }
        if self.last_frame.is_some_and(|last| !frame_newer(frame, last)) {
            return Err(DropReason::NotNewer);
        }
        if let Some((_, reason)) = self.rest {
            return Err(reason);
        }
        if self.credit() == 0 {
            return Err(DropReason::NoCredit);
        }
        if !transport.has_room(Lane::Data) {
            if let Some(compactor) = &mut self.compactor {
                compactor.refused();
            }
            return Err(DropReason::LinkBusy);
        }
        // A frame that is not sent adds no light: the device repeats the one before.
        self.rests(now, [target_at, dark_from], planes, transport)?;
        let has_base = !self.key_due && self.last_frame.is_some();
        let forms = match &mut self.compactor {
            Some(compactor) => compactor.compact(planes, has_base),
            None => [PlaneForm::Raw; MAX_PLANES],
        };
        let forms = &forms[..schedule.len()];
        let bytes = self.send_packets(now, (frame, target_at, dark_from), planes, forms, transport)?;
        self.count_sent(now, frame, planes, forms, bytes);
        if let Some(reported) = &mut self.reported {
            reported.sent(frame, self.field.luminance());
        }
        Ok(())
    }

    /// Hands the packets of a frame to the medium, the commit last: all of them or none. Returns their bytes on the wire.
    fn send_packets(
        &mut self,
        now: HostTime,
        (frame, target_at, dark_from): (u32, DeviceTicks, DeviceTicks),
        planes: &[u8],
        forms: &[PlaneForm],
        transport: &mut dyn Transport,
    ) -> Result<u64, DropReason> {
        let plane_bytes = self.settings.raster.plane_bytes();
        let is_kept = |form: &PlaneForm| *form == PlaneForm::Kept;
        let kept = forms.iter().enumerate().fold(0u32, |mask, (k, f)| mask | u32::from(is_kept(f)) << k);
        let commit = HostMessage::Commit(Commit {
            sent: u32::MAX >> (32 - forms.len()) & !kept,
            kept,
            base_frame: if is_key(forms) { 0 } else { self.last_frame.unwrap_or(0) },
            frames_sent: self.frames_sent.wrapping_add(1),
            dark_from: dark_from.max(DeviceTicks(target_at.0.saturating_add(1))),
        });
        let header =
            Header { frame, target_at, ..Header::control(MessageType::Plane, self.inbox.session, 0) };
        let mut payload = [0u8; MAX_CONTROL_BYTES];
        let (kind, n) = commit.write(&mut payload);
        let last = Packet::new(Header { kind, ..header }, &payload[..n]);
        let mut packets = [last; MAX_PLANES + 1];
        let mut count = 0;
        for (k, (spec, form)) in self.settings.schedule.planes().iter().zip(forms).enumerate() {
            let (codec, bytes) = match (form, &self.compactor) {
                (PlaneForm::Kept, _) => continue,
                (PlaneForm::Coded(codec, n), Some(compactor)) => (*codec, compactor.coded(k, *n)),
                _ => (Codec::Raw, &planes[k * plane_bytes..(k + 1) * plane_bytes]),
            };
            let header = Header { codec, plane: k as u8, led_code: spec.led_code(), ..header };
            packets[count] = Packet::new(header, bytes);
            count += 1;
        }
        packets[count] = last;
        let packets = &packets[..=count];
        match transport.send(now, Lane::Data, packets) {
            Ok(()) => Ok(packets.iter().map(|p| p.wire_bytes() as u64).sum()),
            Err(SendError::Busy) => Err(DropReason::LinkBusy),
            Err(SendError::Failed(_)) => Err(DropReason::LinkLost),
        }
    }

    /// A frame of `bytes` on the wire was sent: it is what the next one may be coded against.
    fn count_sent(&mut self, now: HostTime, frame: u32, planes: &[u8], forms: &[PlaneForm], bytes: u64) {
        let c = &mut self.counters;
        c.bytes_sent += bytes;
        c.frame_bytes_sent += bytes;
        for form in forms {
            *match form {
                PlaneForm::Kept => &mut c.planes_kept,
                PlaneForm::Raw => &mut c.planes_raw,
                PlaneForm::Coded(..) => &mut c.planes_coded,
            } += 1;
        }
        c.key_frames += u64::from(is_key(forms));
        self.key_due = false;
        if let Some(compactor) = &mut self.compactor {
            compactor.sent(planes);
            self.counters.compaction_bytes += compactor.take_touched();
        }
        self.frames_sent = self.frames_sent.wrapping_add(1);
        self.last_frame = Some(frame);
        self.data_sent_at = now;
    }

    /// Feeds the limiters with a frame that is about to be shown in the slot of `target_at`. Returns an error while
    /// light rests.
    fn rests(
        &mut self,
        now: HostTime,
        [target_at, dark_from]: [DeviceTicks; 2],
        planes: &[u8],
        transport: &mut dyn Transport,
    ) -> Result<(), DropReason> {
        let Some(slots) = self.slots else { return Ok(()) };
        // Frames are sent even while an order keeps them dark.
        let shown = match self.ordered {
            None => SlotLight::New(planes),
            Some(Verb::Freeze) => SlotLight::Same,
            Some(Verb::Black) => SlotLight::Dark,
            Some(_) => SlotLight::Nothing,
        };
        let (rest_us, reason) = match self.field.slot(&slots, [target_at, dark_from], shown) {
            None => return Ok(()),
            Some(LimitHit::Flashes) => (u64::from(REST_US), DropReason::FlashLimit),
            Some(LimitHit::Light(limit)) => {
                (self.settings.limits.rest_us(limit), DropReason::LightLimit(limit))
            }
        };
        self.rest_for(now, rest_us, reason, transport);
        Err(reason)
    }

    /// Keeps the field dark for `rest_us`.
    pub(super) fn rest_for(
        &mut self,
        now: HostTime,
        rest_us: u64,
        reason: DropReason,
        transport: &mut dyn Transport,
    ) {
        // If it does not get through now, `poll` repeats it until the device confirms it.
        let _ = self.give(now, Verb::Black, transport);
        self.rest = Some((now.plus_ns((rest_us * 1000) as i64), reason));
    }
}

/// True when a frame of these planes can be shown without the one before it.
fn is_key(forms: &[PlaneForm]) -> bool {
    !forms.iter().any(|f| matches!(f, PlaneForm::Kept | PlaneForm::Coded(Codec::XorRle, _)))
}
