//! Space in f64: rigid motions (SE(3)) and cameras.

pub mod projector;
pub mod se3;
