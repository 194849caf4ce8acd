//! `dpm report DIR`: the folder of a run or a measurement into one HTML file, and a CSV file for each of its tables.

mod against_model;
mod folder;
mod html;
mod markdown;
mod table;

pub use table::{Cell, Table};

use against_model::against_model;
use dpm_common::files::write_atomically;
use dpm_profile::civil;
use dpm_rig::failure::Failure;
use dpm_rig::run_rig::cannot_write;
use folder::{FolderEntry, ReportFolder};
use html::{page, PagePart};
use markdown::blocks;
use serde::Serialize;
use serde_json::Value;
use std::io::Write;
use std::path::{Path, PathBuf};
use table::{figure, tables};

/// What was written.
#[derive(Clone, Debug, Serialize)]
pub struct ReportFiles {
    /// The page.
    pub page: PathBuf,
    /// The tables.
    pub tables: Vec<PathBuf>,
    /// What the page has not, and why.
    pub notes: Vec<String>,
}

/// Makes a page of what `dpm run`, `profile`, `bench`, `plan` or `error` left in `dir`: `report.html` in `out`, with the page's tables
/// as CSV in its folder `tables`. `title`: in place of one from the folder's name.
///
/// # Errors
/// `dir` is no folder, has no result, or has one that cannot be read; `out` cannot be written.
pub fn report(dir: &Path, out: &Path, title: Option<&str>) -> Result<ReportFiles, Failure> {
    let folder = ReportFolder::read(dir)?;
    let parts = parts(&folder);
    let name =
        dir.canonicalize().ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    let of_folder = || {
        let kinds: Vec<&str> = folder.results.iter().map(|found| found.name.as_str()).collect();
        format!("{}: {}", kinds.join(", "), name.unwrap_or_else(|| dir.display().to_string()))
    };
    let title = title.map_or_else(of_folder, str::to_owned);
    let put = |path: &Path, text: &str| {
        write_atomically(path, |file| file.write_all(text.as_bytes())).map_err(|e| cannot_write(path, &e))
    };
    let html = out.join("report.html");
    put(&html, &page(&title, &parts))?;
    let mut written: Vec<PathBuf> = Vec::new();
    for table in
        parts.iter().filter_map(|part| if let PagePart::Table(table) = part { Some(table) } else { None })
    {
        let path = out.join("tables").join(table.file_word() + ".csv");
        put(&path, &table.to_csv())?;
        written.push(path);
    }
    Ok(ReportFiles { page: html, tables: written, notes: folder.notes })
}

/// The parts of the page, what matters most first.
fn parts(folder: &ReportFolder) -> Vec<PagePart> {
    let mut parts: Vec<PagePart> = folder.results.iter().map(|found| PagePart::Table(facts(found))).collect();
    let told: Vec<String> =
        folder.results.iter().flat_map(warnings).chain(folder.notes.iter().cloned()).collect();
    if !told.is_empty() {
        parts.extend([PagePart::Heading("Notes".into()), PagePart::List(told)]);
    }
    for found in &folder.results {
        parts.extend(missed(found));
    }
    parts.extend(against_model(&folder.results));
    for text in &folder.flights {
        let first = text.lines().next().unwrap_or("Flight").to_owned();
        parts.push(PagePart::Folded(first, text.clone()));
    }
    if !folder.plots.is_empty() {
        parts.push(PagePart::Heading("Plots".into()));
        parts.extend(folder.plots.iter().cloned().map(PagePart::Plot));
    }
    for found in &folder.results {
        parts.push(PagePart::Heading(found.name.clone()));
        match &found.text {
            Some(text) => parts.extend(blocks(&found.name, text).into_iter().map(PagePart::from)),
            None => {
                let told = [&FACTS[..], &TOLD].concat();
                parts.extend(tables(&found.name, &found.figures, &told).into_iter().map(PagePart::Table));
            }
        }
    }
    if !folder.pictures.is_empty() {
        parts.push(PagePart::Heading("Pictures".into()));
        parts.extend(
            folder.pictures.iter().map(|(name, bytes)| PagePart::Picture(name.clone(), bytes.clone())),
        );
    }
    parts.push(PagePart::Heading("Files".into()));
    let size = |(name, bytes): &(String, u64)| format!("{name}, {:.1} kB", *bytes as f64 * 1e-3);
    parts.push(PagePart::List(folder.files.iter().map(size).collect()));
    parts
}

