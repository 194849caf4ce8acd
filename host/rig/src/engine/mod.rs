//! What decides in a run, free of threads, of clocks and of I/O of its own.
//!
//! Each part takes an instant and what has happened, and gives back what is to be done and when it wants to be asked again:
//!
//! - [`plan`]: which slot the next frame is for, and when its poses are read;
//! - [`pack`]: how long the GPU is waited for, and which frame is left out;
//! - [`link`]: when a frame is sent, what the operator ordered, the projector's clock, and how the light ends;
//! - [`supervision`]: who has fallen silent, and what is made anew.
//!
//! They share [`facts::Facts`], which are atomics. At real pace `pipeline` gives each part a thread; at virtual pace one thread drives all of
//! them under a clock that it moves. What differs between the two is [`pace::Pace`].

pub(crate) mod connect;
pub(crate) mod error;
pub(crate) mod facts;
pub(crate) mod keeper;
pub(crate) mod link;
pub(crate) mod options;
pub(crate) mod pace;
pub(crate) mod pack;
pub(crate) mod plan;
pub(crate) mod pulse;
pub(crate) mod supervision;

#[cfg(test)]
mod tests;
