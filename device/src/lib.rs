//! The far side of the cable.
//!
//! Wire formats (bit-plane link, NatNet, VRPN, serial poses) as `no_std` code that firmware can reuse, and behind the
//! features `usb`, `serial` and `net` the transports, projectors and trackers that speak them.
//!
//! Reading order: [`time`] and [`pose`] and [`planes`] are the vocabulary; [`tracker`] is where motion comes in.
//! **Only this crate knows bytes on a wire.** Nothing here knows about scenes, rendering or the GPU.
//!
//! # Example: what firmware does with the host's bytes
//!
//! A [`link::Decoder`] finds packets in a stream, however the stream is cut, and reports them to a
//! [`link::PacketSink`]. Neither allocates.
//!
//! ```
//! use dpm_device::link::{Assembly, Decoder, Header, HostHello, HostMessage, Packet, PacketSink, MAX_CONTROL_BYTES};
//!
//! /// Keeps the last message of the host.
//! #[derive(Default)]
//! struct Firmware {
//!     incoming: Option<Assembly>,
//!     heard: Option<HostMessage>,
//! }
//!
//! impl PacketSink for Firmware {
//!     fn begin(&mut self, header: &Header) -> bool {
//!         self.incoming = Assembly::new(header);
//!         self.incoming.is_some()
//!     }
//!     fn payload(&mut self, bytes: &[u8]) {
//!         self.incoming.as_mut().expect("a packet has begun").push(bytes);
//!     }
//!     fn end(&mut self, intact: bool) {
//!         let Some(packet) = self.incoming.take().filter(|_| intact) else { return };
//!         self.heard = HostMessage::parse(packet.header().kind, packet.payload()).ok();
//!     }
//! }
//!
//! // The host greets the device in session 7.
//! let hello = HostMessage::Hello(HostHello { version_min: 2, version_max: 2, codecs: 1 });
//! let mut payload = [0; MAX_CONTROL_BYTES];
//! let (kind, n) = hello.write(&mut payload);
//! let bytes = Packet::new(Header::control(kind, 7, 0), &payload[..n]).to_vec();
//!
//! // Its bytes arrive in small pieces, behind some noise.
//! let (mut decoder, mut firmware) = (Decoder::new(), Firmware::default());
//! decoder.push(b"noise on the line", &mut firmware);
//! for piece in bytes.chunks(5) {
//!     decoder.push(piece, &mut firmware);
//! }
//! assert_eq!(firmware.heard, Some(hello));
//! ```
#![cfg_attr(not(feature = "std"), no_std)]

#[cfg(feature = "alloc")]
extern crate alloc;

pub mod clock_map;
pub mod cobs;
pub mod light;
#[cfg(feature = "serial")]
mod line;
pub mod link;
mod packet;
pub mod picture_stream;
pub mod planes;
pub mod pose;
#[cfg(feature = "alloc")]
pub mod projector;
#[cfg(feature = "std")]
pub mod regular_file;
#[cfg(feature = "std")]
pub mod rng;
pub mod sensor;
#[cfg(feature = "std")]
mod stream;
pub mod tag36h11;
pub mod time;
#[cfg(feature = "std")]
pub mod tracker;
#[cfg(feature = "alloc")]
pub mod transport;
#[cfg(feature = "serial")]
pub mod tty;
#[cfg(feature = "usb")]
pub mod usb_help;
