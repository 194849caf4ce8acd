//! The second tier: at real pace, with nothing beside it.

mod alp;
mod browsers;
mod camera;
mod cli_profile;
mod conformance;
mod dlpc900;
mod gpu_faults;
mod hangs;
mod light_word;
mod record;
mod run_limits;
mod run_orders;
mod run_serial;
mod run_usb;
mod set;
mod standing;
mod stop;
