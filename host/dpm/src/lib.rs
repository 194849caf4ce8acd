//! The program `dpm`: the rig controller and its tools on the command line.

// What only a satellite or the bar of a terminal calls is dead in a program without it.
#![cfg_attr(not(all(feature = "satellites", feature = "terminal")), allow(dead_code))]

pub mod cli;
mod keep_parameters;
mod notify;
pub mod satellites;
