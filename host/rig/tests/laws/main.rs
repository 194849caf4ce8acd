//! The integration tests of this crate, in one program: one link, one row of costs.

mod frame_path_allocates_nothing;
mod real_pace;
mod tracker_losses;
