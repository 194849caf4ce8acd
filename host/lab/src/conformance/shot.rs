//! Frames that a rule sends: right ones, and wrong ones in one point.

use super::driver::{ConformanceDriver, R};
use super::Stop;
use dpm_device::link::{
    crc32c, packet_bytes, rle_encode, Codec, Commit, Header, HostMessage, MessageType, Packet, COMMIT_BYTES,
    MAX_CONTROL_BYTES,
};
use dpm_device::time::DeviceTicks;
use dpm_device::transport::Lane;

/// Longest time that one raw plane may take on the medium; beyond it rules that need raw planes are not judged.
const LONGEST_PLANE_NS: i64 = 800_000_000;

/// One plane on its way.
#[derive(Clone, Debug)]
pub(crate) struct Piece {
    pub plane: u8,
    pub codec: Codec,
    pub led: u8,
    pub target: u64,
    pub bytes: Vec<u8>,
    /// The payload's checksum is wrong.
    pub damaged: bool,
}

/// A frame on its way.
#[derive(Clone, Debug)]
pub(super) struct Shot {
    pub id: u32,
    pub slot: u64,
    pub target: u64,
    pub pieces: Vec<Piece>,
    pub commit: Commit,
    /// FRAME_COMMIT is sent.
    pub commits: bool,
}

impl ConformanceDriver<'_> {
    /// Bytes of one plane.
    pub(super) fn plane_bytes(&self) -> usize {
        self.hello.map_or(1, |h| h.raster.plane_bytes())
    }

    pub(super) fn reads(&self, codec: Codec) -> bool {
        self.hello.is_some_and(|h| h.codecs & codec.mask() != 0)
    }

    /// Bytes of a plain frame on the wire.
    pub(super) fn frame_bytes(&self) -> usize {
        let plane = if self.reads(Codec::Rle) { 64.min(self.plane_bytes()) } else { self.plane_bytes() };
        2 * packet_bytes(plane) + packet_bytes(COMMIT_BYTES)
    }

    /// Without raw planes that the medium carries in time a device that reads no codec cannot be judged.
    pub(crate) fn needs_frames(&self) -> R {
        if !self.reads(Codec::Rle) {
            self.needs_raw()?;
        }
        Ok(())
    }

    /// See [`ConformanceDriver::needs_frames`], for a rule that is about raw planes.
    pub(crate) fn needs_raw(&self) -> R {
        if self.carry_ns(packet_bytes(self.plane_bytes())) > LONGEST_PLANE_NS {
            return Err(Stop::NotJudged(format!(
                "a raw plane of {} bytes takes this medium longer than {} ms",
                self.plane_bytes(),
                LONGEST_PLANE_NS / 1_000_000
            )));
        }
        Ok(())
    }

    /// A plane that is dark but for its first mirrors, which `value` draws: the least light that is still a picture.
    pub(crate) fn faint(&self, value: u8) -> Vec<u8> {
        let mut plane = vec![0; self.plane_bytes()];
        let width = self.hello.map_or(8, |h| h.raster.width());
        plane[0] = if width >= 8 { value } else { value & (0xff00 >> width) as u8 };
        plane
    }

    /// `plane` by the shortest codec that needs no other frame, of those that the device reads.
    pub(super) fn coded(&self, plane: &[u8]) -> (Codec, Vec<u8>) {
        let mut out = vec![0; plane.len()];
        if self.reads(Codec::Rle) {
            // Shorter than the plane, as every coded plane must be.
            if let Some(n) = rle_encode(plane, &mut out).filter(|n| *n < plane.len()) {
                out.truncate(n);
                return (Codec::Rle, out);
            }
        }
        (Codec::Raw, plane.to_vec())
    }

    /// The next frame, for `slot`, whole and right. Its light ends two seconds after its slot.
    pub(super) fn shot(&mut self, slot: u64) -> R<Shot> {
        let slots = self.slots()?;
        let target = slots.start(slot).0;
        self.shot_at(slot, target)
    }

    /// The same for the instant `target`.
    pub(crate) fn shot_at(&mut self, slot: u64, target: u64) -> R<Shot> {
        let Some(config) = self.config else { return Err(Stop::Failed("not configured".into())) };
        let id = self.next_frame;
        self.next_frame = id.wrapping_add(1);
        self.frames_sent = self.frames_sent.wrapping_add(1);
        let pieces: Vec<Piece> = config
            .schedule
            .planes()
            .iter()
            .enumerate()
            .map(|(k, spec)| {
                let (codec, bytes) = self.coded(&self.faint((id as u8) ^ (k as u8) << 4 | 0x80));
                Piece { plane: k as u8, codec, led: spec.led_code(), target, bytes, damaged: false }
            })
            .collect();
        let commit = Commit {
            sent: u32::MAX >> (32 - pieces.len()),
            kept: 0,
            base_frame: 0,
            frames_sent: self.frames_sent,
            dark_from: DeviceTicks(target + 2 * self.tick_hz()),
        };
        Ok(Shot { id, slot, target, pieces, commit, commits: true })
    }

    /// Makes and sends the next frame, for `slot`.
    pub(super) fn send_for(&mut self, slot: u64) -> R<Shot> {
        let shot = self.shot(slot)?;
        self.send(&shot)?;
        Ok(shot)
    }

    /// Makes and sends the next frame, for a slot that is ahead.
    pub(super) fn send_ahead(&mut self) -> R<Shot> {
        let slot = self.slot_ahead()?;
        self.send_for(slot)
    }

    /// Sends it: all of it in one go, as a transfer carries a whole frame.
    pub(super) fn send(&mut self, shot: &Shot) -> R {
        self.send_as(self.session, Lane::Data, shot)
    }

    /// The same in another session or on another lane.
    pub(crate) fn send_as(&mut self, session: u32, lane: Lane, shot: &Shot) -> R {
        let header = |kind| Header {
            frame: shot.id,
            target_at: DeviceTicks(shot.target),
            ..Header::control(kind, session, 0)
        };
        let mut payload = [0u8; MAX_CONTROL_BYTES];
        let (kind, n) = HostMessage::Commit(shot.commit).write(&mut payload);
        let mut packets = Vec::new();
        for piece in &shot.pieces {
            let header = Header {
                codec: piece.codec,
                plane: piece.plane,
                led_code: piece.led,
                target_at: DeviceTicks(piece.target),
                payload_bytes: piece.bytes.len() as u32,
                ..header(MessageType::Plane)
            };
            packets.push(if piece.damaged {
                damaged_payload(&header, &piece.bytes)
            } else {
                Packet::new(header, &piece.bytes)
            });
        }
        if shot.commits {
            packets.push(Packet::new(header(kind), &payload[..n]));
        }
        self.send_packets(lane, &packets)
    }
}

