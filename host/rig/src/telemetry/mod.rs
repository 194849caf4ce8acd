//! Telemetry of a run, read by threads that are not on the frame path.

pub mod flight;
mod flight_page;
pub mod histogram_steps;
pub mod interval;
pub(crate) mod light_gauge;
pub mod light_state;
pub(crate) mod link_gauges;
pub mod live;
pub mod miss_log;
pub mod monitor;
pub mod notes;
mod ordered;
pub mod profile;
pub mod projector;
pub mod report;
mod report_table;
pub mod signed;
pub mod slots;
pub mod trace;
