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

/// A [`MockProjector`] on a serial line.
#[derive(Debug)]
pub struct SerialProjector {
    projector: MockProjector,
    deframer: Deframer<Vec<u8>>,
    out: Vec<u8>,
}

impl SerialProjector {
    /// Connects `projector` to a line.
    pub fn new(projector: MockProjector) -> Self {
        let plane = projector.core.setup.raster.plane_bytes().max(MAX_CONTROL_BYTES);
        Self { deframer: Deframer::new(vec![0; packet_bytes(plane)]), projector, out: Vec::new() }
    }

    /// The projector inside.
    pub fn projector(&mut self) -> &mut MockProjector {
        &mut self.projector
    }

    /// Bytes from the line.
    pub fn receive(&mut self, now: HostTime, bytes: &[u8]) {
        let Self { projector, deframer, .. } = self;
        deframer.push(bytes, &mut |frame| {
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
    pub fn replies(&mut self, now: HostTime) -> &mut Vec<u8> {
        let Self { projector, out, .. } = self;
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
