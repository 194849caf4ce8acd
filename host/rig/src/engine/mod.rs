//! The decisions of a run, without threads, clocks or I/O of their own.
//!
//! Each part takes an instant and what has happened. It returns what to do and when to ask again:
//!
//! - [`plan`]: which slot the next frame is for, and when its poses are read;
//! - `cadence`: how many slots a frame gets;
//! - [`pack`]: how long to wait for the GPU, and which frame to leave out;
//! - `genlock`: by how much slots are shifted, to keep step with the tracker;
//! - [`follow`]: what a projector that can move parts of a frame is told of the bodies meanwhile;
//! - [`link`]: when a frame is sent, the operator's orders, the projector's clock, and how the light ends;
//! - [`supervision`]: which thread has fallen silent, and what is restarted.
//!
//! The parts share [`facts::Facts`], which are atomics. At real pace `pipeline` gives each part a thread. At virtual
//! pace one thread drives all parts under a clock that it moves. [`pace::Pace`] defines the differences between the
//! two.

mod cadence;
pub(crate) mod connect;
pub(crate) mod error;
pub(crate) mod facts;
pub(crate) mod follow;
mod genlock;
pub(crate) mod keeper;
pub(crate) mod link;
pub(crate) mod options;
pub(crate) mod pace;
pub(crate) mod pack;
pub(crate) mod plan;
pub(crate) mod pulse;
mod queue;
mod reported_light;
mod slack;
mod slowness;
pub(crate) mod supervision;

#[cfg(test)]
mod tests;
