//! The command line of `dpm`: a file for each command, and what runs share. What stands beside the controller is a feature.

#[cfg(feature = "lab")]
mod bench;
#[cfg(feature = "calibrate")]
mod calibrate;
#[cfg(feature = "manual")]
mod completion;
#[cfg(feature = "display")]
mod display;
mod doctor;
#[cfg(feature = "lab")]
mod error;
#[cfg(feature = "lab")]
mod error_experiments;
#[cfg(feature = "lab")]
mod error_files;
mod guard;
#[cfg(feature = "page")]
mod guide;
mod keys;
#[cfg(feature = "lab")]
mod link_test;
#[cfg(feature = "page")]
mod live_page;
#[cfg(not(feature = "page"))]
#[path = "no_page.rs"]
mod live_page;
#[cfg(feature = "manual")]
mod manual;
mod order;
mod os;
mod osc;
#[cfg(feature = "page")]
mod page;
mod pattern;
#[cfg(feature = "lab")]
mod plan;
mod profile;
#[cfg(feature = "lab")]
mod progress;
mod record;
#[cfg(feature = "lab")]
mod rehearse;
#[cfg(feature = "lab")]
mod report;
mod rig_args;
#[cfg(feature = "page")]
mod rigs;
pub mod run;
#[cfg(feature = "lab")]
mod scene;
#[cfg(feature = "page")]
mod session;
mod set;
#[cfg(feature = "lab")]
mod snapshot;
#[cfg(feature = "lab")]
mod stability;
mod tell;
mod watch;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use dpm_rig::failure::Failure;
use dpm_rig::order::Order;
use std::any::TypeId;
use std::io::Write;
use std::process::ExitCode;

/// Rig controller for path-traced dynamic projection mapping.
#[derive(Debug, Parser)]
#[command(name = "dpm", version, about = ABOUT, after_help = AFTER_HELP)]
struct Cli {
    #[command(subcommand)]
    command: CliCommand,
}

const ABOUT: &str =
    "Lights moving objects: from a tracker's samples through path tracing to a projector's bit planes.";

const AFTER_HELP: &str = "Exit codes: 0 ok, 1 a check failed, 2 usage or bad input, 3 device, 4 no GPU.
Every key of the rig file can be set by --set a.b=c or by the environment variable DPM_SET_A__B=c.";

