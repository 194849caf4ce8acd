//! Compiles every pipeline for GPUs that are not there, and prints or records what their compilers made of it.
//!
//! `gpu-compile [--drivers DIR] [--only TEXT] [--json] [--record | --anew]`, or `gpu-compile --here` for the GPU of this machine

use gpu_compile::table::{compile, everything_said, inputs, Row, Table};
use gpu_compile::targets::{Target, ALL};
use gpu_compile::{cases, laws, page};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

const USAGE: &str = "usage: gpu-compile [--drivers DIR] [--only TEXT] [--json] [--record | --anew]
       gpu-compile --here
  --drivers DIR  where tests/gpu-compile/drivers has unpacked the drivers (target/gpu-drivers)
  --only TEXT    only targets whose name contains TEXT, such as navi31; nothing is compared or recorded
  --json         print the table as JSON
  --record       write the table into docs/lab, unless a row of it is worse than the one that is there
  --anew         write it in any case
  --here         compile for the device of this machine, and print all that its driver says; nothing is compared or recorded";

struct Arguments {
    drivers: PathBuf,
    only: Option<String>,
    json: bool,
    record: bool,
    anew: bool,
    /// Compile for the device of this machine.
    here: bool,
    /// Compile for this target in this process.
    one: Option<String>,
}

fn arguments() -> Result<Arguments, String> {
    let mut found = Arguments {
        drivers: "target/gpu-drivers".into(),
        only: None,
        json: false,
        record: false,
        anew: false,
        here: false,
        one: None,
    };
    let mut all = std::env::args().skip(1);
    while let Some(flag) = all.next() {
        match flag.as_str() {
            "--drivers" => found.drivers = all.next().ok_or(USAGE)?.into(),
            "--only" => found.only = Some(all.next().ok_or(USAGE)?),
            "--one" => found.one = Some(all.next().ok_or(USAGE)?),
            "--here" => found.here = true,
            "--json" => found.json = true,
            "--record" => found.record = true,
            "--anew" => (found.record, found.anew) = (true, true),
            _ => return Err(USAGE.into()),
        }
    }
    Ok(found)
}

fn main() -> ExitCode {
    let done = arguments().map_err(|e| (2, e)).and_then(|arguments| match &arguments.one {
        Some(name) => one(name).map_err(|e| (1, e)),
        None if arguments.here => here().map_err(|e| (1, e)),
        None => all(&arguments).map_err(|e| (1, e)),
    });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err((code, e)) => {
            eprintln!("{e}");
            ExitCode::from(code)
        }
    }
}

/// Prints what the driver of this machine's device says of every program.
fn here() -> Result<(), String> {
    println!("{}", everything_said(&cases::all()?)?.join("\n"));
    Ok(())
}

/// Prints the driver and the rows of one target, whose driver this process has.
fn one(name: &str) -> Result<(), String> {
    let target = Target::named(name).ok_or_else(|| format!("{name} is no target"))?;
    let found = compile(&cases::all()?, target)?;
    println!("{}", serde_json::json!(found));
    // Some of these drivers cannot be closed without a GPU.
    std::process::exit(0)
}

/// Runs this program for one target.
fn ask(target: &Target, drivers: &Path, scratch: &Path) -> Result<(String, Vec<Row>), String> {
    eprintln!("compiling for {} ({})", target.name, target.gpu);
    let program = std::env::current_exe().map_err(|e| e.to_string())?;
    let mut command: Command = target.command(drivers, &program, scratch)?;
    let ran = command
        .args(["--one", target.name])
        .stderr(Stdio::inherit())
        .output()
        .map_err(|e| format!("{}: {e}", target.name))?;
    if !ran.status.success() {
        return Err(format!("{}: {}", target.name, ran.status));
    }
    serde_json::from_slice(&ran.stdout).map_err(|e| format!("{}: {e}", target.name))
}

/// Runs this program for all of these, as many at once as the machine has cores.
fn ask_all(targets: &[&Target], drivers: &Path, scratch: &Path) -> Vec<Result<(String, Vec<Row>), String>> {
    let next = AtomicUsize::new(0);
    let found: Vec<_> = targets.iter().map(|_| Mutex::new(Err("not compiled".to_owned()))).collect();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..cores.min(targets.len()) {
            scope.spawn(|| {
                while let Some(i) = Some(next.fetch_add(1, Ordering::Relaxed)).filter(|i| *i < targets.len())
                {
                    let rows = ask(targets[i], drivers, scratch);
                    *found[i].lock().unwrap_or_else(|e| e.into_inner()) = rows;
                }
            });
        }
    });
    found.into_iter().map(|f| f.into_inner().unwrap_or_else(|e| e.into_inner())).collect()
}

fn all(arguments: &Arguments) -> Result<(), String> {
    let scratch = arguments.drivers.join("manifests");
    std::fs::create_dir_all(&scratch).map_err(|e| format!("{}: {e}", scratch.display()))?;
    let drivers = arguments.drivers.canonicalize().map_err(|e| e.to_string())?;
    let wanted = |target: &&Target| arguments.only.as_ref().is_none_or(|text| target.name.contains(text));
    let targets: Vec<_> = ALL.iter().filter(wanted).collect();
    let mut table = Table { inputs: cases::all()?.iter().flat_map(inputs).collect(), ..Table::default() };
    for (target, found) in targets.iter().zip(ask_all(&targets, &drivers, &drivers.join("manifests"))) {
        let (driver, rows) = found?;
        table.drivers.push((target.name.to_owned(), driver));
        table.passes.extend(rows);
    }
    println!("{}", if arguments.json { table.json() } else { table.markdown() }.trim_end());
    if arguments.only.is_some() {
        return Ok(());
    }
    let root = Path::new(".");
    let committed = page::committed(root)?.unwrap_or_default();
    if arguments.record {
        let worse = laws::worse(&table, &committed);
        if !worse.is_empty() && !arguments.anew {
            return Err(format!(
                "Not recorded, because these rows are worse than the committed ones (--anew records them all the same):\n  {}",
                worse.join("\n  ")
            ));
        }
        page::record(root, &table)?;
    } else if table != committed {
        return Err(format!("This differs from {}: record it with ./x gpu-compile --record", page::TABLE));
    }
    let broken = laws::broken(&table);
    if broken.is_empty() {
        Ok(())
    } else {
        Err(format!("Broken laws:\n  {}", broken.join("\n  ")))
    }
}
