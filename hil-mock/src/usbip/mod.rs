//! USB/IP: serves any device model to a kernel's `vhci_hcd` over TCP or a socket pair, and uses a server's devices
//! without a kernel.
//!
//! On the machine that is to see the device: `modprobe vhci-hcd`, then `usbip attach -r HOST -b 1-1`.

mod client;
mod server;
pub mod wire;

pub use client::{list, RemoteCable};
pub use server::{serve, serve_imported, Export, Link, Server};

#[cfg(test)]
mod tests;
