//! Two profiling reports into a verdict per figure: better, worse, or no more than noise.
//!
//! The noise of a figure is known from the batches of its run: the standard error of their mean. Welch's test compares the two
//! means; neighbouring batches are not quite independent, so the level is strict (0.1 %) and a difference must also exceed
//! the histogram's own resolution.
//!
//! Two figures are gates: the share of slots without a frame of their own, raw, and the share of frames that were lit late. A comparison in
//! which one of them got worse fails. What a viewer sees is the missed slots: a change that drops frames makes no other figure worse.

use dpm_rig::telemetry::profile::ProfileReport;
use std::fmt::Write;

/// Differences below this share of the value are the histogram's resolution, not a finding.
const RESOLUTION: f64 = 2e-3;

/// What became of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FigureChange {
    /// Lower by more than noise.
    Better,
    /// Higher by more than noise.
    Worse,
    /// Not told apart from noise.
    Same,
    /// Too few batches to know the noise.
    Unknown,
}

impl FigureChange {
    /// As printed.
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Better => "better",
            Self::Worse => "WORSE",
            Self::Same => "same within noise",
            Self::Unknown => "noise unknown",
        }
    }
}

/// A figure in both reports. All figures are times or counts: less is better.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Interval and quantile.
    pub figure: String,
    /// In the first report, ms or %.
    pub before: f64,
    /// In the second, ms or %.
    pub after: f64,
    /// Half-width of the interval of the difference, ms or %, at 99.9 %, of missed slots at 99 %; `None` when unknown.
    pub noise: Option<f64>,
    /// What that means.
    pub verdict: FigureChange,
    /// A figure that must not get worse.
    pub gate: bool,
}

/// The gates that got worse, by name; a comparison without any passes.
pub fn failed_gates(rows: &[Comparison]) -> Vec<&str> {
    rows.iter().filter(|r| r.gate && r.verdict == FigureChange::Worse).map(|r| r.figure.as_str()).collect()
}

/// Compares every interval's median and 99th percentile, and the shares of missed slots and late frames. Figures that only one report has
/// are left out and named in the second return value, together with differences in the setup.
pub fn compare(before: &ProfileReport, after: &ProfileReport) -> (Vec<Comparison>, Vec<String>) {
    let mut notes = Vec::new();
    for (key, a) in &before.setup {
        match after.setup.get(key) {
            Some(b) if a == b => {}
            Some(b) => notes.push(format!("{key} differs: {a} before, {b} after")),
            None => notes.push(format!("{key} is only in the first report: {a}")),
        }
    }
    for key in after.setup.keys().filter(|k| !before.setup.contains_key(*k)) {
        notes.push(format!("{key} is only in the second report"));
    }
    let mut rows = Vec::new();
    for (name, a) in &before.intervals_ms {
        let Some(b) = after.intervals_ms.get(name) else {
            notes.push(format!("{name} is only in the first report"));
            continue;
        };
        if a.count == 0 || b.count == 0 {
            continue;
        }
        for (quantile, x, y, xs, ys) in [
            ("p50", a.p50, b.p50, &a.batch_p50, &b.batch_p50),
            ("p99", a.p99, b.p99, &a.batch_p99, &b.batch_p99),
        ] {
            rows.push(judge(format!("{name} {quantile}"), x, y, difference_noise(xs, ys)));
        }
    }
    for name in after.intervals_ms.keys().filter(|k| !before.intervals_ms.contains_key(*k)) {
        notes.push(format!("{name} is only in the second report"));
    }
    for (report, which) in [(before, "first"), (after, "second")] {
        if report.slots == 0 {
            notes.push(format!(
                "the {which} report tells of no slots: missed slots cannot be compared with it; make it anew with this program"
            ));
        }
        if report.intervals_ms.values().any(|d| d.modelled && d.kind == "total") {
            notes.push(format!(
                "the {which} report was made at virtual pace: its times follow from real_time.stage_costs_us and are no measurement"
            ));
        }
    }
    rows.push(missed_share(before, after));
    rows.push(late_share(before, after));
    (rows, notes)
}

fn judge(figure: String, before: f64, after: f64, noise: Option<f64>) -> Comparison {
    let difference = after - before;
    let verdict = match noise {
        None => FigureChange::Unknown,
        Some(noise) if difference.abs() <= noise.max(RESOLUTION * before.abs().max(after.abs())) => {
            FigureChange::Same
        }
        Some(_) if difference < 0.0 => FigureChange::Better,
        Some(_) => FigureChange::Worse,
    };
    Comparison { figure, before, after, noise, verdict, gate: false }
}

