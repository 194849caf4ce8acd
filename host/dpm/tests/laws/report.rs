//! `dpm report` of what the other commands leave in a folder: one page that needs nothing else.

use crate::cli_common::{code, dpm, err, out, TestFolder};
use std::path::{Path, PathBuf};

/// Runs a command whose output goes to `name` in `folder`; returns that folder.
fn measured(folder: &TestFolder, name: &str, args: &[&str]) -> PathBuf {
    let dir = Path::new(folder.text()).join(name);
    let output = dpm(&[args, &["--out", dir.to_str().expect("text")]].concat(), &[]);
    assert_eq!(code(&output), 0, "{args:?}: {}", err(&output));
    dir
}

/// The page of `dir`, and the files that the command names. Nothing in the page comes from outside, and nothing runs.
fn page(dir: &Path) -> (String, Vec<PathBuf>) {
    let output = dpm(&["report", dir.to_str().expect("text"), "--json"], &[]);
    assert_eq!(code(&output), 0, "{}", err(&output));
    let files: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    assert_eq!(files["notes"], serde_json::json!([]));
    let tables = files["tables"].as_array().expect("a list").iter();
    let tables = tables.map(|path| PathBuf::from(path.as_str().expect("a path"))).collect();
    let page = std::fs::read_to_string(files["page"].as_str().expect("a path")).expect("a page");
    assert!(page.starts_with("<!DOCTYPE html>") && page.ends_with("</body></html>\n"));
    for outside in ["<script", "<link", "href=", "@import", "src=\"http", "url("] {
        assert!(!page.contains(outside), "{outside}");
    }
    (page, tables)
}

/// What a command says of a folder that it refuses.
fn refused(dir: &Path) -> String {
    let output = dpm(&["report", dir.to_str().expect("text")], &[]);
    assert_eq!(code(&output), 2, "{}", out(&output));
    assert!(!dir.join("report.html").exists());
    err(&output)
}

#[test]
fn a_profile_is_a_page_with_its_latencies_and_missed_slots() {
    let folder = TestFolder::new("report-profile");
    let args = [
        "profile",
        "--no-render",
        "--seconds",
        "1",
        "--raster",
        "64x48",
        "--set",
        "output.flight_recorder=true",
    ];
    let dir = measured(&folder, "profile", &args);
    let (page, tables) = page(&dir);
    let profile = std::fs::read_to_string(dir.join("profile.json")).expect("a profile");
    let profile: serde_json::Value = serde_json::from_str(&profile).expect("JSON");
    let (missed, slots) = (&profile["missed_slots"], &profile["slots"]);
    for part in [
        format!("{missed} of {slots} slots were missed"),
        "one slot".into(),
        "motion to first photon".into(),
        profile["setup"]["commit"].as_str().expect("a commit").into(),
        " UTC".into(),
    ] {
        assert!(page.contains(&part), "{part}");
    }
    assert_eq!(page.matches("<svg").count(), 4, "work, waits, latency and the histogram");
    // The table of intervals as CSV has the figures of the profile with all digits.
    let csv = tables
        .iter()
        .find(|path| path.ends_with("profile-intervals-ms.csv"))
        .expect("the table of intervals");
    let csv = std::fs::read_to_string(csv).expect("a table");
    let worst = profile["intervals_ms"]["motion_to_first_photon"]["max"].to_string();
    let row = csv.lines().find(|line| line.starts_with("motion to first photon")).expect("a row");
    assert!(row.split(',').any(|cell| cell == worst), "{worst} in {row}");
    // A page is not a result: the folder can be reported again.
    assert_eq!(self::page(&dir).0.matches("<svg").count(), 4);
}

