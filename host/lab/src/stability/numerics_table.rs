//! The declarations of the cases into the tables of `docs/lab/CASES.md` and `docs/lab/NUMERICS.md`, and the pages held to them.

use super::{cases, gpu, Case};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How the tables are written anew.
const RENEW: &str = "DPM_UPDATE_MANUAL=1 cargo test -p dpm-lab --lib numerics_table";
/// Head of the table of declarations.
const DECLARED: &str = "| case | input | compared with | bound | unit |\n|---|---|---|---:|---|\n";
/// Head of the table of measured errors.
const MEASURED: &str = "| case | error | bound | unit |\n|---|---:|---:|---|\n";

fn all_cases() -> Vec<Case> {
    let mut all = cases();
    all.extend(gpu::cases(&Err("the declarations need no device".into())));
    all
}

fn page(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs").join(name)
}

/// A bound as people write it: the powers of ten only where a number would be long.
fn number(bound: f64) -> String {
    if bound == 0.0 || bound >= 1e-4 {
        format!("{bound}")
    } else {
        format!("{bound:e}")
    }
}

/// The table of declarations.
fn declared(cases: &[Case]) -> String {
    let row = |c: &Case| {
        format!("| `{}` | {} | {} | {} | {} |\n", c.name, c.input, c.oracle, number(c.bound), c.unit)
    };
    cases.iter().map(row).collect()
}

/// The table of measured errors: the errors are those of the rows in `old`, a dash where a case has none yet.
fn measured(cases: &[Case], old: &str) -> String {
    let errors: BTreeMap<&str, &str> = (old.lines())
        .filter_map(|line| {
            let mut cells = line.split(" | ");
            Some((cells.next()?.trim_start_matches("| "), cells.next()?))
        })
        .collect();
    let row = |c: &Case| {
        let name = format!("`{}`", c.name);
        let error = errors.get(name.as_str()).unwrap_or(&"-");
        format!("| {name} | {error} | {} | {} |\n", number(c.bound), c.unit)
    };
    cases.iter().map(row).collect()
}

/// A page whose table under `head` has the rows that `rows` makes of its present ones.
fn renewed(text: &str, head: &str, rows: impl Fn(&str) -> String) -> String {
    let (before, rest) = text.split_once(head).expect("the page has the table");
    let length = rest.split_inclusive('\n').take_while(|line| line.starts_with('|')).map(str::len).sum();
    let (old, after) = rest.split_at(length);
    format!("{before}{head}{}{after}", rows(old))
}

/// Holds a page to its table, or writes it anew where that is asked for.
fn assert_up_to_date(name: &str, head: &str, rows: impl Fn(&str) -> String) {
    let path = page(name);
    let written = std::fs::read_to_string(&path).unwrap();
    let wanted = renewed(&written, head, rows);
    if std::env::var_os("DPM_UPDATE_MANUAL").is_some() {
        std::fs::write(&path, &wanted).unwrap();
    } else {
        assert!(written == wanted, "the table of docs/{name} is stale: {RENEW}");
    }
}

#[test]
fn the_page_declares_every_case_as_the_code_does() {
    let all = all_cases();
    assert_up_to_date("lab/CASES.md", DECLARED, |_| declared(&all));
    assert!(std::fs::read_to_string(page("lab/CASES.md")).unwrap().contains(RENEW));
}

#[test]
fn every_measured_error_stands_beside_the_bound_of_today() {
    let all = all_cases();
    assert_up_to_date("lab/NUMERICS.md", MEASURED, |old| measured(&all, old));
}

/// Prose and the other tables name cases too, or all of a group by what their names begin with.
#[test]
fn no_page_names_a_case_that_is_gone() {
    let all = all_cases();
    let groups: Vec<String> =
        all.iter().filter_map(|c| Some(c.name.split_once('-')?.0.to_owned() + "-")).collect();
    for name in ["NUMERICS.md", "lab/CASES.md", "lab/NUMERICS.md"] {
        let text = std::fs::read_to_string(page(name)).unwrap();
        let words = text.split('`').skip(1).step_by(2).filter(|w| groups.iter().any(|g| w.starts_with(g)));
        let gone: Vec<&str> = words
            .filter(|w| !all.iter().any(|c| c.name == *w || (w.ends_with('-') && c.name.starts_with(*w))))
            .collect();
        assert!(gone.is_empty(), "docs/{name} names {gone:?}");
    }
}

#[test]
fn a_table_is_renewed_in_its_place_and_keeps_what_was_measured() {
    let case = |name, bound| Case::new(name, "i", "o", "u", bound, |_| 0.0);
    let cases = [case("a-one", 2e-6), case("b-two", 0.0), case("c-three", 1.5e-2)];
    let page = format!("above\n{MEASURED}| `b-two` | 7 | 1 | m |\n| `z-gone` | 8 | 1 | m |\n\nbelow | a\n");
    let made = renewed(&page, MEASURED, |old| measured(&cases, old));
    let rows = "| `a-one` | - | 2e-6 | u |\n| `b-two` | 7 | 0 | u |\n| `c-three` | - | 0.015 | u |\n";
    assert_eq!(made, format!("above\n{MEASURED}{rows}\nbelow | a\n"));
    assert_eq!(renewed(&made, MEASURED, |old| measured(&cases, old)), made);
    assert_eq!(declared(&cases[2..]), "| `c-three` | i | o | 0.015 | u |\n");
}
