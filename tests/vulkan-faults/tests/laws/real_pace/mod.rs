//! The second tier: at real pace, with nothing beside it.

mod other_device;
mod whole_rig;
