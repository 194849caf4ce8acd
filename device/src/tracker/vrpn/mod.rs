//! VRPN trackers over TCP: decodes messages into samples, and (for the mock server) encodes samples as messages.
//!
//! Both sides greet with a 24-byte cookie, then exchange messages that carry numbers for senders and types. Each side
//! describes the meaning of its numbers in description messages. [`wire`] is the layout, [`client`] the protocol.

pub mod wire;

#[cfg(feature = "net")]
pub mod client;
