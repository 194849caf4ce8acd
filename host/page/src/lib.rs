//! The live page of a running rig.
//!
//! A small HTTP server on an address of this machine shows what the rig does, takes the orders BLACK, FREEZE, SAFE and
//! ARM from whoever proves to know a secret ([`proof`]), and tells its figures to Prometheus. `docs/PAGE.md` describes it for operators.
//!
//! Another page shows several rigs at once, from what the servers of their own pages tell ([`rigs`]).
//!
//! It runs on threads of its own. From the run it takes what [`dpm_rig::telemetry::monitor::RunMonitor`] shows to
//! every observer, and it gives orders as the control socket does, through [`dpm_rig::control::orders::Orders`].

pub mod calibration;
mod connections;
mod events;
mod guard;
mod hex;
pub mod metrics;
mod orders;
mod parameters;
mod pictures;
pub mod probe;
pub mod proof;
mod query;
pub mod rigs;
mod room;
mod routes;
mod server;
mod shared;
mod site;
mod state;
mod stream;
pub mod token;

pub use guard::{NUMBER, ORDER, PROOF};
pub use server::{Page, PageError, Settings};
