//! The second tier: breadth and repetition of what the commit tier holds once.

mod calibration;
mod dlpc900_light;
mod dlpc900_motion;
mod equal_work;
mod every_case;
mod frame_path;
mod large_rasters;
mod ray_query;
mod subgroup_widths;
mod turns;
