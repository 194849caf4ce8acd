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
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

fn line(c: &CaseResult) -> String {
    let error = c.error.map_or("-".into(), |e| format!("{e:.2e}"));
    let verdict = match c.verdict {
        CaseVerdict::Pass => "pass",
        CaseVerdict::Fail => "FAIL",
        CaseVerdict::NotRun => "----",
    };
    format!("{verdict}  {:<36} {error:>9} <= {:<7e} {:<11} {}\n", c.name, c.bound, c.unit, c.oracle)
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
    let mut report = StabilityReport::default();
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
        print(&format!("{} of {} cases pass{not_run}\n", report.passed, report.cases.len()));
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
            format!("{}{note}: replay with dpm stability --only {} --seed {}", c.name, c.name, c.seed)
        })
        .collect();
    Err(Failure::new(FailureKind::CheckFailed, format!("stability: {}", failed.join("\n  "))))
}
