//! CPU twins of shaders: the same operations in the same order, so that a shader's result can be compared bit for bit.

pub mod compensation;
pub mod rate_map;
