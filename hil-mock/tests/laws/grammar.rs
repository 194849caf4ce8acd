//! The grammar of faults as `docs/TRACKERS.md` tells it, held to the parser.

use hil_mock::faults::{FaultKind, FaultPlan};
use std::collections::BTreeMap;
use std::path::PathBuf;

fn document() -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../docs/TRACKERS.md");
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The table of kinds: name to what it says of the amount and of the time.
fn table() -> BTreeMap<String, (String, String)> {
    let text = document();
    let rows = text.lines().skip_while(|l| *l != "| kind | amount | when | what happens |").skip(2);
    rows.take_while(|l| l.starts_with('|'))
        .map(|row| {
            let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
            let [name, amount, when, what] = cells[..] else { panic!("four columns: {row}") };
            assert!(what.len() > 10, "{row}");
            (name.trim_matches('`').to_owned(), (amount.to_owned(), when.to_owned()))
        })
        .collect()
}

fn parses(plan: &str) -> bool {
    plan.parse::<FaultPlan>().is_ok()
}

/// Noticed in use: the grammar of faults stood in a source file only. Every word of it stands in the document, and what the document
/// says of it is what the parser does.
#[test]
fn the_document_names_every_fault_and_says_what_it_takes() {
    let table = table();
    let names: Vec<&str> = table.keys().map(String::as_str).collect();
    let mut known: Vec<&str> = FaultKind::ALL.iter().map(|k| k.name()).collect();
    known.sort_unstable();
    assert_eq!(names, known);
    for (name, (amount, when)) in &table {
        // A right amount, a wrong one, and whether it may be left out.
        let (right, wrong, optional) = match amount.as_str() {
            // Left out, it is 1; see below.
            "probability" => ("=0.5", "=2", true),
            "metres" => ("=3", "=3ms", false),
            "body" => ("=2", "=0", false),
            "duration" => ("=2ms", "=2", false),
            "none" => ("", "=0.5", true),
            other => panic!("{name}: an amount of {other}?"),
        };
        let (never, at, during) = match when.as_str() {
            "any" => (true, true, true),
            "start" => (false, true, true),
            "window" => (false, false, true),
            other => panic!("{name}: when is {other}?"),
        };
        for (time, is_right) in [("", never), ("@1s", at), ("@1s+20ms", during), ("@1s+20ms/500ms", during)] {
            let plan = format!("{name}{right}{time}");
            assert_eq!(parses(&plan), is_right, "{plan}: {amount}, {when}");
        }
        let window = "@1s+20ms";
        assert!(!parses(&format!("{name}{wrong}{window}")), "{name}{wrong}: {amount}");
        assert_eq!(parses(&format!("{name}{window}")), optional, "{name} without an amount: {amount}");
    }
    // What is said around the table.
    for (name, _) in table.iter().filter(|(_, (amount, _))| amount == "probability") {
        assert_eq!(parses(name), name == "invalid", "{name} alone");
        assert_eq!(format!("{name}@1s").parse::<FaultPlan>().unwrap().faults()[0].amount, 1.0);
    }
    let text = document();
    assert!(text.contains("kind[=amount][@start[+length][/period]]"));
    for unit in ["ns", "us", "ms", "s"] {
        assert!(text.contains(&format!("`{unit}`")) && parses(&format!("slow=2{unit}")), "{unit}");
    }
    assert!(!parses("slow=2h"));
    let many = vec!["loss=0.1"; FaultPlan::MAX_FAULTS].join(",");
    assert!(text.contains(&format!("up to {} entries", FaultPlan::MAX_FAULTS)));
    assert!(parses(&many) && !parses(&format!("{many},loss=0.1")));
    let examples: Vec<&str> = text.lines().filter_map(|l| l.strip_prefix("--faults ")).collect();
    assert!(examples.len() >= 5);
    for example in examples {
        let plan = example.split_whitespace().next().expect("a plan");
        assert!(parses(plan), "{plan}");
    }
}
