//! What the end-to-end tests share: the GPU under validation, demands on pictures, rigs.

pub mod compare;
pub mod conversations;
pub mod decoders;
pub mod gpu;
pub mod rigs;
