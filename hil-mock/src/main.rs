//! The command line: `hil-mock serve ...` offers this crate's devices to programs that do not know about it.

mod serve;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

#[derive(Parser)]
#[command(version, about = "Projectors and trackers made of software, for programs that expect hardware")]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Offers a mock device to other programs until stopped
    #[command(subcommand)]
    Serve(serve::Device),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Serve(device) => serve::run(device),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            serve::complain(format_args!("hil-mock: {error}"));
            ExitCode::FAILURE
        }
    }
}
