//! Rigid motions and cameras in f64.

pub mod se3;
