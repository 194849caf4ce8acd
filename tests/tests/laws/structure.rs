//! Checks the structure of the sources: every file belongs to a module, only one file of the rig names the mocks, no
//! folders of a crate import each other in a circle, a crate has one program of integration tests, and the commit tier
//! costs what it may. Cargo checks the dependencies between crates.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Crates whose folders are free of circles.
const CRATES: [&str; 24] = [
    "device",
    "hil-mock",
    "host/common",
    "host/alp",
    "host/dlpc900",
    "host/dlpc900-rig",
    "host/mock",
    "host/calibrate",
    "host/calibration",
    "host/camera",
    "host/camera-files",
    "host/calibration-file",
    "host/display",
    "host/ktx2",
    "host/scene",
    "host/tracking",
    "host/render",
    "host/rig",
    "host/profile",
    "host/pupil",
    "host/rehearsal",
    "host/lab",
    "host/page",
    "host/dpm",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The Rust files below `folder`, with their texts.
fn sources(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut all = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() {
            all.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            all.push((path, text));
        }
    }
    all.sort();
    all
}

/// The code of a file: without its comments, and without the module of tests at its end. A module that lies in a file of its own is
/// only declared, and what follows its declaration is code.
fn code(text: &str) -> String {
    let has_a_body = |at: &usize| text[*at..].lines().nth(1).is_some_and(|line| line.ends_with('{'));
    let mut modules = text.match_indices("#[cfg(test)]\nmod ").map(|(at, _)| at);
    let end = modules.find(has_a_body).unwrap_or(text.len());
    text[..end].lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// The names that follow `mark` in `text`.
fn names_after<'a>(text: &'a str, mark: &'a str) -> impl Iterator<Item = &'a str> {
    text.split(mark).skip(1).map(|rest| {
        let end = rest.find(|c: char| c != '_' && !c.is_ascii_alphanumeric()).unwrap_or(rest.len());
        &rest[..end]
    })
}

/// Files of `all`, the sources in the folder `src`, that no module declares.
fn undeclared(src: &Path, all: &[(PathBuf, String)]) -> Vec<PathBuf> {
    let mut declared: BTreeSet<PathBuf> = ["lib.rs", "main.rs"].map(|root| src.join(root)).into();
    for (path, text) in all {
        let folder = path.parent().expect("in a folder");
        let stem = path.file_stem().expect("a name");
        let inner =
            if ["lib", "main", "mod"].iter().any(|s| stem == *s) { folder.into() } else { folder.join(stem) };
        for name in names_after(text, "mod ") {
            declared.extend([inner.join(format!("{name}.rs")), inner.join(name).join("mod.rs")]);
        }
        // Tests in a separate file beside the file that they test.
        for path in text.split("#[path = \"").skip(1).filter_map(|rest| rest.split('"').next()) {
            declared.extend([folder.join(path), inner.join(path)]);
        }
    }
    all.iter().map(|(path, _)| path.clone()).filter(|path| !declared.contains(path)).collect()
}

#[test]
fn no_source_file_is_left_behind() {
    let mut left = Vec::new();
    for krate in CRATES.into_iter().chain(["host/handoff"]) {
        let src = root().join(krate).join("src");
        left.extend(undeclared(&src, &sources(&src)));
    }
    assert!(left.is_empty(), "no module declares {left:?}");
}

#[test]
fn one_file_of_the_rig_names_the_mocks() {
    let src = root().join("host/rig/src");
    let naming: Vec<PathBuf> = sources(&src)
        .into_iter()
        .map(|(path, text)| (path.strip_prefix(&src).expect("below it").to_owned(), text))
        .filter(|(path, text)| !path.to_string_lossy().contains("tests") && code(text).contains("dpm_mock"))
        .map(|(path, _)| path)
        .collect();
    assert_eq!(naming, [PathBuf::from("mock.rs")]);
}

/// Names that no file of the engine may use in its code: threads, clocks, and I/O. A medium is passed in as a
/// `Transport`.
const OUTSIDE: [&str; 10] = [
    "std::thread",
    "SystemTime",
    "Instant",
    "Stopwatch",
    "dpm_common::clock",
    "std::fs",
    "std::net",
    "std::io::Read",
    "crate::pipeline",
    "crate::mock",
];

#[test]
fn the_engine_has_no_thread_no_clock_and_no_io() {
    let src = root().join("host/rig/src/engine");
    let files = sources(&src);
    assert!(files.len() >= 10, "the engine lies elsewhere: {files:?}");
    for (path, text) in files.into_iter().filter(|(path, _)| !path.ends_with("tests.rs")) {
        let code = code(&text);
        let named: Vec<_> = OUTSIDE.iter().filter(|outside| code.contains(**outside)).collect();
        assert!(named.is_empty(), "{} names {named:?}", path.display());
    }
}

/// Crates through which frames pass.
const ON_THE_WAY: [&str; 8] = [
    "device",
    "host/alp",
    "host/handoff",
    "host/common",
    "host/display",
    "host/tracking",
    "host/render",
    "host/rig",
];
/// The files in them that name a lock of the standard library, and why no frame waits for it. All others use
/// `dpm_handoff::path::Lock`, which counts where it is locked on the frame path; the tests of the frame path
/// (`tests/tests/laws/frame_law/`) demand that it never is.
const LOCKS: [(&str, &str); 5] = [
    ("host/handoff/src/path.rs", "the lock that counts"),
    ("host/common/src/keys/rows.rs", "the table of kinds, which is read with the rig file"),
    ("host/common/src/realtime/standstill.rs", "control threads and the collector"),
    ("host/render/src/gpu/instance.rs", "messages of the validation layer, which no rig loads"),
    ("host/rig/src/control/orders.rs", "threads that serve clients"),
];

#[test]
fn where_frames_pass_no_lock_is_named_but_the_one_that_counts() {
    let mut naming = Vec::new();
    for krate in ON_THE_WAY {
        for (path, text) in sources(&root().join(krate).join("src")) {
            let below = path.strip_prefix(root()).expect("below it").to_string_lossy().into_owned();
            let code = code(&text);
            let locks =
                |word: &&str| code.split(|c: char| c != '_' && !c.is_alphanumeric()).any(|w| w == *word);
            if !below.contains("tests") && ["Mutex", "RwLock", "Condvar"].iter().any(locks) {
                naming.push(below);
            }
        }
    }
    naming.sort();
    let mut listed: Vec<&str> = LOCKS.iter().map(|(path, _)| *path).collect();
    listed.sort_unstable();
    assert_eq!(naming, listed);
}

/// The modules at the top of a crate, and for each the modules whose names it uses.
type Arrows = BTreeMap<String, BTreeSet<String>>;

fn arrows(src: &Path) -> Arrows {
    let mut all = Arrows::new();
    for (path, text) in sources(src) {
        let below = path.strip_prefix(src).expect("below it");
        let top = below.components().next().expect("a name").as_os_str().to_string_lossy();
        let module = top.trim_end_matches(".rs").to_owned();
        if module == "lib" || below.to_string_lossy().contains("tests") {
            continue;
        }
        let used = all.entry(module.clone()).or_default();
        let code = code(&text);
        // From a file at the top of the crate, or from the root of a folder there, `super` is the crate.
        let is_root =
            below.components().count() == 1 || below.ends_with("mod.rs") && below.components().count() == 2;
        let above = if is_root { "super::" } else { "super::super::" };
        let named = names_after(&code, "crate::").chain(names_after(&code, above));
        used.extend(named.filter(|name| *name != module).map(String::from));
    }
    // Items that the crate's root re-exports are not modules.
    let modules: BTreeSet<String> = all.keys().cloned().collect();
    all.values_mut().for_each(|used| used.retain(|name| modules.contains(name)));
    all
}

/// A module that depends on itself, and the path of the circle.
fn circle(all: &Arrows) -> Option<Vec<String>> {
    fn walk<'a>(
        all: &'a Arrows,
        way: &mut Vec<&'a str>,
        done: &mut BTreeSet<&'a str>,
    ) -> Option<Vec<String>> {
        let here = *way.last()?;
        for next in &all[here] {
            if let Some(begin) = way.iter().position(|w| w == next) {
                return Some(way[begin..].iter().map(|w| (*w).to_owned()).collect());
            }
            if !done.contains(next.as_str()) {
                way.push(next);
                if let Some(found) = walk(all, way, done) {
                    return Some(found);
                }
                way.pop();
            }
        }
        done.insert(here);
        None
    }
    let mut done = BTreeSet::new();
    all.keys().find_map(|module| walk(all, &mut vec![module.as_str()], &mut done))
}

