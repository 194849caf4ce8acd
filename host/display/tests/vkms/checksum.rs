//! The kernel's checksum of every frame that it scans out.

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::sync::mpsc::{channel, Receiver};
use std::time::Instant;

use crate::rig::{CRC, PATIENCE};

/// The checksum that the kernel computes of a picture: CRC-32 without its inversions, over pixels of 16 bits for each of
/// alpha, red, green and blue (drivers/gpu/drm/vkms/vkms_composer.c).
pub(crate) fn checksum(pixels: &[u8]) -> u32 {
    let mut crc = 0u32;
    let mut push = |byte: u8| {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
        }
    };
    for pixel in pixels.chunks_exact(4) {
        // Little-endian words of alpha, red, green, blue; eight bits become sixteen by repeating them.
        for byte in [0xff, pixel[2], pixel[1], pixel[0]] {
            push(byte);
            push(byte);
        }
    }
    crc
}

/// The kernel's checksums from now on: the count of the blank, and the sum.
pub(crate) fn checksums() -> Receiver<(u32, u32)> {
    File::options().write(true).open(format!("{CRC}/control")).unwrap().write_all(b"auto").unwrap();
    let data = BufReader::new(File::open(format!("{CRC}/data")).expect("the kernel's checksums"));
    let (tell, told) = channel();
    std::thread::spawn(move || {
        for line in data.lines().map_while(Result::ok) {
            // The kernel ends each line with a newline and a zero.
            let line = line.trim_matches('\0');
            let mut words =
                line.split_whitespace().map(|w| u32::from_str_radix(w.trim_start_matches("0x"), 16));
            let (Some(Ok(frame)), Some(Ok(sum))) = (words.next(), words.next()) else { continue };
            if tell.send((frame, sum)).is_err() {
                break;
            }
        }
    });
    told
}

/// The next checksums until `wanted`, within the patience. Returns how many were looked at.
pub(crate) fn wait_for(told: &Receiver<(u32, u32)>, what: &str, wanted: impl Fn(u32) -> bool) -> u32 {
    let limit = Instant::now() + PATIENCE;
    let mut looked = 0;
    loop {
        let left = limit.saturating_duration_since(Instant::now());
        let (_, sum) = told.recv_timeout(left).unwrap_or_else(|e| panic!("{what}: {e}"));
        looked += 1;
        if wanted(sum) {
            return looked;
        }
    }
}
