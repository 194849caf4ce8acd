//! Keys of a TOML file, each declared once with its type, unit, default, range and advice: read with their place in the file, checked, and
//! documented.
//!
//! [`section!`](crate::section), [`words!`](crate::words) and [`kinds!`](crate::kinds) declare them. Values come from a file, from the
//! environment and from flags, later ones over earlier ones. All mistakes are collected, each with its place.

mod declare;
mod error;
mod frame_rate;
pub mod read;
pub mod rows;
pub mod source;

pub use error::{ConfigError, ConfigErrors, Origin};
pub use frame_rate::RateBound;
