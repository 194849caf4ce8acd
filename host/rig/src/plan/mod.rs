//! What is decided before a frame is drawn: how early it is begun, how far poses are predicted, how many rays it may cost.

pub mod budget;
pub mod dark;
pub mod frame;
pub mod horizon;
pub mod lead;
pub mod light_centre;
pub(crate) mod link_time;
