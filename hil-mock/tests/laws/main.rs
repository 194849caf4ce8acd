//! The integration tests of this crate, in one program: one link, one row of costs.

mod allocation;
mod grammar;
mod hostile;
mod link_serial;
mod natnet;
mod natnet_clock;
mod natnet_common;
mod sensor_wand;
mod serial;
mod serve;
mod serve_projector;
mod vrpn;
