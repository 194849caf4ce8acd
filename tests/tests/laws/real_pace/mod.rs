//! The second tier: at real pace, with nothing beside it.

mod calibration;
mod dlpc900_light;
mod dlpc900_motion;
mod frame_path;
mod frame_path_sockets;
mod frame_path_usb;
mod frame_path_vulkan;
mod full_raster;
mod gaze;
mod own_process;
mod rates;
mod ray_query;
mod soak;
mod tutorial;
