//! A `FramePlan` into radiance: what the shaders compute, and the tables and CPU twins they share.

pub mod albedo_table;
pub mod compensation;