/// True for a word that is a bare participle by its ending: a type is a noun.
fn is_participle(name: &str) -> bool {
    const ENDINGS: [&str; 12] =
        ["ed", "wn", "ven", "ken", "ept", "ent", "old", "eard", "ead", "eft", "ound", "een"];
    const NOUNS: [&str; 34] = [
        "Agent",
        "Agreement",
        "Alignment",
        "Argument",
        "Bound",
        "Client",
        "Comment",
        "Component",
        "Content",
        "Current",
        "Descent",
        "Document",
        "Element",
        "Environment",
        "Event",
        "Extent",
        "Feed",
        "Fragment",
        "Instrument",
        "Judgement",
        "Moment",
        "Movement",
        "Need",
        "Placement",
        "Present",
        "Read",
        "Round",
        "Seed",
        "Segment",
        "Sheen",
        "Sound",
        "Speed",
        "Thread",
        "Token",
    ];
    let is_one_word = name.chars().skip(1).all(|c| c.is_ascii_lowercase());
    is_one_word && !NOUNS.contains(&name) && ENDINGS.iter().any(|ending| name.ends_with(ending))
}

/// Types that are named so all the same, by their crate, because many files name them. A new one takes another name.
const PARTICIPLES: [(&str, &str); 13] = [
    ("device", "Mapped"),
    ("device", "Shown"),
    ("hil-mock", "Executed"),
    ("host/lab", "Explained"),
    ("host/lab", "Measured"),
    ("host/lab", "Modelled"),
    ("host/lab", "Noticed"),
    ("host/lab", "Seen"),
    ("host/render", "Drawn"),
    ("host/render", "Shown"),
    ("host/render", "Spread"),
    ("host/rig", "Ended"),
    ("host/scene", "Deformed"),
];

