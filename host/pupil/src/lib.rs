//! Gaze from Pupil Core: the network interface of Pupil Capture and Pupil Service.
//!
//! Reading order: [`zmtp`] turns a stream of bytes into messages of ZeroMQ and back, [`msgpack`] reads and writes their
//! payloads, [`gaze`] is what one message says of the eyes, [`client`] holds the connection, asks for the clock and
//! maps every sample to the host's time.
//!
//! Both codecs are written here: the packages that speak ZeroMQ without its C++ library bring an asynchronous runtime
//! with dozens of packages and take frames of any length, and of ZMTP only the NULL mechanism, REQ and SUB are needed.

pub mod client;
pub mod gaze;
pub mod msgpack;
pub mod zmtp;

#[cfg(test)]
mod tests;
