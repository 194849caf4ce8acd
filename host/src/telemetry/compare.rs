//! Two profiling reports into a verdict per figure: better, worse, or no more than noise.
//!
//! The noise of a figure is known from the batches of its run: the standard error of their mean. Welch's test compares the two
//! means; neighbouring batches are not quite independent, so the level is strict (0.1 %) and a difference must also exceed
//! the histogram's own resolution.

use super::profile::ProfileReport;
use std::fmt::Write;

/// Differences below this share of the value are the histogram's resolution, not a finding.
const RESOLUTION: f64 = 2e-3;

/// What became of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Lower by more than noise.
    Better,
    /// Higher by more than noise.
    Worse,
    /// Not told apart from noise.
    Same,
    /// Too few batches to know the noise.
    Unknown,
}

impl Verdict {
    /// As printed.
    pub const fn word(self) -> &'static str {
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
    /// In the first report, ms.
    pub before: f64,
    /// In the second, ms.
    pub after: f64,
    /// Half-width of the 99.9 % interval of the difference, ms; `None` when unknown.
    pub noise: Option<f64>,
    /// What that means.
    pub verdict: Verdict,
}

/// Compares every interval's median and 99th percentile, and the share of late frames. Figures that only one report has are left
/// out and named in the second return value, together with differences in the setup.
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
    rows.push(late_share(before, after));
    (rows, notes)
}

fn judge(figure: String, before: f64, after: f64, noise: Option<f64>) -> Comparison {
    let difference = after - before;
    let verdict = match noise {
        None => Verdict::Unknown,
        Some(noise) if difference.abs() <= noise.max(RESOLUTION * before.abs().max(after.abs())) => {
            Verdict::Same
        }
        Some(_) if difference < 0.0 => Verdict::Better,
        Some(_) => Verdict::Worse,
    };
    Comparison { figure, before, after, noise, verdict }
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
    judge("late frames, %".into(), x, y, known.then(|| 3.29 * (vx + vy).sqrt()))
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
    Some(student_t_999(freedom) * sum.sqrt())
}

/// Two-sided 99.9 % quantile of Student's t: table values, linear in 1 / freedom between them.
fn student_t_999(freedom: f64) -> f64 {
    const TABLE: [(f64, f64); 10] = [
        (2.0, 31.599),
        (3.0, 12.924),
        (4.0, 8.610),
        (5.0, 6.869),
        (7.0, 5.408),
        (10.0, 4.587),
        (15.0, 4.073),
        (30.0, 3.646),
        (60.0, 3.460),
        (f64::INFINITY, 3.291),
    ];
    let inverse = 1.0 / freedom.max(2.0);
    for pair in TABLE.windows(2) {
        let ((f0, t0), (f1, t1)) = (pair[0], pair[1]);
        if inverse >= 1.0 / f1 {
            let share = (inverse - 1.0 / f1) / (1.0 / f0 - 1.0 / f1);
            return t1 + share * (t0 - t1);
        }
    }
    TABLE[TABLE.len() - 1].1
}

/// A table of all figures, worst news first.
pub fn to_table(rows: &[Comparison], notes: &[String]) -> String {
    let mut sorted: Vec<&Comparison> = rows.iter().collect();
    let rank = |v: Verdict| match v {
        Verdict::Worse => 0,
        Verdict::Better => 1,
        Verdict::Unknown => 2,
        Verdict::Same => 3,
    };
    sorted.sort_by_key(|r| rank(r.verdict));
    let mut text = format!(
        "{:<24} {:>10} {:>10} {:>9} {:>10}  verdict\n",
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
            "{:<24} {:>10.4} {:>10.4} {change:>9} {noise:>10}  {}",
            r.figure,
            r.before,
            r.after,
            r.verdict.word()
        );
    }
    for note in notes {
        let _ = writeln!(text, "note: {note}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::profile::Distribution;
    use super::*;

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
            frames_lit: 60_000,
            frames_late: late,
            intervals_ms: [("render".to_owned(), d)].into(),
            ..Default::default()
        }
    }

    fn verdict(a: &ProfileReport, b: &ProfileReport, figure: &str) -> Verdict {
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
            alarms += usize::from(verdict(&a, &same, "render p50") != Verdict::Same);
            missed += usize::from(verdict(&a, &slower, "render p50") != Verdict::Worse);
            assert_ne!(verdict(&slower, &a, "render p50"), Verdict::Worse);
        }
        assert!(alarms <= 5, "{alarms} false alarms in 1000");
        assert!(missed <= 100, "{missed} changes of 10 % missed in 1000");
    }

    #[test]
    fn no_batches_no_verdict_and_resolution_is_no_news() {
        let (a, b) = (report(1.0, 0.0, 0, 1), report(1.001, 0.0, 0, 2));
        assert_eq!(verdict(&a, &b, "render p50"), Verdict::Same, "0.1 % is the histogram's resolution");
        assert_eq!(verdict(&a, &report(1.01, 0.0, 0, 2), "render p50"), Verdict::Worse);
        assert_eq!(verdict(&a, &b, "render p99"), Verdict::Unknown);
        assert_eq!(
            verdict(&report(1.0, 0.0, 3, 1), &report(1.0, 0.0, 9, 1), "late frames, %"),
            Verdict::Same
        );
        assert_eq!(
            verdict(&report(1.0, 0.0, 3, 1), &report(1.0, 0.0, 90, 1), "late frames, %"),
            Verdict::Worse
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
        assert!((student_t_999(10.0) - 4.587).abs() < 1e-9);
        assert!((student_t_999(1e12) - 3.291).abs() < 1e-3);
        let values: Vec<f64> = (2..200).map(|f| student_t_999(f64::from(f))).collect();
        assert!(values.windows(2).all(|w| w[1] < w[0]));
    }
}
