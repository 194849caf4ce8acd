//! Runs the whole rig on AMD's driver over a kernel that does nothing, and says what the host takes of a slot.
//!
//! `gpu-dry-run [--drivers DIR] [--slots N] [--set KEY=VALUE] [--json]`

use gpu_compile::rehearsal::{machine_wakes_late_ms, paced, too_large, validated, Share, METHODS};
use gpu_compile::targets::DRY_RUN;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

const USAGE: &str = "usage: gpu-dry-run [--drivers DIR] [--slots N] [--set KEY=VALUE] [--json]
  --drivers DIR  where tests/gpu-compile/drivers has unpacked the drivers (target/gpu-drivers)
  --slots N      slots of the run of each method (3000)
  --set KEY=VALUE  a key of the rig file, for the runs at real pace; may be given more than once
  --json         print one JSON object";

/// Slots for which the machine is watched before the runs.
const MACHINE_SLOTS: u32 = 3000;

struct Arguments {
    drivers: PathBuf,
    slots: u64,
    settings: Vec<String>,
    json: bool,
    /// Do this part in this process, which has the driver: the checks, or the run of a method.
    part: Option<String>,
}

fn arguments() -> Result<Arguments, String> {
    let mut found = Arguments {
        drivers: "target/gpu-drivers".into(),
        slots: 3000,
        settings: Vec::new(),
        json: false,
        part: None,
    };
    let mut all = std::env::args().skip(1);
    while let Some(flag) = all.next() {
        match flag.as_str() {
            "--drivers" => found.drivers = all.next().ok_or(USAGE)?.into(),
            "--slots" => {
                let number = all.next().and_then(|n| n.parse().ok()).filter(|n| (1..1_000_000).contains(n));
                found.slots = number.ok_or(USAGE)?;
            }
            "--set" => found.settings.push(all.next().ok_or(USAGE)?),
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
            Some(method) => paced(method, arguments.slots, &arguments.settings)
                .map(|share| println!("{}", serde_json::json!(share))),
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
    let settings = arguments.settings.iter().flat_map(|setting| ["--set", setting]);
    let ran = command
        .args(["--part", part, "--slots", &arguments.slots.to_string()])
        .args(settings)
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
    // Before any other process: memory that one gives back as it ends has stopped a virtual machine for 40 ms.
    let late = machine_wakes_late_ms(MACHINE_SLOTS, true)?;
    let late_from_sleep = machine_wakes_late_ms(MACHINE_SLOTS, false)?;
    let seen: Vec<String> = ask("validated", arguments, &drivers)?;
    // Each in a process of its own: the kernel's stand-in ends in a fault after some ten thousand submissions.
    let shares = METHODS.map(|method| ask::<Share>(method.word(), arguments, &drivers));
    let shares = shares.into_iter().collect::<Result<Vec<_>, _>>()?;
    if arguments.json {
        let told = serde_json::json!({
            "seen": seen,
            "machine_wakes_late_ms": late,
            "machine_wakes_late_from_sleep_ms": late_from_sleep,
            "shares": shares,
        });
        println!("{told}");
    } else {
        println!("{}", seen.join("\n"));
        println!(
            "\nWith nothing else to do, this machine wakes a thread of the frame path {:.3} ms (p50) and {:.3} ms (p99) late; {:.3} and \
             {:.3} ms if idle cores may sleep.",
            late[0], late[1], late_from_sleep[0], late_from_sleep[1]
        );
        println!("\n| method | runs | frames | slots missed | latch to submission, ms (p50, p99) | submission to readable, ms (p50, p99) | both, frame by frame |");
        println!("|---|---:|---:|---:|---:|---:|---:|");
        let text = |[p50, p99]: [f64; 2]| format!("{p50:.3}, {p99:.3}");
        for share in &shares {
            let Share { method, runs, frames, missed, plan_ms, readable_ms, taken_ms } = share;
            let [plan, readable, taken] = [*plan_ms, *readable_ms, *taken_ms].map(text);
            println!("| {method} | {runs} | {frames} | {missed} | {plan} | {readable} | {taken} |");
        }
    }
    match too_large(&shares) {
        over if over.is_empty() => Ok(()),
        over => Err(over.join("\n")),
    }
}
