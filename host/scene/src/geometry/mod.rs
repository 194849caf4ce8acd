//! Space in f64: rigid motions (SE(3)), cameras and their calibration.

pub mod lens;
pub mod opencv;
pub mod projector;
