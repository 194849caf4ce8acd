//! Vulkan, and the only place that names it: a device, buffers, compute pipelines, and command lists recorded once.
//!
//! Everything here runs headless on any Vulkan 1.2 device with scalar block layout, software ones included.
//!
//! A device may be lost, or hang. Then every call fails at once, and everything can be dropped without waiting. [`Gpu::reopen`] opens a device
//! on which the renderer and its slots can be made again ([`crate::Renderer::from_plan`]). [`LossBudget`] decides when to stop trying. A call of a
//! driver that does not return (a submission, the creation of a device) can only be abandoned together with its thread. Such a process should end
//! by `_exit`, because what drivers run at an orderly exit may wait for the threads that hang.
#![allow(unsafe_code)]

mod acceleration;
mod address_space;
mod buffer;
mod commands;
mod context;
mod devices;
mod error;
mod instance;
mod kept;
mod leftovers;
mod loss;
mod manifests;
mod overlap;
mod pipeline;
mod relay;
mod reopen;
mod statistics;
mod turn;

pub(crate) use acceleration::{triangle_buffer, BodyTrees, BodyTriangles, FrameTree};
pub use buffer::{Buffer, MemoryKind, MemoryPlace};
pub(crate) use commands::run_now;
pub use commands::{CommandList, FrameFence, Recorder};
pub use context::{memory_given_up, Gpu, GpuOptions};
pub use devices::DeviceSummary;
pub use error::{GpuError, MemoryPool};
pub use instance::validation_messages;
pub use leftovers::devices_unfinished;
pub use loss::{AfterLoss, LossBudget};
pub(crate) use overlap::{submit_frame, FrameOrder, Orders, Overlap};
pub use pipeline::{shared_bindings, BindingKind, BindingSet, BindingTable, ComputePipeline};
pub(crate) use relay::Relay;
pub use statistics::Executable;
