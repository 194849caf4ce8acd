//! Stiff and extreme inputs into verdicts: what `dpm stability` runs.
//!
//! Every case names its input, the oracle it is held to (closed form, invariant, brute force, statistics, exact integers), the measured
//! error and the bound. The cases call the code that runs in the rig, not copies of its formulas. Each is a function of a seed, so a failure
//! replays.

mod calibration;
#[cfg(test)]
mod calibration_tests;
mod clocks;
pub mod estimate;
pub mod gpu;
mod gpu_chain;
pub mod gpu_compare;
mod gpu_disocclusion;
mod gpu_exact;
mod gpu_filter;
mod gpu_histories_in_motion;
mod gpu_history;
mod gpu_paper;
mod gpu_relight;
mod gpu_samplers;
pub mod gpu_shot;
mod gpu_tracer;
mod gpu_traversal;
mod interval;
mod lobes;
#[cfg(test)]
mod numerics_table;
mod planes;
mod predictor;
mod scattering;
mod stiffness;
mod tracer;

pub use stiffness::StiffnessResult;

use serde::Serialize;
use std::ops::RangeInclusive;
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::time::Instant;
use stiffness::Stiffness;

/// One hard case.
pub struct Case {
    /// Unique, lower case with dashes: the component, then what is hard.
    pub name: &'static str,
    /// What goes in.
    pub input: &'static str,
    /// What the result is held to.
    pub oracle: &'static str,
    /// Unit of error and bound.
    pub unit: &'static str,
    /// Largest accepted error.
    pub bound: f64,
    /// Error for a seed, not negative; NaN fails. Cases without randomness ignore the seed.
    pub measure: Box<dyn Fn(u64) -> f64 + Send + Sync>,
    /// What is missing on this machine, so that the case cannot run; `None`: nothing.
    pub missing: Option<String>,
}

impl Case {
    /// A case from its parts, in the order of the fields.
    pub(crate) fn new(
        name: &'static str,
        input: &'static str,
        oracle: &'static str,
        unit: &'static str,
        bound: f64,
        measure: impl Fn(u64) -> f64 + Send + Sync + 'static,
    ) -> Self {
        Self { name, input, oracle, unit, bound, measure: Box::new(measure), missing: None }
    }
}

/// A case that needs no device: name, input, oracle, unit, bound and measure, as [`Case::new`] takes them.
pub(crate) struct CpuCase(
    pub &'static str,
    pub &'static str,
    pub &'static str,
    pub &'static str,
    pub f64,
    pub fn(u64) -> f64,
);

/// Whether the error is within the bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CaseVerdict {
    /// It is.
    Pass,
    /// It is not, and that is known: the part does not reach yet what it should. The error is no greater than it was.
    Missed,
    /// It is not, or the case panicked, or its error is not a number.
    Fail,
    /// Something that it needs is missing here: nothing is known.
    #[serde(rename = "not run")]
    NotRun,
}

impl CaseVerdict {
    /// Nothing is worse than it was: the case passes, or misses its bound as it is known to.
    pub const fn is_as_known(self) -> bool {
        matches!(self, Self::Pass | Self::Missed)
    }
}

/// What became of a case.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CaseResult {
    /// Name of the case.
    pub name: &'static str,
    /// What went in.
    pub input: &'static str,
    /// What the result was held to.
    pub oracle: &'static str,
    /// Unit of error and bound.
    pub unit: &'static str,
    /// Measured; absent when the case panicked or the error is not finite.
    pub error: Option<f64>,
    /// Largest accepted.
    pub bound: f64,
    /// The verdict.
    pub verdict: CaseVerdict,
    /// What makes it stiff, if it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffness: Option<StiffnessResult>,
    /// Seed that replays it.
    pub seed: u64,
    /// How long it took.
    pub wall_s: f64,
    /// Why there is no error value: the case panicked, returned NaN, or lacked something that it needs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// All results.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StabilityReport {
    /// One per case, in order.
    pub cases: Vec<CaseResult>,
    /// How many passed.
    pub passed: usize,
    /// How many miss a bound that they are known to miss.
    pub missed: usize,
    /// How many failed.
    pub failed: usize,
    /// How many could not run here.
    pub not_run: usize,
    /// The error of each stiff case is measured against its number.
    #[serde(skip)]
    pub with_curves: bool,
}

