//! The program `dpm`: passes the command line to the library, with the commit from which it was compiled.

/// `DPM_COMMIT` at compile time (for packagers), else what Git says.
const COMMIT: &str = match option_env!("DPM_COMMIT") {
    Some(told) => told,
    None => dpm_commit::commit!("../.."),
};

fn main() -> std::process::ExitCode {
    dpm::cli::main(COMMIT)
}