#[derive(Debug, Subcommand)]
enum CliCommand {
    /// Run the built-in scene of two moving objects with the mock projector and the mock tracker
    Demo(run::DemoArgs),
    /// Run a rig file
    Run(run::RunArgs),
    /// Measure how much of this rig's pictures the link to the projector can carry, and at which frame rate
    #[cfg(feature = "lab")]
    LinkTest(link_test::LinkTestArgs),
    /// Make the projectors of all running rigs dark, or of one; the rigs continue to run
    ///
    /// The projectors stay dark until `dpm arm`. The order stands for the next run too, however this one ends. Prints the rigs that were reached and the state of each projector. Exit code 0 only if every
    /// projector confirmed. If a rig does not answer within 20 ms, the order is sent to it as the signal USR1, which
    /// needs only its link's thread.
    Black(order::OrderArgs),
    /// Freeze the frame that the projector of a running rig shows
    ///
    /// The frame is held until `dpm arm`, `dpm black` or `dpm safe`. Exit code 0 only if the projector confirmed.
    Freeze(order::OrderArgs),
    /// Make the projectors of all running rigs dark, or of one, and keep them dark over restarts until `dpm arm`
    ///
    /// The order is latched in the projector and in the state folder. The next run of that projector comes up dark,
    /// even after a crash or a restart of the service or the machine. Exit code 0 only if every projector confirmed
    /// and the order is on the disk. If a rig does not answer within 20 ms, the order is sent to it as the signal
    /// USR2.
    Safe(order::OrderArgs),
    /// Permit light again after black, freeze, safe or a fault; this acknowledges the fault
    ///
    /// Only a running rig can be armed. The order in the state folder is forgotten first; then the light returns. If
    /// several rigs run, select one with --pid.
    #[command(visible_alias = "resume")]
    Arm(order::OrderArgs),
    /// Show or change the parameters of a running rig: exposure, samples, gaze, motions of projector and bodies
    ///
    /// A change is used from one frame on, and the answer names the frame. --undo takes the last change back, and --save
    /// writes the values into the rig file and the calibration file for the next run.
    Set(set::SetArgs),
    /// Print the link for orders to the page of a running rig, if what listens there is the rig
    ///
    /// The link holds the key of the rig's page behind the sign #, which no browser sends. Give it to nobody. The page
    /// keeps the key until it is left.
    #[cfg(feature = "page")]
    Page(page::PageArgs),
    /// Show several running rigs on one page: state, rates, what is dark and why; without orders
    ///
    /// Asks the live pages of the rigs, once a second while somebody looks. A rig on another machine comes through a
    /// tunnel: ssh -N -L 8948:127.0.0.1:8948 rig2
    #[cfg(feature = "page")]
    Rigs(rigs::RigsArgs),
    /// Show a pattern on a rig's projector, for aiming, focusing and calibrating, or write it as PNG files
    Pattern(pattern::PatternArgs),
    /// Measure what a rig needs to know: wand, projector, bodies, latency, light
    #[cfg(feature = "calibrate")]
    Calibrate(calibrate::CalibrateArgs),
    /// Record the samples of a rig's tracker into a file that `tracker.kind = "replay"` plays
    Record(record::RecordArgs),
    /// Say what to expect of a rig before its parts are there: registration, latency, and what better parts would win
    ///
    /// Runs the rig's own engine at virtual pace against mocks with the rates, delays, noise and calibration errors of its
    /// parts. Needs neither hardware nor a GPU, and repeats bit for bit. The section `rehearsal` of the rig file says what is assumed.
    #[cfg(feature = "lab")]
    Rehearse(rehearse::RehearseArgs),
    /// Measure where the time between motion and light goes
    Profile(profile::ProfileArgs),
    /// Show what this machine can do, and how to fix what is missing
    Doctor(doctor::DoctorArgs),
    /// Run stiff and extreme cases: measured error against bound, with the oracle of each
    #[cfg(feature = "lab")]
    Stability(stability::StabilityArgs),
    /// Write what a run or a measurement left in a folder as one HTML file, and its tables as CSV
    #[cfg(feature = "lab")]
    Report(report::ReportArgs),
    /// Write pictures of everything that one frame was made from: rates, errors, samples, history, motion, light
    #[cfg(feature = "lab")]
    Snapshot(snapshot::SnapshotArgs),
    /// Write the room of a rig for other programs
    #[cfg(feature = "lab")]
    Scene(scene::SceneArgs),
    /// Measure rays, samples and milliseconds per pass of every method on this device
    #[cfg(feature = "lab")]
    Bench(bench::BenchArgs),
    /// Measure error against cost of every method: perceived error, bias, noise and flicker at equal rays
    #[cfg(feature = "lab")]
    Error(error::ErrorArgs),
    /// Show what a rig needs from the renderer, and what is left out, why and how; with --measure also the savings
    #[cfg(feature = "lab")]
    Plan(plan::PlanArgs),
    #[command(flatten)]
    Satellite(crate::satellites::SatelliteCommand),
    /// List the displays that can serve as projectors, and what to write in a rig file for each mode
    #[cfg(feature = "display")]
    Display(display::DisplayArgs),
    /// Print the completions of a shell: bash, zsh, fish and others
    ///
    /// For bash: dpm completions bash > ~/.local/share/bash-completion/completions/dpm
    #[cfg(feature = "manual")]
    Completions(manual::CompletionsArgs),
    /// Write a man page for the program and one for each command
    #[cfg(feature = "manual")]
    Man(manual::ManArgs),
}

