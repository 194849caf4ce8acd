//! Decisions before a frame is drawn: how early it begins, how far poses are predicted, and how many rays it may
//! cost.

pub mod beat;
pub mod budget;
pub mod dark;
pub mod eyes;
pub mod frame;
pub mod horizon;
pub mod lead;
pub(crate) mod light_centre;
pub mod light_course;
pub(crate) mod link_time;
pub mod scale;
