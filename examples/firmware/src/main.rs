//! A projector of 64 x 48 mirrors: bytes of a serial line into light.
//!
//! The rules of the protocol are `dpm_device::projector`, the same code as the mock projector. This file connects it to a
//! board, and `board.rs` is the board: an emulated one, with the five places that a real one replaces.
#![no_std]
#![no_main]

mod board;
mod heap;

use board::Board;
use cortex_m_rt::entry;
use dpm_device::cobs::{encode, encoded_bytes, Deframer};
use dpm_device::link::{packet_bytes, MessageType, MAX_CONTROL_BYTES};
use dpm_device::planes::Raster;
use dpm_device::projector::{FirmwareConfig, ProjectorFirmware};
use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};

/// The mirrors.
const RASTER: Raster = match Raster::new(64, 48) {
    Some(raster) => raster,
    None => panic!("both sides are 1 to 8192"),
};
/// The longest packet: a raw plane.
const PACKET: usize = packet_bytes(if RASTER.plane_bytes() > MAX_CONTROL_BYTES {
    RASTER.plane_bytes()
} else {
    MAX_CONTROL_BYTES
});
/// Bytes that one pass takes from the line at most, so that light is never long in coming, or in going.
const BYTES_A_PASS: usize = 64;

#[entry]
fn main() -> ! {
    let mut board = Board::start();
    let mut projector = ProjectorFirmware::new(FirmwareConfig {
        max_planes: 24,
        // Four frames may wait: with the three that are received, lit and referred to, seven times 9,216 bytes.
        frame_buffers: 4,
        min_plane_ns: board::MIN_PLANE_NS,
        settle_ns: board::SETTLE_NS,
        serial: board.serial(),
        // The newest slot says which plane is due; nobody asks for those before it.
        events_kept: 1,
        changes_kept: 0,
        ..FirmwareConfig::new(RASTER)
    });
    let mut line = Deframer::new([0; PACKET]);
    let mut replies = Replies::new();
    let mut slot_began = HostTime(0);
    loop {
        let now = board.now();
        // What must end the light at once, and keeps it off: heat, a broken lamp, the emergency stop.
        projector.set_faults(now, board.faults());
        let bytes = receive(&mut board, &mut projector, &mut line);

        projector.advance_to(board.now());
        while let Some(slot) = projector.next_light() {
            slot_began = slot.first_photon_at;
        }
        light(&mut board, &projector, slot_began);

        replies.send(&mut board, &mut projector);
        if bytes == 0 && replies.is_empty() {
            board.wait();
        }
    }
}

/// Bytes of the line into packets, and packets into the projector. Returns how many bytes there were.
fn receive<const N: usize>(
    board: &mut Board,
    projector: &mut ProjectorFirmware,
    line: &mut Deframer<[u8; N]>,
) -> usize {
    for count in 0..BYTES_A_PASS {
        let Some(byte) = board.read() else { return count };
        line.push(&[byte], &mut |packet| {
            // An ECHO is stamped with the time at which its last byte has arrived.
            let now = board.now();
            use MessageType::{FrameCommit, Plane, Sync};
            let kind = packet.get(5).copied().and_then(MessageType::from_code);
            let is_data = matches!(kind, Some(Plane | FrameCommit | Sync));
            let lane = if is_data { Lane::Data } else { Lane::Control };
            projector.receive(now, lane, packet);
            // A frame of the line that ends early holds half a packet, which nothing may complete.
            projector.end_of_transfer(now, lane);
        });
    }
    BYTES_A_PASS
}

/// The plane that is due now, onto the mirrors; dark where the projector says so. The planes of a slot share it equally.
fn light(board: &mut Board, projector: &ProjectorFirmware, slot_began: HostTime) {
    let lit = projector.lit_frame().filter(|_| projector.is_lit());
    let (Some(frame), Some(planes), Some((_, schedule, rate))) =
        (lit, projector.lit_planes(), projector.configured())
    else {
        return board.dark();
    };
    let since = board.now().ns_since(slot_began);
    let Ok(since) = u64::try_from(since) else { return board.dark() };
    let slot_ns = 1_000_000_000 * u64::from(rate.den()) / u64::from(rate.num());
    let plane = (since * schedule.len() as u64 / slot_ns.max(1)) as usize;
    match (schedule.planes().get(plane), planes.chunks(RASTER.plane_bytes()).nth(plane)) {
        (Some(spec), Some(mirrors)) => board.light(frame, plane as u8, *spec, mirrors),
        // The slot is over, and the next one has not begun.
        _ => board.dark(),
    }
}

/// Replies that the line has not taken yet. While there are some no new ones are made: an older STATUS never delays a newer
/// one, and an ECHO is stamped when it can leave.
struct Replies {
    bytes: [u8; 4096],
    sent: usize,
    len: usize,
}

impl Replies {
    const fn new() -> Self {
        Self { bytes: [0; 4096], sent: 0, len: 0 }
    }

    const fn is_empty(&self) -> bool {
        self.sent == self.len
    }

    /// Writes as much as the line takes now.
    fn send(&mut self, board: &mut Board, projector: &mut ProjectorFirmware) {
        if self.is_empty() {
            (self.sent, self.len) = (0, 0);
            projector.replies(board.now(), &mut |_, packet| {
                // Sixteen ECHOes, HELLO, FAULTs and STATUS fit.
                if self.bytes.len() - self.len >= encoded_bytes(packet.len()) {
                    self.len += encode(&[packet], &mut self.bytes[self.len..]).unwrap_or(0);
                }
            });
        }
        while !self.is_empty() && board.write(self.bytes[self.sent]) {
            self.sent += 1;
        }
    }
}
