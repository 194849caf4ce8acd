//! The program `dpm`: words into calls of the library, with the commit that it is compiled from.

/// `DPM_COMMIT` at compile time (for packagers), else what Git says.
const COMMIT: &str = match option_env!("DPM_COMMIT") {
    Some(told) => told,
    None => dpm_commit::commit!("../.."),
};

fn main() -> std::process::ExitCode {
    dpm::cli::main(COMMIT)
}
