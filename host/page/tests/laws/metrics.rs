//! The metrics are those of the report, in the text that Prometheus reads.

use crate::common::RunWithPage;
use dpm_page::metrics::FAMILIES;
use std::collections::{BTreeMap, BTreeSet};

/// Values by name and labels, as they stand in the text.
type Values = BTreeMap<String, f64>;

/// Reads the text as strictly as its grammar is: a family begins with its help and type, each of its lines bears its
/// name, and nothing occurs twice.
fn parse(text: &str) -> Values {
    let (mut values, mut families) = (Values::new(), BTreeSet::new());
    let (mut family, mut kind) = ("", "");
    assert!(text.ends_with('\n'));
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (name, help) = rest.split_once(' ').expect("a help text");
            assert!(!help.trim().is_empty() && families.insert(name), "{name}");
            let told = lines.next().and_then(|l| l.strip_prefix("# TYPE ")).expect("the type after the help");
            let (same, its_kind) = told.split_once(' ').expect("a type");
            assert!(same == name && ["counter", "gauge", "histogram"].contains(&its_kind), "{told}");
            assert_eq!(name.ends_with("_total"), its_kind == "counter", "{told}");
            (family, kind) = (name, its_kind);
            continue;
        }
        let (key, value) = line.rsplit_once(' ').unwrap_or_else(|| panic!("{line}"));
        let name = key.split('{').next().unwrap();
        assert!(
            name.starts_with("dpm_") && name.bytes().all(|b| b == b'_' || b.is_ascii_lowercase()),
            "{name}"
        );
        let suffix = name.strip_prefix(family).unwrap_or_else(|| panic!("{line} in {family}"));
        let suffixes: &[&str] = if kind == "histogram" { &["_bucket", "_sum", "_count"] } else { &[""] };
        assert!(suffixes.contains(&suffix), "{line}");
        if let Some(labels) = key.strip_prefix(name).filter(|l| !l.is_empty()) {
            let inner = labels.strip_prefix('{').and_then(|l| l.strip_suffix('}')).expect("braces");
            // Every label is closed; the values of this test hold no escaped quotes.
            assert_eq!(inner.matches('"').count(), 2 * inner.matches("=\"").count(), "{labels}");
        }
        let value: f64 = value.parse().unwrap_or_else(|_| panic!("{line}"));
        assert!(kind != "counter" || value >= 0.0, "{line}");
        assert!(values.insert(key.to_owned(), value).is_none(), "twice: {key}");
    }
    values
}

#[test]
fn the_manual_lists_every_metric_as_it_is() {
    let manual = include_str!("../../../../docs/PAGE.md");
    let listed: Vec<&str> = manual.lines().filter(|line| line.starts_with("| `dpm_")).collect();
    let known: Vec<String> =
        FAMILIES.iter().map(|(name, kind, help)| format!("| `{name}` | {kind} | {help} |")).collect();
    assert_eq!(listed, known);
}

#[test]
fn counters_equal_the_report_and_histograms_add_up() {
    let mut rig = RunWithPage::start("metrics");
    rig.order("black");
    let dark = "dpm_slots_ordered_dark_total{reason=\"black\"}";
    rig.wait("a dark slot", || {
        parse(&rig.ask("GET", "/metrics", &[]).body).get(dark).is_some_and(|n| *n > 0.0)
    });
    rig.order("arm");
    let during = parse(&rig.ask("GET", "/metrics", &[]).body);
    let before = rig.monitor.counts().frames_lit;
    rig.wait("more light", || rig.monitor.counts().frames_lit > before + 5);
    let later = parse(&rig.ask("GET", "/metrics", &[]).body);
    for (key, value) in during.iter().filter(|(key, _)| key.contains("_total") || key.contains("_bucket")) {
        assert!(later[key] >= *value, "{key} fell");
    }
    assert_eq!((later["dpm_light_state{state=\"lit\"}"], later["dpm_body_lit{body=\"bunny\"}"]), (1.0, 1.0));
    assert_eq!(later["dpm_light_state{state=\"dark\"}"], 0.0);
    let outcome = rig.end_run();
    let report = outcome.report;
    let text = rig.ask("GET", "/metrics", &[]).body;
    let told = parse(&text);
    let mut expected: Values = [
        ("dpm_frames_total{fate=\"lit\"}", report.frames_lit),
        ("dpm_frames_total{fate=\"dark\"}", report.frames_dark),
        ("dpm_frames_total{fate=\"dropped\"}", report.frames_dropped),
        ("dpm_frames_total{fate=\"withheld\"}", report.frames_withheld),
        ("dpm_frames_total{fate=\"unrecorded\"}", report.frames_unrecorded),
        ("dpm_frames_late_total", report.frames_late),
        ("dpm_frames_repeated_total", report.frames_repeated),
        ("dpm_frames_too_old_total", report.frames_too_old),
        ("dpm_slots_total", report.slots),
    ]
    .into_iter()
    .map(|(key, n)| (key.to_owned(), n as f64))
    .collect();
    for (cause, n) in &report.missed_by_cause {
        expected.insert(format!("dpm_slots_missed_total{{cause=\"{cause}\"}}"), *n as f64);
    }
    for (reason, n) in &report.ordered_dark {
        expected.insert(format!("dpm_slots_ordered_dark_total{{reason=\"{reason}\"}}"), *n as f64);
    }
    let link = report.projector.expect("a link");
    expected.insert("dpm_link_sent_bytes_total".into(), (link.sent_mb * 1e6).round());
    expected.insert("dpm_link_sessions_total".into(), link.sessions as f64);
    for (key, n) in &expected {
        assert_eq!(told.get(key), Some(n), "{key}");
    }
    assert!(report.frames_lit > 0 && report.ordered_dark["black"] > 0, "the run says something");
    // Every frame that was planned has one fate.
    let fates = report.frames_lit
        + report.frames_dark
        + report.frames_dropped
        + report.frames_withheld
        + report.frames_unrecorded;
    assert_eq!(told["dpm_frames_planned_total"], fates as f64);
    histograms(&told, &outcome.profiler);
    // Every metric is told of, and no other.
    let named: Vec<&str> =
        text.lines().filter_map(|l| l.strip_prefix("# TYPE ")?.split(' ').next()).collect();
    assert_eq!(named, FAMILIES.iter().map(|f| f.0).collect::<Vec<_>>());
}

