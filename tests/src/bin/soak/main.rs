//! A soak: the real threads at real pace for hours, against a projector and a tracker in processes of their own.
//!
//! `soak HOURS [--seed N] [--out DIR]` starts `hil-mock serve projector` on a pseudo-terminal, `hil-mock serve natnet`,
//! and `dpm run` with the flight recorder on. A seeded plan gives orders, pulls the plug, kills the tracker, and ends or
//! kills `dpm` itself. What it watches are laws: when it must be dark, when light must be back, that nothing leaks, and
//! that nothing ends which should not. It ends with a table, and with exit code 1 if a law was broken.

mod cable;
mod crew;
mod laws;
mod light;
mod plan;

use crew::Crew;
use laws::Laws;
use plan::{Deed, Plan};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// How long a deed lasts before it is taken back.
const DEED: Duration = Duration::from_millis(1500);

/// The arguments.
struct Arguments {
    hours: f64,
    seed: u64,
    out: PathBuf,
}

fn arguments() -> Result<Arguments, String> {
    let usage = "usage: soak HOURS [--seed N] [--out DIR]; fractions of an hour are allowed, such as 0.02";
    let mut all = std::env::args().skip(1);
    let hours: f64 = all.next().and_then(|text| text.parse().ok()).ok_or(usage)?;
    if !(hours > 0.0 && hours < 10_000.0) {
        return Err(usage.into());
    }
    let mut arguments = Arguments { hours, seed: 1, out: PathBuf::from("out/soak") };
    while let Some(flag) = all.next() {
        let value = all.next().ok_or(usage)?;
        match flag.as_str() {
            "--seed" => arguments.seed = value.parse().map_err(|_| usage)?,
            "--out" => arguments.out = value.into(),
            _ => return Err(usage.into()),
        }
    }
    Ok(arguments)
}

fn main() -> ExitCode {
    let arguments = match arguments() {
        Ok(arguments) => arguments,
        Err(e) => {
            eprintln!("{e}");
            return ExitCode::from(2);
        }
    };
    match soak(&arguments) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(e) => {
            eprintln!("error: {e}");
            ExitCode::from(3)
        }
    }
}

/// Runs the soak; true if every law was kept.
fn soak(arguments: &Arguments) -> Result<bool, String> {
    let out = empty_folder(&arguments.out)?;
    let begin = Instant::now();
    let length = Duration::from_secs_f64(arguments.hours * 3600.0);
    let mut laws = Laws::new();
    let mut crew = Crew::start(&out)?;
    crew.expect_light(&mut laws, "the start");
    let mut plan = Plan::new(arguments.seed, length);
    while let Some(deed) = plan.next(begin.elapsed()) {
        let due = begin + deed.after;
        while Instant::now() < due && crew.is_well(&mut laws) {
            crew.watch_quietly(&mut laws);
        }
        if laws.is_hopeless() {
            break;
        }
        eprintln!("{:9.1} s  {}", begin.elapsed().as_secs_f64(), deed.deed.word());
        crew.act(deed.deed, &mut laws);
    }
    while begin.elapsed() < length && !laws.is_hopeless() && crew.is_well(&mut laws) {
        crew.watch_quietly(&mut laws);
    }
    crew.end(&mut laws);
    let table = laws.table(begin.elapsed(), arguments.seed, &crew, &out);
    println!("{table}");
    std::fs::write(out.join("soak.txt"), &table).map_err(|e| format!("cannot write the table: {e}"))?;
    Ok(laws.are_kept())
}

/// Makes the folder; what an earlier soak left in it is deleted.
fn empty_folder(out: &Path) -> Result<PathBuf, String> {
    let wrong = |e: std::io::Error| format!("cannot use the folder {}: {e}", out.display());
    // Only what a soak has written is deleted.
    if out.join("soak.log").exists() {
        std::fs::remove_dir_all(out).map_err(wrong)?;
    }
    std::fs::create_dir_all(out).map_err(wrong)?;
    std::fs::write(out.join("soak.log"), "").map_err(wrong)?;
    out.canonicalize().map_err(wrong)
}

impl Crew {
    /// Does a deed of the plan, takes it back, and judges what followed.
    fn act(&mut self, deed: Deed, laws: &mut Laws) {
        let at = hil_mock::monotonic::now_ns();
        match deed {
            Deed::Black => {
                self.order("black", laws);
                self.expect_dark(laws, at, laws::ORDER_WITHIN_MS, "BLACK");
                self.stays_dark(laws, "BLACK", DEED);
                self.order("arm", laws);
                self.expect_light(laws, "ARM after BLACK");
            }
            Deed::Freeze => {
                self.order("freeze", laws);
                self.expect_held(laws, "FREEZE");
                self.rest(DEED);
                self.expect_held(laws, "FREEZE, held");
                self.order("arm", laws);
                self.expect_state(laws, "armed", "ARM after FREEZE");
            }
            Deed::Unplug => {
                self.cable.unplug();
                self.expect_dark(laws, at, laws::WATCHDOG_WITHIN_MS, "pulling the plug");
                self.stays_dark(laws, "pulling the plug", DEED);
                match self.cable.plug_in() {
                    Ok(()) => self.expect_light(laws, "plugging in again"),
                    Err(e) => laws.found(format!("the soak's own cable cannot be plugged in: {e}")),
                }
            }
            Deed::KillTracker => {
                self.tracker.kill();
                self.expect_picture(laws, false, "the tracker's death");
                self.rest(DEED);
                self.start_tracker(laws);
                self.expect_picture(laws, true, "the tracker's return");
            }
            Deed::Restart => {
                self.stop_dpm(laws, at);
                self.start_dpm(laws);
                self.expect_light(laws, "a restart");
            }
            Deed::Kill => {
                self.dpm.kill();
                laws.killed += 1;
                self.expect_dark(laws, at, laws::WATCHDOG_WITHIN_MS, "the death of dpm");
                self.stays_dark(laws, "the death of dpm", DEED);
                self.start_dpm(laws);
                self.expect_light(laws, "the start after a death");
            }
        }
        laws.deeds += 1;
        self.settle();
    }
}