impl StabilityReport {
    /// Adds a result.
    pub(crate) fn push(&mut self, result: CaseResult) {
        match result.verdict {
            CaseVerdict::Pass => self.passed += 1,
            CaseVerdict::Missed => self.missed += 1,
            CaseVerdict::Fail => self.failed += 1,
            CaseVerdict::NotRun => self.not_run += 1,
        }
        self.cases.push(result);
    }

    /// Runs the cases whose name contains `only` (all without it) into this report, each with every one of `seeds`, and tells the worst.
    pub fn run_cases(
        &mut self,
        cases: &[Case],
        only: Option<&str>,
        seeds: RangeInclusive<u64>,
        mut progress: impl FnMut(&CaseResult),
    ) {
        for case in cases.iter().filter(|c| only.is_none_or(|o| c.name.contains(o))) {
            let Some(mut result) = worst(case, seeds.clone()) else { continue };
            let failed = (result.verdict == CaseVerdict::Fail).then_some(case.bound);
            result.stiffness =
                Stiffness::of(case.name).map(|stiff| stiff.result(result.seed, failed, self.with_curves));
            progress(&result);
            self.push(result);
        }
    }
}

/// Cases that do not reach their bound yet, and the error that none of them may exceed.
const MISSED: &[(&str, f64)] = &[];

/// The seed of ordinary runs.
pub const SEED: u64 = 1;

/// All cases that need no device.
pub fn cases() -> Vec<Case> {
    let all = [
        tracer::CASES,
        scattering::CASES,
        lobes::CASES,
        predictor::CASES,
        clocks::CASES,
        calibration::CASES,
        planes::CASES,
    ];
    let case = |c: &CpuCase| Case::new(c.0, c.1, c.2, c.3, c.4, c.5);
    all.into_iter().flatten().map(case).collect()
}

/// Runs the cases whose name contains `only` (all without it).
#[cfg(test)]
pub(crate) fn run(only: Option<&str>) -> StabilityReport {
    let mut report = StabilityReport::default();
    report.run_cases(&cases(), only, SEED..=SEED, |_| {});
    report
}

/// Runs one case with several seeds: the first result that fails or did not run, else that of the largest error. `None` without a seed.
pub(crate) fn worst(case: &Case, seeds: RangeInclusive<u64>) -> Option<CaseResult> {
    let mut largest: Option<CaseResult> = None;
    for seed in seeds {
        let result = run_case(case, seed);
        if !result.verdict.is_as_known() {
            return Some(result);
        }
        if largest.as_ref().is_none_or(|l| result.error > l.error) {
            largest = Some(result);
        }
    }
    largest
}

/// Runs one case. A panic inside it is a failure of the case, not of the run.
pub(crate) fn run_case(case: &Case, seed: u64) -> CaseResult {
    let start = Instant::now();
    if let Some(missing) = &case.missing {
        return result(case, seed, start, (None, Some(missing.clone())), CaseVerdict::NotRun);
    }
    let outcome = catch_unwind(AssertUnwindSafe(|| (case.measure)(seed)));
    let (error, note) = match outcome {
        Ok(error) if error.is_finite() => (Some(error), None),
        Ok(error) => (None, Some(format!("the error is {error}"))),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(|s| s.to_string()));
            (None, Some(format!("panicked: {}", text.unwrap_or_default())))
        }
    };
    let known = MISSED.iter().find(|(name, _)| *name == case.name).map_or(case.bound, |(_, known)| *known);
    let verdict = match error {
        Some(e) if e <= case.bound => CaseVerdict::Pass,
        Some(e) if e <= known => CaseVerdict::Missed,
        _ => CaseVerdict::Fail,
    };
    result(case, seed, start, (error, note), verdict)
}

