//! A test into its exit code and one line of costs. `./x test` has Cargo run every test program through this one.
//!
//!     test-meter PROGRAM [ARGUMENTS...]
//!
//! cargo-nextest starts one process a test and names the test in the environment. Its processor time, with that of the
//! processes that it waited for, goes into the file that `DPM_TEST_COSTS` names, as
//! `program <tab> test <tab> core-seconds <tab> seconds <tab> exit code`. Without these variables the program is executed and
//! nothing is measured.
//!
//! A test whose path has the module `real_pace` may fail because the machine was busy. If it fails, what the machine did
//! meanwhile is printed below its own message, so that nobody has to guess.

use std::ffi::OsString;
use std::io::Write;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Command, ExitCode};
use std::time::Instant;
use test_meter::machine::{self, Sample, Watch};

/// The module whose tests run at real pace; `.config/nextest.toml` runs them alone.
const REAL_PACE: &str = "real_pace::";

fn main() -> ExitCode {
    let mut arguments = std::env::args_os().skip(1);
    let Some(program) = arguments.next() else {
        eprintln!("test-meter: no program was named");
        return ExitCode::from(2);
    };
    let mut command = Command::new(&program);
    command.args(arguments);
    let variable = |name: &str| std::env::var(name).ok();
    let (Some(file), Some(binary), Some(test)) =
        (std::env::var_os("DPM_TEST_COSTS"), variable("NEXTEST_BINARY_ID"), variable("NEXTEST_TEST_NAME"))
    else {
        let error = command.exec();
        eprintln!("test-meter: {} cannot be run: {error}", program.display());
        return ExitCode::from(2);
    };
    match measured(&mut command, &file, &binary, &test) {
        Ok(code) => ExitCode::from(code),
        Err(error) => {
            eprintln!("test-meter: {binary} {test}: {error}");
            ExitCode::from(2)
        }
    }
}

/// Runs the test, appends its costs to `file`, and gives its exit code; a signal counts as a shell counts it.
fn measured(command: &mut Command, file: &OsString, binary: &str, test: &str) -> std::io::Result<u8> {
    let watch = (test.starts_with(REAL_PACE) || test.contains(&format!("::{REAL_PACE}"))).then(Watch::begin);
    let (begin, before) = (Instant::now(), Sample::now());
    let status = command.status()?;
    let (seconds, after) = (begin.elapsed().as_secs_f64(), Sample::now());
    let core_seconds = machine::core_seconds_of_children();
    let code = status.code().unwrap_or_else(|| 128 + status.signal().unwrap_or(0));
    // One write, so that lines of tests that end together do not mix.
    let line = format!("{binary}\t{test}\t{core_seconds:.4}\t{seconds:.4}\t{code}\n");
    std::fs::OpenOptions::new().create(true).append(true).open(file)?.write_all(line.as_bytes())?;
    if let (Some(watch), true) = (watch, code != 0) {
        eprintln!("\n{}", machine::account(&before, &after, seconds, core_seconds, &watch.end()));
    }
    Ok(u8::try_from(code).unwrap_or(1))
}
