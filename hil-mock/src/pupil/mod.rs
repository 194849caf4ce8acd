//! Pupil Capture as a program sees it by its network interface: Pupil Remote, and the data of eyes that are made up.
//!
//! Reading order: [`eyes`] is what the eyes do, [`messages`] what Pupil says of it, [`host`] the two sockets.

pub mod eyes;
pub mod host;
pub mod messages;

#[cfg(test)]
mod tests;