/// Share of the slots without a frame of their own, percent, raw: standstills of the machine excuse nothing here. Slots are missed in
/// bursts, so the noise is that of a binomial count (of at least one slot) times the dispersion of the batches, where that is above 1. The
/// level is 99 %: this is the figure that a comparison is made for.
fn missed_share(before: &ProfileReport, after: &ProfileReport) -> Comparison {
    let share = |r: &ProfileReport| {
        let n = r.slots.max(1) as f64;
        let p = r.missed_slots as f64 / n;
        let at_least_one = p.clamp(1.0 / n, 1.0);
        (100.0 * p, 1e4 * (at_least_one * (1.0 - at_least_one)).max(1.0 / n) / n)
    };
    let ((x, vx), (y, vy)) = (share(before), share(after));
    let noise = (before.slots > 0 && after.slots > 0).then(|| {
        let (a, b) = (dispersion(&before.missed_batches), dispersion(&after.missed_batches));
        let (squares, freedom) = (a.0 + b.0, a.1 + b.1);
        // Without batches to tell, misses are taken to be independent.
        let (factor, quantile) =
            if freedom >= 4.0 { ((squares / freedom).max(1.0), student_t(freedom, 0)) } else { (1.0, 2.576) };
        quantile * (factor * (vx + vy)).sqrt()
    });
    Comparison { gate: true, ..judge("missed slots, %".into(), x, y, noise) }
}

/// Sum of the squared deviations of the batches from their common share, each in units of its binomial variance, and its degrees of freedom:
/// their quotient is 1 where misses are independent, and the mean length of a burst where they are not.
fn dispersion(batches: &[(u64, u64)]) -> (f64, f64) {
    let (slots, missed) = batches.iter().fold((0, 0), |(n, m), (a, b)| (n + a, m + b));
    if batches.len() < 3 || missed == 0 || missed >= slots {
        return (0.0, 0.0);
    }
    let p = missed as f64 / slots as f64;
    let squares = batches.iter().filter(|(n, _)| *n > 0).map(|(n, m)| {
        let (n, m) = (*n as f64, *m as f64);
        (m - n * p).powi(2) / (n * p * (1.0 - p))
    });
    (squares.sum(), batches.len() as f64 - 1.0)
}

/// Share of late frames, percent; its noise is that of a binomial count (Poisson for the rare).
fn late_share(before: &ProfileReport, after: &ProfileReport) -> Comparison {
    let share = |r: &ProfileReport| {
        let n = r.frames_lit.max(1) as f64;
        let late = r.frames_late as f64;
        // One late frame more or less is always possible, also where none was seen.
        (100.0 * late / n, 1e4 * late.max(1.0) / (n * n))
    };
    let ((x, vx), (y, vy)) = (share(before), share(after));
    let known = before.frames_lit > 0 && after.frames_lit > 0;
    Comparison { gate: true, ..judge("late frames, %".into(), x, y, known.then(|| 3.29 * (vx + vy).sqrt())) }
}

/// Half-width of the 99.9 % confidence interval of the difference of two means (Welch).
fn difference_noise(a: &[f64], b: &[f64]) -> Option<f64> {
    if a.len() < 3 || b.len() < 3 {
        return None;
    }
    let moments = |v: &[f64]| {
        let n = v.len() as f64;
        let mean = v.iter().sum::<f64>() / n;
        let variance = v.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / (n - 1.0);
        (variance / n, n - 1.0)
    };
    let ((va, fa), (vb, fb)) = (moments(a), moments(b));
    let sum = va + vb;
    if sum == 0.0 {
        return Some(0.0);
    }
    let freedom = sum * sum / (va * va / fa + vb * vb / fb);
    Some(student_t(freedom, 1) * sum.sqrt())
}

/// Two-sided quantile of Student's t, of 99 % (`level` 0) or 99.9 % (`level` 1): table values, linear in 1 / freedom between them.
fn student_t(freedom: f64, level: usize) -> f64 {
    const TABLE: [(f64, [f64; 2]); 10] = [
        (2.0, [9.925, 31.599]),
        (3.0, [5.841, 12.924]),
        (4.0, [4.604, 8.610]),
        (5.0, [4.032, 6.869]),
        (7.0, [3.499, 5.408]),
        (10.0, [3.169, 4.587]),
        (15.0, [2.947, 4.073]),
        (30.0, [2.750, 3.646]),
        (60.0, [2.660, 3.460]),
        (f64::INFINITY, [2.576, 3.291]),
    ];
    let inverse = 1.0 / freedom.max(2.0);
    for pair in TABLE.windows(2) {
        let ((f0, t0), (f1, t1)) = (pair[0], pair[1]);
        if inverse >= 1.0 / f1 {
            let share = (inverse - 1.0 / f1) / (1.0 / f0 - 1.0 / f1);
            return t1[level] + share * (t0[level] - t1[level]);
        }
    }
    TABLE[TABLE.len() - 1].1[level]
}

