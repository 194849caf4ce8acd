//! Vulkan, and the only place that names it: a device, buffers, compute pipelines, and command lists recorded once.
//!
//! Everything here runs headless on any Vulkan 1.2 device with scalar block layout, software ones included.
//!
//! A device may be lost, or hang. Then every call fails at once, everything can be dropped without waiting, and [`Gpu::reopen`] gives a
//! device to go on with: make the renderer and its slots anew on that one
//! ([`crate::Renderer::from_plan`]). [`LossBudget`] says when to stop trying. Drivers' calls that do
//! not return (a submission, the making of a device) can be left only with their thread, and such a process should end by `_exit`: what
//! drivers run at an orderly exit may wait for the very threads that hang.
#![allow(unsafe_code)]

mod address_space;
mod buffer;
mod commands;
mod context;
mod error;
mod loss;
mod pipeline;
mod reopen;

pub use buffer::{Buffer, MemoryKind};
pub(crate) use commands::run_now;
pub use commands::{CommandList, FrameFence, Recorder};
pub use context::{memory_given_up, validation_messages, DeviceSummary, Gpu, GpuOptions};
pub use error::{GpuError, MemoryPool};
pub use loss::{AfterLoss, LossBudget};
pub use pipeline::{BindingKind, BindingSet, BindingTable, ComputePipeline};