#[test]
fn types_are_nouns() {
    let mut found = BTreeSet::new();
    for krate in CRATES {
        for (_, text) in sources(&root().join(krate).join("src")) {
            for word in ["struct ", "enum "] {
                found.extend(
                    names_after(&code(&text), word)
                        .filter(|n| is_participle(n))
                        .map(|n| (krate, n.to_owned())),
                );
            }
        }
    }
    let listed: BTreeSet<(&str, String)> = PARTICIPLES.iter().map(|(k, n)| (*k, (*n).to_owned())).collect();
    assert_eq!(found, listed);
}

#[test]
fn no_circle_joins_the_folders_of_a_crate() {
    for krate in CRATES {
        let all = arrows(&root().join(krate).join("src"));
        assert_eq!(circle(&all), None, "{krate}");
    }
}

/// A reader sees the whole of a function.
const MOST_LINES: usize = 70;

/// The functions of a formatted text with more lines than a reader sees, from the line of the name to that of the brace.
fn long_functions(text: &str) -> Vec<(String, usize)> {
    let lines: Vec<&str> = text.lines().collect();
    let indent = |line: &str| line.len() - line.trim_start().len();
    let words = ["pub", "const", "unsafe", "async", "extern"];
    let is_function = |line: &str| match line.split_once("fn ") {
        Some((before, _)) => before.split_whitespace().all(|word| words.iter().any(|w| word.starts_with(w))),
        None => false,
    };
    let length = |from: &[&str]| {
        // Without a body it ends with its declaration.
        let is_end =
            |line: &&str| indent(line) == indent(from[0]) && (line.trim() == "}" || line.ends_with(';'));
        from.iter().position(is_end).map_or(from.len(), |last| last + 1)
    };
    let begins = (0..lines.len()).filter(|at| is_function(lines[*at]));
    let all = begins.map(|at| (lines[at].trim().to_owned(), length(&lines[at..])));
    all.filter(|(_, length)| *length > MOST_LINES).collect()
}

#[test]
fn a_function_is_seen_whole() {
    let mut seen = 0;
    for krate in CRATES {
        let src = root().join(krate).join("src");
        for (path, text) in sources(&src) {
            // Tests are lists.
            if !path.strip_prefix(&src).unwrap().to_string_lossy().contains("tests") {
                assert_eq!(long_functions(&code(&text)), [], "{}", path.display());
                seen += 1;
            }
        }
    }
    assert!(seen > 500, "{seen} files");
    let of = |lines: usize| {
        format!(
            "    pub(crate) fn a(\n        b: u8,\n    ) {{\n{}    }}\n",
            "        c();\n".repeat(lines - 4)
        )
    };
    assert_eq!(long_functions(&of(MOST_LINES)), []);
    assert_eq!(long_functions(&of(MOST_LINES + 1)), [("pub(crate) fn a(".to_owned(), 71)]);
}

/// The cases are judged by the reference, so not even its tests may lean on them.
#[test]
fn the_reference_and_its_tests_name_no_case() {
    for (path, text) in sources(&root().join("host/lab/src/reference")) {
        let named = text.lines().find(|line| line.contains("stability::"));
        assert_eq!(named, None, "{}", path.display());
    }
}

#[test]
fn code_ends_where_tests_begin_and_not_where_a_file_of_them_is_declared() {
    let text = "#[cfg(test)]\nmod far;\nuse a;\n// b\n#[cfg(test)]\nmod tests {\n    use c;\n}\n";
    assert_eq!(code(text), "#[cfg(test)]\nmod far;\nuse a;");
}

