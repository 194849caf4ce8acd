//! Poses over a serial line: COBS packets with CRC, for trackers on microcontrollers. The format is specified in
//! `docs/TRACKERS.md`; [`wire`] is its layout, [`client`] the tracker.

pub mod wire;

#[cfg(feature = "serial")]
pub mod client;
