//! OptiTrack NatNet 3.0 to 4.2 over UDP: decodes datagrams into samples, and (for the mock server) encodes samples as
//! datagrams.
//!
//! The layout is little-endian and unframed; `docs/TRACKERS.md` describes the client's rules. [`wire`] reads and writes
//! single values, [`messages`] the handshake, [`frame`] poses, [`models`] names; [`client`] runs the protocol.

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
