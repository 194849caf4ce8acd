//! CPU twins of shaders: the same operations in the same order, so that a shader's result can be compared bit for bit;
//! of the filter an oracle in f64.

pub mod compensation;
pub mod rate_map;
pub mod spatial_regression;
