//! `dpm stability`: hard cases with their errors and bounds.

use super::watch::print;
use dpm_lab::stability::{cases, gpu, CaseResult, CaseVerdict, StabilityReport, SEED};
use dpm_render::gpu::validation_messages;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::report::to_json;

/// Flags of `dpm stability`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct StabilityArgs {
    /// Run only cases whose name contains this
    #[arg(long, value_name = "NAME")]
    only: Option<String>,
    /// Seed of the random inputs; a failing case prints the seed that reproduces it
    #[arg(long, default_value_t = SEED)]
    seed: u64,
    /// Number of consecutive seeds per case; prints the first failure, or else the largest error
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    seeds: u64,
    /// Print the error of each stiff case against the number that makes it stiff
    #[arg(long)]
    curves: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

fn line(c: &CaseResult) -> String {
    let error = c.error.map_or("-".into(), |e| format!("{e:.2e}"));
    let verdict = match c.verdict {
        CaseVerdict::Pass => "pass",
        CaseVerdict::Missed => "miss",
        CaseVerdict::Fail => "FAIL",
        CaseVerdict::NotRun => "----",
    };
    let mut text =
        format!("{verdict}  {:<36} {error:>9} <= {:<7e} {:<11} {}\n", c.name, c.bound, c.unit, c.oracle);
    if let Some(stiff) = &c.stiffness {
        text += &format!("      {:<36} {:>9.2e} {}\n", "", stiff.number, stiff.of);
        for (number, error) in &stiff.curve {
            let error = error.map_or("no answer".into(), |e| format!("{e:.2e}"));
            text += &format!("      {number:>46.2e}: {error}\n");
        }
    }
    text
}

/// Runs the cases; the command fails if one of them fails.
pub(super) fn execute(args: &StabilityArgs) -> Result<(), Failure> {
    let mut all = cases();
    let device = gpu::open();
    all.extend(gpu::cases(&device));
    let only = args.only.as_deref();
    if let Some(name) = only.filter(|o| !all.iter().any(|c| c.name.contains(o))) {
        let names: Vec<&str> = all.iter().map(|c| c.name).collect();
        let message = format!("no stability case is called {name:?}; there are: {}", names.join(", "));
        return Err(Failure::new(FailureKind::BadInput, message));
    }
    let mut report = StabilityReport { with_curves: args.curves, ..StabilityReport::default() };
    report.run_cases(&all, only, args.seed..=args.seed.saturating_add(args.seeds - 1), |c| {
        if !args.json {
            print(&line(c));
        }
    });
    if args.json {
        print(&(to_json(&report) + "\n"));
    } else {
        let not_run =
            if report.not_run > 0 { format!(", {} not run", report.not_run) } else { String::new() };
        let missed = match report.missed {
            0 => String::new(),
            some => format!(", {some} miss a bound that they do not reach yet"),
        };
        print(&format!("{} of {} cases pass{missed}{not_run}\n", report.passed, report.cases.len()));
    }
    let (validation, texts) = validation_messages();
    if validation > 0 {
        let told = format!("Vulkan validation reported:\n  {}", texts.join("\n  "));
        return Err(Failure::new(FailureKind::CheckFailed, told));
    }
    if report.failed == 0 {
        let Some(first) = report.cases.iter().find(|c| c.verdict == CaseVerdict::NotRun) else {
            return Ok(());
        };
        let why = first.note.as_deref().unwrap_or("something is missing");
        let told = format!("{} stability cases were not run: {why}", report.not_run);
        return Err(Failure::new(FailureKind::NoGpu, told));
    }
    let failed: Vec<String> = (report.cases.iter())
        .filter(|c| c.verdict == CaseVerdict::Fail)
        .map(|c| {
            let note = c.note.as_ref().map_or(String::new(), |n| format!(" ({n})"));
            let least = c.stiffness.as_ref().and_then(|stiff| Some((stiff.fails_from?, stiff.of)));
            let least = least.map_or(String::new(), |(n, of)| format!(", from {n:.3e} on ({of})"));
            format!("{}{note}{least}: replay with dpm stability --only {} --seed {}", c.name, c.name, c.seed)
        })
        .collect();
    Err(Failure::new(FailureKind::CheckFailed, format!("stability: {}", failed.join("\n  "))))
}