/// Runs the program with the process's arguments. `commit`: the commit from which it was compiled, see
/// [`dpm_common::commit::get`].
pub fn main(commit: &'static str) -> ExitCode {
    dpm_common::commit::set(commit);
    crate::satellites::register();
    if let Some(state) = dpm_rig::standing::state_folder() {
        dpm_scene::horizon::keep_in(state.join("horizons"));
    }
    #[cfg(feature = "manual")]
    completion::answer();
    let command = coloured(command());
    let parsed = command.try_get_matches().and_then(|m| Cli::from_arg_matches(&m));
    let cli = match parsed {
        Ok(cli) => cli,
        Err(e) => {
            // Help and version are "errors" here too, with exit code 0.
            let _ = e.print();
            return ExitCode::from(u8::try_from(e.exit_code()).unwrap_or(2));
        }
    };
    #[cfg(feature = "display")]
    if let Some(command) = display::guardian_command() {
        dpm_display::transport::set_guardian(command);
    }
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

/// Help and errors in colours, unless the user wants none.
#[cfg(feature = "terminal")]
fn coloured(command: clap::Command) -> clap::Command {
    use clap::ColorChoice;
    // https://no-color.org: set and not empty.
    let plain = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
    command.color(if plain { ColorChoice::Never } else { ColorChoice::Auto })
}

#[cfg(not(feature = "terminal"))]
fn coloured(command: clap::Command) -> clap::Command {
    command
}

/// The command line. `-V` tells version and commit; `--version` adds the features.
fn command() -> clap::Command {
    let version = format!("{} ({})", env!("CARGO_PKG_VERSION"), dpm_common::commit::get());
    let long = format!("{version}\nfeatures: {}", crate::satellites::features());
    // Leaked once or twice per process; the parser keeps them for as long.
    negatives_reach_their_checks(Cli::command().version(&*version.leak()).long_version(&*long.leak()))
}

/// A number below 0 is no flag: the check of the flag says what is allowed.
fn negatives_reach_their_checks(command: clap::Command) -> clap::Command {
    let is_number = |arg: &clap::Arg| arg.get_value_parser().type_id() == TypeId::of::<f64>();
    command
        .mut_args(move |arg| if is_number(&arg) { arg.allow_negative_numbers(true) } else { arg })
        .mut_subcommands(negatives_reach_their_checks)
}

fn dispatch(command: &CliCommand) -> Result<(), Failure> {
    match command {
        CliCommand::Demo(args) => run::execute_demo(args),
        CliCommand::Run(args) => run::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::LinkTest(args) => link_test::execute(args),
        CliCommand::Black(args) => order::execute(args, Order::Black),
        CliCommand::Freeze(args) => order::execute(args, Order::Freeze),
        CliCommand::Safe(args) => order::execute(args, Order::Safe),
        CliCommand::Arm(args) => order::execute(args, Order::Arm),
        CliCommand::Set(args) => set::execute(args),
        #[cfg(feature = "page")]
        CliCommand::Page(args) => page::execute(args),
        #[cfg(feature = "page")]
        CliCommand::Rigs(args) => rigs::execute(args),
        CliCommand::Pattern(args) => pattern::execute(args),
        #[cfg(feature = "calibrate")]
        CliCommand::Calibrate(args) => calibrate::execute(args),
        CliCommand::Record(args) => record::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Rehearse(args) => rehearse::execute(args),
        CliCommand::Profile(args) => profile::execute(args),
        CliCommand::Doctor(args) => doctor::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Stability(args) => stability::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Report(args) => report::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Snapshot(args) => snapshot::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Scene(args) => scene::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Bench(args) => bench::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Error(args) => error::execute(args),
        #[cfg(feature = "lab")]
        CliCommand::Plan(args) => plan::execute(args),
        CliCommand::Satellite(command) => crate::satellites::execute(command).map(|text| watch::print(&text)),
        #[cfg(feature = "display")]
        CliCommand::Display(args) => display::execute(args),
        #[cfg(feature = "manual")]
        CliCommand::Completions(args) => manual::completions(args),
        #[cfg(feature = "manual")]
        CliCommand::Man(args) => manual::man(args),
    }
}
