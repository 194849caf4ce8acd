//! Runs that answer a question: each is a command and a test.

pub mod bench;
pub mod conformance;
pub mod error_export;
pub mod error_figure3;
pub mod error_parts;
pub mod error_plan;
pub mod error_plot;
pub mod error_reference;
pub mod error_report;
pub mod error_runs;
pub mod error_sheet;
pub mod error_table;
pub mod error_verdict;
pub mod link_test;
pub mod median;
pub mod pictures;
pub mod plan_savings;
pub mod profile;
pub mod run_dlpc900;
pub mod run_rig;
pub mod scene_plan;
pub mod sequence;
pub mod snapshot;
pub mod stability;
pub mod stamp;
