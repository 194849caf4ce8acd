//! OptiTrack NatNet 3.0 to 4.2 over UDP: datagrams into samples, and (for the mock server) samples into datagrams.
//!
//! The layout is little-endian and unframed; what is known about it, and from where, stands in `docs/TRACKERS.md`.
//! [`wire`] reads and writes single values, [`messages`] the handshake, [`frame`] poses, [`models`] names; [`client`] holds the
//! conversation.

pub mod frame;
pub mod messages;
pub mod models;
pub mod wire;

#[cfg(feature = "net")]
pub mod client;
#[cfg(feature = "net")]
mod clock;
#[cfg(feature = "net")]
mod report;

pub use wire::{Version, WireError};

#[cfg(test)]
mod golden_tests;
