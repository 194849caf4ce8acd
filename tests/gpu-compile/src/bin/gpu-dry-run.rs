//! Runs the whole rig on AMD's driver over a kernel that does nothing, and says what the host takes of a slot.
//!
//! `gpu-dry-run [--drivers DIR] [--slots N] [--json]`

use gpu_compile::rehearsal::{machine_wakes_late_ms, paced, too_large, validated, Share, METHODS};
use gpu_compile::targets::DRY_RUN;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

const USAGE: &str = "usage: gpu-dry-run [--drivers DIR] [--slots N] [--json]
  --drivers DIR  where tests/gpu-compile/drivers has unpacked the drivers (target/gpu-drivers)
  --slots N      slots of the run of each method (3000)
  --json         print one JSON object";

/// Slots for which the machine is watched before the runs.
const MACHINE_SLOTS: u32 = 3000;

struct Arguments {
    drivers: PathBuf,
    slots: u64,
    json: bool,
    /// Do this part in this process, which has the driver: the checks, or the run of a method.
    part: Option<String>,
}

fn arguments() -> Result<Arguments, String> {
    let mut found = Arguments { drivers: "target/gpu-drivers".into(), slots: 3000, json: false, part: None };
    let mut all = std::env::args().skip(1);
    while let Some(flag) = all.next() {
        match flag.as_str() {
            "--drivers" => found.drivers = all.next().ok_or(USAGE)?.into(),
            "--slots" => {
                let number = all.next().and_then(|n| n.parse().ok()).filter(|n| (1..1_000_000).contains(n));
                found.slots = number.ok_or(USAGE)?;
            }
            "--part" => found.part = Some(all.next().ok_or(USAGE)?),
            "--json" => found.json = true,
            _ => return Err(USAGE.into()),
        }
    }
    Ok(found)
}

fn main() -> ExitCode {
    let arguments = match arguments() {
        Ok(arguments) => arguments,
        Err(e) => {
            eprintln!("{e}");
            return ExitCode::from(2);
        }
    };
    let done = match arguments.part.as_deref() {
        Some("validated") => validated().map(|seen| println!("{}", serde_json::json!(seen))),
        Some(part) => match METHODS.into_iter().find(|method| method.word() == part) {
            Some(method) => {
                paced(method, arguments.slots).map(|share| println!("{}", serde_json::json!(share)))
            }
            None => Err(USAGE.to_owned()),
        },
        None => all(&arguments),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("{e}");
            ExitCode::from(1)
        }
    }
}

/// Runs a part in a process that has the driver.
fn ask<T: serde::de::DeserializeOwned>(
    part: &str,
    arguments: &Arguments,
    drivers: &Path,
) -> Result<T, String> {
    let program = std::env::current_exe().map_err(|e| e.to_string())?;
    let mut command: Command = DRY_RUN.command(drivers, &program, &drivers.join("manifests"))?;
    let ran = command
        .args(["--part", part, "--slots", &arguments.slots.to_string()])
        .stderr(Stdio::inherit())
        .output()
        .map_err(|e| format!("{part}: {e}"))?;
    if !ran.status.success() {
        return Err(format!("{part}: {}", ran.status));
    }
    serde_json::from_slice(&ran.stdout).map_err(|e| format!("{part}: {e}"))
}

fn all(arguments: &Arguments) -> Result<(), String> {
    let manifests = arguments.drivers.join("manifests");
    std::fs::create_dir_all(&manifests).map_err(|e| format!("{}: {e}", manifests.display()))?;
    let drivers = arguments.drivers.canonicalize().map_err(|e| e.to_string())?;
    let seen: Vec<String> = ask("validated", arguments, &drivers)?;
    let late = machine_wakes_late_ms(MACHINE_SLOTS)?;
    // Each in a process of its own: the kernel's stand-in ends in a fault after some ten thousand submissions.
    let shares = METHODS.map(|method| ask::<Share>(method.word(), arguments, &drivers));
    let shares = shares.into_iter().collect::<Result<Vec<_>, _>>()?;
    if arguments.json {
        println!("{}", serde_json::json!({ "seen": seen, "machine_wakes_late_ms": late, "shares": shares }));
    } else {
        println!("{}", seen.join("\n"));
        println!(
            "\nWith nothing else to do, this machine wakes a thread of the frame path {:.3} ms (p50) and {:.3} ms (p99) late.",
            late[0], late[1]
        );
        println!("\n| method | runs | frames | slots missed | latch to submission, ms (p50, p99) | submission to readable, ms (p50, p99) |");
        println!("|---|---:|---:|---:|---:|---:|");
        for Share { method, runs, frames, missed, plan_ms: [p, pp], readable_ms: [r, rr] } in &shares {
            println!("| {method} | {runs} | {frames} | {missed} | {p:.3}, {pp:.3} | {r:.3}, {rr:.3} |");
        }
    }
    match too_large(&shares) {
        over if over.is_empty() => Ok(()),
        over => Err(over.join("\n")),
    }
}
