//! Calibration of a rig: what is measured into the numbers that put the light where it belongs.
//!
//! Light is right when `pixel = distort(K [R|t] T_WB(t_light) T_BM x_M)`. Each module finds a part of that: [`pivot`] the
//! tip of the wand, [`projector`] lens and pose from points that were aimed at by hand, [`sensor`] the same (with tip
//! and latency) from a light sensor that moves through coded planes, [`body`] the place of a mesh in its tracked body,
//! [`light`] how bright a code value is where. [`file`] keeps the results, and [`rehearsal`] judges all of it against a
//! drawn truth. No module reads a device: samples come in, numbers or reasons come out.

pub mod body;
mod dense;
pub mod file;
mod least_squares;
pub mod light;
pub mod model;
pub mod pinhole;
pub mod pivot;
pub mod projector;
pub mod rehearsal;
pub mod sensor;
pub mod trajectory;