/// A packet with a right header and a payload whose checksum is wrong.
pub(crate) fn damaged_payload<'a>(header: &Header, payload: &'a [u8]) -> Packet<'a> {
    let header = Header { payload_bytes: payload.len() as u32, ..*header };
    let pad = (4 - payload.len() % 4) % 4;
    let mut trailer = [0u8; 8];
    trailer[pad..pad + 4].copy_from_slice(&(crc32c(payload) ^ 0x0001_0000).to_le_bytes());
    Packet::from_raw(header.encode(), payload, &trailer[..pad + 4])
}

/// `header` with `value` at `at`, its checksum right again.
pub(crate) fn other_header(header: &Header, at: usize, value: u8) -> [u8; 32] {
    let mut bytes = header.encode();
    bytes[at] = value;
    let crc = crc32c(&bytes[..28]);
    bytes[28..].copy_from_slice(&crc.to_le_bytes());
    bytes
}

/// One LZ4 block of `plane`: its first byte, a match for the longest run after it, and the rest as it is.
pub(crate) fn lz4_block(plane: &[u8]) -> Vec<u8> {
    let length = |out: &mut Vec<u8>, mut n: usize| {
        while n >= 255 {
            out.push(255);
            n -= 255;
        }
        out.push(n as u8);
    };
    let mut out = Vec::new();
    // A run of one value from byte 1 on; the last five bytes of a block are literals, and a match begins 12 before its end.
    let run = plane.get(1).map_or(0, |v| plane[1..].iter().take_while(|b| *b == v).count());
    let matched = run.saturating_sub(1).min(plane.len().saturating_sub(2 + 12));
    let mut from = 0;
    if matched >= 4 {
        // Two literals, then the second over and over.
        let n = matched - 4;
        out.push(2 << 4 | n.min(15) as u8);
        out.extend(&plane[..2]);
        out.extend([1, 0]);
        if n >= 15 {
            length(&mut out, n - 15);
        }
        from = 2 + matched;
    }
    let rest = &plane[from..];
    out.push((rest.len().min(15) as u8) << 4);
    if rest.len() >= 15 {
        length(&mut out, rest.len() - 15);
    }
    out.extend(rest);
    out
}
