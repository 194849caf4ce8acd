//! Pages of a rig in a real browser.

mod calibrate;
mod page;
mod rigs;