fn result(
    case: &Case,
    seed: u64,
    start: Instant,
    (error, note): (Option<f64>, Option<String>),
    verdict: CaseVerdict,
) -> CaseResult {
    CaseResult {
        name: case.name,
        input: case.input,
        oracle: case.oracle,
        unit: case.unit,
        error,
        bound: case.bound,
        verdict,
        stiffness: None,
        seed,
        wall_s: start.elapsed().as_secs_f64(),
        note,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_cases_pass() {
        let report = run(None);
        for c in &report.cases {
            println!(
                "{:<44} {:>12.3e} <= {:<9.1e} {:<8} {:.2} s {:?}",
                c.name,
                c.error.unwrap_or(f64::NAN),
                c.bound,
                c.unit,
                c.wall_s,
                c.verdict
            );
        }
        let failed: Vec<&CaseResult> =
            report.cases.iter().filter(|c| c.verdict == CaseVerdict::Fail).collect();
        assert!(failed.is_empty(), "{failed:#?}");
        assert_eq!(report.passed, report.cases.len());
        assert!(report.passed >= 40, "{}", report.passed);
    }

    #[test]
    fn names_are_unique_and_plain() {
        let mut names: Vec<&str> =
            cases().iter().chain(&gpu::cases(&Err("no".into()))).map(|c| c.name).collect();
        let n = names.len();
        assert!(names
            .iter()
            .all(|n| n.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-')));
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), n);
    }

    #[test]
    fn without_a_device_its_cases_are_neither_passed_nor_failed() {
        let mut report = StabilityReport::default();
        let all = gpu::cases(&Err("no Vulkan here".into()));
        report.run_cases(&all, None, SEED..=SEED, |_| {});
        assert!(all.len() >= 25, "{}", all.len());
        assert_eq!((report.passed, report.failed, report.not_run), (0, 0, all.len()));
        let json = serde_json::to_value(&report.cases[0]).unwrap();
        assert_eq!(
            (json["verdict"].as_str(), json["note"].as_str()),
            (Some("not run"), Some("no Vulkan device: no Vulkan here"))
        );
        assert!(json["error"].is_null());
    }

    #[test]
    fn of_several_seeds_the_first_that_fails_is_told_else_the_worst() {
        let case = |f: fn(u64) -> f64| Case::new("x", "", "", "", 1.0, f);
        let told = |f, seeds| worst(&case(f), seeds).map(|r| (r.seed, r.verdict, r.error));
        let hump: fn(u64) -> f64 = |seed| 0.9 - 0.1 * (seed as f64 - 5.0).abs();
        assert_eq!(told(hump, 1..=9), Some((5, CaseVerdict::Pass, Some(0.9))));
        let climb: fn(u64) -> f64 = |seed| 0.25 * seed as f64;
        assert_eq!(told(climb, 1..=9), Some((5, CaseVerdict::Fail, Some(1.25))));
        assert_eq!(told(climb, u64::MAX..=u64::MAX).map(|r| r.0), Some(u64::MAX));
        #[allow(clippy::reversed_empty_ranges)]
        let none = told(climb, 2..=1);
        assert_eq!(none, None);
        // The seed that is told replays the case, bit for bit.
        let own = cases().into_iter().find(|c| c.name == "predictor-at-rest").unwrap();
        let found = worst(&own, 7..=9).unwrap();
        assert_eq!(run_case(&own, found.seed).error, found.error);
        assert!((7..=9).filter(|s| *s != found.seed).all(|s| run_case(&own, s).error < found.error));
    }

    #[test]
    fn failures_are_told_apart() {
        let case = |bound, f: fn(u64) -> f64| Case::new("x", "", "", "", bound, f);
        assert_eq!(run_case(&case(1.0, |_| 1.0), 1).verdict, CaseVerdict::Pass);
        assert_eq!(run_case(&case(1.0, |_| 1.1), 1).verdict, CaseVerdict::Fail);
        let nan = run_case(&case(1.0, |_| f64::NAN), 1);
        assert!(nan.verdict == CaseVerdict::Fail && nan.error.is_none() && nan.note.unwrap().contains("NaN"));
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(|_| {}));
        let panicked = run_case(&case(1.0, |_| panic!("boom")), 7);
        std::panic::set_hook(hook);
        assert!(panicked.verdict == CaseVerdict::Fail && panicked.note.unwrap().contains("boom"));
        assert_eq!(panicked.seed, 7);
        let json = serde_json::to_value(run_case(&case(1.0, |_| 0.5), 3)).unwrap();
        assert_eq!((json["verdict"].as_str(), json["error"].as_f64()), (Some("pass"), Some(0.5)));
    }
}
