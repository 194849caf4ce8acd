//! Words into calls: the command line of `dpm`. One file per command, no logic of its own.

mod bench;
mod dlpc900;
mod doctor;
mod error;
mod error_experiments;
mod error_files;
mod keys;
mod link_test;
mod order;
mod os;
mod plan;
mod profile;
mod progress;
mod record;
mod rig_args;
pub mod run;
pub mod signals;
mod snapshot;
mod stability;
mod tell;
mod watch;

use clap::{ColorChoice, CommandFactory, FromArgMatches, Parser, Subcommand};
use dpm_rig::failure::Failure;
use dpm_rig::order::Order;
use std::io::Write;
use std::process::ExitCode;

/// Rig controller for path-traced dynamic projection mapping.
#[derive(Debug, Parser)]
#[command(name = "dpm", version, about = ABOUT, after_help = AFTER_HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const ABOUT: &str =
    "Lights moving objects: from a tracker's samples through path tracing to a projector's bit planes.";

const AFTER_HELP: &str = "Exit codes: 0 ok, 1 a check failed, 2 usage or bad input, 3 device, 4 no GPU.
Every key of the rig file can be set by --set a.b=c or by the environment variable DPM_SET_A__B=c.";

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the built-in scene of two moving objects against the embedded mock projector and tracker
    Demo(run::DemoArgs),
    /// Run a rig file
    Run(run::RunArgs),
    /// Measure what the link to the projector carries of this rig's pictures, and the frame rate that allows
    LinkTest(link_test::LinkTestArgs),
    /// Make the projectors of all running rigs dark, or of one; the rigs go on
    ///
    /// Dark until `dpm arm` or the orderly end of the run; a run that dies leaves it standing for the next one. Prints whose rigs were
    /// reached and how each projector is. Exit code 0 only when every one confirmed. Where a rig does not answer within 20 ms the order
    /// goes to it as the signal USR1, which needs no thread of it but its link's.
    Black(order::OrderArgs),
    /// Hold the frame that the projector of a running rig shows
    ///
    /// Until `dpm arm`, `dpm black` or `dpm safe`. Exit code 0 only when the projector confirmed.
    Freeze(order::OrderArgs),
    /// Make the projectors of all running rigs dark, or of one, and latch it over restarts until `dpm arm`
    ///
    /// Latched in the projector and in the state folder: the next run of that projector, after a crash, a restart of the service or of the
    /// machine, comes up dark. Exit code 0 only when every projector confirmed and the order is on the disk. Where a rig does not answer
    /// within 20 ms the order goes to it as the signal USR2.
    Safe(order::OrderArgs),
    /// Let light through again after black, freeze, safe or a fault, which this acknowledges
    ///
    /// Only a running rig can be armed. What stands in the state folder is forgotten first, then the light comes. Where several rigs run,
    /// name one with --pid.
    #[command(visible_alias = "resume")]
    Arm(order::OrderArgs),
    /// Record what a rig's tracker says into a file that `tracker.kind = "replay"` plays
    Record(record::RecordArgs),
    /// Measure where the time between motion and light goes
    Profile(profile::ProfileArgs),
    /// Say what this machine can do, and what to do about what is missing
    Doctor(doctor::DoctorArgs),
    /// Run stiff and extreme cases: measured error against bound, with the oracle of each
    Stability(stability::StabilityArgs),
    /// Write everything that one frame was made from as pictures: rates, errors, samples, history, motion, light
    Snapshot(snapshot::SnapshotArgs),
    /// Measure rays, samples and milliseconds by pass of every method on this device
    Bench(bench::BenchArgs),
    /// Measure error against cost of every method: perceived error, bias, noise and flicker at equal rays
    Error(error::ErrorArgs),
    /// Say what a rig needs of the renderer, what is left out, why, how, and with --measure what that saves
    Plan(plan::PlanArgs),
    /// Control a DLPC900 projector (LightCrafter 6500 / 9000): status, patterns, rest
    Dlpc900(dlpc900::Dlpc900Args),
}

/// Runs the program with the process's arguments. `commit`: what it was compiled from, see [`dpm_common::commit::get`].
pub fn main(commit: &'static str) -> ExitCode {
    dpm_common::commit::set(commit);
    // https://no-color.org: set and not empty.
    let plain = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
    // Once in the life of the process; the parser keeps it for as long.
    let version: &'static str = format!("{} ({commit})", env!("CARGO_PKG_VERSION")).leak();
    let command =
        Cli::command().version(version).color(if plain { ColorChoice::Never } else { ColorChoice::Auto });
    let parsed = command.try_get_matches().and_then(|m| Cli::from_arg_matches(&m));
    let cli = match parsed {
        Ok(cli) => cli,
        Err(e) => {
            // Help and version are such "errors" too, with exit code 0.
            let _ = e.print();
            return ExitCode::from(u8::try_from(e.exit_code()).unwrap_or(2));
        }
    };
    let code = match dispatch(&cli.command) {
        Ok(()) => 0,
        Err(failure) => {
            let _ = writeln!(std::io::stderr(), "error: {failure}");
            failure.kind.exit_code()
        }
    };
    if dpm_rig::pipeline::has_left_threads_behind() {
        // Destructors of drivers could wait for a thread that hangs.
        let _ = std::io::stdout().flush();
        os::leave(code);
    }
    ExitCode::from(code)
}

fn dispatch(command: &Command) -> Result<(), Failure> {
    match command {
        Command::Demo(args) => run::execute_demo(args),
        Command::Run(args) => run::execute(args),
        Command::LinkTest(args) => link_test::execute(args),
        Command::Black(args) => order::execute(args, Order::Black),
        Command::Freeze(args) => order::execute(args, Order::Freeze),
        Command::Safe(args) => order::execute(args, Order::Safe),
        Command::Arm(args) => order::execute(args, Order::Arm),
        Command::Record(args) => record::execute(args),
        Command::Profile(args) => profile::execute(args),
        Command::Doctor(args) => doctor::execute(args),
        Command::Stability(args) => stability::execute(args),
        Command::Snapshot(args) => snapshot::execute(args),
        Command::Bench(args) => bench::execute(args),
        Command::Error(args) => error::execute(args),
        Command::Plan(args) => plan::execute(args),
        Command::Dlpc900(args) => dlpc900::execute(args),
    }
}
