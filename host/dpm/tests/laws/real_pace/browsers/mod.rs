//! Pages of a rig in a real browser.

mod calibrate;
mod impostor;
mod page;
mod rigs;
