//! Space in f64: rigid motions (SE(3)), cameras, lenses and calibration files.

pub mod lens;
pub mod projector;
