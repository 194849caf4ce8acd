//! Frame inputs into code values and bit planes: what the shaders compute, and the tables and CPU twins that they share.
//!
//! # Example: code values into bit planes, without a GPU
//!
//! ```
//! use dpm_device::planes::{PlaneSchedule, Raster};
//! use dpm_render::pack::{pack, unpack, BitPlaneFrame, Kernel};
//!
//! let raster = Raster::new(64, 48).expect("sides in range");
//! let codes: Vec<u32> = (0..raster.pixel_count() as u32).map(|i| i * 1001 & 0x00ff_ffff).collect();
//! let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
//! pack(Kernel::best(), &codes, &mut planes);
//!
//! let mut back = vec![0; codes.len()];
//! unpack(&planes, &mut back);
//! assert_eq!(back, codes, "nothing is lost");
//! ```

pub mod albedo_map;
mod apart;
pub mod blue_noise;
mod body_tree;
mod deformed;
mod deforming_body;
pub mod drive;
mod fill;
mod frame_buffers;
pub mod gpu;
mod last_frame;
mod live_textures;
mod memory;
pub mod method;
mod optics;
pub mod pack;
mod passes;
mod plan;
mod prepared;
pub mod rate_table;
mod read_back;
mod renderer;
mod resources;
mod scale;
pub mod scene_data;
mod scene_gpu;
mod scene_needs;
mod settings;
mod slot;
pub mod tiles;
mod walk_alone;
pub mod walker;
pub mod warp;

pub use memory::least_memory_bytes;
pub use passes::{traffic, Traffic, PASSES};
pub use plan::{trace_groups, Program, RendererPlan};
pub use prepared::PreparedScene;
pub use read_back::{Guide, History, Surface};
pub use renderer::Renderer;
pub use scale::{reduced, Scale, LADDER};
pub use scene_data::Keep;
pub use settings::{
    FrameInputs, Output, Overlapping, RayWalk, RayWalker, RenderError, RendererSettings, Tracing,
};
pub use slot::{FrameCost, FrameSlot};