fn histograms(told: &Values, profiler: &dpm_rig::telemetry::profile::Profiler) {
    use dpm_rig::telemetry::interval::Interval;
    for interval in Interval::ALL {
        let label = format!("interval=\"{}\"", interval.name());
        let of = |key: &str| told[&format!("dpm_interval_seconds_{key}")];
        let histogram = profiler.histogram(interval);
        let count = histogram.early().len() + histogram.late().len();
        assert_eq!(of(&format!("count{{{label}}}")), count as f64);
        let mut buckets: Vec<(f64, f64)> = told
            .iter()
            .filter(|(key, _)| key.starts_with("dpm_interval_seconds_bucket") && key.contains(&label))
            .map(|(key, n)| {
                let le = key.split("le=\"").nth(1).unwrap().split('"').next().unwrap();
                (if le == "+Inf" { f64::INFINITY } else { le.parse().unwrap() }, *n)
            })
            .collect();
        buckets.sort_by(|a, b| a.0.total_cmp(&b.0));
        assert!(buckets.windows(2).all(|w| w[0].0 < w[1].0 && w[0].1 <= w[1].1), "{label}: {buckets:?}");
        assert_eq!(buckets.last(), Some(&(f64::INFINITY, count as f64)));
        // The median lies in the bucket that the counts say.
        let median_s = histogram.value_at_quantile(0.5) as f64 * 1e-9;
        for (le, n) in buckets.iter().filter(|_| count > 0) {
            if median_s <= le * 0.998 {
                assert!(*n >= 0.5 * count as f64, "{label}: {n} of {count} up to {le}, median {median_s}");
            }
        }
    }
}

/// Black is no picture of the other program, and a body that never had one is told of in the report.
#[test]
fn pictures_of_other_programs_are_counted() {
    let bodies = "scene.bodies=[{ name = \"bunny\", texture = \"pipe:/nowhere/a\", texture_size = [1, 1] }, \
                  { name = \"venus\", texture = \"pipe:/nowhere/b\" }]";
    let mut rig =
        RunWithPage::with("pictures", &["real_time.pace=\"real\"", "projector.frame_rate=\"100/1\"", bodies]);
    let count = |name: &str| {
        parse(&rig.ask("GET", "/metrics", &[]).body)[&format!("dpm_live_pictures_total{{body=\"{name}\"}}")]
    };
    assert_eq!(count("bunny"), 0.0);
    let live = rig.monitor.live().rig().expect("it runs").clone();
    let (_, _, pictures) = live.live_pictures().next().expect("the bunny's");
    for _ in 0..3 {
        pictures.show(&[[1, 2, 3, 255]]);
    }
    pictures.show_black();
    assert_eq!((count("bunny"), count("venus")), (3.0, 0.0));
    let warnings = rig.end_run().report.warnings;
    let told: Vec<&String> = warnings.iter().filter(|told| told.contains("no picture has come")).collect();
    assert!(told.len() == 1 && told[0].starts_with("venus: pipe:/nowhere/b"), "{warnings:?}");
}
