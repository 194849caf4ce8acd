//! The second tier: at real pace, with nothing beside it.

mod frame_path_sockets;
mod frame_path_usb;
mod frame_path_vulkan;
mod full_raster;
mod rates;
mod soak;
mod tutorial;
