//! VRPN trackers over TCP: messages into samples, and (for the mock server) samples into messages.
//!
//! Both sides greet with a 24-byte cookie, then exchange messages that carry numbers for senders and types; what a number means is
//! told by description messages of the side that uses it. [`wire`] is the layout, [`client`] the conversation.

pub mod wire;

#[cfg(feature = "net")]
pub mod client;
