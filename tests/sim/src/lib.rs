//! A simulated world around the rig: the real engine, tracking, link, orders and projector model, on one thread, under
//! one clock, from one seed. Everything else is made up, and hostile.
//!
//! Reading order: [`kinds`] names the faults and the states in which they strike; [`plan`] draws episodes from a seed;
//! [`world`] has the clock and moves everything; [`strike`] turns a fault into what happens in the world; [`laws`]
//! judges after every event; [`guard`] has the lives in which one guard stands alone; [`life`] runs one seed, and shrinks it if a law was broken.

pub mod cable;
mod calls;
pub mod dice;
pub mod disk;
pub mod eyes;
mod far;
pub mod follow;
pub mod guard;
pub mod kinds;
mod lag;
pub mod laws;
pub mod life;
pub mod line;
pub mod machine;
pub mod net;
pub mod plan;
pub mod port;
pub mod process;
pub mod strike;
mod strike_tracker;
pub mod table;
pub mod tracker_line;
pub mod tracker_stream;
pub mod tracks;
pub mod world;
