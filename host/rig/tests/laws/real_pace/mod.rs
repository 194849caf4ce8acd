//! The second tier: at real pace, with nothing beside it.

mod stall;
