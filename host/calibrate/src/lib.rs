//! `dpm calibrate`: the operator's side of calibration. The solvers are in the crate `dpm-calibration`; here the tracker is
//! read, crosses are shown, the operator is told what to do next, and results go into the calibration file.

pub mod aim;
pub mod beside;
pub mod body;
pub mod camera;
pub mod check;
mod codes;
pub mod dialogue;
pub mod levels;
pub mod light;
pub mod lines;
pub mod nudge;
pub mod outline;
pub mod pace;
pub mod parts;
pub mod poses;
pub mod projector;
pub mod recorder;
pub mod sensor;
pub mod showing;
pub mod shown;
pub mod view;
pub mod wand;
