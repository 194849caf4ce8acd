//! The committed table belongs to the shaders of this tree, is complete, and keeps its laws.

use gpu_compile::table::{inputs, is_by_query, Row, Table};
use gpu_compile::targets::{Maker, Target, ALL};
use gpu_compile::{cases, laws, page};
use std::path::Path;

/// Makes a row worse.
type Change = fn(&mut Row);

const REMEDY: &str = "run ./x gpu-compile --record";

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

fn committed() -> Table {
    page::committed(root()).unwrap_or_else(|e| panic!("{e}")).unwrap_or_else(|| panic!("no table: {REMEDY}"))
}

#[test]
fn the_table_is_of_the_pipelines_of_this_tree() {
    let today: Vec<_> = cases::all().unwrap_or_else(|e| panic!("{e}")).iter().flat_map(inputs).collect();
    let table = committed();
    let changed: Vec<_> = today.iter().filter(|i| !table.inputs.contains(i)).collect();
    assert!(changed.is_empty(), "{REMEDY}: these were compiled in another form: {changed:?}");
    assert_eq!(today.len(), table.inputs.len(), "{REMEDY}: there are fewer pipelines");
}

#[test]
fn every_pipeline_has_one_row_for_every_target_that_can_run_it() {
    let table = committed();
    let mut due = 0;
    for input in &table.inputs {
        for target in ALL.iter().filter(|target| target.ray_query || !is_by_query(&input.pass)) {
            due += 1;
            let same =
                |r: &&Row| (&r.case, &r.pass, r.target.as_str()) == (&input.case, &input.pass, target.name);
            let rows: Vec<_> = table.passes.iter().filter(same).collect();
            assert_eq!(rows.len(), 1, "{} of {} on {}", input.pass, input.case, target.name);
            assert_eq!(rows[0].current, target.current);
            assert!(rows[0].instructions > 50 && rows[0].registers > 4, "{:?}", rows[0]);
        }
    }
    assert_eq!(table.passes.len(), due);
    for pass in ["primary", "trace"] {
        assert!(table.inputs.iter().any(|i| is_by_query(&i.pass) && i.pass.starts_with(pass)), "{pass}");
    }
}

#[test]
fn on_current_amd_drivers_nothing_spills_and_enough_waves_fit() {
    let broken = laws::broken(&committed());
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn every_broken_law_is_seen() {
    let good = committed();
    let row = |table: &mut Table, pass: &str, change: Change| {
        let amd = |r: &&mut Row| r.target.starts_with("navi31, RADV 25") && r.pass == pass;
        change(table.passes.iter_mut().find(amd).expect("such a row"));
    };
    let changes: [(&str, Change); 5] = [
        ("trace", |r| r.spills = 1),
        ("compensate", |r| r.scratch = 4),
        ("primary", |r| r.waves = Some(laws::WAVES_OF_WALKS - 1)),
        ("spatial", |r| r.waves = Some(laws::WAVES - 1)),
        ("trace by ray query", |r| r.waves = Some(laws::WAVES_OF_WALKS - 1)),
    ];
    for (pass, change) in changes {
        let mut bad = good.clone();
        row(&mut bad, pass, change);
        assert_eq!(laws::broken(&bad).len(), 1, "{pass}");
        assert_eq!(laws::worse(&bad, &good).len(), 1, "{pass}");
        assert_eq!(laws::worse(&good, &bad).len(), 0, "{pass}: better is not worse");
    }
    // A driver that is no more current may spill as much as it did, and not one register more.
    let mut bad = good.clone();
    let old = |r: &&mut Row| Target::named(&r.target).is_some_and(|t| t.maker == Maker::Amd && !t.current);
    bad.passes.iter_mut().find(old).expect("an old driver").spills += 1;
    assert_eq!((laws::broken(&bad).len(), laws::worse(&bad, &good).len()), (0, 1));
}

#[test]
fn the_page_shows_the_table() {
    let text = std::fs::read_to_string(root().join(page::PAGE)).unwrap();
    assert_eq!(page::with_table(&text, &committed()).as_deref(), Some(text.as_str()), "{REMEDY}");
    assert_eq!(page::with_table("no marks", &committed()), None);
}
