//! Telemetry of a run, read by threads that are not on the frame path.

pub(crate) mod flight;
mod flight_page;
pub mod interval;
pub mod monitor;
mod ordered;
pub mod profile;
pub(crate) mod projector;
pub mod report;
mod report_table;
pub mod signed;
pub mod slots;
pub mod trace;
