//! Shared parts of the end-to-end tests: the GPU with validation, requirements on pictures, rigs.

pub mod compare;
pub mod conversations;
pub mod decoders;
pub mod files;
pub mod gpu;
pub mod programs;
pub mod rigs;
pub mod sensor_wand;