/// A table of all figures, gates first, then worst news first.
pub fn to_table(rows: &[Comparison], notes: &[String]) -> String {
    let mut sorted: Vec<&Comparison> = rows.iter().collect();
    let rank = |v: FigureChange| match v {
        FigureChange::Worse => 0,
        FigureChange::Better => 1,
        FigureChange::Unknown => 2,
        FigureChange::Same => 3,
    };
    // Gates first, whatever became of them.
    sorted.sort_by_key(|r| (!r.gate, rank(r.verdict)));
    let mut text = format!(
        "{:<28} {:>10} {:>10} {:>9} {:>10}  verdict\n",
        "figure (ms)", "before", "after", "change", "noise"
    );
    for r in sorted {
        let change = if r.before != 0.0 {
            format!("{:+.1} %", 100.0 * (r.after / r.before - 1.0))
        } else {
            "-".into()
        };
        let noise = r.noise.map_or("?".into(), |n| format!("{n:.4}"));
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{:<28} {:>10.4} {:>10.4} {change:>9} {noise:>10}  {}{}",
            r.figure,
            r.before,
            r.after,
            r.verdict.word(),
            if r.gate { " (gate)" } else { "" }
        );
    }
    for note in notes {
        let _ = writeln!(text, "note: {note}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::telemetry::profile::Distribution;

    fn noise(seed: &mut u64) -> f64 {
        *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        // Sum of four uniforms: nearly normal, variance 1/3.
        (0..4).map(|i| (*seed >> (12 * i) & 0xfff) as f64 / 4096.0 - 0.5).sum()
    }

    fn report(p50: f64, spread: f64, late: u64, seed: u64) -> ProfileReport {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let batches: Vec<f64> = (0..10).map(|_| p50 + spread * noise(&mut state)).collect();
        let mean = batches.iter().sum::<f64>() / 10.0;
        let d = Distribution {
            count: 1000,
            p50: mean,
            p99: 2.0 * mean,
            batch_p50: batches.clone(),
            batch_p99: vec![],
            ..Default::default()
        };
        ProfileReport {
            slots: 60_000,
            frames_lit: 60_000,
            frames_late: late,
            intervals_ms: [("render".to_owned(), d)].into(),
            ..Default::default()
        }
    }

    fn verdict(a: &ProfileReport, b: &ProfileReport, figure: &str) -> FigureChange {
        compare(a, b).0.into_iter().find(|c| c.figure == figure).unwrap().verdict
    }

    /// Over many pairs from one distribution false alarms stay rare; a difference of five standard errors is always found.
    #[test]
    fn noise_is_told_from_change() {
        let (mut alarms, mut missed) = (0, 0);
        for seed in 0..1000 {
            let a = report(1.0, 0.05, 10, 2 * seed);
            let same = report(1.0, 0.05, 10, 2 * seed + 1);
            let slower = report(1.1, 0.05, 10, 2 * seed + 1);
            alarms += usize::from(verdict(&a, &same, "render p50") != FigureChange::Same);
            missed += usize::from(verdict(&a, &slower, "render p50") != FigureChange::Worse);
            assert_ne!(verdict(&slower, &a, "render p50"), FigureChange::Worse);
        }
        assert!(alarms <= 5, "{alarms} false alarms in 1000");
        assert!(missed <= 100, "{missed} changes of 10 % missed in 1000");
    }

    /// A run of `slots` in which stretches of `burst` slots are missed at random, with the share `p` of all.
    fn run(slots: u64, p: f64, burst: u64, seed: u64) -> ProfileReport {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut batches = vec![(0, 0); 40];
        let mut left = 0;
        for slot in 0..slots {
            if left == 0 && uniform() < p / (burst as f64) {
                left = burst;
            }
            let batch = &mut batches[(slot * 40 / slots) as usize];
            batch.0 += 1;
            batch.1 += u64::from(left > 0);
            left = left.saturating_sub(1);
        }
        ProfileReport {
            slots,
            missed_slots: batches.iter().map(|b| b.1).sum(),
            missed_batches: batches,
            // No frame comes late: those that are not in time are not lit at all.
            frames_lit: slots,
            ..Default::default()
        }
    }

    /// The runs "FIFO" and "FIFO + 2 CPU hogs" of the second look at latency: 84 of 22728 and 128 of 18940 slots missed, fewer late frames of
    /// those lit. Found in use: the comparison said "same within noise", as it looked at late frames only.
    #[test]
    fn a_change_that_drops_frames_fails_the_comparison() {
        let measured = |slots: u64, missed: u64, lit: u64, late: u64| ProfileReport {
            slots,
            missed_slots: missed,
            missed_share: missed as f64 / slots as f64,
            frames_lit: lit,
            frames_late: late,
            ..Default::default()
        };
        let (fifo, hogs) = (measured(22_728, 84, 22_667, 11), measured(18_940, 128, 18_850, 6));
        let (rows, notes) = compare(&fifo, &hogs);
        assert_eq!(failed_gates(&rows), ["missed slots, %"]);
        let missed = rows.iter().find(|r| r.figure == "missed slots, %").unwrap();
        assert!((missed.before - 0.370).abs() < 1e-3 && (missed.after - 0.676).abs() < 1e-3, "{missed:?}");
        assert_eq!(verdict(&fifo, &hogs, "late frames, %"), FigureChange::Same);
        assert!(to_table(&rows, &notes).lines().nth(1).unwrap().contains("WORSE (gate)"));
        // The other way round it got better, which fails nothing.
        assert_eq!(verdict(&hogs, &fifo, "missed slots, %"), FigureChange::Better);
        assert!(failed_gates(&compare(&hogs, &fifo).0).is_empty());
        // With batches of independent misses, the same.
        let (mut a, mut b) = (fifo, hogs);
        a.missed_batches = (0..32).map(|k| (710, 2 + [0, 1, 2, 0][k % 4])).collect();
        b.missed_batches = (0..32).map(|k| (592, 3 + [0, 1, 2, 1][k % 4])).collect();
        assert_eq!(failed_gates(&compare(&a, &b).0), ["missed slots, %"]);
        // A report of an older program, which tells of no slots, is no pass and no failure, but told.
        let (rows, notes) = compare(&ProfileReport { frames_lit: 100, ..Default::default() }, &b);
        assert_eq!(
            rows.iter().find(|r| r.figure == "missed slots, %").unwrap().verdict,
            FigureChange::Unknown
        );
        assert!(notes.iter().any(|n| n.contains("the first report tells of no slots")), "{notes:?}");
    }

    /// Whether misses come one by one or in bursts: pairs of the same share are seldom told apart, a share that is 1.8 times as large with
    /// single misses, or four times as large with bursts of eight, nearly always.
    #[test]
    fn the_spread_of_missed_slots_is_that_of_the_batches() {
        for (burst, worse) in [(1, 1.8), (8, 4.0)] {
            let (mut alarms, mut found) = (0, 0);
            for seed in 0..200 {
                let a = run(20_000, 0.004, burst, 3 * seed);
                let same = run(20_000, 0.004, burst, 3 * seed + 1);
                let more = run(20_000, 0.004 * worse, burst, 3 * seed + 2);
                alarms += usize::from(verdict(&a, &same, "missed slots, %") != FigureChange::Same);
                found += usize::from(verdict(&a, &more, "missed slots, %") == FigureChange::Worse);
            }
            assert!(alarms <= 10, "bursts of {burst}: {alarms} false alarms in 200");
            assert!(found >= 180, "bursts of {burst}: {found} of 200 found");
        }
    }

    #[test]
    fn no_batches_no_verdict_and_resolution_is_no_news() {
        let (a, b) = (report(1.0, 0.0, 0, 1), report(1.001, 0.0, 0, 2));
        assert_eq!(verdict(&a, &b, "render p50"), FigureChange::Same, "0.1 % is the histogram's resolution");
        assert_eq!(verdict(&a, &report(1.01, 0.0, 0, 2), "render p50"), FigureChange::Worse);
        assert_eq!(verdict(&a, &b, "render p99"), FigureChange::Unknown);
        assert_eq!(
            verdict(&report(1.0, 0.0, 3, 1), &report(1.0, 0.0, 9, 1), "late frames, %"),
            FigureChange::Same
        );
        assert_eq!(
            verdict(&report(1.0, 0.0, 3, 1), &report(1.0, 0.0, 90, 1), "late frames, %"),
            FigureChange::Worse
        );
    }

    #[test]
    fn differences_in_setup_are_named() {
        let (mut a, mut b) = (report(1.0, 0.0, 0, 1), report(1.0, 0.0, 0, 1));
        a.setup.insert("gpu".into(), "A".into());
        b.setup.insert("gpu".into(), "B".into());
        b.setup.insert("cores".into(), "2".into());
        b.intervals_ms.insert("extra".into(), Distribution::default());
        let (rows, notes) = compare(&a, &b);
        assert_eq!(notes.len(), 3, "{notes:?}");
        assert!(to_table(&rows, &notes).contains("gpu differs: A before, B after"));
    }

    #[test]
    fn t_quantiles_meet_the_table_and_fall() {
        assert!((student_t(10.0, 1) - 4.587).abs() < 1e-9 && (student_t(10.0, 0) - 3.169).abs() < 1e-9);
        assert!((student_t(1e12, 1) - 3.291).abs() < 1e-3 && (student_t(1e12, 0) - 2.576).abs() < 1e-3);
        for level in [0, 1] {
            let values: Vec<f64> = (2..200).map(|f| student_t(f64::from(f), level)).collect();
            assert!(values.windows(2).all(|w| w[1] < w[0]));
        }
    }
}
