//! The integration tests of this crate, in one program: one link, one row of costs.

mod albedo_on_gpu;
mod animation;
mod breadth;
mod calibration_display;
mod clips;
#[path = "../../../host/scene/tests/laws/common/mod.rs"]
mod common;
mod compensation_on_gpu;
mod corpora;
mod deforming;
mod doctor;
mod documents;
mod end_to_end;
mod error_runs;
mod eyes;
mod frame_law;
mod frame_path_calls;
mod gaze;
mod gpu_against_reference;
mod halftone_on_gpu;
mod leaving_out;
mod lens_on_gpu;
mod light_course;
#[path = "../../../host/dpm/tests/laws/link_common/mod.rs"]
mod link_common;
mod live_pictures;
mod many_bodies;
mod methods;
mod packing_on_gpu;
mod projector_kinds;
mod real_pace;
mod recoveries;
mod references;
mod rig_files;
mod scene_files;
mod security;
mod stability_on_gpu;
mod structure;
mod tracker_kinds;
mod tracks;
mod warp_on_gpu;