#[test]
fn a_circle_is_found_and_a_diamond_is_none() {
    let of = |arrows: &[(&str, &[&str])]| -> Arrows {
        arrows.iter().map(|(m, used)| ((*m).into(), used.iter().map(|u| (*u).into()).collect())).collect()
    };
    assert_eq!(circle(&of(&[("a", &["b", "c"]), ("b", &["d"]), ("c", &["d"]), ("d", &[])])), None);
    let found = circle(&of(&[("a", &["b"]), ("b", &["c"]), ("c", &["b"])]));
    assert_eq!(found, Some(vec!["b".into(), "c".into()]));
}

/// Programs of integration tests that are not `laws`: they run alone in a virtual machine (`./x hil`).
const IN_A_MACHINE: [&str; 2] = ["host/display/tests/vkms/main.rs", "tests/tests/hil.rs"];

/// Folders of all crates of the workspace.
fn members() -> Vec<String> {
    let manifest = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let (_, list) = manifest.split_once("members = [").expect("the members");
    let (list, _) = list.split_once(']').expect("the end of the members");
    list.split('"').filter(|word| root().join(word).join("Cargo.toml").is_file()).map(Into::into).collect()
}

/// Every program of integration tests is linked with the whole rig: one a crate.
#[test]
fn a_crate_has_one_program_of_integration_tests() {
    let mut others = Vec::new();
    for member in members() {
        let Ok(entries) = std::fs::read_dir(root().join(&member).join("tests")) else { continue };
        for entry in entries {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let main = format!("{member}/tests/{name}/main.rs");
            if name.ends_with(".rs") && member != "tests" {
                others.push(format!("{member}/tests/{name}"));
            } else if name != "laws" && root().join(&main).is_file() {
                others.push(main);
            }
        }
    }
    others.extend(sources(&root().join("tests/tests")).into_iter().filter_map(|(path, _)| {
        let below = path.strip_prefix(root()).expect("below it").to_string_lossy().into_owned();
        (path.parent() == Some(&root().join("tests/tests"))).then_some(below)
    }));
    others.sort();
    assert_eq!(others, IN_A_MACHINE);
}

/// A row of `tests/costs.tsv`: what `./x test --record` measured.
struct Cost {
    unit: String,
    tier: String,
    core_s: f64,
}

fn costs() -> Vec<Cost> {
    let text = std::fs::read_to_string(root().join("tests/costs.tsv")).unwrap();
    let row = |line: &str| {
        let fields: Vec<&str> = line.split('\t').collect();
        let &[unit, tier, _, core_s] = &fields[..] else { panic!("{line:?} is no row of costs") };
        Cost { unit: unit.into(), tier: tier.into(), core_s: core_s.parse().expect("core-seconds") }
    };
    text.lines().filter(|line| !line.starts_with('#')).map(row).collect()
}

/// What the tests of the commit tier may take of one core, in seconds. Two cores do that in less than four minutes.
const COMMIT_TIER_S: f64 = 430.0;

#[test]
fn the_commit_tier_takes_no_longer_than_it_may() {
    let costs = costs();
    let sum: f64 = costs.iter().filter(|cost| cost.tier == "commit").map(|cost| cost.core_s).sum();
    assert!(sum <= COMMIT_TIER_S, "{sum:.0} core-seconds are recorded, {COMMIT_TIER_S} are allowed");
    let rows: BTreeSet<_> = costs.iter().map(|cost| (&cost.unit, &cost.tier)).collect();
    assert_eq!(rows.len(), costs.len(), "a row stands twice");
    let tiers: BTreeSet<&str> = costs.iter().map(|cost| cost.tier.as_str()).collect();
    assert_eq!(tiers, ["breadth", "commit", "real_pace"].into());
}

/// A file of tests that nobody has measured would not count.
#[test]
fn every_file_of_tests_of_the_commit_tier_has_a_recorded_cost() {
    let costs = costs();
    let mut missing = Vec::new();
    for member in members() {
        let folder = root().join(&member);
        let manifest = std::fs::read_to_string(folder.join("Cargo.toml")).unwrap();
        let name = manifest.split('"').nth(1).expect("the name of a package").to_owned();
        let has = |unit: &str| costs.iter().any(|cost| cost.unit == unit && cost.tier == "commit");
        let laws = folder.join("tests/laws");
        if laws.is_dir() {
            for (path, text) in sources(&laws) {
                let stem = path.file_stem().expect("a name").to_string_lossy().into_owned();
                let unit = format!("{name}::laws::{stem}");
                if path.parent() == Some(&laws) && text.lines().any(|line| line == "#[test]") && !has(&unit) {
                    missing.push(unit);
                }
            }
        }
    }
    assert!(missing.is_empty(), "run ./x test --record: {missing:?} have no row in tests/costs.tsv");
}
