//! A folder into what this program has left there: results, texts, plots, pictures and flights, each within a limit.

use dpm_device::regular_file;
use dpm_profile::svg::is_plain_svg;
use dpm_rig::failure::{Failure, FailureKind};
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Results of commands: the file, what it is called, and keys without which it is something else.
const RESULTS: [(&str, &str, &[&str]); 7] = [
    ("report.json", "Run", &["frames_lit", "missed_slots"]),
    ("profile.json", "Profile", &["intervals_ms", "frames_lit"]),
    ("bench.json", "Bench", BENCH_KEYS),
    ("plan.json", "Plan", &["method", "entries"]),
    ("error.json", "Error", &["groups"]),
    ("figure3.json", "Figure 3", &["groups"]),
    ("table.json", "Table", &["groups"]),
];

const BENCH_KEYS: &[&str] = &["stamp", "methods"];

/// Largest result or text that is read, bytes.
const MAX_RESULT_BYTES: u64 = 64 << 20;
/// Largest plot, picture or flight, bytes.
const MAX_ITEM_BYTES: u64 = 8 << 20;
/// Most plots, pictures and flights together that a page holds.
const MAX_ITEMS: usize = 64;
/// Most files of a folder that are looked at.
const MAX_FILES: usize = 10_000;

/// A measurement.
pub(super) struct FolderEntry {
    /// What it is called.
    pub(super) name: String,
    /// Its figures.
    pub(super) figures: Map<String, Value>,
    /// Its tables as text, for those that have them.
    pub(super) text: Option<String>,
    /// When its file was written, seconds since 1970.
    pub(super) written_s: u64,
}

/// What is in a folder.
#[derive(Default)]
pub(super) struct ReportFolder {
    pub(super) results: Vec<FolderEntry>,
    /// SVG texts.
    pub(super) plots: Vec<String>,
    /// Names and bytes of PNG files.
    pub(super) pictures: Vec<(String, Vec<u8>)>,
    /// Pages of the flight recorder.
    pub(super) flights: Vec<String>,
    /// Names and bytes of all files.
    pub(super) files: Vec<(String, u64)>,
    /// What was left out, and why.
    pub(super) notes: Vec<String>,
}

fn bad(path: &Path, told: impl std::fmt::Display) -> Failure {
    Failure::new(FailureKind::BadInput, format!("{}: {told}", path.display()))
}

impl ReportFolder {
    /// Reads the results in `dir`, and what lies beside them.
    ///
    /// # Errors
    /// There is no such folder; nothing in it is of this program; a result cannot be read or is something else.
    pub(super) fn read(dir: &Path) -> Result<Self, Failure> {
        let mut folder = Self { files: files(dir)?, ..Self::default() };
        for (file, name, keys) in RESULTS {
            if folder.has(file) {
                folder.results.push(result(&dir.join(file), name.to_owned(), keys)?);
            }
        }
        let sent: Vec<String> =
            folder.files.iter().map(|(name, _)| name.clone()).filter(|name| is_sent(name)).collect();
        if sent.len() > MAX_ITEMS {
            return Err(bad(
                dir,
                format!(
                    "it has {} reports of benches; take some out, a page has at most {MAX_ITEMS}",
                    sent.len()
                ),
            ));
        }
        for file in sent {
            folder.results.push(result(&dir.join(&file), format!("Bench of {file}"), BENCH_KEYS)?);
        }
        if folder.results.is_empty() {
            return Err(bad(dir, folder.why_nothing()));
        }
        let names: Vec<(String, u64)> = folder.files.clone();
        let mut items = 0;
        for (name, bytes) in &names {
            let path = dir.join(name);
            let (is_plot, is_picture) = (name.ends_with(".svg"), name.ends_with(".png"));
            if !(is_plot || is_picture || is_flight(name)) {
                continue;
            }
            items += 1;
            if items > MAX_ITEMS || *bytes > MAX_ITEM_BYTES {
                folder.notes.push(format!("{name} is not on this page, which would become too large"));
                continue;
            }
            let cannot = |e: std::io::Error| bad(&path, format!("cannot read it: {e}"));
            if is_picture {
                folder
                    .pictures
                    .push((name.clone(), regular_file::read(&path, MAX_ITEM_BYTES).map_err(cannot)?));
                continue;
            }
            let text = regular_file::read_text(&path, MAX_ITEM_BYTES).map_err(cannot)?;
            match is_plot {
                true if is_plain_svg(&text) => folder.plots.push(text),
                true => {
                    folder.notes.push(format!("{name} is not on this page: it is no plot of this program"))
                }
                false => folder.flights.push(text),
            }
        }
        Ok(folder)
    }

    fn has(&self, name: &str) -> bool {
        self.files.iter().any(|(file, _)| file == name)
    }

    /// Why there is nothing to report, and what to do.
    fn why_nothing(&self) -> String {
        let names = RESULTS.map(|(file, _, _)| file).join(", ");
        if self.files.iter().any(|(name, _)| is_group(name)) {
            return "its measured groups have not been joined; run `dpm error merge` with --out and this folder".into();
        }
        let what = if self.files.is_empty() { "it is empty" } else { "no file in it is a result of dpm" };
        format!("{what}; give the folder that --out of `dpm run`, `profile`, `bench`, `plan` or `error` named ({names}), or one with bench-*.json")
    }
}

/// A report that the owner of a GPU has sent in, `dpm bench --report bench-NAME.json`.
fn is_sent(name: &str) -> bool {
    name.starts_with("bench-") && name.ends_with(".json")
}

fn is_flight(name: &str) -> bool {
    name.starts_with("flight-") && name.ends_with(".txt")
}

/// A group of `dpm error` that waits to be joined.
fn is_group(name: &str) -> bool {
    ["group-", "figure3-", "table-"].iter().any(|start| name.starts_with(start)) && name.ends_with(".json")
}

/// Names and bytes of the plain files in `dir`, by name.
fn files(dir: &Path) -> Result<Vec<(String, u64)>, Failure> {
    let cannot = |e: std::io::Error| bad(dir, format!("cannot read this folder: {e}"));
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(cannot)?.take(MAX_FILES) {
        let entry = entry.map_err(cannot)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        // A file that vanishes meanwhile was not a result.
        let Ok(about) = entry.metadata() else { continue };
        if about.is_file() && !name.starts_with('.') {
            files.push((name, about.len()));
        }
    }
    files.sort();
    Ok(files)
}

fn result(path: &PathBuf, name: String, keys: &[&str]) -> Result<FolderEntry, Failure> {
    let text = regular_file::read_text(path, MAX_RESULT_BYTES)
        .map_err(|e| bad(path, format!("cannot read it: {e}")))?;
    let value: Value = serde_json::from_str(&text)
        .map_err(|e| bad(path, format!("is not JSON ({e}); measure again, or take it out of the folder")))?;
    let figures = match value {
        Value::Object(figures) if keys.iter().all(|key| figures.contains_key(*key)) => figures,
        _ => {
            let keys = keys.join(" and ");
            return Err(bad(
                path,
                format!("has no {keys}, so it is no result of dpm; take it out of the folder"),
            ));
        }
    };
    let beside = path.with_extension("md");
    let text = match regular_file::read_text(&beside, MAX_RESULT_BYTES) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => None,
        read => Some(read.map_err(|e| bad(&beside, format!("cannot read it: {e}")))?),
    };
    let written =
        std::fs::metadata(path).and_then(|about| about.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
    let written_s = written.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    Ok(FolderEntry { name, figures, text, written_s })
}
