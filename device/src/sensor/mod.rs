//! A light sensor on a serial line: blocks of samples with the sensor's own clock. docs/PROTOCOL.md section 13 is the
//! contract, docs/SENSOR.md says how to build one.
//!
//! [`wire`] has the messages, [`device`] the sensor's side for firmware; neither needs an operating system or
//! allocates. [`client`] is the host's side: it opens the port, maps the sensor's clock, and counts what is lost.

#[cfg(feature = "serial")]
pub mod client;
pub mod device;
pub mod wire;
