//! What the end-to-end tests share: small scenes made by code, and frames drawn by the GPU under validation.

pub mod compare;
pub mod gpu;
pub mod rigs;
pub mod scenes;
pub mod statistics;