/// Keys that stand at the top of the page: what ran, on what, how long.
const FACTS: [&str; 21] = [
    "version",
    "dpm",
    "commit",
    "gpu",
    "software_gpu",
    "device",
    "driver",
    "software",
    "cores",
    "priority",
    "config_hash",
    "seed",
    "raster",
    "planes",
    "frame_rate_hz",
    "pace",
    "method",
    "prediction",
    "slots",
    "frames_lit",
    "wall_s",
];

/// Keys that are told outside the tables of figures, beside [`FACTS`].
const TOLD: [&str; 9] = [
    "warnings",
    "setup",
    "stamp",
    "missed",
    "missed_by_cause",
    "missed_slots",
    "missed_share",
    "excused_by_standstill",
    "standstill_ns",
];

/// Date, program, machine and sample counts of a measurement.
fn facts(found: &FolderEntry) -> Table {
    let figures = &found.figures;
    let group = figures.get("groups").and_then(|groups| groups.get(0));
    let inner = [figures.get("setup"), figures.get("stamp"), group.and_then(|group| group.get("stamp"))];
    let known = FACTS.into_iter().filter_map(|key| {
        let value = inner.iter().flatten().find_map(|object| object.get(key)).or_else(|| figures.get(key))?;
        Some(figure(key, value)?.into())
    });
    let slot = figures.get("frame_rate_hz").and_then(Value::as_f64).filter(|hz| *hz > 0.0);
    let slot = slot.and_then(|hz| Some(figure("one_slot_ms", &(1e3 / hz).into())?.into()));
    let written = vec![Cell::text("written"), Cell::text(date(found.written_s))];
    Table {
        title: format!("{}: what was measured", found.name),
        head: vec!["what".into(), "value".into()],
        rows: std::iter::once(written).chain(known).chain(slot).collect(),
    }
}

/// Seconds since 1970 as a date and time, UTC.
fn date(seconds: u64) -> String {
    let (year, month, day) = civil(seconds / 86_400);
    let (hour, minute) = (seconds / 3600 % 24, seconds / 60 % 60);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02} UTC")
}

fn warnings(found: &FolderEntry) -> Vec<String> {
    let list = found.figures.get("warnings").and_then(Value::as_array);
    list.into_iter().flatten().filter_map(Value::as_str).map(str::to_owned).collect()
}

/// How many slots were missed, and why; nothing for a measurement without slots.
fn missed(found: &FolderEntry) -> Vec<PagePart> {
    let count = |key: &str| found.figures.get(key).and_then(Value::as_u64);
    let (Some(slots), Some(missed)) = (count("slots"), count("missed_slots")) else { return Vec::new() };
    let share = found.figures.get("missed_share").and_then(Value::as_f64).unwrap_or(0.0);
    let mut told = format!("{missed} of {slots} slots were missed ({:.3} %).", 100.0 * share);
    if let Some(excused) = count("excused_by_standstill").filter(|n| *n > 0) {
        told += &format!(" In {excused} of them the machine itself stood still.");
    }
    if let Some([total, longest]) =
        found.figures.get("standstill_ns").and_then(Value::as_array).map(Vec::as_slice)
    {
        let ms = |v: &Value| v.as_f64().unwrap_or(0.0) * 1e-6;
        told += &format!(
            " The machine stood still for {:.1} ms in all, {:.1} ms at the longest.",
            ms(total),
            ms(longest)
        );
    }
    let causes = found
        .figures
        .get("missed_by_cause")
        .or_else(|| found.figures.get("missed"))
        .and_then(Value::as_object);
    let mut parts = vec![PagePart::Heading(format!("{}: missed slots", found.name)), PagePart::Text(told)];
    if let Some(causes) = causes.filter(|_| missed > 0) {
        let row = |(cause, slots): (&String, &Value)| vec![Cell::text(cause), Cell::text(slots.to_string())];
        parts.push(PagePart::Table(Table {
            title: format!("{}: missed slots by cause", found.name),
            head: vec!["cause".into(), "slots".into()],
            rows: causes.iter().map(row).collect(),
        }));
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_have_a_time() {
        assert_eq!(date(0), "1970-01-01 00:00 UTC");
        assert_eq!(date(20_779 * 86_400 + 15 * 3600 + 59 * 60 + 3), "2026-11-22 15:59 UTC");
    }
}
