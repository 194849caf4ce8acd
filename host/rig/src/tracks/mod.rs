//! What the tracker says, into the tracks of all bodies.

pub(crate) mod source;
