//! The integration tests of this crate, in one program: one link, one row of costs.

mod barriers;
mod common;
mod control;
mod failing_calls;
mod real_pace;
mod renderer;
