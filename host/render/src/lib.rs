//! Frame inputs into code values and bit planes: what the shaders compute, and the tables and CPU twins that they share.

pub mod blue_noise;
mod body_bvh;
mod cluster;
pub mod compensation;
mod fill;
mod frame_buffers;
pub mod gpu;
mod last_frame;
mod memory;
pub mod method;
pub mod pack;
mod passes;
pub mod rate_map;
mod renderer;
pub mod scene_data;
mod scene_gpu;
mod slot;
pub mod tiles;

pub use passes::PASSES;
pub use renderer::{FrameInputs, Output, RenderError, Renderer, RendererSettings};
pub use scene_data::Keep;
pub use slot::{FrameCost, FrameSlot};
