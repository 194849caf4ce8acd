//! All stability cases on the GPU, the slow ones among them, with validation.

use dpm_lab::stability::gpu::cases;
use dpm_lab::stability::{StabilityReport, SEED};
use dpm_tests::gpu::with_gpu;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

/// Number of cases that run at the same time, each on a device of its own. A case keeps little more than one core busy,
/// and one after the other took six minutes.
const WORKERS: usize = 2;

/// Every case, because those that guard the newest code are among the slow ones.
#[test]
fn every_case_passes_on_the_gpu() {
    let next = AtomicUsize::new(0);
    let report = Mutex::new(StabilityReport::default());
    let worker = || {
        with_gpu(|gpu| {
            let all = cases(&Ok(gpu.clone()));
            assert!(all.len() >= 50, "{}", all.len());
            while let Some(case) = all.get(next.fetch_add(1, Ordering::Relaxed)) {
                let mut one = StabilityReport::default();
                one.run_cases(std::slice::from_ref(case), None, SEED..=SEED, |c| {
                    println!("{:<28} {:?} <= {} {} {:.1} s", c.name, c.error, c.bound, c.unit, c.wall_s);
                });
                report.lock().unwrap().cases.extend(one.cases);
            }
        });
    };
    std::thread::scope(|threads| {
        for _ in 0..WORKERS {
            threads.spawn(worker);
        }
    });
    let report = report.into_inner().unwrap();
    let all = cases(&Err("only to be counted".into())).len();
    assert_eq!(report.cases.len(), all);
    let failed: Vec<_> = report.cases.iter().filter(|c| !c.verdict.is_as_known()).collect();
    assert!(failed.is_empty(), "{failed:#?}");
}
