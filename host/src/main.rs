//! The program `dpm`: words into calls of the library.

fn main() -> std::process::ExitCode {
    dpm_host::cli::main()
}
