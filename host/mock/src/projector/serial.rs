//! The projector on a serial line: COBS frames in, COBS frames out, on any reader and writer.

use std::io::{ErrorKind, Read, Write};

use dpm_device::cobs::{encode, encoded_bytes, Deframer};
use dpm_device::link::{packet_bytes, MessageType, MAX_CONTROL_BYTES};
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};

use super::MockProjector;

/// Maximum number of bytes of replies kept; more are dropped, because STATUS is absolute.
const REPLIES_KEPT: usize = 16 * 1024;
/// Bytes read in one call at most.
const READ_AT_ONCE: usize = 256 * 1024;

/// The projector's end of a serial line: what lies between the line's bytes and the projector's packets.
#[derive(Debug)]
pub struct SerialEnd {
    deframer: Deframer<Vec<u8>>,
    out: Vec<u8>,
}

impl SerialEnd {
    /// An end for `projector` that has heard nothing yet.
    pub fn new(projector: &MockProjector) -> Self {
        let plane = projector.raster().plane_bytes().max(MAX_CONTROL_BYTES);
        Self { deframer: Deframer::new(vec![0; packet_bytes(plane)]), out: Vec::new() }
    }

    /// Bytes from the line.
    pub fn receive(&mut self, projector: &mut MockProjector, now: HostTime, bytes: &[u8]) {
        self.deframer.push(bytes, &mut |frame| {
            use MessageType::{FrameCommit, Plane, Sync};
            let kind = frame.get(5).copied().and_then(MessageType::from_code);
            let is_data = matches!(kind, Some(Plane | FrameCommit | Sync));
            let lane = if is_data { Lane::Data } else { Lane::Control };
            projector.receive(now, lane, frame);
            projector.end_of_transfer(now, lane);
        });
    }

    /// Bytes for the line; the caller removes those that the line took from the front. While the line has not taken the
    /// last ones, no new ones are made: an older STATUS never delays a newer one, and an ECHO is stamped when it can
    /// leave.
    pub fn replies(&mut self, projector: &mut MockProjector, now: HostTime) -> &mut Vec<u8> {
        let out = &mut self.out;
        if !out.is_empty() {
            projector.advance_to(now);
            return out;
        }
        projector.replies(now, &mut |_, packet| {
            let from = out.len();
            if from < REPLIES_KEPT {
                out.resize(from + encoded_bytes(packet.len()), 0);
                let n = encode(&[packet], &mut out[from..]).expect("room was made for it");
                out.truncate(from + n);
            }
        });
        out
    }
}

/// A [`MockProjector`] on a serial line.
#[derive(Debug)]
pub struct SerialProjector {
    projector: MockProjector,
    end: SerialEnd,
}

impl SerialProjector {
    /// Connects `projector` to a line.
    pub fn new(projector: MockProjector) -> Self {
        Self { end: SerialEnd::new(&projector), projector }
    }

    /// The projector inside.
    pub fn projector(&mut self) -> &mut MockProjector {
        &mut self.projector
    }

    /// Bytes from the line, see [`SerialEnd::receive`].
    pub fn receive(&mut self, now: HostTime, bytes: &[u8]) {
        self.end.receive(&mut self.projector, now, bytes);
    }

    /// Bytes for the line, see [`SerialEnd::replies`].
    pub fn replies(&mut self, now: HostTime) -> &mut Vec<u8> {
        self.end.replies(&mut self.projector, now)
    }

    /// One round on a non-blocking line: reads the input, advances to now, writes what the line takes. `Ok(false)` when
    /// the line has ended. `clock` is read before each delivery and before the answers.
    pub fn serve(
        &mut self,
        clock: impl Fn() -> HostTime,
        line: &mut (impl Read + Write),
    ) -> std::io::Result<bool> {
        let mut bytes = [0u8; 4096];
        let mut left = READ_AT_ONCE;
        while left > 0 {
            match line.read(&mut bytes) {
                Ok(0) => return Ok(false),
                Ok(n) => {
                    self.receive(clock(), &bytes[..n]);
                    left = left.saturating_sub(n);
                }
                Err(e) if later(&e) => break,
                Err(e) if e.kind() == ErrorKind::BrokenPipe || e.raw_os_error() == Some(libc::EIO) => {
                    return Ok(false)
                }
                Err(e) => return Err(e),
            }
        }
        let out = self.replies(clock());
        if !out.is_empty() {
            match line.write(out) {
                Ok(n) => drop(out.drain(..n)),
                Err(e) if later(&e) => {}
                Err(e) if e.kind() == ErrorKind::BrokenPipe || e.raw_os_error() == Some(libc::EIO) => {
                    return Ok(false)
                }
                Err(e) => return Err(e),
            }
        }
        Ok(true)
    }
}

fn later(e: &std::io::Error) -> bool {
    matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::projector::MockConfig;
    use dpm_device::link::{
        DeviceMessage, Epoch, HostLink, LightLimits, LinkSettings, LinkState, MessageType, SendOutcome,
        Underrun,
    };
    use dpm_device::planes::{PlaneSchedule, Raster};
    use dpm_device::time::{DeviceTicks, FrameRate};
    use dpm_device::transport::inproc::Direct;

    /// A projector that has been sent one frame over a cable without length, and the time.
    fn with_one_frame() -> (MockProjector, HostTime) {
        let raster = Raster::new(20, 3).unwrap();
        let mut link = HostLink::new(LinkSettings {
            raster,
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(947, 1).unwrap(),
            watchdog_us: 50_000,
            underrun: Underrun::Repeat,
            late_slots: 0,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: 0,
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        let mut cable = Direct::new(MockProjector::new(MockConfig::new(raster)));
        link.connect();
        for ms in 0..200 {
            let now = HostTime(ms * 1_000_000);
            match link.poll(now, &mut cable).expect("handshake") {
                LinkState::Ready => link.arm(0),
                LinkState::Streaming => {
                    let slots = link.slots().unwrap();
                    let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap() + 2;
                    let planes = vec![0x40; raster.plane_bytes() * 24];
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 60_000_000_000));
                    let sent = link.send_frame(now, 1, target, dark_from, &planes, &mut cable);
                    assert_eq!(sent, SendOutcome::Sent);
                    return (cable.into_device(), now);
                }
                _ => {}
            }
        }
        panic!("still {:?}", link.state());
    }

    /// Question 11: on a slow line no STATUS waits behind another, and an ECHO's answer behind at most one.
    #[test]
    fn no_status_is_queued_behind_another() {
        let (projector, now) = with_one_frame();
        let mut line = SerialProjector::new(projector);
        let one = line.replies(now).len();
        assert!((100..300).contains(&one), "{one} bytes");
        // Nothing is taken for forty slots.
        for slot in 1..40 {
            let now = now.plus_ns(slot * 1_055_966);
            assert_eq!(line.replies(now).len(), one);
        }
        // Half of it, then the rest: only then there is one more STATUS, a present one.
        let now = now.plus_ns(40 * 1_055_966);
        line.replies(now).drain(..one / 2);
        assert_eq!(line.replies(now).len(), one - one / 2);
        line.replies(now).clear();
        let fresh = line.replies(now).clone();
        let mut packet = Vec::new();
        dpm_device::cobs::Deframer::new([0; 256]).push(&fresh, &mut |frame| packet = frame.to_vec());
        let DeviceMessage::Status(status) =
            DeviceMessage::parse(MessageType::Status, &packet[32..128]).unwrap()
        else {
            unreachable!()
        };
        assert_eq!(status.now, line.projector().clock().ticks_at(now));
    }
}
