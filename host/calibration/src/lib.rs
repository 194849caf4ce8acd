//! Calibration of a rig: what is measured into the numbers that put the light where it belongs.
//!
//! Light is right when `pixel = distort(K [R|t] T_WB(t_light) T_BM x_M)`. Each module finds a part of that: [`pivot`] the
//! tip of the wand, [`board`] the inside of a camera from a printed board,
//! [`beside`] the place of a camera beside another one, [`projector`] lens and pose from points that were aimed
//! at by hand, [`view`] the same from coded light before a camera, [`sensor`] the same (with tip and latency) from a light
//! sensor that moves through coded planes, [`body`] the place of a mesh in its tracked body,
//! [`light`] how bright a code value is where. [`mod@file`] keeps the results, and [`rehearsal`] judges all of it against a
//! drawn truth. [`check`] judges all of it by light on a body, and [`nudge`] corrects it by hand while the [`outline`] of a
//! body is shown. No module reads a device: samples come in, numbers or reasons come out.

pub mod beside;
pub mod board;
pub mod body;
pub mod check;
pub mod dense;
pub mod least_squares;
pub mod light;
pub mod nudge;
pub mod outline;
pub mod pinhole;
pub mod pivot;
pub mod projector;
pub mod rehearsal;
pub mod sensor;
pub mod trajectory;
pub mod view;

pub use dpm_calibration_file as file;
pub use dpm_calibration_file::model;