/// Owners of GPUs send files in; a page of a folder of them sets each beside the model.
#[test]
fn reports_of_several_machines_stand_beside_the_model() {
    let folder = TestFolder::new("sent");
    let sent = folder.path("sent");
    let file = |name: &str| sent.join(name).display().to_string();
    for name in ["bench-mine.json", "bench-of-a-friend.json"] {
        let args =
            ["bench", "--raster", "48x32", "--count", "3", "--method", "full", "--report", &file(name)];
        let output = dpm(&args, &[]);
        assert_eq!(code(&output), 0, "{}", err(&output));
    }
    let (page, tables) = page(&sent);
    assert!(page.contains("Bench of bench-mine.json: methods") && page.contains("none of them was measured"));
    let beside =
        tables.iter().find(|path| path.ends_with("measured-beside-the-model.csv")).expect("the table");
    let text = std::fs::read_to_string(beside).unwrap();
    let rows: Vec<&str> = text.lines().skip(1).collect();
    assert_eq!(rows.len(), 2, "{text}");
    // Software Vulkan is no card of the model.
    assert!(rows.iter().all(|row| row.starts_with("Bench of bench-") && row.ends_with(",-")), "{text}");

    let many = folder.path("many");
    std::fs::create_dir(&many).unwrap();
    for i in 0..65 {
        std::fs::copy(sent.join("bench-mine.json"), many.join(format!("bench-{i}.json"))).unwrap();
    }
    let why = refused(&many);
    assert!(why.contains("it has 65 reports of benches; take some out"), "{why}");

    let cannot = dpm(&["bench", "--count", "3", "--report", "/proc/nowhere/bench.json"], &[]);
    assert_eq!(code(&cannot), 2, "{}", err(&cannot));
    assert!(err(&cannot).contains("choose another file with --report"), "{}", err(&cannot));
    let into_a_folder = dpm(&["bench", "--count", "3", "--report", &sent.display().to_string()], &[]);
    assert_eq!(code(&into_a_folder), 2, "{}", err(&into_a_folder));
    assert!(
        err(&into_a_folder).contains("is a folder; name a file in it with --report"),
        "{}",
        err(&into_a_folder)
    );
}

#[test]
fn a_folder_without_results_is_refused_with_what_to_do() {
    let folder = TestFolder::new("report-refused");
    let root = Path::new(folder.text());
    let dir = |name: &str, files: &[(&str, &str)]| {
        let dir = root.join(name);
        std::fs::create_dir_all(&dir).expect("a folder");
        files.iter().for_each(|(file, text)| std::fs::write(dir.join(file), text).expect("a file"));
        dir
    };
    for (dir, told) in [
        (dir("empty", &[]), "it is empty; give the folder that --out"),
        (dir("foreign", &[("notes.txt", "x"), ("data.json", "{}")]), "no file in it is a result of dpm"),
        (dir("broken", &[("profile.json", "{\"interv")]), "is not JSON"),
        (dir("other", &[("report.json", "{\"passed\": 3}")]), "has no frames_lit and missed_slots"),
        (dir("groups", &[("group-still-1-00.json", "{}")]), "dpm error merge"),
        (root.join("nowhere"), "cannot read this folder"),
    ] {
        let error = refused(&dir);
        assert!(error.contains(told) && error.contains(dir.to_str().expect("text")), "{error}");
    }
}

#[test]
fn what_others_put_beside_a_result_is_left_out_by_name() {
    let folder = TestFolder::new("report-foreign");
    let dir = measured(&folder, "bench", &["bench", "--raster", "48x32", "--count", "3", "--method", "full"]);
    let evil = "<svg xmlns=\"http://www.w3.org/2000/svg\"><script>alert(1)</script></svg>";
    std::fs::write(dir.join("evil.svg"), evil).expect("a file");
    let output = dpm(&["report", dir.to_str().expect("text")], &[]);
    assert_eq!(code(&output), 0, "{}", err(&output));
    assert!(out(&output).contains("evil.svg is not on this page"), "{}", out(&output));
    let page = std::fs::read_to_string(dir.join("report.html")).expect("a page");
    assert!(page.contains("evil.svg is not on this page") && !page.contains("<script"));
}

/// Whole reports.
mod breadth {
    use super::*;

    #[test]
    fn a_run_and_a_bench_are_pages_with_pictures_and_tables() {
        let folder = TestFolder::new("report-run");
        let run = measured(&folder, "run", &["demo", "--raster", "48x32", "--frames", "6"]);
        let (page_of_run, _) = page(&run);
        for part in [
            "data:image/png;base64,",
            "light.png",
            "registration error, px",
            "0 of 6 slots were missed",
            "gpu trace",
        ] {
            assert!(page_of_run.contains(part), "{part}");
        }
        let bench =
            measured(&folder, "bench", &["bench", "--raster", "48x32", "--count", "3", "--method", "full"]);
        let (page_of_bench, tables) = page(&bench);
        assert!(page_of_bench.contains("Bench: methods") && page_of_bench.contains("config hash"));
        assert!(tables.iter().any(|path| path.ends_with("bench-methods.csv")), "{tables:?}");
    }
}
