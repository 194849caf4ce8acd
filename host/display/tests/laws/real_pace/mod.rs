//! The second tier: at real pace, with nothing beside it.

mod dlpc900;
mod transport;
#[cfg(feature = "x11")]
mod windows;
