//! Vulkan, and the only place that names it: a device, buffers, compute pipelines, and command lists recorded once.
//!
//! Everything here runs headless on any Vulkan 1.1 device with scalar block layout, software ones included.
#![allow(unsafe_code)]

mod buffer;
mod commands;
mod context;
mod error;
mod pipeline;

pub use buffer::{Buffer, MemoryKind};
pub use commands::{CommandList, FrameFence, Recorder};
pub use context::{validation_messages, DeviceSummary, Gpu, GpuOptions};
pub use error::GpuError;
pub use pipeline::{BindingKind, BindingSet, BindingTable, ComputePipeline};
