//! The second tier: at real pace, with nothing beside it.

mod attack;
mod events;
mod rigs;
